"""Annotations on disk: every format gives the record back, other programs get what they expect, names cannot break out."""

import csv
import importlib.resources
import io
import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from kinjax.annotations import Annotations, Constraint, Constraints, NoisePattern, Template
from kinjax.errors import FileFormatError, OptionError
from kinjax.formats import export, read_annotations, write_annotations
from kinjax.formats.annotations_frames import frame_codes
from kinjax.formats.annotations_json import SCHEMA_FILE

FPS = 1 / 0.0083333
NASTY = [
    "=cmd()|' /C calc'!A0", "+1", "-1", "@SUM(A1)", "\tx", "\rx", "'quoted", "a,b", 'a"b', "a\nb", "<script>alert(1)</script>",
    "&amp;", "a --> b", "\x1b[31mred", '"""; import os; """', "\\", "{x}", "左足", "a\x00b", "x\u2028y", "\ud800",
]  # fmt: skip


def made(names=("LeftFoot", "RightHand"), **kw) -> Annotations:
    constraints = [
        Constraint(names[0], "space", 0, 30, (0.1, 0.2, 1 / 3), None, 0.0012, 0, FPS),
        Constraint(names[-1], "line", 10, 99, (-1.0, 2e-17, 3.0), (0.0, 0.6, 0.8), 1e-4, 1, FPS),
        Constraint(names[0], "point", 25, 40, (math.nan, 0.0, 5.0), None, math.nan, 0, FPS),
    ]
    patterns = (
        NoisePattern(names[0], "space", (0.01, math.inf), (0.02, 0.03), (5, 50), 0.1, 0.2, 9, 8, "few_intervals+given",
                     (Template(names[0], 1, 9), Template("b", 2, 4, "line")), "per_second"),
        NoisePattern(names[-1], "line", (0.5,), (0.25,)),
    )  # fmt: skip
    fields = {"method": "robust", "patterns": patterns, "warnings": ("one", "two\nlines")} | kw
    return Annotations("walk.bvh", FPS, 100, Constraints(tuple(constraints)), **fields)


def assert_same(a: Annotations, b: Annotations) -> None:
    assert repr(a) == repr(b)  # shortest exact numbers; NaN equals NaN


@pytest.mark.parametrize("suffix", [".json", ".parquet", ".npz", ".csv", ".JSON"])
def test_the_record_comes_back(tmp_path, suffix):
    for a in (made(), made(patterns=(), warnings=()), Annotations("empty.bvh", 30.0, 7, Constraints())):
        path = write_annotations(tmp_path / f"a{suffix}", a)
        first, back = path.read_bytes(), read_annotations(path)
        expected = Annotations(a.clip, a.fps, a.frames, a.constraints, method=a.method) if suffix == ".csv" else a
        assert_same(back, expected)
        assert write_annotations(path, a).read_bytes() == first  # no clock, no chance
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", [".json", ".parquet", ".npz", ".csv"])
def test_nasty_names_come_back(tmp_path, suffix):
    for name in NASTY:
        back = read_annotations(write_annotations(tmp_path / f"a{suffix}", made((name, "b"), patterns=())))
        assert back.constraints[0].object == ("\\ud800" if name == "\ud800" else name)


def test_numpy_numbers_and_a_rate_per_constraint(tmp_path):
    c = Constraint("a", "space", np.int32(1), np.int64(2), tuple(np.float64([1, 2, 3])), None, np.float32(0.5), np.int32(0), 0.0)
    for suffix in (".json", ".csv", ".parquet", ".npz"):
        back = read_annotations(write_annotations(tmp_path / f"a{suffix}", Annotations("c", 50.0, 5, Constraints((c,)))))
        assert back.constraints[0] == Constraint("a", "space", 1, 2, (1.0, 2.0, 3.0), None, 0.5, 0, 50.0)
        assert back.constraints[0].end_s == 0.04


def test_json_follows_its_schema(tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    shipped = importlib.resources.files("kinjax.formats").joinpath("annotations.schema.json")
    schema = json.loads(shipped.read_text("utf-8"))
    assert SCHEMA_FILE.read_text("utf-8") == shipped.read_text("utf-8")
    jsonschema.Draft202012Validator.check_schema(schema)
    check = jsonschema.Draft202012Validator(schema)
    for a in (made(), Annotations("empty", 0.0, 3, Constraints())):
        document = json.loads(write_annotations(tmp_path / "a.json", a).read_bytes())
        check.validate(document)
    document = json.loads(write_annotations(tmp_path / "a.json", made()).read_bytes())
    first = document["constraints"][0]
    assert first["begin_s"] == 0 and first["end_s"] == 30 / FPS and first["position"] == [0.1, 0.2, 1 / 3] and first["axis"] is None
    assert document["constraints"][2]["residual"] is None and document["patterns"][0]["sigma_max"] == [0.01, "inf"]
    for change in ({"schema": "kinjax-annotations/2"}, {"more": 1}, {"unit": "cm"}, {"frames": -1}, {"fps": "fast"}):
        assert not check.is_valid({**document, **change})
    assert not check.is_valid({**document, "constraints": [{**first, "type": "plane"}]})
    assert len((tmp_path / "a.json").read_text().splitlines()) == 21  # one constraint a line: differences stay readable


def refused(path, *parts: str) -> None:
    with pytest.raises(FileFormatError) as e:
        read_annotations(path)
    assert e.value.remedy and str(path) in str(e.value) and all(p in str(e.value) for p in parts), str(e.value)


def test_json_that_is_wrong_is_refused(tmp_path):
    path = write_annotations(tmp_path / "a.json", made())
    whole = path.read_bytes()
    good = json.loads(whole)
    constraint = good["constraints"][0]

    def wrong(document, *parts):
        path.write_text(document if isinstance(document, str) else json.dumps(document))
        refused(path, *parts)

    wrong({**good, "schema": "kinjax-annotations/2"}, "kinjax-annotations/2", "update")
    wrong({k: v for k, v in good.items() if k != "schema"}, "does not say")
    wrong({**good, "schema": "other"}, "'other'")
    wrong({**good, "more": 1}, "more")
    wrong({**good, "unit": "cm"}, "cm")
    wrong({**good, "fps": -1}, "-1")
    for change in ({"begin": 31}, {"end": 100}, {"begin": -1}, {"type": "plane"}, {"position": [1, 2]}, {"object": 5}):
        part = "not inside" if {"begin", "end"} & set(change) else "$.constraints[0]"
        wrong({**good, "constraints": [{**constraint, **change}]}, part)
    for text in ("", "{", "[]", "null", "[" * 100_000, '{"a":' * 100_000, whole.decode()[:-20], '{"schema": "\\ud800"}'):
        wrong(text)
    path.write_bytes(b"\xff\xfe" + whole)
    refused(path)


def test_tables_that_are_wrong_are_refused(tmp_path):
    path = write_annotations(tmp_path / "a.csv", made())
    lines = path.read_text().splitlines()
    head, row = lines[:2]
    for text, part in (
        ("", "columns"),
        ("a,b\n1,2\n", "columns"),
        (head, "no row"),
        (f"{head}\n{row[:-5]}", "cells"),
        (f"{head}\n{row}\n{row.replace('walk', 'run')}", "2 clips"),
        (f"{head}\n{row.replace('30,0.0', '3x,0.0', 1)}", "'3x'"),
        (f"{head}\n{row.replace('space', 'plane')}", "plane"),
        (f'{head}\n{row}\n"open', "CSV"),
        (f"{head}\n{row.replace(',100,', ',20,')}", "inside"),
    ):
        path.write_text(text)
        refused(path, part)
    path.write_bytes(b"\xff\xfe\x00")
    refused(path)
    whole = write_annotations(tmp_path / "a.parquet", made()).read_bytes()
    for cut in (0, 4, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.parquet").write_bytes(whole[:cut])
        refused(tmp_path / "a.parquet", "Parquet")
    import pyarrow as pa
    from pyarrow import parquet

    for table in (pa.table({"a": [1]}), parquet.read_table(pa.BufferReader(whole)).replace_schema_metadata({"kinjax": b"[1]"})):
        parquet.write_table(table, tmp_path / "a.parquet")
        refused(tmp_path / "a.parquet")


def test_csv_is_safe_in_a_spreadsheet(tmp_path):
    for name in NASTY:
        a = Annotations(name, 30.0, 9, Constraints((Constraint(name, "space", 0, 5, (-1.0, 2, 3)),)))
        for path in (write_annotations(tmp_path / "a.csv", a), export(a, tmp_path / "e.csv")):
            rows = csv.reader(io.StringIO(path.read_bytes().decode(), newline=""))
            cells = {c for row in rows for c in row} - {"-1.0"}
            assert not any(c.startswith(("=", "+", "-", "@", "\t", "\r")) for c in cells), (name, cells)
    text = write_annotations(tmp_path / "a.csv", made()).read_text()
    assert ",-1.0,2e-17,3.0,0.0,0.6,0.8," in text  # numbers are numbers


def test_parquet_is_a_plain_table(tmp_path):
    duckdb = pytest.importorskip("duckdb")
    path = write_annotations(tmp_path / "a.parquet", made())
    rows = duckdb.sql(f"select object, type, \"begin\", \"end\", residual from '{path}' order by all").fetchall()
    assert [r[:4] for r in rows] == [("LeftFoot", "point", 25, 40), ("LeftFoot", "space", 0, 30), ("RightHand", "line", 10, 99)]


def test_labels_of_frames(tmp_path):
    a = made()
    with np.load(write_annotations(tmp_path / "a.npz", a), allow_pickle=False) as f:
        assert f["codes"].shape == (100, 2) and f["codes"].dtype == np.uint8 and f["fps"] == FPS
        assert list(f["objects"]) == ["LeftFoot", "RightHand"] and list(f["types"]) == ["space", "line", "point"]
        codes = f["codes"]
    assert list(codes[[0, 24, 25, 30, 31, 40, 41], 0]) == [1, 1, 5, 5, 4, 4, 0] and list(codes[[9, 10, 99], 1]) == [0, 2, 2]
    path = write_annotations(tmp_path / "b.npz", a, objects=["Head", "RightHand", "LeftFoot"])
    with np.load(path, allow_pickle=False) as f:
        np.testing.assert_array_equal(f["codes"][:, ::-1][:, :2], codes)
        assert not f["codes"][:, 0].any()
    assert_same(read_annotations(path), a)
    np.testing.assert_array_equal(frame_codes(a, ["RightHand"])[:, 0] > 0, a.constraints.mask(100, "RightHand"))
    for objects, part in ((["LeftFoot"], "RightHand"), (["LeftFoot", "RightHand", "RightHand"], "repeats")):
        with pytest.raises(OptionError, match=part):
            write_annotations(tmp_path / "c.npz", a, objects=objects)
    with pytest.raises(OptionError, match="objects="):
        write_annotations(tmp_path / "c.json", a, objects=["x"])


def test_what_cannot_be_written_is_refused(tmp_path):
    for suffix in (".json", ".csv", ".parquet", ".npz"):
        path = tmp_path / f"a{suffix}"
        path.write_text("old")
        for begin, end in ((-1, 3), (5, 4), (90, 100)):
            a = Annotations("c", 30.0, 100, Constraints((Constraint("x", "space", begin, end, (0, 0, 0)),)))
            with pytest.raises(OptionError, match=rf"'x', frames {begin}..{end}.*0..99"):
                write_annotations(path, a)
        with pytest.raises(OptionError, match="rate"):
            write_annotations(path, Annotations("c", math.nan, 1, Constraints()))
        assert path.read_text() == "old"
    with pytest.raises(OptionError, match=r"\.json, \.csv, \.parquet, \.npz"):
        write_annotations(tmp_path / "a.xml", made())
    with pytest.raises(FileFormatError, match=r"'\.xml'.*\.json, \.csv, \.parquet, \.npz"):
        read_annotations(tmp_path / "a.xml")
    with pytest.raises(FileFormatError, match="no such file"):
        read_annotations(tmp_path / "none.json")
    with pytest.raises(OptionError, match="no folder"):
        write_annotations(tmp_path / "none" / "a.json", made())


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = write_annotations(tmp_path / "a.json", made())
    old = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    for step in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, step, full)
            with pytest.raises(OSError, match="No space"):
                write_annotations(path, made(method="other"))
        assert path.read_bytes() == old and os.listdir(tmp_path) == ["a.json"]


# Exports


def test_webvtt(tmp_path):
    a = Annotations("a & b.bvh", 25.0, 200_000, Constraints((
        Constraint("Foot<b>", "space", 100_000, 100_024, (0, 0, 0)), Constraint("x\n\n00:00 --> 9", "line", 0, 0, (0, 0, 0)),
    )))  # fmt: skip
    text = export(a, tmp_path / "a.vtt").read_text()
    assert text.startswith("WEBVTT\n\nNOTE ") and "a &amp; b.bvh" in text and "exclusive" in text and "(end + 1) / fps" in text
    blocks = text.strip().split("\n\n")[2:]
    assert blocks[0] == "1\n00:00:00.000 --> 00:00:00.040\nx 00:00 --&gt; 9: line"
    assert blocks[1] == "2\n01:06:40.000 --> 01:06:41.000\nFoot&lt;b&gt;: space"
    for name in NASTY:
        text = export(made((name, "b")), tmp_path / "a.vtt").read_text()
        assert text.count("-->") == 3 and "<" not in text.replace("-->", "") and len(text.strip().split("\n\n")) == 5, name


FAKE_BPY = """
import sys, types, json
made = []
markers = types.SimpleNamespace(new=lambda name, frame: made.append([frame, name]))
scene = types.SimpleNamespace(timeline_markers=markers)
sys.modules["bpy"] = types.SimpleNamespace(context=types.SimpleNamespace(scene=scene))
for path in sys.argv[1:]:
    exec(compile(open(path, encoding="ascii").read(), path, "exec"), {})
print(json.dumps(made))
"""


def test_blender_markers_run(tmp_path):
    paths = [export(made(), tmp_path / "a.py"), export(made((n := NASTY[14], "b")), tmp_path / "b.py", first_frame=-3)]
    for i, name in enumerate(NASTY):
        nasty = made((name, name))
        paths.append(export(Annotations(name, nasty.fps, nasty.frames, nasty.constraints), tmp_path / f"n{i}.py"))
    out = subprocess.run([sys.executable, "-c", FAKE_BPY, *map(str, paths)], capture_output=True, text=True, check=True).stdout
    marks = json.loads(out)
    assert marks[0] == [1, "LeftFoot space begin"] and marks[5] == [100, "RightHand line end"]
    assert [31, "LeftFoot space end"] in marks[:6]
    assert marks[6] == [-3, f"{n} space begin"] and len(marks) == 6 * len(paths)
    assert "included" in paths[0].read_text() and "FIRST_FRAME" in paths[0].read_text()


def test_events(tmp_path):
    names = ["LeftFoot", "mixamorig:RightHand", "lfemur", "rtoes", "lowerback", "L_Ankle", "hand.R", "RThumb", "root", "Head"]
    sides = ["Left", "Right", "Left", "Right", "General", "Left", "Right", "Right", "General", "General"]
    constraints = tuple(Constraint(n, "space", i, i + 25, (0, 0, 0)) for i, n in enumerate(names))
    a = Annotations("a,=b.bvh", 50.0, 100, Constraints(constraints))
    text = export(a, tmp_path / "e.csv").read_bytes().decode()
    assert "included" in text.splitlines()[1] and all("," not in line for line in text.splitlines()[:2])
    rows = list(csv.DictReader(text.splitlines()[2:]))
    assert [r["object"] for r in rows[:10]] == names and [r["side"] for r in rows[:10]] == sides
    assert rows[0] == {"object": "LeftFoot", "side": "Left", "label": "space begin", "time_s": "0.0", "frame": "0"}
    assert rows[10] == {"object": "LeftFoot", "side": "Left", "label": "space end", "time_s": "0.5", "frame": "25"}


def test_exports_that_make_no_sense(tmp_path):
    assert export(made(), tmp_path / "a.txt", "WebVTT").read_text().startswith("WEBVTT")
    with pytest.raises(OptionError, match=r"webvtt \(\.vtt\), blender \(\.py\), events \(\.csv\)"):
        export(made(), tmp_path / "a.srt")
    with pytest.raises(OptionError, match="'srt'"):
        export(made(), tmp_path / "a.vtt", "srt")
    with pytest.raises(OptionError, match="no frame rate"):
        export(Annotations("c", 0.0, 5, Constraints()), tmp_path / "a.vtt")
    with pytest.raises(OptionError, match="not inside"):
        export(Annotations("c", 1.0, 5, Constraints((Constraint("x", "space", 0, 5, (0, 0, 0)),))), tmp_path / "a.vtt")


def test_another_rate_keeps_the_times_that_are_inside():
    at = [Constraint("a", "space", b, e, (0.0, 0.0, 0.0), fps=25.0) for b, e in ((0, 0), (3, 10), (24, 24), (2, 3))]
    found = Annotations("clip", 25.0, 25, Constraints(tuple(at)))
    fast = found.at_rate(60.0, 60)  # ratio 2.4: 7.2..24 and 4.8..7.2 hold the frames 8..24 and 5..7
    assert [(c.begin, c.end, c.fps) for c in fast.constraints] == [(0, 0, 60), (8, 24, 60), (58, 58, 60), (5, 7, 60)]
    assert (fast.fps, fast.frames, fast.at_rate(60.0, 60)) == (60, 60, fast)
    slow = found.at_rate(5.0, 5)
    assert [(c.begin, c.end) for c in slow.constraints] == [(0, 0), (1, 2), (4, 4), (0, 0)]  # the last was between two
    with pytest.raises(OptionError, match="positive"):
        found.at_rate(0.0, 60)


def test_importing_the_formats_loads_nothing_heavy():
    code = "import sys, kinjax.formats; print([m for m in ('pyarrow', 'msgspec', 'kinjax.formats.bvh', 'jax') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
