"""The part of the skeleton that a deformation moves: forward kinematics of many trial poses of one frame.

In: local rotations and root places, one trial a lane. Out: world transforms, from which the rows of `tasks` are made. Only
the joints that lie between the root and something constrained are here, in their order; the others follow the input.
Arrays keep trials last, so that every operation runs over all trials at once. Rotations are quaternions where they are
kept and composed, matrices where they act: a product of matrices is a fifth of the instructions to compile.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..rotations import exp, log, matrix, normalize

World = Float[Array, "p1 3 4 c"]
"""[R | t] of each joint in the world, and of the world itself in the last row; trials last."""


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
    top = (chain.parents < 0)[:, None, None]
    place = jnp.where(top, root[None], offsets[:, :, None])
    local = jnp.concatenate([jnp.moveaxis(matrix(rotations), 2, 0), place[:, :, None]], axis=2)  # (P, 3, 4, C)
    still = jnp.broadcast_to(jnp.eye(3, 4, dtype=rotations.dtype)[:, :, None], (3, 4, trials))
    world = jnp.concatenate([jnp.zeros((joints, 3, 4, trials), rotations.dtype), still[None]])
    # adds a row's own place to that of its parent: [R | t] [Q | s] = [R Q | R s + t]
    last = jnp.asarray(np.eye(4)[3], rotations.dtype)[None, :, None]
    xs = (
        jnp.arange(joints, dtype=jnp.int32),
        jnp.where(chain.parents < 0, jnp.asarray(joints, jnp.int32), chain.parents),
        local,
    )

    def step(world: World, x: tuple[Array, ...]) -> tuple[World, None]:
        j, parent, own = x
        up = jax.lax.dynamic_index_in_dim(world, parent, 0, keepdims=False)
        here = times(up[:, :3], own) + up[:, 3:] * last
        return jax.lax.dynamic_update_index_in_dim(world, here, j, 0), None

    return jax.lax.scan(step, world, xs)[0]


def times(a: Float[Array, "... i j c"], b: Float[Array, "... j k c"]) -> Float[Array, "... i k c"]:
    """Products of small matrices, trial by trial, as one multiplication and one sum."""
    return jnp.sum(a[..., :, :, None, :] * b[..., None, :, :, :], axis=-3)


def act(r: Float[Array, "... i j #c"], v: Float[Array, "... j #c"]) -> Float[Array, "... i c"]:
    """Small matrices times vectors, trial by trial."""
    return jnp.sum(r * v[..., None, :, :], axis=-2)


# the Hamilton product a b is L(a) b, with L(a) made of a's components and signs
_PLACES = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]], np.int32)
_SIGNS = np.array([[1, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]], float)
_INVERSE = np.array([1.0, -1, -1, -1])


def compose(a: Float[Array, "4 ..."], b: Float[Array, "4 ..."]) -> Float[Array, "4 ..."]:
    """Hamilton product: first `b`, then `a`; few instructions, for programs that are compiled often."""
    signs = jnp.asarray(_SIGNS, a.dtype).reshape(4, 4, *[1] * (a.ndim - 1))
    return jnp.sum(a[_PLACES] * signs * b[None], axis=1)


def inverse_of(q: Float[Array, "4 ..."]) -> Float[Array, "4 ..."]:
    """Inverse rotation."""
    return q * jnp.asarray(_INVERSE, q.dtype).reshape(4, *[1] * (q.ndim - 1))


def moved(chain: Chain, pose: Pose, parent: Float[Array, "p 3 3"], step: Float[Array, "n c"]) -> Pose:
    """The trials that `step` makes of the one pose (C = 1) whose joints' parents have world rotations `parent`.

    step: root translation, then for each joint a rotation vector, all along world axes. A turn by `w` is made by Cayley's map,
    the quaternion along (1, w / 2): the exponential up to the third order, without its sines. Limits are kept by clamping
    the rotation vector of a joint's rotation.
    """
    joints = parent.shape[0]
    turn = step[3:].reshape(joints, 3, -1)
    local = jnp.sum(
        parent[:, :, :, None] * turn[:, :, None, :], axis=1
    )  # R_parent^T w: the same turn seen from the parent
    turn = jnp.concatenate([jnp.ones_like(local[:, :1]), local / 2], axis=1)
    q = normalize(compose(jnp.moveaxis(turn, 1, 0), pose.rotations))
    if chain.limits is not None:
        q = within_limits(q, chain.limits)
    return Pose(q, pose.root + step[:3])


def within_limits(q: Float[Array, "4 p c"], limits: Float[Array, "p 3 2"]) -> Float[Array, "4 p c"]:
    """Rotations whose rotation vector lies within `limits`; those that do are left as they are, bit for bit."""
    v = log(q)
    low, high = limits[..., 0].T[:, :, None], limits[..., 1].T[:, :, None]
    inside = ((v >= low) & (v <= high)).all(0)
    return jnp.where(inside, q, exp(jnp.clip(v, low, high)))


def parent_rotations(chain: Chain, world: World) -> Float[Array, "p 3 3"]:
    """World rotation of each joint's parent, of the single trial `world`."""
    last = jnp.asarray(world.shape[0] - 1, jnp.int32)
    return world[jnp.where(chain.parents < 0, last, chain.parents), :, :3, 0]
