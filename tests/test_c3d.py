"""C3D: what is in a file arrives in metres, whatever machine wrote it; what is not in it is refused without cost.

Files are written here byte by byte; ezc3d, where it is installed, is the second reader. Real recordings need the data folder.
"""

import os
import struct
import tracemalloc

import numpy as np
import pytest

from benchmarks import forceplates as fp
from kinjax.errors import FileFormatError, KinjaxError, OptionError, UnknownNameError
from kinjax.formats import load, read_c3d
from kinjax.formats.c3d import Markers, read_c3d_markers, rigid_objects

FOOT = ["LHEE", "LTOE", "LANK"]
LAYOUT = np.array([[0.0, 0.0, 30.0], [200.0, 20.0, 40.0], [70.0, -50.0, 100.0]])  # mm: heel, toe, ankle
TRIALS = ("Gait", "PiG_Motion-FlatFoot-Full", "PiG_Motion-FlatFoot-Hole", "PiG_Motion3_FF", "PlugInC3D")


def walking(frames=20, markers=LAYOUT):
    """(frames, markers, 3) in mm: the foot moves and turns about the vertical."""
    angle = np.linspace(0, 0.6, frames)
    c, s, o = np.cos(angle), np.sin(angle), np.zeros(frames)
    turn = np.stack([np.stack([c, -s, o], -1), np.stack([s, c, o], -1), np.stack([o, o, o + 1], -1)], -2)
    return np.einsum("fij,mj->fmi", turn, markers) + np.linspace(0, 500, frames)[:, None, None] * [1.0, 0.2, 0.0] + 10.0


class File:
    """A C3D file, byte by byte. points: (frames, points, 3). Every claim can be changed after it was made."""

    def __init__(self, points=None, labels=FOOT, processor="Intel", scale=-1.0, residual=None, analog=0, **point):
        self.points = walking() if points is None else np.asarray(points, float)
        frames, count = self.points.shape[:2]
        self.processor, self.scale, self.analog = processor, scale, analog
        self.residual = np.zeros((frames, count)) if residual is None else residual
        self.header = {"points": count, "analog": 2 * analog, "first": 1, "last": frames, "scale": scale, "rate": 100.0}
        self.header |= {"samples": 2 if analog else 0, "start": None}
        self.groups = {
            "POINT": {
                "USED": ("i", [count]), "FRAMES": ("i", [frames]), "SCALE": ("f", [scale]), "RATE": ("f", [100.0]),
                "DATA_START": ("i", [0]), "UNITS": ("s", ["mm"]), "LABELS": ("s", list(labels)),
            },
            "ANALOG": {"USED": ("i", [analog])},
        }  # fmt: skip
        for name, value in point.items():
            self.groups["POINT"].pop(name) if value is None else self.groups["POINT"].update({name: value})

    def bytes(self):
        section = self.section()
        start = 2 + len(section) // 512
        self.groups["POINT"].setdefault("DATA_START", ("i", [0]))[1][0] = start
        section = self.section()
        h = self.header
        head = bytes([2, 0x50]) + self.pack("H", h["points"], h["analog"], h["first"], h["last"], 10)
        head += self.number(h["scale"]) + self.pack("H", start if h["start"] is None else h["start"], h["samples"])
        head += self.number(h["rate"])
        return head.ljust(512, b"\0") + section + self.data()

    def data(self):
        width = 2 * self.analog
        frames, count = self.points.shape[:2]
        values = np.concatenate([self.points, self.residual[..., None]], -1).reshape(frames, 4 * count)
        values = np.concatenate([values, np.full((frames, width), 7.0)], 1)
        if self.scale < 0:
            raw = b"".join(self.number(v) for v in values.ravel())
        else:
            values[:, : 4 * count].reshape(frames, count, 4)[..., :3] /= self.scale
            raw = np.rint(values).astype(">i2" if self.processor == "MIPS" else "<i2").tobytes()
        return raw + b"\0" * (-len(raw) % 512)

    def section(self):
        out = bytes([1, 0x50, 0, {"Intel": 84, "DEC": 85, "MIPS": 86}[self.processor]])
        for g, (group, entries) in enumerate(self.groups.items(), 1):
            out += struct.pack("bb", len(group), -g) + group.encode() + self.pack("H", 3) + b"\0"
            for name, (kind, values) in entries.items():
                body = self.entry(kind, values) + b"\0"
                out += struct.pack("bb", len(name), g) + name.encode() + self.pack("H", len(body) + 2) + body
        out += b"\0\0"
        out += b"\0" * (-len(out) % 512)
        return out[:2] + bytes([len(out) // 512]) + out[3:]

    def entry(self, kind, values):
        if kind == "s":
            texts = [v.encode() for v in values]
            width = max(map(len, texts), default=0)
            return struct.pack("b3B", -1, 2, width, len(texts)) + b"".join(t.ljust(width) for t in texts)
        body = b"".join(self.pack("H", int(v) % 65536) if kind == "i" else self.number(v) for v in values)
        return bytes([2 if kind == "i" else 4, 1, len(values)]) + body

    def pack(self, kind, *values):
        return struct.pack((">" if self.processor == "MIPS" else "<") + kind * len(values), *values)

    def number(self, value):
        if self.processor != "DEC":
            return self.pack("f", value)
        (bits,) = struct.unpack("<I", struct.pack("<f", value * 4))  # the same mantissa, another bias, halves swapped
        return struct.pack("<HH", bits >> 16, bits & 0xFFFF) if value else b"\0\0\0\0"

    def at(self, folder, name="made.c3d"):
        path = folder / name
        path.write_bytes(self.bytes())
        return path


def said(notes, text):
    """Whether one of the notes has the text in it."""
    return any(text in n for n in notes)


# what is in a file arrives --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("processor", ["Intel", "DEC", "MIPS"])
@pytest.mark.parametrize("scale", [-1.0, 0.05])
@pytest.mark.parametrize("analog", [0, 3])
def test_every_machine_and_storage(tmp_path, processor, scale, analog):
    file = File(processor=processor, scale=scale, analog=analog)
    found = read_c3d_markers(file.at(tmp_path))
    assert found.labels == tuple(FOOT) and (found.rate, found.up, found.clip) == (100.0, "z", "made.c3d")
    assert found.positions.dtype == np.float64 and found.positions.shape == (20, 3, 3)
    np.testing.assert_allclose(found.positions, file.points / 1000, rtol=0, atol=1e-7 if scale < 0 else 0.026e-3)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("cm", 0.01), ("m", 1.0), (" MM ", 1e-3), ("Meters", 1.0)])
def test_units(tmp_path, unit, metres):
    found = read_c3d_markers(File(UNITS=("s", [unit])).at(tmp_path))
    np.testing.assert_allclose(found.positions, walking() * metres, rtol=1e-6)
    assert said(found.notes, "by POINT:UNITS")


def test_a_unit_that_is_missing_is_assumed_and_one_that_is_unknown_refused(tmp_path):
    assert said(read_c3d_markers(File(UNITS=None).at(tmp_path)).notes, "millimetres assumed")
    assert said(read_c3d_markers(File(UNITS=("s", ["  "])).at(tmp_path)).notes, "millimetres assumed")
    with pytest.raises(FileFormatError, match=r"'furlong'.*may be mm, cm"):
        read_c3d_markers(File(UNITS=("s", ["furlong"])).at(tmp_path))


@pytest.mark.parametrize(
    ("screen", "up", "note"),
    [
        ({"X_SCREEN": ("s", ["+X"]), "Y_SCREEN": ("s", ["+Z"])}, "z", "Y_SCREEN = +Z"),
        ({"X_SCREEN": ("s", ["+Z"]), "Y_SCREEN": ("s", ["+Y"])}, "y", "Y_SCREEN = +Y"),
        ({"Y_SCREEN": ("s", ["-x"])}, "x", "Y_SCREEN = -X"),
        ({}, "z", "assumed (no POINT:Y_SCREEN)"),
        ({"X_SCREEN": ("s", ["+Y"]), "Y_SCREEN": ("s", ["+Y"])}, "z", "assumed (POINT:X_SCREEN = '+y'"),
        ({"Y_SCREEN": ("s", ["up"])}, "z", "assumed"),
    ],
)
def test_up(tmp_path, screen, up, note):
    path = File(**screen).at(tmp_path)
    found = read_c3d_markers(path)
    assert found.up == up and said(found.notes, note)
    given = read_c3d_markers(path, up="x")
    assert given.up == "x" == read_c3d(path, up="x").up and said(given.notes, "as given") and not said(given.notes, note)


def test_up_must_be_an_axis(tmp_path):
    with pytest.raises(OptionError, match="choose from auto, x, y, z"):
        read_c3d(File().at(tmp_path), up="w")


def test_missing_points(tmp_path):
    points, residual = walking(), np.zeros((20, 3))
    residual[3, 0] = -1
    points[4, 1] = residual[4, 1] = 0  # 0, 0, 0 in a gap
    residual[4, 1] = -1
    points[5, 1] = 0  # 0, 0, 0 and "seen", while it is elsewhere in all other frames
    points[6, 2, 1], points[7, 2, 0] = np.nan, np.inf
    points, residual = np.tile(points, (5, 1, 1)), np.tile(residual, (5, 1))
    points[8, 0, 0] = 3e30
    found = read_c3d_markers(File(points, residual=residual).at(tmp_path))
    lost = np.zeros((20, 3), bool)
    lost[[3, 4, 5, 6, 7], [0, 1, 1, 2, 2]] = True
    lost = np.tile(lost, (5, 1))
    lost[8, 0] = True
    np.testing.assert_array_equal(found.seen, ~lost)
    assert said(found.notes, "21 of 300 marker positions are missing")
    assert said(found.notes, "5 marker positions at exactly 0, 0, 0") and said(found.notes, "1 marker positions more than 1000 m")
    assert np.isnan(found.positions[~found.seen]).all()


def test_a_marker_that_never_leaves_the_origin_is_there(tmp_path):
    points = walking()
    points[:, 0] = 0
    assert read_c3d_markers(File(points).at(tmp_path)).seen.all()


def test_numbers_beyond_all_bounds_are_damage(tmp_path):
    with pytest.raises(FileFormatError, match="60 of 60 marker positions are more than 1000 m away"):
        read_c3d_markers(File(walking() * 1e9).at(tmp_path))


def test_rate_is_the_parameters_and_a_difference_is_told(tmp_path):
    file = File(RATE=("f", [120.0]))
    found = read_c3d_markers(file.at(tmp_path))
    assert found.rate == 120 and said(found.notes, "120 fps by POINT:RATE (header 100.0)")
    assert said(read_c3d_markers(File(RATE=None).at(tmp_path)).notes, "100 fps by header (POINT:RATE missing)")
    file.header["rate"], file.groups["POINT"]["RATE"] = np.nan, ("f", [-5.0])
    with pytest.raises(FileFormatError, match=r"no frame rate: POINT:RATE -5.0, header nan"):
        read_c3d_markers(file.at(tmp_path))


def test_angles_and_forces_are_no_markers(tmp_path):
    points = np.concatenate([walking(), walking()[:, :1]], 1)
    found = read_c3d_markers(File(points, [*FOOT, "LKneeAngles"], ANGLES=("s", ["LKneeAngles"])).at(tmp_path))
    assert found.labels == tuple(FOOT) and said(found.notes, "1 points are angles")
    with pytest.raises(FileFormatError, match="none of the 3 points is a marker"):
        read_c3d_markers(File(FORCES=("s", FOOT)).at(tmp_path))


def test_labels_in_several_parameters_and_too_few_of_them(tmp_path):
    found = read_c3d_markers(File(LABELS=("s", FOOT[:1]), LABELS2=("s", ["LTOE"])).at(tmp_path))
    assert found.labels == ("LHEE", "LTOE", "") and said(found.notes, "1 of 3 points have no label")
    found = read_c3d_markers(File(LABELS=("s", ["A\x1b[31m", "Zehe\xfc", "C"])).at(tmp_path))
    assert found.labels == ("A?[31m", "Zehe\xfc", "C")


def test_load_takes_the_suffix_in_any_case(tmp_path):
    assert load(File().at(tmp_path, "A.C3D")).names == ("left_foot",)


# rigid objects --------------------------------------------------------------------------------------------------------


def test_a_foot_is_the_cluster_of_its_markers(tmp_path):
    poses = read_c3d(File().at(tmp_path))
    assert poses.names == ("left_foot",) and (poses.up, poses.clip, poses.rate) == ("z", "made.c3d", 100.0)
    assert poses.valid.all()
    np.testing.assert_allclose(poses.position[:, 0], walking().mean(1) / 1000, atol=1e-7)
    turned = 2 * np.arctan2(poses.rotation[:, 0, 3], poses.rotation[:, 0, 0])
    np.testing.assert_allclose(turned - turned[0], np.linspace(0, 0.6, 20), atol=1e-6)


def markers(positions, labels):
    return Markers(tuple(labels), np.asarray(positions, float), 100.0)


def five(frames=100):
    """Five markers of a head and pelvis cluster in metres."""
    shape = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0.2, 0.2, 0.05], [0.1, 0.1, 0.2]])
    return shape + np.linspace(0, 1, frames)[:, None, None] * [1.0, 0, 0]


def test_a_marker_that_is_often_missing_is_left_out_where_three_others_remain():
    x = five()[:, :4]
    x[:30, 1] = np.nan
    x[50:60, 2] = np.nan
    poses, notes = rigid_objects(markers(x, "abcd"), {"thing": list("abcd")})
    assert said(notes, "thing is made without b (70% of its frames)")
    assert poses.valid[:, 0].sum() == 90 and not poses.valid[50:60].any()  # a frame without all of the rest is masked
    np.testing.assert_allclose(poses.position[poses.valid[:, 0], 0], x[poses.valid[:, 0]][:, [0, 2, 3]].mean(1), atol=1e-12)


def test_it_stays_where_three_do_not_remain_or_remain_on_a_line():
    x = five()[:, :3]
    x[:30, 1] = np.nan
    poses, notes = rigid_objects(markers(x, "abc"), {"thing": list("abc")})
    assert poses.valid.sum() == 70 and not notes
    line = five()[:, :4]
    line[:, 2] = 2 * line[:, 1] - line[:, 0]  # a, b, c on one line: d carries the orientation
    line[:30, 3] = np.nan
    poses, notes = rigid_objects(markers(line, "abcd"), {"thing": list("abcd")})
    assert poses.valid.sum() == 70 and not notes


def test_presence_counts_only_the_frames_that_show_the_object():
    x = five()[:, :4]
    x[40:] = np.nan
    poses, notes = rigid_objects(markers(x, "abcd"), {"thing": list("abcd")})
    assert poses.valid.sum() == 40 and not notes


def test_objects_without_a_pose_are_left_out_with_a_note():
    x = five()
    x[50:, 0] = np.nan
    x[:50, 1] = np.nan
    line = five()[:, :3] * [0, 1, 1] + five()[:, :3, :1] * [1, 0, 0]
    line[:, 1:] = line[:, :1] + np.array([[[0.1, 0.1, 0.1], [0.2, 0.2, 0.2005]]])
    found = markers(np.concatenate([x, line], 1), "abcdefgh")
    poses, notes = rigid_objects(found, {"apart": list("abc"), "thin": list("fgh"), "good": list("cde")})
    assert poses.names == ("good",)
    assert said(notes, "apart is left out: no frame shows a, b, c together") and said(notes, "thin is left out: f, g, h lie on one line")
    with pytest.raises(FileFormatError, match=r"no frame shows.*the labels are: a, b, c, d.*clusters=\{"):
        rigid_objects(found, {"apart": list("abc")})


def test_automatic_objects_say_what_is_missing(tmp_path):
    path = File(labels=["S:LHEE", "S:LTOE", "ball"]).at(tmp_path)
    with pytest.raises(FileFormatError, match=r"made.c3d: no rigid object.*left_foot is left out: only S:LHEE, S:LTOE.*ball"):
        read_c3d(path)
    assert read_c3d(path, {"prop": ["lhee", "S:ltoe", "Ball"]}).names == ("prop",)


def test_a_marker_that_is_never_seen_is_not_there():
    x = five(10)[:, [0, 1, 2, 4]]
    x[:, 0] = np.nan
    poses, _ = rigid_objects(markers(x, ["LHEE", "LTOE", "LANK", "LHEE"]))  # the second of the name is
    assert poses.valid.all()
    np.testing.assert_allclose(poses.position[:, 0], x[:, 1:].mean(1), atol=1e-12)


@pytest.mark.parametrize("wrong", ["feet", {}, None, {"foot": "LHEE"}, {"foot": FOOT[:2]}, {"foot": ["LHEE", "lhee", "LTOE"]}])
def test_clusters_that_make_no_sense(wrong):
    with pytest.raises(OptionError, match="clusters"):
        rigid_objects(markers(five(5)[:, :3], FOOT), wrong)


def test_an_unknown_label_lists_the_nearest():
    with pytest.raises(UnknownNameError, match=r"no marker named 'LHEEL' \(nearest: LHEE"):
        rigid_objects(markers(five(5)[:, :3], FOOT), {"foot": ["LHEEL", "LTOE", "LANK"]})


# what is not in a file is refused -------------------------------------------------------------------------------------


def claimed(**header):
    file = File()
    file.header |= header
    return file


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda b: b"", "has 0 bytes: a C3D header alone has 512"),
        (lambda b: b[:300], "has 300 bytes"),
        (lambda b: b"BVH " + b[4:], "no C3D file: its first two bytes are 42 56"),
        (lambda b: b"\0" * 4 + b[4:], "no C3D file"),
        (lambda b: b[:512], "the parameters are said to begin at byte 512"),
        (lambda b: b[:515] + b"\x21" + b[516:], r"processor type is 33, none of 84 \(Intel\)"),
        (lambda b: b[:-600], r"bytes of 32-bit numbers; it has"),
        (lambda b: b[:520] + b"\xff" * 20 + b[540:], "the parameters are damaged"),
    ],
)
def test_files_that_are_none_or_cut(tmp_path, change, match):
    path = tmp_path / "bad.c3d"
    path.write_bytes(change(File().bytes()))
    with pytest.raises(FileFormatError, match=match) as caught:
        read_c3d(path)
    assert str(path) in str(caught.value) and caught.value.remedy


@pytest.mark.parametrize("processor", ["Intel", "MIPS"])
def test_huge_claims_cost_nothing(tmp_path, processor):
    files = [File(processor=processor) for _ in range(4)]
    files[0].groups["POINT"]["FRAMES"] = ("f", [1e9])
    files[0].header["last"] = 65535
    files[1].header["last"], files[1].groups["POINT"]["FRAMES"] = 65535, ("i", [-1])
    files[1].groups["TRIAL"] = {"ACTUAL_START_FIELD": ("i", [1, 0]), "ACTUAL_END_FIELD": ("i", [51712, 15258])}
    files[2].header["points"], files[2].groups["POINT"]["USED"] = 65535, ("i", [65535])
    files[3].header["analog"], files[3].header["samples"], files[3].groups["ANALOG"]["USED"] = 65535, 1, ("i", [65535])
    for n, file in enumerate(files):
        path = file.at(tmp_path, f"{n}.c3d")
        tracemalloc.start()
        with pytest.raises(FileFormatError, match=rf"claims .*; it has {path.stat().st_size} bytes") as caught:
            read_c3d(path)
        assert tracemalloc.get_traced_memory()[1] < 2e6 + path.stat().st_size
        tracemalloc.stop()
        assert n > 1 or "1000000000 (" in str(caught.value)


def test_the_claim_that_fills_the_file_is_taken(tmp_path):
    for wrong in (claimed(last=31), claimed(points=4), claimed(analog=6, samples=1), claimed(start=9)):
        found = read_c3d_markers(wrong.at(tmp_path))
        assert found.positions.shape == (20, 3, 3) and said(found.notes, "20 frames of 3 points fill the file")
        np.testing.assert_allclose(found.positions, walking() / 1000, rtol=1e-6)
    both = claimed(last=31)
    both.groups["POINT"]["FRAMES"] = ("i", [40])
    with pytest.raises(FileFormatError, match=r"frames 31 \(header\) and 40 \(POINT:FRAMES\).*none of the combinations fills it"):
        read_c3d_markers(both.at(tmp_path))
    cut = tmp_path / "cut.c3d"  # 49 of 60 frames, and a parameter that says 30: nothing is dropped silently
    cut.write_bytes(File(walking(60), FRAMES=("i", [30])).bytes()[:-512])
    with pytest.raises(FileFormatError, match="none of the combinations"):
        read_c3d_markers(cut)


def test_more_frames_than_a_header_can_count(tmp_path):
    points = np.tile(walking(10), (7000, 1, 1))
    raw = np.zeros((70000, 3, 4), "<f4")
    raw[..., :3] = points
    file = File(points[:65535:65534])
    file.header |= {"last": 65535}
    file.points = points[:1]
    file.residual = np.zeros((1, 3))
    for frames in (("i", [-1]), ("f", [70000.0])):
        file.groups["POINT"]["FRAMES"] = frames
        data = file.bytes()
        path = tmp_path / "long.c3d"
        path.write_bytes(data[: -len(file.data())] + raw.tobytes() + b"\0" * (-raw.nbytes % 512))
        found = read_c3d_markers(path)
        assert found.positions.shape == (70000, 3, 3)
        assert said(found.notes, "70000 frames by the file's size") == (frames[0] == "i")


def test_scales_that_contradict_each_other(tmp_path):
    with pytest.raises(FileFormatError, match=r"the scales contradict.*header -1, POINT:SCALE 0.1"):
        read_c3d_markers(File(SCALE=("f", [0.1])).at(tmp_path))
    found = read_c3d_markers(File(scale=0.05, SCALE=("f", [0.02])).at(tmp_path))
    assert said(found.notes, "0.05 is taken")
    file = File(scale=0.05, SCALE=("f", [np.nan]))
    file.header["scale"] = 0.0
    with pytest.raises(FileFormatError, match="no usable scale of the integers: header 0, POINT:SCALE nan"):
        read_c3d_markers(file.at(tmp_path))


def test_what_a_file_must_tell(tmp_path):
    with pytest.raises(FileFormatError, match="no POINT:LABELS"):
        read_c3d(File(LABELS=None).at(tmp_path))
    nothing = File(np.zeros((20, 0, 3)), [])
    with pytest.raises(FileFormatError, match="holds no points"):
        read_c3d(nothing.at(tmp_path))


def test_paths_that_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.c3d")
    for path in (tmp_path / "none.c3d", tmp_path, tmp_path / "pipe.c3d"):
        with pytest.raises(FileFormatError):
            read_c3d(path)


def mutated(whole, rng):
    """A file with a random fault: cut, flipped, overwritten, or with bytes too many or too few."""
    data, end = bytearray(whole), min(len(whole), 512 * (1 + whole[514]))
    kind = rng.integers(7)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        return bytes(data[: rng.integers(end + 600)])
    if kind in (5, 6):
        at, some = rng.integers(2, end), rng.integers(1, 40)
        data[at : at + (some if kind == 5 else 0)] = b"" if kind == 5 else rng.bytes(some)
        return bytes(data)
    for _ in range(rng.integers(1, 30 if kind == 4 else 4)):
        at = rng.integers(0, 24) if kind == 2 else rng.integers(512, end) if kind == 3 else rng.integers(end)
        data[at] = rng.choice([0, 1, 127, 128, 255, data[at] ^ (1 << rng.integers(8)), rng.integers(256)])
    return bytes(data)


def survive(files, count, folder, seed=0):
    """Read `count` mutations of the files; nothing but a `KinjaxError` may come of it. How many were refused."""
    rng, refused = np.random.default_rng(seed), 0
    path = folder / "mutated.c3d"
    for i in range(count):
        path.write_bytes(mutated(files[i % len(files)], rng))
        try:
            found = read_c3d_markers(path)
            assert np.isfinite(found.positions).all(-1).sum() == found.seen.sum() and found.positions.ndim == 3
            if i % 10 == 0:
                rigid_objects(found)
        except KinjaxError:
            refused += 1
    return refused


def test_mutations_are_read_or_refused(tmp_path):
    files = [File(processor=p, scale=s, analog=2).bytes() for p in ("Intel", "DEC", "MIPS") for s in (-1.0, 0.05)]
    assert 200 < survive(files, 600, tmp_path) < 600


def test_a_file_cut_anywhere_in_its_descriptions_or_data_is_refused(tmp_path):
    whole, path = File().bytes(), tmp_path / "cut.c3d"
    data = len(whole) - len(File().data()) + 20 * 48
    for length in range(0, data, 7):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError):
            read_c3d_markers(path)
    path.write_bytes(whole[:data])
    assert read_c3d_markers(path).positions.shape == (20, 3, 3)


# recordings -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def c3d(data):
    if not (data / "c3d").is_dir():
        pytest.skip(f"no C3D files in {data}")
    return data / "c3d"


@pytest.mark.parametrize("name", TRIALS)
def test_feet_are_those_of_the_force_plate_trials(c3d, name):
    trial = fp.load_trial(c3d / "forceplates" / f"{name}.npz")
    expected = fp.poses_of(trial.markers, trial.rate)
    found = read_c3d(c3d / "forceplates" / f"{name}.c3d").select(["left_foot", "right_foot"])
    assert found.rate == expected.rate and found.up == expected.up == "z"
    np.testing.assert_array_equal(found.valid, expected.valid)
    seen = expected.valid
    assert seen.any(0).all()
    assert np.abs(found.position - expected.position)[seen].max() < 1e-6
    assert np.abs(np.abs((found.rotation * expected.rotation).sum(-1)[seen]) - 1).max() < 1e-9


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("Gait", "left_foot right_foot pelvis thorax left_shank right_shank"),
        (
            "PiG_Motion-FlatFoot-Hole",
            "left_foot right_foot left_hand right_hand head pelvis thorax left_shank right_shank left_forearm right_forearm",
        ),
    ],
)
def test_body_parts_of_recordings(c3d, name, parts):
    poses = read_c3d(c3d / "forceplates" / f"{name}.c3d")
    assert poses.names == tuple(parts.split())
    height = {n: np.median(poses.position[poses.valid[:, i], i, 2]) for i, n in enumerate(poses.names)}
    assert 0.02 < height["left_foot"] < 0.2 < height["left_shank"] < 0.5 < height["pelvis"] < 1.1 < height["thorax"] < 1.5


def test_odd_recordings_are_read(c3d):
    found = {p.stem: read_c3d_markers(p) for p in sorted((c3d / "odd").glob("*.c3d"))}
    mips = found["MACsample"]  # POINT:SCALE would make a dwarf of the walker
    assert mips.positions.shape == (180, 33, 3) and mips.rate == 60 and said(mips.notes, "scales of the integers differ")
    shoulder = mips.positions[:, mips.labels.index("RSHO"), 2]
    assert 1.3 < np.nanmedian(shoulder) < 1.6
    assert found["badParameterOffset"].positions.shape == (111, 41, 3)
    assert said(found["badParameterOffset"].notes, "damaged parameters, not read: ANALOG:UNITS")
    assert found["bad_parameter_section"].positions.shape == (332, 45, 3)
    assert said(found["bad_parameter_section"].notes, "the data begin inside the parameters, in LABELS")
    poses, notes = rigid_objects(found["tennis_serve_gaps"])
    assert poses.objects == 13 and poses.valid[:, poses.index("right_upper_arm")].sum() == 947
    assert said(notes, "left_thigh is left out: only Derrick:LTHI, Derrick:LKNE")
    for name in ("badParameterOffset", "bad_parameter_section"):
        steps = np.linalg.norm(np.diff(found[name].positions, axis=0), axis=-1)
        assert np.median(steps[np.isfinite(steps)]) < 0.03  # markers move, they do not flicker
        seen = found[name].positions[found[name].seen]
        assert 0.5 < np.ptp(seen, axis=0).max() < 6.0


def test_a_second_reader_agrees(c3d):
    ezc3d = pytest.importorskip("ezc3d")
    for path in [*sorted((c3d / "forceplates").glob("*.c3d")), c3d / "odd" / "tennis_serve_gaps.c3d"]:
        other, found = ezc3d.c3d(str(path)), read_c3d_markers(path)
        point = other["parameters"]["POINT"]
        kinds = ("ANGLES", "FORCES", "MOMENTS", "POWERS")
        derived = {n for k in kinds if k in point for n in point[k]["value"]}
        at = [i for i, n in enumerate(point["LABELS"]["value"]) if n not in derived]
        expected = other["data"]["points"][:3].transpose(2, 1, 0)[:, at] * {"mm": 1e-3, "m": 1.0}[point["UNITS"]["value"][0]]
        assert [point["LABELS"]["value"][i] for i in at] == list(found.labels)
        assert found.rate == point["RATE"]["value"][0]
        np.testing.assert_allclose(found.positions, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("count", "frames"), [(3, 40), (300, 5)])
def test_what_a_second_writer_wrote(tmp_path, count, frames):
    ezc3d = pytest.importorskip("ezc3d")
    points = walking(frames, np.random.default_rng(0).normal(size=(count, 3)) * 100)
    labels = [f"M{i}" for i in range(count)]
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [120.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["data"]["points"] = np.concatenate([points.transpose(2, 1, 0), np.ones((1, count, frames))])
    file.write(str(tmp_path / "other.c3d"))
    found = read_c3d_markers(tmp_path / "other.c3d")
    assert found.labels == tuple(labels) and found.rate == 120
    np.testing.assert_allclose(found.positions, points / 1000, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_many_mutations_of_recordings(c3d, tmp_path):
    files = [p.read_bytes() for p in sorted(c3d.glob("*/*.c3d"))]
    assert 1000 < survive(files, 3000, tmp_path) < 2500
