"""Derivatives of a solved clip, forward and reverse, from the conditions that its frames fulfil; no iteration is stored.

In: what was solved, and the solution. Out: the same poses, with a rule of differentiation: each frame's pose moves such that
`conditions.balance` stays 0. Memory grows with frames, not with frames times iterations. `chained`: where a frame starts
from the one before it (joints that are not attracted to the input, limbs held back as they straighten), its derivative goes
on through the clip; else every frame's start counts as constant.

Frames that were not solved are the input's, and so are their derivatives; what is not finite has the derivative 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..errors import OptionError
from .chain import Chain, Pose, forward, moved, parent_rotations
from .conditions import Factors, Numbers, Solved, System, balance, derivative, factors_of, from_start, of_start
from .sequence import Carried, Frames
from .tasks import Kinds, Tasks

TOGETHER = 16
"""Frames that are differentiated at once."""


class Asked(NamedTuple):
    """What a clip's poses follow from: everything that the derivatives are taken by (`sequence.solve_sequence`)."""

    chain: Chain
    tasks: Tasks
    frames: Frames
    first: Carried


class Static(NamedTuple):
    """What a program depends on."""

    layers: int
    kinds: Kinds
    chained: bool


class Poses(NamedTuple):
    """Solved poses of F frames: local rotations (F, 4, P), root (F, 3)."""

    rotations: Float[Array, "f 4 p"]
    root: Float[Array, "f 3"]


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def attach(asked: Asked, numbers: Numbers, found: tuple[Poses, Bool[Array, " f"]], static: Static) -> Poses:
    """The poses `found`, with their derivatives by `asked`. found: poses, and which frames the solver is sound in. What is in
    `found` and in `numbers` counts as constant."""
    return found[0]


@attach.defjvp
def _attached(static: Static, primals: Any, tangents: Any) -> tuple[Poses, Poses]:
    asked, numbers, (poses, sound) = once(primals)
    places, known = _places(asked, poses, sound)
    change = _finite_change(tangents[0], asked, sound & known)
    asked = _finite(asked, sound & known)
    system = _system(asked, numbers, static)
    factors, response = _each(partial(_frame, system), asked.frames, places)

    def moves(frame: Frames, at: Solved, factors: Factors, by: Any) -> Float[Array, " n"]:
        """How the conditions move with everything but the pose itself and the pose before."""

        def all_of(chain: Chain, tasks: Tasks, frame: Frames, last: Pose, before: Pose) -> Float[Array, " n"]:
            there = at._replace(last=last, before=before)
            return balance(system._replace(chain=chain, tasks=tasks), frame, there, factors)

        primal = asked.chain, asked.tasks, frame, at.last, at.before
        return jax.jvp(all_of, primal, (change.chain, change.tasks, *by))[1]

    # the poses before move, too: here as far as they are given, in `_chain` as far as they are solved
    inputs = Pose(change.frames.rotations[..., None], change.frames.root[..., None])
    none = jax.tree.map(jnp.zeros_like, inputs)
    if static.chained:
        begun, before = _earlier(none, change.first.pose, known), _earlier(inputs, change.first.before, known)
    else:
        begun, before = none, none
    b = _each(moves, asked.frames, places, factors, (change.frames, begun, before))
    step = jax.vmap(_Response.to)(response, b)
    if static.chained:
        step = _chain(asked, numbers, static, places, known, factors, response, step)

    def move(pose: Pose, offsets: Array, by: Array) -> Pose:
        parent = parent_rotations(asked.chain, forward(asked.chain, pose, offsets))
        free = asked.chain._replace(limits=None)
        return jax.jvp(lambda s: moved(free, pose, parent, s[:, None]), (jnp.zeros_like(by),), (by,))[1]

    change_of = jax.vmap(move)(places.pose, asked.frames.offsets, step)
    keep = known[:, None]
    return poses, Poses(
        jnp.where(keep[..., None], change_of.rotations[..., 0], 0), jnp.where(keep, change_of.root[..., 0], 0)
    )


def distance(
    asked: Asked, numbers: Numbers, poses: Poses, sound: Bool[Array, " f"], static: Static
) -> Float[Array, " f"]:
    """How far each frame is from fulfilling its conditions: the largest component, in radians or metres, of what one more step
    would change; infinite where the solver was not sound."""
    asked, numbers, poses = jax.lax.stop_gradient((asked, numbers, poses))
    places, known = _places(asked, poses, sound)
    asked = _finite(asked, sound & known)
    system = _system(asked, numbers, static)

    def missing(frame: Frames, at: Solved) -> Array:
        return jnp.max(jnp.abs(balance(system, frame, at, factors_of(system, frame, at))))

    left = _each(missing, asked.frames, places)
    return jnp.where(sound & known & jnp.isfinite(left), left, jnp.inf)


def settled(
    asked: Asked, numbers: Numbers, poses: Poses, sound: Bool[Array, " f"], static: Static, steps: int
) -> Poses:
    """The poses after up to so many Newton steps on their conditions; a step that brings a frame no nearer is not taken."""
    asked, numbers, poses = jax.lax.stop_gradient((asked, numbers, poses))
    places, known = _places(asked, poses, sound)
    fine = sound & known
    clean = _finite(asked, fine)
    system, free = _system(clean, numbers, static), clean.chain._replace(limits=None)

    def frame(x: Frames, at: Solved) -> Pose:
        def missing(pose: Pose) -> tuple[Factors, Array]:
            there = at._replace(pose=pose)
            factors = factors_of(system, x, there)
            return factors, balance(system, x, there, factors)

        def step(_: Any, state: tuple[Pose, Factors, Array]) -> tuple[Pose, Factors, Array]:
            pose, factors, left = state
            response = _factorized(derivative(system, x, at._replace(pose=pose), factors))
            parent = parent_rotations(clean.chain, forward(clean.chain, pose, x.offsets))
            tried = moved(free, pose, parent, response.to(left)[:, None])
            new = (tried, *missing(tried))
            better = jnp.max(jnp.abs(new[2])) < jnp.max(jnp.abs(left))
            return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, state)

        return jax.lax.fori_loop(0, steps, step, (at.pose, *missing(at.pose)))[0]

    new = _each(frame, clean.frames, places)
    return Poses(
        jnp.where(fine[:, None, None], new.rotations[..., 0], poses.rotations),
        jnp.where(fine[:, None], new.root[..., 0], poses.root),
    )


def _system(asked: Asked, numbers: Numbers, static: Static) -> System:
    return System(asked.chain, asked.tasks, numbers, static.layers, static.kinds)


class _Response(NamedTuple):
    """A frame's derivative of the conditions by the pose, factorized; bad where that is not finite, or singular."""

    lu: Float[Array, "*f n n"]
    pivots: Int[Array, "*f n"]
    good: Bool[Array, "*f"]

    def to(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """How the pose responds to a change of the conditions, of one frame; not at all where that is not known."""
        step = -jax.scipy.linalg.lu_solve((self.lu, self.pivots), change)
        return jnp.where(self.good, step, 0)


def _frame(system: System, frame: Frames, at: Solved) -> tuple[Factors, _Response]:
    """Factors, and how the pose responds."""
    factors = factors_of(system, frame, at)
    return factors, _factorized(derivative(system, frame, at, factors))


def _factorized(a: Float[Array, "n n"]) -> _Response:
    identity = jnp.eye(a.shape[0], dtype=a.dtype)
    finite = jnp.isfinite(a).all()
    lu, pivots = jax.scipy.linalg.lu_factor(jnp.where(finite, a, -identity))
    smallest = jnp.min(jnp.abs(jnp.diagonal(lu)))
    good = finite & jnp.isfinite(lu).all() & (smallest > 8 * jnp.finfo(a.dtype).eps)
    return _Response(jnp.where(good, lu, identity), pivots, good)


def _each(f: Callable[..., Any], *frames: Any) -> Any:
    """`f` of every frame, a few at a time: what it needs in between stays in the processor's cache, and out of memory."""
    return jax.lax.map(lambda x: f(*x), frames, batch_size=TOGETHER)


def _places(asked: Asked, poses: Poses, sound: Bool[Array, " f"]) -> tuple[Solved, Bool[Array, " f"]]:
    """Each frame's pose and those before it, with frames that are not finite left out: after one, the next starts from the last
    that was. known: (F,) which frames are finite."""
    own = Pose(asked.frames.rotations[..., None], asked.frames.root[..., None])
    pose = Pose(poses.rotations[..., None], poses.root[..., None])
    known = jnp.isfinite(pose.rotations).all((1, 2, 3)) & jnp.isfinite(pose.root).all((1, 2))
    known &= jnp.isfinite(own.rotations).all((1, 2, 3)) & jnp.isfinite(own.root).all((1, 2))
    last = _earlier(pose, asked.first.pose, known)
    before = _earlier(own, asked.first.before, known)
    still = jnp.eye(4, 1, dtype=poses.root.dtype)[None, :, None]
    pose = Pose(
        jnp.where(known[:, None, None, None], pose.rotations, still),
        jnp.where(known[:, None, None], pose.root, 0),
    )
    return Solved(pose, last, before), known


def _earlier(x: Pose, first: Pose, known: Bool[Array, " f"]) -> Pose:
    """For every frame the last known one before it, `first` where there is none."""
    index = jnp.arange(known.shape[0], dtype=jnp.int32)
    until = jax.lax.cummax(jnp.where(known, index, -1))
    at = jnp.concatenate([jnp.full(1, -1, jnp.int32), until[:-1]])

    def pick(rows: Array, begin: Array) -> Array:
        there = (at >= 0).reshape(-1, *[1] * begin.ndim)
        return jnp.where(there, rows[jnp.maximum(at, 0)], begin[None])

    return jax.tree.map(pick, x, first)


def _finite(asked: Asked, good: Bool[Array, " f"]) -> Asked:
    """Frames that were not solved ask for nothing but their input; what is not finite is at rest."""
    frames = asked.frames
    still, unit = jnp.eye(4, 1, dtype=frames.root.dtype), jnp.eye(1, 4, dtype=frames.root.dtype)[0]
    return asked._replace(frames=_kept(frames, _usable(frames, good), still, unit))


def _finite_change(change: Asked, asked: Asked, good: Bool[Array, " f"]) -> Asked:
    """What belongs to it of a change: what `_finite` puts in the place of something does not change."""
    none = jnp.zeros((), asked.frames.root.dtype)
    return change._replace(frames=_kept(change.frames, _usable(asked.frames, good), none, none))


class _Usable(NamedTuple):
    """Which parts of what is asked of F frames count, in shapes that broadcast to theirs."""

    input: Bool[Array, " f"]
    asked: Bool[Array, " f"]
    place: Bool[Array, "f b 1"]
    turn: Bool[Array, "f b 1"]
    mass: Bool[Array, "f m 3"]
    offsets: Bool[Array, "f p 3"]


def _usable(frames: Frames, good: Bool[Array, " f"]) -> _Usable:
    goals, there = frames.goals, good[:, None, None]
    return _Usable(
        jnp.isfinite(frames.rotations).all((1, 2)) & jnp.isfinite(frames.root).all(1),
        good,
        there & jnp.isfinite(goals.place).all(-1, keepdims=True),
        there & jnp.isfinite(goals.rotation).all(-1, keepdims=True),
        jnp.isfinite(goals.mass_point),
        jnp.isfinite(frames.offsets),
    )


def _kept(frames: Frames, of: _Usable, still: Array, unit: Array) -> Frames:
    """The parts that count; for the others 0, `still` for the input's rotations and `unit` for those asked for."""
    goals = frames.goals
    return frames._replace(
        rotations=jnp.where(of.input[:, None, None], frames.rotations, still),
        root=jnp.where(of.input[:, None], frames.root, 0),
        offsets=jnp.where(of.offsets, frames.offsets, 0),
        controlled=jnp.where(of.asked[:, None], frames.controlled, 0),
        root_controlled=jnp.where(of.asked, frames.root_controlled, 0),
        goals=goals._replace(
            place=jnp.where(of.place, goals.place, 0),
            rotation=jnp.where(of.turn, goals.rotation, unit),
            active=jnp.where(of.asked[:, None], goals.active, 0),
            mass_point=jnp.where(of.mass, goals.mass_point, 0),
        ),
    )


def _chain(
    asked: Asked,
    numbers: Numbers,
    static: Static,
    places: Solved,
    known: Bool[Array, " f"],
    factors: Factors,
    response: _Response,
    step: Float[Array, "f n"],
) -> Float[Array, "f n"]:
    """Each frame's step with what the step of the frame before it adds: one linear recurrence over the clip."""
    free = asked.chain._replace(limits=None)
    offsets = _earlier_rows(asked.frames.offsets, known)
    joints = (step.shape[1] - 3) // 3

    def through(frame: Frames, at: Solved, before: Array) -> tuple[Array, Array]:
        """How `from_start` moves with the pose before, (1 + P, 3, 3) for the root's place and each joint: none looks at another."""
        here = parent_rotations(asked.chain, forward(asked.chain, at.pose, frame.offsets))
        there = parent_rotations(asked.chain, forward(asked.chain, at.last, before))

        def start(s: Float[Array, " 3"]) -> tuple[Array, Array]:
            last = moved(free, at.last, there, jnp.tile(s, joints + 1)[:, None])
            return from_start(frame, at._replace(last=last), here, numbers)

        back, travel = jax.jacfwd(start)(jnp.zeros(3, step.dtype))
        return back.reshape(-1, 3, 3), travel.reshape(-1, 3, 3)

    blocks = _each(through, asked.frames, places, offsets)
    good = jnp.array([jnp.isfinite(x).all((1, 2, 3)) for x in blocks]).all(0)
    blocks = tuple(jnp.where(good[:, None, None, None], x, 0) for x in blocks)

    def follow(last: Array, x: tuple[Any, ...]) -> tuple[Array, Array]:
        own, response, factors, blocks, seen = x
        moves = (jnp.sum(m * last.reshape(-1, 1, 3), axis=-1).reshape(-1) for m in blocks)
        here = own + response.to(of_start(factors, *moves))
        return jnp.where(seen, here, last), here

    return jax.lax.scan(follow, jnp.zeros_like(step[0]), (step, response, factors, blocks, known))[1]


def _earlier_rows(x: Float[Array, "f p 3"], known: Bool[Array, " f"]) -> Float[Array, "f p 3"]:
    index = jnp.arange(known.shape[0], dtype=jnp.int32)
    until = jax.lax.cummax(jnp.where(known, index, 0))
    return x[jnp.concatenate([until[:1], until[:-1]])]


@jax.custom_jvp
def _same(x: Array) -> Array:
    return x


@_same.defjvp
def _twice(primals: Any, tangents: Any) -> Any:
    raise OptionError(
        "a second derivative through the deformation was asked for: the implicit rule gives first derivatives only; "
        'take gradient="unrolled"'
    )


def once(tree: Any) -> Any:
    """The same arrays; to differentiate them is an error: what is made of them holds a first derivative already, and has constants
    in it that a second one would need."""
    return jax.tree.map(lambda x: _same(x) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)
