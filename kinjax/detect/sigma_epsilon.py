"""Step 3: each displacement as a point `(sigma_3, eps_3, sigma_1, eps_1)` of the sigma-epsilon space (paper, section 5).

In: displacements. Out: `SigmaEpsilon`, with the stationary point and the axis of each instantaneous constraint. Two routes:
`project` in closed form, for rigid objects, finite with finite gradients at rest and at pi; and `project_svd`, the
paper's own route by singular values, for any 3 x 4 displacement. Each is the other's test.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import safe_norm, safe_sqrt
from ..rotations import cross, dot
from .displacements import Displacement

FLOOR_EPS = 32.0
"""Singular values up to this many machine epsilons count as zero and as equal to one another."""


class SigmaEpsilon(NamedTuple):
    """The sigma-epsilon point, and what is stationary.

    sigma_3, sigma_1: largest and smallest singular value of `R - I`. eps_3, eps_1: residuals in metres after zeroing the
    singular values up to `sigma_3` or `sigma_1` (eq. 8). point (3, ...): from the object's origin at the first frame to the
    point of the screw axis nearest to it, in the axes of the displacement. axis (3, ...): unit, 0 where the rotation has none.
    """

    sigma_3: Float[Array, "..."]
    eps_3: Float[Array, "..."]
    sigma_1: Float[Array, "..."]
    eps_1: Float[Array, "..."]
    point: Float[Array, "3 ..."]
    axis: Float[Array, "3 ..."]


def sigma_epsilon(x: Displacement) -> tuple[Array, Array, Array, Array]:
    """`sigma_3, eps_3, sigma_1, eps_1` alone, in closed form: the hot kernel.

    A rotation by `theta` about `a` has `R - I` with singular values `2 sin(theta/2)` twice and 0, so `sigma_3 = 2 |v|`,
    `eps_3 = |t|`, `sigma_1 = 0`, `eps_1 = |a . t|`; a displacement without rotation has all of them zero and `eps_1 = |t|`.
    """
    # no scaling before the squares: |v| <= 1, and displacements are neither 1e-19 m nor 1e19 m
    s = safe_sqrt(dot(x.v, x.v))
    eps_3 = safe_sqrt(dot(x.d, x.d))
    turning = s > FLOOR_EPS / 2 * jnp.finfo(s.dtype).eps
    along = jnp.abs(dot(x.v, x.d)) / jnp.where(turning, s, jnp.ones_like(s))
    return s + s, eps_3, jnp.zeros_like(s), jnp.where(turning, along, eps_3)


def project(x: Displacement) -> SigmaEpsilon:
    """Closed form of the whole projection; angles near pi lose nothing, at rest the axis is 0 and the point 0."""
    sigma_3, eps_3, sigma_1, eps_1 = sigma_epsilon(x)
    turning = sigma_3 > FLOOR_EPS * jnp.finfo(sigma_3.dtype).eps
    s = jnp.where(
        turning, sigma_3 / 2, 1
    )  # selected before the divisions: their gradients overflow long before they do
    axis = jnp.where(turning, x.v, 0) / s
    across = x.d - axis * dot(axis, x.d)
    # (R - I) p + t = 0 across the axis: p = t/2 + cot(theta/2) a x t / 2
    point = (across + x.w / s * cross(axis, across)) / 2
    return SigmaEpsilon(sigma_3, eps_3, sigma_1, eps_1, jnp.where(turning, point, 0), axis)


def project_svd(rotation: Float[Array, "3 3"], translation: Float[Array, " 3"]) -> SigmaEpsilon:
    """The paper's route for one displacement `[R t]`, by singular value decomposition of `R - I` (eq. 4 to 8)."""
    a = rotation - jnp.eye(3, dtype=rotation.dtype)
    u, s, vt = jnp.linalg.svd(a)  # s descending: s[0] is sigma_3, s[2] is sigma_1
    floor = FLOOR_EPS * jnp.finfo(s.dtype).eps

    def residual(limit: Array) -> tuple[Array, Array]:
        used = s > jnp.maximum(limit, floor)
        p = -vt.T @ (jnp.where(used, 1 / jnp.where(used, s, 1), 0) * (u.T @ translation))
        return safe_norm(a @ p + translation), p

    eps_3, _ = residual(s[0])
    eps_1, point = residual(s[2])
    axis = jnp.where(s[0] > floor, vt[2], 0)
    s = jnp.where(s > floor, s, 0)
    return SigmaEpsilon(s[0], eps_3, s[2], eps_1, point, axis)


def project_by_svd(x: Displacement) -> SigmaEpsilon:
    """`project_svd` over all displacements at once, on the layout of `Displacement`."""
    eye = jnp.eye(3, dtype=x.w.dtype)
    zero = jnp.zeros_like(x.w)
    vx, vy, vz = x.v
    hat = jnp.stack([jnp.stack([zero, -vz, vy]), jnp.stack([vz, zero, -vx]), jnp.stack([-vy, vx, zero])])
    square = x.v[:, None] * x.v[None] - dot(x.v, x.v) * eye.reshape(3, 3, *([1] * x.w.ndim))
    rotation = eye.reshape(3, 3, *([1] * x.w.ndim)) + 2 * x.w * hat + 2 * square
    flat = rotation.reshape(3, 3, -1).transpose(2, 0, 1), x.d.reshape(3, -1).T
    out = jax.vmap(project_svd)(*flat)
    shape = x.w.shape
    sigma_3, eps_3, sigma_1, eps_1 = (y.reshape(shape) for y in out[:4])
    point, axis = out.point.T.reshape(3, *shape), out.axis.T.reshape(3, *shape)
    return SigmaEpsilon(sigma_3, eps_3, sigma_1, eps_1, point, axis)
