"""Quaternions (wxyz, components last) as the few products that the solver needs, each one call into a matrix product.

A bilinear map of two quaternions is the outer product of their components times a constant matrix: two NumPy calls,
however many quaternions there are.
"""

import numpy as np


def _bilinear(terms, width):
    """The (16, width) matrix of a bilinear map: `terms` are (component of a, component of b, output, factor)."""
    matrix = np.zeros((16, width))
    for a, b, out, factor in terms:
        matrix[4 * a + b, out] += factor
    return matrix


# Hamilton product, and the rotation matrix q -> R(q) row by row.
_PRODUCT = _bilinear(
    [
        *[(0, 0, 0, 1), (1, 1, 0, -1), (2, 2, 0, -1), (3, 3, 0, -1)],
        *[(0, 1, 1, 1), (1, 0, 1, 1), (2, 3, 1, 1), (3, 2, 1, -1)],
        *[(0, 2, 2, 1), (2, 0, 2, 1), (3, 1, 2, 1), (1, 3, 2, -1)],
        *[(0, 3, 3, 1), (3, 0, 3, 1), (1, 2, 3, 1), (2, 1, 3, -1)],
    ],
    4,
)
_ROTATION = _bilinear(
    [(0, 0, k, 1) for k in (0, 4, 8)]
    + [(c, c, 4 * (r - 1), 1 if c == r else -1) for r in (1, 2, 3) for c in (1, 2, 3)]
    + [(1, 2, 1, 2), (0, 3, 1, -2), (1, 3, 2, 2), (0, 2, 2, 2)]
    + [(1, 2, 3, 2), (0, 3, 3, 2), (2, 3, 5, 2), (0, 1, 5, -2)]
    + [(1, 3, 6, 2), (0, 2, 6, -2), (2, 3, 7, 2), (0, 1, 7, 2)],
    9,
)
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _apply(bilinear, a, b):
    outer = a[..., :, None] * b[..., None, :]
    return outer.reshape(*outer.shape[:-2], 16) @ bilinear


def multiply(a, b):
    """Hamilton product (..., 4): first `b`, then `a`."""
    return _apply(_PRODUCT, a, b)


def conjugate(q):
    """Inverse rotation of unit quaternions."""
    return q * _CONJUGATE


def matrices(q):
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    flat = _apply(_ROTATION, q, q)
    return flat.reshape(*flat.shape[:-1], 3, 3)


def normalized(q):
    """Unit quaternions."""
    return q / _length(q)


def _length(v):
    """|v| (..., 1); `vecdot` is much faster than a sum over so short an axis."""
    return np.sqrt(np.vecdot(v, v))[..., None]


def exp(v):
    """Quaternions (..., 4) of rotation vectors (..., 3), radians, full angle."""
    half = 0.5 * _length(v)
    q = np.empty((*v.shape[:-1], 4))
    q[..., :1] = np.cos(half)
    safe = np.maximum(half, 1e-12)  # sin(x)/x is 1 to rounding long before this
    q[..., 1:] = 0.5 * (np.sin(safe) / safe) * v
    return q


def log(q):
    """Rotation vectors (..., 3) of unit quaternions (..., 4), angle in [0, pi]."""
    s = _length(q[..., 1:])
    w = q[..., :1]
    safe = np.maximum(s, 1e-12)
    # atan2 of |w| and the sign afterwards: q and -q are one rotation, and the shorter way is meant
    return np.where(w < 0, -2.0, 2.0) * (np.arctan2(safe, np.abs(w)) / safe) * q[..., 1:]
