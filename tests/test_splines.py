"""Masked splines against SciPy's, for every number of control points, padding of any kind, times far outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from kinjax.splines import monotone_cubic, natural_cubic

ROOM, TIMES = 8, 60
CURVES = {
    "cubic": (natural_cubic, lambda x, y: CubicSpline(x, y, bc_type="natural")),
    "monotone": (monotone_cubic, PchipInterpolator),
}
COMPILED = {name: jax.jit(jax.vmap(f)) for name, (f, _) in CURVES.items()}


def cases(count=280, seed=0):
    """Times, knots, values and counts 1..ROOM; some with flat stretches, some monotone."""
    rng = np.random.default_rng(seed)
    counts = np.arange(count) % ROOM + 1
    knots = np.cumsum(rng.uniform(0.5, 40, (count, ROOM)), 1)
    values = rng.uniform(0.01, 1, (count, ROOM))
    values[::3] = np.sort(values[::3], 1)
    values[1::5, 2:5] = values[1::5, 2:3]  # what two control points of one template give
    last = knots[np.arange(count), counts - 1]
    at = rng.uniform(knots[:, :1] - 10, last[:, None] + 10, (count, TIMES))
    at[:, :ROOM] = np.where(np.arange(ROOM) < counts[:, None], knots, last[:, None])  # the control points themselves
    at[:, ROOM], at[:, ROOM + 1] = -1e6, 1e6
    return at, knots, values, counts.astype(np.int32)


def padded(knots, values, counts, how):
    """What lies beyond `count`: the last point again (as the engine pads), zeros, or NaN."""
    beyond = np.arange(ROOM) >= counts[:, None]
    last = np.arange(len(counts)), counts - 1
    fill = {"last": (knots[last][:, None], values[last][:, None]), "zero": (0.0, 0.0), "nan": (np.nan, np.nan)}[how]
    return np.where(beyond, fill[0], knots), np.where(beyond, fill[1], values)


def run(name, at, knots, values, counts, dtype):
    return np.asarray(COMPILED[name](*(jnp.asarray(x, dtype) for x in (at, knots, values)), jnp.asarray(counts)))


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("how", ["last", "zero", "nan"])
def test_against_scipy(x64, name, how):
    at, knots, values, counts = cases()
    found = run(name, at, *padded(knots, values, counts, how), counts, "float64")
    for i, n in enumerate(counts):
        x, y = knots[i, :n], values[i, :n]
        curve = CURVES[name][1](x, y) if n > 1 else lambda t, y=y: np.full_like(t, y[0])
        np.testing.assert_allclose(found[i], curve(np.clip(at[i], x[0], x[-1])), rtol=0, atol=2e-13, err_msg=f"{n} knots")


@pytest.mark.parametrize("name", CURVES)
def test_goes_through_every_control_point_and_is_constant_outside(precision, name):
    at, knots, values, counts = cases()
    knots, values = (x.astype(precision) for x in (knots, values))
    at = at.astype(precision)
    at[:, :ROOM] = np.where(np.arange(ROOM) < counts[:, None], knots, knots[np.arange(len(counts)), counts - 1][:, None])
    found = run(name, at, *padded(knots, values, counts, "last"), counts, precision)
    through = padded(knots, values, counts, "last")[1]
    tolerance = 512 * np.finfo(precision).eps  # the curves are steep
    np.testing.assert_allclose(found[:, :ROOM], through, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(found[:, ROOM], values[:, 0], rtol=tolerance)
    np.testing.assert_allclose(found[:, ROOM + 1], through[:, -1], rtol=tolerance)


def test_monotone_stays_between_its_neighbours(x64):
    """The natural cubic overshoots on the same points: the reason for the other."""
    at, knots, values, counts = cases(seed=1)
    outside = {}
    for name in CURVES:
        found = run(name, at, *padded(knots, values, counts, "last"), counts, "float64")
        outside[name] = 0.0
        for i, n in enumerate(counts):
            j = np.clip(np.searchsorted(knots[i, :n], at[i], side="right") - 1, 0, max(n - 2, 0))
            k = np.minimum(j + 1, n - 1)
            low, high = np.minimum(values[i, j], values[i, k]), np.maximum(values[i, j], values[i, k])
            outside[name] = max(outside[name], (low - found[i]).max(), (found[i] - high).max())
    assert outside["monotone"] < 1e-14
    assert outside["cubic"] > 0.05


@pytest.mark.parametrize("name", CURVES)
def test_one_knot_needs_no_room(name):
    curve = CURVES[name][0]
    found = curve(jnp.array([-1.0, 0, 5]), jnp.array([2.0]), jnp.array([0.25]), jnp.int32(1))
    np.testing.assert_array_equal(found, [0.25] * 3)


@pytest.mark.parametrize("name", CURVES)
def test_derivatives_by_the_control_values(x64, name):
    at, knots, values, counts = cases(24, seed=2)
    knots, values = padded(knots, values, counts, "last")
    curve = CURVES[name][0]
    slope = jax.jit(jax.vmap(jax.grad(lambda y, *x: jnp.sum(curve(x[0], x[1], y, x[2])))))
    arrays = [jnp.asarray(x) for x in (at, knots, counts)]
    exact = np.asarray(slope(jnp.asarray(values), *arrays))
    assert np.isfinite(exact).all()
    total = lambda y: run(name, at, knots, y, counts, "float64").sum(1)  # noqa: E731
    generic = ~np.isin(np.arange(24) % 5, [1])  # PCHIP has kinks where neighbours are equal
    for k in range(ROOM):
        step = 1e-6 * (np.arange(ROOM) == k)
        difference = (total(values + step) - total(values - step)) / 2e-6
        np.testing.assert_allclose(exact[generic, k], difference[generic], atol=1e-6)
