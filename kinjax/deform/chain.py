"""The part of the skeleton that a deformation moves: forward kinematics of many trial poses of one frame.

In: local rotations and root places, one trial a lane. Out: world transforms, from which the rows of `tasks` are made. Only
the joints that lie between the root and something constrained are here, in their order; the others follow the input.
Arrays keep trials last, so that every operation runs over all trials at once.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..rotations import conjugate, exp, log, multiply, normalize, rotate

World = Float[Array, "p1 7 c"]
"""World quaternion and position of each joint, and of the world itself in the last row; trials last."""


class Chain(NamedTuple):
    """P joints, each after its parent.

    parents: (P,) -1 for the root. above: (P, P) 1 where the column's joint is the row's, or one of its ancestors.
    limits: (P, 3, 2) bounds of the rotation vector in radians, or None.
    """

    parents: Int[Array, " p"]
    above: Float[Array, "p p"]
    limits: Float[Array, "p 3 2"] | None = None


class Pose(NamedTuple):
    """Local rotations (4, P, C) and the root's place (3, C) of C trials."""

    rotations: Float[Array, "4 p c"]
    root: Float[Array, "3 c"]


def forward(chain: Chain, pose: Pose, offsets: Float[Array, "p 3"]) -> World:
    """World transforms of all trials; `offsets` are the joints' places in their parents' frames (the root's is unused)."""
    rotations, root = pose
    _, joints, trials = rotations.shape
    world = jnp.zeros((joints + 1, 7, trials), rotations.dtype).at[joints, 0].set(1)
    xs = (
        jnp.arange(joints, dtype=jnp.int32),
        jnp.where(chain.parents < 0, jnp.asarray(joints, jnp.int32), chain.parents),
        jnp.moveaxis(rotations, 1, 0),
        jnp.where((chain.parents < 0)[:, None, None], root[None], offsets[:, :, None]),
    )

    def step(world: World, x: tuple[Array, ...]) -> tuple[World, None]:
        j, parent, q, t = x
        up = jax.lax.dynamic_index_in_dim(world, parent, 0, keepdims=False)
        here = jnp.concatenate([multiply(up[:4], q), up[4:] + rotate(up[:4], t)])
        return jax.lax.dynamic_update_index_in_dim(world, here, j, 0), None

    return jax.lax.scan(step, world, xs)[0]


def moved(
    chain: Chain, pose: Pose, parent: Float[Array, "4 p"], step: Float[Array, "n c"]
) -> Pose:
    """The trials that `step` makes of the one pose (C = 1) whose joints' parents have world rotations `parent`.

    step: root translation, then for each joint a rotation vector, all along world axes. Limits are kept by clamping the
    rotation vector of a joint's rotation.
    """
    joints = parent.shape[1]
    turn = jnp.moveaxis(step[3:].reshape(joints, 3, -1), 1, 0)
    local = rotate(conjugate(parent)[:, :, None], turn)  # R_parent^T w: the same turn seen from the parent
    q = normalize(multiply(exp(local), pose.rotations))
    if chain.limits is not None:
        q = within_limits(q, chain.limits)
    return Pose(q, pose.root + step[:3])


def within_limits(q: Float[Array, "4 p c"], limits: Float[Array, "p 3 2"]) -> Float[Array, "4 p c"]:
    """Rotations whose rotation vector lies within `limits`; those that do are left as they are, bit for bit."""
    v = log(q)
    low, high = limits[..., 0].T[:, :, None], limits[..., 1].T[:, :, None]
    inside = ((v >= low) & (v <= high)).all(0)
    return jnp.where(inside, q, exp(jnp.clip(v, low, high)))


def parent_rotations(chain: Chain, world: World) -> Float[Array, "4 p"]:
    """World rotation of each joint's parent, of the single trial `world`."""
    last = jnp.asarray(world.shape[0] - 1, jnp.int32)
    return world[jnp.where(chain.parents < 0, last, chain.parents), :4, 0].T
