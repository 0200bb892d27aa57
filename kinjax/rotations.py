"""Rotations as quaternions `wxyz`, with the components along the **first** axis.

In and out: arrays (4, ...) and (3, ...), or their components as separate arrays. Hot kernels keep components first, so
that every operation runs down long contiguous rows; `axis=-1` arrays of the public types are moved once, at the entry.
`exp` takes rotation vectors (full angle) to quaternions, `log` back. Quaternions are unit unless said.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import components
from .numerics import safe_sqrt

Quaternion = Float[Array, "4 ..."]
Vector = Float[Array, "3 ..."]
Parts = Sequence[Float[Array, "..."]]
"""The components of either as separate arrays: what is never stacked need not be taken apart again."""


def multiply(a: Quaternion | Parts, b: Quaternion | Parts) -> Quaternion:
    """Hamilton product: first `b`, then `a`."""
    return jnp.stack(components.multiply(a, b))


def conjugate(q: Quaternion) -> Quaternion:
    """Inverse rotation."""
    return jnp.stack(components.conjugate(q))


def cross(a: Vector | Parts, b: Vector | Parts) -> Vector:
    """Cross product."""
    return jnp.stack(components.cross(a, b))


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
    return jnp.stack(components.rotate(q, v))


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
    r = components.matrix(q)
    return jnp.stack([jnp.stack(r[i : i + 3]) for i in (0, 3, 6)])


def exp(v: Vector) -> Quaternion:
    """Quaternion of a rotation vector (radians, full angle), smooth at 0 to any order that is asked for."""
    square = dot(v, v)
    # by their series where the quotients would lose digits, and the square root its derivatives
    small = square < 1e-3
    half = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square)) / 2
    w = jnp.where(small, 1 - square / 8 + square * square / 384, jnp.cos(half))
    factor = jnp.where(small, 0.5 - square / 48 + square * square / 3840, jnp.sin(half) / (half + half))
    return jnp.concatenate([w[None], factor * v])


def log(q: Quaternion) -> Vector:
    """Rotation vector of a quaternion, angle in [0, pi]."""
    q = jnp.where(q[0] < 0, -q, q)
    s = safe_sqrt(dot(q[1:], q[1:]))
    small = s < 1e-4
    safe = jnp.where(small, jnp.ones_like(s), s)
    # 2 asin(s)/s by its series where the quotient would lose the gradient
    return jnp.where(small, 2 + s * s / 3, 2 * jnp.arctan2(safe, q[0]) / safe) * q[1:]
