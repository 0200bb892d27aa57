"""Forward kinematics against a plain loop, poses of joints and of marker clusters against motions that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinjax.errors import OptionError, ShapeError, UnknownNameError
from kinjax.kinematics import cluster_poses, forward_kinematics, object_poses, quaternions_of
from kinjax.motion import Motion
from kinjax.skeleton import Skeleton, Topology

JOINTS, FRAMES = 12, 9


def random_motion(seed, dtype="float64"):
    """A random forest: several roots, several joints with a moving translation, End Sites here and there."""
    rng = np.random.default_rng(seed)
    parents = (-1, *(-1 if i in (5, 8) and seed % 2 else int(rng.integers(0, i)) for i in range(1, JOINTS)))
    roots = [i for i, p in enumerate(parents) if p < 0]
    moving = tuple(sorted([*roots, *(i for i in (3, 7, 11) if i not in roots)][:4]))
    ends = tuple(int(i) for i in rng.integers(0, JOINTS, 3))
    names = tuple(f"joint{i}" for i in range(JOINTS))
    topology = Topology(names, parents, translated=moving, end_parents=ends, end_names=("",) * 3)
    q = Rotation.random(FRAMES * JOINTS, random_state=seed).as_quat()[:, [3, 0, 1, 2]].reshape(FRAMES, JOINTS, 4)
    q = q * rng.choice([-1.0, 1.0], (FRAMES, JOINTS, 1))
    skeleton = Skeleton(rng.normal(size=(JOINTS, 3)).astype(dtype), rng.normal(size=(3, 3)).astype(dtype), topology)
    return Motion(rng.normal(size=(FRAMES, len(moving), 3)).astype(dtype), q.astype(dtype), skeleton, 60.0, name="forest")


def by_loops(motion):
    """World matrices (frames, joints, 3, 3) and positions, one joint after the other."""
    top = motion.skeleton.topology
    turns, places = np.zeros((FRAMES, JOINTS, 3, 3)), np.zeros((FRAMES, JOINTS, 3))
    for f in range(FRAMES):
        for j, parent in enumerate(top.parents):
            w, x, y, z = (float(v) for v in motion.rotations[f, j])
            local = Rotation.from_quat([x, y, z, w]).as_matrix()
            offset = np.asarray(motion.skeleton.offsets[j], float)
            if j in top.translated:
                offset = np.asarray(motion.translations[f, top.translated.index(j)], float)
            if parent < 0:
                turns[f, j], places[f, j] = local, offset
            else:
                turns[f, j] = turns[f, parent] @ local
                places[f, j] = places[f, parent] + turns[f, parent] @ offset
    return turns, places


def matrices(q):
    return Rotation.from_quat(np.asarray(q, float).reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix().reshape(*q.shape[:-1], 3, 3)


@pytest.mark.parametrize("seed", range(6))
def test_forward_kinematics_of_random_trees(precision, seed):
    motion = random_motion(seed, precision)
    q, t = forward_kinematics(motion)
    assert q.shape == (FRAMES, JOINTS, 4) and t.shape == (FRAMES, JOINTS, 3) and q.dtype == t.dtype == precision
    turns, places = by_loops(motion)
    tolerance = 40 * np.finfo(precision).eps
    np.testing.assert_allclose(matrices(q), turns, atol=tolerance)
    np.testing.assert_allclose(t, places, atol=tolerance * 5)


def test_there_are_forests_and_moving_joints_among_them():
    tops = [random_motion(seed).skeleton.topology for seed in range(6)]
    assert any(top.parents.count(-1) > 1 for top in tops)
    assert all(any(top.parents[j] >= 0 for j in top.translated) for top in tops[::2])


def test_forward_kinematics_takes_one_clip():
    motion = random_motion(0)
    batch = Motion(np.stack([motion.translations] * 2), np.stack([motion.rotations] * 2), motion.skeleton, 60.0)
    with pytest.raises(ShapeError, match="one clip"):
        forward_kinematics(batch)


@pytest.mark.parametrize("origin", ["segment", "joint"])
def test_object_poses(x64, origin):
    motion = random_motion(1)
    names = ["JOINT4", "joint0", "joint11"]
    poses = object_poses(motion, names, origin=origin)
    assert poses.names == ("joint4", "joint0", "joint11") and poses.clip == "forest" and poses.rate == 60.0
    turns, places = by_loops(motion)
    top, skeleton = motion.skeleton.topology, motion.skeleton
    for k, j in enumerate((4, 0, 11)):
        ahead = [skeleton.offsets[i] for i, p in enumerate(top.parents) if p == j]
        ahead += [skeleton.end_offsets[i] for i, p in enumerate(top.end_parents) if p == j]
        center = np.mean(ahead, 0) / 2 if ahead and origin == "segment" else np.zeros(3)
        np.testing.assert_allclose(poses.position[:, k], places[:, j] + turns[:, j] @ center, atol=1e-13)
        np.testing.assert_allclose(matrices(np.asarray(poses.rotation[:, k])), turns[:, j], atol=1e-13)
    assert np.asarray(poses.valid).all()


def test_a_frame_of_nan_is_invalid_where_it_reaches():
    motion = random_motion(0)
    rotations = np.array(motion.rotations)
    rotations[4, 5] = np.nan
    poses = object_poses(Motion(motion.translations, rotations, motion.skeleton, 60.0))
    parents = motion.skeleton.topology.parents
    below = [j for j in range(JOINTS) if 5 in _line(parents, j)]
    expected = np.ones((FRAMES, JOINTS), bool)
    expected[4, below] = False
    np.testing.assert_array_equal(poses.valid, expected)


def _line(parents, joint):
    """A joint and all above it."""
    return [] if joint < 0 else [joint, *_line(parents, parents[joint])]


def test_object_poses_refuses_what_is_not_there():
    with pytest.raises(UnknownNameError, match="joint1"):
        object_poses(random_motion(0), ["joint1x"])
    with pytest.raises(OptionError, match="segment or joint"):
        object_poses(random_motion(0), origin="middle")


# ------------------------------------------------------------------------------------------------------------ marker clusters
BOX = np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.15], [-0.05, -0.1, 0.05]])


def moving_cluster(frames=40, seed=0, layout=BOX):
    """Rotations, positions of the centroid, and the markers that show them."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(frames, random_state=seed)
    place = rng.normal(size=(frames, 3))
    centered = layout - layout.mean(0)
    return turn, place, np.stack([r.apply(centered) + p for r, p in zip(turn, place, strict=True)])


@pytest.mark.parametrize("layout", [BOX, BOX[:3]], ids=["four", "three"])
def test_a_rigid_motion_is_found(layout):
    turn, place, points = moving_cluster(layout=layout)
    points[7, 1] = np.nan
    points[20:23, 0, 2] = np.nan
    poses = cluster_poses({"box": points}, 120.0, {"box": layout + np.full(3, 5.0)}, clip="trial")
    lost = np.isin(np.arange(40), [7, 20, 21, 22])
    np.testing.assert_array_equal(np.asarray(poses.valid)[:, 0], ~lost)
    assert np.isfinite(poses.rotation).all() and np.isfinite(poses.position).all()
    np.testing.assert_allclose(matrices(np.asarray(poses.rotation)[~lost, 0]), turn.as_matrix()[~lost], atol=1e-12)
    np.testing.assert_allclose(np.asarray(poses.position)[~lost, 0], place[~lost], atol=1e-12)
    assert (poses.rate, poses.up, poses.clip, poses.names) == (120.0, "z", "trial", ("box",))


def test_without_a_layout_displacements_are_the_same():
    turn, place, points = moving_cluster()
    poses = cluster_poses({"a": points, "b": points + 1}, 100.0)
    found = Rotation.from_quat(np.asarray(poses.rotation)[:, 0][:, [1, 2, 3, 0]])
    moved = found[1:] * found[:-1].inv()
    assert (moved.inv() * (turn[1:] * turn[:-1].inv())).magnitude().max() < 1e-7
    np.testing.assert_allclose(np.diff(poses.position[:, 0], axis=0), np.diff(place, axis=0), atol=1e-12)
    np.testing.assert_allclose(poses.position[:, 1], poses.position[:, 0] + 1, atol=1e-12)


def test_the_typical_shape_is_not_the_bad_frame():
    _, _, points = moving_cluster()
    points[0, 2] += 0.5  # the first frame shows a marker that was swapped
    _, _, clean = moving_cluster()
    found = Rotation.from_quat(np.asarray(cluster_poses({"a": points}, 100.0).rotation)[:, 0][:, [1, 2, 3, 0]])
    wanted = Rotation.from_quat(np.asarray(cluster_poses({"a": clean}, 100.0).rotation)[:, 0][:, [1, 2, 3, 0]])
    relative = found[1:] * found[1].inv(), wanted[1:] * wanted[1].inv()
    assert (relative[0].inv() * relative[1]).magnitude().max() < 1e-7


def test_a_mirrored_fit_is_never_taken():
    """Noise can make a mirrored fit the nearer one for nearly flat clusters; a rotation is given all the same."""
    rng = np.random.default_rng(0)
    flat = BOX * [1, 1, 1e-3]
    _, _, points = moving_cluster(200, 1, flat)
    poses = cluster_poses({"a": points + rng.normal(0, 1e-3, points.shape)}, 100.0, {"a": flat})
    assert np.linalg.det(matrices(np.asarray(poses.rotation))).min() > 0.999


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((5, 2, 3)), "at least 3 markers"),
        (np.zeros((5, 3)), "at least 3 markers"),
        (np.full((5, 3, 3), np.nan), "no frame of 'a'"),
        (np.linspace(0, 1, 4)[None, :, None] * np.ones((5, 1, 3)), "lie on one line"),
    ],
    ids=["two", "flat", "nan", "line"],
)
def test_bad_clusters_are_refused(points, words):
    with pytest.raises(ShapeError, match=words):
        cluster_poses({"a": points}, 100.0)


def test_quaternions_of_matrices():
    turn = Rotation.random(60, random_state=3)
    found = quaternions_of(turn.as_matrix().reshape(3, 20, 3, 3))
    assert found.shape == (3, 20, 4) and (found[..., 0] >= 0).all()
    np.testing.assert_allclose(matrices(found).reshape(-1, 3, 3), turn.as_matrix(), atol=1e-14)
    assert quaternions_of(np.zeros((0, 4, 3, 3))).shape == (0, 4, 4)


@pytest.mark.parametrize("bad", [-np.eye(3), np.diag([1.0, 1, -1]), 1.001 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_matrices_that_are_no_rotations_are_refused(bad):
    with pytest.raises(ShapeError, match="matrix 1 is no rotation"):
        quaternions_of(np.stack([np.eye(3), bad]))
