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

from ..rotations import exp, log, multiply, normalize

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
    # computed along the joints, which are many, and turned round for the loop over them: (P, 3, 4, C)
    turns = jnp.transpose(matrices(jnp.swapaxes(rotations, 1, 2)), (3, 0, 1, 2))
    local = jnp.concatenate([turns, place[:, :, None]], axis=2)
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


# the matrix of v x . is the sum of v_k times these
_SKEW = np.zeros((3, 3, 3))
for _k in range(3):
    _SKEW[_k, (_k + 2) % 3, (_k + 1) % 3], _SKEW[_k, (_k + 1) % 3, (_k + 2) % 3] = 1, -1


def matrices(q: Float[Array, "4 c p"]) -> Float[Array, "3 3 c p"]:
    """Rotation matrices `(w^2 - |v|^2) I + 2 (v v' + w [v x])` of unit quaternions, as one expression over whole arrays: their nine
    elements one by one would be nine branches in a loop."""
    shape = q.shape[1:]
    q = q.reshape(4, -1)
    w, v = q[0], q[1:]
    square = w * w - v[0] * v[0] - v[1] * v[1] - v[2] * v[2]
    eye = jnp.eye(3, dtype=q.dtype)[..., None]
    skew = jnp.asarray(_SKEW, q.dtype)[..., None]
    across = skew[0] * v[0] + skew[1] * v[1] + skew[2] * v[2]
    return (square * eye + 2 * (v[:, None] * v[None] + w * across)).reshape(3, 3, *shape)


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

    step: root translation, then for each joint a rotation vector, all along world axes.
    """
    turn = step[3:].reshape(parent.shape[0], 3, -1)
    return stepped(chain, pose, answers(pose, parent), step[:3], jnp.transpose(turn, (1, 2, 0)))


def answers(pose: Pose, parent: Float[Array, "p 3 3"]) -> Float[Array, "4 4 p"]:
    """The unit quaternion of each joint of one pose (C = 1), and how it begins to answer half a turn about each axis of the world:
    the axis, seen from the parent, times the quaternion. What is the same for all trials of a pose."""
    q = normalize(pose.rotations[:, :, 0])
    axes = jnp.moveaxis(parent, 0, 2)  # the rows of a parent's rotation are the world's axes in its frame
    return jnp.stack([q, *[multiply((jnp.zeros_like(q[0]), *axis), q) for axis in axes]])


def stepped(
    chain: Chain, pose: Pose, answer: Float[Array, "4 4 p"], root: Float[Array, "3 c"], turn: Float[Array, "3 c p"]
) -> Pose:
    """`moved`, from what `answers` gave and the steps of the root and, axis by axis, of the joints.

    A turn by `w` is made by Cayley's map, the quaternion along (1, w / 2): the exponential up to the third order, without its
    sines. Limits are kept by clamping the rotation vector of a joint's rotation.
    """
    x, y, z = turn / 2
    scale = 1 / jnp.sqrt(1 + x * x + y * y + z * z)
    q, *change = answer[:, :, None]
    q = (q + x * change[0] + y * change[1] + z * change[2]) * scale
    q = jnp.swapaxes(q, 1, 2)
    if chain.limits is not None:
        q = within_limits(q, chain.limits)
    return Pose(q, pose.root + root)


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
