"""BVH: what is read is what the file means, what cannot be read is refused with its place, what is written comes back."""

import contextlib
import itertools
import os
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kinjax.errors import FileFormatError, KinjaxError, OptionError, ShapeError
from kinjax.formats import load, parse_bvh, read_bvh, save, write_bvh
from kinjax.formats.bvh_units import infer_unit
from kinjax.formats.bvh_write import bvh_bytes
from kinjax.formats.euler import euler_to_quaternion, quaternion_to_euler, rotation_between
from kinjax.motion import Motion
from kinjax.skeleton import Skeleton, Topology

GOOD = """HIERARCHY
ROOT Hips
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Foot
  {
    OFFSET 0.0 -90.0 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 -5.0 15.0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
0.000000 90.000000 0.000000 1.500000 -2.250000 0.000000 0.500000 0.250000 -0.125000
1.000000 90.000000 0.250000 1.500000 -2.250000 3.125000 0.500000 0.250000 -0.125000
"""


def positions(motion: Motion) -> np.ndarray:
    """World positions (frames, joints + End Sites, 3) by quaternions."""
    t, s, where, turn = motion.skeleton.topology, motion.skeleton, [], []

    def act(q, v):
        u = 2 * np.cross(q[:, 1:], v)
        return v + q[:, :1] * u + np.cross(q[:, 1:], u)

    for j, p in enumerate(t.parents):
        q = motion.rotations[:, j]
        local = motion.translations[:, t.translated.index(j)] if j in t.translated else np.tile(s.offsets[j], (motion.frames, 1))
        if p >= 0:
            a, b = turn[p], q
            local = where[p] + act(a, local)
            w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdims=True)
            q = np.hstack([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])])
        where.append(local)
        turn.append(q)
    where += [where[p] + act(turn[p], np.tile(s.end_offsets[e], (motion.frames, 1))) for e, p in enumerate(t.end_parents)]
    return np.stack(where, axis=1)


def plain_positions(text: str, frames: list[int]) -> np.ndarray:
    """The same from the text of a file by other means: words, rotation matrices, one frame after the other; file units."""
    head, _, motion = text.partition("MOTION")
    words, numbers = head.split(), [float(x) for x in motion.split()[5:]]
    nodes, ends, stack, channels = [], [], [], 0
    for i, word in enumerate(words):
        if word in ("ROOT", "JOINT", "End"):
            (ends if word == "End" else nodes).append({"parent": stack[-1] if stack else None, "channels": []})
            opened = (ends if word == "End" else nodes)[-1]
        elif word == "{":
            stack.append(opened)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            stack[-1]["offset"] = np.array([float(x) for x in words[i + 1 : i + 4]])
        elif word == "CHANNELS":
            stack[-1]["channels"] = [(c, channels + n) for n, c in enumerate(words[i + 2 : i + 2 + int(words[i + 1])])]
            channels += int(words[i + 1])
    out = []
    for f in frames:
        row = numbers[f * channels : (f + 1) * channels]
        for n in (*nodes, *ends):
            local, turn = n["offset"].copy(), np.eye(3)
            for c, at in n["channels"]:
                i = "XYZ".index(c[0])
                if c.endswith("position"):
                    local[i] = row[at]
                else:
                    j, k = (i + 1) % 3, (i + 2) % 3
                    r, angle = np.eye(3), np.radians(row[at])
                    r[j, j] = r[k, k] = np.cos(angle)
                    r[k, j], r[j, k] = np.sin(angle), -np.sin(angle)
                    turn = turn @ r
            p = n["parent"]
            n["R"], n["p"] = (turn, local) if p is None else (p["R"] @ turn, p["p"] + p["R"] @ local)
        out.append([n["p"] for n in (*nodes, *ends)])
    return np.array(out)


def refused(text: str | bytes, *parts: str, line: int | None = None, column: int | None = None) -> None:
    with pytest.raises(FileFormatError) as e:
        parse_bvh(text if isinstance(text, bytes) else text.encode(), path="x.bvh")
    assert e.value.remedy and all(p in str(e.value) for p in parts), str(e.value)
    assert line is None or (e.value.line, e.value.column) == (line, column), str(e.value)


def real(data):
    return sorted((data / "bvh").rglob("*.bvh"))


# Reading


def test_a_good_file():
    m = parse_bvh(GOOD.encode(), path="folder/good.bvh")
    t = m.skeleton.topology
    assert (m.frames, m.joints, m.name, m.rate) == (2, 2, "good.bvh", 1 / 0.0083333)
    assert t.names == ("Hips", "Foot") and t.parents == (-1, 0) and t.translated == (0,)
    assert t.channels[1] == ("Zrotation", "Xrotation", "Yrotation") and t.end_parents == (1,) and t.end_names == ("",)
    assert m.translations.dtype == m.rotations.dtype == np.float64
    np.testing.assert_allclose(m.root, [[0, 0.9, 0], [0.01, 0.9, 0.0025]], atol=1e-15)
    np.testing.assert_allclose(m.skeleton.end_offsets, [[0, -0.05, 0.15]], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(m.rotations, axis=-1), 1, atol=1e-15)
    assert "0.01 m (cm" in m.notes[0] and len(m.notes) == 1


ODD = {
    "00_ok": "", "02_crlf": "", "04_tabs_motion": "", "06_trailing_space": "", "08_exponent": "", "14_no_final_newline": "",
    "38_frames_tab": "", "40_blank_lines": "", "42_comment_hash": "", "34_wrapped_frame": "8 lines", "46_nul_tail": "NUL",
    "20_end_site_named": "", "22_name_with_space": "", "24_name_utf8": "",
    "10_nan": (19, 57, "'nan'", "finite"), "12_frames_too_many_declared": (17, 9, "6", "36", "4 frames"),
    "16_dt_zero": (18, 13, "0 s"), "18_comma_decimals": (18, 13, "0,0083333", "point"),
    "36_missing_space_slimevr": (19, 29, "1.500000-2.250000", "space is missing"),
    "44_header_only": (16, 1, "before MOTION"), "48_ragged_row": (22, 65, "7 numbers", "9"),
}  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_odd_files_read_right_or_are_refused(data, name):
    path, expected = data / "odd_bvh" / f"{name}.bvh", ODD[name]
    if isinstance(expected, tuple):
        refused(path.read_bytes(), *expected[2:], line=expected[0], column=expected[1])
        return
    m, good = read_bvh(path), read_bvh(data / "odd_bvh" / "00_ok.bvh")
    np.testing.assert_array_equal(m.translations, good.translations)
    np.testing.assert_array_equal(m.rotations, good.rotations)
    assert m.rate == good.rate and len(m.notes) == 1 + bool(expected) and expected in m.notes[-1]


def test_odd_files_with_another_skeleton(data):
    odd = data / "odd_bvh"
    good = read_bvh(odd / "00_ok.bvh")
    assert read_bvh(odd / "20_end_site_named.bvh").skeleton.topology.end_names == ("LeftToe",)
    assert read_bvh(odd / "22_name_with_space.bvh").skeleton.names == ("Hips", "Left Foot")
    assert read_bvh(odd / "24_name_utf8.bvh").skeleton.names == ("Hips", "左足")
    six = read_bvh(odd / "26_six_channel_joints.bvh")
    assert six.skeleton.topology.translated == (0, 1)
    np.testing.assert_allclose(positions(six), positions(good), atol=1e-15)
    still = read_bvh(odd / "30_zero_channel_root.bvh")
    assert still.skeleton.topology.translated == (0,) and not still.translations.any()
    assert (still.rotations[:, 0] == [1, 0, 0, 0]).all()
    two = read_bvh(odd / "32_two_roots.bvh")
    assert two.skeleton.topology.parents == (-1, 0, -1, 2) and two.skeleton.topology.translated == (0, 2)
    np.testing.assert_array_equal(positions(two)[:, :2], positions(two)[:, 2:4])
    mixed = read_bvh(odd / "28_mixed_orders.bvh")
    angles = quaternion_to_euler(mixed.rotations[:, 1], "xyz")
    np.testing.assert_allclose(angles, [[0.5, 0.25, -0.125]] * 4, atol=1e-12)


def test_every_real_file_reads_and_comes_back(data):
    """Write, read, write is a fixed point, byte for byte; joints and End Sites return to 1e-6 m; the hierarchy stays."""
    assert len(real(data)) >= 30
    for path in real(data):
        m = read_bvh(path)
        first = bvh_bytes(m)
        again = parse_bvh(first)
        assert bvh_bytes(again) == first, path.name
        assert np.abs(positions(m) - positions(again)).max() < 1e-6, path.name
        assert again.skeleton.topology == m.skeleton.topology and again.rate == m.rate and again.notes[0] == m.notes[0]
        assert np.isclose(np.linalg.norm(m.rotations, axis=-1), 1, atol=1e-12).all()


@pytest.mark.parametrize(
    "name", ["cmu/10_01", "cmu/131_01", "exporters/bvh_example", "exporters/walk01", "exporters/AV_8Walk_Meredith_HVHA_Rep1",
             "exporters/custom_skeleton_walk_example", "exporters/bvh_test3", "exporters/Swagger"],
)  # fmt: skip
def test_positions_against_plain_matrices(data, name):
    path = data / "bvh" / f"{name}.bvh"
    m, frames = read_bvh(path, unit="m"), [0, 7, 40]
    np.testing.assert_allclose(positions(m)[frames], plain_positions(path.read_text(), frames), atol=1e-9)


@pytest.mark.parametrize("name", ["cmu/02_03", "exporters/test_mocapbank", "exporters/walk01"])
def test_positions_against_another_reader(data, name):
    bvh = pytest.importorskip("pymotion.io.bvh").BVH()
    skeleton = pytest.importorskip("pymotion.ops.skeleton")
    bvh.load(str(data / "bvh" / f"{name}.bvh"))
    rotations, places, parents, offsets, _, _ = bvh.get_data()
    expected, _ = skeleton.fk(rotations, places[:, 0], offsets * (np.arange(len(offsets)) > 0)[:, None], parents)
    m = read_bvh(data / "bvh" / f"{name}.bvh", unit="m")
    np.testing.assert_allclose(positions(m)[:, : m.joints], expected, atol=1e-5)  # file units; its angles are rounded


def test_two_conversions_of_one_motion_agree(data):
    """Other unit, other conventions, one frame more in front: the same body in the same place, to the digits of the files."""
    a = read_bvh(data / "bvh/cmu/01_01.bvh")
    b = read_bvh(data / "bvh/exporters/cgspeed_01_01.bvh")
    assert "0.01 m" in a.notes[0] and "(cmu" in b.notes[0] and b.frames == a.frames + 1
    pairs = {"root": "Hips", "ltibia": "LeftLeg", "lfoot": "LeftFoot", "rfoot": "RightFoot"}
    at, bt = ([m.skeleton.topology.index(n) for n in names] for m, names in ((a, pairs), (b, pairs.values())))
    assert np.abs(positions(a)[:, at] - positions(b)[1:, bt]).max() < 1e-5


def test_units(data):
    for path in real(data):  # people: with the inferred unit a rest pose, or arm span, of 1.1 to 2 m
        tall = float(read_bvh(path).notes[0].split("then ")[1].split()[0])
        assert 1.1 < tall < 2.0, path.name
    assert [infer_unit(h)[0] for h in (1.7, 170, 1700, 70, 30, 90)] == [1, 0.01, 0.001, 0.0254, 0.0254 / 0.45, 0.01]
    assert "assumed" in infer_unit(400)[1] and "no size" in infer_unit(0.0)[1]
    raw = GOOD.encode()
    for unit, scale in (("m", 1), ("MM", 1e-3), ("inch", 0.0254), (0.5, 0.5), ("cmu", 0.0254 / 0.45)):
        assert parse_bvh(raw, unit=unit).skeleton.offsets[1, 1] == -90 * scale
    assert parse_bvh(raw, up="z").skeleton.topology.up == "z"
    for wrong in ({"unit": "furlong"}, {"unit": 0.0}, {"unit": float("nan")}, {"up": "w"}):
        with pytest.raises(OptionError):
            parse_bvh(raw, **wrong)


def test_position_replaces_offset():
    text = GOOD.replace("CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS 2 Zposition Yrotation")
    text = text.replace("0.500000 0.250000 -0.125000", "7.000000 0.500000")
    m = parse_bvh(text.encode())
    assert m.skeleton.topology.translated == (0, 1)
    np.testing.assert_allclose(m.translations[:, 1], [[0, -0.9, 0.07]] * 2, atol=1e-15)
    stays = parse_bvh(GOOD.replace("OFFSET 0.0 0.0 0.0", "OFFSET 0 500 0").encode())
    assert any("replace its OFFSET" in n for n in stays.notes)


def test_tolerated_spellings():
    good = parse_bvh(GOOD.encode())

    def same(text: str | bytes, *notes: str) -> Motion:
        m = parse_bvh(text if isinstance(text, bytes) else text.encode())
        np.testing.assert_array_equal(m.rotations, good.rotations)
        np.testing.assert_array_equal(m.translations, good.translations)
        assert len(m.notes) == 1 + len(notes) and all(n in str(m.notes) for n in notes), m.notes
        return m

    head, numbers = GOOD[: GOOD.index("0.000000 90")], GOOD[GOOD.index("0.000000 90") :]
    same(b"\xef\xbb\xbf" + GOOD.encode())
    same(GOOD.replace("\n", "\r"))
    same(GOOD.replace("\n", "\r\n"))
    same(GOOD.lower().replace("hips", "Hips"))
    same(GOOD.upper())
    same(GOOD.replace("  ", "\t \t").replace(" ", "   "))
    same(" ".join(head.split("\n")).replace("Hips", "Hips\n").replace("Foot", "Foot\n").replace("Site", "Site\n") + "\n" + numbers)
    same(head.replace("\n{", " {") + numbers)
    same(head + numbers.replace("\n", " "), "2 frames stand on 1 lines")
    same(head + numbers.replace(" ", "\n"), "stand on 18 lines")
    same(head + "# a comment\n" + numbers + "// another, -1 -2\n", "comments")
    same(head.replace("MOTION", "# MOTION\n// ROOT {\nMOTION") + numbers)
    same(head.replace("Frames: 2\nFrame Time: 0.0083333", "FRAME  TIME :8.3333e-3 Frames\t:2") + numbers)
    same(head + numbers.replace("1.500000", "+1.5").replace("-2.250000", "-225e-2"))
    same(GOOD.rstrip("\n"))
    same(GOOD + "\x00" * 9, "NUL")
    same(GOOD + "\x1a", "end-of-file")
    same(GOOD.replace("Frames: 2", "Frames: 1"), "but 2 follow")
    same(GOOD[:-1].replace("250000", "25"), "no line end after the last number")
    assert same(GOOD.replace("Foot", "F\xfc\xdf").encode("latin-1"), "Latin-1").skeleton.names[1] == "Füß"


def test_names_that_repeat_are_numbered():
    joint = "JOINT A\n{\nOFFSET 0 1 0\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n"
    text = GOOD.replace("  JOINT Foot", joint + joint + joint.replace("T A", "T A_2") + "  JOINT Foot")
    m = parse_bvh(text.encode())
    assert m.skeleton.names == ("Hips", "A", "A_3", "A_2", "Foot") and "repeat" in m.notes[1]
    assert bvh_bytes(parse_bvh(bvh_bytes(m))) == bvh_bytes(m)


# Refusing


HEADER_FAULTS = [
    ("HIERARCHY", "HIERARCHI", 1, 1, "HIERARCHY"),
    ("ROOT Hips", "ROOT", 2, 1, "without a name"),
    ("{\n  OFFSET", "OFFSET", 3, 1, "should open"),
    ("-90.0 0.0\n", "-90.0\n", 9, 5, "number of OFFSET"),
    ("-90.0", "-90,0", 8, 16, "point"),
    ("-90.0", "nan", 8, 16, "'nan'"),
    ("-90.0", "1e400", 8, 16, "1e400"),
    ("-90.0", "0x10", 8, 16, "0x10"),
    ("    OFFSET 0.0 -90.0 0.0\n", "", 13, 3, "without OFFSET"),
    ("    OFFSET 0.0 -90.0 0.0\n", "    OFFSET 0 1 2\n    OFFSET 0 1 2\n", 9, 5, "second OFFSET"),
    ("CHANNELS 3", "CHANNELS 4", 10, 5, "channel 4 of 4"),
    ("CHANNELS 3", "CHANNELS 2", 9, 36, "one channel more"),
    ("CHANNELS 3", "CHANNELS 1000000", 9, 14, "0 to 6"),
    ("CHANNELS 3", "CHANNELS -1", 9, 14, "0 to 6"),
    ("Zrotation Xrotation Yrotation\n    End", "Zrotation Xrotation Zrotation\n    End", 9, 36, "twice"),
    ("Yrotation\n    End", "Wrotation\n    End", 9, 36, "Wrotation"),
    ("JOINT Foot", "ROOT Foot", 6, 3, "ROOT inside"),
    ("  }\n}\nMOTION", "  }\nMOTION", 15, 1, "closing brace"),
    ("  }\n}\nMOTION", "  }\n}\n}\nMOTION", 16, 1, "'}'"),
    ("End Site", "End Site\n{\nJOINT X", 12, 1, "End Site"),
    ("Frames: 2", "Frames: 2.5", 17, 9, "2.5"),
    ("Frames: 2", "Frames: -2", 17, 9, "-2"),
    ("Frames: 2", "Frames: 0", 17, 9, "1 or more"),
    ("Frames: 2", "Frames: " + "9" * 5000, 17, 9, "999"),
    ("Frames: 2\n", "", 18, 1, "'Frames:'"),
    ("Frame Time: 0.0083333\n", "", 18, 1, "'Frame Time:'"),
    ("0.0083333", "-0.0083333", 18, 13, "-0.0083333"),
    ("0.0083333", "nan", 18, 13, "nan"),
    ("0.0083333", "8.3333", 18, 13, "milliseconds"),
    ("0.0083333", "0.0001", 18, 13, "1000 frames"),
    ("0.0083333", "1e9", 18, 13, "1e+09"),
    ("Foot", "Fo\x01ot", 6, 3, "control"),
    ("OFFSET 0.0 -90.0 0.0", "OFFSET 0.0 -90.0 0.0 1.0", 8, 26, "three numbers"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "column", "part"), HEADER_FAULTS)
def test_header_faults_are_located(old, new, line, column, part):
    assert old in GOOD
    refused(GOOD.replace(old, new, 1), "x.bvh", part, line=line, column=column)


NUMBER_FAULTS = [
    *((word, 20, 57, word) for word in ("nan", "inf", "-Infinity", "NaN(ind)", "1.#QNAN", "1e400")),
    *((word, 20, 57, word) for word in ("0x10", "1_0", "1d5", "--1", "1e")),
    ("0,5", 20, 57, "point"), ("1.5-2.25", 20, 57, "space is missing"), ("٣", 20, 57, "plain"), ('"1"', 20, 57, "plain"),
    ("true", 20, 57, "plain"), ("\x01", 20, 57, "plain"), ("MOTION", 20, 57, "plain"),
    ("", 20, 76, "this line has 8 numbers"), ("1 2", 20, 70, "this line has 10 numbers"),
]  # fmt: skip


@pytest.mark.parametrize(("word", "line", "column", "part"), NUMBER_FAULTS)
def test_number_faults_are_located(word, line, column, part):
    at = GOOD.rindex("0.500000")
    refused(GOOD[:at] + word + GOOD[at + 8 :] + "0 0 0 0 0 0 0 0 0\n" * 3, part, line=line, column=column)


def feet(names):
    return [j for j, name in enumerate(names) if "foot" in name.casefold()]


def without_arms(change=lambda row: row, frames=9) -> bytes:
    """A figure of hips, arm and foot; `change` is made to the words of one frame: six of the hips, three of the arm, three of the
    foot."""
    more = "  JOINT Arm\n  {\n    OFFSET 1 1 0\n    CHANNELS 3 Zrotation Xrotation Yrotation\n  }\n"
    head = GOOD.replace("  JOINT Foot", more + "  JOINT Foot")
    head = head[: head.index("0.000000 90.0")].replace("Frames: 2", f"Frames: {frames}")
    rows = [[f"{i + k / 16:.4f}" for k in range(12)] for i in range(frames)]
    rows[frames // 2] = change(rows[frames // 2])
    return (head + "".join(" ".join(r) + "\n" for r in rows)).encode()


def test_only_some_joints(data):
    """They are what they are when all are read, whatever the file's spelling; the others are NaN."""
    for path in [*real(data), *(data / "odd_bvh" / f"{n}.bvh" for n in ("06_trailing_space", "08_exponent", "40_blank_lines"))]:
        whole, part = read_bvh(path), read_bvh(path, joints=feet)
        t, kept = whole.skeleton.topology, set()
        for j in feet(t.names):
            while j >= 0:
                kept.add(j)
                j = t.parents[j]
        for j in range(whole.joints):
            assert np.array_equal(part.rotations[:, j], whole.rotations[:, j]) or (j not in kept and np.isnan(part.rotations[:, j]).all())
        for n, j in enumerate(t.translated):
            a, b = part.translations[:, n], whole.translations[:, n]
            assert np.array_equal(a, b) if j in kept else np.isnan(a).all()
        assert (part.skeleton.topology, part.rate, part.notes[0]) == (t, whole.rate, whole.notes[0])


def arm(*words):
    return lambda row: [*row[:6], *words, *row[9:]]


@pytest.mark.parametrize("ending", ["\n", " \n", "\r\n"])
@pytest.mark.parametrize(
    "change",
    [arm("nan", "1", "2"), arm("1", "1,5", "2"), arm("1", "", "2"), arm("1", "x", "2"), arm("1", "--1", "2"), arm("1", "1-2", "3"),
     arm("1", "1e", "2"), arm("1", "1e999", "2"), arm("1", "2"), arm("1", "2", "3", "4"), arm("1", "\x00", "2"), arm("1.5-2.5", "3"),
     arm("", "1", "2"), arm("1", "2", ""), lambda row: [*row[:-1], ""], lambda row: ["", *row[1:]], lambda row: row[:6]],
)  # fmt: skip
def test_faults_in_joints_that_are_not_wanted(change, ending):
    """A number that nobody wants is not converted; that it is there, and looks like one, is known nevertheless."""
    raw = without_arms(change).replace(b"\n", ending.encode())
    said = []
    for joints in (None, feet):
        with pytest.raises(FileFormatError) as e:
            parse_bvh(raw, path="x.bvh", joints=joints)
        said.append(str(e.value))
    assert said[0] == said[1]
    for good in (without_arms(), without_arms(arm("1e1", "+2", "-.5")), without_arms(arm("1", "2", "3"), frames=1)):
        good = good.replace(b"\n", ending.encode())
        whole, part = parse_bvh(good), parse_bvh(good, joints=feet)
        assert np.array_equal(whole.rotations[:, 2], part.rotations[:, 2]) and np.isnan(part.rotations[:, 1]).all()


def test_wrong_counts():
    last = GOOD.splitlines()[-1]
    refused(GOOD.replace("Frames: 2", "Frames: 3"), "27 numbers, but 18 follow, 2 frames", line=17, column=9)
    refused(GOOD + last + "\n" + last + "\n", "36 follow, 4 frames", line=17, column=9)
    refused(GOOD[: -len(last) - 1], "9 follow", line=17, column=9)
    # The count is right, but one row gave a number to the next: no line of a file says where a frame begins.
    moved = GOOD.replace("-0.125000\n1.000000", "-0.125000 1.000000\n")
    refused(moved, "this line has 10 numbers, a frame has 9", line=19, column=85)
    refused(GOOD.replace("CHANNELS 6", "CHANNELS 0 #").replace("CHANNELS 3", "CHANNELS 0 #"), "no joint has a channel")
    began = time.perf_counter()
    refused(GOOD.replace("Frames: 2", "Frames: 1000000000"), "9000000000 numbers, but 18 follow", line=17, column=9)
    refused(GOOD.replace("Frames: 2", "Frames: 100000"), "100000", line=17, column=9)
    assert time.perf_counter() - began < 1


def test_nesting_has_a_limit():
    def nested(depth: int) -> bytes:
        joint = b"{ OFFSET 0 1 0 CHANNELS 1 Xrotation "
        inner = b"\n".join(b"JOINT j%d " % i + joint for i in range(1, depth))
        row = b" ".join([b"1"] * depth)
        return b"HIERARCHY ROOT r " + joint + inner + b"}" * depth + b" MOTION Frames: 1 Frame Time: 0.01\n" + row + b"\n"

    deep = parse_bvh(nested(256))
    assert deep.joints == 256 and bvh_bytes(parse_bvh(bvh_bytes(deep))) == bvh_bytes(deep)
    for depth in (257, 5000, 200_000):
        refused(nested(depth), "256", line=256, column=1)


def test_what_is_no_text_file(tmp_path, data):
    def no(path, part):
        with pytest.raises(FileFormatError, match=part) as e:
            read_bvh(path)
        assert str(path) in str(e.value) or "\\x00" in str(e.value)
        assert e.value.remedy

    no(tmp_path / "missing.bvh", "no such file")
    no(tmp_path, "a folder")
    no(tmp_path / "a\x00b.bvh", "file name")
    no(tmp_path / ("n" * 300), "too long")
    os.mkfifo(tmp_path / "pipe.bvh")
    no(tmp_path / "pipe.bvh", "a pipe")
    (tmp_path / "loop.bvh").symlink_to(tmp_path / "loop.bvh")
    no(tmp_path / "loop.bvh", "loop")
    no("/dev/zero", "a device")
    for name, content, part in (
        ("empty", b"", "empty"),
        ("blank", b" \n\x00", "empty"),
        ("only a byte-order mark", b"\xef\xbb\xbf", "empty"),
        ("a byte-order mark and blanks", b"\xef\xbb\xbf \r\n\x00", "empty"),
        ("only an end-of-file character", b"\n\x1a", "empty"),
        ("utf16", GOOD.encode("utf-16"), "UTF-16"),
        ("be", GOOD.encode("utf-16-be"), "UTF-16"),
        ("binary", bytes(range(256)) * 8, "UTF-16|binary"),
        ("zip", b"PK\x03\x04\x00\x00\x01", "binary"),
        ("text", b"name,x\na,1\n", "HIERARCHY"),
    ):
        (tmp_path / f"{name}.bvh").write_bytes(content)
        no(tmp_path / f"{name}.bvh", part)
    (tmp_path / "a.link").symlink_to(data / "odd_bvh" / "00_ok.bvh")
    assert read_bvh(tmp_path / "a.link").frames == 4


def test_truncation_is_never_taken_for_the_whole(data):
    """Cut anywhere: refused, or all values are there (then only line ends were cut), or a note says what cannot be known."""
    files = [
        (data / "odd_bvh/00_ok.bvh", 1), (data / "odd_bvh/32_two_roots.bvh", 5), (data / "odd_bvh/08_exponent.bvh", 5),
        (data / "bvh/exporters/akjava_single_frame_pose.bvh", 11), (data / "bvh/exporters/walk01.bvh", 997),
        (data / "bvh/exporters/bvh_test2.bvh", 797), (data / "bvh/exporters/example.bvh", 1009),
    ]  # fmt: skip
    for path, stride in files:
        raw, whole = path.read_bytes(), read_bvh(path)
        for cut in [*range(0, len(raw), stride), *range(max(len(raw) - 40, 0), len(raw))]:
            try:
                m = parse_bvh(raw[:cut])
            except FileFormatError as e:
                assert e.remedy and (e.line is not None or "empty" in str(e))
                continue
            flagged = any("no line end" in n for n in m.notes)
            assert flagged or (np.array_equal(m.rotations, whole.rotations) and m.frames == whole.frames), (path.name, cut)
            assert m.frames == whole.frames


WORDS = [
    "HIERARCHY", "ROOT a", "JOINT b", "End Site", "{", "}", "OFFSET 0 1 0", "OFFSET", "CHANNELS 1 Xrotation", "CHANNELS 0",
    "MOTION", "Frames: 1", "Frames: 99999999999", "Frame Time: 0.01", "1", "-2.5e3", "nan", "1e999", "\n", "\r", "\x00", "#",
    "é", "}" * 9, "{ OFFSET 0 1 0 CHANNELS 1 Yrotation } MOTION Frames: 1 Frame Time: 0.01",
]  # fmt: skip


@settings(max_examples=150, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from(WORDS), max_size=25))
def test_fuzz_of_words(words):
    for text in (" ".join(words), "HIERARCHY ROOT a\n{" + " ".join(words)):
        with contextlib.suppress(KinjaxError):
            bvh_bytes(parse_bvh(text.encode()))


@settings(max_examples=300, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(st.integers(0, len(GOOD)), st.integers(0, 6), st.binary(max_size=5)), max_size=4), st.binary(max_size=30))
def test_fuzz_of_edits(edits, junk):
    raw = GOOD.encode()
    for at, drop, insert in edits:
        raw = raw[:at] + insert + raw[at + drop :]
    for candidate in (raw, junk, raw[:300] + junk):
        try:
            m = parse_bvh(candidate)
        except KinjaxError:
            continue
        assert np.isfinite(m.rotations).all() and np.isfinite(m.translations).all()


# Writing


def made(channels, rotations, translations=None, **kw) -> Motion:
    """A root with six channels and one joint with the given ones."""
    six = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    moving = (0, 1) if any(c.endswith("position") for c in channels) else (0,)
    t = Topology(("root", "arm"), (-1, 0), (six, tuple(channels)), moving, (1,), ("",))
    s = Skeleton(np.array([[0, 0, 0], [0, 1.0, 0]]), np.array([[0, 0.7, 0.0]]), t)
    q = np.stack([np.broadcast_to([1.0, 0, 0, 0], rotations.shape), rotations], axis=1)
    return Motion(np.zeros((len(q), len(moving), 3)) if translations is None else translations, q, s, kw.get("rate", 120.0), "made")


def test_euler_all_orders_with_gimbal_lock():
    """Angles there and back, at, near and across the lock; those of a file give themselves again, digit for digit."""
    rng = np.random.default_rng(0)
    n = 600
    for axes in map("".join, itertools.permutations("xyz")):
        for smooth in (False, True):
            a, c = (np.cumsum(rng.normal(0, 3, n)) if smooth else rng.uniform(-400, 400, n) for _ in range(2))
            near = rng.choice([0, 1e-7, 3e-6, 5e-6, 6e-6, 1e-5, 1e-3, 1, 30], n) * rng.choice([-1, 1], n)
            b = 90 + np.cumsum(rng.normal(0, 2, n)) if smooth else rng.choice([-90, 90], n) + near
            for x in (a, b, c):
                x[::5] = np.round(x[::5] / 90) * 90
            q = euler_to_quaternion(np.stack([a, b, c], axis=-1), axes)
            for digits in (6, 3):
                once = np.round(quaternion_to_euler(q, axes, digits), digits)
                back = euler_to_quaternion(once, axes)
                assert rotation_between(back, q).max() < (3e-7 if digits == 6 else 3e-5)
                np.testing.assert_array_equal(np.round(quaternion_to_euler(back, axes, digits), digits), once)
                if smooth and digits == 6:
                    steady = np.abs(np.cos(np.radians(b))) > 0.2  # away from the lock, small motions are small steps
                    quiet = steady[1:] & steady[:-1] & (np.arange(1, n) % 5 > 1)
                    assert np.abs(np.diff(once, axis=0))[quiet].max() < 120


def test_shorter_channel_lists():
    rng = np.random.default_rng(1)
    for length in (0, 1, 2):
        for axes in map("".join, itertools.permutations("xyz", length)):
            angles = np.cumsum(rng.normal(0, 40, (300, length)), axis=0)
            channels = [f"{a.upper()}rotation" for a in axes]
            m = made(channels, euler_to_quaternion(angles, axes))
            first = bvh_bytes(m)
            again = parse_bvh(first, unit="cm")
            assert bvh_bytes(again) == first and again.skeleton.topology.channels[1] == tuple(channels)
            assert np.abs(positions(again) - positions(m)).max() < 1e-6
            if length:
                other = euler_to_quaternion(np.full((4, 1), 30.0), next(a for a in "xyz" if a not in axes))
                with pytest.raises(OptionError, match=r"'arm' turns by 30 degrees \(frame 0\)"):
                    bvh_bytes(made(channels, other))


def test_positions_without_a_channel_are_refused():
    q = np.tile([1.0, 0, 0, 0], (3, 1))
    t = np.zeros((3, 2, 3))
    t[:, 1] = [0, 1, 0]
    t[2, 1, 2] = 0.25
    assert parse_bvh(bvh_bytes(made(["Zposition"], q, t)), unit="cm").translations[2, 1, 2] == 0.25
    with pytest.raises(OptionError, match=r"'arm' moves by 0.25 m along its Z axis \(frame 2\).*Zposition"):
        bvh_bytes(made(["Xposition", "Yrotation"], q, t))


def test_writing_units_rates_precision(tmp_path):
    m = parse_bvh(GOOD.encode())
    for unit, word in (("same", "-90.000000"), ("m", "-0.90000000"), ("mm", "-900.000000"), (0.9, "-1.00000000")):
        path = write_bvh(tmp_path / "a.bvh", m, unit=unit)
        text = path.read_text()
        assert f"OFFSET 0.{'0' * (len(word.split('.')[1]))} {word} " in text and "Frame Time: 0.0083333\n" in text
        back = read_bvh(path, unit="cm" if unit == "same" else unit)
        assert np.abs(positions(back) - positions(m)).max() < 1e-6 and back.rate == m.rate
    assert read_bvh(write_bvh(tmp_path / "a.bvh", m, digits=2)).frames == 2
    single = Motion(np.float32(m.translations), np.float32(m.rotations), m.skeleton, np.float32(m.rate), notes=m.notes)
    assert "Frame Time: 0.0083333\n" in bvh_bytes(single).decode()
    still = np.tile([1.0, 0, 0, 0], (2, 1))
    for rate in (120.0, 24.0, 1000.0, 1.0, 60.0, 1 / 0.0083333, 1 / 0.0416667):
        assert parse_bvh(bvh_bytes(made([], still, rate=rate))).rate == rate
    first = bvh_bytes(made([], still, rate=29.97))  # which no number has as its inverse
    assert abs(parse_bvh(first).rate - 29.97) < 1e-14 and bvh_bytes(parse_bvh(first)) == first
    bare = Topology(("a", "b", "c"), (-1, 0, 0), (), (0,), (2, 1), ("", "tip"))
    m = Motion(np.ones((2, 1, 3)), np.tile([1.0, 0, 0, 0], (2, 3, 1)), Skeleton(np.ones((3, 3)), np.ones((2, 3)), bare), 30.0)
    t = parse_bvh(bvh_bytes(m)).skeleton.topology
    assert [len(c) for c in t.channels] == [6, 3, 3] and t.end_names == ("tip", "")


def test_joints_out_of_file_order():
    """Children of different joints may alternate in a topology; a file lists each joint's descendants together."""
    t = Topology(("r", "a", "b", "a1", "b1"), (-1, 0, 0, 1, 2))
    q = np.random.default_rng(2).normal(size=(4, 5, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    m = Motion(np.ones((4, 1, 3)), q, Skeleton(np.random.default_rng(3).normal(size=(5, 3)), np.zeros((0, 3)), t), 60.0)
    again = parse_bvh(bvh_bytes(m), unit="cm")
    assert again.skeleton.names == ("r", "a", "a1", "b", "b1")
    np.testing.assert_allclose(positions(again), positions(m)[:, [0, 1, 3, 2, 4]], atol=1e-6)


def test_what_cannot_be_written_is_refused(tmp_path):
    q = np.tile([1.0, 0, 0, 0], (3, 1))
    bad = q.copy()
    bad[1, 2] = np.nan
    with pytest.raises(OptionError, match="'arm' at frame 1 is not finite"):
        bvh_bytes(made([], bad))
    with pytest.raises(OptionError, match="length 2"):
        bvh_bytes(made([], 2 * q))
    for rate in (0.0, -1.0, 2000.0, float("nan")):
        with pytest.raises(OptionError, match="rate"):
            bvh_bytes(made([], q, rate=rate))
    with pytest.raises(OptionError, match="digits"):
        bvh_bytes(made([], q), digits=0)
    m = made([], q)
    batch = Motion(m.translations[None], m.rotations[None], m.skeleton, 120.0)
    with pytest.raises(ShapeError):
        bvh_bytes(batch)
    for name in ("a{", "a\nb", " a", ""):
        t = Topology(("r", name), (-1, 0))
        with pytest.raises(OptionError, match="name"):
            bvh_bytes(Motion(m.translations, m.rotations, Skeleton(m.skeleton.offsets, np.zeros((0, 3)), t), 120.0))
    with pytest.raises(OptionError, match="no folder"):
        write_bvh(tmp_path / "no" / "a.bvh", m)
    with pytest.raises(OptionError, match="no regular file"):
        write_bvh(tmp_path, m)
    (tmp_path / "keep.bvh").write_text("old")
    with pytest.raises(OptionError):
        write_bvh(tmp_path / "keep.bvh", made([], bad))
    assert (tmp_path / "keep.bvh").read_text() == "old" and os.listdir(tmp_path) == ["keep.bvh"]


def test_load_and_save_by_suffix(tmp_path, data):
    m = load(data / "odd_bvh/00_ok.bvh", unit="mm")
    assert load(save(tmp_path / "a.BVH", m)).frames == 4
    np.testing.assert_array_equal(load(save(tmp_path / "a.npz", m)).rotations, m.rotations)
    with pytest.raises(FileFormatError, match=r"'\.fbx'.*\.bvh, .*\.npz"):
        load(tmp_path / "a.fbx")
    with pytest.raises(OptionError, match=r"'\.fbx'"):
        save(tmp_path / "a.fbx", m)
