"""Safe arithmetic at the hard spots, exact order statistics, buckets."""


import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import reliability
from kinjax.lengths import BLOCK, bucket
from kinjax.numerics import (
    at_frames,
    eps_of,
    order_statistic,
    running_count,
    running_sum,
    safe_divide,
    safe_norm,
    safe_sqrt,
)

ROWS = ("N8", "N9", "N11")


def hold(rows):
    """Every figure meets its bar."""
    rows = list(rows)
    assert rows
    assert all(r.ok for r in rows), "\n" + reliability.table([r for r in rows if not r.ok])


@pytest.mark.parametrize("row", ROWS)
def test_invariances(row):
    hold(reliability.MEASURES[row](False))


@pytest.mark.slow
@pytest.mark.parametrize("row", reliability.MEASURES)
def test_full_sweep(row):
    hold(reliability.MEASURES[row](True))


def test_a_missed_bar_is_a_miss(capsys, monkeypatch):
    from benchmarks.reliability.__main__ import main

    row = reliability.Row
    assert not row("X", "", "", 2.0, 1.0).ok
    assert not row("X", "", "", 0.0, 1.0, True).ok
    assert not row("X", "", "", float("nan"), 1.0).ok and not row("X", "", "", float("nan"), 1.0, True).ok
    assert row("X", "", "", float("nan")).ok
    monkeypatch.setitem(main.__globals__, "MEASURES", {"X": lambda full: iter([row("X", "fed", "figure", 2.0, 1.0 + full)])})
    assert main([]) == 0 and "MISS" not in capsys.readouterr().out
    assert main(["--quick", "X"]) == 1 and "MISS" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------------------ safe arithmetic
def test_safe_norm_at_the_hard_spots(precision):
    info = np.finfo(precision)
    big, tiny = info.max / 4, info.tiny
    rows = [[0, 0, 0], [3, 4, 0], [big, 0, big], [tiny, 0, tiny], [-np.inf, 1, 0], [np.nan, 1, 0], [1e-30, 0, 0]]
    value = np.asarray(safe_norm(jnp.asarray(rows, precision)))
    expected = [0, 5, big * 2**0.5, tiny * 2**0.5, np.inf, np.nan, 1e-30]
    np.testing.assert_allclose(value, np.asarray(expected, precision), rtol=4 * info.eps)
    subnormal = np.asarray(safe_norm(jnp.full((3,), info.smallest_subnormal, precision)))
    assert 0 <= subnormal <= 4 * info.smallest_subnormal  # some devices flush them to zero


def test_safe_norm_gradient_with_one_zero_row_in_a_batch(precision):
    info = np.finfo(precision)
    rows = np.array([[0, 0, 0], [3, 4, 0], [info.max / 4, 0, 0], [info.tiny * 16, 0, 0]], precision)
    gradient = np.asarray(jax.grad(lambda x: jnp.sum(safe_norm(x)))(jnp.asarray(rows)))
    np.testing.assert_allclose(gradient, np.array([[0, 0, 0], [0.6, 0.8, 0], [1, 0, 0], [1, 0, 0]]), rtol=4 * info.eps)


@pytest.mark.parametrize(("shape", "axis"), [((4, 0), -1), ((0, 4), 0), ((2, 0, 3), 1), ((2, 0, 3), -2), ((0, 3), 1)])
def test_safe_norm_of_nothing(shape, axis):
    assert safe_norm(jnp.zeros(shape), axis).shape == np.linalg.norm(np.zeros(shape), axis=axis).shape
    assert not np.any(safe_norm(jnp.zeros(shape), axis))


def test_safe_sqrt_and_divide(precision):
    x = jnp.asarray([-1.0, 0.0, 4.0, np.inf, np.nan], precision)
    np.testing.assert_array_equal(safe_sqrt(x), np.array([0, 0, 2, np.inf, np.nan]))
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(safe_sqrt(x)))(x[:3]), [0, 0, 0.25])
    a, b = jnp.asarray([1.0, 6.0, 0.0, np.inf], precision), jnp.asarray([0.0, 3.0, 0.0, 0.0], precision)
    np.testing.assert_array_equal(safe_divide(a, b), [0, 2, 0, 0])
    one, two = jax.grad(lambda a, b: jnp.sum(safe_divide(a, b)), (0, 1))(a, b)
    np.testing.assert_allclose(one, [0, 1 / 3, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(two, [0, -2 / 3, 0, 0], rtol=1e-6)
    assert eps_of(x) == np.finfo(precision).eps


# ------------------------------------------------------------------------------------------------------------ order statistics
LENGTH = 24
_select = jax.jit(order_statistic)


def by_sorting(x, mask, rank):
    """The definition, row by row."""
    out = []
    for v, m, r in zip(x, mask, rank, strict=True):
        v = np.sort(v[m])  # NaN comes last, as in the kernel
        out.append(v[r] if r < len(v) else np.nan)
    return np.array(out, x.dtype)


def test_order_statistic_is_exact(precision):
    rng = np.random.default_rng(0)
    x = np.abs(rng.normal(size=(400, LENGTH)) * 10.0 ** rng.integers(-30, 30, (400, 1))).astype(precision)
    x[::3] = rng.integers(0, 4, x[::3].shape)  # ties
    x[::5, :3] = np.inf
    x[::7, 1] = -0.0
    x[::11, 2] = np.finfo(precision).smallest_subnormal
    mask = rng.random(x.shape) < rng.random((len(x), 1))
    mask[-3:] = False
    rank = rng.integers(0, LENGTH, len(x)).astype(np.int32)
    found = np.asarray(_select(jnp.asarray(x), jnp.asarray(mask), jnp.asarray(rank)))
    np.testing.assert_array_equal(found, by_sorting(x, mask, rank))
    assert np.isnan(found[-3:]).all()


def test_order_statistic_puts_nan_last_and_ignores_what_is_masked(precision):
    x = np.array([[3, np.nan, 1, 2], [3, np.nan, 1, 2]], precision)
    mask = np.array([[True] * 4, [True, False, True, True]])
    for rank in range(4):
        ranks = np.full(2, rank, np.int32)
        found = np.asarray(_select(jnp.asarray(x), jnp.asarray(mask), jnp.asarray(ranks)))
        np.testing.assert_array_equal(found, np.array([[1, 2, 3, np.nan][rank]] * 2, precision))


def test_order_statistic_over_several_axes():
    x = np.random.default_rng(1).random((3, 4, LENGTH)).astype(np.float32)
    rank = np.arange(12, dtype=np.int32).reshape(3, 4)
    found = _select(jnp.asarray(x), jnp.ones(x.shape, bool), jnp.asarray(rank))
    np.testing.assert_array_equal(found, np.take_along_axis(np.sort(x, -1), rank[..., None], -1)[..., 0])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.lists(st.integers(0, 0x7F800000), min_size=LENGTH, max_size=LENGTH),
    st.integers(0, 2**LENGTH - 1),
    st.integers(0, LENGTH - 1),
)
def test_order_statistic_of_any_floats(bits, mask, rank):
    """Every non-negative float32, by its bits: zero, subnormal ones, infinity."""
    x, mask = np.array([bits], np.uint32).view(np.float32), (mask >> np.arange(LENGTH))[None] % 2 > 0
    ranks = np.array([rank], np.int32)
    np.testing.assert_array_equal(_select(jnp.asarray(x), jnp.asarray(mask), jnp.asarray(ranks)), by_sorting(x, mask, ranks))


# --------------------------------------------------------------------------------------------------------- counts and buckets
@pytest.mark.parametrize("n", [0, 1, 63, 64, 65, 1000])
def test_running_count(n):
    flags = np.random.default_rng(n).random((2, 3, n)) < 0.6
    found = running_count(jnp.asarray(flags))
    assert found.dtype == jnp.int32
    np.testing.assert_array_equal(found, np.cumsum(flags, -1))


def test_running_count_of_a_long_clip():
    n = 2**20 + 3
    np.testing.assert_array_equal(jax.jit(running_count)(jnp.ones(n, bool)), np.arange(1, n + 1))


def test_running_sum(precision):
    x = np.random.default_rng(2).normal(size=(2, 3, 301)).astype(precision)
    np.testing.assert_allclose(running_sum(jnp.asarray(x)), np.cumsum(x, -1), atol=200 * np.finfo(precision).eps)
    assert running_sum(jnp.zeros((2, 0), precision)).shape == (2, 0)


def test_values_at_places_of_each_lane():
    rng = np.random.default_rng(1)
    x, index = rng.normal(size=(3, 50)), rng.integers(0, 50, (7, 3))
    found = at_frames(jnp.asarray(x, jnp.float32), jnp.asarray(index, jnp.int32))
    np.testing.assert_array_equal(found, np.take_along_axis(np.float32(x), index.T, axis=1).T)


def test_buckets_are_monotone_few_and_little_padded():
    sizes = [bucket(n) for n in range(1, 20001)]
    assert all(s >= n for n, s in enumerate(sizes, 1))
    assert sizes == sorted(sizes)
    assert max(s / n for n, s in enumerate(sizes, 1) if n > 128) <= 1.25
    assert max(1 - n / s for n, s in enumerate(sizes, 1) if n > 128) <= 0.25
    assert max(s - n for n, s in enumerate(sizes, 1) if 64 <= n <= 128) < BLOCK
    assert len(set(sizes)) <= 4 * 9 + 1  # of 64..20,000: at most four an octave
    assert all(bucket(s) == s and s % BLOCK == 0 for s in set(sizes))
