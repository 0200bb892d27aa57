"""Annotation of folders in this process: what gets into the store, what is skipped, refused, replaced and removed."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import database_cases as cases
import numpy as np
import pyarrow as pa
import pytest
from database_cases import FEET, bytes_of, folder_of_clips

from kinjax.database import Configuration, Store, TemplateRule, annotate, read_configuration
from kinjax.database.catalogue import find_clips, in_parts
from kinjax.database.upkeep import check, compact
from kinjax.detect import detect
from kinjax.errors import FileFormatError, KinjaxError, OptionError
from kinjax.formats import load, read_bvh, save, write_poses_npz
from kinjax.synthetic import hinge, noisy_motion, walking_biped


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Twelve walks and four broken files."""
    return folder_of_clips(tmp_path_factory.mktemp("many") / "clips", 12, tuple(cases.BROKEN))


@pytest.fixture(scope="module")
def annotated(clips, tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("store") / "s"
    annotate([clips], store, FEET, part_clips=4)
    return store


@pytest.fixture
def own(clips, annotated, tmp_path) -> tuple[Path, Path]:
    """The clips and their store, to be changed."""
    shutil.copytree(clips, tmp_path / "clips", copy_function=shutil.copy2)
    store = tmp_path / "s"
    annotate([tmp_path / "clips"], store, FEET, part_clips=4)
    return tmp_path / "clips", store


def test_every_file_is_counted_once(clips, tmp_path):
    told = []
    report = annotate([clips], tmp_path / "s", FEET, part_clips=4, progress=told.append)
    assert (report.found, report.ok, report.refused, report.skipped) == (16, 12, 4, 0)
    assert report.exit_code == 3 and report.reasons == {"FileFormatError": 4}
    assert told[-1].done == told[-1].total == 16 and told[-1].refused == 4
    store = Store(tmp_path / "s")
    assert store.table("clips").num_rows == 12 and store.table("errors").num_rows == 4
    assert check(store) == []
    errors = {Path(r["clip"]).name: r for r in store.table("errors").to_pylist()}
    assert set(errors) == set(cases.BROKEN) and errors["nan.bvh"]["line"] > 0 and errors["nan.bvh"]["column"] > 0
    assert all(str(clips) in r["message"] for r in errors.values())
    assert not list((tmp_path / "s" / "aside").iterdir())


def test_a_clip_has_what_detect_finds_in_it(clips, annotated):
    store = Store(annotated)
    path = clips / "s00" / "00_003.bvh"
    found = detect(load(path), ["LeftFoot", "RightFoot"])
    rows = [r for r in store.table("constraints").to_pylist() if r["path" if "path" in r else "clip"].endswith("00_003.bvh")]
    assert len(rows) == len(found.constraints) > 2
    for row, c in zip(rows, found.constraints, strict=True):
        assert (row["object"], row["type"], row["begin"], row["end"]) == (c.object, c.type, c.begin, c.end)
        assert (row["begin_s"], row["end_s"]) == (c.begin_s, c.end_s) and row["role"] in ("left_foot", "right_foot")
        np.testing.assert_allclose([row["x"], row["y"], row["z"]], c.position, atol=1e-6)
    clip = next(r for r in store.table("clips").to_pylist() if r["clip"] == "clips/s00/00_003.bvh")
    assert clip["frames"] == found.frames and clip["subject"] == "00" and clip["objects"] == ["LeftFoot", "RightFoot"]
    assert clip["constraints"] == len(rows) and clip["bytes"] == path.stat().st_size and clip["root"] == str(clips)
    patterns = [r for r in store.table("patterns").to_pylist() if r["clip"] == clip["clip"]]
    assert [p["status"] for p in patterns] == ["automatic"] * 2 and all(p["noise_m"] < 1e-3 for p in patterns)
    assert {r["pattern"] for r in rows} <= {p["pattern"] for p in patterns}


def test_a_second_run_writes_nothing(clips, annotated):
    before = {p: p.stat().st_mtime_ns for p in annotated.rglob("*") if p.name != "lock" and p.is_file()}
    report = annotate([clips], annotated, FEET, part_clips=4)
    assert (report.ok, report.refused, report.skipped, report.skipped_refused, report.parts) == (0, 0, 16, 4, 0)
    assert report.exit_code == 3
    assert {p: p.stat().st_mtime_ns for p in annotated.rglob("*") if p.name != "lock" and p.is_file()} == before


def test_parts_do_not_depend_on_the_order_or_on_what_is_done(clips, annotated, tmp_path):
    store = tmp_path / "s"
    for folder in ("s00", "s01"):  # a root of its own, so nothing is shared with the whole
        annotate([clips / folder], store, FEET, part_clips=4)
    assert Store(store).table("clips").num_rows == 12
    again = tmp_path / "again"
    shutil.copytree(annotated, again)
    for part in Store(again).parts()[::2]:
        Store(again).remove([part])
    annotate([clips], again, FEET, part_clips=4)
    assert bytes_of(again) == bytes_of(annotated)


def test_a_new_file_redoes_its_part_only(own):
    clips, path = own
    before = set(Store(path).parts())
    shutil.copy2(clips / "s00" / "00_000.bvh", clips / "s00" / "00_999.bvh")
    report = annotate([clips], path, FEET, part_clips=4)
    store = Store(path)
    assert report.found == 17 and report.ok + report.refused + report.skipped == 17 and report.ok <= 16
    assert len(before - set(store.parts())) <= 1 and store.table("clips").num_rows == 13 and check(store) == []
    fresh = path.parent / "fresh"
    annotate([clips], fresh, FEET, part_clips=4)
    assert bytes_of(fresh) == bytes_of(path)


def test_changed_and_vanished_files(own):
    clips, path = own
    m = read_bvh(clips / "s01" / "01_010.bvh")
    save(clips / "s01" / "01_010.bvh", m.slice(0, 40))
    (clips / "s00" / "00_001.bvh").unlink()
    (clips / "cut.bvh").unlink()
    report = annotate([clips], path, FEET, part_clips=4)
    store = Store(path)
    assert report.removed + report.parts >= 2 and check(store) == []
    names = store.table("clips")["clip"].to_pylist()
    assert "clips/s00/00_001.bvh" not in names and len(names) == len(set(names)) == 11
    assert store.table("errors").num_rows == 3
    frames = dict(zip(names, store.table("clips")["frames"].to_pylist(), strict=True))
    assert frames["clips/s01/01_010.bvh"] == 41
    assert annotate([clips], path, FEET, part_clips=4).parts == 0
    fresh = path.parent / "fresh"
    annotate([clips], fresh, FEET, part_clips=4)
    assert {t: Store(fresh).table(t).sort_by("clip") for t in ("clips", "errors")} == {
        t: store.table(t).sort_by("clip") for t in ("clips", "errors")
    }


def test_another_configuration_or_other_code_redoes_all(own, monkeypatch):
    clips, path = own
    hard = replace(FEET, settings=FEET.settings.but(still=(0.1, 1.0)))
    assert annotate([clips], path, hard, part_clips=4).ok == 12
    assert check(Store(path)) == [] and Store(path).table("clips").num_rows == 12
    assert annotate([clips], path, hard, part_clips=64).parts == 0  # how parts are cut is no reason to redo them
    monkeypatch.setattr("kinjax.database.configuration.code_version", lambda: "2.0")
    assert annotate([clips], path, hard, part_clips=4).ok == 12
    assert Store(path).table("clips").num_rows == 12


def test_the_papers_method_needs_templates(clips, tmp_path):
    with pytest.raises(OptionError, match="templates"):
        annotate([clips], tmp_path / "s", replace(FEET, settings=cases.Settings(method="paper")))


def test_a_moved_database_is_annotated_where_it_is_now(own, tmp_path):
    clips, path = own
    (tmp_path / "deep").mkdir()
    moved = clips.rename(tmp_path / "deep" / "clips")
    annotate([moved], path, FEET, part_clips=4)
    rows = Store(path).table("clips").to_pylist()
    assert len(rows) == 12 and all(Path(r["path"]).is_file() and r["root"] == str(moved) for r in rows)


def test_refused_files_are_tried_again_when_asked(own):
    clips, path = own
    assert annotate([clips], path, FEET, part_clips=4, retry=True).refused == 4
    assert check(Store(path)) == []


def test_a_part_that_is_damaged_is_made_anew(own):
    clips, path = own
    whole = bytes_of(path)
    store = Store(path)
    file = store.file("constraints", store.parts()[0])
    file.write_bytes(file.read_bytes()[:50])
    assert check(store)
    annotate([clips], path, FEET, part_clips=4)
    assert bytes_of(path) == whole
    store.file("patterns", store.parts()[1]).unlink()
    assert check(store)
    annotate([clips], path, FEET, part_clips=4)
    assert bytes_of(path) == whole


def test_compaction_keeps_rows_and_what_is_skipped(own):
    clips, path = own
    store = Store(path)
    tables = {t: store.table(t).sort_by("clip") for t in ("clips", "constraints", "patterns", "errors")}
    before, after = compact(store)
    assert before > after == 1 and check(store) == []
    for t, old in tables.items():
        assert store.table(t).sort_by("clip") == old
    assert annotate([clips], path, FEET, part_clips=4).parts == 0
    os.utime(clips / "s00" / "00_000.bvh", (1, 1))  # one of many clips in a large part
    assert annotate([clips], path, FEET, part_clips=4).ok < 12
    assert check(store) == [] and store.table("clips").num_rows == 12


def test_a_compaction_that_was_interrupted_is_brought_to_its_end(own, monkeypatch):
    clips, path = own
    store = Store(path)
    rows = store.table("constraints").sort_by("clip")

    def dies(*_, **__):
        raise KeyboardInterrupt

    for at in range(1, 12):
        left = [at]
        real = os.replace

        def counted(*args, real=real, left=left):
            left[0] -= 1
            if left[0] == 0:
                dies()
            return real(*args)

        monkeypatch.setattr(os, "replace", counted)
        try:
            compact(store)
        except KeyboardInterrupt:
            monkeypatch.undo()
            annotate([clips], path, FEET, part_clips=4)
            assert check(store) == [] and store.table("constraints").sort_by("clip") == rows, at
            for part in store.parts():
                store.remove([part])
            annotate([clips], path, FEET, part_clips=4)
        monkeypatch.undo()


def test_two_jobs_on_one_store(clips, annotated):
    with Store(annotated).locked(), pytest.raises(OptionError, match="another job"):
        annotate([clips], annotated, FEET)


def test_what_is_no_store_is_left_alone(clips, tmp_path):
    (tmp_path / "thesis.txt").write_text("x")
    with pytest.raises(OptionError, match="no store"):
        annotate([clips], tmp_path, FEET)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(OptionError, match="no store"):
        Store(tmp_path / "none")
    with pytest.raises(OptionError, match="no motion files"):
        annotate([tmp_path], tmp_path / "s", FEET)
    with pytest.raises(OptionError, match="no such folder"):
        annotate([tmp_path / "nowhere"], tmp_path / "s", FEET)
    store = tmp_path / "old"
    store.mkdir()
    (store / "manifest.json").write_text('{"schema": "kinjax-store/9"}')
    with pytest.raises(FileFormatError, match="version"):
        Store(store)


def test_a_full_disk_ends_the_job_and_leaves_what_is_there(clips, tmp_path, monkeypatch):
    import errno

    from kinjax.database import store as room

    real, left = room.pq.write_table, [9]

    def full(*args, **kwargs):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device", "/aside")
        return real(*args, **kwargs)

    monkeypatch.setattr(room.pq, "write_table", full)
    with pytest.raises(OSError, match="No space"):
        annotate([clips], tmp_path / "s", FEET, part_clips=2)
    store = Store(tmp_path / "s")
    assert len(store.parts()) == 2 and store.table("clips").num_rows + store.table("errors").num_rows > 0
    monkeypatch.undo()
    annotate([clips], tmp_path / "s", FEET, part_clips=2)
    assert check(store) == [] and store.table("clips").num_rows == 12


def test_nasty_names_stay_in_the_store(tmp_path):
    clips = folder_of_clips(tmp_path / "clips", 1)
    source = clips / "s00" / "00_000.bvh"
    names = ["a;rm -rf.bvh", "=cmd().bvh", "CON.bvh", "n" * 200 + ".bvh", "<script>.bvh", "a..bvh", "A.BVH", "a.bvh", "line\nend.bvh"]
    names.append(os.fsdecode(b"lat\xe9.bvh"))
    for name in names:
        shutil.copy2(source, clips / name)
    (clips / "up.bvh").symlink_to(source)
    (clips / "loop").symlink_to(clips)
    (clips / "loop.bvh").symlink_to(clips / "loop.bvh")
    os.mkfifo(clips / "pipe.bvh")
    (clips / "folder.bvh").mkdir()
    (clips / ".hidden.bvh").write_text("")
    store = tmp_path / "out" / "s"
    store.parent.mkdir()
    report = annotate([clips], store, FEET)
    assert report.ok == len(names) + 2 and report.refused == 2  # the pipe and the link to itself
    assert {p.name for p in store.parent.iterdir()} == {"s"} and {p.name for p in tmp_path.iterdir()} == {"clips", "out"}
    assert all(p.name.startswith("part-") for t in ("clips", "errors") for p in (store / t).iterdir())
    assert check(Store(store)) == [] and annotate([clips], store, FEET).parts == 0


def test_two_folders_of_one_name_cannot_be_told_apart(tmp_path):
    for side in "ab":
        folder_of_clips(tmp_path / side / "walks", 1)
    with pytest.raises(OptionError, match="one name"):
        find_clips([tmp_path / "a" / "walks", tmp_path / "b" / "walks"])
    assert len(find_clips([tmp_path / "a" / "walks", tmp_path / "a" / "walks"])) == 1
    assert [e.clip for e in find_clips([tmp_path / "a" / "walks" / "s00" / "00_000.bvh"])] == ["s00/00_000.bvh"]
    assert find_clips([tmp_path], exclude=["a/*"])[0].clip.endswith("b/walks/s00/00_000.bvh")
    assert len(find_clips([tmp_path], include=["b/*"])) == 1


def test_parts_are_cut_by_their_own_names_only(tmp_path):
    clips = folder_of_clips(tmp_path / "clips", 1)
    source = clips / "s00" / "00_000.bvh"
    for i in range(300):
        os.link(source, clips / f"x_{i:03d}.bvh")
    parts = in_parts(find_clips([clips]), "key", 8)
    assert sum(len(p.entries) for p in parts) == 301 and 20 < len(parts) < 80
    (clips / "x_150.bvh").unlink()
    fewer = in_parts(find_clips([clips]), "key", 8)
    assert len({p.key for p in parts} - {p.key for p in fewer}) <= 2


def test_poses_and_props(tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    write_poses_npz(clips / "door.npz", hinge().poses)
    (clips / "other.npz").write_bytes(b"PK")
    report = annotate([clips], tmp_path / "s", Configuration(settings=cases.Settings(types=("line",), free_pivots=True)))
    assert report.ok == 1 and report.refused == 1
    assert Store(tmp_path / "s").table("constraints")["type"].to_pylist() in (["line"], ["line"] * 2)


def test_pickles_are_never_loaded(tmp_path):
    import pickle

    class Harm:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "harmed"),))

    clips = tmp_path / "clips"
    clips.mkdir()
    np.savez(clips / "bad.npz", meta=np.array([Harm()], dtype=object), allow_pickle=True)
    (clips / "bad.pkl").write_bytes(pickle.dumps(Harm()))
    report = annotate([clips], tmp_path / "s", FEET)
    assert (report.found, report.refused) == (1, 1) and not (tmp_path / "harmed").exists()


# templates


def test_a_template_is_carried_to_its_skeleton_or_subject(tmp_path):
    scene = walking_biped(rate=120, steps=2)
    clips = tmp_path / "clips"
    clips.mkdir()
    for i, name in enumerate(("01_01", "01_02", "02_01")):
        save(clips / f"{name}.bvh", noisy_motion(scene.motion, 0.001, i))
    save(clips / "02_02.bvh", noisy_motion(scene.motion, 0.004, 9))
    rest = next(c for c in scene.truth if c.object == "LeftFoot" and c.type == "space")
    rule = TemplateRule("clips/01_01.bvh", "left_foot", rest.begin + 5, rest.end - 5)
    for scope, expected in (("skeleton", 4), ("subject", 2), ("all", 4)):
        store = tmp_path / scope
        annotate([clips], store, replace(FEET, templates=(replace(rule, scope=scope),)))
        rows = Store(store).table("patterns").to_pylist()
        taught = [r for r in rows if r["template"] is not None]
        assert len(taught) == expected and {r["object"] for r in taught} == {"LeftFoot"}
        assert sum(r["object"] == "RightFoot" and r["status"] == "automatic" for r in rows) == 4
        by = {(r["clip"], r["pattern"]): r["object"] for r in rows}
        assert all(by[r["clip"], r["pattern"]] == r["object"] for r in Store(store).table("constraints").to_pylist())
        assert all(r["template"].startswith("01_01.bvh LeftFoot") and r["status"] != "automatic" for r in taught)
        warned = [c["clip"] for c in Store(store).table("clips").to_pylist() if any("noise here" in w for w in c["warnings"])]
        assert warned == (["clips/02_02.bvh"] if scope != "subject" else [])


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        (TemplateRule("nowhere.bvh", "LeftFoot", 0, 10), "no clip"),
        (TemplateRule("clips/s00/00_000.bvh", "LeftFoot", 0, 4000), "outside the clip"),
        (TemplateRule("clips/s00/00_000.bvh", "LeftWing", 0, 10), "LeftWing"),
        (TemplateRule("clips/cut.bvh", "LeftFoot", 0, 10), "cut.bvh"),
    ],
)
def test_a_template_that_cannot_be_used_ends_the_job(rule, says, clips, tmp_path):
    with pytest.raises(KinjaxError, match=says):
        annotate([clips], tmp_path / "s", replace(FEET, templates=(rule,)))
    assert not (tmp_path / "s").exists()


# configuration files


def test_a_configuration_file(tmp_path):
    path = tmp_path / "job.toml"
    path.write_text(
        """
objects = ["feet", "*Toe*"]
subject = '^(s\\d+)'
unit = "cm"
[settings]
types = ["space", "line"]
still = [0.2, 2.0]
[clusters]
left_foot = ["LHEE", "LTOE", "LANK"]
[[template]]
clip = "01_01.bvh"
object = "left_foot"
begin = 10
end = 40
for = "subject"
"""
    )
    made = read_configuration(path)
    assert made.objects == ("feet", "*Toe*") and made.settings.still == (0.2, 2.0) and made.unit == "cm"
    assert made.templates == (TemplateRule("01_01.bvh", "left_foot", 10, 40, "space", "subject"),)
    assert made.clusters == (("left_foot", ("LHEE", "LTOE", "LANK")),) and made.subject_of("s12_3", "x") == "s12"
    assert made.subject_of("take", "folder") == "folder"


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ('objects = ["feet"]\nobject = 3', 2, "no key 'object'"),
        ("objects = 3", 1, "objects"),
        ("[settings]\nstil = [1, 2]", 1, "stil"),
        ("[[template]]\nclip = 'a'", 1, "needs object"),
        ("[[template]]\nclip = 'a'\nobject='b'\nbegin=0\nend=5\ncolour=1", 1, "colour"),
        ("a = ", None, "Invalid"),
        ("a = 1 2", 1, "Expected"),
        ("subject = '('", None, "regular expression"),
        ("subject = 'a'", None, "group"),
        ("objects = []", None, "objects"),
    ],
)
def test_a_configuration_that_is_wrong_is_refused_with_its_line(text, line, says, tmp_path):
    path = tmp_path / "job.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=says) as caught:
        read_configuration(path)
    assert caught.value.line == line


def test_each_shape_compiles_once(tmp_path):
    from kinjax.detect.engine import run_clips
    from kinjax.lengths import octave

    clips = tmp_path / "clips"
    clips.mkdir()
    lengths = [30, 44, 48, 55, 60, 61, 70, 75, 80, 85, 90, 96, 97, 102]
    for n in lengths:
        save(clips / f"a_{n}.bvh", cases.walk().slice(0, min(n, cases.walk().frames) - 1))
    run_clips.clear_cache()
    annotate([clips], tmp_path / "s", FEET)
    frames = Store(tmp_path / "s").table("clips")["frames"].to_pylist()
    assert len(frames) == len(lengths)
    assert run_clips._cache_size() <= len({octave(n + 32) for n in frames}) <= 3


def test_the_tables_open_elsewhere_as_they_are(annotated):
    duckdb, pd, pl = (pytest.importorskip(m) for m in ("duckdb", "pandas", "polars"))
    for table in ("clips", "constraints", "patterns", "errors"):
        mine = Store(annotated).table(table)
        assert len(pd.read_parquet(annotated / table)) == mine.num_rows
        assert pl.read_parquet(annotated / table / "*.parquet").height == mine.num_rows
        (n,) = duckdb.sql(f"SELECT count(*) FROM '{annotated}/{table}/*.parquet'").fetchall()[0]
        assert n == mine.num_rows
    assert isinstance(Store(annotated).table("clips", ["clip"]), pa.Table)
