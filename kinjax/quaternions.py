"""Quaternions `wxyz` on the host: NumPy, float64, components along the **last** axis, as the public types have them.

In and out: arrays (..., 4) and (..., 3), leading axes broadcast. What is computed once a clip (paths of targets, reports)
needs no compiled program; `rotations` has the same in JAX for what runs in the engines. `turns` and `from_turns` lead to
SciPy and back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Quaternions = Float[np.ndarray, "... 4"]
Vectors = Float[np.ndarray, "... 3"]


def multiply(a: Quaternions, b: Quaternions) -> Quaternions:
    """Hamilton product: first `b`, then `a`."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return _joined(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def inverse(q: Quaternions) -> Quaternions:
    """Inverse of unit quaternions."""
    return q * np.array([1.0, -1, -1, -1])


def rotate(q: Quaternions, v: Vectors) -> Vectors:
    """Vectors turned by unit quaternions."""
    w, x, y, z = (q[..., i] for i in range(4))
    a, b, c = (v[..., i] for i in range(3))
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return _joined(a + w * s + y * u - z * t, b + w * t + z * s - x * u, c + w * u + x * t - y * s)


def exponential(v: Vectors) -> Quaternions:
    """Quaternions of rotation vectors, full angle; continued beyond half a turn."""
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * v], -1)


def known(q: Quaternions) -> Quaternions:
    """`q` with the identity in place of what is not finite."""
    return np.where(np.isfinite(q).all(-1, keepdims=True), q, np.array([1.0, 0, 0, 0]))


def turns(q: Quaternions) -> Rotation:
    """SciPy rotations (leading axes flattened), the identity where a quaternion is not finite: SciPy takes no others."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(known(np.asarray(q, float)).reshape(-1, 4)[:, [1, 2, 3, 0]])


def from_turns(r: Rotation) -> Quaternions:
    """Quaternions of SciPy rotations."""
    return r.as_quat()[..., [3, 0, 1, 2]]


def _joined(*parts: np.ndarray) -> np.ndarray:
    """Components along a new last axis, each contiguous in memory: what follows reads them one by one."""
    out = np.empty((len(parts), *parts[0].shape), np.result_type(*parts))
    for i, part in enumerate(parts):
        out[i] = part
    return out.transpose(*range(1, out.ndim), 0)
