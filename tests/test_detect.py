"""Detection as a whole: the same answer however it is asked for, few compilations, clear errors, nothing leaks."""

import dataclasses

import jax
import numpy as np
import pytest

from benchmarks.speed import walking_crowd
from kinjax import synthetic
from kinjax.annotations import Template
from kinjax.detect import Settings, calibrate, detect, detect_many, engine, pipeline
from kinjax.detect.planning import numbers, pivot_patterns
from kinjax.detect.prepare import prepared
from kinjax.detect.refit import span_places
from kinjax.errors import OptionError, ShapeError, TemplateError, TemplateTooShort, UnknownNameError
from kinjax.kinematics import object_poses
from kinjax.motion import make_poses

FEET = ("LeftFoot", "RightFoot")


@pytest.fixture(scope="module")
def walk():
    return synthetic.walking_biped()


@pytest.fixture(scope="module")
def foot():
    return synthetic.rolling_foot()


def spans(found):
    return [(c.object, c.type, c.begin, c.end) for c in found.constraints]


def test_motion_and_its_poses_give_the_same(walk):
    a = detect(walk.motion, FEET)
    b = detect(object_poses(walk.motion, FEET))
    assert spans(a) == spans(b) and len(a.constraints) > 4
    for x, y in zip(a.constraints, b.constraints, strict=True):
        np.testing.assert_allclose(x.position, y.position, atol=2e-5)


@pytest.mark.parametrize("options", [{"method": "paper", "thresholds": (2e-3, 2e-3)}, {}, {"types": ("space", "line")}])
def test_few_objects_at_a_time_are_the_same_as_all_at_once(options, monkeypatch):
    motion = walking_crowd(300, 5)
    settings = Settings().but(**{"types": ("space",)} | options)
    clip = prepared(motion, None, None, settings)
    plan = pipeline._run(clip, settings, (), ())[0]
    found = []
    for width in (8, 2, 1):
        monkeypatch.setattr(engine, "CACHED", width * clip.arrays.valid.shape[-1])
        run = jax.jit(lambda numbers, joints, plan=plan: engine.run_joints.__wrapped__(plan, numbers, joints, (), ()))
        found.append(jax.tree.leaves(run(numbers(settings, clip.rate, pivot_patterns((), clip)), clip.arrays)))
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            close = {"rtol": 1e-6, "atol": 1e-6} if jax.numpy.issubdtype(a.dtype, jax.numpy.floating) else {"rtol": 0}
            np.testing.assert_allclose(a, b, **close)


def test_names_in_any_case_and_order(walk):
    a = detect(walk.motion, ["rightfoot", "LEFTFOOT", "RightFoot"])
    assert a.objects == ("RightFoot", "LeftFoot")
    assert sorted(spans(a)) == sorted(spans(detect(walk.motion, FEET)))


@pytest.mark.parametrize("method", ["paper", "robust"])
def test_joints_in_their_order_are_the_same_in_any_other(method):
    """All joints in the skeleton's order are taken as they are, in another order they are picked out one by one."""
    options = {"method": method, "types": ("space",)} | ({"thresholds": (2e-3, 2e-3)} if method == "paper" else {})
    motion = walking_crowd(600, 29)
    names = motion.skeleton.names
    a, b = detect(motion, **options), detect(motion, list(reversed(names)), **options)
    assert prepared(motion, None, None, Settings()).arrays.at is None
    assert b.objects == tuple(reversed(a.objects))
    np.testing.assert_array_equal(a.sigma_3, b.sigma_3[:, ::-1])
    assert a.sigma_1.shape == a.eps_1.shape == a.valid.shape == a.sigma_3.shape
    found = [{(c.object, c.type, c.begin, c.end, *c.position) for c in d.constraints} for d in (a, b)]
    assert found[0] == found[1] and found[0]


@pytest.mark.parametrize("distance", [1e3])
def test_one_kilometre_from_the_origin(walk, distance):
    motion = walk.motion
    shift = np.array([distance, 0.0, -distance])
    far = dataclasses.replace(motion, translations=motion.translations + shift)
    a, b = detect(motion, FEET), detect(far, FEET)
    assert spans(a) == spans(b)
    for x, y in zip(a.constraints, b.constraints, strict=True):
        np.testing.assert_allclose(np.array(y.position) - shift, x.position, atol=2e-5)


def test_batch_equals_single_clips_and_nothing_leaks(foot):
    short = dataclasses.replace(foot.poses.slice(0, 329), clip="short")
    broken = dataclasses.replace(
        foot.poses, position=np.where(np.arange(foot.frames)[:, None, None] % 3 == 0, np.nan, foot.poses.position)
    )
    broken = make_poses(broken.names, broken.rotation, broken.position, broken.rate, clip="broken")
    clips = [foot.poses, broken, short]
    together = detect_many(clips)
    for clip, found in zip(clips, together, strict=True):
        alone = detect(clip)
        assert spans(alone) == spans(found) and found.clip == clip.clip
        np.testing.assert_array_equal(np.asarray(alone.sigma_3), np.asarray(found.sigma_3))
        np.testing.assert_array_equal(alone.missing, found.missing)
    assert together[1].missing[0] > 100 and together[0].missing[0] == 0


def test_padding_changes_nothing(foot):
    whole = detect(foot.poses, types=("space", "line", "point"))
    q, t = np.asarray(foot.poses.rotation), np.asarray(foot.poses.position)
    extra = 40
    longer = make_poses(
        foot.poses.names,
        np.concatenate([q, np.full((extra, *q.shape[1:]), np.nan)]),
        np.concatenate([t, np.full((extra, *t.shape[1:]), np.nan)]),
        foot.poses.rate,
    )
    assert spans(detect(longer, types=("space", "line", "point"))) == spans(whole)


@pytest.fixture
def compilations():
    """A list that grows by one with every XLA compilation."""
    seen = []

    def listen(name, seconds, **_):
        if name == "/jax/core/compile/backend_compile_duration":
            seen.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


def test_a_second_clip_of_the_same_bucket_compiles_nothing(foot, walk, compilations):
    detect(foot.poses.slice(0, 380))
    detect(walk.motion.slice(0, 350), FEET)
    assert compilations  # the listener hears
    compilations.clear()
    detect(foot.poses.slice(0, 360))
    detect(foot.poses.slice(20, 380), still=(0.2, 2.0), min_duration=0.1, max_gap=0.05)
    detect(walk.motion.slice(20, 360), ["RightFoot", "LeftFoot"])
    assert not compilations


def test_missing_frames_are_masked_counted_and_said(foot):
    gaps = synthetic.with_gaps(foot, spans=[("foot", 60, 72)])
    found = detect(gaps.poses)
    assert found.missing[0] == 13
    assert any("13 of" in w and "missing" in w for w in found.warnings)
    assert len(found.constraints) == len(detect(foot.poses).constraints)  # 0.13 s out of sight cuts no stance


def test_spikes_are_removed_and_do_not_cut(foot):
    spoiled = synthetic.with_outliers(foot, fraction=0.03, size=0.05, seed=1)
    assert len(detect(spoiled.poses).constraints) == len(detect(foot.poses).constraints)


@pytest.mark.slow
def test_calibrated_patterns_equal_templates(walk):
    template = [Template("LeftFoot", *_stance(walk))]
    pattern = calibrate(walk.motion, template)
    assert (
        pattern[0].object == "LeftFoot"
        and pattern[0].kept >= pattern[0].intervals // 2
        and pattern[0].unit == "per_second"
    )
    assert spans(detect(walk.motion, ["LeftFoot"], patterns=pattern)) == spans(
        detect(walk.motion, ["LeftFoot"], templates=template)
    )


def _stance(scene):
    c = max((c for c in scene.truth if c.object == "LeftFoot" and c.type == "space"), key=lambda c: c.frames)
    return c.begin, c.end


def test_a_second_template_refines(walk):
    stances = [(c.begin, c.end) for c in walk.truth.of("LeftFoot", "space")][:2]
    noisy = synthetic.with_noise(walk, 0.001, 3).poses
    one = calibrate(noisy, [Template("LeftFoot", *stances[0])], method="paper")[0]
    two = calibrate(noisy, [Template("LeftFoot", *s) for s in stances], method="paper")[0]
    assert len(two.sigma_max) == 4 and two.frames == (*stances[0], *stances[1])
    assert two.sigma_max[:2] == one.sigma_max


def test_rate_and_stride(foot):
    half = detect(foot.poses, rate=50.0)
    full = detect(foot.poses)
    assert len(half.constraints) == len(full.constraints)
    for a, b in zip(half.constraints, full.constraints, strict=True):
        assert abs(a.begin - b.begin) <= 4 and abs(a.end - b.end) <= 4  # frames of the original clip


def test_relative_frames():
    scene = synthetic.rolling_foot()
    rng = np.random.default_rng(0)
    from scipy.spatial.transform import Rotation

    drift = np.cumsum(rng.normal(size=(scene.frames, 3)) * 0.03, 0)
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(size=(scene.frames, 3)) * 0.05, 0))
    q = Rotation.from_quat(scene.poses.rotation[:, 0][:, [1, 2, 3, 0]])
    moved = (turn * q).as_quat()[:, [3, 0, 1, 2]]
    poses = make_poses(
        ["foot", "treadmill"],
        np.stack([moved, turn.as_quat()[:, [3, 0, 1, 2]]], 1),
        np.stack([turn.apply(scene.poses.position[:, 0]) + drift, drift], 1),
        scene.rate,
    )
    assert spans(detect(poses, ["foot"], relative_to="treadmill")) == spans(detect(scene.poses))
    assert not detect(poses, ["foot"]).constraints


def test_results_are_pytrees(foot):
    found = detect(foot.poses)
    doubled = jax.tree.map(lambda x: x, found)
    assert spans(doubled) == spans(found) and all(
        isinstance(x, (np.ndarray, float, int)) for x in jax.tree.leaves(found)
    )


def test_one_frame_and_two_frames(foot):
    with pytest.raises(OptionError, match=r"so short"):
        detect(foot.poses.slice(0, 0))
    assert not detect(foot.poses.slice(0, 1), method="paper", thresholds=(1e-3, 1e-3), min_duration=0.08).constraints


def test_only_missing_frames(foot):
    q, t = np.asarray(foot.poses.rotation), np.full_like(foot.poses.position, np.nan)
    found = detect(make_poses(["foot"], q, t, 100.0))
    assert not found.constraints and found.missing[0] == foot.frames


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (dict(objects=["LeftFot"]), UnknownNameError, "LeftFoot"),
        (dict(templates=[Template("LeftFoot", 10, 100000)]), TemplateError, "outside the clip"),
        (dict(templates=[Template("LeftFoot", 30, 20)]), TemplateError, "ends before it begins"),
        (dict(templates=[Template("LeftFoot", 10, 11)]), TemplateTooShort, "at least"),
        (dict(templates=[Template("LeftFoot", 10, 60), Template("LeftFoot", 40, 90)]), TemplateError, "overlap"),
        (dict(templates=[Template("Nose", 10, 60)]), UnknownNameError, "Nose"),
        (dict(method="paper"), OptionError, "template"),
        (dict(methd="paper"), OptionError, "method"),
        (dict(method="magic"), OptionError, "robust"),
        (dict(types=("plane",)), OptionError, "space, line, point"),
        (dict(thresholds=(1.0, 1.0)), OptionError, "paper"),
        (dict(rate=-1.0), OptionError, "rate"),
    ],
)
def test_errors_say_what_to_do(walk, options, error, words):
    options = {"objects": FEET, **options}
    with pytest.raises(error, match=words):
        detect(walk.motion, **options)


def test_shapes_are_checked():
    with pytest.raises(ShapeError):
        make_poses(["a"], np.zeros((3, 1, 3)), np.zeros((3, 1, 3)), 30.0)
    with pytest.raises(ShapeError, match="length 2"):
        make_poses(["a"], np.ones((3, 1, 4)), np.zeros((3, 1, 3)), 30.0)
    with pytest.raises(ShapeError, match="Motion or Poses"):
        detect([1, 2, 3])


def test_settings_are_hashable_and_checked():
    assert hash(Settings()) == hash(Settings()) and Settings().but(types=("LINE",)).types == ("line",)


@pytest.mark.slow
def test_line_templates_teach_the_noise_of_pivots(foot):
    noisy = synthetic.with_noise(foot, 0.003, 2).poses
    toe = foot.truth.of("foot", "line")[1]
    options = {"types": ("space", "line", "point"), "templates": [Template("foot", toe.begin, toe.end, "line")]}
    taught, untaught = detect(noisy, **options), detect(noisy, types=options["types"])
    line = next(p for p in taught.patterns if p.unit == "per_window")
    assert line.status == "ok" and 0.0025 < line.eps_max[0] < 0.005  # noise of 3 mm on each of eight markers, and no motion
    again = detect(noisy, types=options["types"], patterns=calibrate(noisy, options["templates"]))
    assert spans(again) == spans(taught)
    assert len(taught.constraints.of("foot", "line")) == len(untaught.constraints.of("foot", "line")) == 6


def test_a_template_of_a_type_that_is_not_asked_for_is_an_error(foot):
    with pytest.raises(TemplateError, match="asked for"):
        detect(foot.poses, templates=[Template("foot", 92, 114, "line")])


def test_window_rewards_do_not_depend_on_how_many_lanes_there_are():
    """A body at rest earns the same alone and among many (a compiler's reduction once made it depend on the size)."""
    import jax.numpy as jnp

    from kinjax.detect.windows import Reward, window_rewards

    def rewards(lanes, frames):
        q = jnp.zeros((4, lanes, frames), jnp.float32).at[0].set(1)
        t, seen = jnp.zeros((3, lanes, frames), jnp.float32), jnp.ones((lanes, frames), bool)
        reward = Reward(*(jnp.float32(x) for x in (4.0, 0.003, 28.0, 0.2, 1e-4, 0.002, 0.01)))
        reward = reward._replace(**{k: jnp.full(lanes, getattr(reward, k)) for k in ("nu", "near", "turn")})
        return jax.jit(lambda q, t, v: window_rewards(q, t, v, ~v, 6, 12, reward, rest=False))(q, t, seen)

    few, many = np.asarray(rewards(2, 320)), np.asarray(rewards(40, 320))
    np.testing.assert_allclose(few[-1, :, 20], 12 * 4.0 - 28.0, rtol=1e-5)
    np.testing.assert_array_equal(many, np.broadcast_to(few[:, :1], many.shape))


def test_a_pivot_is_measured_against_the_noise_at_its_lever():
    """Every window's reward against NumPy, frame by frame: least squares for the pivot, noise larger the farther it is."""
    import jax.numpy as jnp
    from scipy.spatial.transform import Rotation

    from kinjax.detect.windows import Reward, window_rewards

    rng = np.random.default_rng(3)
    frames, ridge, beta, opening, reach, nu, near, turn = 30, 1e-4, 4.0, 20.0, 0.2, 0.0065, 0.002, 0.05
    turned = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.06, size=(frames, 3)), 0))
    R = turned.as_matrix()
    t = np.array([1.0, 2.0, 3.0]) - R @ np.array([0.12, 0.02, -0.05]) + rng.normal(scale=0.002, size=(frames, 3))
    t[15:] += 0.02 * np.arange(15)[:, None]
    lanes = [jnp.asarray([x], jnp.float32) for x in (nu, near, turn)]
    f = jnp.float32
    reward = Reward(f(beta), lanes[0], f(opening), f(reach), f(ridge), *lanes[1:])
    q = jnp.asarray(turned.as_quat()[:, [3, 0, 1, 2]].T[:, None], jnp.float32)
    seen = jnp.ones((1, frames), bool)
    found = window_rewards(q, jnp.asarray(t.T[:, None], jnp.float32), seen, ~seen, 6, 9, reward, rest=False)
    levers = []
    for n in range(6, 10):
        for last in range(n - 1, frames):
            at = slice(last - n + 1, last + 1)
            # unknowns: body point p, world point x; rows R p - x = -t, and the ridge as n further equations of weight
            a = np.vstack([np.hstack([R[at].reshape(-1, 3), np.tile(-np.eye(3), (n, 1))]), np.sqrt(n * ridge) * np.eye(3, 6)])
            b = np.concatenate([-t[at].ravel(), np.zeros(3)])
            solution = np.linalg.lstsq(a, b, rcond=None)[0]
            energy, lever = ((a @ solution - b) ** 2).sum() / n, np.linalg.norm(solution[:3])
            level = max(nu**2, near**2 + (turn * lever) ** 2)
            expected = n * (beta - energy / level) - opening if lever <= reach else -np.inf
            levers.append((turn * lever) ** 2 > nu**2 - near**2)
            if abs(lever - reach) > 1e-3:
                np.testing.assert_allclose(found[n - 6, 0, last], expected, rtol=2e-3, atol=0.02)
    assert any(levers) and not all(levers)  # both sides of the maximum


@pytest.mark.parametrize("method", ["robust", "window"])
def test_float64_gives_the_same_constraints(foot, method):
    single = detect(foot.poses, method=method)
    with jax.enable_x64(True):
        double = detect(foot.poses, method=method)
    assert double.sigma_3.dtype == np.float64 and spans(single) == spans(double)


def test_window_refuses_patterns_that_it_would_not_use(walk):
    pattern = calibrate(walk.motion, [Template("LeftFoot", *_stance(walk))])
    with pytest.raises(OptionError, match="templates="):
        detect(walk.motion, ["LeftFoot"], method="window", patterns=pattern)


def test_places_of_spans_by_plain_means():
    """More spans than a chunk holds, that share end frames, are one frame or a hundred long, a metre apart, or lie where frames
    are missing."""
    rng = np.random.default_rng(4)
    frames, objects, slots = 640, 4, 64
    begin, end = np.zeros((slots, objects), np.int32), np.zeros((slots, objects), np.int32)
    used = np.zeros((slots, objects), bool)
    t = rng.normal(size=(3, objects, frames)) * 1e-4
    for lane, (most, lengths) in enumerate(((40, (0, 1, 5, 12)), (7, (0, 1, 5, 12)), (0, ()), (6, (8, 16, 31, 150)))):
        at, gap, where = 0, 1, 0.0
        for k in range(most):
            long = int(rng.choice(lengths))
            begin[k, lane], end[k, lane], used[k, lane] = at, at + long, True
            where = rng.normal(size=(3, 1)) if gap else where  # a frame of two rests is where both are
            t[:, lane, at + (gap == 0) : at + long + 1] += where
            gap = int(rng.choice([0, 1, 3])) if long else 1
            at += long + gap
        assert at < frames - 1
    valid = rng.random((objects, frames)) < 0.9
    for k, lane in zip(*np.nonzero(used), strict=True):
        valid[lane, begin[k, lane]] = True  # rests begin where something is seen
    t = np.where(valid, t, 0)
    arguments = (jax.numpy.asarray(x) for x in (np.float32(t), valid, begin, end, used))
    place = jax.jit(span_places)(*arguments)
    for k, lane in zip(*np.nonzero(used), strict=True):
        x = t[:, lane, begin[k, lane] : end[k, lane] + 1][:, valid[lane, begin[k, lane] : end[k, lane] + 1]]
        np.testing.assert_allclose(place.center[:, k, lane], x.mean(1), atol=2e-6)
        spread = np.sqrt(((x - x.mean(1, keepdims=True)) ** 2).sum(0).mean())
        np.testing.assert_allclose(place.spread[k, lane], spread, atol=5e-6)


@pytest.mark.parametrize("order", ["C", "F"])  # as a person has them, and as readers leave them
def test_rotations_that_are_not_unit_are_normalised(walk, order):
    rotations = np.asarray(walk.motion.rotations)
    wanted = detect(walk.motion, FEET)
    long = dataclasses.replace(walk.motion, rotations=np.asarray(1.5 * rotations, order=order))
    assert spans(detect(long, FEET)) == spans(wanted)
    none = np.array(rotations, order=order)
    none[3:5, 2] = 0
    clip = prepared(dataclasses.replace(walk.motion, rotations=none), None, None, Settings())
    assert clip.valid.all() and np.isfinite(clip.arrays.rotations).all()
    np.testing.assert_array_equal(clip.arrays.rotations[2, :, 3:5], np.eye(4)[:, :1].repeat(2, 1))
    np.testing.assert_allclose(np.linalg.norm(clip.arrays.rotations, axis=1), 1, atol=1e-6)
