"""Kochanek-Bartels splines on knots of any spacing, in space and for rotations; host NumPy, float64.

In: knots and tension, continuity and bias of each control point. Out: in space, weights (the curve is linear in control
points and end tangents); for rotations, the curve and its angular velocity. The tangents are those of Kochanek and Bartels
1984 with the chord slopes weighted for non-uniform knots, as the `splines` package has them; a spline of rotations takes
rotation vectors for differences and slerp in de Casteljau's algorithm for lines. Quaternions are continued along the
curve (their sign counts here), so one leg of a curve may turn by more than half a turn.
"""

from __future__ import annotations

import numpy as np

from ..quaternions import exponential, inverse, multiply, rotate

_LONGEST_LEG = 1.8 * np.pi  # radians; beyond a whole turn the slerp of a leg would turn the other way


def side_factors(tcb: np.ndarray) -> np.ndarray:
    """Factors (..., 4) of the slopes before and after a knot in its incoming and in its outgoing tangent.

    tcb: (..., 3) tension, continuity, bias. Kochanek and Bartels 1984, equations 8 and 9.
    """
    t, c, b = np.moveaxis(np.asarray(tcb, float), -1, 0)
    return np.stack(
        [
            (1 - t) * (1 - c) * (1 + b),
            (1 - t) * (1 + c) * (1 - b),
            (1 - t) * (1 + c) * (1 + b),
            (1 - t) * (1 - c) * (1 - b),
        ],
        -1,
    )


def tangent_weights(knots: np.ndarray, tcb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Incoming and outgoing tangent of each of K knots as weights (K, K + 2) of [control points; two end tangents].

    knots: (K,) strictly increasing. tcb: (K, 3). At the ends only the tension counts: it shortens the given tangent by
    `1 - tension`.
    """
    k = len(knots)
    incoming, outgoing = np.zeros((k, k + 2)), np.zeros((k, k + 2))
    outgoing[0, k], incoming[-1, k + 1] = 1 - tcb[0, 0], 1 - tcb[-1, 0]
    h, factors = np.diff(knots), side_factors(tcb)
    for i in range(1, k - 1):
        before, after = np.zeros(k + 2), np.zeros(k + 2)
        before[[i - 1, i]] = np.array([-1, 1]) / h[i - 1]
        after[[i, i + 1]] = np.array([-1, 1]) / h[i]
        near = np.array([h[i], h[i - 1]]) / (h[i - 1] + h[i])  # the slope of the shorter side counts more
        incoming[i] = factors[i, 0] * near[0] * before + factors[i, 1] * near[1] * after
        outgoing[i] = factors[i, 2] * near[0] * before + factors[i, 3] * near[1] * after
    return incoming, outgoing


def curve_weights(
    u: np.ndarray, knots: np.ndarray, incoming: np.ndarray, outgoing: np.ndarray, derivative: int = 0
) -> np.ndarray:
    """Weights (n, K + 2) of the curve (or of its first derivative) at `u` (n,), clipped to the knots: cubic Hermite.

    At a knot the row is exactly its unit vector, and the derivative is the one that goes out of the knot.
    """
    if len(knots) == 1:
        return np.repeat(np.zeros((1, 3)) if derivative else np.eye(1, 3), len(u), 0)
    j, s, h = _segment(u, knots)
    if derivative:
        p0, p1 = 6 * s * (s - 1) / h, 6 * s * (1 - s) / h
        v0, v1 = (1 - s) * (1 - 3 * s), s * (3 * s - 2)
    else:
        p0, p1 = (1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s)
        v0, v1 = h * s * (1 - s) ** 2, h * s**2 * (s - 1)
    rows = v0[:, None] * outgoing[j] + v1[:, None] * incoming[j + 1]
    at = np.arange(len(u))
    rows[at, j] += p0
    rows[at, j + 1] += p1
    return rows


def rotation_legs(quaternions: np.ndarray, knots: np.ndarray, tcb: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Bezier legs (K - 1, 3, 3): rotation vectors (world, full angle) from each control quaternion to the next.

    quaternions: (K, 4) unit, neighbours in one hemisphere. ends: (2, 3) angular velocity at the first and last knot,
    radians in one unit of the knots. A knot whose tangent would turn more than 1.8 pi in a third of a segment has it
    shortened, the same on both sides.
    """
    h, k = np.diff(knots), len(knots)
    turn = logarithm(multiply(quaternions[1:], inverse(quaternions[:-1])))
    incoming, outgoing = np.zeros((k, 3)), np.zeros((k, 3))
    outgoing[0], incoming[-1] = (1 - tcb[0, 0]) * ends[0], (1 - tcb[-1, 0]) * ends[1]
    if k > 2:
        factors = side_factors(tcb[1:-1])[..., None]
        before, after = h[:-1, None], h[1:, None]
        a, b = turn[:-1] / before * after / (before + after), turn[1:] / after * before / (before + after)
        incoming[1:-1], outgoing[1:-1] = factors[:, 0] * a + factors[:, 1] * b, factors[:, 2] * a + factors[:, 3] * b
    into, out = incoming * np.r_[0, h][:, None] / 3, outgoing * np.r_[h, 0][:, None] / 3
    longest = np.maximum(np.linalg.norm(into, axis=-1), np.linalg.norm(out, axis=-1))
    short = _LONGEST_LEG / np.maximum(longest, _LONGEST_LEG)
    first, last = out[:-1] * short[:-1, None], into[1:] * short[1:, None]
    near, far = multiply(exponential(first), quaternions[:-1]), multiply(exponential(-last), quaternions[1:])
    return np.stack([first, logarithm(multiply(far, inverse(near))), last], 1)


def rotation_curve(
    u: np.ndarray, knots: np.ndarray, quaternions: np.ndarray, legs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion (n, 4) and angular velocity (n, 3; world, radians in one unit of the knots) at `u` (n,), clipped."""
    if len(knots) == 1:
        return np.repeat(quaternions, len(u), 0), np.zeros((len(u), 3))
    j, s, h = _segment(u, knots)
    s = s[:, None, None]
    corners = [quaternions[j]]
    for leg in np.moveaxis(legs[j], 1, 0)[:2]:
        corners.append(multiply(exponential(leg), corners[-1]))
    corner = np.stack(corners, 1)
    # a slerp of two points that themselves move with s: first the point, then its velocity by s
    points, speeds = multiply(exponential(s * legs[j]), corner), legs[j]
    while points.shape[1] > 1:
        a, b, wa, wb = points[:, :-1], points[:, 1:], speeds[:, :-1], speeds[:, 1:]
        across = multiply(b, inverse(a))
        between = logarithm(across)
        stretch = _inverse_jacobian(between, wb - rotate(across, wa))
        part = exponential(s * between)
        points = multiply(part, a)
        speeds = between + s * _jacobian(s * between, stretch) + rotate(part, wa)
    found, speed = points[:, 0], speeds[:, 0] / h[:, None]
    # a knot is met exactly, whatever the rounding of the legs
    first, last = (s[:, 0] == 0), (s[:, 0] == 1)
    found = np.where(first, quaternions[j], np.where(last, quaternions[j + 1], found))
    return found / np.linalg.norm(found, axis=-1, keepdims=True), speed


def one_hemisphere(quaternions: np.ndarray) -> np.ndarray:
    """Unit quaternions (K, 4) with signs chosen so that neighbours are joined by their shortest arc."""
    q = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    q[1:] *= np.cumprod(np.where(np.sum(q[1:] * q[:-1], -1) < 0, -1.0, 1.0))[:, None]
    return q


def logarithm(q: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) of unit quaternions, angle in [0, 2 pi]: the sign of `q` counts. About x for -1."""
    w, v = q[..., :1], q[..., 1:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    tiny = sine < 1e-150  # no direction left
    axis = np.where(tiny, np.array([1.0, 0, 0]), v / np.where(tiny, 1.0, sine))
    return 2 * np.arctan2(np.where(tiny, 0.0, sine), w) * axis


def _segment(u: np.ndarray, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interval of each parameter, the place in it from 0 to 1, and its length."""
    u = np.clip(u, knots[0], knots[-1])
    j = np.clip(np.searchsorted(knots, u, side="right") - 1, 0, len(knots) - 2)
    h = knots[j + 1] - knots[j]
    return j, (u - knots[j]) / h, h


def _jacobian(v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Left Jacobian of the exponential at `v` (..., 3), applied to `w` (..., 3)."""
    a = np.linalg.norm(v, axis=-1, keepdims=True)
    small = a < 1e-3
    x = np.where(small, 1.0, a)
    c1 = np.where(small, 0.5 - a**2 / 24, (1 - np.cos(x)) / x**2)
    c2 = np.where(small, 1 / 6 - a**2 / 120, (x - np.sin(x)) / x**3)
    vw = np.cross(v, w)
    return w + c1 * vw + c2 * np.cross(v, vw)


def _inverse_jacobian(v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Its inverse, for |v| below a whole turn."""
    a = np.linalg.norm(v, axis=-1, keepdims=True)
    small = a < 1e-2
    x = np.where(small, 1.0, np.minimum(a, 2 * np.pi - 1e-6))
    c = np.where(small, 1 / 12 + a**2 / 720, (1 - x / 2 / np.tan(x / 2)) / x**2)
    vw = np.cross(v, w)
    return w - vw / 2 + c * np.cross(v, vw)
