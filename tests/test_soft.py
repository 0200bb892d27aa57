"""Soft detection as a whole: it tends to the hard one, and its gradient is finite, right, and stays where it belongs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinjax import Template, detect, soft, synthetic
from kinjax.errors import OptionError, ShapeError, TemplateError
from kinjax.motion import Poses


def walk(frames=220, noise=0.001):
    scene = synthetic.with_noise(synthetic.walking_biped(), noise, seed=1)
    return scene.poses.select(["LeftFoot", "RightFoot"]).slice(0, frames - 1)


def hard_labels(poses, **options):
    found = detect.detect(poses, **options)
    return np.stack([found.constraints.mask(found.frames, o, "space") for o in found.objects])


CLIPS = {
    "walk": (lambda: synthetic.with_noise(synthetic.walking_biped(), 0.001, seed=1).poses, {}),
    "walk with gaps": (lambda: synthetic.with_gaps(synthetic.walking_biped(), 0.1, seed=1).poses, {}),
    "foot": (lambda: synthetic.rolling_foot().poses, {}),
    "foot at 60 Hz": (lambda: synthetic.with_noise(synthetic.rolling_foot(rate=60.0), 0.001).poses, {}),
    "dice": (lambda: synthetic.rolling_dice().poses, {"method": "paper", "thresholds": (2e-3, 2e-3)}),
}
SHORT = "walk", "dice"


@pytest.mark.parametrize("name", [n if n in SHORT else pytest.param(n, marks=pytest.mark.slow) for n in CLIPS])
def test_labels_tend_to_the_hard_ones(name):
    make, options = CLIPS[name]
    poses = make()
    hard, task = hard_labels(poses, **options), soft.prepare(poses, **options)
    off = [
        float(np.abs(np.asarray(soft.detect(task, temperature=t).labels) - hard).mean())
        for t in (0.2, 0.05, 0.01, 1e-3)
    ]
    print(name, [f"{x:.4f}" for x in off])
    assert off[0] > off[1] >= off[2] >= off[3]
    # what is left are frames whose value lies on a threshold to 1e-3 of it
    assert off[3] < 0.001


@pytest.mark.parametrize("method", ["robust", pytest.param("paper", marks=pytest.mark.slow)])
def test_a_template_teaches_the_thresholds_of_the_hard_method(method):
    scene = synthetic.with_noise(synthetic.walking_biped(), 0.002, seed=2)
    stance = max(scene.truth.of("LeftFoot", "space"), key=lambda c: c.frames)
    template = Template("LeftFoot", stance.begin, stance.end)
    pattern = detect.calibrate(scene.poses, [template], method=method)[0]
    task = soft.prepare(scene.poses, ["LeftFoot"], templates=[template], method=method)
    found = soft.detect(task, temperature=1e-3)
    # the largest kept value is one of a template's tail: at this temperature it is met to a few parts in a thousand
    assert float(found.limits.sigma_max[0]) == pytest.approx(pattern.sigma_max[0], rel=0.01)
    assert float(found.limits.eps_max[0]) == pytest.approx(pattern.eps_max[0], rel=0.01)
    hard = hard_labels(scene.poses, objects=["LeftFoot"], templates=[template], method=method)
    assert np.abs(np.asarray(found.labels) - hard).mean() < 0.01


def direction(x, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=np.shape(x)), jnp.result_type(float))


def check_each(f, at, steps, rel):
    """Forward and reverse derivatives along a direction of each argument against central differences; three programs in all."""
    f = jax.jit(f)
    gradient = jax.jit(jax.grad(f, tuple(range(len(at)))))(*at)
    forward = jax.jit(lambda d: jax.jvp(f, at, d)[1])
    none = tuple(jnp.zeros_like(x) for x in at)
    for i, (x, step, back) in enumerate(zip(at, steps, gradient, strict=True)):
        d = direction(x)
        slope = forward((*none[:i], d, *none[i + 1 :]))
        after, before = (f(*at[:i], x + s * d, *at[i + 1 :]) for s in (step, -step))
        assert slope != 0 and np.isfinite(slope)
        np.testing.assert_allclose(jnp.sum(back * d), slope, rtol=1e-9)
        np.testing.assert_allclose(slope, (after - before) / (2 * step), rtol=rel[i])


@pytest.mark.parametrize("method", [pytest.param("robust", marks=pytest.mark.slow), "paper"])
def test_gradients_through_the_whole_against_finite_differences(x64, method):
    scene = synthetic.with_noise(synthetic.walking_biped(), 0.002, seed=2)
    motion, t = scene.motion.slice(0, 159), jnp.asarray(0.2)
    names = ["LeftFoot", "RightFoot"]
    template = Template("LeftFoot", 20, 60)
    task = soft.prepare(motion, names, templates=[template], method=method)
    target = direction(np.zeros((2, 160)), 1)

    def loss(r, x, o, w):
        there = task.with_motion(r, x, o).with_template(w)
        return jnp.sum(soft.detect(there, temperature=t).labels * target)

    weights = jnp.clip(jnp.asarray(task.templates.frames[:2, :160]), 0.1, 0.9)
    at = jnp.asarray(motion.rotations), jnp.asarray(motion.translations), jnp.asarray(motion.skeleton.offsets), weights
    # the Hampel mask must not change between the two sides: steps are small
    check_each(loss, at, (1e-8, 1e-8, 1e-8, 1e-6), (2e-5,) * 4)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["robust", "paper"])
def test_gradients_of_given_thresholds_and_poses(x64, method):
    poses = walk(160)
    task = soft.prepare(poses, method=method)
    values = (1.8, 0.18) if method == "robust" else (0.02, 0.002)
    limits = jnp.stack([jnp.full(2, v) for v in values])

    def loss(l, q, x):
        return jnp.sum(soft.detect(task.with_poses(q, x), tuple(l), temperature=jnp.asarray(0.2)).labels ** 2)

    at = limits, jnp.asarray(poses.rotation), jnp.asarray(poses.position)
    check_each(loss, at, (1e-7, 1e-8, 1e-8), (1e-6, 2e-5, 2e-5))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["robust", "paper"])
def test_float32_gradient_is_that_of_float64(method):
    """Of the very same arrays: rounding a walk to float32 shakes its speeds by 1e-5 m/s, and makes another motion of it."""
    task = soft.prepare(walk(160), method=method)
    limits = np.float32([[1.8, 1.8], [0.18, 0.18]] if method == "robust" else [[0.02, 0.02], [0.002, 0.002]])

    def slopes(task, limits):
        def f(l, t):
            y = soft.detect(replace(task, clip=task.clip._replace(t=t)), (l[0], l[1]), temperature=0.2)
            return jnp.mean(y.labels**2)

        return jax.jit(jax.grad(f, (0, 1)))(jnp.asarray(limits), jnp.asarray(task.clip.t))

    got = slopes(task, limits)
    assert got[0].dtype == jnp.float32
    with jax.enable_x64(True):
        wide = lambda x: np.float64(x) if np.asarray(x).dtype == np.float32 else x  # noqa: E731
        exact = slopes(jax.tree.map(wide, task), wide(limits))
        assert exact[0].dtype == jnp.float64
    for a, b in zip(got, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(b).max())


def position_gradient(poses, **options):
    task = soft.prepare(poses, **options)
    f = lambda x: jnp.mean(soft.detect(task.with_poses(position=x), temperature=0.2).labels)  # noqa: E731
    return np.asarray(jax.jit(jax.grad(f))(jnp.asarray(poses.position, jnp.result_type(float))))


def test_missing_frames_contribute_exactly_nothing():
    poses = walk()
    lost = np.zeros((220, 2), bool)
    lost[50:60, 0] = lost[100, 1] = lost[0, 0] = True
    holes = replace(
        poses,
        position=np.where(lost[..., None], np.nan, poses.position),
        rotation=np.where(lost[..., None], np.nan, poses.rotation),
        valid=poses.valid & ~lost,
    )
    g = position_gradient(holes)
    assert np.isfinite(g).all() and (g[lost] == 0).all() and (g[~lost] != 0).any()
    garbage = replace(holes, position=np.where(lost[..., None], 1e30, poses.position), rotation=poses.rotation)
    np.testing.assert_array_equal(position_gradient(garbage), g)


@pytest.mark.slow
def test_a_body_at_rest_and_one_never_seen_have_finite_gradients_in_float64(x64):
    test_a_body_at_rest_and_one_never_seen_have_finite_gradients()


def test_a_body_at_rest_and_one_never_seen_have_finite_gradients():
    q, x = np.tile([1.0, 0, 0, 0], (80, 2, 1)), np.zeros((80, 2, 3))
    seen = np.ones((80, 2), bool)
    seen[:, 1] = False
    poses = Poses(q, x, seen, 100.0, ("still", "gone"))
    for options in ({}, {"method": "paper", "thresholds": (1e-3, 1e-3)}):
        g = position_gradient(poses, **options)
        assert np.isfinite(g).all() and (g[:, 1] == 0).all()
        labels = np.asarray(soft.detect(poses, temperature=0.1, **options).labels)
        assert labels[0].min() > 0.9 and labels[0, 2:-2].min() > 0.999 and (labels[1] == 0).all()


@pytest.mark.slow
def test_a_bad_clip_leaves_the_others_of_a_batch_as_they_are():
    tasks = [soft.prepare(walk(noise=n)) for n in (0.001, 0.002, 0.0)]
    clips = jax.tree.map(lambda *x: jnp.stack(x), *[t.clip for t in tasks])

    @jax.jit
    def slopes(positions):
        def one(clip, x):
            return jnp.mean(soft.detect(replace(tasks[0], clip=clip._replace(t=x)), temperature=0.2).labels)

        return jax.vmap(jax.value_and_grad(one, argnums=1))(clips, positions)

    good = slopes(clips.t)
    bad = slopes(clips.t.at[1, :, :, 40:].set(jnp.nan))
    for a, b in zip(good, bad, strict=True):
        np.testing.assert_array_equal(np.asarray(a)[[0, 2]], np.asarray(b)[[0, 2]])
    alone = soft.detect(tasks[2], temperature=0.2).labels.mean()
    assert float(good[0][2]) == pytest.approx(float(alone), rel=1e-5)


@pytest.mark.slow
def test_scan_over_temperatures_and_padding():
    poses = walk(100)
    task = soft.prepare(poses)
    _, labels = jax.lax.scan(lambda c, t: (c, soft.detect(task, temperature=t).labels), 0, jnp.array([0.2, 0.05]))
    np.testing.assert_allclose(labels[1], soft.detect(task, temperature=0.05).labels, atol=1e-6)
    longer = replace(task, clip=jax.tree.map(lambda x: np.concatenate([x, x[..., -32:]], -1), task.clip))

    def f(t):
        loss = lambda x: soft.detect(replace(t, clip=t.clip._replace(t=x)), temperature=0.2).labels.mean()  # noqa: E731
        return np.asarray(jax.grad(loss)(t.clip.t))

    a, b = f(task), f(longer)
    assert (a[..., 100:] == 0).all() and (b[..., 100:] == 0).all()
    np.testing.assert_allclose(b[..., :100], a[..., :100], atol=1e-5 * np.abs(a).max())


def test_arguments_are_checked():
    poses = walk(60)
    task = soft.prepare(poses)
    with pytest.raises(OptionError, match="temperature"):
        soft.detect(task, temperature=0.0)
    with pytest.raises(OptionError, match="window"):
        soft.prepare(poses, method="window")
    with pytest.raises(OptionError, match="types"):
        soft.prepare(poses, types=("line",))
    with pytest.raises(OptionError, match="prepared already"):
        soft.detect(task, method="paper")
    with pytest.raises(OptionError, match="needs templates"):
        soft.detect(poses, method="paper")
    with pytest.raises(OptionError, match="positive"):
        soft.detect(task, (np.zeros(2), np.ones(2)))
    with pytest.raises(ShapeError, match="by object"):
        soft.detect(task, (np.ones(3), np.ones(3)))
    with pytest.raises(ShapeError, match="60 frames"):
        task.with_poses(position=np.zeros((61, 2, 3)))
    with pytest.raises(OptionError, match="with_poses"):
        task.with_motion(rotations=np.zeros((60, 2, 4)))
    with pytest.raises(TemplateError, match="one template"):
        soft.prepare(poses, templates=[Template("LeftFoot", 0, 20), Template("LeftFoot", 30, 50)])
