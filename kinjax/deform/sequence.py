"""The frame loop: every frame starts from where the one before it ended.

In: a clip's goals and the input's poses, all frames along the first axis. Out: the poses and what is known of each frame.
Source: 2004 paper, section 5.1, eq. 4: joints that a constraint controls start from their previous output, the others at the
input, whose values they keep. The start is the new input moved by the last displacement, not the last output itself: the
two agree where the input rests, and where it does not, the first is where the output would be if nothing else changed
(constraints that the input already keeps then give back the input; from the last output, swinging limbs outran the solver).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .chain import Chain, Pose, compose, inverse_of
from .frame_solver import Reference, Solving, solve_frame
from .loops import Loop, plain
from .tasks import Goals, Kinds, Tasks


class Frames(NamedTuple):
    """F frames of input: local rotations (F, 4, P), root (F, 3), the joints' places in their parents' frames (F, P, 3), which
    joints are controlled (F, P) and whether the root's place is (F,), as 0 or 1, whether the frame starts where the one
    before it ended (F,) or, with 0, at the input, whether a straightening limb is held back (F,), and the goals."""

    rotations: Float[Array, "f 4 p"]
    root: Float[Array, "f 3"]
    offsets: Float[Array, "f p 3"]
    controlled: Float[Array, "f p"]
    root_controlled: Float[Array, " f"]
    warm: Float[Array, " f"]
    dragged: Float[Array, " f"]
    goals: Goals


class Solved(NamedTuple):
    """F frames of output: poses, and what `State` says of each frame; sound is False where the solve was not finite and the
    frame is the input's."""

    rotations: Float[Array, "f 4 p"]
    root: Float[Array, "f 3"]
    iterations: Int[Array, " f"]
    rank: Int[Array, "f layers"]
    solo: Float[Array, "f b"]
    own: Float[Array, "f layers"]
    stayed: Bool[Array, " f"]
    sound: Bool[Array, " f"]
    trust: Float[Array, "f layers"]
    pull: Float[Array, " f"]


class Carried(NamedTuple):
    """What a frame hands to the next: its pose and its input's (C = 1), the trust of its layers and the pull (`State`)."""

    pose: Pose
    before: Pose
    trust: Float[Array, " layers"]
    pull: Float[Array, ""]


def displaced(own: Pose, last: Pose, before: Pose, joints: Float[Array, " p"], root: Float[Array, ""]) -> Pose:
    """Where a frame starts: its input `own` moved by the last displacement, that of the output `last` from its input `before`, in
    the joints and, for the root's place, where the marks are above 0."""
    turn = compose(last.rotations, compose(inverse_of(before.rotations), own.rotations))
    return Pose(
        jnp.where(joints[None, :, None] > 0, turn, own.rotations),
        jnp.where(root > 0, last.root + (own.root - before.root), own.root),
    )


def solve_sequence(
    chain: Chain,
    tasks: Tasks,
    frames: Frames,
    first: Carried,
    solving: Solving,
    layers: int,
    kinds: Kinds,
    attract: tuple[bool, bool] = (True, True),
    loop: Loop = plain,
    count: Int[Array, ""] | None = None,
) -> tuple[Carried, Solved]:
    """All frames in their order, from the pose `first` (C = 1); gives the last pose, too.

    count: only so many of the frames; of the others the output is 0 (no reverse derivative then). attract: whether joints,
    and the root's translation, are drawn to the input. A frame whose solve is not finite restarts from the input and is
    flagged; where the input itself is not finite, the next frame starts from the last sound one. loop: how a frame's loops
    are run (`loops`).
    """

    def step(carried: Carried, x: Frames) -> tuple[Carried, Solved]:
        last, before, trust, pull = carried
        own = Pose(x.rotations[..., None], x.root[:, None])
        start = displaced(own, last, before, x.controlled * x.warm, x.root_controlled * x.warm * x.goals.root_free)
        reference = Reference(
            x.rotations,
            x.root,
            float(attract[0]) * x.controlled,
            float(attract[1]) * x.root_controlled * x.goals.root_free,
        )
        s = solve_frame(
            chain, tasks, x.goals, start, x.offsets, reference, layers, solving, kinds, trust, pull, x.dragged, loop
        )
        sound = jnp.isfinite(s.pose.rotations).all() & jnp.isfinite(s.pose.root).all() & jnp.isfinite(s.errors).all()
        pose = Pose(
            jnp.where(sound & (x.controlled[None, :, None] > 0), s.pose.rotations, own.rotations),
            jnp.where(sound & (x.root_controlled * x.goals.root_free > 0), s.pose.root, own.root),
        )
        known = jnp.isfinite(pose.rotations).all() & jnp.isfinite(pose.root).all()
        kept, before = jax.tree.map(lambda new, old: jnp.where(known, new, old), (pose, own), (last, before))
        trust, pull = jnp.where(sound, s.trust, trust), jnp.where(sound, s.pull, pull)
        out = Solved(
            pose.rotations[..., 0], pose.root[:, 0], s.iterations, s.rank, s.solo, s.own, s.stayed, sound, trust, pull
        )  # fmt: skip
        return Carried(kept, before, trust, pull), out

    if count is None:
        return jax.lax.scan(step, first, frames)

    def at(i: Int[Array, ""], state: tuple[Carried, Solved]) -> tuple[Carried, Solved]:
        x = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, i, 0, keepdims=False), frames)
        carried, new = step(state[0], x)
        return carried, jax.tree.map(lambda a, b: jax.lax.dynamic_update_index_in_dim(a, b, i, 0), state[1], new)

    shapes = jax.eval_shape(step, first, jax.tree.map(lambda a: a[0], frames))[1]
    none = jax.tree.map(lambda a: jnp.zeros((len(frames.root), *a.shape), a.dtype), shapes)
    return jax.lax.fori_loop(0, count, at, (first, none))
