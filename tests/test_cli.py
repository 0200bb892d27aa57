"""The command line: what it writes, what it says when the input is wrong, and what it exits with."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kinjax.cli import main
from kinjax.errors import OptionError

COMMANDS = ("detect", "deform", "clean", "info", "plot", "report", "export", "annotate", "query", "evaluate", "store", "samples", "demo")


@pytest.fixture(autouse=True)
def no_cache(monkeypatch: pytest.MonkeyPatch):
    """No test touches the user's cache of compiled programs."""
    monkeypatch.setenv("KINJAX_CACHE", "off")


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with walk.bvh (a short walk, known truth), door.npz (poses of one object) and broken files."""
    from kinjax.formats import save, write_poses_npz
    from kinjax.synthetic import hinge, walking_biped

    folder = tmp_path_factory.mktemp("my clips")
    save(folder / "walk.bvh", walking_biped(rate=60, steps=2).motion)
    write_poses_npz(folder / "door.npz", hinge().poses)
    (folder / "binary.bvh").write_bytes(bytes(range(256)) * 40)
    (folder / "empty.bvh").write_bytes(b"")
    (folder / "notes.txt").write_text("no motion")
    (folder / "cut.bvh").write_text((folder / "walk.bvh").read_text()[:3000])
    head, frames = (folder / "walk.bvh").read_text().split("Frame Time:")
    (folder / "nan.bvh").write_text(head + "Frame Time:" + frames.replace(frames.split()[40], "nan", 1))
    (folder / "folder.bvh").mkdir()
    return folder


@pytest.fixture(scope="session")
def annotations(clips: Path) -> Path:
    """walk.json: what is found in walk.bvh."""
    path = clips / "found" / "walk.json"
    assert main(["detect", str(clips / "walk.bvh"), "-o", str(path), "--quiet"]) == 0
    return path


def fails(capsys: pytest.CaptureFixture[str], *args: object, code: int = 2) -> str:
    """Runs a command that must fail with one line; gives the line."""
    capsys.readouterr()
    assert main([str(a) for a in args]) == code
    told = capsys.readouterr()
    assert told.out == "" and "Traceback" not in told.err
    lines = told.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("kinjax: error: "), told.err
    return lines[0]


# ---- help and the parser


@pytest.mark.parametrize("args", [["--help"], *([c, "--help"] for c in COMMANDS)], ids=" ".join)
def test_help(args: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main(args)
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith("usage: kinjax") and "None" not in out
    assert len(args) > 1 or all(c in out for c in COMMANDS)


def test_version(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out.startswith("kinjax 0.")


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["detcet", "a.bvh"], "no command 'detcet'"),
        (["detect"], "no clip is given"),
        (["info"], "no clip is given"),
        (["report"], "no clip is given"),
        (["plot"], "nothing to draw"),
        (["export"], "no annotations"),
        (["detect", "a.bvh", "--min-duratoin", "1"], "perhaps --min-duration"),
        (["detect", "a.bvh", "--nonsense"], "--nonsense"),
        (["detect", "a.bvh", "--type", "plane"], "'plane'"),
        (["detect", "a.bvh", "--method", "magic"], "'magic'"),
        (["detect", "a.bvh", "--thresholds", "1"], "--thresholds"),
        (["detect", "a.bvh", "--rate", "fast"], "--rate"),
        (["detect", "a.bvh", "-o"], "-o"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_wrong_usage_is_one_line(args: list[str], says: str, capsys: pytest.CaptureFixture[str]):
    assert says in fails(capsys, *args)


def test_a_forgotten_command_is_suggested(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert f"kinjax detect {clips / 'walk.bvh'}" in fails(capsys, clips / "walk.bvh")


def test_clips_behind_an_option_are_noticed(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert "clips come before options" in fails(capsys, "detect", "--object", "LeftFoot", clips / "walk.bvh")


# ---- wrong input


@pytest.mark.parametrize("command", ["detect", "info", "plot", "report"])
@pytest.mark.parametrize("name", ["missing.bvh", "folder.bvh", "binary.bvh", "empty.bvh", "notes.txt", "cut.bvh", "nan.bvh"])
def test_a_file_that_is_no_clip_is_one_line_that_names_it(command: str, name: str, clips: Path, capsys: pytest.CaptureFixture[str]):
    assert name in fails(capsys, command, clips / name)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--object", "LeftFot"], "LeftFoot"),
        (["--object", "LeftFoot", "--relative-to", "Hipz"], "Hips"),
        (["--object", "LeftFoot", "--template", "0:100000"], "100000"),
        (["--object", "LeftFoot", "--template", "20:10"], "10"),
        (["--object", "LeftFoot", "--template", "3:4"], ""),
        (["--object", "LeftFoot", "--template", "10"], "BEGIN:END"),
        (["--object", "LeftFoot", "--template", "a:b"], "BEGIN:END"),
        (["--object", "LeftFoot", "--template", "=1:20"], "BEGIN:END"),
        (["--object", "LeftFoot", "--template", "-5:20"], ""),
        (["--object", "LeftFoot", "--template", "1:20:plane"], "space, line, point"),
        (["--object", "LeftFoot", "--template", "RightFoot=1:20"], "not among the objects"),
        (["--template", "1:20"], "--object"),
        (["--set", "stil=1,2"], "still"),
        (["--set", "still"], "NAME=VALUE"),
        (["--set", "still=abc"], "still"),
        (["--set", "still=1"], "still"),
        (["--set", "projection=magic"], "projection"),
        (["--thresholds", "0.1", "0.1"], "paper"),
        (["--stride", "0"], "stride"),
        (["--rate", "0"], "rate"),
        (["--unit", "furlong"], "furlong"),
        (["-o", "walk.xml"], ".parquet"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_a_wrong_option_is_one_line(args: list[str], says: str, clips: Path, capsys: pytest.CaptureFixture[str]):
    assert says in fails(capsys, "detect", clips / "walk.bvh", *args)
    assert not Path("walk.xml").exists()


def test_no_error_is_a_traceback_in_a_process_of_its_own(clips: Path):
    done = subprocess.run(
        [sys.executable, "-m", "kinjax", "detect", str(clips / "binary.bvh")],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"KINJAX_CACHE": "off"},
    )
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("kinjax: error: ")


# ---- detect


def test_detect_shows_a_table_and_says_what_it_looks_at(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["detect", str(clips / "walk.bvh")]) == 0
    out = capsys.readouterr().out
    assert "looking at LeftHand, RightHand, LeftFoot, RightFoot (feet and hands" in out
    assert "LeftFoot" in out and "space" in out and "\x1b" not in out


def test_names_match_in_any_case(clips: Path, tmp_path: Path, annotations: Path):
    names = ["--object", "lefthand", "RIGHTHAND", "--object", "leftFOOT", "RightFoot"]
    assert main(["detect", str(clips / "walk.bvh"), *names, "-q", "-o", str(tmp_path / "a.json")]) == 0
    assert (tmp_path / "a.json").read_text() == annotations.read_text()


def test_a_template_makes_the_noise_pattern(clips: Path, tmp_path: Path):
    args = ["--template", "LEFTFOOT=0:20", "RightFoot=0:30:space", "-q", "-o", str(tmp_path / "a.json")]
    assert main(["detect", str(clips / "walk.bvh"), *args]) == 0
    patterns = json.loads((tmp_path / "a.json").read_text())["patterns"]
    spans = {p["object"]: [(t["begin"], t["end"]) for t in p["templates"]] for p in patterns}
    assert spans == {"LeftFoot": [(0, 20)], "RightFoot": [(0, 30)]}


@pytest.mark.parametrize(
    ("args", "objects", "templates", "types"),
    [
        ([], ["door"], [], ("space",)),
        (["--template", "3:9"], ["door"], [("door", 3, 9, "space")], ("space",)),
        (["--template", "DOOR=3:9:line"], ["door"], [("door", 3, 9, "line")], ("line",)),
        (["--type", "line", "--template", "3:9", "20:30"], ["door"], [("door", 3, 9, "line"), ("door", 20, 30, "line")], ("line",)),
        (
            ["--type", "line", "point", "--object", "Door", "--template", "3:9:point"],
            ["door"],
            [("door", 3, 9, "point")],
            ("line", "point"),
        ),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) and all(isinstance(y, str) for y in x) else "",
)
def test_what_is_typed_becomes_what_is_asked(args, objects, templates, types, clips: Path):
    from kinjax.cli.parse import parse
    from kinjax.cli.request import load_clip, request

    options = parse(["detect", str(clips / "door.npz"), *args])
    asked = request(options, load_clip(options.clips[0], options), "door.npz")
    assert list(asked.objects) == objects and asked.settings.types == types
    assert [(t.object, t.begin, t.end, t.type) for t in asked.templates] == templates


def test_every_option_reaches_the_settings():
    from kinjax.cli.parse import parse
    from kinjax.cli.request import make_settings
    from kinjax.detect import Settings

    args = "--method paper --thresholds 0.1 0.02 --estimator naive --rate 25 --stride 2 --min-duration 0.2 --free-pivots"
    more = "--set still=0.2,2 --set interpolation=monotone --set max-gap=0.3"
    assert make_settings(parse(["detect", "x.bvh", *args.split(), *more.split()])) == Settings(
        method="paper", thresholds=(0.1, 0.02), estimator="naive", rate=25.0, stride=2, min_duration=0.2, free_pivots=True,
        still=(0.2, 2.0), interpolation="monotone", max_gap=0.3,
    )  # fmt: skip
    assert make_settings(parse(["detect", "x.bvh"])) == Settings()


@pytest.mark.parametrize("suffix", [".json", ".csv", ".parquet", ".npz"])
def test_the_suffix_chooses_the_format(suffix: str, clips: Path, tmp_path: Path, annotations: Path):
    path = tmp_path / "new folder" / f"walk{suffix}"
    assert main(["detect", str(clips / "walk.bvh"), "-q", "-o", str(path)]) == 0
    if suffix == ".npz":
        with np.load(path) as arrays:
            assert len(arrays.files) > 0
        return
    from kinjax.formats import read_annotations

    there, here = read_annotations(annotations).constraints, read_annotations(path).constraints
    assert [(c.object, c.type, c.begin, c.end) for c in here] == [(c.object, c.type, c.begin, c.end) for c in there]


def test_json_on_stdout_is_json_and_nothing_else(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["detect", str(clips / "walk.bvh"), "-o", "-"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["constraints"] and "looking at" in told.err


def test_quiet_prints_nothing(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["detect", str(clips / "walk.bvh"), "-q", "-o", str(tmp_path / "a.json")]) == 0
    assert capsys.readouterr().out == ""


def test_poses_without_a_skeleton(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["detect", str(clips / "door.npz")]) == 0
    out = capsys.readouterr().out
    assert "looking at door (every object" in out and "space" in out
    assert "--unit" in fails(capsys, "detect", clips / "door.npz", "--unit", "cm")


def test_settings_by_name_change_the_result(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["detect", str(clips / "walk.bvh"), "--set", "min_duration=3"]) == 0
    assert "no constraints in 199 frames" in capsys.readouterr().out


def test_several_clips_go_into_a_directory(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    args = ["-o", str(tmp_path / "out"), "--format", "csv"]
    assert main(["detect", str(clips / "walk.bvh"), str(clips / "door.npz"), *args]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["door.csv", "walk.csv"]
    assert "walk.bvh" in capsys.readouterr().out


def test_some_clips_fail_and_the_others_are_done(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    names = ("binary.bvh", "walk.bvh", "missing.bvh")
    assert main(["detect", *(str(clips / n) for n in names), "-o", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert [p.name for p in tmp_path.iterdir()] == ["walk.json"]
    assert "binary.bvh" in told.err and "missing.bvh" in told.err and "2 of 3 clips failed" in told.err
    assert "Traceback" not in told.err and told.err.count("kinjax: error:") == 3


def test_a_fault_of_our_own_in_one_clip_does_not_stop_the_others(
    clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    from kinjax.cli import detecting

    load = detecting.load_clip
    monkeypatch.setattr(detecting, "load_clip", lambda path, o: load(path, o) if path.stem == "walk" else 1 / 0)
    assert main(["detect", str(clips / "door.npz"), str(clips / "walk.bvh"), "-o", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert "door.npz: a fault of kinjax itself, ZeroDivisionError" in told and (tmp_path / "walk.json").exists()


def test_all_clips_failing_is_bad_input(clips: Path, tmp_path: Path):
    assert main(["detect", str(clips / "binary.bvh"), str(clips / "missing.bvh"), "-o", str(tmp_path)]) == 2


@pytest.mark.parametrize("output", ["-", "one.json"])
def test_several_clips_do_not_go_into_one_file(output: str, clips: Path, capsys: pytest.CaptureFixture[str]):
    fails(capsys, "detect", clips / "walk.bvh", clips / "door.npz", "-o", output)


def test_clips_of_one_name_keep_apart(tmp_path: Path):
    from kinjax.cli.detecting import _places

    clips = [tmp_path / "a" / "walk.bvh", tmp_path / "b" / "walk.bvh"]
    assert _places(clips, tmp_path / "out", ".json") == [tmp_path / "out" / d / "walk.bvh.json" for d in "ab"]
    with pytest.raises(OptionError, match="twice"):
        _places([clips[0], clips[0]], tmp_path / "out", ".json")


# ---- the other commands


def test_info_shows_the_joints_as_a_tree(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["info", str(clips / "walk.bvh")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("60 frames a second" in line for line in lines)
    hips, foot = (next(line for line in lines if line.rstrip(" *").endswith(n)) for n in ("Hips", "LeftFoot"))
    assert foot.index("LeftFoot") > hips.index("Hips") and foot.endswith("*")


def test_info_of_poses_lists_the_objects(clips: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["info", str(clips / "door.npz")]) == 0
    assert "door" in capsys.readouterr().out


def test_report_is_one_html_file(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "walk.html"
    assert main(["report", str(clips / "walk.bvh"), "-o", str(path)]) == 0
    assert "LeftFoot" in path.read_text(encoding="utf-8") and str(path) in capsys.readouterr().out


@pytest.mark.parametrize("name", ["door.npz", "found/walk.json", "found/walk.npz"])
def test_plot_draws_clips_and_annotations(name: str, clips: Path, annotations: Path, tmp_path: Path):
    from kinjax.formats import read_annotations, write_annotations

    write_annotations(annotations.with_suffix(".npz"), read_annotations(annotations))
    assert main(["plot", str(clips / name), "-q", "-o", str(tmp_path)]) == 0
    pictures = list(tmp_path.iterdir())
    assert pictures and all(p.read_bytes().startswith(b"\x89PNG") for p in pictures)
    assert len(pictures) == (4 if name == "door.npz" else 1)


@pytest.mark.parametrize("to", ["vtt", "blender", "events"])
def test_export(to: str, annotations: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["export", str(annotations), "--to", to, "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert main(["export", str(annotations), "--to", to, "-o", "-"]) == 0
    assert capsys.readouterr().out.strip() == (tmp_path / "out").read_text(encoding="utf-8").strip() != ""


def test_exported_events_do_not_write_over_annotations(annotations: Path):
    from kinjax.formats import read_annotations, write_annotations

    table = write_annotations(annotations.with_suffix(".csv"), read_annotations(annotations))
    before = table.read_bytes()
    for source in (annotations, table):
        assert main(["export", str(source), "--to", "events"]) == 0
    assert table.read_bytes() == before
    assert "space begin" in table.with_name(f"{table.stem}-events.csv").read_text(encoding="utf-8")


def test_export_needs_to_know_what_for(annotations: Path, capsys: pytest.CaptureFixture[str]):
    assert "--to" in fails(capsys, "export", annotations)


def test_samples_can_be_read_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["samples", "-o", str(tmp_path)]) == 0
    assert {p.name for p in tmp_path.iterdir()} >= {"walk.bvh", "walk-truth.json", "dice.npz", "dice-truth.json"}
    for name in ("walk.bvh", "dice.npz"):
        assert main(["info", str(tmp_path / name)]) == 0
    from kinjax.formats import read_annotations

    assert len(read_annotations(tmp_path / "dice-truth.json").constraints)


@pytest.mark.parametrize("clips", [pytest.param("few", id="two clips"), pytest.param("all", marks=pytest.mark.slow)])
def test_the_demo_is_what_happens_without_a_command(
    clips: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    if clips == "few":
        from kinjax.synthetic import hinge, walking_biped

        monkeypatch.setattr("kinjax.cli.demo.sample_clips", lambda: {s.name: s for s in (hinge(), walking_biped(rate=60, steps=2))})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("KINJAX_PROG", "./my run")
    assert main([]) == 0
    out = capsys.readouterr().out
    assert "constraints found" in out and "Try next:" in out and "'./my run' detect" in out
    assert "not found" not in out  # every constraint that is true is found
    written = {p.name for p in (tmp_path / "kinjax-out").iterdir()}
    assert written >= {"walk.bvh", "walk.json", "walk.html", "walk-truth.json", "walk-reach.toml", "hinge.npz", "hinge.html"}
    advice = [shlex.split(line)[1:] for line in out.split("Try next:")[1].splitlines() if "walk.bvh" in line]
    assert [a[0] for a in advice] == ["info", "detect", "clean", "deform"]
    for command in advice:
        assert all((tmp_path / a).exists() for a in command if a.startswith("kinjax-out"))
    if clips == "all":  # compiles much
        assert all(main(command) == 0 for command in advice)
        assert {"left-foot.csv", "walk-clean.bvh", "walk-reach.bvh"} <= {p.name for p in tmp_path.iterdir()}


# ---- how it prints


def test_a_reader_that_goes_away_is_no_error(clips: Path):
    script = f'"{sys.executable}" -m kinjax info "{clips / "walk.bvh"}" | head -n 1; echo "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stderr == "" and done.stdout.splitlines()[-1] == "0"


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("10:20", (None, 10, 20, None)),
        ("LeftFoot=10:20", ("LeftFoot", 10, 20, None)),
        ("mixamorig:LeftFoot=10:20:Line", ("mixamorig:LeftFoot", 10, 20, "line")),
        ("a=b=1:2:point", ("a=b", 1, 2, "point")),
    ],
)
def test_templates_are_parsed(text: str, parsed: tuple[object, ...]):
    from kinjax.cli.request import parse_template

    assert parse_template(text) == parsed


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("Hips", "LeftFoot", "LeftToeBase", "LeftHand", "LeftHandIndex1"), ("LeftFoot", "LeftHand")),
        (("root", "lfoot", "ltoes", "rhand", "rfingers"), ("lfoot", "rhand")),
        (("hip", "lShin", "lToe", "Foot_L_end"), ("Foot_L_end",)),
        (("hip", "lToe"), ("lToe",)),
        (("die_a", "die_b"), ()),
    ],
)
def test_feet_and_hands_are_found_by_name(names: tuple[str, ...], found: tuple[str, ...]):
    from kinjax.cli.request import _feet_and_hands

    assert _feet_and_hands(names) == found


def test_the_cache_of_compiled_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import jax

    from kinjax.cli.cache import use_cache

    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {n: getattr(jax.config, n) for n in names}
    try:
        assert use_cache() is None
        monkeypatch.setenv("KINJAX_CACHE", str(tmp_path / "kept"))
        assert use_cache() == tmp_path / "kept" == Path(jax.config.jax_compilation_cache_dir)
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("KINJAX_CACHE", str(tmp_path / "file" / "below"))
        assert use_cache() is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
