"""Rotations in plain NumPy, float64: what the synthetic scenes are built and refitted with.

In and out: arrays with leading batch axes; quaternions `wxyz`, unit; rotation vectors in radians (full angle). The
engines have their own, in JAX; these stay independent of them, so that truth and detector share no arithmetic.
"""

from __future__ import annotations

import numpy as np


def quat_exp(rotvec: np.ndarray) -> np.ndarray:
    """Quaternion (..., 4) of the rotation vector (..., 3), radians."""
    rotvec = np.asarray(rotvec, float)
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * rotvec], -1)


def quat_mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation `b` followed by `a`, (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - np.sum(av * bv, -1, keepdims=True)
    return np.concatenate([w, aw * bv + bw * av + np.cross(av, bv)], -1)


def quat_inv(q: np.ndarray) -> np.ndarray:
    """The inverse of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def quat_rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The vectors `v` (..., 3) turned by `q` (..., 4); batch axes broadcast."""
    v = np.asarray(v, float)
    w, u = q[..., :1], q[..., 1:]
    s = np.cross(u, v)
    return v + 2.0 * (w * s + np.cross(u, s))


def quat_to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    return np.stack([quat_rotate(q, e) for e in np.eye(3)], -1)


def quat_from_matrix(m: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) of rotation matrices (..., 3, 3); of Shepperd's four forms (1978) the best behaved."""
    m = np.asarray(m, float)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    forms = np.stack(
        [
            np.stack([1 + xx + yy + zz, a, b, c], -1),
            np.stack([a, 1 + xx - yy - zz, d, e], -1),
            np.stack([b, d, 1 - xx + yy - zz, f], -1),
            np.stack([c, e, f, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(forms, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(forms, best[..., None, None], -2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def unroll(q: np.ndarray) -> np.ndarray:
    """Signs chosen along the first axis (frames) so that neighbours agree: a continuous path for a continuous motion.

    NaN frames keep their NaN and do not break the chain: the sign follows the last finite frame.
    """
    q = np.array(q, float)
    finite = np.isfinite(q).all(-1)
    at = np.arange(len(q)).reshape(-1, *(1,) * (q.ndim - 2))
    last = np.maximum.accumulate(np.where(finite, at, 0), 0)
    known = np.nan_to_num(np.take_along_axis(q, last[..., None], 0))
    q[1:] *= np.cumprod(np.where(np.sum(known[1:] * known[:-1], -1) < 0, -1.0, 1.0), 0)[..., None]
    return q


def kabsch(local: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rigid pose that best takes `local` (markers, 3) to `world` (..., markers, 3), least squares; metres.

    Returns quaternions (..., 4) and the world position (..., 3) of the local origin; NaN wherever a marker is NaN.
    Source: Kabsch 1976, with the reflection of Umeyama 1991 excluded.
    """
    local, world = np.asarray(local, float), np.asarray(world, float)
    seen = np.isfinite(world).all((-2, -1))
    known = np.where(seen[..., None, None], world, local)
    p0, x0 = local.mean(-2), known.mean(-2)
    u, _, vt = np.linalg.svd(np.einsum("mi,...mj->...ij", local - p0, known - x0[..., None, :]))
    turn = np.linalg.det(u) * np.linalg.det(vt)
    signs = np.stack([np.ones_like(turn), np.ones_like(turn), turn], -1)
    rotation = np.einsum("...ki,...k,...jk->...ij", vt, signs, u)
    position = x0 - rotation @ p0
    hidden = ~seen[..., None]
    return np.where(hidden, np.nan, quat_from_matrix(rotation)), np.where(hidden, np.nan, position)
