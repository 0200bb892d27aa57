"""The sigma-epsilon point of a displacement: the closed form against the SVD route, the baseline, and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import numpy_baseline, reliability
from benchmarks.reliability import screws as sc
from kinjax.detect.displacements import Displacement, displacements
from kinjax.detect.sigma_epsilon import FLOOR_EPS, project, project_by_svd, project_svd, sigma_epsilon

GENERIC = sc.ANGLES[(sc.ANGLES >= 1e-2)]


@pytest.mark.parametrize("row", ["N1", "N2", "N3", "N4", "N5", "N6", "N7"])
def test_reliability(row):
    rows = list(reliability.MEASURES[row](False))
    assert rows and {r.id for r in rows} == {row}
    assert all(r.ok for r in rows), "\n" + reliability.table([r for r in rows if not r.ok])


def test_closed_form_svd_and_baseline_agree():
    s = sc.screws(40, 20, GENERIC)
    by_svd, closed = (sc.projected(s.quaternion, s.d, by) for by in ("svd", "closed"))
    theirs = numpy_baseline.project_vectorised(sc.matrices(s.quaternion), s.d, np.ones(len(s.angle), bool))
    for mine in (closed, by_svd):
        for name, one, other in zip(mine._fields, mine[:4], theirs[:4], strict=False):
            np.testing.assert_allclose(one, other, atol=1e-13, err_msg=name)
        scale = 1e-14 / s.angle  # a small rotation determines its axis and point so much worse
        assert (np.linalg.norm(mine.point.T - theirs.p, axis=1) <= scale).all()
        assert (sc.angle_between(mine.axis.T, theirs.axis) <= scale).all()


def test_the_point_is_stationary_and_the_axis_is_the_rotation_axis():
    """Independent of any decomposition: D moves the point along the axis only, by the slide."""
    s = sc.screws(40, 21, GENERIC)
    y = sc.projected(s.quaternion, s.d)
    r = sc.matrices(s.quaternion)
    moved = np.einsum("nij,nj->ni", r, y.point.T) + s.d - y.point.T
    np.testing.assert_allclose(moved, s.slide[:, None] * s.axis, atol=1e-13)
    np.testing.assert_allclose(y.axis.T, s.axis, atol=1e-13)
    np.testing.assert_allclose((y.point.T * s.axis).sum(1), 0, atol=1e-13)
    np.testing.assert_allclose(y.point.T, s.lever, atol=1e-12)


def test_hot_kernel_is_the_projection(precision):
    s = sc.screws(5, 22)
    q, d = jnp.asarray(s.quaternion.T, precision), jnp.asarray(s.d.T, precision)
    x = Displacement(q[1:], q[0], d, jnp.ones(d.shape[1:], bool))
    for one, other in zip(*jax.jit(lambda x: (sigma_epsilon(x), project(x)[:4]))(x), strict=True):
        np.testing.assert_array_equal(one, other)


def test_svd_takes_displacements_that_are_no_rotations(x64):
    """`W` that scales or shears: the paper's route holds, with sigma_1 > 0 and the least squares point."""
    rng = np.random.default_rng(3)
    r, t = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), rng.normal(size=3)
    y = jax.jit(project_svd)(jnp.asarray(r), jnp.asarray(t))
    s = np.linalg.svd(r - np.eye(3), compute_uv=False)
    np.testing.assert_allclose([y.sigma_3, y.sigma_1], s[[0, 2]], rtol=1e-12)
    theirs = numpy_baseline.project_one(r, t)
    np.testing.assert_allclose([y.eps_3, y.eps_1], [theirs[1], theirs[3]], rtol=1e-12)
    np.testing.assert_allclose(y.point, theirs[4], atol=1e-12)


def test_batched_svd_is_the_single_one(x64):
    s = sc.screws(3, 23, GENERIC)
    q, d = s.quaternion.T.reshape(4, 3, -1), s.d.T.reshape(3, 3, -1)
    x = Displacement(jnp.asarray(q[1:]), jnp.asarray(q[0]), jnp.asarray(d), jnp.ones(d.shape[1:], bool))
    y = jax.jit(project_by_svd)(x)
    assert y.sigma_3.shape == (3, len(GENERIC)) and y.point.shape == (3, 3, len(GENERIC))
    single = numpy_baseline.project_one(sc.matrices(s.quaternion)[7], s.d[7])
    place = np.unravel_index(7, y.sigma_3.shape)
    np.testing.assert_allclose(np.asarray(y.eps_1)[place], single[3], atol=1e-14)
    np.testing.assert_allclose(np.asarray(y.point)[:, *place], single[4], atol=1e-13)


def test_what_the_floor_does(x64):
    """Rotations up to 32 eps have no axis: the whole translation is the residual."""
    floor = FLOOR_EPS * np.finfo(float).eps
    half = np.array([[1.0, 0.49 * floor, 0, 0], [1.0, 0.51 * floor, 0, 0]])
    y = sc.projected(half, np.array([[0.3, 0.4, 0.0]] * 2))
    np.testing.assert_allclose(y.eps_1, [0.5, 0.3], rtol=1e-15)
    np.testing.assert_array_equal(y.axis.T, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(y.sigma_3, 2 * half[:, 1])


def test_derivatives_against_differences(x64):
    """sigma_3, eps_3, eps_1, point and axis by quaternion and translation, from 0.01 rad to a half turn."""
    s = sc.screws(6, 24, GENERIC)
    exact = sc.gradients(s.quaternion, s.d)
    x = jnp.asarray(np.concatenate([s.quaternion, s.d], 1))
    step = 1e-6
    along = jax.jit(jax.vmap(lambda x, e: (sc.nine(x + step * e) - sc.nine(x - step * e)) / (2 * step), (0, None)))
    found = np.stack([along(x, e) for e in jnp.eye(7)], -1)
    size = np.abs(exact).max((1, 2))[:, None, None]
    smooth = np.abs(s.slide)[:, None, None] > 1e-4  # |a . t| has a kink at no slide
    assert (np.abs(exact - found) * smooth <= 1e-6 * size).all()
    at_pi = s.angle == np.pi
    assert at_pi.any() and np.isfinite(exact).all()


def test_derivatives_are_finite_everywhere(precision):
    """At rest, with and without translation, at a half turn, on the axes; forward mode too."""
    half = np.sqrt(0.5)
    q = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [half, half, 0, 0], [0, half, 0, half], [-1, 0, 0, 0], [1, 1e-20, 0, 0]]
    q, d = np.repeat(np.array(q), 3, 0), np.tile([[0.0, 0, 0], [1, 0, 0], [0.1, -0.2, 0.3]], (len(q), 1))
    exact = sc.gradients(q, d, precision)
    assert np.isfinite(exact).all()
    rest = (np.abs(q[:, 0]) == 1) & (q[:, 1] == 0)
    assert not exact[rest][:, 0].any()  # the documented subgradient of sigma_3 at rest
    forward = jax.jit(jax.vmap(jax.jacfwd(sc.nine)))(jnp.asarray(np.concatenate([q, d], 1), precision))
    np.testing.assert_allclose(forward, exact, atol=64 * np.finfo(precision).eps * np.abs(exact).max())


def test_displacements_of_frames_apart(precision):
    """From frame i to i + k, in world axes, valid where both frames are; quaternion signs do not matter."""
    rng = np.random.default_rng(5)
    frames, k = 30, 3
    q = sc.unit(rng.normal(size=(frames, 4)))
    t, valid = rng.normal(size=(frames, 3)), rng.random(frames) < 0.8
    arrays = jnp.asarray(q.T[:, None], precision), jnp.asarray(t.T[:, None], precision), jnp.asarray(valid[None])
    both = jax.jit(lambda *a: (displacements(*a, k), sigma_epsilon(displacements(*a, k))))
    x, points = both(*arrays)
    turn = sc.matrices(q)
    relative = turn[k:] @ turn[:-k].transpose(0, 2, 1)
    found = sc.matrices(np.concatenate([np.asarray(x.w)[None], np.asarray(x.v)])[:, 0].T.astype(float))
    tolerance = 16 * np.finfo(precision).eps
    np.testing.assert_allclose(found, relative, atol=tolerance)
    np.testing.assert_allclose(x.d[:, 0].T, t[k:] - t[:-k], atol=tolerance)
    np.testing.assert_array_equal(x.valid[0], valid[:-k] & valid[k:])
    flipped = np.asarray(arrays[0]) * rng.choice([-1, 1], frames).astype(precision)
    for a, b in zip(points, both(jnp.asarray(flipped), *arrays[1:])[1], strict=True):
        np.testing.assert_array_equal(a, b)


number = st.floats(-1, 1, allow_subnormal=False)
_one = jax.jit(lambda x: sc.nine(x))


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.tuples(number, number, number, number), st.tuples(number, number, number))
def test_never_nan_and_never_more_than_the_whole_translation(q, d):
    q = np.array(q)
    length = np.linalg.norm(q)
    q = q / length if length > 1e-6 else np.array([1.0, 0, 0, 0])
    y = np.asarray(_one(jnp.asarray(np.concatenate([q, d]), jnp.float32)))
    assert np.isfinite(y).all()
    sigma_3, eps_3, eps_1, axis = y[0], y[1], y[2], y[6:]
    assert 0 <= sigma_3 <= 2 * (1 + 1e-6)
    assert 0 <= eps_1 <= eps_3 * (1 + 1e-6) + 1e-18  # squares of less than 1e-19 m underflow
    assert np.linalg.norm(axis) == pytest.approx(1, abs=1e-6) or not axis.any()
