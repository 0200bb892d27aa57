"""What holds at a solved frame, as equations: from them follow the derivatives of the pose that the solver found.

In: a frame's pose, what was asked of it, where it started. Out: `balance`, n numbers that are 0 where no layer can gain anything
with what the layers above leave it and the attraction cannot either: the conditions of the lexicographic optimum, one set a
layer. For layer `i`, with `r_i` its residuals and `J_i` its rows: `J_i' r_i` lies in the span of the rows above, and what
remains outside all rows of the attraction `z` (eq. 1 of the 2004 paper) is 0.

They are written with multipliers, `J_i' r_i - J_above' mu_i`, so that their derivative holds the curvature of the
constraints; the row basis, the multipliers and the inverses, which `prioritized` makes as in the solve, are `Factors` and
count as constant. The numbers are steps, in radians and metres along world axes: the derivative of `balance` by the pose is
minus the identity plus that curvature.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..numerics import safe_divide, safe_sqrt
from .chain import Chain, Pose, World, forward, moved, parent_rotations
from .frame_solver import Reference, attraction
from .prioritized import Basis, fading, inverse, row_basis, times
from .sequence import Frames, displaced
from .tasks import CENTER_OF_MASS, Kinds, Seen, Tasks, jacobian, look, residuals, stiffness, wrench

FAINT = 0.02
"""Directions in which a layer moves less than this share of its rows' root mean square length are held back: there the
derivative would grow without bound. Those that move five times as much are left as they are to within rounding."""


class Solved(NamedTuple):
    """A frame's place in the clip: its `pose`, and the pose and the input's pose of the frame `before` it (C = 1)."""

    pose: Pose
    last: Pose
    before: Pose


class Numbers(NamedTuple):
    """The solver's numbers that decide where it rests: `drag` and `singular` (`settings.Settings`), and whether joints and the
    root's translation are `attracted` to the input (0 or 1) or stay where the frame started."""

    drag: Float[Array, ""]
    singular: Float[Array, ""]
    attracted: tuple[Float[Array, ""], Float[Array, ""]]


class System(NamedTuple):
    """What the conditions of all frames of a clip share; `layers` and `kinds` are not data."""

    chain: Chain
    tasks: Tasks
    numbers: Numbers
    layers: int
    kinds: Kinds


class Factors(NamedTuple):
    """The constants of one frame's conditions.

    basis: of all rows. solve: (m, m) `(R_ii' R_ii + hold_i)^-1` in blocks of layers. hold: (m, m) what keeps a layer back:
    the drag of the lowest one, and along faint directions. dragged: (m, m) the drag's share of it. multipliers: (N + 1, m)
    those of each layer's conditions and, last, those of the attraction.
    """

    basis: Basis
    solve: Float[Array, "m m"]
    hold: Float[Array, "m m"]
    dragged: Float[Array, "m m"]
    multipliers: Float[Array, "layers1 m"]


def factors_of(system: System, frame: Frames, at: Solved) -> Factors:
    """The constants at a pose."""
    chain, tasks, numbers, layers, kinds = system
    world = forward(chain, at.pose, frame.offsets)
    seen = look(tasks, frame.goals, world)
    r = residuals(tasks, frame.goals, seen, kinds).reshape(-1)
    jac = jacobian(chain, tasks, frame.goals, world, seen, kinds)
    parent = parent_rotations(chain, world)
    pull = _pull(frame, at.pose, parent, numbers) + from_start(frame, at, parent, numbers)[0]
    basis = row_basis(jac)
    rows = jnp.repeat(tasks.layer, 3)
    same = (rows[:, None] == rows[None, :]).astype(jac.dtype)
    own = basis.factors * same
    normal = times(own.T, own)
    square = jnp.sum(jac * jac, axis=1)
    counted = times(same, (square > 0).astype(jac.dtype))
    size2 = safe_divide(times(same, square), counted)
    size2 = jnp.where(size2 > 0, size2, jnp.ones_like(size2))
    held = (rows == _lowest(tasks, frame)) & (jnp.repeat(tasks.kind, 3) != CENTER_OF_MASS)
    strength = jnp.where(held, numbers.drag * frame.dragged, jnp.zeros_like(size2))
    dragged = fading(normal, numbers.singular**2 * size2, strength)
    hold = dragged + fading(normal, FAINT**2 * size2, FAINT * safe_sqrt(size2))
    empty = (jnp.sum(basis.rows**2, axis=1) < 0.5).astype(jac.dtype)  # a row that adds no direction
    solve = inverse(normal + hold + jnp.diag(empty * size2))
    goals = r[:, None] * _members(rows, layers, r.dtype)
    sought = jnp.concatenate([times(basis.factors.T, goals), times(basis.rows, pull)[:, None]], axis=1)
    above = rows[:, None] < jnp.arange(layers + 1, dtype=jnp.int32)[None, :]
    return Factors(basis, solve, hold, dragged, _multipliers(basis.factors, jnp.where(above, sought, 0), jac).T)


def balance(system: System, frame: Frames, at: Solved, factors: Factors) -> Float[Array, " n"]:
    """The conditions: 0 at a pose where nothing can be gained, else about the step that is missing."""
    world = forward(system.chain, at.pose, frame.offsets)
    own = _balance(system, frame, at.pose, world, factors)
    return own + of_start(factors, *from_start(frame, at, parent_rotations(system.chain, world), system.numbers))


def _balance(system: System, frame: Frames, pose: Pose, world: World, factors: Factors) -> Float[Array, " n"]:
    """The part of the conditions that does not look at the frame before."""
    chain, tasks, numbers, layers, kinds = system
    seen = look(tasks, frame.goals, world)
    q = factors.basis.rows
    load, member = _loads(system, frame, seen, factors)
    gains = wrench(chain, tasks, frame.goals, world, seen, kinds, load)  # (n, N + 1)
    own = jnp.sum(times(q, gains[:, :layers]) * member, axis=1)
    free = _pull(frame, pose, parent_rotations(chain, world), numbers) + gains[:, layers]
    return times(q.T, times(factors.solve, own) - times(q, free)) + free


def _loads(
    system: System, frame: Frames, seen: Seen, factors: Factors
) -> tuple[Float[Array, "m layers1"], Float[Array, "m layers"]]:
    """What each layer's conditions, and last the attraction's, load the rows with: its own residuals, less the multipliers of those
    above. And 1 where a row is of a layer."""
    r = residuals(system.tasks, frame.goals, seen, system.kinds).reshape(-1, 1)
    member = _members(jnp.repeat(system.tasks.layer, 3), system.layers, r.dtype)
    return jnp.concatenate([r * member, jnp.zeros_like(r)], axis=1) - factors.multipliers.T, member


def _pull(frame: Frames, pose: Pose, parent: Float[Array, "p 3 3"], numbers: Numbers) -> Float[Array, " n"]:
    """The attraction to the input."""
    stays, stays_root = _staying(frame, numbers)
    return attraction(Reference(frame.rotations, frame.root, 1 - stays, 1 - stays_root), pose, parent)


def from_start(
    frame: Frames, at: Solved, parent: Float[Array, "p 3 3"], numbers: Numbers
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """All that depends on the frame before: the way back to the start of what is not attracted to the input, and the way that
    everything has come from it. A joint's depend on that joint alone."""
    own = Pose(frame.rotations[..., None], frame.root[:, None])
    turning = frame.controlled * frame.warm
    sliding = frame.root_controlled * frame.warm * frame.goals.root_free
    start = displaced(own, at.last, at.before, turning, sliding)
    ones = jnp.ones_like(frame.controlled), jnp.ones_like(frame.root_controlled)
    back = attraction(Reference(start.rotations[..., 0], start.root[:, 0], *ones), at.pose, parent)
    stays, stays_root = _staying(frame, numbers)
    return back * jnp.concatenate([jnp.repeat(stays_root, 3), jnp.repeat(stays, 3)]), -back


def of_start(factors: Factors, back: Float[Array, " n"], travel: Float[Array, " n"]) -> Float[Array, " n"]:
    """What both do to the conditions: linear in them."""
    q = factors.basis.rows
    held = times(factors.solve, times(factors.dragged, times(q, travel)))
    return back - times(q.T, times(q, back) + held)


def derivative(system: System, frame: Frames, at: Solved, factors: Factors) -> Float[Array, "n n"]:
    """How `balance` changes with a step of the pose, along world axes; along faint directions it counts as if they moved.

    In closed form where all constraints are in the world and none is a look-at, else by `jacfwd`.
    """
    form = _by_jacfwd if system.kinds.relative or system.kinds.looks else _in_closed_form
    change = form(system, frame, at, factors)
    q = factors.basis.rows
    held = jnp.matmul(times(factors.solve, factors.hold - factors.dragged), q, precision="highest")
    return change - jnp.matmul(q.T, held, precision="highest")


def _by_jacfwd(system: System, frame: Frames, at: Solved, factors: Factors) -> Float[Array, "n n"]:
    chain = system.chain
    world = forward(chain, at.pose, frame.offsets)
    parent = parent_rotations(chain, world)
    free = chain._replace(limits=None)

    def after(step: Float[Array, " n"]) -> Float[Array, " n"]:
        pose = moved(free, at.pose, parent, step[:, None])
        there = nearby(chain, world, step)
        own = _balance(system, frame, pose, there, factors)
        past = from_start(frame, at._replace(pose=pose), parent_rotations(chain, there), system.numbers)
        return own + of_start(factors, *past)

    return jax.jacfwd(after)(jnp.zeros(3 + 3 * parent.shape[0], parent.dtype))


def _in_closed_form(system: System, frame: Frames, at: Solved, factors: Factors) -> Float[Array, "n n"]:
    chain, tasks, numbers, layers, kinds = system
    world = forward(chain, at.pose, frame.offsets)
    parent = parent_rotations(chain, world)
    seen = look(tasks, frame.goals, world)
    rows = jnp.repeat(tasks.layer, 3)
    q, factors_r = factors.basis
    load, member = _loads(system, frame, seen, factors)
    bent = stiffness(chain, tasks, frame.goals, world, seen, kinds, load)  # (N + 1, n, n)
    # residuals change with every joint that moves them, recruited or not
    all_joints = tasks._replace(
        recruits=jnp.ones_like(tasks.recruits), root_recruited=jnp.ones_like(tasks.root_recruited)
    )
    free_goals = frame.goals._replace(root_free=jnp.ones_like(frame.goals.root_free))
    every = jacobian(chain, all_joints, free_goals, world, seen, kinds)
    same = (rows[:, None] == rows[None, :]).astype(load.dtype)
    curved = jnp.einsum("mn,ml,lnk->mk", q, member, bent[:layers], precision="highest")
    own = curved - jnp.matmul((factors_r * same).T, every, precision="highest")
    stays, stays_root = _staying(frame, numbers)
    reference = Reference(frame.rotations, frame.root, jnp.ones_like(stays), jnp.ones_like(stays_root))
    ways = attraction(reference, at.pose, parent), -from_start(frame, at, parent, numbers)[1]
    pulls = [_attraction_change(chain, z) for z in ways]
    mixed = jnp.concatenate([jnp.repeat(stays_root, 3), jnp.repeat(stays, 3)])[:, None]
    free = (1 - mixed) * pulls[0] + mixed * pulls[1] + bent[layers]
    travelled = jnp.matmul(factors.dragged, jnp.matmul(q, pulls[1], precision="highest"), precision="highest")
    inner = jnp.matmul(factors.solve, own + travelled, precision="highest") - jnp.matmul(q, free, precision="highest")
    return free + jnp.matmul(q.T, inner, precision="highest")


def _attraction_change(chain: Chain, z: Float[Array, " n"]) -> Float[Array, "n n"]:
    """How the attraction `z` to a fixed pose changes with a step: the root's by minus the step, a joint's by minus the inverse of
    the right Jacobian of its rotation vector, and it is carried along by the joints above."""
    v = z[3:].reshape(-1, 3)
    joints = v.shape[0]
    angle2 = jnp.sum(v * v, axis=1)
    small = angle2 < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1, angle2))
    series = jnp.asarray(1 / 12, z.dtype) + angle2 / 720
    c = jnp.where(small, series, (1 - angle / 2 / jnp.tan(angle / 2)) / jnp.where(small, 1, angle2))
    eye = jnp.eye(3, dtype=z.dtype)
    hat = jnp.stack([jnp.cross(jnp.broadcast_to(e, v.shape), v) for e in eye], axis=2)  # t -> t x v, that is -[v]x
    square = v[:, :, None] * v[:, None, :] - angle2[:, None, None] * eye
    own = -(eye - hat / 2 + c[:, None, None] * square)
    strict = chain.above - jnp.eye(joints, dtype=z.dtype)
    turned = (
        strict[:, None, :, None] * hat[:, :, None, :]
        + jnp.eye(joints, dtype=z.dtype)[:, None, :, None] * own[:, :, None]
    )
    n = 3 * joints
    out = jnp.zeros((3 + n, 3 + n), z.dtype).at[:3, :3].set(-eye)
    return out.at[3:, 3:].set(turned.reshape(n, n))


def nearby(chain: Chain, world: World, step: Float[Array, " n"]) -> World:
    """World transforms after a step so small that its square does not count: what `forward` has for a derivative, without the
    recursion."""
    joints = world.shape[0] - 1
    turn = step[3:].reshape(joints, 3)
    place = world[:joints, :, 3, 0]
    turned = jnp.sum(chain.above[:, :, None] * turn[None], axis=1)
    slid = jnp.sum(chain.above[:, :, None] * jnp.cross(turn, place)[None], axis=1)
    shift = jnp.cross(turned, place) - slid + step[:3]
    change = jnp.concatenate(
        [jnp.cross(turned[:, None], jnp.swapaxes(world[:joints, :, :3, 0], 1, 2)).swapaxes(1, 2), shift[:, :, None]],
        axis=2,
    )
    return world.at[:joints, :, :, 0].add(change)


def _staying(frame: Frames, numbers: Numbers) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Joints, and whether the root's place, that stay where the frame started: controlled and not attracted to the input. What is
    not controlled is the input's."""
    return (
        (1 - numbers.attracted[0]) * frame.controlled,
        (1 - numbers.attracted[1]) * frame.root_controlled,
    )


def _members(rows: Int[Array, " m"], layers: int, dtype: jnp.dtype) -> Float[Array, "m layers"]:
    """1 where a row is of a layer."""
    return (rows[:, None] == jnp.arange(layers, dtype=jnp.int32)).astype(dtype)


def _lowest(tasks: Tasks, frame: Frames) -> Int[Array, ""]:
    """The last layer of which something is asked in this frame."""
    return jnp.max(jnp.where(frame.goals.active > 0, tasks.layer, -1))


def _multipliers(r: Float[Array, "m m"], sought: Float[Array, "m k"], jac: Float[Array, "m n"]) -> Float[Array, "m k"]:
    """`mu` with `J' mu = Q' sought`, that is `R' mu = sought`, from the last row up; rows of which little is left over by those above them
    bear no more than rounding allows."""
    length = safe_sqrt(jnp.sum(jac * jac, axis=1))
    least = (1e-6 if jac.dtype == jnp.float64 else 1e-3) * jnp.where(length > 0, length, jnp.ones_like(length))
    pivot = jnp.diagonal(r)
    inverse_pivot = pivot / (pivot * pivot + least * least)
    m = r.shape[0]

    def row(i: Int[Array, ""], mu: Float[Array, "m k"]) -> Float[Array, "m k"]:
        k = m - 1 - i
        column = jax.lax.dynamic_index_in_dim(r, k, 1, keepdims=False)  # R'[k, :]
        rest = sought[k] - times(column[None], mu)[0]
        return mu.at[k].set(rest * inverse_pivot[k])

    return jax.lax.fori_loop(0, m, row, jnp.zeros_like(sought))
