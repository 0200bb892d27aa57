"""The frame loop: every frame starts where the one before it ended.

In: a clip's goals and the input's poses, all frames along the first axis. Out: the poses and what is known of each frame.
Source: 2004 paper, section 5.1, eq. 4: joints that a constraint controls start at their previous output, the others at the
input, whose values they keep.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .chain import Chain, Pose
from .frame_solver import Reference, Solving, solve_frame
from .tasks import Goals, Tasks


class Frames(NamedTuple):
    """F frames of input: local rotations (F, 4, P), root (F, 3), the joints' places in their parents' frames (F, P, 3), which
    joints are controlled (F, P) and whether the root's place is (F,), as 0 or 1, and the goals."""

    rotations: Float[Array, "f 4 p"]
    root: Float[Array, "f 3"]
    offsets: Float[Array, "f p 3"]
    controlled: Float[Array, "f p"]
    root_controlled: Float[Array, " f"]
    goals: Goals


class Solved(NamedTuple):
    """F frames of output."""

    rotations: Float[Array, "f 4 p"]
    root: Float[Array, "f 3"]
    residual: Float[Array, "f b 3"]
    errors: Float[Array, "f layers"]
    iterations: Int[Array, " f"]
    rank: Int[Array, "f layers"]


def solve_sequence(
    chain: Chain, tasks: Tasks, frames: Frames, first: Pose, layers: int, iterations: int, solving: Solving
) -> Solved:
    """All frames in their order, from the pose `first` (C = 1)."""

    def step(last: Pose, x: Frames):
        own = Pose(x.rotations[..., None], x.root[:, None])
        held = x.controlled[None, :, None] > 0
        start = Pose(
            jnp.where(held, last.rotations, own.rotations),
            jnp.where(x.root_controlled > 0, last.root, own.root),
        )
        reference = Reference(x.rotations, x.root, x.controlled, x.root_controlled)
        s = solve_frame(chain, tasks, x.goals, start, x.offsets, reference, layers, iterations, solving)
        out = Solved(s.pose.rotations[..., 0], s.pose.root[:, 0], s.residual, s.errors, s.iterations, s.rank)
        return s.pose, out

    return jax.lax.scan(step, first, frames)[1]
