"""What is asked of a frame: residuals of all constraints for many trial poses, and their Jacobian at one of them.

In: `Tasks` (what does not change over a clip) and `Goals` (one frame of what does). Out: three rows a constraint, in order of
priority. Every kind of constraint is one formula: a row asks for `A v + B w`, with `v` and `w` the velocity and angular
velocity of the constrained point, less those of the frame that it is relative to. With turns along world axes a joint at
`p_j` gives the point `x` the velocity `w_j x (x - p_j)`, so its columns are `(x - p_j) x A + B`; the centre of mass has its
subtree's in place of `x - p_j` (inverse kinetics, 2004 paper, section 4.3).

Residuals are in metres; turns count `RADIAN` metres a radian, so that one layer can hold both.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..numerics import safe_divide, safe_sqrt
from ..rotations import log
from .chain import Chain, World, act, compose, inverse_of, times

RADIAN = 0.25
"""Metres that an error of one radian counts for: the reach of a hand or a foot."""

POSITION, ORIENTATION, LOOK_AT, CENTER_OF_MASS = range(4)


class Kinds(NamedTuple):
    """What a program has to be able to do (static; what is not asked for is not compiled): orientations, look-at, and frames of
    reference other than the world."""

    turns: bool = False
    looks: bool = False
    relative: bool = False


class Tasks(NamedTuple):
    """B constraints of three rows each, sorted by layer, the most important first.

    kind: one of the four above. joint, reference: rows of the world array (its last is the world). point: metres in the
    joint's frame. look: unit vector in the joint's frame that a look-at turns to its target. scale: (B, 3) axes mask times
    the root of the weight. layer: (B,). recruits: (B, P) and root_recruited (B,): 1 where a joint may be used. above: (B, P)
    joints that move the point; beside: those that move its reference. centers: (D,) which constraints are on a centre of mass;
    mass_joint: (M,) the rows of the world array that carry the mass points; weights (D, M): theirs; carried (D, P, M): the same,
    of the points that joint P moves.
    """

    kind: Int[Array, " b"]
    joint: Int[Array, " b"]
    reference: Int[Array, " b"]
    point: Float[Array, "b 3"]
    look: Float[Array, "b 3"]
    scale: Float[Array, "b 3"]
    layer: Int[Array, " b"]
    recruits: Float[Array, "b p"]
    root_recruited: Float[Array, " b"]
    above: Float[Array, "b p"]
    beside: Float[Array, "b p"]
    centers: Int[Array, " d"]
    mass_joint: Int[Array, " m"]
    weights: Float[Array, "d m"]
    carried: Float[Array, "d p m"]


class Goals(NamedTuple):
    """One frame's targets: place (B, 3), rotation (B, 4) and whether each constraint is active (B,), as 0 or 1; mass_point
    (M, 3): where the mass points are in their joints' frames; root_free: 0 where the root's translation is held."""

    place: Float[Array, "b 3"]
    rotation: Float[Array, "b 4"]
    active: Float[Array, " b"]
    mass_point: Float[Array, "m 3"]
    root_free: Float[Array, ""]


class Seen(NamedTuple):
    """Where the constrained things of C trials are: what residuals and Jacobian both start from."""

    point: Float[Array, "b 3 c"]
    rotation: Float[Array, "b 3 3 c"]
    reference_point: Float[Array, "b 3 c"]
    reference: Float[Array, "b 3 3 c"]
    masses: Float[Array, "m 3 c"]


def look(tasks: Tasks, goals: Goals, world: World) -> Seen:
    """Points, rotations and reference frames of all constraints."""
    at, of = world[tasks.joint], world[tasks.reference]
    point = _place(at, tasks.point)
    masses = _place(world[tasks.mass_joint], goals.mass_point)
    if tasks.centers.size:
        point = point.at[tasks.centers].set(jnp.einsum("dm,mic->dic", tasks.weights, masses, precision="highest"))
    return Seen(point, at[:, :, :3], of[:, :, 3], of[:, :, :3], masses)


def _place(world: Float[Array, "b 3 4 c"], local: Float[Array, "b 3"]) -> Float[Array, "b 3 c"]:
    return world[:, :, 3] + act(world[:, :, :3], local[:, :, None])


def residuals(tasks: Tasks, goals: Goals, seen: Seen, kinds: Kinds) -> Float[Array, "b 3 c"]:
    """What is left to do, in the frame of the reference (of the world, where there is none), scaled as the rows are."""
    kind = tasks.kind[:, None, None]
    back = jnp.swapaxes(seen.reference, 1, 2)
    place = seen.point
    if kinds.relative:
        place = act(back, place - seen.reference_point)
    error = goals.place[:, :, None] - place
    if kinds.looks:
        along = act(seen.rotation, tasks.look[:, :, None])
        along = act(back, along) if kinds.relative else along
        error = jnp.where(kind == LOOK_AT, RADIAN * _turn_between(along, error), error)
    if kinds.turns:
        own = quaternion(times(back, seen.rotation) if kinds.relative else seen.rotation)
        turn = RADIAN * log(compose(jnp.broadcast_to(goals.rotation.T[:, :, None], own.shape), inverse_of(own)))
        error = jnp.where(kind == ORIENTATION, jnp.moveaxis(turn, 0, 1), error)
    return error * _scale(tasks, goals)[:, :, None]


def _scale(tasks: Tasks, goals: Goals) -> Float[Array, "b 3"]:
    return tasks.scale * goals.active[:, None]


def quaternion(r: Float[Array, "b 3 3 c"]) -> Float[Array, "4 b c"]:
    """Quaternions of rotation matrices: the row of `4 q q'` with the largest diagonal, so that no angle is special."""
    x, y, z = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    size = (1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z)
    pairs = ((2, 1), (0, 2), (1, 0))
    a, b, c = (r[:, i, j] - r[:, j, i] for i, j in pairs)  # 4 w x, 4 w y, 4 w z
    d, e, f = (r[:, i, j] + r[:, j, i] for i, j in pairs)  # 4 y z, 4 z x, 4 x y
    best = jnp.argmax(jnp.stack(size), axis=0)
    rows = ((size[0], a, b, c), (a, size[1], f, e), (b, f, size[2], d), (c, e, d, size[3]))
    q = [jnp.where(best == 0, w, jnp.where(best == 1, x, jnp.where(best == 2, y, z))) for w, x, y, z in zip(*rows, strict=True)]
    return jnp.stack(q) / jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


def _turn_between(a: Float[Array, "b 3 c"], d: Float[Array, "b 3 c"]) -> Float[Array, "b 3 c"]:
    """(turn about u1, about u2, 0) that takes the unit vector `a` to the direction of `d`; `u1`, `u2` as in `_across`."""
    frame = jnp.concatenate([_across(a), a[:, None]], axis=1)  # (B, 3, 3, C)
    x, y, z = jnp.moveaxis(act(frame, d), 1, 0)
    side = safe_sqrt(x * x + y * y)
    one = jnp.ones_like(x)
    nowhere, opposite = (side == 0) & (z == 0), (side == 0) & (z < 0)
    angle = jnp.arctan2(jnp.where(nowhere, 0 * one, side), jnp.where(nowhere, one, z))
    x = jnp.where(opposite, one, x)  # opposite directions: any axis across will do
    factor = safe_divide(angle, jnp.where(opposite, one, side))
    return jnp.stack([-factor * y, factor * x, 0 * x], axis=1)


def _across(a: Float[Array, "b 3 ..."]) -> Float[Array, "b 2 3 ..."]:
    """Two unit vectors that make a right-handed frame (u1, u2, a) (Duff et al. 2017)."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
    p = -1 / (sign + z)
    q = x * y * p
    u1 = jnp.stack([1 + sign * x * x * p, sign * q, -sign * x], axis=1)
    return jnp.stack([u1, jnp.stack([q, sign + y * y * p, -y], axis=1)], axis=1)


_CROSS = np.zeros((3, 3, 3))  # (a x b)_i = sum_jk _CROSS[i, j, k] a_j b_k
for _i in range(3):
    _CROSS[_i, (_i + 1) % 3, (_i + 2) % 3], _CROSS[_i, (_i + 2) % 3, (_i + 1) % 3] = 1, -1


def jacobian(chain: Chain, tasks: Tasks, goals: Goals, world: World, seen: Seen, kinds: Kinds) -> Float[Array, "m n"]:
    """(3 B, 3 + 3 P): how the residuals go down with a step along world axes, of the single trial (C = 1) of `world`.

    Columns: root translation, then the turn of each joint. Exact for positions and centres of mass, and for turns and
    look-at where the residual is small (elsewhere they take the shortest way round).
    """
    joints = world.shape[0] - 1
    rows = 3 * tasks.kind.shape[0]
    arm, body, rootward = levers(chain, tasks, seen, world[:joints, :, 3, 0])
    directions, turns = _directions(tasks, goals, seen, kinds)  # A and B, (B, 3 rows, 3)
    scale = _scale(tasks, goals)[:, :, None]
    directions = directions * scale
    # (arm x A)_i = sum_j arm_j skew_ji
    skew = jnp.sum(
        jnp.asarray(_CROSS, arm.dtype).swapaxes(0, 1) * directions[:, :, None, None, :], axis=-1
    )  # (B, 3, j, i)
    columns = jnp.sum(arm[:, None, :, :, None] * skew[:, :, None], axis=-2)  # (B, 3, P, i)
    if turns is not None:
        columns = columns + (turns * scale)[:, :, None, :] * body[:, None, :, None]
    columns = columns * tasks.recruits[:, None, :, None]
    root = directions * (rootward * tasks.root_recruited * goals.root_free)[:, None, None]
    # the root first, as if it were one more joint: rows of one shape can be laid side by side without index arithmetic
    return jnp.concatenate([root[:, :, None], columns], axis=2).reshape(rows, 3 + 3 * joints)


def wrench(
    chain: Chain, tasks: Tasks, goals: Goals, world: World, seen: Seen, kinds: Kinds, load: Float[Array, "m k"]
) -> Float[Array, "n k"]:
    """`J' load` for several loads on the rows, without the Jacobian `J`: forces at the points, and their moments about the joints."""
    joints = world.shape[0] - 1
    arm, body, rootward = levers(chain, tasks, seen, world[:joints, :, 3, 0])
    directions, turns = _directions(tasks, goals, seen, kinds)
    load = load.reshape(-1, 3, load.shape[-1]) * _scale(tasks, goals)[:, :, None]

    def at_points(axes: Float[Array, "b 3 3"]) -> Float[Array, "b 3 k"]:
        return jnp.sum(axes[:, :, :, None] * load[:, :, None, :], axis=1)

    force = at_points(directions)
    used = tasks.recruits[:, :, None, None]
    x, y, z = (arm[:, :, i, None] for i in range(3))
    fx, fy, fz = (force[:, None, i] for i in range(3))
    moment = jnp.stack([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx], axis=2)  # (B, P, 3, K)
    if turns is not None:
        moment = moment + body[:, :, None, None] * at_points(turns)[:, None]
    root = force * (rootward * tasks.root_recruited * goals.root_free)[:, None, None]
    return jnp.concatenate([jnp.sum(root, axis=0), jnp.sum(moment * used, axis=0).reshape(3 * joints, -1)])


def stiffness(
    chain: Chain, tasks: Tasks, goals: Goals, world: World, seen: Seen, kinds: Kinds, load: Float[Array, "m k"]
) -> Float[Array, "k n n"]:
    """How `wrench` changes with a step of the pose, the loads being fixed: the curvature of the constraints.

    For constraints in the world, no look-at: a point's force `f` stays as it is, and an arm turns with whichever of two joints is
    deeper, `d/dw_k (arm_j x f) = [f]x [arm_deeper]x = arm f' - (arm . f) I`.
    """
    joints = world.shape[0] - 1
    arm, _, _ = levers(chain, tasks, seen, world[:joints, :, 3, 0])
    directions, _ = _directions(tasks, goals, seen, kinds)
    load = load.reshape(-1, 3, load.shape[-1]) * _scale(tasks, goals)[:, :, None]
    force = jnp.einsum("bri,brk->bki", directions, load, precision="highest")
    along = jnp.einsum("bpi,bki->bkp", arm, force, precision="highest")
    eye = jnp.eye(3, dtype=arm.dtype)
    own = jnp.einsum("bj,bji,bkl->kjil", tasks.recruits, arm, force, precision="highest")
    own = own - jnp.einsum("bj,bkj->kj", tasks.recruits, along, precision="highest")[..., None, None] * eye
    below = jnp.einsum("bj,bpi,bkl->kjipl", tasks.recruits, arm, force, precision="highest")
    below = below - (
        jnp.einsum("bj,bkp->kjp", tasks.recruits, along, precision="highest")[:, :, None, :, None]
        * eye[None, None, :, None, :]
    )
    strict = chain.above - jnp.eye(joints, dtype=arm.dtype)
    turned = chain.above[None, :, None, :, None] * own[:, :, :, None] + strict.T[None, :, None, :, None] * below
    n = 3 * joints
    return jnp.zeros((load.shape[-1], 3 + n, 3 + n), arm.dtype).at[:, 3:, 3:].set(turned.reshape(-1, n, n))


def levers(
    chain: Chain, tasks: Tasks, seen: Seen, p: Float[Array, "p 3"]
) -> tuple[Float[Array, "b p 3"], Float[Array, "b p"], Float[Array, " b"]]:
    """For each constraint and joint the arm on which the joint turns the point, how much of its turn the body takes, and how
    much of the root's translation the point takes."""
    x = seen.point[:, :, 0]
    moves = tasks.above - tasks.beside
    arm = moves[:, :, None] * (x[:, None, :] - p[None])
    rootward = (tasks.reference == chain.parents.shape[0]).astype(x.dtype)
    if tasks.centers.size:
        carried = jnp.einsum("dpm,mi->dpi", tasks.carried, seen.masses[:, :, 0], precision="highest")
        carried = carried - jnp.sum(tasks.carried, axis=-1)[:, :, None] * p[None]
        beside = tasks.beside[tasks.centers][:, :, None] * (x[tasks.centers][:, None, :] - p[None])
        arm = arm.at[tasks.centers].set(carried - beside)
        # the root moves what its turn moves
        rootward = rootward.at[tasks.centers].multiply(jnp.sum(tasks.carried[:, 0], axis=1), unique_indices=True)
    return arm, moves, rootward


def _directions(
    tasks: Tasks, goals: Goals, seen: Seen, kinds: Kinds
) -> tuple[Float[Array, "b 3 3"], Float[Array, "b 3 3"] | None]:
    """A and B of each row: what a row sees of the point's velocity and of the body's turn, in world axes."""
    frame = seen.reference[:, :, :, 0]
    axes = jnp.swapaxes(frame, 1, 2)  # the reference's axes, one a row
    if not (kinds.turns or kinds.looks):
        return axes, None
    kind = tasks.kind[:, None, None]
    zero = jnp.zeros_like(axes)
    along = jnp.where(kind == ORIENTATION, zero, axes)
    turns = jnp.where(kind == ORIENTATION, RADIAN * axes, zero)
    if kinds.looks:
        a = jnp.sum(seen.rotation[:, :, :, 0] * tasks.look[:, None, :], axis=-1)
        local = jnp.sum(axes * a[:, None, :], axis=-1)
        # rows are about u1 and u2, chosen in the reference's frame as the residual's are
        u = jnp.concatenate([_across(local), jnp.zeros_like(local)[:, None]], axis=1)
        u = jnp.sum(frame[:, None] * u[:, :, None, :], axis=-1)
        away = jnp.sum(frame * goals.place[:, None, :], axis=-1) + seen.reference_point[:, :, 0] - seen.point[:, :, 0]
        d = away * safe_divide(jnp.ones_like(away[:, 0]), jnp.sum(away * away, axis=-1))[:, None]
        along = jnp.where(kind == LOOK_AT, RADIAN * jnp.cross(u, d[:, None, :]), along)
        turns = jnp.where(kind == LOOK_AT, RADIAN * u, turns)
    return along, turns
