"""Host quaternions against SciPy, in every layout of memory, and what is not finite."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinjax.quaternions import exponential, from_turns, inverse, known, multiply, rotate, turns

RNG = np.random.default_rng(0)
A, B = (Rotation.random(60, random_state=seed) for seed in (1, 2))
V = RNG.normal(size=(60, 3))


def same(a: np.ndarray, b: np.ndarray) -> None:
    """Equal as rotations: `q` and `-q` are one."""
    np.testing.assert_allclose(a * np.where((a * b).sum(-1, keepdims=True) < 0, -1, 1), b, rtol=0, atol=1e-14)


def test_product_inverse_and_rotation_agree_with_scipy():
    a, b = from_turns(A), from_turns(B)
    same(multiply(a, b), from_turns(A * B))
    same(inverse(a), from_turns(A.inv()))
    np.testing.assert_allclose(rotate(a, V), A.apply(V), rtol=0, atol=1e-14)
    np.testing.assert_allclose(rotate(inverse(a), rotate(a, V)), V, rtol=0, atol=1e-14)


def test_leading_axes_broadcast_and_the_layout_of_memory_does_not_count():
    a, b, v = from_turns(A).reshape(3, 20, 4), from_turns(B)[:20], V[:20]
    for first in (a, np.asfortranarray(a)):
        product, turned = multiply(first, b), rotate(first, v)
        assert product.shape == (3, 20, 4) and turned.shape == (3, 20, 3)
        for i in range(3):
            np.testing.assert_array_equal(product[i], multiply(a[i], b))
            np.testing.assert_array_equal(turned[i], rotate(a[i], v))
    np.testing.assert_array_equal(multiply(a[0, 0], b), multiply(np.broadcast_to(a[0, 0], b.shape), b))
    np.testing.assert_array_equal(rotate(a[0, 0], v[0]), rotate(a[0], v)[0])


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-9, 1e-3, 1.0, np.pi - 1e-9, np.pi])
def test_exponential_agrees_with_scipy(angle):
    v = angle * V / np.linalg.norm(V, axis=1, keepdims=True)
    same(exponential(v), from_turns(Rotation.from_rotvec(v)))


def test_exponential_goes_on_beyond_half_a_turn():
    """Twice around is the identity again, once around its other sign."""
    axis = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(exponential(2 * np.pi * axis), [-1, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(exponential(4 * np.pi * axis), [1, 0, 0, 0], atol=1e-15)


def test_to_scipy_and_back():
    q = from_turns(A)
    same(from_turns(turns(q)), q)
    same(from_turns(turns(q.reshape(3, 20, 4))), q)
    small = q.astype(np.float32)
    same(from_turns(turns(small)), small / np.linalg.norm(small.astype(float), axis=1, keepdims=True))
    assert from_turns(A[0]).shape == (4,)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_turns_nothing(bad):
    q = from_turns(A)
    q[7, 2] = bad
    expected = np.where(np.arange(60)[:, None] == 7, [1.0, 0, 0, 0], from_turns(A))
    np.testing.assert_array_equal(known(q), expected)
    same(from_turns(turns(q)), expected)
