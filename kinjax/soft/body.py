"""Forward kinematics whose derivative is as cheap as its value.

In: local rotations, moving translations, offsets. Out: world poses of the objects, components first. The value is that of
`kinematics.world_transforms`, whose scan over joints is the fastest here but slow to differentiate (every step would carry the
gradient of all joints). The derivative is written in closed form instead: with `A` the matrix of who is an ancestor of whom,
world angular velocities are `A c` and velocities `(A c) x t + A (d - c x t)`, `c` and `d` the own contributions of each joint: two
matrix products, in either mode.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..detect.interface import Joints
from ..kinematics import world_transforms
from .parts import Parts, conjugate, cross, multiply, normalize, rotate, vector_of_product


def joint_poses(x: Joints) -> tuple[Parts, Parts, Bool[Array, "objects frames"]]:
    """World poses of the joints that are objects, origins at their segments' centres: `detect.engine.joint_poses`, with
    rotations normalised first, frames that are not valid replaced by the identity, and a cheap derivative."""
    # split, not indexed: the gradient is then one concatenation
    rows = (r[:, 0] for r in jnp.split(jnp.asarray(x.rotations), 4, axis=1))
    local = normalize(tuple(jnp.where(x.valid, r, 0 if k else 1) for k, r in enumerate(rows)))
    moving = jnp.where(x.valid, x.moving, 0)
    world = _world(local, moving, x.offsets, x.parents, x.translated)
    q, t = (tuple(w[x.at] for w in part) for part in (world[:4], world[4:]))
    lever = rotate(q, tuple(x.centers[:, k, None] for k in range(3)))
    return q, tuple(a + b for a, b in zip(t, lever, strict=True)), x.valid & (x.at >= 0)[:, None]


@jax.custom_jvp
def _world(
    rotations: tuple[Array, ...], moving: Array, offsets: Array, parents: Array, translated: Array
) -> tuple[Float[Array, "rows frames"], ...]:
    return world_transforms(jnp.stack(rotations, axis=1), moving, offsets, parents, translated)


def _ancestors(parents: Int[Array, " joints"], dtype: Any) -> Float[Array, "joints joints"]:
    """1 where the column's joint is the row's, or above it."""
    joints = parents.shape[0]
    eye = jnp.eye(joints, dtype=dtype)

    def step(rows: Array, x: tuple[Array, ...]) -> tuple[Array, None]:
        j, above, own = x
        row = own + jnp.where(above >= 0, rows[jnp.maximum(above, 0)], 0)
        return jax.lax.dynamic_update_index_in_dim(rows, row, j, 0), None

    at = jnp.arange(joints, dtype=jnp.int32)
    return jax.lax.scan(step, jnp.zeros_like(eye), (at, parents, eye))[0]


@_world.defjvp
def _world_jvp(primals: Any, tangents: Any) -> Any:
    rotations, _, _, parents, translated = primals
    d_rotations, d_moving, d_offsets = tangents[:3]
    world = _world(*primals)
    joints, frames = rotations[0].shape
    above = jnp.where(parents < 0, joints, parents)
    parent = tuple(w[above] for w in world[:4])  # a row each, the identity for the roots
    # own turn in the parent's axes: 2 vec(dq q*), to the world by the parent's rotation
    turn = tuple(2 * x for x in vector_of_product(d_rotations, conjugate(rotations)))
    own = rotate(parent, turn)
    offset = (jnp.broadcast_to(d_offsets[:, k, None], (joints, frames)) for k in range(3))
    shift = rotate(
        parent, tuple(o.at[translated].set(d_moving[:, k], unique_indices=True) for k, o in enumerate(offset))
    )
    place = tuple(w[:joints] for w in world[4:])
    rest = tuple(a - b for a, b in zip(shift, cross(own, place), strict=True))
    both = jnp.concatenate([*own, *rest], axis=-1)
    summed = jnp.matmul(_ancestors(parents, both.dtype), both, precision="highest")
    *spin, fx, fy, fz = jnp.split(summed, 6, axis=-1)
    d_t = (a + b for a, b in zip(cross(tuple(spin), place), (fx, fy, fz), strict=True))
    d_q = multiply((jnp.zeros_like(spin[0]), *(s / 2 for s in spin)), tuple(w[:joints] for w in world[:4]))
    last = jnp.zeros((1, frames), both.dtype)
    return world, tuple(jnp.concatenate([d, last]) for d in (*d_q, *d_t))
