"""The kernel of forward kinematics: world poses of all joints, with a derivative as cheap as the value.

In: local rotations, moving translations, offsets, components first. Out: world rotations and places, an array a component. The
value is one `lax.scan` over the joints, whose parents are data: it compiles once for each number of joints, whatever the
skeleton. Differentiated as it stands, every step would carry the gradient of all joints. The derivative is written in closed
form instead: with `A` the matrix of who is an ancestor of whom, world angular velocities are `A c` and velocities
`(A c) x t + A (d - c x t)`, `c` and `d` the own contributions of each joint: two matrix products, in either mode.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .components import Parts, conjugate, cross, multiply, rotate, vector_of_product


@jax.custom_jvp
def world_transforms(
    rotations: Float[Array, "joints 4 frames"] | Parts,
    moving: Float[Array, "t 3 frames"],
    offsets: Float[Array, "joints 3"],
    parents: Int[Array, " joints"],
    translated: Int[Array, " t"],
) -> Parts:
    """The seven components (rows, frames) of every joint's world quaternion and position.

    rotations: local, unit quaternions, as one array or as four components (joints, frames). offsets: metres in the parent's
    frame; the `translated` joints have `moving` ones instead. A root's parent is -1, and a joint comes after its parent. The
    row after the last joint's is the identity, the parent of the roots. Derivatives are those along unit quaternions: what
    changes a quaternion's length alone changes nothing.
    """
    joints, frames = rotations[0].shape if isinstance(rotations, tuple) else rotations.shape[::2]
    if not moving.shape[0]:  # a row that no joint has
        moving = jnp.zeros((1, 3, frames), offsets.dtype)
    own = jnp.full(joints, -1, jnp.int32).at[translated].set(jnp.arange(translated.shape[0], dtype=jnp.int32))
    one, zero = jnp.ones(frames, offsets.dtype), jnp.zeros(frames, offsets.dtype)
    identity = (one, *(zero,) * 6)

    # one array a component, each of which a step writes in one vectorised pass (a concatenation would not be one). It reads rows
    # one by one: of a slice that is taken apart, XLA makes a function whose loop does not vectorise
    def row(x: Array, at: Array) -> Array:
        return jax.lax.dynamic_index_in_dim(x, at, 0, keepdims=False)

    def rows(x: Array, at: Array) -> list[Array]:
        flat, count = x.reshape(-1, frames), x.shape[1]
        return [row(flat, at * count + k) for k in range(count)]

    # a step fetches its successor's parent after it has written: were its own fetched first, XLA would copy the arrays every step
    def step(carried: Any, x: tuple[Array, ...]) -> tuple[Any, None]:
        world, above = carried
        j, following, offset, path = x
        q = [row(r, j) for r in rotations] if isinstance(rotations, tuple) else rows(rotations, j)
        t = [jnp.where(path >= 0, m, o) for m, o in zip(rows(moving, jnp.maximum(path, 0)), offset, strict=True)]
        here = (*multiply(above[:4], q), *(a + b for a, b in zip(above[4:], rotate(above[:4], t), strict=True)))
        world = tuple(jax.lax.dynamic_update_index_in_dim(w, h, j, 0) for w, h in zip(world, here, strict=True))
        # never: but what is fetched depends on all that was written, else XLA fetches in between, and copies what it still needs
        never = functools.reduce(jnp.add, (jax.lax.dynamic_slice(w, (j, jnp.int32(0)), (1, 1))[0, 0] for w in world)) > jnp.inf
        following = following + never.astype(jnp.int32)
        return (world, tuple(row(w, following) for w in world)), None

    following = jnp.roll(jnp.where(parents < 0, joints, parents), -1)
    above = identity  # the first joint is a root
    xs = jnp.arange(joints, dtype=jnp.int32), following, offsets, own
    world = tuple(jnp.broadcast_to(x, (joints + 1, frames)) for x in identity)
    return jax.lax.scan(step, (world, above), xs)[0][0]


@world_transforms.defjvp
def _derivative(primals: Any, tangents: Any) -> tuple[Parts, Parts]:
    rotations, _, _, parents, translated = primals
    d_rotations, d_moving, d_offsets = tangents[:3]
    world = world_transforms(*primals)
    if not isinstance(rotations, tuple):
        # split, not indexed: the gradient is then one concatenation
        rotations, d_rotations = (tuple(r[:, 0] for r in jnp.split(x, 4, axis=1)) for x in (rotations, d_rotations))
    joints, frames = rotations[0].shape
    above = jnp.where(parents < 0, joints, parents)
    parent = tuple(w[above] for w in world[:4])
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
