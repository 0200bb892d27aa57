"""Rotations as quaternions `wxyz`, with the components along the **first** axis.

In and out: arrays (4, ...) and (3, ...), or their components as separate arrays. Hot kernels keep components first, so
that every operation runs down long contiguous rows; `axis=-1` arrays of the public types are moved once, at the entry.
`exp` takes rotation vectors (full angle) to quaternions, `log` back. Quaternions are unit unless said.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from .numerics import safe_sqrt

Quaternion = Float[Array, "4 ..."]
Vector = Float[Array, "3 ..."]
Parts = Sequence[Float[Array, "..."]]
"""The components of either as separate arrays: what is never stacked need not be taken apart again."""


def multiply(a: Quaternion | Parts, b: Quaternion | Parts) -> Quaternion:
    """Hamilton product: first `b`, then `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(q: Quaternion) -> Quaternion:
    """Inverse rotation."""
    w, x, y, z = q
    return jnp.stack([w, -x, -y, -z])


def cross(a: Vector | Parts, b: Vector | Parts) -> Vector:
    """Cross product."""
    ax, ay, az = a
    bx, by, bz = b
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def dot(a: Float[Array, "c ..."] | Parts, b: Float[Array, "c ..."] | Parts) -> Float[Array, "..."]:
    """Inner product over the first axis, component by component (XLA reduces a short leading axis slowly)."""
    return sum((x * y for x, y in zip(a[1:], b[1:], strict=True)), a[0] * b[0])


def apply(r: Float[Array, "3 3 ..."], v: Vector) -> Vector:
    """`R v`, rows first."""
    return jnp.stack([dot(row, v) for row in r])


def apply_transposed(r: Float[Array, "3 3 ..."], v: Vector) -> Vector:
    """`R^T v`."""
    return jnp.stack([dot(r[:, k], v) for k in range(3)])


def rotate(q: Quaternion | Parts, v: Vector | Parts) -> Vector:
    """`R(q) v`."""
    w, *u = q
    t = [x + x for x in cross(u, v)]
    return jnp.stack([x + w * y + z for x, y, z in zip(v, t, cross(u, t), strict=True)])


def normalize(q: Quaternion) -> Quaternion:
    """Unit quaternion; zero and non-finite ones become the identity (their frames are masked)."""
    n2 = dot(q, q)
    good = (n2 > 0) & jnp.isfinite(n2)
    # component by component: what selects on a stack of them does not vectorise
    parts = [jnp.where(good, x, 0 if i else 1) for i, x in enumerate(q)]
    scale = 1 / safe_sqrt(dot(parts, parts))
    return jnp.stack([x * scale for x in parts])


def matrix(q: Quaternion) -> Float[Array, "3 3 ..."]:
    """Rotation matrix, rows first."""
    w, x, y, z = q
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def exp(v: Vector) -> Quaternion:
    """Quaternion of a rotation vector (radians, full angle)."""
    angle = safe_sqrt(dot(v, v))  # where the square underflows the series does not need it
    half = angle / 2
    small = angle < 1e-3
    safe = jnp.where(small, jnp.ones_like(angle), angle)
    # sin(x/2)/x by its series where the quotient would lose the gradient
    factor = jnp.where(small, 0.5 - dot(v, v) / 48, jnp.sin(safe / 2) / safe)
    return jnp.concatenate([jnp.cos(half)[None], factor * v])


def log(q: Quaternion) -> Vector:
    """Rotation vector of a quaternion, angle in [0, pi]."""
    q = jnp.where(q[0] < 0, -q, q)
    s = safe_sqrt(dot(q[1:], q[1:]))
    small = s < 1e-4
    safe = jnp.where(small, jnp.ones_like(s), s)
    # 2 asin(s)/s by its series where the quotient would lose the gradient
    return jnp.where(small, 2 + s * s / 3, 2 * jnp.arctan2(safe, q[0]) / safe) * q[1:]
