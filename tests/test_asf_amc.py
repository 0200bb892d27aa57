"""ASF/AMC: what is read is what the file means, checked against a literal reading and against the same motion in BVH; what
cannot be read is refused with its place; nothing is cut, missing or wrong in silence."""

import contextlib
import os
import re
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kinjax import forward_kinematics
from kinjax.errors import FileFormatError, KinjaxError, OptionError
from kinjax.formats import load, parse_bvh, read_amc, read_asf, read_bvh, write_bvh
from kinjax.formats.asf_amc import find_asf, parse_amc, parse_asf
from kinjax.formats.asf_frames import _quick
from kinjax.formats.bvh_write import bvh_bytes
from kinjax.skeleton import Skeleton

ASF = """# a small skeleton
:version 1.10
:name SMALL
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
   two lines of text
   length of 99
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name thigh
     direction 0.34202 -0.939693 0
     length 7.5
     axis 0 0 20  XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-inf inf)
  end
  begin
     id 2
     name shin
     direction 0 -1 0
     length 7.25
     axis -90 0 20 XYZ
    dof rx
    limits (-10.0 170.0)
  end
  begin
     id 3
     name toe
     direction 0 0 1
     length 2
     axis 0 0 0 XYZ
  end
  begin
     id 4
     name spine
     direction 0 1 0
     length 12
     axis 0 0 0 XYZ
    dof rz rx
    limits (-10.0 170.0)
    (-10.0 170.0)
  end
:hierarchy
  begin
    root thigh spine
    thigh shin
    shin toe
  end
"""

AMC = """#!OML:ASF C:\\small.ASF
:FULLY-SPECIFIED
:DEGREES
1
root 1.5 16.25 -3 10.5 -20.25 30
thigh 10 -20 30.5
shin -45.25
spine 5 15
2
root 1.75 16.5 -3 10.5 -20.25 31
thigh 11 -21 -1.5e-014
shin 45.5
spine 5.25 15
3
root 2 16.75 -3 10.5 -20.25 32
thigh 12 -22 30.25
shin 46.75
spine 5.5 15
"""

SMALL = parse_asf(ASF.encode())


# A literal reading, with nothing of the package: words, 4x4 matrices, bone by bone.


def turn(axis: str, degrees: float) -> np.ndarray:
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    m, angle = np.eye(4), np.radians(degrees)
    m[j, j] = m[k, k] = np.cos(angle)
    m[k, j], m[j, k] = np.sin(angle), -np.sin(angle)
    return m


def shift(x: float, y: float, z: float) -> np.ndarray:
    m = np.eye(4)
    m[:3, 3] = x, y, z
    return m


def literal_bones(asf: str) -> tuple[dict, dict, float, float]:
    """Bones and root by name, children, metres and degrees in one unit of the file."""
    bones, children, bone, section = {}, {"root": []}, None, ""
    for line in asf.replace("(", " ").replace(")", " ").splitlines():
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            section = words[0]
            if section == ":root":
                bone = bones["root"] = {"direction": [0, 0, 0], "length": 0}
            continue
        key, values = words[0], words[1:]
        if section == ":units" and key in ("length", "angle"):
            if key == "length":
                meter = 0.0254 / float(values[0])
            else:
                degree = 1 if values[0] == "deg" else 180 / np.pi
        elif section == ":bonedata" and key == "begin":
            bone = {}
        elif section == ":bonedata" and key == "name":
            bones[values[0]], children[values[0]] = bone, []
        elif section in (":bonedata", ":root"):
            if key in ("direction", "position", "orientation"):
                bone[key] = [float(x) for x in values]
            elif key == "length":
                bone[key] = float(values[0])
            elif key in ("dof", "order"):
                bone["dof"] = [x.lower() for x in values]
            elif key == "axis":
                bone["angles"], bone["letters"] = [float(x) for x in values[:-1]], values[-1].lower()
        elif section == ":hierarchy" and key not in ("begin", "end"):
            children[key] += values
    return bones, children, meter, degree


def literal_positions(asf: str, amc: str) -> dict[str, np.ndarray]:
    """(frames, 2, 3) of each bone: its start and its end, metres."""
    bones, children, meter, degree = literal_bones(asf)
    frames = []
    for line in amc.splitlines():
        words = line.split("#")[0].split()
        if not words or words[0].startswith(":"):
            continue
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        else:
            frames[-1][words[0]] = [float(x) for x in words[1:]]
    amc_degree = 180 / np.pi if ":RADIANS" in amc else 1
    out = {name: [] for name in bones}
    for frame in frames:
        stack = [("root", np.eye(4))]
        while stack:
            name, above = stack.pop()
            bone = bones[name]
            rotation, movement = np.eye(4), np.zeros(3)
            for dof, value in zip(bone.get("dof", []), frame.get(name, []), strict=True):
                if dof[0] == "r":
                    rotation = turn(dof[1], value * amc_degree) @ rotation  # the first listed turns first
                else:
                    movement["xyz".index(dof[1])] += value * meter
            axes = np.eye(4)
            angles = bone["orientation"] if name == "root" else bone["angles"]
            for letter in bone["letters"]:
                axes = turn(letter, angles["xyz".index(letter)] * degree) @ axes
            if name == "root":
                here = shift(*np.multiply(bone["position"], meter)) @ axes @ shift(*movement) @ rotation
            else:
                here = above @ axes @ shift(*movement) @ rotation @ np.linalg.inv(axes)
            end = here @ shift(*np.multiply(bone["direction"], bone["length"] * meter))
            out[name].append([here[:3, 3], end[:3, 3]])
            stack += [(child, end) for child in children[name]]
    return {name: np.array(x) for name, x in out.items()}


def matrices(q: np.ndarray) -> np.ndarray:
    w, (x, y, z) = q[..., 0], (q[..., n] for n in (1, 2, 3))
    return np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
         2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1
    ).reshape(*q.shape[:-1], 3, 3)  # fmt: skip


def positions(motion) -> np.ndarray:
    """World positions (frames, joints + End Sites, 3)."""
    t, s, local = motion.skeleton.topology, motion.skeleton, matrices(motion.rotations)
    where, turns = [], []
    for j, p in enumerate(t.parents):
        step = motion.translations[:, t.translated.index(j)] if j in t.translated else np.tile(s.offsets[j], (motion.frames, 1))
        above = turns[p] if p >= 0 else np.tile(np.eye(3), (motion.frames, 1, 1))
        where.append((where[p] if p >= 0 else 0) + np.einsum("fij,fj->fi", above, step))
        turns.append(above @ local[:, j])
    where += [where[p] + turns[p] @ s.end_offsets[e] for e, p in enumerate(t.end_parents)]
    return np.stack(where, axis=1)


def against_literal(motion, asf: str, amc: str) -> float:
    """Largest distance of a joint or End Site from the literal reading, metres."""
    expected, t = literal_positions(asf, amc), motion.skeleton.topology
    starts = [expected[name][:, 0] for name in t.names]
    ends = [expected[t.names[p]][:, 1] for p in t.end_parents]
    return float(np.abs(positions(motion) - np.stack([*starts, *ends], axis=1)).max())


def made(rng: np.random.Generator, bones: int, plain: bool) -> str:
    """The text of a random skeleton; not `plain`: any order, subset, unit, preset of the root."""
    order = (lambda: "".join(rng.permutation(list("XYZ")))) if not plain else lambda: "XYZ"
    degrees = plain or rng.random() < 0.5

    def three(size: float) -> str:
        return " ".join(f"{x:.6f}" for x in rng.normal(size=3) * size)

    angle = 60 if degrees else 1
    root = ["TX", "TY", "TZ", "RX", "RY", "RZ"]
    root = root if plain else list(rng.permutation(root))[: rng.integers(1, 7)]
    lines = [":version 1.10", ":name made", ":units", f"length {0.45 if plain else rng.uniform(0.3, 2):.4f}"]
    lines += [f"angle {'deg' if degrees else 'rad'}", ":root", f"order {' '.join(root)}", f"axis {order()}"]
    lines += [f"position {three(0 if plain else 3)}", f"orientation {three(0 if plain else angle)}", ":bonedata"]
    links = {}
    for n in range(bones):
        kinds = "rx ry rz" if plain else "tx ty tz rx ry rz"
        dof = list(rng.permutation(kinds.split()))[: rng.integers(0, 4 if plain else 7)]
        dof = sorted(dof) if plain else dof
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        lines += ["begin", f"id {n + 1}", f"name b{n}", f"direction {' '.join(f'{x:.9f}' for x in direction)}"]
        lines += [f"length {rng.uniform(0, 9):.5f}", f"axis {three(angle)} {order()}", *(["dof " + " ".join(dof)] if dof else [])]
        lines += ["end"]
        links.setdefault(rng.choice(["root", *(f"b{i}" for i in range(n))]), []).append(f"b{n}")
    lines += [":hierarchy", "begin", *(" ".join([p, *c]) for p, c in rng.permutation(np.array([*links.items(), 0], object)[:-1])), "end"]
    return "\n".join(lines) + "\n"


def played(rng: np.random.Generator, asf: str, frames: int, radians: bool = False, shuffled: bool = False) -> str:
    """The text of random motion for a skeleton."""
    bones = [(name, bone["dof"]) for name, bone in literal_bones(asf)[0].items() if bone.get("dof")]
    lines = [":FULLY-SPECIFIED", ":RADIANS" if radians else ":DEGREES"]
    for f in range(frames):
        lines.append(str(f + 1))
        if f == 0 or shuffled:
            rng.shuffle(bones)
        for name, dof in bones:
            values = [rng.normal() * (5 if d[0] == "t" else 2 if radians else 100) for d in dof]
            lines.append(" ".join([name, *(f"{x:.12g}" for x in values)]))
    return "\n".join(lines) + "\n"


def refused(amc: str | bytes, *parts: str, asf: str = "", line: int | None = None, column: int | None = None) -> None:
    """The AMC with the small skeleton is refused; or the ASF is, where one is given."""
    with pytest.raises(FileFormatError) as e:
        if asf:
            parse_asf(asf.encode(), path="x.asf")
        parse_amc(amc if isinstance(amc, bytes) else amc.encode(), SMALL, path="x.amc")
    assert e.value.remedy and all(p in str(e.value) for p in (*parts, "x.asf" if asf else "x.amc")), str(e.value)
    assert line is None or (e.value.line, e.value.column) == (line, column), str(e.value)


# Reading


def test_a_small_pair():
    m = parse_amc(AMC.encode(), SMALL, path="folder/small_01.amc")
    t, unit = m.skeleton.topology, 0.0254 / 0.45
    assert type(m.skeleton) is Skeleton and m.skeleton.limits is None and m.skeleton.masses is None
    assert (m.frames, m.joints, m.name, m.rate) == (3, 5, "small_01.amc", 120.0)
    assert t.names == ("root", "thigh", "shin", "toe", "spine") and t.parents == (-1, 0, 1, 2, 0) and t.translated == (0,)
    assert t.channels[0] == ("Xposition", "Yposition", "Zposition", "Zrotation", "Yrotation", "Xrotation")
    assert t.channels[3] == ("Zrotation", "Yrotation", "Xrotation") and t.end_parents == (3, 4) and t.up == "y"
    assert m.translations.dtype == m.rotations.dtype == np.float64
    np.testing.assert_allclose(m.root[1], np.array([1.75, 16.5, -3]) * unit, atol=1e-15)
    np.testing.assert_allclose(m.skeleton.offsets[2], np.array([0.34202, -0.939693, 0]) * 7.5 * unit, atol=1e-15)
    np.testing.assert_allclose(m.skeleton.offsets[[1, 4]], 0, atol=0)
    np.testing.assert_allclose(m.skeleton.end_offsets, np.array([[0, 0, 2], [0, 12, 0]]) * unit, atol=1e-15)
    np.testing.assert_allclose(m.skeleton.segment_centers()[1], m.skeleton.offsets[2] / 2, atol=1e-15)
    np.testing.assert_allclose(m.rotations[:, 3], [[1, 0, 0, 0]] * 3, atol=0)
    np.testing.assert_allclose(np.linalg.norm(m.rotations, axis=-1), 1, atol=1e-14)
    assert against_literal(m, ASF, AMC) < 1e-13
    assert len(m.notes) == 5 and all(
        part in note
        for part, note in zip(("(cmu, ", "120 frames", "the skeleton", "limits are not used", "order of dof"), m.notes, strict=True)
    )


def test_against_the_literal_reading():
    """Random skeletons and motion, with every order and subset of degrees of freedom: the same places, to rounding."""
    rng = np.random.default_rng(5)
    kinds = set()
    for n in range(60):
        asf = made(rng, int(rng.integers(1, 9)), plain=n % 3 == 0)
        amc = played(rng, asf, 5, radians=n % 2 == 1, shuffled=n % 5 == 0)
        skeleton = parse_asf(asf.encode())
        m = parse_amc(amc.encode(), skeleton)
        assert against_literal(m, asf, amc) < 1e-11, asf
        assert not any("length of" in note for note in m.notes)
        kinds.update(m.skeleton.topology.translated[1:], ("turned",) if any("moved and turned" in x for x in m.notes) else ())
        again = parse_bvh(bvh_bytes(m, unit="cm"), unit="cm")
        assert np.abs(positions(again) - positions(m)).max() < 1e-6
        assert again.skeleton.topology == m.skeleton.topology
    assert "turned" in kinds and len(kinds) > 3


def test_quick_and_slow_agree(monkeypatch):
    rng = np.random.default_rng(6)
    for _ in range(10):
        asf = made(rng, 6, plain=False)
        amc, skeleton = played(rng, asf, 7), parse_asf(asf.encode())
        assert _quick(amc.encode(), amc.index("\n1\n") + 1, skeleton.reading.nodes) is not None
        quick = parse_amc(amc.encode(), skeleton)
        with monkeypatch.context() as patch:
            patch.setattr("kinjax.formats.asf_frames._quick", lambda *_: None)
            slow = parse_amc(amc.encode(), skeleton)
        np.testing.assert_array_equal(quick.rotations, slow.rotations)
        np.testing.assert_array_equal(quick.translations, slow.translations)


@pytest.mark.parametrize("take", ["02_01", "02_03", "49_20"])
def test_against_the_same_take_in_bvh(data, take, x64):
    """Frame i is frame i, the origin and the joints are the same; the BVH has angles to 1e-4 degrees and centimetres, so the
    longest chain (eight joints, 1.5 m) ends within 10 micrometres (3.3 measured)."""
    m, b = load(data / "asfamc" / f"{take}.amc"), read_bvh(data / "bvh" / "cmu" / f"{take}.bvh")
    assert m.frames == b.frames and m.skeleton.topology == b.skeleton.topology
    assert np.abs(m.skeleton.offsets - b.skeleton.offsets).max() < 1e-8  # six decimals of a centimetre
    assert np.abs(m.root - b.root).max() < 0.6e-6  # four
    assert np.linalg.norm(positions(m) - positions(b), axis=-1).max() < 1e-5
    turned, placed = (np.asarray(x) for x in forward_kinematics(m))
    np.testing.assert_allclose(placed, positions(m)[:, : m.joints], atol=1e-12)
    other = np.asarray(forward_kinematics(b)[0])
    assert np.abs(np.abs((turned * other).sum(-1)) - 1).max() < 1e-10
    assert len(m.notes) == 4 and m.rate == 120.0 and take[:2] in m.notes[2]


def test_real_files_against_the_literal_reading(data):
    asf = (data / "asfamc/49.asf").read_text()
    lines = (data / "asfamc/49_20.amc").read_text().splitlines()
    begins = [n for n, line in enumerate(lines) if line.strip().isdigit()]
    some = "\n".join([":DEGREES", *lines[begins[0] : begins[2]], *lines[begins[400] : begins[403]]])
    m = read_amc(data / "asfamc/49_20.amc")
    pick = [0, 1, 400, 401, 402]
    expected = literal_positions(asf, some)
    for j, name in enumerate(m.skeleton.names):
        np.testing.assert_allclose(positions(m)[pick, j], expected[name][:, 0], atol=1e-12)


def test_written_as_bvh_and_read_again(data, tmp_path):
    for take in ("02_01", "49_20"):
        m = read_amc(data / "asfamc" / f"{take}.amc")
        for unit in ("same", "cm"):
            again = read_bvh(write_bvh(tmp_path / "a.bvh", m, unit=unit))
            assert np.abs(positions(again) - positions(m)).max() < 1e-6
            assert again.skeleton.topology == m.skeleton.topology and again.rate == m.rate


def test_tolerated_spellings():
    good = parse_amc(AMC.encode(), SMALL)

    def same(text: str | bytes, *notes: str, skeleton=SMALL):
        m = parse_amc(text if isinstance(text, bytes) else text.encode(), skeleton)
        np.testing.assert_array_equal(m.rotations, good.rotations)
        np.testing.assert_array_equal(m.translations, good.translations)
        assert len(m.notes) == len(good.notes) + len(notes) and all(n in str(m.notes) for n in notes), m.notes

    same(b"\xef\xbb\xbf" + AMC.encode())
    same(AMC.replace("\n", "\r\n"))
    same(AMC.replace("\n", "\r"))
    same(AMC.replace("\n", "\n\n \t\n").replace(" ", " \t "))
    same(AMC.replace("1.5 ", "+1.5 ").replace("10.5", "105e-1").replace("-3", "-3.").replace("30.25", "3025E-2"))
    same(AMC.replace("\n2\n", "\n# a comment\n  2 # frame\n").replace("shin", "# toe 1\nshin"))
    same(AMC + "\x1a", "end-of-file")
    same(AMC.replace("shin", "toe\nshin"))  # a bone that has no degree of freedom has no number
    same(AMC.replace(":DEGREES", ":degrees").replace(":FULLY", ":fully"))
    same(AMC.replace(":DEGREES\n", ""), "neither :DEGREES nor :RADIANS: degrees")
    same(AMC.replace(":FULLY-SPECIFIED\n", ""), "FULLY")
    same(AMC.replace(":DEGREES", ":DEGREES\n:ASF-FILE small.asf"), "ASF-FILE")
    same(AMC.replace("\n2\n", "\n02\n"))
    same(AMC[:-1], "no line end after the last number")
    same(AMC.replace("\n3\n", "\n10\n").replace("\n2\n", "\n9\n").replace("\n1\n", "\n8\n"), "number 8")
    moved = AMC.replace("thigh 11 -21 -1.5e-014\nshin 45.5", "shin 45.5\nthigh 11 -21 -1.5e-014")
    same(moved)
    same(AMC.replace(":DEGREES", ":DEGREES\n:FRAME-RANGE 1 3"))
    same(AMC.replace(":DEGREES", ":DEGREES\n:FRAME-RANGE 1 2"), "says 2 frames, but 3 follow")

    for text in (
        ASF.replace("\n", "\r\n"),
        re.sub("THIGH|SHIN|TOE|SPINE|(?<!:)ROOT", lambda m: m.group().lower(), ASF.upper()),
        ASF.replace(" ", "\t"), ASF.replace("0.34202 -0.939693 0", "0.34202, -0.939693, 0"), "\ufeff" + ASF, ASF + "\x00",
        ASF.replace("\n", " # more\n"), ASF.replace("length 7.5\n     axis 0 0 20  XYZ", "axis 0 0 20 xyz\n length 75e-1"),
    ):  # fmt: skip
        skeleton = parse_asf(text.encode())
        np.testing.assert_array_equal(skeleton.offsets, SMALL.offsets)
        assert skeleton.topology == SMALL.topology and skeleton.reading.nodes == SMALL.reading.nodes
        assert len(skeleton.reading.notes) == len(SMALL.reading.notes) + ("\x00" in text)


def test_what_a_skeleton_says():
    unused = parse_asf(ASF.replace(":hierarchy", ":skin a.skn\n:hierarchy").encode())
    assert any("':skin'" in n for n in unused.reading.notes)
    stretched = parse_asf(ASF.replace("direction 0 -1 0", "direction 0 -2 0").encode())
    np.testing.assert_allclose(stretched.offsets, SMALL.offsets, atol=0)
    assert any("normalised" in n and "'shin'" in n for n in stretched.reading.notes)
    turned = parse_asf(ASF.replace("axis -90 0 20 XYZ", "axis -90 0 20 ZYX").encode())
    assert any("about x, y, z" in n and "'shin'" in n for n in turned.reading.notes)
    for unit, scale in (("m", 1.0), ("cm", 0.01), (0.5, 0.5)):
        assert parse_asf(ASF.encode(), unit=unit).end_offsets[1, 1] == 12 * scale
    assert any("tall at rest" in n for n in parse_asf(ASF.encode(), unit="m").reading.notes)
    assert parse_asf(ASF.encode(), up="z").topology.up == "z"
    latin = parse_asf(ASF.replace("toe", "zeh\xe9").encode("latin-1"))
    assert latin.names[3] == "zehé" and any("Latin-1" in n for n in latin.reading.notes)
    rooted = ASF.replace("position 0 0 0", "position 1 2 3").replace("orientation 0 0 0", "orientation 10 20 30")
    skeleton = parse_asf(rooted.encode())
    m = parse_amc(AMC.encode(), skeleton)
    assert any("in front of all motion" in n for n in m.notes) and against_literal(m, rooted, AMC) < 1e-13
    masses = ASF.replace("    dof", "    bodymass 2\n    cofmass 1.5\n    dof")
    assert parse_asf(masses.encode()).masses is None
    assert sum("is not used" in n for n in parse_asf(masses.encode()).reading.notes) == 2
    whole = parse_asf(masses.replace("length 2\n", "length 2\n bodymass 1\n cofmass 1.5\n").encode())
    np.testing.assert_array_equal(whole.masses, [0, 2, 2, 1, 2])
    np.testing.assert_allclose(whole.mass_centers[1], whole.offsets[2] / 7.5 * 1.5, atol=1e-15)
    np.testing.assert_array_equal(parse_amc(AMC.encode(), whole).skeleton.masses, whole.masses)


def test_rates_and_options():
    named = AMC.replace(":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 60")
    for text, rate, found, note in (
        (AMC, 120.0, 120.0, "CMU's"), (AMC, 30.0, 30.0, "as given"), (named, 120.0, 60.0, "from :SAMPLES"),
        (named, 30.0, 30.0, "says 60"),
    ):  # fmt: skip
        m = parse_amc(text.encode(), SMALL, rate=rate)
        assert m.rate == found and note in m.notes[1]
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(OptionError):
            parse_amc(AMC.encode(), SMALL, rate=rate)
    for wrong in ({"up": "w"}, {"unit": "furlong"}, {"unit": 0.0}, {"unit": 1e308}):
        with pytest.raises(OptionError):
            parse_asf(ASF.encode(), **wrong)
    with pytest.raises(OptionError, match="read_asf"):
        parse_amc(AMC.encode(), SMALL.plain())
    radians = parse_amc(AMC.replace(":DEGREES", ":RADIANS").encode(), SMALL)
    assert against_literal(radians, ASF, AMC.replace(":DEGREES", ":RADIANS")) < 1e-12


def test_the_skeleton_beside_the_motion(tmp_path):
    amc = tmp_path / "Ann_walk_03.AMC"
    amc.write_text(AMC)
    with pytest.raises(FileFormatError, match=r"Ann_walk_03\.asf and Ann_walk\.asf and Ann\.asf.*no \.asf at all.*put the ASF"):
        read_amc(amc)
    (tmp_path / "only.asf").write_text(ASF)
    assert find_asf(amc).name == "only.asf" and load(amc).frames == 3
    assert "the skeleton is only.asf" in load(amc, rate=60.0).notes
    (tmp_path / "other.asf").write_text("no skeleton")
    with pytest.raises(FileFormatError, match=r"2 others are there \(only.asf, other.asf\)"):
        read_amc(amc)
    (tmp_path / "ANN.Asf").write_text(ASF)
    assert find_asf(amc).name == "ANN.Asf" and read_amc(amc).frames == 3
    (tmp_path / "ann.asf").write_text(ASF)
    with pytest.raises(FileFormatError, match="4 others"):
        read_amc(amc)
    (tmp_path / "Ann_walk.asf").write_text(ASF)
    assert find_asf(amc).name == "Ann_walk.asf"
    with pytest.raises(FileFormatError, match="begins with :version") as e:
        read_amc(amc, tmp_path / "other.asf")
    assert str(tmp_path / "other.asf") in str(e.value)
    assert read_amc(amc, tmp_path / "only.asf", up="z").skeleton.topology.up == "z"
    skeleton = read_asf(tmp_path / "only.asf", up="z", unit="m")
    assert read_amc(amc, skeleton).skeleton.end_offsets[1, 1] == read_amc(amc, skeleton, up="z").skeleton.end_offsets[1, 1] == 12
    with pytest.raises(OptionError, match="read already"):
        read_amc(amc, skeleton, up="x")
    for missing in ((tmp_path / "none.amc", None), (amc, tmp_path / "none.asf"), (tmp_path, None), (tmp_path / "a\x00.amc", None)):
        with pytest.raises(FileFormatError):
            read_amc(*missing)
    os.mkfifo(tmp_path / "pipe.amc")
    with pytest.raises(FileFormatError, match="a pipe"):
        read_amc(tmp_path / "pipe.amc")


# Refusing


ASF_FAULTS = [
    (":version", "version", 2, 1, "where a section should begin"),
    (":units", ":unit", 60, 1, "no section :units"),
    (":hierarchy", ":name", 54, 1, "second section"),
    ("length 0.45", "length 0", 6, 10, "unit of length of 0"),
    ("length 0.45", "length 0,45", 6, 12, "2 values here (it has 1 (a comma is a blank"),
    ("  length 0.45\n", "", 4, 1, "no 'length'"),
    ("angle deg", "angle turn", 7, 9, "deg or rad"),
    ("mass 1.0", "weight 1.0", 5, 3, "'weight' in :units"),
    ("RX RY RZ", "RX RY RX", 12, 25, "rx stands twice"),
    ("RX RY RZ", "RX RY RW", 12, 25, "'RW'"),
    ("axis XYZ", "axis XXZ", 13, 9, "order of axes"),
    ("position 0 0 0", "position 0 0", 14, 16, "2 values"),
    ("position 0 0 0", "position 0 0 nan", 14, 17, "finite"),
    ("orientation 0 0 0", "orientation 0 0 0 0", 15, 22, "4 values"),
    ("   axis XYZ\n", "", 11, 1, "no 'axis'"),
    ("begin\n     id 1\n", "id 1\n", 17, 3, "where a bone should begin"),
    ("name thigh", "name", 19, 10, "0 values"),
    ("name thigh", "name left thigh", 19, 16, "2 values"),
    ("name thigh", "name 17", 19, 11, "called '17'"),
    ("name shin", "name thigh", 30, 11, "second bone 'thigh'"),
    ("name shin", "name root", 30, 11, "second bone 'root'"),
    ("     name shin\n", "", 28, 3, "no 'name'"),
    ("direction 0 -1 0", "direction 0 0 0", 30, 11, "no direction"),
    ("direction 0 -1 0", "direction 0 -1e99 0", 31, 18, "too large"),
    ("length 7.25", "length -7.25", 32, 13, "cannot be negative"),
    ("length 7.25", "length 7.25\n     length 7.25", 33, 6, "second 'length'"),
    ("axis -90 0 20 XYZ", "axis -90 0 20", 33, 19, "3 values"),
    ("dof rx\n", "dof rx l\n", 34, 12, "rigid"),
    ("dof rx\n", "dof q\n", 34, 9, "degree of freedom"),
    ("     id 3", "     colour 3", 38, 6, "'colour' in a bone"),
    ("  begin\n     id 2\n", "     id 2\n", 28, 6, "should begin"),
    ("  end\n:hierarchy", ":hierarchy", 44, 3, "does not end"),
    ("begin\n    root", "root", 55, 3, "'begin'"),
    ("shin toe\n  end", "shin toe", 59, 1, "no 'end'"),
    ("shin toe\n  end", "shin toe\n  end\n  toe shin", 60, 3, "after the hierarchy's end"),
    ("shin toe", "shin", 58, 9, "stands alone"),
    ("shin toe", "shin heel", 58, 10, "no bone 'heel'"),
    ("shin toe", "shn toe", 58, 5, "nearest: shin"),
    ("shin toe", "shin toe root", 58, 14, "root is a child"),
    ("shin toe", "shin toe thigh", 58, 14, "two parents, 'root' and 'shin'"),
    ("shin toe", "spine toe\n    toe toe", 59, 9, "two parents"),
    ("root thigh spine", "root spine\n    toe thigh", 19, 11, "no chain of parents"),
    ("    thigh shin\n", "", 30, 11, "no chain of parents leads from 'shin'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "column", "part"), ASF_FAULTS)
def test_skeleton_faults_are_located(old, new, line, column, part):
    assert old in ASF
    refused(AMC, part, asf=ASF.replace(old, new, 1), line=line, column=column)


AMC_FAULTS = [
    (":FULLY-SPECIFIED", "FULLY-SPECIFIED", 2, 1, "first frame's number"),
    (":DEGREES", ":DEGREES\n:RADIANS", 4, 1, "both"),
    (":DEGREES", ":SAMPLES-PER-SECOND", 3, 20, "0 values"),
    (":DEGREES", ":SAMPLES-PER-SECOND 0", 3, 21, "a rate of 0"),
    (":DEGREES", ":FRAME-RANGE 1 9", 3, 1, "says 9 frames, but 3 follow"),
    (":DEGREES", ":FRAME-RANGE 1 1e9", 3, 1, "says 1000000000 frames"),
    ("\n2\n", "\n3\n", 9, 1, "frame 3 comes after frame 1"),
    ("\n2\n", "\n1\n", 9, 1, "frame 1 comes after frame 1"),
    ("\n2\n", "\n1000000000\n", 9, 1, "frame 1000000000 comes after frame 1"),
    ("\n2\n", "\n" + "9" * 400 + "\n", 9, 1, "as a frame's number"),
    ("\n2\n", "\n2.0\n", 9, 1, "where a bone's name should stand"),
    ("\n2\n", "\n", 9, 1, "'root' stands twice in frame 1"),
    ("\n1\n", "\n", 4, 1, "first frame's number"),
    (AMC[AMC.index("root 1.5") : AMC.index("2\nroot")], "", 5, 1, "here ends frame 1 without 'root', 'thigh', 'shin', 'spine'"),
    ("shin 45.5\n", "", 13, 1, "here ends frame 2 without 'shin'"),
    ("shin 45.5\n", "shin 45.5\nshin 45.5\n", 13, 1, "twice"),
    ("shin 45.5\n", "shin\n", 12, 5, "has 0 numbers here; its degrees of freedom in the skeleton are 1: rx"),
    ("shin 45.5\n", "shin 45.5 3\n", 12, 11, "2 numbers"),
    ("shin 45.5\n", "shin 45.5\ntoe 3\n", 13, 5, "are none"),
    ("shin 45.5\n", "shni 45.5\n", 12, 1, "nearest: shin"),
    ("shin 45.5\n", "shin 45,5\n", 12, 6, "point"),
    ("shin 45.5\n", "shin nan\n", 12, 6, "finite"),
    ("shin 45.5\n", "shin -inf\n", 12, 6, "finite"),
    ("shin 45.5\n", "shin 1.#QNAN\n", 12, 6, "finite"),
    ("shin 45.5\n", "shin 1e400\n", 12, 6, "too large"),
    ("shin 45.5\n", "shin 1e10\n", 12, 6, "too large"),
    ("shin 45.5\n", "shin 0x10\n", 12, 6, "'0x10'"),
    ("shin 45.5\n", "shin 4_5\n", 12, 6, "'4_5'"),
    ("shin 45.5\n", "shin 4\x005\n", 1, 1, "binary"),
    ("thigh 11 -21 ", "thigh 11-21 ", 11, 7, "space is missing"),
    ("thigh 11 -21 ", "thigh 11 -21\n", 11, 13, "2 numbers"),
    ("spine 5.5 15\n", "", 18, 1, "the file ends inside frame 3 without 'spine'"),
    ("spine 5.5 15\n", "spine 5.5 15\n4\n", 20, 1, "the file ends inside frame 4"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "column", "part"), AMC_FAULTS)
def test_motion_faults_are_located(old, new, line, column, part):
    assert old in AMC
    refused(AMC.replace(old, new, 1), part, line=line, column=column)


def test_what_is_no_acclaim_file():
    for raw, part in (
        (b"", "empty"), (b" \n\x00", "empty"), (b"\xef\xbb\xbf", "empty"), (b"# only\n#", "only comments"), (b"1", "frame 1"),
        (AMC.encode("utf-16"), "UTF-16"), (bytes(range(256)), "UTF-16|binary"), (b"PK\x03\x04\x00\x00\x01", "binary"),
        (b"HIERARCHY\nROOT a\n", "first frame"), (b":FULLY-SPECIFIED\n", "no frame"), (ASF.encode(), "no frame|first frame"),
    ):  # fmt: skip
        for parse in (lambda r: parse_amc(r, SMALL), parse_asf):
            if parse is parse_asf and raw == ASF.encode():
                continue
            with pytest.raises(FileFormatError, match=part if parse is not parse_asf else None) as e:
                parse(raw)
            assert e.value.remedy


def test_claims_cost_nothing():
    """Numbers of frames in a file are never a size; deep and wide skeletons are refused or read in linear time."""
    tracemalloc.start()
    for text in (AMC.replace("\n2\n", "\n1000000000\n"), AMC.replace(":DEGREES", ":FRAME-RANGE 1 1000000000")):
        refused(text, "1000000000")
    late = AMC.replace("\n3\n", "\n1000000002\n").replace("\n2\n", "\n1000000001\n").replace("\n1\n", "\n1000000000\n")
    assert parse_amc(late.encode(), SMALL).frames == 3
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()

    def chain(depth: int, wide: bool = False) -> str:
        bone = "begin\nname b{0}\ndirection 0 1 0\nlength 1\naxis 0 0 0 XYZ\nend\n"
        links = "".join(f"{'root' if wide or not n else f'b{n - 1}'} b{n}\n" for n in range(depth))
        head = ASF[: ASF.index(":bonedata")]
        return f"{head}:bonedata\n{''.join(bone.format(n) for n in range(depth))}:hierarchy\nbegin\n{links}end\n"

    assert len(parse_asf(chain(255).encode()).names) == 256
    began = time.perf_counter()
    for depth in (256, 5_000):
        refused(AMC, "256", asf=chain(depth))
    assert len(parse_asf(chain(5_000, wide=True).encode()).names) == 5_001
    many = b" ".join([b"1"] * 1_000_000)
    for text in (b" " * 2_000_000 + b"\n", b"1" * 2_000_000 + b"x", b"shin " + many, b"#" * 1_000_000, b"a#" * 500_000):
        refused(AMC.encode().replace(b"shin 45.5", text), "")
        refused(text + b"\n" + AMC.encode() + b"9", "")
    assert time.perf_counter() - began < 20


def test_truncation_is_never_taken_for_the_whole():
    """Cut at any byte: refused, or a note says what cannot be known, or what is there is whole."""
    whole = parse_amc(AMC.encode(), SMALL)
    fixed = "".join(
        " ".join([w[0], *(f"{float(x):.6f}" for x in w[1:])]) + "\n" if (w := line.split())[1:] else line + "\n"
        for line in AMC.splitlines()[1:]
    )
    for text in (AMC, fixed, AMC.replace("\n", "\r\n"), fixed.replace("\n", "\r\n")):
        accepted = 0
        for cut in range(len(text)):
            try:
                m = parse_amc(text.encode()[:cut], SMALL)
            except FileFormatError as e:
                assert e.remedy
                continue
            accepted += 1
            same = np.allclose(m.rotations, whole.rotations[: m.frames], atol=1e-7)
            assert any("no line end" in n for n in m.notes) or same, cut
        assert accepted <= 12 + 2 * text.count("\r")
    places = ASF.index(":hierarchy"), ASF.index(":units"), ASF.index(":root")
    parts = ASF[: places[1]], ASF[places[1] : places[2]], ASF[places[2] : places[0]], ASF[places[0] :]
    for text in (ASF, ASF.replace("\n", "\r\n"), parts[0] + parts[2] + parts[3] + parts[1], parts[0] + parts[3] + parts[1] + parts[2]):
        for cut in range(len(text)):
            try:
                s = parse_asf(text.encode()[:cut])
            except FileFormatError as e:
                assert e.remedy
                continue
            same = np.array_equal(s.offsets, SMALL.offsets) and s.reading.nodes == SMALL.reading.nodes
            assert any("no line end" in n for n in s.reading.notes) or same, text[:cut][-30:]


def test_real_files_cut_short(data):
    skeleton, raw = read_asf(data / "asfamc/02.asf"), (data / "asfamc/02_03.amc").read_bytes()
    whole = parse_amc(raw, skeleton)
    for cut in [*range(0, len(raw), 4999), *range(len(raw) - 40, len(raw))]:
        try:
            m = parse_amc(raw[:cut], skeleton)
        except FileFormatError as e:
            assert e.remedy
            continue
        assert any("no line end" in n for n in m.notes) or np.array_equal(m.rotations, whole.rotations[: m.frames])
    asf = (data / "asfamc/02.asf").read_bytes()
    for cut in range(0, len(asf) - 6, 31):
        with pytest.raises(FileFormatError):
            parse_asf(asf[:cut])


def both(asf: bytes, amc: bytes) -> None:
    """Reads, or raises an error of the family; what was read is finite and can be written or is refused in words."""
    for skeleton in (lambda: SMALL, lambda: parse_asf(asf)):
        with contextlib.suppress(KinjaxError):
            s = skeleton()
            assert np.isfinite(s.offsets).all() and np.isfinite(s.end_offsets).all()
            m = parse_amc(amc, s)
            assert np.isfinite(m.rotations).all() and np.isfinite(m.translations).all()
            bvh_bytes(m)


EDITS = st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 6), st.binary(max_size=5)), max_size=4)


@settings(max_examples=300, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(EDITS, EDITS)
def test_fuzz_of_edits(in_asf, in_amc):
    texts = []
    for text, edits in ((ASF.encode(), in_asf), (AMC.encode(), in_amc)):
        for at, drop, insert in edits:
            at %= len(text)
            text = text[:at] + insert + text[at + drop :]
        texts.append(text)
    both(*texts)
    both(ASF.encode(), texts[1])


LINES = [*ASF.splitlines(), *AMC.splitlines(), "begin", "end", "root root", "toe thigh", "dof l", "1e9", "-1 2", "\x00", "é", "root"]


@settings(max_examples=200, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(st.integers(0, 200), st.sampled_from(LINES), st.booleans()), max_size=4), st.booleans())
def test_fuzz_of_lines(edits, in_asf):
    lines = (ASF if in_asf else AMC).splitlines()
    for at, line, replace in edits:
        at %= len(lines)
        lines[at : at + replace] = [line]
    text = "\n".join(lines).encode()
    both(text if in_asf else ASF.encode(), AMC.encode() if in_asf else text)


@settings(max_examples=100, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from(LINES), max_size=30), st.binary(max_size=60))
def test_fuzz_of_junk(lines, junk):
    text = "\n".join(lines).encode()
    for candidate in (text, junk, b":FULLY-SPECIFIED\n1\n" + text, ASF.encode()[:700] + text, ASF.encode() + junk):
        both(candidate, candidate)
