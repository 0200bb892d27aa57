"""The records that rooms share: motions, poses, skeletons, constraints, templates; what they refuse, in which words."""

import dataclasses

import jax
import numpy as np
import pytest

from kinjax.annotations import TYPES, Constraint, Constraints, NoisePattern, Template, check_type
from kinjax.errors import FileFormatError, KinjaxError, OptionError, ShapeError, UnknownNameError, find_name
from kinjax.motion import Motion, clip_name, make_poses, resample
from kinjax.skeleton import Skeleton, Topology

FRAMES, NAMES = 12, ("LeftFoot", "RightFoot")


LONG = 1 + 0.01 * (np.arange(24).reshape(12, 2, 1) == 9)
"""Lengths of quaternions, one of them wrong."""


def arrays(dtype=float):
    """Rotations and positions of two objects."""
    rng = np.random.default_rng(0)
    q = rng.normal(size=(FRAMES, 2, 4))
    return (q / np.linalg.norm(q, axis=-1, keepdims=True)).astype(dtype), rng.normal(size=(FRAMES, 2, 3)).astype(dtype)


# ----------------------------------------------------------------------------------------------------------------------- poses
def test_make_poses():
    q, t = arrays()
    poses = make_poses(NAMES, q, t, 120.0, clip="walk", up="z")
    assert (poses.frames, poses.objects, poses.rate, poses.names, poses.clip, poses.up) == (FRAMES, 2, 120.0, NAMES, "walk", "z")
    assert poses.valid.all() and poses.valid.dtype == bool
    np.testing.assert_array_equal(poses.position, t)


def test_what_is_not_finite_is_not_valid():
    q, t = arrays()
    q[3, 0, 2], t[5, 1, 0] = np.nan, np.inf
    seen = np.ones((FRAMES, 2), bool)
    seen[8] = False
    expected = seen.copy()
    expected[3, 0] = expected[5, 1] = False
    np.testing.assert_array_equal(make_poses(NAMES, q, t, 60.0, seen).valid, expected)
    q[8] = 17.0  # what is not valid may hold anything
    np.testing.assert_array_equal(make_poses(NAMES, q, t, 60.0, seen).valid, expected)


def test_batch_axes_are_kept():
    q, t = arrays()
    poses = make_poses(NAMES, np.stack([q] * 3), np.stack([t] * 3), 60.0)
    assert (poses.frames, poses.objects, poses.valid.shape) == (FRAMES, 2, (3, FRAMES, 2))
    assert poses.slice(2, 4).select(["rightfoot"]).position.shape == (3, 3, 1, 3)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda a: a | {"rotation": a["rotation"][..., :3]}, ShapeError, r"rotation \(12, 2, 3\) must be"),
        (lambda a: a | {"position": a["position"][:-1]}, ShapeError, r"position \(11, 2, 3\)"),
        (lambda a: a | {"position": a["position"][..., :2]}, ShapeError, "must be"),
        (lambda a: a | {"names": ("one",)}, ShapeError, "1 names for position"),
        (lambda a: a | {k: a[k][:, 0] for k in ("rotation", "position")}, ShapeError, "last axes are frames, objects, 3"),
        (lambda a: a | {"valid": np.ones(FRAMES, bool)}, ShapeError, r"valid \(12,\) must be \(12, 2\)"),
        (lambda a: a | {"rate": 0.0}, OptionError, "rate is 0"),
        (lambda a: a | {"rate": float("nan")}, OptionError, "rate is nan"),
        (lambda a: a | {"rate": float("inf")}, OptionError, "rate is inf"),
        (lambda a: a | {"rotation": a["rotation"] * LONG}, ShapeError, "'RightFoot' at frame 4 has length 1.01"),
    ],
)
def test_make_poses_refuses(change, error, words):
    q, t = arrays()
    with pytest.raises(error, match=words):
        make_poses(**change({"names": NAMES, "rotation": q, "position": t, "rate": 60.0}))


def test_select_and_index():
    poses = make_poses(NAMES, *arrays(), 60.0, clip="walk")
    one = poses.select(["rightFOOT"])
    assert one.names == ("RightFoot",) and one.objects == 1
    np.testing.assert_array_equal(one.position[:, 0], poses.position[:, 1])
    swapped = poses.select(["RightFoot", "LeftFoot"])
    np.testing.assert_array_equal(swapped.rotation, poses.rotation[:, ::-1])
    np.testing.assert_array_equal(swapped.valid, poses.valid[:, ::-1])
    assert poses.select([]).objects == 0
    with pytest.raises(UnknownNameError, match=r"walk: no object named 'LeftFot' \(nearest: LeftFoot") as error:
        poses.index("LeftFot")
    assert error.value.near[0] == "LeftFoot"


def test_slice_includes_both_ends():
    poses = make_poses(NAMES, *arrays(), 60.0)
    part = poses.slice(3, 5)
    assert part.frames == 3 and part.names == NAMES
    np.testing.assert_array_equal(part.position, poses.position[3:6])
    np.testing.assert_array_equal(part.rotation, poses.rotation[3:6])
    assert poses.slice(0, FRAMES - 1).frames == FRAMES and poses.slice(4, 4).frames == 1
    for begin, end in ((-1, 3), (3, 2), (0, FRAMES)):
        with pytest.raises(OptionError, match=f"{begin}..{end} are not inside the clip's 0..11"):
            poses.slice(begin, end)


def test_poses_are_a_tree_of_arrays():
    poses = make_poses(NAMES, *arrays(), 60.0)
    doubled = jax.tree.map(lambda x: x, poses)
    assert doubled.names == NAMES
    assert len(jax.tree.leaves(poses)) == 4  # rotation, position, valid, rate
    with pytest.raises(dataclasses.FrozenInstanceError):
        poses.rate = 30.0


# -------------------------------------------------------------------------------------------------------- skeleton and motion
TOPOLOGY = Topology(
    ("hips", "knee", "foot", "prop"), (-1, 0, 1, -1), translated=(0, 3), end_parents=(2, 2), end_names=("toe", "heel")
)  # fmt: skip
SKELETON = Skeleton(np.array([[0.0, 0, 0], [0, -0.4, 0], [0, -0.5, 0], [1, 0, 0]]), np.array([[0, 0, 0.2], [0, 0, -0.1]]), TOPOLOGY)


def test_motion():
    rng = np.random.default_rng(1)
    t = rng.normal(size=(9, 2, 3))
    motion = Motion(t, np.tile([1.0, 0, 0, 0], (9, 4, 1)), SKELETON, 100.0, name="clip")
    assert (motion.frames, motion.joints, motion.duration) == (9, 4, 0.08)
    np.testing.assert_array_equal(motion.root, t[:, 0])
    part = motion.slice(2, 4)
    assert part.frames == 3 and part.name == "clip" and part.skeleton is SKELETON
    np.testing.assert_array_equal(part.translations, t[2:5])
    with pytest.raises(OptionError, match=r"5..9 are not inside the clip's 0..8"):
        motion.slice(5, 9)
    assert motion.slice(3, 3).duration == 0


def turning(frames=9, rate=100.0, dtype=float):
    """Every joint turns about z by 0.1 rad a frame, signs of quaternions mixed; the roots move by 1 cm a frame."""
    half = 0.05 * np.arange(frames)
    q = np.zeros((frames, 4, 4), dtype)
    q[..., 0], q[..., 3] = np.cos(half)[:, None], np.sin(half)[:, None]
    q[::2] *= -1
    t = np.tile(0.01 * np.arange(frames, dtype=dtype)[:, None, None], (1, 2, 3))
    return Motion(t, q, SKELETON, rate, name="clip")


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("rate", [25.0, 40.0, 100.0, 240.0, 24.0])
def test_resample(rate, dtype):
    motion = turning(dtype=dtype)
    new = resample(motion, rate)
    assert new.rate == rate and new.frames == int(0.08 * rate + 1e-9) + 1 and new.skeleton is SKELETON
    assert new.rotations.dtype == new.translations.dtype == dtype
    time = np.arange(new.frames) / rate
    tight = 1e-6 if dtype == "float32" else 1e-12
    np.testing.assert_allclose(new.translations[:, 1, 2], time, atol=tight)
    half = 5 * time
    right = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    agree = np.abs((np.asarray(new.rotations[:, 2], float) * right).sum(-1))
    np.testing.assert_allclose(agree, 1, atol=tight)
    np.testing.assert_allclose(np.linalg.norm(new.rotations, axis=-1), 1, atol=tight)
    cut = 0.08 - time[-1] > 1e-6
    assert ("have no frame" in new.notes[-1]) == cut and f"to {rate:g} fps" in new.notes[-1]


def test_resample_keeps_frames_at_their_times_and_batches():
    motion = turning()
    np.testing.assert_array_equal(resample(motion, 25.0).rotations, motion.rotations[::4])
    both = dataclasses.replace(
        motion, translations=np.stack([motion.translations] * 2), rotations=np.stack([motion.rotations] * 2)
    )
    two = resample(both, 30.0)
    assert two.rotations.shape == (2, 3, 4, 4)
    np.testing.assert_array_equal(two.rotations[1], resample(motion, 30.0).rotations)
    assert resample(motion.slice(4, 4), 24.0).frames == 1


def test_resample_does_not_spread_what_is_not_finite():
    motion = turning()
    motion.rotations[4] = np.nan
    assert not np.isfinite(resample(motion, 25.0).rotations[1]).any()
    lost = np.flatnonzero(~np.isfinite(resample(motion, 200.0).rotations).all((1, 2)))
    assert lost.tolist() == [7, 8, 9]
    assert np.isfinite(resample(motion, 200.0).translations).all()


def test_resample_refuses():
    for rate in (0.0, -24.0, float("nan"), float("inf")):
        with pytest.raises(OptionError, match="rate is"):
            resample(turning(), rate)
    with pytest.raises(ShapeError, match="nothing to resample"):
        resample(dataclasses.replace(turning(), rate=0.0), 24.0)


def test_segment_centers():
    """Half-way to the mean of children and End Sites; the joint itself where it has none."""
    np.testing.assert_allclose(SKELETON.segment_centers(), [[0, -0.2, 0], [0, -0.25, 0], [0, 0, 0.025], [0, 0, 0]])


def test_topology():
    assert TOPOLOGY.children(0) == (1,) and TOPOLOGY.children(2) == ()
    assert TOPOLOGY.index("KNEE") == 1 and SKELETON.names == TOPOLOGY.names
    assert hash(TOPOLOGY) == hash(dataclasses.replace(TOPOLOGY))
    for names, parents, words in (
        (("a", "b"), (-1,), "2 joint names, 1 parents"),
        (("a", "a"), (-1, 0), r"repeat: \['a'\]"),
        (("a", "b"), (-1, 1), "must come before"),
        (("a", "b"), (0, -1), "must come before"),
        (("a", "b"), (-1, -2), "must come before"),
    ):
        with pytest.raises(ShapeError, match=words):
            Topology(names, parents)
    with pytest.raises(ShapeError, match="1 channel lists"):
        Topology(("a", "b"), (-1, 0), channels=(("Xrotation",),))


@pytest.mark.parametrize(("path", "name"), [("a/b/walk.bvh", "walk.bvh"), ("walk", "walk")])
def test_clip_name(path, name):
    assert clip_name(path) == name


# ----------------------------------------------------------------------------------------------------------------- annotations
ITEMS = (
    Constraint("RightFoot", "line", 20, 30, (1.0, 2, 3), (0.0, 1, 0), 2e-3, 1, 100.0),
    Constraint("LeftFoot", "space", 5, 9, (0.0, 0, 0), residual=1e-3, fps=100.0),
    Constraint("LeftFoot", "point", 5, 9, (0.0, 0, 1), fps=100.0),
)


def test_a_constraint_covers_both_of_its_frames():
    c = ITEMS[0]
    assert (c.frames, c.begin_s, c.end_s) == (11, 0.2, 0.3)
    assert np.isnan(dataclasses.replace(c, fps=0.0).begin_s)
    mask = Constraints(ITEMS).mask(25, "rightfoot")
    np.testing.assert_array_equal(np.flatnonzero(mask), np.arange(20, 25))
    np.testing.assert_array_equal(np.flatnonzero(Constraints(ITEMS).mask(40, type="point")), np.arange(5, 10))


def test_constraints_are_a_sequence_with_selections():
    every = Constraints.sorted(ITEMS)
    assert [c.type for c in every] == ["space", "point", "line"] and len(every) == 3
    assert every[0] == ITEMS[1] and every[1:].items == (ITEMS[2], ITEMS[0]) and ITEMS[0] in every
    assert [c.begin for c in every.of(object="LEFTFOOT")] == [5, 5]
    assert len(every.of(type="Space")) == 1 and len(every.of("LeftFoot", "line")) == 0
    with pytest.raises(OptionError, match="no constraint type 'plane': choose from space, line, point"):
        every.of(type="plane")


def test_columns_and_words():
    columns = Constraints(ITEMS).columns()
    assert list(columns) == [
        "object", "type", "begin", "end", "begin_s", "end_s", "x", "y", "z", "axis_x", "axis_y", "axis_z", "residual", "pattern",
    ]  # fmt: skip
    assert {len(v) for v in columns.values()} == {3}
    np.testing.assert_array_equal(columns["axis_y"], [1, np.nan, np.nan])
    np.testing.assert_array_equal(columns["z"], [3, 0, 1])
    assert columns["pattern"].dtype == int and columns["object"][0] == "RightFoot"
    empty = Constraints().columns()
    assert list(empty) == list(columns) and all(len(v) == 0 for v in empty.values())
    assert {k: v.dtype.kind for k, v in empty.items()} == {k: v.dtype.kind for k, v in columns.items()}
    text = str(Constraints(ITEMS)).splitlines()
    assert len(text) == 4 and "RightFoot" in text[1] and "2.00" in text[1] and str(Constraints()) == "no constraints"


def test_types_templates_and_patterns():
    assert TYPES == ("space", "line", "point") and [check_type(f" {t.upper()} ") for t in TYPES] == list(TYPES)
    assert Template("LeftFoot", 3, 9) == Template("LeftFoot", 3, 9, "space") and hash(Template("a", 0, 1))
    pattern = NoisePattern("LeftFoot", "space", (0.1, 0.2), (0.01, 0.02), (3, 9))
    assert pattern.with_object("RightFoot") == dataclasses.replace(pattern, object="RightFoot")
    assert pattern.status == "ok" and pattern.unit == "per_interval"


# ---------------------------------------------------------------------------------------------------------------------- errors
def test_names_are_found_in_any_case_unless_that_is_ambiguous():
    assert find_name("b", ("B", "b")) == 1 and find_name("HIPS", ("Hips",)) == 0
    with pytest.raises(UnknownNameError, match="no joint named 'HIPS'"):
        find_name("HIPS", ("Hips", "hips"), "joint")
    with pytest.raises(UnknownNameError, match="known: a, b"):
        find_name("zzzz", ("a", "b"))
    with pytest.raises(UnknownNameError, match=r"nearest: .*LeftFoot"):
        find_name("foot", ("LeftFoot", "Hips"))


def test_errors_are_one_family_and_say_where():
    assert issubclass(KinjaxError, ValueError)
    error = FileFormatError("five numbers", path="a.bvh", line=3, column=7, remedy="give six")
    assert str(error) == "a.bvh:3:7: five numbers (give six)"
    assert str(FileFormatError("empty", line=1)) == "line 1: empty" and str(FileFormatError("empty")) == "empty"
