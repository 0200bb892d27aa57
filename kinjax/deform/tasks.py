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
from jaxtyping import Array, Float, Int

from ..numerics import safe_divide, safe_norm
from ..rotations import conjugate, cross, dot, log, multiply, rotate
from .chain import Chain, World

RADIAN = 0.25
"""Metres that an error of one radian counts for: the reach of a hand or a foot."""

POSITION, ORIENTATION, LOOK_AT, CENTER_OF_MASS = range(4)


class Tasks(NamedTuple):
    """B constraints of three rows each, sorted by layer, the most important first.

    kind: one of the four above. joint, reference: rows of the world array (its last is the world). point: metres in the
    joint's frame. look: unit vector in the joint's frame that a look-at turns to its target. scale: (B, 3) axes mask times
    the root of the weight. layer: (B,). recruits: (B, P) and root_recruited (B,): 1 where a joint may be used. above: (B, P)
    joints that move the point; beside: those that move its reference. centers: (D,) which constraints are on a centre of mass;
    mass_joint: (M,) the joints that carry the mass points; weights (D, M): theirs; carried (D, P, M): the same, of the points
    that joint P moves.
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

    point: Float[Array, "3 b c"]
    rotation: Float[Array, "4 b c"]
    reference_point: Float[Array, "3 b c"]
    reference: Float[Array, "4 b c"]
    masses: Float[Array, "3 m c"]


def look(tasks: Tasks, goals: Goals, world: World) -> Seen:
    """Points, rotations and reference frames of all constraints."""
    at, of = jnp.moveaxis(world[tasks.joint], 1, 0), jnp.moveaxis(world[tasks.reference], 1, 0)
    masses = _place(jnp.moveaxis(world[tasks.mass_joint], 1, 0), goals.mass_point)
    point = _place(at, tasks.point)
    if tasks.centers.size:
        center = jnp.einsum("dm,imc->idc", tasks.weights, masses, precision="highest")
        point = point.at[:, tasks.centers].set(center)
    return Seen(point, at[:4], of[4:], of[:4], masses)


def _place(world: Float[Array, "7 b c"], local: Float[Array, "b 3"]) -> Float[Array, "3 b c"]:
    return world[4:] + rotate(world[:4], jnp.broadcast_to(local.T[:, :, None], world[4:].shape))


def residuals(tasks: Tasks, goals: Goals, seen: Seen) -> Float[Array, "b 3 c"]:
    """What is left to do, in the frame of the reference (of the world, where there is none), scaled as the rows are."""
    back = conjugate(seen.reference)
    place = rotate(back, seen.point - seen.reference_point)
    rotation = multiply(back, seen.rotation)
    offset = goals.place.T[:, :, None] - place
    kind = tasks.kind[:, None]
    turn = RADIAN * log(multiply(jnp.broadcast_to(goals.rotation.T[:, :, None], rotation.shape), conjugate(rotation)))
    along = rotate(rotation, jnp.broadcast_to(tasks.look.T[:, :, None], offset.shape))
    error = jnp.where(kind == ORIENTATION, turn, offset)
    error = jnp.where(kind == LOOK_AT, RADIAN * _turn_between(along, offset), error)
    return jnp.moveaxis(error, 0, 1) * _scale(tasks, goals)[:, :, None]


def _scale(tasks: Tasks, goals: Goals) -> Float[Array, "b 3"]:
    return tasks.scale * goals.active[:, None]


def _turn_between(a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """(turn about u1, about u2, 0) that takes the unit vector `a` to the direction of `b`; `u1`, `u2` as in `_across`."""
    u1, u2 = _across(a)
    x, y, z = dot(u1, b), dot(u2, b), dot(a, b)
    side = safe_norm(jnp.stack([x, y]), axis=0)
    angle = jnp.arctan2(jnp.where((side == 0) & (z == 0), jnp.zeros_like(side), side), jnp.where((side == 0) & (z == 0), jnp.ones_like(z), z))
    # opposite directions: any axis across will do
    x = jnp.where((side == 0) & (z < 0), jnp.ones_like(x), x)
    factor = safe_divide(angle, jnp.where((side == 0) & (z < 0), jnp.ones_like(side), side))
    return jnp.stack([-factor * y, factor * x, jnp.zeros_like(x)])


def _across(a: Float[Array, "3 ..."]) -> tuple[Float[Array, "3 ..."], Float[Array, "3 ..."]]:
    """Two unit vectors that make a right-handed frame (u1, u2, a) (Duff et al. 2017)."""
    x, y, z = a
    sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
    p = -1 / (sign + z)
    q = x * y * p
    return (
        jnp.stack([1 + sign * x * x * p, sign * q, -sign * x]),
        jnp.stack([q, sign + y * y * p, -y]),
    )


def jacobian(chain: Chain, tasks: Tasks, goals: Goals, world: World, seen: Seen) -> Float[Array, "m n"]:
    """(3 B, 3 + 3 P): how the residuals go down with a step along world axes, of the single trial (C = 1) of `world`.

    Columns: root translation, then the turn of each joint. Exact for positions, centres of mass and look-at, and for turns
    where the residual is small (elsewhere it takes the shortest way round).
    """
    joints = world.shape[0] - 1
    p = world[:joints, 4:, 0]  # (P, 3)
    r, angular, rootward = _levers(chain, tasks, seen, p)
    directions, turns = _directions(tasks, goals, seen)  # each (3 rows, 3, B)
    scale = (_scale(tasks, goals)).T[:, None, :]
    directions, turns = directions * scale, turns * scale
    lever = jnp.moveaxis(r, -1, 0)[None]  # (1, 3, B, P)
    along = jnp.moveaxis(directions, 1, 0)[:, :, :, None]  # (3, rows, B, 1)
    lever = jnp.moveaxis(lever, 1, 0)  # (3, 1, B, P)
    columns = cross(lever, along) + jnp.moveaxis(turns, 1, 0)[:, :, :, None] * angular[None, None]
    columns = columns * tasks.recruits[None, None]  # (3, rows, B, P)
    root = directions * (rootward * tasks.root_recruited * goals.root_free)[None, None]  # (rows, 3, B)
    turning = jnp.transpose(columns, (2, 1, 3, 0)).reshape(3 * tasks.kind.shape[0], 3 * joints)
    return jnp.concatenate([jnp.transpose(root, (2, 0, 1)).reshape(-1, 3), turning], axis=1)


def _levers(chain, tasks, seen, p):
    """For each constraint and joint the arm on which the joint turns the point (B, P, 3), how much of its turn the body takes
    (B, P), and how much of the root's translation (B,)."""
    x = seen.point[:, :, 0].T
    arm = (tasks.above - tasks.beside)[:, :, None] * (x[:, None, :] - p[None])
    rootward = (tasks.reference == chain.parents.shape[0]).astype(x.dtype)
    if tasks.centers.size:
        carried = jnp.einsum("dpm,im->dpi", tasks.carried, seen.masses[:, :, 0], precision="highest")
        carried = carried - jnp.sum(tasks.carried, axis=-1)[:, :, None] * p[None]
        beside = tasks.beside[tasks.centers][:, :, None] * (x[tasks.centers][:, None, :] - p[None])
        arm = arm.at[tasks.centers].set(carried - beside)
        rootward = rootward.at[tasks.centers].multiply(jnp.sum(tasks.weights, axis=1))
    return arm, tasks.above - tasks.beside, rootward


def _directions(tasks, goals, seen):
    """A and B of each row, (3 rows, 3 components, B)."""
    frame = seen.reference[:, :, 0]
    axes = jnp.stack([rotate(frame, jnp.broadcast_to(e[:, None], frame[1:].shape)) for e in jnp.eye(3, dtype=frame.dtype)])
    zero = jnp.zeros_like(axes)
    kind = tasks.kind
    turns = jnp.where(kind == ORIENTATION, RADIAN * axes, zero)
    a = rotate(seen.rotation[:, :, 0], tasks.look.T)
    away = rotate(frame, goals.place.T) + seen.reference_point[:, :, 0] - seen.point[:, :, 0]
    # rows of a look-at are about u1 and u2, which follow the body in the reference's frame
    local = rotate(conjugate(frame), a)
    u = jnp.stack([*(rotate(frame, v) for v in _across(local)), jnp.zeros_like(a)])
    near = safe_divide(jnp.ones_like(away[0]), dot(away, away))
    d = away * near
    return (
        jnp.where(kind == LOOK_AT, RADIAN * jnp.stack([cross(v, d) for v in u]), jnp.where(kind == ORIENTATION, zero, axes)),
        jnp.where(kind == LOOK_AT, RADIAN * u, turns),
    )
