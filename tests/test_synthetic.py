"""The synthetic scenes: their truth is checked against their poses with arithmetic of the test's own (matrices)."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from kinjax import synthetic as syn
from kinjax.annotations import TYPES
from kinjax.errors import OptionError, UnknownNameError
from kinjax.synthetic import spatial

CLIPS = syn.sample_clips()
EXTRA = {
    "dice, seed 5, 120 fps": syn.rolling_dice(120.0, 400, seed=5),
    "hinge, wide and tilted": syn.hinge(200.0, reach=0.4, axis=(0.3, 1.0, -0.2)),
    "walk, 60 fps": syn.walking_biped(60.0, steps=4, step_length=0.45),
    "foot, one step": syn.rolling_foot(120.0, steps=1),
}
SCENES = {**CLIPS, **EXTRA}
each_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())


def matrix(q):
    """Rotation matrices of wxyz quaternions, from the textbook's polynomial."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotvec(r):
    """Rotation vectors of small rotation matrices, to third order in the angle."""
    return 0.5 * np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)


def pose(scene, name):
    i = scene.poses.index(name)
    return matrix(scene.poses.rotation[:, i]), scene.poses.position[:, i]


def speeds(scene, name):
    """Angular (rad/s) and linear (m/s) speed of an object over each interval."""
    r, t = pose(scene, name)
    turn = np.swapaxes(r[:-1], -1, -2) @ r[1:]
    angle = np.arctan2(np.linalg.norm(rotvec(turn), axis=-1), 0.5 * (np.trace(turn, axis1=-2, axis2=-1) - 1))
    return angle * scene.rate, np.linalg.norm(np.diff(t, axis=0), axis=-1) * scene.rate


def spread(r):
    """Eigenvalues of I - Rbar^T Rbar: how far the rotations differ about each direction; smallest 0 for one axis."""
    mean = r.mean(0)
    return np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)


# the poses ------------------------------------------------------------------------------------------------------------


@each_scene
def test_poses_are_unit_continuous_and_carry_the_markers(scene):
    q, t = scene.poses.rotation, scene.poses.position
    assert q.dtype == t.dtype == np.float64 and scene.poses.valid.all() and scene.poses.up == "y"
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, atol=1e-14)
    assert np.sum(q[1:] * q[:-1], -1).min() > 0.9
    assert np.linalg.norm(np.diff(t, axis=0), axis=-1).max() * scene.rate < 5.0
    assert set(scene.markers) == set(scene.marker_layout) == set(scene.poses.names)
    for name, layout in scene.marker_layout.items():
        r, x = pose(scene, name)
        np.testing.assert_allclose(scene.markers[name], np.einsum("fij,mj->fmi", r, layout) + x[:, None], atol=1e-14)
        np.testing.assert_allclose(layout.mean(0), 0.0, atol=1e-15)
        assert len(layout) >= 4 and 0.05 < np.sqrt(np.mean(np.sum(layout**2, -1))) < 0.5


@each_scene
def test_nothing_goes_below_the_ground(scene):
    if scene.name in ("dice", "foot"):
        assert min(m[..., 1].min() for m in scene.markers.values()) > -1e-12


# the truth ------------------------------------------------------------------------------------------------------------


@each_scene
def test_constrained_points_do_not_move(scene):
    for c in scene.truth:
        r, t = pose(scene, c.object)
        r, t = r[c.begin : c.end + 1], t[c.begin : c.end + 1]
        x = np.array(c.position)
        fixed = {"space": x + 0.3 * np.eye(3), "point": x[None]}
        if c.type == "line":
            assert abs(np.linalg.norm(c.axis) - 1) < 1e-14
            fixed["line"] = x + np.array([[-0.5], [0.0], [0.5]]) * c.axis
        else:
            assert c.axis is None
        for point in fixed[c.type]:
            local = r[0].T @ (point - t[0])
            assert np.abs(np.einsum("fij,j->fi", r, local) + t - point).max() < 1e-12
        assert (c.residual, c.fps) == (0.0, scene.rate) and 0 <= c.begin < c.end < scene.frames


@each_scene
def test_positions_are_where_the_annotations_say(scene):
    """Space: the origin; line: the axis point nearest the mean origin; pivots within 0.2 m unless the door is wide."""
    for c in scene.truth:
        t = pose(scene, c.object)[1][c.begin : c.end + 1]
        away = t.mean(0) - c.position
        if c.type == "space":
            assert np.abs(away).max() < 1e-14
        if c.type == "line":
            assert abs(away @ np.array(c.axis)) < 1e-14
        reach = 0.4 if scene is EXTRA["hinge, wide and tilted"] else 0.2
        assert np.linalg.norm(t - c.position, axis=-1).max() < reach + 1e-12


@each_scene
def test_kinds_are_what_they_say_and_starts_are_sharp(scene):
    """At rest nothing moves; a line has one axis, a point many; both turn fast from the first to the last interval."""
    for c in scene.truth:
        angular, linear = (v[c.begin : c.end] for v in speeds(scene, c.object))
        r = pose(scene, c.object)[0][c.begin : c.end + 1]
        if c.type == "space":
            assert angular.max() < 1e-12 and linear.max() < 1e-12
        else:
            assert angular.min() > 2.5 and angular.max() < 9.0
            assert (spread(r)[0] < 1e-12) if c.type == "line" else (spread(r)[0] > 0.05)
            assert spread(r)[1] > 0.01


@each_scene
def test_truth_is_complete(scene):
    """Where truth is silent the object neither rests nor turns about a pivot within 0.2 m of its origin."""
    for name in scene.poses.names:
        silent = syn.labels(scene, name, intervals=True) == 0
        angular, linear = speeds(scene, name)
        assert not (silent & (angular < 1.5) & (linear < 0.15)).any()
        if scene.name in ("dice", "hinge", "ball"):
            assert not silent.any()
        r, t = pose(scene, name)
        for seconds in (0.06, 0.2):
            n = round(seconds * scene.rate)
            for a in np.flatnonzero(np.convolve(silent, np.ones(n), "valid") == n)[::3]:
                rs, ts = r[a : a + n + 1], t[a : a + n + 1]
                mean = rs.mean(0)
                m, b = np.eye(3) - mean.T @ mean, np.einsum("fji,fj->i", rs, ts) / (n + 1) - mean.T @ ts.mean(0)
                assert np.linalg.norm(np.linalg.solve(m + 1.8e-4 * np.eye(3), b)) > 0.25


@each_scene
def test_spans_of_one_object_do_not_overlap_and_differ(scene):
    for name in scene.poses.names:
        spans = list(scene.truth.of(name))
        assert spans == sorted(spans, key=lambda c: c.begin) and len(spans) >= 3
        for a, b in pairwise(spans):
            assert a.end <= b.begin
            if a.end == b.begin and a.type == b.type:
                assert a.type == "line" and np.linalg.norm(np.subtract(a.position, b.position)) > 0.15


def test_labels():
    scene = CLIPS["foot"]
    by_frame, by_interval = syn.labels(scene, "Foot"), syn.labels(scene, "foot", intervals=True)
    assert by_frame.shape == (scene.frames,) and by_interval.shape == (scene.frames - 1,)
    for c in scene.truth:
        assert (by_interval[c.begin : c.end] == 1 + TYPES.index(c.type)).all()
    heel, stand = scene.truth[:2]
    assert by_frame[heel.end - 1] == 2 and by_frame[heel.end] == 1 and by_interval[heel.end - 1] == 2
    assert by_frame[heel.begin - 1] == by_frame[0] == by_frame[-1] == 0 and stand.begin == heel.end
    np.testing.assert_array_equal(syn.labels(scene.truth, "foot", scene.frames), by_frame)
    with pytest.raises(OptionError, match="frames"):
        syn.labels(scene.truth, "foot")
    with pytest.raises(UnknownNameError):
        syn.labels(scene, "hand")
    notes = scene.annotations()
    assert (notes.clip, notes.fps, notes.frames, notes.constraints) == ("foot", 100.0, scene.frames, scene.truth)


# each scene -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_dice(seed):
    scene = syn.rolling_dice(seed=seed)
    assert scene.frames == 141 and scene.rate == 60 and scene.poses.names == ("die_a", "die_b")
    assert min(c.frames - 1 for c in scene.truth) >= 12
    assert {t: len(scene.truth.of(type=t)) for t in TYPES} == {"space": 9, "line": 4, "point": 4}
    assert min(m[..., 1].min() for m in scene.markers.values()) > -1e-12
    assert np.linalg.norm(np.subtract(*scene.poses.position.swapaxes(0, 1)), axis=-1).min() > 0.4
    for name in scene.poses.names:
        assert {c.type for c in scene.truth.of(name)} == set(TYPES)
        spans = list(scene.truth.of(name))
        assert spans[0].begin == 0 and spans[-1].end == 140
        assert all(a.end == b.begin for a, b in pairwise(spans))
        corners = scene.markers[name]
        for c in spans:  # resting on a face; pivots are corners and edges on the carpet
            low = np.sort(corners[c.begin, :, 1])
            np.testing.assert_allclose(low, np.repeat([0.0, 0.2], 4), atol=1e-12)
            if c.type != "space":
                assert abs(c.position[1]) < 1e-12
            if c.type == "point":
                assert np.linalg.norm(corners[c.begin] - c.position, axis=-1).min() < 1e-12


def test_dice_follow_seed_rate_and_length():
    one, same, other = syn.rolling_dice(seed=3), syn.rolling_dice(seed=3), syn.rolling_dice(seed=4)
    np.testing.assert_array_equal(one.poses.rotation, same.poses.rotation)
    assert one.truth == same.truth and np.abs(one.poses.position - other.poses.position).max() > 0.1
    fast = syn.rolling_dice(120.0, 281, seed=3)
    np.testing.assert_allclose(fast.poses.position[::2], one.poses.position, atol=1e-3)
    assert len(syn.rolling_dice(frames=1001).truth) > 6 * len(one.truth)
    with pytest.raises(OptionError, match="at least 55"):
        syn.rolling_dice(frames=40)
    assert syn.rolling_dice(frames=55).frames == 55


def test_samples_and_options():
    assert list(CLIPS) == ["dice", "hinge", "ball", "foot", "walk"] and all(s.name == n for n, s in CLIPS.items())
    again = syn.sample_clips()
    for name, scene in CLIPS.items():
        np.testing.assert_array_equal(scene.poses.rotation, again[name].poses.rotation)
        assert scene.truth == again[name].truth and (scene.motion is not None) == (name == "walk")
    assert [c.type for c in CLIPS["hinge"].truth] == ["space", "line", "space", "line", "space"]
    assert CLIPS["hinge"].truth[2].end_s - CLIPS["hinge"].truth[2].begin_s == pytest.approx(0.4)
    assert [c.type for c in CLIPS["ball"].truth] == ["space", "point", "space"]
    wrong = (
        (syn.hinge, {"rate": 0.0}), (syn.hinge, {"reach": -1.0}), (syn.hinge, {"axis": (0, 0, 0)}),
        (syn.ball_joint, {"reach": 0.0}), (syn.ball_joint, {"rate": np.nan}), (syn.rolling_foot, {"steps": 0}),
        (syn.walking_biped, {"steps": 1}), (syn.walking_biped, {"step_length": 2.0}), (syn.walking_biped, {"rate": 1}),
        (syn.rolling_dice, {"edge": 0.0}), (syn.rolling_dice, {"rate": -60.0}),
    )  # fmt: skip
    for make, options in wrong:
        with pytest.raises(OptionError):
            make(**options)


@pytest.mark.parametrize("axis", [(0, 1, 0), (0, -1, 0), (0, 0, 2), (1, 1, 1)])
def test_hinge_takes_any_axis(axis):
    scene = syn.hinge(axis=axis)
    assert all(np.linalg.norm(np.cross(c.axis, axis)) < 1e-12 for c in scene.truth.of(type="line"))


def test_the_ball_turns_about_all_directions_within_the_longest_window():
    r, _ = pose(CLIPS["ball"], "ball")
    assert min(spread(r[begin : begin + 41])[0] for begin in range(40, 161)) > 0.04


def test_foot_has_walking_times():
    scene = CLIPS["foot"]
    assert [c.type for c in scene.truth] == ["line", "space", "line"] * 3
    for heel, stand, toe in zip(scene.truth[::3], scene.truth[1::3], scene.truth[2::3], strict=True):
        assert 10 <= heel.end - heel.begin <= 15 and 35 <= stand.end - stand.begin <= 50
        assert 20 <= toe.end - toe.begin <= 25 and heel.end == stand.begin and stand.end == toe.begin
        assert toe.position[2] - heel.position[2] == pytest.approx(0.26) and abs(heel.position[1]) < 1e-12
    assert scene.truth[3].begin_s - scene.truth[2].end_s == pytest.approx(0.4)


# the walk -------------------------------------------------------------------------------------------------------------


def joints(motion):
    """World rotations and positions of all joints: plain forward kinematics with matrices, one joint after another."""
    local, offsets = matrix(motion.rotations), np.asarray(motion.skeleton.offsets)
    r, p = np.zeros_like(local), np.zeros((*local.shape[:2], 3))
    for j, parent in enumerate(motion.skeleton.topology.parents):
        if parent < 0:
            r[:, j], p[:, j] = local[:, j], motion.translations[:, 0]
        else:
            r[:, j] = r[:, parent] @ local[:, j]
            p[:, j] = p[:, parent] + r[:, parent] @ offsets[j]
    return r, p


@pytest.mark.parametrize("scene", [CLIPS["walk"], EXTRA["walk, 60 fps"]], ids=["120", "60"])
def test_walk_motion_carries_the_feet(scene):
    """The motion's own feet, by forward kinematics, are the poses, so they are planted to rounding error."""
    motion = scene.motion
    r, p = joints(motion)
    centres = motion.skeleton.segment_centers()
    for name in scene.poses.names:
        j = motion.skeleton.topology.index(name)
        pose_r, pose_t = pose(scene, name)
        np.testing.assert_allclose(r[:, j], pose_r, atol=1e-12)
        np.testing.assert_allclose(p[:, j] + r[:, j] @ centres[j], pose_t, atol=1e-12)
        for c in scene.truth.of(name, "space"):
            assert np.ptp(p[c.begin : c.end + 1, j], axis=0).max() < 1e-12


def test_walk_looks_like_walking():
    motion = CLIPS["walk"].motion
    topology, rate = motion.skeleton.topology, motion.rate
    r, p = joints(motion)
    index = topology.index
    assert len(topology.names) == 21 and len(topology.end_parents) == 5
    assert [len(c) for c in topology.channels] == [6] + [3] * 20
    assert topology.channels[1] == ("Zrotation", "Xrotation", "Yrotation")
    np.testing.assert_allclose(np.linalg.norm(motion.rotations, axis=-1), 1.0, atol=1e-14)
    assert np.sum(motion.rotations[1:] * motion.rotations[:-1], -1).min() > 0.99
    n = round(0.2 * rate)
    assert np.ptp(p[:n], axis=0).max() < 1e-12 and np.ptp(p[-n:], axis=0).max() < 1e-12
    velocity = np.diff(p[:, 0], axis=0) * rate
    assert np.abs(np.diff(velocity, axis=0) * rate).max() < 4.0  # smooth: m/s^2
    steady = velocity[round(1.8 * rate) : round(3.7 * rate), 2]
    assert 2.7 < p[-1, 0, 2] < 2.8 and steady.min() > 0.6 and steady.max() < 1.4
    assert p[:, 0, 1].min() > 0.8 and p[:, 0, 1].max() < 0.95 and np.abs(p[:, 0, 0]).max() < 0.05
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        bend = matrix(motion.rotations[:, index(side + "Leg")])  # a pure hinge about x, shank backwards
        np.testing.assert_allclose(bend[:, 0, 0], 1.0, atol=1e-12)
        flexion = np.arctan2(bend[:, 2, 1], bend[:, 1, 1])
        assert flexion.min() > 0.2 and flexion.max() < 1.4
        foot, toe = index(side + "Foot"), index(side + "ToeBase")
        heel = p[:, foot] + r[:, foot] @ np.array([0, -0.08, -0.05])
        end = p[:, toe] + r[:, toe] @ motion.skeleton.end_offsets[topology.end_parents.index(toe)]
        assert min(heel[:, 1].min(), end[:, 1].min()) > -1e-12 and p[:, toe, 1].min() > 0.02 - 1e-12
        assert sign * p[:, foot, 0].min() > 0.05 or sign * p[:, foot, 0].max() > 0.05
        hand, other = p[:, index(side + "Hand"), 2] - p[:, 0, 2], p[:, foot, 2] - p[:, 0, 2]
        assert np.corrcoef(hand, other)[0, 1] < -0.6  # arms swing against the legs
    planted = [syn.labels(CLIPS["walk"], s + "Foot") > 0 for s in ("Left", "Right")]
    assert (planted[0] | planted[1]).all() and not (planted[0] & planted[1]).all()


def test_walk_truth_by_foot_and_toe():
    truth = CLIPS["walk"].truth
    for side in ("Left", "Right"):
        kinds = [c.type for c in truth.of(side + "Foot")]
        assert kinds == ["space", "line", "line"] * 3 + ["space"]
        assert [c.type for c in truth.of(side + "ToeBase")] == ["space", "line"] * 3 + ["space"]
        plants = [c for c in truth.of(side + "Foot", "space")]
        assert all(c.frames > 0.3 * 120 for c in plants)
        steps = np.diff([c.position[2] for c in plants])
        np.testing.assert_allclose(steps, [1.1, 1.1, 0.55] if side == "Left" else [0.55, 1.1, 1.1], atol=1e-12)
        heels = [c.position[1] for c in truth.of(side + "ToeBase", "line")]
        np.testing.assert_allclose(heels, 0.0, atol=1e-12)


# noise, spikes, gaps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("flat", [False, True], ids=["box", "plane"])
def test_kabsch_finds_a_known_rotation(angle, flat):
    rng = np.random.default_rng(1)
    local = rng.normal(size=(6, 3)) * 0.1
    if flat:
        local[:, 2] = 0.0
    axis = rng.normal(size=(50, 3))
    q = spatial.quat_exp(angle * axis / np.linalg.norm(axis, axis=-1, keepdims=True))
    t = rng.normal(size=(50, 3))
    world = np.einsum("fij,mj->fmi", matrix(q), local) + t[:, None]
    found, at = syn.kabsch(local, world)
    np.testing.assert_allclose(matrix(found), matrix(q), atol=1e-12)
    np.testing.assert_allclose(at, t, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-14)


def test_kabsch_never_reflects_and_passes_gaps_on():
    rng = np.random.default_rng(2)
    local, world = rng.normal(size=(5, 3)), rng.normal(size=(20, 5, 3))
    world[3, 2, 1] = np.nan
    q, t = syn.kabsch(local, world)
    good = np.arange(20) != 3
    assert np.isnan(q[3]).all() and np.isnan(t[3]).all()
    np.testing.assert_allclose(np.linalg.det(matrix(q[good])), 1.0, atol=1e-12)


def test_quaternions_agree_with_matrices():
    rng = np.random.default_rng(3)
    q = spatial.quat_exp(rng.normal(size=(200, 3)) * rng.choice([1e-9, 1.0, 3.0], (200, 1)))
    v = rng.normal(size=(200, 3))
    np.testing.assert_allclose(spatial.quat_to_matrix(q), matrix(q), atol=1e-14)
    np.testing.assert_allclose(spatial.quat_rotate(q, v), np.einsum("fij,fj->fi", matrix(q), v), atol=1e-14)
    np.testing.assert_allclose(matrix(spatial.quat_mul(q, q[::-1])), matrix(q) @ matrix(q[::-1]), atol=1e-14)
    np.testing.assert_allclose(matrix(spatial.quat_from_matrix(matrix(q))), matrix(q), atol=1e-14)
    np.testing.assert_allclose(matrix(spatial.quat_inv(q)), np.swapaxes(matrix(q), -1, -2), atol=1e-15)


@pytest.mark.parametrize("sigma", [0.001, 0.003])
@pytest.mark.parametrize("what", ["dice", "foot"])
def test_noise_has_the_size_it_should(what, sigma):
    clean = syn.rolling_dice(frames=2001) if what == "dice" else syn.rolling_foot(steps=20)
    noisy = syn.with_noise(clean, sigma, seed=7)
    name, n = clean.poses.names[0], 8
    (r0, t0), (r1, t1) = pose(clean, name), pose(noisy, name)
    frames = clean.frames
    assert np.std(noisy.markers[name] - clean.markers[name]) == pytest.approx(sigma, rel=0.03)
    assert np.std(t1 - t0) == pytest.approx(sigma / np.sqrt(n), rel=4 / np.sqrt(6 * frames))
    error = rotvec(np.swapaxes(r0, -1, -2) @ r1)
    expected = np.sqrt(np.diag(syn.rotation_noise(clean.marker_layout[name], sigma)))
    np.testing.assert_allclose(error.std(0), expected, rtol=4 / np.sqrt(2 * frames))
    assert np.abs(error.mean(0)).max() < 4 * expected.max() / np.sqrt(frames)
    white = np.sum(error[1:] * error[:-1]) / np.sum(error**2)
    assert abs(white) < 4 / np.sqrt(3 * frames)
    if what == "dice":
        np.testing.assert_allclose(expected, sigma / 0.4, rtol=1e-12)
    assert noisy.truth == clean.truth and noisy.poses.valid.all()
    assert np.sum(noisy.poses.rotation[1:] * noisy.poses.rotation[:-1], -1).min() > 0.9


def test_noise_follows_its_seed_and_zero_is_none():
    clean = CLIPS["dice"]
    a, b, c = (syn.with_noise(clean, 0.001, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.poses.position, b.poses.position)
    assert np.abs(a.poses.position - c.poses.position).max() > 1e-4
    offsets = a.markers["die_a"] - clean.markers["die_a"], a.markers["die_b"] - clean.markers["die_b"]
    assert abs(np.corrcoef(offsets[0].ravel(), offsets[1].ravel())[0, 1]) < 0.1
    none = syn.with_noise(clean, 0.0)
    np.testing.assert_allclose(none.poses.position, clean.poses.position, atol=1e-14)
    np.testing.assert_allclose(matrix(none.poses.rotation), matrix(clean.poses.rotation), atol=1e-13)
    with pytest.raises(OptionError):
        syn.with_noise(clean, -1.0)


def test_noisy_motion():
    clean = CLIPS["walk"]
    noisy = syn.with_noise(clean, 0.002, seed=4)
    assert noisy.motion.skeleton is clean.motion.skeleton
    (r0, p0), (r1, p1) = joints(clean.motion), joints(noisy.motion)
    error = rotvec(np.swapaxes(r0, -1, -2) @ r1)
    np.testing.assert_allclose(error.std((0, 2)), 0.002 / 0.4, rtol=0.12)
    assert np.std(p1[:, 0] - p0[:, 0]) == pytest.approx(0.002 / np.sqrt(8), rel=0.12)
    j = clean.motion.skeleton.topology.index("LeftFoot")
    assert np.std(p1[:, j] - p0[:, j]) > 2 * np.std(p1[:, 0] - p0[:, 0])
    np.testing.assert_array_equal(syn.noisy_motion(clean.motion, 0.002, 4).rotations, noisy.motion.rotations)
    np.testing.assert_allclose(joints(syn.noisy_motion(clean.motion, 0.0))[1], p0, atol=1e-13)


def test_outliers_are_isolated_and_of_the_given_size():
    clean = CLIPS["walk"]
    spiky = syn.with_outliers(clean, 0.05, 0.03, seed=1)
    shift = np.linalg.norm(spiky.poses.position - clean.poses.position, axis=-1)
    for i, name in enumerate(clean.poses.names):
        hit = np.flatnonzero(shift[:, i])
        assert len(hit) == round(0.05 * clean.frames) and np.diff(hit).min() >= 3
        np.testing.assert_allclose(shift[hit, i], 0.03, rtol=1e-12)
        moved = np.linalg.norm(spiky.markers[name] - clean.markers[name], axis=-1)
        np.testing.assert_allclose(moved, np.repeat(shift[:, i, None], 8, 1), atol=1e-14)
    assert len({tuple(np.flatnonzero(shift[:, i])) for i in range(4)}) == 4
    np.testing.assert_array_equal(spiky.poses.rotation, clean.poses.rotation)
    np.testing.assert_array_equal(spiky.poses.position, syn.with_outliers(clean, 0.05, 0.03, seed=1).poses.position)
    assert spiky.truth == clean.truth and spiky.motion is clean.motion
    with pytest.raises(OptionError, match="isolated"):
        syn.with_outliers(clean, 0.5)


def test_gaps():
    clean = CLIPS["dice"]
    gappy = syn.with_gaps(clean, fraction=0.1, seconds=0.1, seed=2)
    lost = ~gappy.poses.valid
    np.testing.assert_array_equal(lost.sum(0), 14)
    np.testing.assert_array_equal(np.isnan(gappy.poses.position).any(-1), lost)
    np.testing.assert_array_equal(np.isnan(gappy.poses.rotation).all(-1), lost)
    for i, name in enumerate(clean.poses.names):
        np.testing.assert_array_equal(np.isnan(gappy.markers[name]).all((1, 2)), lost[:, i])
    np.testing.assert_array_equal(gappy.poses.position[~lost], clean.poses.position[~lost])
    chosen = syn.with_gaps(clean, spans=[("DIE_B", 10, 12), ("die_b", 140, 140)])
    assert chosen.poses.valid[:, 0].all() and list(np.flatnonzero(~chosen.poses.valid[:, 1])) == [10, 11, 12, 140]
    assert gappy.truth == clean.truth and clean.poses.valid.all()
    with pytest.raises(OptionError, match="not inside"):
        syn.with_gaps(clean, spans=[("die_a", 100, 141)])
    with pytest.raises(UnknownNameError):
        syn.with_gaps(clean, spans=[("die_c", 1, 2)])


def test_faults_combine_in_any_order():
    clean = CLIPS["foot"]
    one = syn.with_gaps(syn.with_noise(syn.with_outliers(clean, seed=1), 0.001, seed=2), seed=3)
    two = syn.with_noise(syn.with_outliers(syn.with_gaps(clean, seed=3), seed=1), 0.001, seed=2)
    np.testing.assert_array_equal(one.poses.valid, two.poses.valid)
    np.testing.assert_allclose(one.poses.position, two.poses.position, atol=1e-12)
    seen = one.poses.valid[:, 0]
    np.testing.assert_allclose(matrix(one.poses.rotation[seen]), matrix(two.poses.rotation[seen]), atol=1e-12)
    q = one.poses.rotation[seen]
    assert np.sum(q[1:] * q[:-1], -1).min() > 0.9 and np.isfinite(one.poses.position[seen]).all()
    assert replace(one, truth=clean.truth).truth == two.truth
