"""Euler angles of files and quaternions of motions, in float64 NumPy: every channel order, and back, continuously.

In: angles in the order in which a file lists the axes. Out: quaternions `wxyz`; and back to angles that do not jump.
The convention: axes "zxy" means `R = Rz(a) Rx(b) Ry(c)`, each about the axis already turned (as BVH lists its channels).
A channel list has at most one rotation an axis, so all lists are Tait-Bryan orders, or beginnings of one.

With `i, j, k` the axes in order, `e` the parity of `ijk`, and half angles `A, B, C`:
`w = cA cB cC - e sA sB sC`, `q_i = sA cB cC + e cA sB sC`, `q_j = cA sB cC - e sA cB sC`, `q_k = cA cB sC + e sA sB cC`, so
`(w + q_j, q_i + e q_k) = (cB + sB) (cos, sin)(A + e C)` and `(w - q_j, q_i - e q_k) = (cB - sB) (cos, sin)(A - e C)`.
The second form has no arcsine: the middle angle keeps full precision at 90 degrees, where one of the pairs vanishes.
"""

from __future__ import annotations

import numpy as np

# Half of the distance of the middle angle from 90 degrees, below which the outer angles are not told apart. Above it the
# rounding of a float64 quaternion moves an outer angle by less than half of the sixth digit; below it, what replaces it
# is off by at most twice this angle (radians).
GIMBAL = 5e-8


def _order(axes: str) -> tuple[int, int, int, float]:
    """Indices of the three axes of a channel list, missing ones appended, and the parity of their order."""
    full = axes + "".join(x for x in "xyz" if x not in axes)
    i, j, k = ("xyz".index(x) for x in full)
    return i, j, k, 1.0 if (j - i) % 3 == 1 else -1.0


def euler_to_quaternion(degrees: np.ndarray, axes: str) -> np.ndarray:
    """Quaternions (..., 4) of angles (..., len(axes)) in degrees about `axes`, 0 to 3 different letters of "xyz"."""
    return np.stack(quaternion_parts(np.moveaxis(degrees, -1, 0), axes), axis=-1)


def quaternion_parts(degrees: np.ndarray, axes: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The four components (...) of the quaternions of angles (len(axes), ...): as `euler_to_quaternion`, components first."""
    c, s = _cos_sin(degrees)
    parts = [np.ones(degrees.shape[1:]), *(np.zeros(degrees.shape[1:]) for _ in range(3))]
    if len(axes) == 1:
        parts[0], parts[1 + "xyz".index(axes)] = c[0], s[0]
    elif axes:
        i, j, k, e = _order(axes)
        w, x, y, z = c[0] * c[1], s[0] * c[1], c[0] * s[1], e * s[0] * s[1]
        if len(axes) == 3:
            cc, sc = c[2], s[2]
            w, x, y, z = w * cc - z * sc, x * cc + e * (y * sc), y * cc - e * (x * sc), w * sc + z * cc
        parts[0], parts[1 + i], parts[1 + j], parts[1 + k] = w, x, y, z
    return parts[0], parts[1], parts[2], parts[3]


def _cos_sin(degrees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of half the angles. By way of the tangent of a quarter: NumPy has a vectorised one, and no vectorised sine
    in float64; a tenth of the time, and as exact (to 4 units in the last place)."""
    t = np.tan(degrees * (np.pi / 720.0))
    u = t * t
    w = 1.0 / (1.0 + u)
    return (1.0 - u) * w, 2.0 * t * w


def unwrap(degrees: np.ndarray, digits: int = 6) -> np.ndarray:
    """Angles (frames, ...), rounded to `digits`, made continuous by whole turns, the first within -180 and 180.

    A step of exactly half a turn goes down, whichever way rounding tips it, so that equal motions give equal numbers.
    """
    tie = 0.5 * 10.0**-digits
    step = np.diff(degrees, axis=0, prepend=0.0)
    return degrees + 360.0 * np.cumsum(np.ceil((-180.0 - tie - step) / 360.0), axis=0)


def quaternion_to_euler(quaternion: np.ndarray, axes: str, digits: int = 6) -> np.ndarray:
    """Continuous angles in degrees, (frames, ..., len(axes)), of quaternions (frames, ..., 4); the time axis comes first.

    Of the two triples that give a rotation, each frame takes the one nearer to the frame before (the first: middle angle
    within 90 degrees). Where the middle angle is at 90 degrees, the first angle is held. With fewer than three
    axes the angles are those of the nearest such rotation in the listed axes: compare `euler_to_quaternion` of them.
    The angles are rounded before anything is decided on them, so angles read from a file give the same angles again.
    """
    i, j, k, e = _order(axes)
    w, x, y, z = (quaternion[..., n] for n in (0, 1 + i, 1 + j, 1 + k))
    if not axes:
        return np.zeros((*quaternion.shape[:-1], 0))
    if len(axes) == 1:
        return unwrap(np.round(np.degrees(2 * np.arctan2(x, w)), digits), digits)[..., None]
    if len(axes) == 2:
        # (w, x) = cB (cA, sA) and (y, e z) = sB (cA, sA): the longer pair tells A, then both tell B.
        longer = w * w + x * x >= y * y + z * z
        a = np.arctan2(np.where(longer, x, e * z), np.where(longer, w, y))
        b = np.arctan2(y * np.cos(a) + e * z * np.sin(a), w * np.cos(a) + x * np.sin(a))
        return unwrap(np.round(np.degrees(2 * np.stack([a, b], axis=-1)), digits), digits)
    plus, minus = np.hypot(w + y, x + e * z), np.hypot(w - y, x - e * z)
    sum_, difference = np.degrees(np.arctan2(x + e * z, w + y)), np.degrees(np.arctan2(x - e * z, w - y))
    a, b = np.round(sum_ + difference, digits), np.round(np.degrees(2 * np.arctan2(plus, minus)) - 90.0, digits)
    c = e * (sum_ - difference)
    locked = 90.0 - np.abs(b) < np.degrees(2 * GIMBAL)
    if locked.any():
        frame = np.arange(len(a)).reshape(-1, *(1,) * (a.ndim - 1))
        last = np.maximum.accumulate(np.where(locked, -1, frame), axis=0)
        held = np.where(last >= 0, np.take_along_axis(a, np.maximum(last, 0), axis=0), 0.0)
        a = np.where(locked, held, a)
        c = np.where(locked, np.where(b > 0, e * (2 * sum_ - a), e * (a - 2 * difference)), c)
    c = np.round(c, digits)
    angles = np.stack([a, b, c], axis=-1)
    # The other triple is (a + 180, 180 - b, c + 180). Changing both frames of a pair keeps their distance, so where the
    # motion changes triples does not depend on which one it is on: one pass, no loop over frames.
    other = np.stack([a + 180.0, 180.0 - b, c + 180.0], axis=-1)
    stay, change = (_distance(to[1:], angles[:-1]) for to in (angles, other))
    changes = np.zeros(a.shape, int)
    changes[1:] = change < stay - 10.5 * 10.0**-digits
    on_other = np.cumsum(changes, axis=0) % 2 == 1
    return unwrap(np.where(on_other[..., None], other, angles), digits)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum over the last axis of the distances of angles on the circle, degrees."""
    return np.abs((a - b + 180.0) % 360.0 - 180.0).sum(-1)


def rotation_between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Angle in radians, (...), between two unit quaternions (..., 4), `q` and `-q` equal; exact for small angles."""
    near = np.where((p * q).sum(-1, keepdims=True) < 0, -q, q)
    return 4 * np.arcsin(np.minimum(np.linalg.norm(p - near, axis=-1) / 2, 1.0))
