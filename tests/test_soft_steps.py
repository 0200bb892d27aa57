"""The surrogates one by one: against finite differences, against the hard step they stand for, and where they might break."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import test_util

from kinjax.detect.lmeds import lmeds
from kinjax.numerics import order_statistic
from kinjax.soft import smooth_quantile, soft_instantaneous, soft_line, soft_lmeds, soft_merge, soft_opening
from kinjax.soft.steps import smooth_maximum, smooth_minimum, smoothstep, smoothstep_slope, within


def check_grads(f, *arguments, **options):
    """JAX's own check against finite differences, of the compiled function: it is called hundreds of times."""
    test_util.check_grads(jax.jit(f), *arguments, **options)


TIGHT = {"atol": 1e-7, "rtol": 1e-6, "eps": 1e-5}


def scalar(x):
    return jnp.asarray(x, jnp.result_type(float))


def values_of(n, seed=0):
    return jnp.asarray(np.abs(np.random.default_rng(seed).normal(size=n)) + 0.1, jnp.result_type(float))


# ------------------------------------------------------------------------------------------------------------- steps
def test_smoothstep_is_twice_differentiable_and_its_slope_is_its_slope(x64):
    x = jnp.linspace(-1.3, 1.3, 53)
    np.testing.assert_allclose(jax.vmap(jax.grad(smoothstep))(x), smoothstep_slope(x), atol=1e-15)
    np.testing.assert_allclose(smoothstep(scalar([-2.0, -1, 0, 1, 2])), [0, 0, 0.5, 1, 1], atol=1e-15)
    curved = jax.vmap(jax.grad(jax.grad(smoothstep)))(scalar([-1 - 1e-9, -1 + 1e-9, 1 - 1e-9, 1 + 1e-9]))
    assert np.abs(curved).max() < 1e-7


def test_within_is_met_half_at_its_reach_and_smooth_at_zero(x64):
    t = scalar(0.1)
    np.testing.assert_allclose(within(scalar([4.0]), scalar([2.0]), t), 0.5)
    assert within(scalar(0.0), scalar(0.0), t) == 0.5 and within(scalar(1e-9), scalar(0.0), t) == 0
    assert jax.grad(lambda d: within(d * d, scalar(0.0), t))(scalar(1e-3)) == 0
    check_grads(lambda d, r: within(d * d, r, t), (scalar(0.3), scalar(0.31)), 2, eps=1e-5)


def test_smooth_extremes_bound_the_hard_ones(x64):
    a, b = scalar([0.0, 1.0, 5.0, 1e6]), scalar(1.0)
    assert (smooth_maximum(a, b, scalar(0.1)) >= np.maximum(a, 1)).all()
    assert (smooth_minimum(a, b, scalar(0.1)) <= np.minimum(a, 1)).all()
    np.testing.assert_allclose(smooth_maximum(a, b, scalar(1e-9)), np.maximum(a, 1), rtol=1e-8)


# ---------------------------------------------------------------------------------------------------------- quantile
@pytest.mark.parametrize("mask", [True, False], ids=["mask", "weights"])
def test_the_quantile_is_the_root_it_claims_to_be(precision, mask):
    v = values_of((3, 101))
    rng = np.random.default_rng(1)
    w = jnp.asarray(rng.random((3, 101)) < 0.8) if mask else jnp.asarray(rng.random((3, 101)), v.dtype)
    share = w.astype(v.dtype)
    level = jnp.floor(jnp.sum(share, -1) / 2) + 0.5
    width, t = scalar(0.02), scalar(0.1)
    q = smooth_quantile(v, w, level, width, t)
    half = width + t * q
    count = jnp.sum(share * smoothstep((q[:, None] - v) / half[:, None]), -1)
    np.testing.assert_allclose(count, level, rtol=1e-13 if precision == "float64" else 3e-6)


def test_the_quantile_tends_to_the_order_statistic(x64):
    v, mask, rank = values_of((4, 60)), jnp.ones((4, 60), bool), jnp.array([0, 17, 30, 59], jnp.int32)
    hard = order_statistic(v, mask, rank)
    level = rank.astype(v.dtype) + 0.5
    off = [np.abs(smooth_quantile(v, mask, level, scalar(0.0), scalar(t)) - hard).max() for t in (0.3, 0.03, 1e-4)]
    assert off[0] > off[1] > off[2] and off[2] < 1e-5
    weighted = smooth_quantile(v, mask.astype(float), level, scalar(0.0), scalar(1e-6))
    np.testing.assert_allclose(weighted, hard, rtol=1e-5)


def test_the_quantile_against_finite_differences(x64):
    v, w = values_of(41), scalar(np.random.default_rng(2).random(41))
    at = v, w, jnp.sum(w) / 2, scalar(0.05), scalar(0.2)
    check_grads(smooth_quantile, at, 1, modes=("fwd", "rev"), **TIGHT)
    check_grads(smooth_quantile, at, 2, modes=("rev",), atol=1e-4, rtol=1e-4, eps=1e-5)
    mask = jnp.asarray(np.arange(41) % 5 > 0)
    check_grads(lambda v, t: smooth_quantile(v, mask, scalar(16.5), scalar(0.0), t), (v, scalar(0.2)), 1, **TIGHT)


def test_the_quantile_survives_ties_masks_nan_and_single_values(precision):
    t, zero = scalar(0.1), scalar(0.0)
    g = jax.jit(jax.value_and_grad(lambda v, m, level: smooth_quantile(v, m, level, zero, t)))
    on = jnp.ones(4, bool)
    for v, m, level, expected in (
        ([2.0] * 4, on, 2.0, 2.0),
        ([0.0] * 4, on, 1.5, 0.0),
        ([0.0, 0, 0, 5], on, 1.5, 0.0),
        ([1.0, 2, 3, 4], ~on, 0.5, 0.0),
        ([7.0, np.nan, np.inf, 1], jnp.array([True, True, True, False]), 0.5, 7.0),
    ):
        for weights in (m, m.astype(t.dtype)):
            q, slope = g(scalar(v), weights, scalar(level))
            assert np.isfinite(slope).all() and q == pytest.approx(expected, abs=1e-6)
    assert g(scalar([2.0] * 4), on, scalar(2.0))[1] == pytest.approx(0.25)
    one, slope = g(scalar([3.0]), jnp.ones(1, bool), scalar(0.5))
    assert one == pytest.approx(3, rel=1e-6) and slope == pytest.approx(1, rel=1e-5)


# ------------------------------------------------------------------------------------------------------------- lmeds
def template(seed=0, n=40, bad=9):
    rng = np.random.default_rng(seed)
    return scalar(np.concatenate([np.abs(rng.normal(1, 0.2, n)), rng.uniform(4, 30, bad)]))


@pytest.mark.parametrize("seed", range(5))
def test_soft_lmeds_tends_to_the_hard_one(x64, seed):
    v = template(seed)
    hard = lmeds(v, jnp.ones(v.shape, bool))
    run = jax.jit(soft_lmeds)
    soft = [run(v, jnp.ones_like(v), scalar(t)) for t in (0.1, 1e-2, 1e-3, 1e-4)]
    off = [abs(float(s.largest / hard.largest) - 1) for s in soft]
    assert off[0] < 0.35 and off[-1] < 2e-3 and off[-1] < off[0]
    np.testing.assert_allclose(soft[-1].weights, hard.kept, atol=0.02)
    assert float(soft[-1].spread) == pytest.approx(float(hard.spread), rel=2e-3)


def test_soft_lmeds_holds_outliers_off(x64):
    clean = soft_lmeds(template()[:40], jnp.ones(40), scalar(0.1)).largest
    for size in (1.0, 1e3, 1e6):
        v = template().at[40:].multiply(size)
        assert soft_lmeds(v, jnp.ones_like(v), scalar(0.1)).largest < 1.5 * clean


def test_soft_lmeds_against_finite_differences(x64):
    v, w = template(3, 25, 5), scalar(np.random.default_rng(1).uniform(0.2, 1, 30))

    def f(v, w, t):
        y = soft_lmeds(v, w, t)
        return y.largest, y.spread, y.center

    check_grads(f, (v, w, scalar(0.2)), 1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-6)


def test_soft_lmeds_float32_gradient_is_that_of_float64():
    def slopes(dtype):
        v, w = template().astype(dtype), jnp.ones(49, dtype)
        return jax.jit(jax.grad(lambda v, w: soft_lmeds(v, w, jnp.asarray(0.2, dtype)).largest, argnums=(0, 1)))(v, w)

    with jax.enable_x64(True):
        exact = slopes(jnp.float64)
    for a, b in zip(slopes(jnp.float32), exact, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * np.abs(b).max())


def test_soft_lmeds_where_nothing_can_be_learnt(precision):
    f = jax.jit(jax.value_and_grad(lambda v, w: soft_lmeds(v, w, scalar(0.1)).largest, argnums=(0, 1)))
    for v, w in (
        ([1.0, 2, 3, 4], [0.0, 0, 0, 0]),
        ([1.0, 1, 1, 1], [1.0, 1, 1, 1]),
        ([0.0, 0, 0, 0], [1.0, 1, 1, 1]),
        ([np.nan, 1, 2, 3], [1.0, 1, 1, 1]),
    ):
        out, slope = f(scalar(v), scalar(w))
        assert np.isfinite(out) and all(np.isfinite(s).all() for s in slope)


# ----------------------------------------------------------------------------------------------------- instantaneous
def test_passing_against_finite_differences_and_its_limits(x64):
    s, e = values_of(6), values_of(6, 1)
    on = jnp.array([True] * 5 + [False])
    f = lambda s, e, a, b, t: soft_instantaneous(s, e, on, a, b, t)  # noqa: E731
    check_grads(
        f, (s, e, scalar(0.6), scalar(0.7), scalar(0.3)), 2, modes=("rev",), atol=1e-5, rtol=1e-5, eps=1e-5
    )
    hard = np.asarray(on & (s <= 0.6) & (e <= 0.7), float)
    np.testing.assert_allclose(f(s, e, scalar(0.6), scalar(0.7), scalar(1e-4)), hard, atol=1e-9)
    line = lambda s, one, e, a, b: soft_line(s, one, e, on, a, b, scalar(0.05), scalar(0.3))  # noqa: E731
    check_grads(
        line, (s, 0.1 * s, e, scalar(0.4), scalar(0.7)), 1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-5
    )
    bad = jax.grad(lambda s: f(s, e, scalar(0.6), scalar(0.7), scalar(0.1)).sum())(s.at[5].set(jnp.nan))
    assert np.isfinite(bad).all() and bad[5] == 0


# ----------------------------------------------------------------------------------------------------------- merging
def hard_merge(bits, valid, at, most, jump, missing):
    """Labels by the rule itself: passing displacements in order, each joined to the one before it or not."""
    out, joined, last = np.zeros(len(bits), bool), np.zeros(len(bits), bool), None
    for i in np.flatnonzero(bits):
        if last is not None:
            between = np.arange(last + 1, i)
            gap, gone = int(valid[between].sum()), int((~valid[between]).sum())
            d = float(np.linalg.norm(at[:, i] - at[:, last]))
            tolerance = most if d <= 0 else int(np.floor(most ** (1 - d / jump))) if d <= jump else -1
            if (gap <= tolerance and gone <= missing) or i == last + 1:
                out[last : i + 1], joined[last:i] = True, True
        out[i], last = True, i
    return out, joined


@pytest.mark.parametrize("gone", [(), (0, 4), (3, 4, 7), (2, 3, 4, 5)], ids=str)
@pytest.mark.parametrize("most", [1, 2, 5])
def test_the_merge_is_the_mean_over_all_pass_patterns(x64, gone, most):
    rng = np.random.default_rng(len(gone) + most)
    n, jump, missing = 9, 0.05, 2
    valid = ~np.isin(np.arange(n), gone)
    p = np.where(valid, rng.uniform(0, 1, n), 0)
    at = rng.normal(size=(3, n)) * 0.02
    covered, joined = np.zeros(n), np.zeros(n)
    for bits in itertools.product([0, 1], repeat=int(valid.sum())):
        full = np.zeros(n, bool)
        full[valid] = np.array(bits, bool)
        chance = np.prod(np.where(full, p, 1 - p)[valid])
        a, b = hard_merge(full, valid, at, most, jump, missing)
        covered, joined = covered + chance * a, joined + chance * b
    place = tuple(scalar(x) for x in at)
    soft = jax.jit(soft_merge, static_argnums=(4, 6))(
        scalar(p), jnp.asarray(valid), place, place, most, scalar(jump), missing, scalar(1e-9)
    )
    np.testing.assert_allclose(soft.covered, covered, atol=1e-12)
    np.testing.assert_allclose(soft.joined, joined, atol=1e-12)
    np.testing.assert_allclose(jnp.sum(soft.begins), jnp.sum(soft.ends), atol=1e-12)


@pytest.mark.parametrize("gone", [pytest.param((), marks=pytest.mark.slow), (4, 5)], ids=str)
def test_the_merge_against_finite_differences(x64, gone):
    rng = np.random.default_rng(0)
    n = 14
    valid = jnp.asarray(~np.isin(np.arange(n), gone))
    p, at = scalar(np.where(valid, rng.uniform(0.1, 0.9, n), 0)), scalar(rng.normal(size=(3, n)) * 0.02)

    def f(p, at, jump, t):
        p = jnp.where(valid, p, 0)
        return jnp.stack(soft_merge(p, valid, tuple(at), tuple(at + 0.001), 4, jump, 3, t))

    check_grads(f, (p, at, scalar(0.05), scalar(0.3)), 1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-6)
    check_grads(lambda p: f(p, at, scalar(0.05), scalar(0.3)), (p,), 2, modes=("rev",), **TIGHT)


@pytest.mark.parametrize("least", [1, 2, 3, 7])
def test_the_opening_of_bits_is_the_hard_one(x64, least):
    rng = np.random.default_rng(least)
    frames = rng.random(60) < 0.8
    edges = np.append(frames[:-1] & frames[1:], False)
    expected, i = np.zeros(60), 0
    while i < 60:
        j = i
        while edges[j]:
            j += 1
        expected[i : j + 1] = frames[i] and j - i >= least
        i = j + 1
    soft = soft_opening(scalar(frames), scalar(edges), least)
    np.testing.assert_array_equal(soft, expected)
    f, e = scalar(rng.random(60)), scalar(rng.random(60))
    check_grads(lambda f, e: soft_opening(f, e, least), (f, e), 2, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-5)
