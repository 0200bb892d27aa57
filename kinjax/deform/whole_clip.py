"""All frames of a clip bent to its constraints at once: one nonlinear least-squares problem, smooth by what it minimises.

In: a motion and constraints, as for `deform`, and the weights of smoothness. Out: a `Deformation`. The unknowns are the
displacement map: for each frame `t` a vector `u_t`, the root's way and a rotation vector `w` a joint (in its parent's frame), with

    p'_t = p_t + u_t,    q'_t = exp(w_t) q_t

so that its velocity and acceleration are differences of the `u_t`. Half the sum of squares of all these is minimised:

    ratio^(layers below) sqrt(weight) r_b(u_t)    every constraint b in every frame in which it is active (metres)
    attraction u_t
    velocity rate (u_{t+1} - u_t)
    acceleration rate^2 (u_{t+2} - 2 u_{t+1} + u_t)

The unknowns of the clip are the joints that any constraint recruits in any frame, in **all** frames: where none is active
they ease out and back in. All other joints keep the input's rotations, bit for bit. Within the clip it is a true
minimum, so a constraint pulls at every unknown that it sees, those that only others recruit among them: `recruits` says what
may move, not on whose account (per constraint that would be no minimum of anything, and no step could be judged).

A frame that is not finite (its poses or targets) stays the input's, and every term that touches it is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import OptionError, ShapeError
from ..lengths import bucket
from ..motion import Motion
from ..quaternions import turns
from ..rotations import exp
from .banded import Bands, times
from .chain import Chain, Pose, compose, forward, parent_rotations
from .constraints import Goal
from .pipeline import output_motion
from .plan import Plan, make_plan
from .reporting import make_report
from .results import Deformation
from .sequence import Frames, Solved
from .settings import Settings
from .solving import _cast
from .tasks import Kinds, Tasks, _levers, look, residuals


class Weights(NamedTuple):
    """Of the terms: attraction (metres a radian), velocity (times the rate: metres a radian a frame) and acceleration (times its
    square)."""

    attraction: Float[Array, ""]
    velocity: Float[Array, ""]
    acceleration: Float[Array, ""]


class Errors(NamedTuple):
    """All terms of the sum of squares."""

    constraints: Float[Array, "f b 3"]
    attraction: Float[Array, "f n"]
    velocity: Float[Array, "f n"]
    acceleration: Float[Array, "f n"]


class Problem(NamedTuple):
    """F frames and what is to be minimised over their displacements (F, 3 + 3 Q) of the root and Q joints.

    tasks: with the layers' weights in `scale`. spread: (P, Q) 1 where the column's joint is the row's of the chain; columns of
    zeros fill up. root_free: 0 where no constraint recruits the root's translation. valid: (F,) 0 for frames that are lost or
    only fill up; nothing is asked of them.
    """

    chain: Chain
    tasks: Tasks
    frames: Frames
    spread: Float[Array, "p q"]
    root_free: Float[Array, ""]
    valid: Float[Array, " f"]
    weights: Weights

    def pose(self, frame: Frames, u: Float[Array, " n"]) -> Pose:
        """One frame's input, displaced (trials C = 1)."""
        turn = jnp.matmul(self.spread, u[3:].reshape(-1, 3), precision="highest")
        q = compose(exp(turn.T), frame.rotations)
        return Pose(q[..., None], (frame.root + self.root_free * u[:3])[:, None])

    def asked(self, kinds: Kinds, frame: Frames, u: Float[Array, " n"]) -> Float[Array, "b 3"]:
        """What one frame's constraints leave."""
        world = forward(self.chain, self.pose(frame, u), frame.offsets)
        return residuals(self.tasks, frame.goals, look(self.tasks, frame.goals, world), kinds)[..., 0]

    def errors(self, kinds: Kinds, u: Float[Array, "f n"]) -> Errors:
        """All terms; what touches a frame that is not there is 0."""
        own = jax.vmap(partial(self.asked, kinds))(self.frames, u)
        pairs, triples = self._together()
        step = jnp.roll(u, -1, 0) - u
        bend = jnp.roll(step, -1, 0) - step
        w = self.weights
        return Errors(own, w.attraction * u, w.velocity * pairs * step, w.acceleration * triples * bend)

    def curvature(self, kinds: Kinds, u: Float[Array, "f n"]) -> tuple[Bands, Float[Array, "f n"]]:
        """The Gauss-Newton matrix of half the sum of squares, and its gradient."""

        def both(frame: Frames, at: Float[Array, " n"]) -> tuple[Array, Array]:
            jac, r = self.jacobian(kinds, frame, at)
            return jnp.matmul(jac.T, jac, precision="highest"), jnp.matmul(r, jac, precision="highest")

        blocks, gradient = jax.vmap(both)(self.frames, u)
        smooth = self._smoothness(u.shape[1])
        return smooth._replace(diagonal=smooth.diagonal + blocks), gradient + times(smooth, u)

    def jacobian(
        self, kinds: Kinds, frame: Frames, u: Float[Array, " n"]
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """How one frame's 3 B residuals grow with its displacement, exactly, and the residuals.

        Only what a constraint sees is differentiated by JAX, with a twist of its body that is small and the same for all;
        what a joint twists it by is known in closed form. (Forward mode through the kinematics takes 30 times as long.)
        """
        pose = self.pose(frame, u)
        world = forward(self.chain, pose, frame.offsets)
        seen = look(self.tasks, frame.goals, world)

        def twisted(way: Float[Array, " 3"], turn: Float[Array, " 3"]) -> tuple[Array, Array]:
            rotation = seen.rotation + jnp.einsum("ik,bkjc->bijc", _cross(turn), seen.rotation, precision="highest")
            moved = seen._replace(point=seen.point + way[:, None], rotation=rotation)
            r = residuals(self.tasks, frame.goals, moved, kinds)[..., 0]
            return r, r

        none = jnp.zeros(3, u.dtype)
        (by_way, by_turn), r = jax.jacfwd(twisted, argnums=(0, 1), has_aux=True)(none, none)  # (B, 3 rows, 3) each
        # the reference's own motion is that of the body the other way round: residuals do not see what moves both
        arm, moves, rootward = _levers(self.chain, self.tasks, seen, world[:-1, :, 3, 0])
        turn = jnp.matmul(self.spread, u[3:].reshape(-1, 3), precision="highest")
        axes = jnp.matmul(parent_rotations(self.chain, world), left_jacobian(turn), precision="highest")
        axes = jnp.einsum("pic,pq->qci", axes, self.spread, precision="highest")  # world axes of each unknown's turn
        arm = jnp.einsum("bpi,pq->bqi", arm, self.spread, precision="highest")
        moves = jnp.matmul(moves, self.spread, precision="highest")
        ways = jnp.cross(axes[None], arm[:, :, None, :])  # (B, Q, 3 unknowns, 3)
        turns = moves[:, :, None, None] * axes[None]
        columns = jnp.einsum("bri,bqci->brqc", by_way, ways, precision="highest")
        if kinds.turns or kinds.looks:
            columns = columns + jnp.einsum("bri,bqci->brqc", by_turn, turns, precision="highest")
        root = by_way * (rootward * self.root_free)[:, None, None]
        rows = r.size
        return jnp.concatenate([root.reshape(rows, 3), columns.reshape(rows, -1)], axis=1), r.reshape(rows)

    def _together(self) -> tuple[Float[Array, "f 1"], Float[Array, "f 1"]]:
        """1 for each frame that the next one, and the next two, are there with."""
        last = jnp.arange(self.valid.shape[0], dtype=jnp.int32)[::-1]
        one, two = jnp.roll(self.valid, -1), jnp.roll(self.valid, -2)
        pairs = jnp.where(last >= 1, self.valid * one, 0)
        return pairs[:, None], jnp.where(last >= 2, pairs * two, 0)[:, None]

    def _smoothness(self, n: int) -> Bands:
        """The matrix of the terms other than the constraints': multiples of the identity."""
        pairs, triples = (x[:, 0] for x in self._together())
        a, v, c = (w * w for w in self.weights)
        middle, end = jnp.roll(triples, 1), jnp.roll(triples, 2)  # a roll brings in zeros: none begins in the last frames
        diagonal = a + v * (pairs + jnp.roll(pairs, 1)) + c * (triples + 4 * middle + end)
        first = -v * pairs - 2 * c * (triples + middle)
        same = jnp.eye(n, dtype=diagonal.dtype)
        return Bands(*(x[:, None, None] * same for x in (diagonal, first, c * triples)))


def _cross(v: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """The matrix of `v x`."""
    return jnp.swapaxes(jnp.cross(v[..., None, :], jnp.eye(3, dtype=v.dtype)), -1, -2)


def left_jacobian(v: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """By what small turn, to be made after it, `exp(v)` changes with `v`: `exp(v + d) = exp(J d) exp(v)`."""
    square = jnp.sum(v * v, axis=-1)[..., None, None]
    small = square < 2.5e-3
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sine, across = (jnp.sin(angle / 2) / angle) ** 2, (angle - jnp.sin(angle)) / angle**3
    # by their series where the quotients would lose digits
    a = jnp.where(small, 0.5 - square / 24 + square * square / 720, 2 * sine)
    b = jnp.where(small, 1 / 6 - square / 120 + square * square / 5040, across)
    k = _cross(v)
    return jnp.eye(3, dtype=v.dtype) + a * k + b * jnp.matmul(k, k, precision="highest")


@dataclass(frozen=True, eq=False)
class Minimum:
    """What was found: `Deformation.again` of `whole_clip`.

    steps: tried. converged: the undamped step that is left is below the tolerance. cost: half the sum of squares. gradient: its
    derivative with the largest size. displacement: (F, 3 + 3 J) of the root's translation and of all joints of the
    skeleton, metres and radians.
    """

    steps: int
    converged: bool
    cost: float
    gradient: float
    displacement: Float[np.ndarray, "f n"]


@partial(jax.jit, static_argnames=("kinds",))
def _run(problem: Problem, start: Any, steps: Any, tolerance: Any, kinds: Kinds) -> Any:
    """(displacements, poses, cost, gradient, steps, converged)."""
    from .clip_solver import minimise

    found = minimise(problem, kinds, start, steps, tolerance)
    pose = jax.vmap(problem.pose)(problem.frames, found.value)
    return found, pose.rotations[..., 0], pose.root[..., 0]


def whole_clip(
    motion: Motion,
    constraints: Sequence[Goal],
    settings: Settings | None = None,
    *,
    ratio: float = 10.0,
    velocity: float = 1e-4,
    acceleration: float = 5e-5,
    attraction: float = 1e-3,
    steps: int = 100,
    tolerance: float = 1e-6,
    start: Motion | None = None,
) -> Deformation:
    """Bend all frames of `motion` to `constraints` at once, by least squares with a smooth displacement map.

    motion, constraints: as for `deform`. ratio: weight of a layer over the one below it. velocity (metres a radian, times
    seconds), acceleration (times seconds squared) and attraction (metres a radian, above 0): weights of the displacement map's
    first and second derivative and of itself, a metre of the root counting as a radian. steps: trials at most. tolerance: it is done when the
    undamped step left would move nothing by more than so many radians or metres (1e-3 at least in float32). start: a motion
    of the same frames to start from, the result of `deform` for instance; default the input.

    Of `settings`, `precision` and `held` count; there are no limits, no filter and no strict priorities. The report's statuses: "converged" where a
    constraint holds, else "stalled" where this is the minimum and "max_iter" where `steps` did not suffice, "nonfinite" in frames
    that are not finite. `again` is a `Minimum`. Raises `KinjaxError`s as `deform` does, and `OptionError` for numbers that
    make no sense.
    """
    settings = settings or Settings()
    weights = _checked(ratio, velocity, acceleration, attraction, steps, tolerance)
    dtype = np.dtype(settings.precision)
    with jax.enable_x64(settings.precision == "float64"), jax.numpy_dtype_promotion("standard"):
        plan = make_plan(motion, tuple(constraints), settings)
        rate = float(motion.rate)
        scaled: Any = Weights(weights.attraction, weights.velocity * rate, weights.acceleration * rate**2)
        problem, free = _problem(plan, scaled, ratio, dtype)
        first = _start(plan, problem, free, motion, start)
        least = max(tolerance, 1e-3 if dtype == np.float32 else 0.0)
        found, rotations, root = _run(problem, first, np.asarray(steps, np.int32), dtype.type(least), plan.kinds)
        return _finished(motion, plan, settings, problem, free, found, np.asarray(rotations), np.asarray(root))


def _checked(ratio: Any, velocity: Any, acceleration: Any, attraction: Any, steps: Any, tolerance: Any) -> Any:
    """The weights; `OptionError` for what makes no sense."""
    numbers = {"ratio": ratio, "velocity": velocity, "acceleration": acceleration, "attraction": attraction}
    for name, value in {**numbers, "tolerance": tolerance}.items():
        zero = name in ("velocity", "acceleration")
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and not zero):
            raise OptionError(f"{name}={value!r}: a {'non-negative' if zero else 'positive'} number is needed")
    if not isinstance(steps, int) or isinstance(steps, bool) or steps < 1:
        raise OptionError(f"steps={steps!r}: a whole number from 1 is needed")
    made: Any = Weights(float(attraction), float(velocity), float(acceleration))  # type: ignore[arg-type]
    return made


def _problem(plan: Plan, weights: Any, ratio: float, dtype: np.dtype) -> tuple[Any, np.ndarray]:
    """The problem, padded in frames and joints, and the places in the chain of the joints that may move."""
    frames = plan.frames
    f = len(frames.root)
    valid = np.ones(f, bool)
    for x in jax.tree.leaves(frames):
        valid &= np.isfinite(x).reshape(f, -1).all(1)
    size = bucket(f)
    still = frames._replace(rotations=np.broadcast_to(np.eye(4, 1), frames.rotations.shape))

    def known(x: np.ndarray, instead: np.ndarray) -> np.ndarray:
        kept = np.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, np.where(np.isfinite(instead), instead, 0))
        return np.concatenate([kept, np.zeros((size - f, *x.shape[1:]), x.dtype)])

    filled = jax.tree.map(known, frames, still)
    goals = filled.goals
    filled.rotations[f:, 0] = goals.rotation[f:, :, 0] = 1
    goals.rotation[:f][~valid] = np.eye(1, 4)
    there = np.concatenate([valid, np.zeros(size - f, bool)])
    goals.active[~there] = 0
    free = np.flatnonzero(frames.controlled.any(0))
    spread = np.zeros((len(plan.chain.parents), -(-max(len(free), 1) // 4) * 4))
    spread[free, np.arange(len(free))] = 1
    below = float(ratio) ** (plan.layers - 1 - plan.tasks.layer)
    tasks = plan.tasks._replace(scale=plan.tasks.scale * below[:, None])
    moves = np.asarray(float(frames.root_controlled.any()))
    numbers: Any = Weights(*(np.asarray(w, float) for w in weights))
    made = Problem(plan.chain._replace(limits=None), tasks, filled, spread, moves, there.astype(float), numbers)  # type: ignore[arg-type]
    return _cast(made, dtype), free


def _start(plan: Plan, problem: Any, free: np.ndarray, motion: Motion, start: Motion | None) -> np.ndarray:
    """(F padded, n) displacements to start from."""
    out = np.zeros((len(problem.valid), 3 + 3 * problem.spread.shape[1]), problem.valid.dtype)
    if start is None:
        return out
    if np.shape(start.rotations) != np.shape(motion.rotations):
        raise ShapeError(f"start has rotations {np.shape(start.rotations)}, the motion {np.shape(motion.rotations)}")
    way, turn = displacement(motion, start)
    own = np.concatenate([way[:, None], turn[:, plan.kept[free]]], axis=1).reshape(motion.frames, -1)
    lost = ~(np.isfinite(own).all(1) & (problem.valid[: motion.frames] > 0))
    out[: motion.frames, : own.shape[1]] = np.where(lost[:, None], 0, own)
    return out


def displacement(before: Motion, after: Motion) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f j 3"]]:
    """The displacement map from one motion to another: the root's way (metres), and each joint's turn in its parent's frame, as a
    rotation vector (radians). NaN where one of the two is not finite."""
    q0, q1 = np.asarray(before.rotations, float), np.asarray(after.rotations, float)
    turn = (turns(q1) * turns(q0).inv()).as_rotvec().reshape(*q0.shape[:2], 3)
    turn[~(np.isfinite(q0).all(-1) & np.isfinite(q1).all(-1))] = np.nan
    return np.asarray(after.translations, float)[:, 0] - np.asarray(before.translations, float)[:, 0], turn


def _finished(
    motion: Motion, plan: Plan, settings: Settings, problem: Any, free: np.ndarray, found: Any, rotations: Any, root: Any
) -> Deformation:
    """The poses found as a motion, with its report."""
    frames, count = plan.frames, motion.frames
    sound = problem.valid[:count] > 0
    moved = np.zeros(len(plan.chain.parents), bool)
    moved[free] = True
    given = frames.rotations.astype(rotations.dtype), frames.root.astype(root.dtype)
    q = np.where(sound[:, None, None] & moved, rotations[:count], given[0])
    p = np.where((sound & (problem.root_free > 0))[:, None], root[:count], given[1])
    tried, done = int(found.steps), bool(found.converged)
    b, n = plan.tasks.kind.shape[0], plan.layers
    ones = np.ones((count, n))
    fields: Any = (
        q, p, np.full(count, tried), np.zeros((count, n), int), np.ones((count, b)), ones, np.full(count, done), sound, ones,
        ones[:, 0],
    )  # fmt: skip
    solved = Solved(*fields)
    result = output_motion(motion, plan, solved)
    report = make_report(motion, result, plan, solved, replace(settings, iterations=tried), 1)
    cost, slope = float(found.cost), float(found.gradient)
    way, turn = displacement(motion, result)
    whole = np.concatenate([way[:, None], turn], axis=1).reshape(count, -1)
    note = f"all frames at once: {tried} steps, {'a minimum' if done else 'not a minimum yet'}, largest gradient {slope:.1e}"
    report = replace(report, notes=(*report.notes, note))
    return Deformation(result, report, Minimum(tried, done, cost, slope, whole))
