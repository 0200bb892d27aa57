"""`kinjax annotate`, `query`, `store` and `evaluate`, and what docs/annotation.md says of them."""

import csv
import errno
import io
import itertools
import json
import re
import shlex
import shutil
import subprocess
from dataclasses import fields, replace
from pathlib import Path

import pytest
from database_cases import folder_of_clips, walk
from store_cases import by_hand, damaged, random_stores, store_of

from kinjax.cli import main
from kinjax.cli.annotating import _configuration
from kinjax.cli.parse import parse
from kinjax.database import Configuration, Store, TemplateRule, When, query, read_configuration
from kinjax.database.schema import TABLES
from kinjax.database.upkeep import check
from kinjax.evaluation import Label
from kinjax.formats import write_labels
from kinjax.synthetic import walking_biped


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """No test touches the user's cache of compiled programs."""
    monkeypatch.setenv("KINJAX_CACHE", "off")


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> list[tuple[Store, dict]]:
    """Random stores with what is in them."""
    return random_stores(tmp_path_factory.mktemp("random"))


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Three short walks and a file that is cut."""
    return folder_of_clips(tmp_path_factory.mktemp("my clips") / "clips", 3, ("cut.bvh",))


@pytest.fixture(scope="module")
def annotated(clips, tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("store") / "s"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KINJAX_CACHE", "off")
        assert main(["annotate", str(clips), "-o", str(store), "--object", "feet", "-q"]) == 3
    return store


def run(capsys, *args: object, code: int = 0) -> tuple[str, str]:
    """What a command prints to stdout and stderr."""
    capsys.readouterr()
    assert main([str(a) for a in args]) == code
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return told.out, told.err


def fails(capsys, *args: object) -> str:
    """The line of a command that is refused."""
    out, err = run(capsys, *args, code=2)
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("kinjax: error: "), (out, err)
    return err


def test_annotate_counts_and_exits(clips, tmp_path, capsys):
    shutil.copytree(clips, tmp_path / "clips")
    command = ["annotate", tmp_path / "clips", "-o", tmp_path / "s", "--object", "feet"]
    out, err = run(capsys, *command, code=3)
    lines = {line.rsplit("  ", 1)[0].strip(): line for line in out.splitlines()}
    assert all(lines[k].split()[-1] == v for k, v in (("found", "4"), ("annotated", "3"), ("refused", "1"))), out
    assert err == "" and "FileFormatError 1" in out and f"store: {tmp_path / 's'}" in out and "frames" in out
    out, _ = run(capsys, *command, code=3)
    assert "4, of which 1 refused" in out and "frames" not in out
    out, _ = run(capsys, *command, "--retry", code=3)
    assert "FileFormatError 1" in out
    assert run(capsys, *command, "-q", code=3) == ("", "")
    (tmp_path / "clips" / "cut.bvh").unlink()
    out, _ = run(capsys, *command)
    assert any(line.split() == ["gone", "from", "the", "folders", "1"] for line in out.splitlines())
    assert run(capsys, *command, "--quiet") == ("", "")


def test_a_full_disk_is_exit_1_and_keeps_what_is_there(clips, tmp_path, capsys, monkeypatch):
    from kinjax.database import store as room

    real, left = room.pq.write_table, [5]

    def full(*args, **kwargs):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "s"))
        return real(*args, **kwargs)

    monkeypatch.setattr(room.pq, "write_table", full)
    command = ["annotate", clips, "-o", tmp_path / "s", "--object", "feet", "--part-clips", "1"]
    out, err = run(capsys, *command, code=1)
    assert out == "" and "No space left on device" in err and "the same command goes on from there" in err
    assert len(Store(tmp_path / "s").parts()) == 1
    monkeypatch.undo()
    monkeypatch.setenv("KINJAX_CACHE", "off")
    out, _ = run(capsys, *command, code=3)
    assert "done before" in out and check(Store(tmp_path / "s")) == []


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ([], "no folder"),
        (["CLIPS"], "-o STORE"),
        (["nowhere", "-o", "s"], "no such folder"),
        (["CLIPS", "-o", "CLIPS"], "no store"),
        (["CLIPS", "-o", "s", "--object", "LeftFoot", "--type", "plane"], "plane"),
        (["CLIPS", "-o", "s", "--template", "a.bvh"], "CLIP:NAME=BEGIN:END"),
        (["CLIPS", "-o", "s", "--template", "a.bvh:LeftFoot=1:20:plane"], "space, line, point"),
        (["CLIPS", "-o", "s", "--template", "a.bvh:LeftFoot=1:20"], "no clip 'a.bvh'"),
        (["CLIPS", "-o", "s", "--method", "paper"], "templates"),
        (["CLIPS", "-o", "s", "--set", "stil=1,2"], "still"),
        (["CLIPS", "-o", "s", "--workers", "2"], "--engine dask"),
        (["CLIPS", "-o", "s", "--scheduler", "tcp://127.0.0.1:1"], "--engine dask"),
        (["CLIPS", "-o", "s", "--engine", "spark"], "spark"),
        (["CLIPS", "-o", "s", "--timeout", "0"], "timeout"),
        (["CLIPS", "-o", "s", "--attempts", "0"], "attempts"),
        (["CLIPS", "-o", "s", "--part-clips", "0"], "part_clips"),
        (["CLIPS", "-o", "s", "-c", "nowhere.toml"], "nowhere.toml"),
        (["CLIPS", "-o", "s", "-c", "CLIPS/cut.bvh"], "cut.bvh"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_annotate_refuses(args, says, clips, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert says in fails(capsys, "annotate", *[a.replace("CLIPS", str(clips)) for a in args])
    assert not (tmp_path / "s").exists()


def asked(*args: object) -> Configuration:
    """The configuration that the options of `kinjax annotate` ask for."""
    return _configuration(parse(["annotate", "folder", "-o", "store", *map(str, args)]))


def test_options_come_before_the_configuration_file(tmp_path):
    path = tmp_path / "job.toml"
    path.write_text(
        """objects = ["hands"]\nexclude = ["cut*", "*_001.bvh"]\nunit = "cm"\nup = "z"\n[settings]\ntypes = ["space"]\nmin_duration = 0.1
[[template]]\nclip = "a.bvh"\nobject = "LeftHand"\nbegin = 1\nend = 9\n"""
    )
    plain = asked("-c", path)
    assert plain == read_configuration(path) and plain.objects == ("hands",) and asked() == Configuration()
    more = asked("-c", path, "--object", "LeftFoot", "*Toe*", "--object", "head", "--unit", "m", "--up", "y", "--set", "types=space,line")
    assert more.objects == ("LeftFoot", "*Toe*", "head") and (more.unit, more.up) == ("m", "y")
    assert more.settings == plain.settings.but(types=("space", "line")) and more.settings.min_duration == 0.1
    assert (more.exclude, more.templates) == (plain.exclude, plain.templates)
    assert asked("-c", path, "--method", "paper").settings.method == "paper"
    assert asked("-c", path, "--type", "line", "--set", "types=space").settings.types == ("space",)
    taught = asked("-c", path, "--template", "C:/x/b.bvh:LeftFoot=3:8:line", "c.bvh:left_foot=0:5", "--carry", "subject")
    assert taught.templates == (
        *plain.templates,
        TemplateRule("C:/x/b.bvh", "LeftFoot", 3, 8, "line", "subject"),
        TemplateRule("c.bvh", "left_foot", 0, 5, "space", "subject"),
    )
    assert taught.settings.types == ("space", "line")


def test_a_configuration_file_on_the_command_line(clips, tmp_path, capsys):
    config = tmp_path / "job.toml"
    config.write_text('objects = ["hands"]\nexclude = ["cut*", "*_001.bvh"]\n')
    run(capsys, "annotate", clips, "-o", tmp_path / "s", "-c", config, "--object", "feet", "--up", "y")
    rows = query(tmp_path / "s", "SELECT clip, objects, up FROM clips ORDER BY clip").to_pylist()
    assert [(r["clip"][-7:], r["objects"], r["up"]) for r in rows] == [(n, ["LeftFoot", "RightFoot"], "y") for n in ("000.bvh", "002.bvh")]
    manifest = Store(tmp_path / "s").manifest()["configuration"]
    assert manifest["objects"] == ["feet"] and manifest["exclude"] == ["cut*", "*_001.bvh"]


def test_a_template_on_the_command_line(clips, tmp_path, capsys):
    rest = next(c for c in walking_biped(rate=30, steps=2).truth if c.object == "LeftFoot" and c.type == "space")
    begin, end = rest.begin + 2, rest.end - 2
    name = f"{clips}/s00/00_001.bvh:left_foot={begin}:{end}"
    run(capsys, "annotate", clips / "s00", "-o", tmp_path / "s", "--object", "feet", "--template", name)
    rows = query(tmp_path / "s", "SELECT object, template, status FROM patterns ORDER BY ALL").to_pylist()
    taught = [r for r in rows if r["template"]]
    assert len(taught) == 3 and {r["object"] for r in taught} == {"LeftFoot"}
    assert all(r["template"] == f"00_001.bvh LeftFoot {begin}:{end}" and r["status"] != "automatic" for r in taught)

NASTY = {
    "=cmd|'/c calc'!A1.bvh": (60.0, [("LeftFoot", "space", 0, 30)]),
    "+1\x1b[31m\nend.bvh": (60.0, [("@SUM(1)", "line", 5, 35)]),
    "-a,\"b\".bvh": (60.0, [("RightFoot", "space", 5, 6)]),
    "\t[bold]x[/bold] $(touch x) `y` 'z'.bvh": (60.0, [("LeftFoot", "point", 1, 2)]),
}  # fmt: skip


@pytest.fixture
def nasty(tmp_path) -> Path:
    return store_of(tmp_path / "nasty", NASTY).path


def test_tables_hold_no_control_characters(nasty, capsys):
    out, _ = run(capsys, "query", nasty, "SELECT clip, object FROM constraints ORDER BY clip")
    assert all(c.isprintable() or c == "\n" for c in out) and "[bold]x[/bold]" in out and "4 rows" in out
    assert len(out.splitlines()) == 6
    out, _ = run(capsys, "query", nasty, "SELECT 1 AS \"a\x1b[0m\", NULL, [1.5, 2.25], 1e-7, true")
    assert "\x1b" not in out and "1.5, 2.25" in out and "1e-07" in out


def test_csv_is_safe_for_spreadsheets(nasty, capsys):
    out, _ = run(capsys, "query", nasty, "SELECT clip, object, begin, -1.5 AS \"=x\" FROM constraints ORDER BY clip", "--format", "csv")
    rows = list(csv.reader(io.StringIO(out)))
    assert rows[0] == ["clip", "object", "begin", "'=x"] and len(rows) == 5
    clips = sorted(NASTY)
    for row, clip in zip(rows[1:], clips, strict=True):
        assert row[0] == "'" + clip and row[3] == "-1.5" and row[1] in ("'@SUM(1)", "LeftFoot", "RightFoot")
    out, _ = run(capsys, "query", nasty, "SELECT ['a', '=b'] AS l, NULL AS n, DATE '2020-02-03' AS d, {'k': 1} AS s", "--format", "csv")
    assert next(csv.reader(io.StringIO(out.splitlines()[1]))) == ['["a", "=b"]', "", '"2020-02-03"', '{"k": 1}']


def test_json_is_json(nasty, capsys):
    def strict(text):
        return json.loads(text, parse_constant=lambda c: pytest.fail(f"{c} is no JSON"))

    sql = "SELECT c.clip, sum(k.frames) AS frames, 'nan'::DOUBLE AS nan, [1, 'inf'::DOUBLE] AS l, 1.5 AS d, DATE '2020-02-03' AS t "
    out, _ = run(capsys, "query", nasty, sql + "FROM constraints c JOIN clips k USING (clip) GROUP BY ALL", "--format", "json")
    rows = strict(out)
    assert sorted(r["clip"] for r in rows) == sorted(NASTY)
    assert all((r["frames"], r["nan"], r["l"], r["d"], r["t"]) == (500, None, [1, None], 1.5, "2020-02-03") for r in rows)
    out, _ = run(capsys, "query", nasty, "FROM patterns", "--format", "json")
    assert strict(out)[0]["sigma_max"] == [0.5, None]
    assert run(capsys, "query", nasty, "FROM clips WHERE false", "--format", "json")[0] == "[]\n"


def test_limit(stores, capsys):
    store, clips = stores[0]
    n = sum(len(f) for _, f in clips.values())
    sql = "SELECT clip FROM constraints"
    out, _ = run(capsys, "query", store.path, sql, "--limit", "3")
    assert f"{n} rows, {n - 3} more: --limit 0 shows all" in out and len(out.splitlines()) == 5
    assert len(run(capsys, "query", store.path, sql, "--limit", "0")[0].splitlines()) == n + 2
    assert len(run(capsys, "query", store.path, sql, "--limit", "3", "--format", "csv")[0].splitlines()) == n + 1
    assert "1 row" in run(capsys, "query", store.path, "SELECT 1")[0]


def test_when_on_the_command_line(stores, capsys):
    store, clips = stores[4]

    def rows(*when: str, least: float = 0.0) -> list[dict]:
        args = [x for w in when for x in ("--when", w)]
        return json.loads(run(capsys, "query", store.path, *args, "--least", least, "--format", "json")[0])

    for texts, conditions in (
        (["left_foot"], [When("left_foot")]),
        (["LEFTFOOT:space"], [When("left_foot", "space")]),
        (["left_foot:0.2"], [When("left_foot", None, 0.2)]),
        (["left_foot:space:0.2", "*::0.1"], [When("left_foot", "space", 0.2), When(None, None, 0.1)]),
        (["mixamorig:RightHand", "*:line"], [When("right_hand"), When(None, "line")]),
        (["mixamorig:RightHand:space:0.05", "", "door"], [When("right_hand", "space", 0.05), When(), When("door")]),
    ):
        expected = by_hand(clips, tuple(conditions), 0.01)
        assert sorted(tuple(r.values()) for r in rows(*texts, least=0.01)) == sorted(expected), texts


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ([], "give SQL, or --when"),
        (["SELECT 1", "--when", "left_foot"], "give SQL, or --when"),
        (["--when", "left_fot"], "left_foot"),
        (["--when", "left_foot:plane"], "plane"),
        (["--when", "left_foot:1:2"], "OBJECT:TYPE:SECONDS"),
        (["--when", "left_foot:-1"], "not negative"),
        (["--when", "left_foot:nan"], "not negative"),
        (["--when", "left_foot", "--least", "-1"], "not negative"),
        (["SELECT nothing FROM clips"], "nothing"),
        (["COPY (SELECT 1) TO 'x.csv'"], "COPY is no question"),
        (["SELECT 1", "--play"], "column path"),
        (["SELECT 1", "--format", "xml"], "xml"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_query_refuses(args, says, stores, capsys):
    assert says in fails(capsys, "query", stores[5][0].path, *args)


def test_commands_without_a_store(tmp_path, capsys):
    assert "no store is given" in fails(capsys, "query")
    assert "no store" in fails(capsys, "query", tmp_path, "SELECT 1")
    assert "no store" in fails(capsys, "store", "check", tmp_path / "nothing")
    assert "store and labels" in fails(capsys, "evaluate")
    assert "mend" in fails(capsys, "store", "mend", tmp_path)


def test_play_prints_commands_that_run(annotated, clips, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out, _ = run(capsys, "query", annotated, "--when", "left_foot:space:0.2", "--when", "right_foot", "--play")
    lines = out.splitlines()
    assert lines and all(line.startswith("kinjax plot ") for line in lines)
    words = shlex.split(lines[0])
    assert words[2].startswith(str(clips)) and words[words.index("--object") + 1 :] == ["LeftFoot", "RightFoot"]
    begin, end = map(int, words[words.index("--frames") + 1].split(":"))
    assert 0 <= begin <= end < walk().frames
    out, _ = run(capsys, *words[1:])
    pictures = sorted(p.name for p in (tmp_path / "kinjax-out").iterdir())
    stem = Path(words[2]).stem
    assert f"{stem}-timeline.png" in pictures and f"{stem}-scene.png" in pictures and len(pictures) > 3
    assert all((tmp_path / "kinjax-out" / p).read_bytes()[:4] == b"\x89PNG" for p in pictures)


def test_play_quotes_what_a_shell_would_obey(nasty, tmp_path, capsys):
    sql = 'SELECT path, object, type, begin - 0.5 AS begin, "end" + 0.5 AS "end" FROM constraints'
    out, _ = run(capsys, "query", nasty, sql, "--play")
    assert all(c.isprintable() or c == "\n" for c in out) and len(out.splitlines()) == 4
    shown = subprocess.run(["bash", "-c", out.replace("kinjax plot", "printf '%s\\0'")], capture_output=True, check=True, timeout=60)
    words = shown.stdout.decode().split("\0")
    assert {w for w in words if w.startswith("/data/")} == {f"/data/{c}" for c in NASTY} and "@SUM(1)" in words
    assert words[words.index("0:31") :][:3] == ["0:31", "--object", "LeftFoot"] and not (tmp_path / "x").exists()
    assert words[words.index("4:36") :][:6] == ["4:36", "--object", "@SUM(1)", "--type", "space", "line"]
    out, _ = run(capsys, "query", nasty, "SELECT path FROM clips UNION ALL SELECT NULL", "--play")
    assert len(out.splitlines()) == 4 and "--frames" not in out


@pytest.mark.parametrize("frames", ["5", "9:3", "a:b", "1:2:3", "-1:5", "0:100000", ""])
def test_frames_that_cannot_be_drawn(frames, clips, tmp_path, capsys):
    told = fails(capsys, "plot", clips / "s00" / "00_000.bvh", f"--frames={frames}", "-o", tmp_path, "--object", "LeftFoot")
    assert "--frames" in told and not list(tmp_path.iterdir())


def test_check_and_compact(annotated, clips, tmp_path, capsys):
    store = tmp_path / "s"
    run(capsys, "annotate", clips, "-o", store, "--object", "feet", "--part-clips", "1", code=3)
    n = len(Store(store).parts())
    out, err = run(capsys, "store", "check", store)
    assert out.startswith("whole: 3 clips, ") and "1 errors" in out and err == ""
    out, _ = run(capsys, "store", "compact", store)
    assert out == f"{n} parts are now 1: {store}\n" and n > 1
    assert run(capsys, "store", "compact", store, "-q") == ("", "")
    assert run(capsys, "store", "check", store, "--quiet") == ("", "")
    assert "done before" in run(capsys, "annotate", clips, "-o", store, "--object", "feet", code=3)[0]
    damaged(Store(store), "constraints", 0, "cut")
    out, err = run(capsys, "store", "check", store, code=3)
    assert "1 complaints" in out and "part-" in err
    assert run(capsys, "store", "check", store, "-q", code=3)[0] == ""
    assert "part-" in fails(capsys, "store", "compact", store)
    run(capsys, "annotate", clips, "-o", store, "--object", "feet", code=3)
    assert run(capsys, "store", "check", store, "-q") == ("", "")


# evaluation of a store


def test_labels_that_are_what_was_found_score_one(stores, tmp_path, capsys):
    store, clips = stores[0]
    merged = {(clip, c[0], c[1]): set() for clip, (_, found) in clips.items() for c in found}
    for clip, (_, found) in clips.items():
        for o, kind, begin, end in found:
            merged[clip, o, kind] |= set(range(begin, end + 1))
    labels = []
    for (clip, o, kind), frames in merged.items():
        for _, run_of in itertools.groupby(enumerate(sorted(frames)), lambda x: x[1] - x[0]):
            at = [f for _, f in run_of]
            labels.append(Label(clip, o, at[0], at[-1], type=kind))
    write_labels(tmp_path / "labels.json", labels)
    run(capsys, "evaluate", store.path, tmp_path / "labels.json", "--json", tmp_path / "all.json")
    out, _ = run(capsys, "evaluate", store.path, tmp_path / "labels.json", "--json", "-")
    document = json.loads(out)
    assert document == json.loads((tmp_path / "all.json").read_text())
    total = document["scores"][-1]
    assert (total["precision"], total["recall"], total["f1"]) == (1, 1, 1)
    half = [Label(x.clip, x.object, x.begin, x.begin + (x.end - x.begin) // 2, type=x.type) for x in labels]
    write_labels(tmp_path / "half.csv", half)
    out, _ = run(capsys, "evaluate", store.path, tmp_path / "half.csv", "--json", "-")
    total = json.loads(out)["scores"][-1]
    wanted = sum(x.end - x.begin + 1 for x in half)
    frames = sum(x.end - x.begin + 1 for x in labels)
    assert total["recall"] == 1 and total["precision"] == pytest.approx(wanted / frames)


def test_synthetic_walks_against_their_own_truth(annotated, tmp_path, capsys):
    """A walk is labelled by construction; what annotation finds in a folder of them agrees with that."""
    truth = [c for c in walking_biped(rate=30, steps=2).truth if c.object in ("LeftFoot", "RightFoot")]
    labels = [Label(f"00_{i:03d}", c.object, c.begin, c.end, type=c.type) for i in range(3) for c in truth]
    rests = [x for x in labels if x.type == "space"]
    write_labels(tmp_path / "truth.json", rests)
    out, err = run(capsys, "evaluate", annotated, tmp_path / "truth.json", "--json", tmp_path / "all.json")
    document = json.loads((tmp_path / "all.json").read_text())
    assert "3 clips with labels" in out and err == ""
    assert {(s["object"], s["type"]) for s in document["scores"]} >= {("LeftFoot", "space"), ("RightFoot", "space"), ("all", "all")}
    for score in document["scores"]:
        assert score["precision"] > 0.95 and score["recall"] > 0.9 and score["labels_hit"] == score["labels"] > 2, score
    assert document["scores"][-1]["labels"] == len(rests)
    roles = [Label(x.clip, {"LeftFoot": "LEFT_FOOT", "RightFoot": "right_foot"}[x.object], x.begin, x.end, type="space") for x in rests]
    write_labels(tmp_path / "roles.csv", roles)
    again, _ = run(capsys, "evaluate", annotated, tmp_path / "roles.csv", "--json", "-")
    assert json.loads(again)["scores"][-1]["precision"] == document["scores"][-1]["precision"]
    write_labels(tmp_path / "wrong.json", [Label(x.clip, x.object, x.begin, x.end, type="line") for x in rests])
    out, _ = run(capsys, "evaluate", annotated, tmp_path / "wrong.json", "--missed", "2")
    assert f"{len(rests)} of {len(rests)} labels were not found" in out
    assert run(capsys, "evaluate", annotated, tmp_path / "truth.json", "-q") == ("", "")


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--core", "1"], "--core"),
        (["--core", "0.9:0.1"], ""),
        (["--iou", "2"], ""),
        (["--missed", "-1"], "--missed"),
        (["--object", "nobody"], "nobody"),
        (["--weigh", "tons"], "tons"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_evaluate_refuses(args, says, stores, tmp_path, capsys):
    store, clips = stores[0]
    write_labels(tmp_path / "l.json", [Label(next(iter(clips)), "LeftFoot", 0, 10)])
    assert says in fails(capsys, "evaluate", store.path, tmp_path / "l.json", *args)
    write_labels(tmp_path / "none.json", [Label("unheard.bvh", "LeftFoot", 0, 10)])
    assert "unheard.bvh" in fails(capsys, "evaluate", store.path, tmp_path / "none.json")


# docs/annotation.md

DOCS = Path(__file__).resolve().parents[1] / "docs" / "annotation.md"


def blocks(kind: str) -> list[str]:
    """The code blocks of a kind in the documentation."""
    return re.findall(rf"^```{kind}\n(.*?)^```", DOCS.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_the_documented_configuration_is_one(tmp_path):
    (example,) = blocks("toml")
    path = tmp_path / "job.toml"
    path.write_text(example)
    made = read_configuration(path)
    assert made.templates == (TemplateRule("mocap/02/02_01.bvh", "left_foot", 15, 65),)
    assert made.settings.types == ("space", "line") and made.clusters == (("left_foot", ("LHEE", "LTOE", "LANK")),)
    keys = set(re.findall(r"^\[*(\w+)", example, re.MULTILINE))
    assert {f.name for f in fields(Configuration)} - {"templates"} <= keys
    assert {f.name for f in fields(TemplateRule)} - {"scope"} <= keys
    assert replace(made, objects=("feet", "hands"), up=None, include=(), exclude=(), clusters=(), templates=()).settings == made.settings


def test_every_column_is_documented():
    text = DOCS.read_text(encoding="utf-8")
    for table, schema in TABLES.items():
        section = text.split(f"`{table}`: ", 1)[1].split("\n\n| column | |\n")[1].split("\n\n", 1)[0]
        documented = {name for row in section.splitlines()[1:] for name in re.findall(r"`(\w+)`", row.split("|")[1])}
        assert documented == set(schema.names), table


def test_documented_questions_are_answered(stores):
    questions = blocks("sql")
    assert len(questions) == 3
    answered = [sum(query(store, sql).num_rows for store, _ in stores) for sql in questions]
    assert answered[1] > 0
    clips = {"a": (100.0, [("LeftFoot", "space", 0, 90), ("RightFoot", "space", 20, 120), ("RightFoot", "space", 60, 100)])}
    store = store_of(stores[0][0].path.parent / "feet", clips)
    assert [(r["begin"], r["end"], r["seconds"]) for r in query(store, questions[2]).to_pylist()] == [(20, 90, 0.7)]


def test_documented_commands_are_understood():
    text = DOCS.read_text(encoding="utf-8")
    lines = [x.strip().split("   ")[0].split(" > ")[0] for x in text.splitlines() if x.startswith("    kinjax ")]
    assert len(lines) > 12
    for line in lines:
        parse(shlex.split(line)[1:])
