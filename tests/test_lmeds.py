"""The least median of squares: its promises, its definition, and what it does with ties, gaps and too few values."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import numpy_baseline, reliability
from benchmarks.reliability.lmeds_sets import contamination, kept, ragged
from kinjax.detect.lmeds import AMBIGUOUS, EXACT, FEW, SHORT, naive


@pytest.mark.parametrize("row", ["R1", "R3", "R5", "R6", "R7", "R8", "R9", "R10", "R11"])
def test_reliability(row):
    rows = list(reliability.MEASURES[row](False))
    assert rows and all(r.id in (row, "R2") for r in rows)
    assert all(r.ok for r in rows), "\n" + reliability.table([r for r in rows if not r.ok])


def test_the_largest_kept_grows_no_faster_than_near_outliers():
    """Near outliers bias the maximum: bounded by their own largest value, and by the scale's band."""
    curves = contamination(50, (20,), seed=1)
    near = curves["near", 20]
    assert max(np.quantile(near[bad], 0.95) for bad in range(9)) < 1.6
    assert near[8].mean() > 1.1  # which is why the statement is a bound and not equality


@pytest.mark.parametrize("size", [3, 4, 9, 10])
def test_few_values_are_called_few(size):
    y = kept(np.random.default_rng(size).normal(5, 1, (1, size)))
    assert bool(y.status[0] & FEW) == (size < 10)
    assert not y.status[0] & SHORT and y.size[0] == size


def test_one_cluster_is_not_called_two():
    """False alarms of `ambiguous` on clean values are rare, and outliers are no second cluster; two clusters are always told."""
    rng = np.random.default_rng(4)
    ambiguous = lambda v: (kept(v).status & AMBIGUOUS > 0).mean()  # noqa: E731
    assert ambiguous(rng.normal(10, 1, (2000, 8))) == 0  # too few to tell; called few
    for n, rate in ((10, 0.11), (14, 0.03), (20, 0.007), (50, 0)):
        clean = rng.normal(10, 1, (2000, n))
        assert ambiguous(clean) <= rate, n
        clean[:, : n // 3] += 100
        assert ambiguous(clean) <= rate, n
        both = np.concatenate([rng.normal(10, 0.2, (300, n // 2)), rng.normal(15, 0.2, (300, n // 2))], 1)
        assert ambiguous(both) == 1, n
    assert not (kept(rng.normal(10, 1, (500, 20))).status & EXACT).any()


def test_all_masked_out(precision):
    y = kept(np.ones((1, 5)), np.zeros((1, 5), bool), precision)
    assert y.largest == 0 and y.size == 0 and not y.kept.any() and y.spread == 0 and y.status[0] & SHORT


def test_masked_values_do_not_matter(precision):
    rng = np.random.default_rng(5)
    v, mask = rng.normal(5, 1, (50, 30)), rng.random((50, 30)) < 0.7
    other = np.where(mask, v, rng.choice([0.0, 1e30, np.nan, -np.inf], v.shape))
    a, b = kept(v, mask, precision), kept(other, mask, precision)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


def test_naive_believes_everything(precision):
    v = np.array([0.5, 3.0, 100.0, 7.0], precision)
    y = naive(jnp.asarray(v), jnp.asarray([True, True, False, True]))
    theirs = numpy_baseline.naive(v[[0, 1, 3]])
    assert y.largest == theirs.largest == 7 and y.size == 3 and list(np.asarray(y.kept)) == [True, True, False, True]
    assert naive(jnp.asarray(v), jnp.zeros(4, bool)).largest == 0
    assert naive(jnp.asarray(v), jnp.asarray([True, True, False, False])).status & SHORT


def test_both_baselines_are_one():
    for v in (np.array([1.0, 2, 3, 50]), np.array([4.0, 4, 4, 1]), np.random.default_rng(6).exponential(1, 25)):
        a, b = numpy_baseline.lmeds_loop(v), numpy_baseline.lmeds_vectorised(v)
        assert (a.centre, a.scale, a.largest) == (b.centre, b.scale, b.largest) and np.array_equal(a.kept, b.kept)


values = st.lists(st.one_of(st.integers(0, 12).map(float), st.floats(0, 1e6, allow_subnormal=False)), min_size=3, max_size=40)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(values)
def test_any_values_against_the_definition(v):
    v = np.array(v)
    mine, theirs = ragged([v]), numpy_baseline.lmeds_loop(v)
    np.testing.assert_array_equal(mine.kept[0][: len(v)], theirs.kept)
    assert mine.largest[0] == theirs.largest
    assert mine.spread[0] == pytest.approx(theirs.scale, rel=1e-15, abs=1e-300)  # subnormal floors flush to 0
    assert mine.kept[0].sum() >= len(v) // 2 + 1


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 1000), min_size=3, max_size=40), st.integers(-30, 30), st.integers(0, 10**6), st.randoms())
def test_equivariance(whole, power, shift, random):
    """T(aX + b) = a T(X) + b, in any order; whole numbers and powers of two, so that equality is exact."""
    a, order = 2.0**power, list(range(len(whole)))
    random.shuffle(order)
    v = np.array(whole, float)
    one, other = ragged([v]), ragged([a * (v[order] + shift)])
    assert other.largest[0] == a * (one.largest[0] + shift)
    np.testing.assert_array_equal(other.kept[0], one.kept[0][order])
