"""The same problem solved by weights alone: nonlinear least squares by optimistix, for comparison.

In: a motion, constraints and settings, as for `deform`. Out: a `Deformation`. Each layer's residuals are multiplied by
`ratio` to the power of the layers below it, and a weak pull to the input is added to them; Levenberg-Marquardt
(`optimistix.LevenbergMarquardt`) minimises the sum of their squares, frame by frame, from the same starts. This is what the
2004 paper sets its priorities against: an unreachable target of a low layer pulls at the high ones, the more the nearer
`ratio` is to 1, and a large `ratio` makes the problem stiff.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..motion import Motion
from .chain import Pose, forward, moved, parent_rotations
from .constraints import Goal
from .frame_solver import Reference, attraction
from .pipeline import output_motion
from .plan import make_plan
from .reporting import make_report
from .results import Deformation
from .sequence import Solved, displaced
from .settings import Settings
from .solving import PIECE, as_dtype, begin_pose, piece_of
from .tasks import Kinds, look, residuals


@partial(jax.jit, static_argnames=("kinds", "steps"))
def _run(chain: Any, tasks: Any, frames: Any, first: Any, weight: Any, pull: Any, kinds: Kinds, steps: int) -> Any:
    """A piece of frames: (what the next starts from, (rotations, root, steps taken))."""
    import optimistix as optx

    solver: Any = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def frame(carried: Any, x: Any) -> Any:
        last, before = carried
        own = Pose(x.rotations[..., None], x.root[:, None])
        held = x.controlled[None, :, None] > 0
        start = displaced(own, last, before, x.controlled, x.root_controlled)
        parent = parent_rotations(chain, forward(chain, start, x.offsets))
        reference = Reference(x.rotations, x.root, x.controlled, x.root_controlled)
        free = jnp.concatenate([jnp.full(3, x.root_controlled), jnp.repeat(x.controlled, 3)])

        def errors(step: Any, _: Any) -> Any:
            pose = moved(chain, start, parent, (free * step)[:, None])
            world = forward(chain, pose, x.offsets)
            r = residuals(tasks, x.goals, look(tasks, x.goals, world), kinds)[..., 0]
            return r * weight[tasks.layer][:, None], pull * attraction(reference, pose, parent)

        found: Any = optx.least_squares(errors, solver, jnp.zeros_like(free), max_steps=steps, throw=False)
        pose = moved(chain, start, parent, (free * found.value)[:, None])
        pose = Pose(
            jnp.where(held, pose.rotations, own.rotations), jnp.where(x.root_controlled > 0, pose.root, own.root)
        )
        return (pose, own), (pose.rotations[..., 0], pose.root[:, 0], found.stats["num_steps"])

    return jax.lax.scan(frame, first, frames)


def least_squares(
    motion: Motion,
    constraints: Sequence[Goal],
    settings: Settings | None = None,
    *,
    ratio: float = 10.0,
    pull: float = 1e-3,
) -> Deformation:
    """`deform` without strict priorities: weighted nonlinear least squares, warm-started from frame to frame.

    ratio: weight of a layer over the one below it. pull: weight of the attraction to the input, metres a radian.
    `settings.iterations` bounds the solver's steps in a frame. No filter, no limits, no statuses but "converged" and
    "max_iter". The sparse structure is not used: `optimistix` differentiates the residuals.
    """
    settings = settings or Settings()
    dtype = np.dtype(settings.precision)
    with jax.enable_x64(settings.precision == "float64"), jax.numpy_dtype_promotion("standard"):
        plan = make_plan(motion, tuple(constraints), settings)
        chain, tasks, frames = (as_dtype(t, dtype) for t in (plan.chain._replace(limits=None), plan.tasks, plan.frames))
        weight = np.asarray(float(ratio) ** np.arange(plan.layers - 1, -1, -1), dtype)
        carried: Any = begin_pose(frames.rotations[0], frames.root[0], 1)[:2]
        out = []
        count = motion.frames
        for begin in range(0, count, PIECE):
            end = min(begin + PIECE, count)
            piece = piece_of(frames, begin, end)
            carried, got = _run(
                chain, tasks, piece, carried, weight, np.asarray(pull, dtype), plan.kinds, settings.iterations
            )
            out.append([np.asarray(x)[: end - begin] for x in got])
        rotations, root, steps = (np.concatenate(x) for x in zip(*out, strict=True))
        b, n = plan.tasks.kind.shape[0], plan.layers
        sound = np.isfinite(rotations).all((1, 2)) & np.isfinite(root).all(1)
        ones = np.ones((count, n))
        fields: Any = (
            rotations, root, steps, np.zeros((count, n), int), np.ones((count, b)), ones, np.zeros(count, bool), sound, ones,
            ones[:, 0],
        )  # fmt: skip
        solved = Solved(*fields)
        result = output_motion(motion, plan, solved)
        return Deformation(result, make_report(motion, result, plan, solved, settings, 1))
