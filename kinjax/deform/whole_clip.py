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
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..errors import OptionError, ShapeError
from ..lengths import bucket
from ..motion import Motion
from ..quaternions import turns
from .clip_problem import Problem, Weights
from .constraints import Goal
from .pipeline import output_motion
from .plan import Plan, make_plan
from .reporting import make_report
from .results import Deformation
from .sequence import Solved
from .settings import Settings
from .solving import as_dtype
from .tasks import Kinds


@dataclass(frozen=True, eq=False)
class Minimum:
    """What was found: `Deformation.again` of `whole_clip`.

    steps: tried. converged: the undamped step that is left is below the tolerance (in float32, or the last step gained next
    to nothing). cost: half the sum of squares. gradient: its
    derivative with the largest size. displacement: (F, 3 + 3 J) of the root's translation and of all joints of the
    skeleton, metres and radians; 0 in lost frames.
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
    attraction: float = 5e-3,
    steps: int = 200,
    tolerance: float = 1e-5,
    start: Motion | None = None,
) -> Deformation:
    """Bend all frames of `motion` to `constraints` at once, by least squares with a smooth displacement map.

    motion, constraints: as for `deform`. ratio: weight of a layer over the one below it. velocity (metres a radian, times
    seconds), acceleration (times seconds squared) and attraction (metres a radian, above 0): weights of the displacement
    map's first and second derivative and of itself, a metre of the root counting as a radian. steps: trials at most.
    tolerance: it is done when the undamped step that is left would move nothing by more than so many radians or metres
    (1e-3 at least in float32, where it also ends at a step that gains less than a thousandth). start: a motion of the
    same frames to start from, the result of `deform` for instance; default the input.

    Of `settings`, `precision` and `held` count; there are no limits, no filter and no strict priorities. The report's
    statuses: "converged" where a constraint holds, else "stalled" where this is the minimum and "max_iter" where `steps`
    did not suffice, "nonfinite" in frames that are not finite. `again` is a `Minimum`. Raises `KinjaxError`s as `deform`
    does, and `OptionError` for numbers that make no sense.
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
    given: Any = float(attraction), float(velocity), float(acceleration)
    return Weights(*given)


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
    numbers = jax.tree.map(np.asarray, weights)
    arrays: Any = plan.chain._replace(limits=None), tasks, filled, spread, moves, there.astype(float), numbers
    return as_dtype(Problem(*arrays), dtype), free


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
    motion: Motion,
    plan: Plan,
    settings: Settings,
    problem: Any,
    free: np.ndarray,
    found: Any,
    rotations: Any,
    root: Any,
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
    whole = np.zeros((count, 1 + len(motion.skeleton.names), 3))
    u = np.asarray(found.value, float)[:count].reshape(count, -1, 3)
    whole[:, 0] = float(problem.root_free) * u[:, 0]
    whole[:, 1 + plan.kept[free]] = u[:, 1 : 1 + len(free)]
    note = f"all frames at once: {tried} steps, {'a minimum' if done else 'not a minimum yet'}, largest gradient {slope:.1e}"
    report = replace(report, notes=(*report.notes, note))
    return Deformation(result, report, Minimum(tried, done, cost, slope, whole.reshape(count, -1)))
