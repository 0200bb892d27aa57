"""Labels on disk: every format gives the same labels, and what is wrong is said with its place; and the command that reads them."""

import contextlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kinjax.annotations import Annotations, Constraint, Constraints
from kinjax.cli.evaluating import evaluate_command, parse_core
from kinjax.cli.evaluating_options import Evaluate
from kinjax.errors import FileFormatError, OptionError
from kinjax.evaluation import Label
from kinjax.formats import write_annotations
from kinjax.formats.labels import SCHEMA, read_labels, write_labels

LABELS = (
    Label("a/walk.bvh", "left_foot", 10, 40, type="space"),
    Label("=run", "'hand", begin_s=0.1, end_s=1 / 3, kind="outer"),
    Label("a/walk.bvh", "左足, \"x\"", 3, 3, type="none"),
    Label("a/walk.bvh", "left_foot", 90, 99, kind="unknown"),
)  # fmt: skip


def text(tmp_path: Path, name: str, content: str) -> Path:
    """A file with this content."""
    path = tmp_path / name
    path.write_text(content, encoding="utf-8", newline="")
    return path


def refused(path: Path) -> FileFormatError:
    with pytest.raises(FileFormatError) as told:
        read_labels(path)
    assert str(path) in str(told.value)
    return told.value


@pytest.mark.parametrize("suffix", [".json", ".csv", ".JSON"])
def test_labels_come_back(tmp_path, suffix):
    path = write_labels(tmp_path / f"labels{suffix}", LABELS, note="made\nhere")
    assert read_labels(path) == LABELS
    again = path.read_bytes()
    assert write_labels(path, LABELS, note="made\nhere").read_bytes() == again
    assert read_labels(write_labels(tmp_path / f"none{suffix}", [])) == ()
    with pytest.raises(OptionError, match=r"\.json or \.csv"):
        write_labels(tmp_path / "labels.txt", LABELS)


def test_json_by_hand(tmp_path):
    record = {"schema": SCHEMA, "labels": [{"clip": "w", "object": "f", "begin": 1.0, "end": 4, "type": "Empty", "kind": None}]}
    assert read_labels(text(tmp_path, "a.json", "\ufeff" + json.dumps(record))) == (Label("w", "f", 1, 4, type="none"),)


def test_csv_by_hand(tmp_path):
    content = "object, clip ,end_s,begin_s\r\nleft_foot,walk.bvh,0.5,0.25\r\n\r\nhand,walk.bvh,2,1\r\n"
    expected = (Label("walk.bvh", "left_foot", begin_s=0.25, end_s=0.5), Label("walk.bvh", "hand", begin_s=1.0, end_s=2.0))
    assert read_labels(text(tmp_path, "a.csv", content)) == expected
    mixed = "clip,object,type,begin,end,begin_s,end_s,kind\nw,f,any,1,2,,,\nw,g,LINE,,,0.1,0.2,Outer\n"
    expected = (Label("w", "f", 1, 2), Label("w", "g", begin_s=0.1, end_s=0.2, type="line", kind="outer"))
    assert read_labels(text(tmp_path, "b.csv", mixed)) == expected


def test_npz_by_hand(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, clip=np.array(["w", "w"]), object=np.array(["f", "g"]), begin=np.array([1, 5]), end=[2.0, 9.0])
    assert read_labels(path) == (Label("w", "f", 1, 2), Label("w", "g", 5, 9))
    np.savez(path, clip=["w"], object=["f"], begin=[np.nan], end=[np.nan], begin_s=[0.5], end_s=[1.5], kind=["outer"])
    assert read_labels(path) == (Label("w", "f", begin_s=0.5, end_s=1.5, kind="outer"),)


@pytest.mark.parametrize("suffix", [".json", ".csv", ".parquet", ".npz"])
def test_annotations_are_labels(tmp_path, suffix):
    items = (Constraint("foot", "space", 10, 40, (0, 0, 0), fps=120.0), Constraint("foot", "line", 41, 50, (0, 0, 0), (1, 0, 0)))
    a = Annotations("walk.bvh", 120.0, 100, Constraints(items))
    labels = read_labels(write_annotations(tmp_path / f"a{suffix}", a))
    assert [(x.clip, x.object, x.type, x.kind, x.span(120.0)) for x in labels] == [
        ("walk.bvh", "foot", "space", "exact", (10, 40)), ("walk.bvh", "foot", "line", "exact", (41, 50)),
    ]  # fmt: skip
    assert labels[0].span(60.0) == (5, 20)  # in seconds: they fit a clip of another rate
    nameless = write_annotations(tmp_path / f"b{suffix}", Annotations("", 0.0, 100, Constraints(items[:1])))
    assert "without clip" in refused(nameless).found


def test_a_folder_of_files(tmp_path):
    (tmp_path / "inner").mkdir()
    write_labels(tmp_path / "b.csv", LABELS[:1])
    write_labels(tmp_path / "inner" / "c.json", LABELS[1:])
    write_annotations(tmp_path / "a.npz", Annotations("w", 10.0, 9, Constraints((Constraint("f", "point", 0, 5, (0, 0, 0)),))))
    text(tmp_path, "README.md", "what these are")
    assert read_labels(tmp_path) == (Label("w", "f", begin_s=0.0, end_s=0.5, type="point"), *LABELS)
    text(tmp_path, "d.json", "{}")
    with pytest.raises(FileFormatError, match=r"d\.json: the file does not say what it is"):
        read_labels(tmp_path)
    (tmp_path / "empty").mkdir()
    assert "no labels in this folder" in refused(tmp_path / "empty").found


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        ("clip,object,begin,end,colour\n", 1, "'colour' is not known"),
        ("clip,begin,end\n", 1, "no column 'object'"),
        ("clip,object,begin,begin\n", 1, "twice"),
        ("", 1, "no column 'clip'"),
        ("clip,object,begin,end\nw,f,1,2\nw,f,1\n", 3, "3 cells under 4 columns"),
        ("clip,object,begin,end\nw,f,1,x\n", 2, "'x' in the column end (the 4. of the row)"),
        ("clip,object,begin,end\nw,f,1.5,2\n", 2, "'1.5' in the column begin"),
        ("clip,object,begin,end\nw,f,5,2\n", 2, "ends at 2"),
        ("clip,object,begin,end\n,f,1,2\n", 2, "without clip"),
        ("clip,object,begin,end,type\nw,f,1,2,plane\n", 2, "no type 'plane'"),
        ("clip,object,begin_s,end_s\nw,f,nan,2\n", 2, "needs begin and end"),
        ("clip,object,begin_s,end_s\nw,f,0,inf\n", 2, "inf"),
        ('clip,object,begin,end\n"w\n,f,1,2\n', None, "no readable CSV"),
    ],
)
def test_csv_that_is_wrong_says_where(tmp_path, content, line, words):
    error = refused(text(tmp_path, "a.csv", content))
    assert words in error.found and error.line == line


@pytest.mark.parametrize(
    ("content", "place", "words"),
    [
        ('{"schema": "kinjax-labels/1",\n "labels": [,]}', (2, 13), "not JSON"),
        ("[]", None, "no labels"),
        ('{"labels": []}', None, "does not say what it is"),
        ('{"schema": "kinjax-labels/2", "labels": []}', None, "of version 'kinjax-labels/2'"),
        ('{"schema": "kinjax-labels/1"}', None, "labels"),
        ('{"schema": "kinjax-labels/1", "labels": [], "lables": 1}', None, "lables"),
        ('{"schema": "kinjax-labels/1", "labels": [{"clip": "w", "object": [1]}]}', None, "labels"),
        ('{"schema": "kinjax-labels/1", "labels": [{"clip": "w", "object": "f", "start": 1}]}', None, "labels[0]: the key 'start'"),
        ('{"schema": "kinjax-labels/1", "labels": [{"clip": "w", "object": "f", "begin": 1}]}', None, "labels[0]: a label needs"),
        ('{"schema": "kinjax-labels/1", "labels": [{"clip": 5, "object": "f", "begin": 1, "end": 2}]}', None, "without clip"),
        ('{"schema": "kinjax-labels/1", "labels": [{"clip": "w", "object": "f", "begin": "1", "end": 2}]}', None, "labels[0]: begin"),
        ("9" * 5000, None, "not JSON"),
        ("\x00", (1, 1), "not JSON"),
    ],
)  # fmt: skip
def test_json_that_is_wrong_says_where(tmp_path, content, place, words):
    error = refused(text(tmp_path, "a.json", content))
    assert words in error.found
    assert place is None or (error.line, error.column) == place


def test_npz_that_is_wrong(tmp_path):
    path = tmp_path / "a.npz"
    good = {"clip": np.array(["w"]), "object": np.array(["f"]), "begin": np.array([1]), "end": np.array([2])}
    for change, words in (
        ({"colour": np.array([1])}, "'colour' is not known"),
        ({"object": np.array([1])}, "array object is of int64"),
        ({"begin": np.array(["1"])}, "array begin is of"),
        ({"begin": np.array([1, 2])}, "begin (2,)"),
        ({"begin": np.array(1)}, "begin ()"),
        ({"begin": np.array([9])}, "label 0: a label ends at 2"),
        ({"clip": np.array([{}], object)}, "Python objects"),
    ):
        np.savez(path, **(good | change))
        assert words in refused(path).found
    np.savez(path, **{k: v for k, v in good.items() if k != "object"})
    assert "no column 'object'" in refused(path).found
    path.write_bytes(b"PK\x03\x04 broken")
    assert "no readable .npz" in refused(path).found
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("clip.npy", b"no array")
        archive.writestr("object.npy", b"no array")
    assert "no array" in refused(path).found


def test_other_files_are_refused(tmp_path):
    assert "no format of labels" in refused(text(tmp_path, "a.txt", "")).found
    assert "no such file" in refused(tmp_path / "missing.json").found
    assert refused(text(tmp_path, "a.parquet", "nothing"))
    path = tmp_path / "latin.csv"
    path.write_bytes(b"clip,object,begin,end\nw,f\xff,1,2\n")
    assert "no readable CSV" in refused(path).found


# the command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path, monkeypatch):
    """A store of two clips, as `kinjax.database.Store` gives its tables, and labels of one of them."""
    from kinjax import database

    class Made:
        def __init__(self, path):
            assert Path(path).name == "store"

        def table(self, name, columns=None):
            tables = {
                "clips": {"clip": ["data/walk.bvh", "data/run.bvh"], "frames": [200, 100], "fps": [100.0, 50.0]},
                "constraints": {
                    "clip": ["data/walk.bvh"] * 2, "object": ["LeftFoot", "LeftHand"], "role": ["left_foot", "left_hand"],
                    "type": ["space"] * 2, "begin": [20, 0], "end": [39, 9],
                },
            }  # fmt: skip
            return {c: tables[name][c] for c in columns}

    monkeypatch.setattr(database, "Store", Made, raising=False)
    labels = [Label("walk", "left_foot", *span, type="space") for span in ((20, 59), (100, 119))] + [Label("hop", "f", 1, 2)]
    return tmp_path / "store", write_labels(tmp_path / "labels.json", labels)


def test_the_command_prints_a_table_and_what_it_left_out(store, capsys):
    assert evaluate_command(Evaluate(*store, missed=5)) == 0
    out, told = capsys.readouterr()
    row = next(line for line in out.splitlines() if line.startswith("left_foot"))
    assert row.split()[:5] == ["left_foot", "space", "2", "1.000", "0.333"]
    assert "1 of 2 labels were not found" in out and "data/walk.bvh" in out
    assert "1 clip without labels" in told and "hop" in told and "1 constraint of objects" in told
    assert evaluate_command(Evaluate(*store, quiet=True)) == 0
    assert capsys.readouterr().out == ""


def test_the_command_writes_json(store, capsys, tmp_path):
    assert evaluate_command(Evaluate(*store, json=Path("-"), object=("LEFT_FOOT",))) == 0
    first = capsys.readouterr().out
    assert json.loads(first)["scores"][0]["recall"] == pytest.approx(1 / 3)
    assert evaluate_command(Evaluate(*store, json=tmp_path / "out.json", object=("left_foot",))) == 0
    assert (tmp_path / "out.json").read_text() == first and "written" in capsys.readouterr().out


def test_the_options_of_counting_reach_it(store, capsys):
    path = write_labels(store[1].with_name("outer.csv"), [Label("walk", "left_foot", 20, 59, kind="outer")])
    options = Evaluate(store[0], path, core="0:1", reach=0.5, iou=0.4, type=("space",), weigh="seconds", json=Path("-"))
    assert evaluate_command(options) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["counting"] == {"core": [0, 1], "reach": 0.5, "iou": 0.4, "join": 0.05, "weigh": "seconds"}
    assert record["scores"][-1]["wanted"] == pytest.approx(0.4)


def test_the_command_refuses_what_makes_no_sense(store, tmp_path):
    assert parse_core("0.1:1") == (0.1, 1.0)
    for options, words in (
        (Evaluate(), "STORE LABELS"),
        (Evaluate(*store, core="0.5"), "--core '0.5'"),
        (Evaluate(*store, core="a:b"), "--core"),
        (Evaluate(*store, core="0.5:0.2"), "core is"),
        (Evaluate(*store, missed=-1), "--missed"),
        (Evaluate(store[0], write_labels(tmp_path / "o.json", LABELS[1:2])), "none of its clips is in"),
    ):
        with pytest.raises(OptionError, match=words):
            evaluate_command(options)


def test_the_options_are_read_by_the_parser():
    import tyro

    options = tyro.cli(Evaluate, args=["s", "l.json", "--object", "left_foot", "hand", "--core", "0:1", "--json", "-"])
    assert (options.object, options.core, options.json) == (("left_foot", "hand"), "0:1", Path("-"))
    with contextlib.suppress(SystemExit):
        tyro.cli(Evaluate, args=["--help"])
