"""Quaternions against SciPy: every angle from none to past a half turn, in both precisions, values and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kinjax import rotations as rot

ANGLES = np.concatenate([
    [0.0, 1e-30, 1e-12, 1e-8, 1e-6, 1.99e-4, 2.01e-4, 9.99e-4, 1.001e-3, 0.01, 0.3, 1.0, 2.0, 3.0],
    np.pi + np.array([-1e-3, -1e-6, -1e-8, 0.0]),
])


_exp, _log, _multiply = jax.jit(rot.exp), jax.jit(rot.log), jax.jit(rot.multiply)


def vectors(angles=ANGLES, axes=8, seed=0):
    """Rotation vectors (n, 3) of each angle about random axes and the basis axes."""
    rng = np.random.default_rng(seed)
    axis = np.concatenate([np.eye(3), rng.normal(size=(axes, 3))])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return (angles[:, None, None] * axis).reshape(-1, 3)


def wxyz(rotation):
    return rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]


@pytest.fixture
def q(precision):
    """Unit quaternions (4, n) of every kind."""
    return jnp.asarray(wxyz(Rotation.from_rotvec(vectors())).T, precision)


def eps(x):
    return float(np.finfo(x.dtype).eps)


def same(found, expected, x, times=8.0, scale=1.0):
    np.testing.assert_allclose(np.asarray(found, np.float64), expected, rtol=0, atol=times * eps(x) * scale)


def test_exp(precision):
    v = jnp.asarray(vectors().T, precision)
    found, expected = np.asarray(_exp(v), float), wxyz(Rotation.from_rotvec(np.array(v, float).T)).T
    same(found * np.sign((found * expected).sum(0)), expected, v, 4)


def test_log_is_exact_at_small_angles_and_near_pi(q):
    found = np.asarray(_log(q), float)
    expected = Rotation.from_quat(np.array(q, float).T[:, [1, 2, 3, 0]]).as_rotvec().T
    angle = np.linalg.norm(expected, axis=0)
    error = np.linalg.norm(found - expected, axis=0)
    half = np.pi - angle < 1e-4  # there the vector and its opposite are one rotation
    error = np.where(half, np.minimum(error, np.linalg.norm(found + expected, axis=0)), error)
    assert (error <= 16 * eps(q) * angle).all()  # relative: small angles keep their digits
    assert (np.linalg.norm(found, axis=0) <= np.pi * (1 + 4 * eps(q))).all()
    same(np.asarray(_log(-q))[:, ~half], found[:, ~half], q, 0)  # q and -q are one rotation


def test_log_undoes_exp(precision):
    v = vectors().T.astype(precision)
    v = jnp.asarray(np.where(np.linalg.norm(v, axis=0) < 3.1, v, v / 2))  # the same shape as everywhere
    np.testing.assert_allclose(_log(_exp(v)), v, rtol=200 * eps(v), atol=1e-37)


def test_product_conjugate_rotation_and_matrix(q):
    other, point = jnp.roll(q, 5, axis=1), jnp.roll(q[1:] + 1, 3, axis=1)
    a, b = (Rotation.from_quat(np.array(x, float).T[:, [1, 2, 3, 0]]) for x in (q, other))
    product = np.asarray(_multiply(q, other), float)
    expected = wxyz(a * b).T
    same(product * np.sign((product * expected).sum(0)), expected, q)
    same(np.moveaxis(np.asarray(rot.matrix(q), float), -1, 0), a.as_matrix(), q)
    matrices, vectors = rot.matrix(q), np.array(point, float).T
    same(rot.apply(matrices, point), a.apply(vectors).T, q, scale=2)
    same(rot.apply_transposed(matrices, point), a.inv().apply(vectors).T, q, scale=2)
    same(rot.rotate(q, point), a.apply(np.array(point, float).T).T, q, scale=2)
    same(rot.multiply(q, rot.conjugate(q)), np.eye(4)[:, :1] * np.ones(q.shape[1]), q)
    same(rot.cross(q[1:], point), np.cross(np.asarray(q[1:], float).T, np.asarray(point, float).T).T, q, scale=2)
    same(rot.dot(q, other), (np.asarray(q, float) * np.asarray(other, float)).sum(0), q)


def test_products_are_in_the_order_that_they_say():
    """`multiply(a, b)` turns by b first."""
    quarter = np.sqrt(0.5)
    x, z = jnp.array([quarter, quarter, 0, 0]), jnp.array([quarter, 0, 0, quarter])
    point = jnp.array([0.0, 1, 0])
    np.testing.assert_allclose(rot.rotate(rot.multiply(x, z), point), rot.rotate(x, rot.rotate(z, point)), atol=1e-6)
    np.testing.assert_allclose(rot.rotate(rot.multiply(x, z), point), [-1, 0, 0], atol=1e-6)


def test_normalize(precision):
    q = np.array([[2, 0, 0, 0], [0, 0, -3, 4], [1, 1, 1, 1], [0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]], precision).T
    expected = np.array([[1, 0, 0, 0], [0, 0, -0.6, 0.8], [0.5] * 4, [1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]]).T
    same(jax.jit(rot.normalize)(jnp.asarray(q)), expected, q, 2)
    jacobian = np.asarray(jax.jit(jax.jacrev(lambda x: jnp.sum(rot.normalize(x), axis=1)))(jnp.asarray(q)))
    assert np.isfinite(jacobian).all()
    assert not jacobian[:, :, 3:].any()  # frames that hold no rotation pass no gradient


def test_derivatives_against_differences(x64):
    """exp and log at every angle, log also just below a half turn; none is NaN, and at rest exp' is 1/2."""
    v = jnp.asarray(vectors(ANGLES[ANGLES < 3.1], 3))
    step = 1e-6

    for f, x in ((rot.exp, v), (lambda q: rot.log(rot.normalize(q)), _exp(v.T).T)):
        exact = np.asarray(jax.jit(jax.vmap(jax.jacrev(f)))(x))
        along = jax.jit(jax.vmap(lambda x, e, f=f: (f(x + step * e) - f(x - step * e)) / (2 * step), (0, None)))
        np.testing.assert_allclose(exact, np.stack([along(x, e) for e in np.eye(x.shape[1])], -1), atol=2e-8)
        if f is rot.exp:
            np.testing.assert_array_equal(exact[0], np.eye(4)[:, 1:] / 2)


def test_derivatives_are_finite_at_every_angle(precision):
    v = jnp.asarray(vectors(np.append(ANGLES, [1e-300, 2 * np.pi]), 3), precision)
    q = _exp(v.T).T
    assert np.isfinite(jax.jit(jax.vmap(jax.jacrev(rot.exp)))(v)).all()
    assert np.isfinite(jax.jit(jax.vmap(jax.jacrev(rot.log)))(q)).all()


unit = st.floats(-1, 1, width=32)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_composition_agrees_with_scipy(a, b):
    both = np.array([a, b], np.float32) * 3
    q = _exp(jnp.asarray(both.T))
    first, then = (Rotation.from_rotvec(v.astype(float)) for v in both)
    found = Rotation.from_quat(np.asarray(_multiply(q[:, 1], q[:, 0]), float)[[1, 2, 3, 0]])
    assert (found.inv() * (then * first)).magnitude() < 2e-6
