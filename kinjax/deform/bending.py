"""Deformation as a function that can be differentiated: variables in, motion out.

In: a motion and constraints, checked and laid out once on the host (`Bend`); then `Variables`, as often as wanted, inside
`jit`, `grad` or `vmap`. Out: `Bent`. It is the frame loop of `deform` without its filter: what `deform` gives with `passes=1`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..errors import OptionError, ShapeError
from ..lengths import bucket
from ..motion import Motion
from .arrangement import Arrangement, Variables, arranged, frames_of
from .chain import Pose
from .conditions import Numbers
from .constraints import Goal
from .frame_solver import Solving
from .implicit import Asked, Poses, Static, attach, distance, settled
from .loops import plain, stored
from .plan import make_plan
from .sequence import Carried, solve_sequence
from .settings import Settings
from .solving import as_dtype, solver_numbers

Gradient = Literal["implicit", "implicit_local", "unrolled"]

CONVERGED = 1e-4
"""Radians and metres: a frame from which one more step would take less than this counts as converged."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bent:
    """The deformed `motion`, as arrays of JAX.

    left: (F,) how far each frame is from where nothing more can be gained: the largest radian or metre of one more full step,
    infinite where it could not be solved. converged: (F,) whether that is below `CONVERGED`; the derivatives of the other
    frames are those of the place to which they were on their way. sound: (F,) False where a frame could not be solved and is the input's.
    """

    motion: Motion
    left: Float[Array, " f"]
    converged: Bool[Array, " f"]
    sound: Bool[Array, " f"]


class Bend:
    """`deform` as a differentiable function of its `variables`.

    gradient: "implicit" differentiates the conditions that the solved frames fulfil, on through the clip where a frame's solution
    depends on the frame before it; "implicit_local" counts every frame's start as constant; "unrolled" goes back through the
    iterations, whatever they led to. The first two give first derivatives, forward and reverse, and need memory for the
    frames alone; the third gives any, at the cost of going through every iteration again.

    settle: Newton steps on those conditions that follow the frame loop, at most; the loop goes on only as long as it gains what is
    worth a step, and often stops a hundredth of a radian short of where the attraction to the input would lead. With 3 to 5
    steps it is there, and the derivatives are those of what came out to within rounding; each costs about as much as the
    derivative itself.

    Computes in JAX's working precision (`settings.precision` is that of `deform`). No filter, and one pass. Raises the errors
    of `deform`.
    """

    def __init__(
        self,
        motion: Motion,
        constraints: Sequence[Goal],
        settings: Settings | None = None,
        *,
        gradient: Gradient = "implicit",
        settle: int = 0,
    ):
        if gradient not in get_args(Gradient):
            raise OptionError(f"gradient={gradient!r}: choose from {', '.join(get_args(Gradient))}")
        if settle < 0 or (settle and gradient == "unrolled"):
            raise OptionError(f"settle={settle}: it must be 0 or more, and goes with an implicit gradient")
        self.motion, self.settings, self.gradient, self.settle = motion, settings or Settings(), gradient, settle
        self.constraints = goals = tuple(constraints)
        plan = make_plan(motion, goals, self.settings)
        if gradient != "unrolled" and plan.chain.limits is not None:
            raise OptionError(
                "the skeleton has joint limits, at which the conditions of a solved frame are others: "
                'take gradient="unrolled", or a skeleton without limits'
            )
        dtype = np.dtype(jnp.result_type(float))
        arrangement, variables = arranged(motion, goals, plan)
        self.frames = motion.frames
        self._arrays = _padded(as_dtype(arrangement, dtype), self.frames)
        self.variables: Variables = jax.tree.map(jnp.asarray, as_dtype(variables, dtype))
        self._static = Static(plan.layers, plan.kinds, gradient == "implicit")
        self._solving = solver_numbers(self.settings, dtype)

    def __call__(self, variables: Variables) -> Bent:
        """The motion that `variables` lead to. Their shapes are those of `self.variables`; a clip's frames are padded inside, so
        that clips of many lengths share a program."""
        for name, own in vars(self.variables).items():
            given = getattr(variables, name)
            if jnp.shape(given) != own.shape:
                raise ShapeError(f"{name} has shape {jnp.shape(given)}, the motion and constraints need {own.shape}")
        length = self._arrays.owner.shape[0]
        v = jax.tree.map(lambda x: jnp.asarray(x, self.variables.weight.dtype), variables)
        v = replace(
            v, **{n: _longer(getattr(v, n), length) for n in ("place", "rotation", "rotations", "translations")}
        )
        rotations, translations, left, sound = _bend(
            self._arrays,
            v,
            self._solving,
            self._static,
            self.gradient,
            (self.settings.attract, self.settings.attract_root),
            self.settle,
        )
        f = self.frames
        skeleton = replace(self.motion.skeleton, offsets=v.offsets)
        motion = replace(self.motion, rotations=rotations[:f], translations=translations[:f], skeleton=skeleton)
        left = left[:f]
        return Bent(motion, left, left < CONVERGED, sound[:f])


def _longer(x: Array, length: int) -> Array:
    """Frames repeated at the end, of which nothing is asked."""
    more = length - x.shape[0]
    return jnp.concatenate([x, jnp.repeat(jax.lax.stop_gradient(x[-1:]), more, axis=0)]) if more else x


def _padded(a: Arrangement, frames: int) -> Arrangement:
    """Padded to a bucket of lengths."""
    more = bucket(frames) - frames
    if not more:
        return a
    grown = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], more, axis=0)]), a.frames)
    grown.goals.active[frames:] = 0
    grown.controlled[frames:] = 0
    grown.root_controlled[frames:] = 0
    owner = np.concatenate([a.owner, np.full((more, a.owner.shape[1]), -1, np.int32)])
    longer: Any = owner
    return replace(a, frames=grown, owner=longer)


@partial(jax.jit, static_argnames=("static", "gradient", "attract", "settle"))
def _bend(
    a: Arrangement,
    v: Variables,
    solving: Solving,
    static: Static,
    gradient: str,
    attract: tuple[bool, bool],
    settle: int,
) -> tuple[Array, Array, Array, Array]:
    """Rotations (F, J, 4), translations (F, T, 3), distances and soundness (F,)."""
    tasks, frames = frames_of(a, v)
    still = jnp.eye(4, 1, dtype=frames.root.dtype)
    q, t = frames.rotations[0], frames.root[0]
    pose = Pose(
        jnp.where(jnp.isfinite(q).all(0), q, still)[..., None],
        jnp.where(jnp.isfinite(t), t, jnp.zeros_like(t))[:, None],
    )
    first = Carried(pose, pose, jnp.ones(static.layers, t.dtype), jnp.ones((), t.dtype))
    asked = Asked(a.chain, tasks, frames, first)
    unrolled = gradient == "unrolled"
    given = asked if unrolled else jax.lax.stop_gradient(asked)
    solved = solve_sequence(
        given.chain, given.tasks, given.frames, given.first, solving, static.layers, static.kinds, attract,
        stored if unrolled else plain,
    )[1]  # fmt: skip
    found = Poses(solved.rotations, solved.root)
    drawn = jnp.asarray(float(attract[0]), t.dtype), jnp.asarray(float(attract[1]), t.dtype)
    numbers = Numbers(jnp.asarray(solving.drag), jnp.asarray(solving.singular), drawn)
    if settle:
        found = settled(asked, numbers, found, solved.sound, static, settle)
    if not unrolled:
        found = attach(asked, numbers, jax.lax.stop_gradient((found, solved.sound)), static)
    left = distance(asked, numbers, found, solved.sound, static)
    n = len(a.kept)
    kept = np.array(a.kept, np.int32)
    rotations = v.rotations.at[:, kept].set(jnp.moveaxis(found.rotations[:, :, :n], 1, 2))
    translations = v.translations
    if a.root_path >= 0:
        translations = translations.at[:, a.root_path].set(found.root + a.origin)
    return rotations, translations, left, solved.sound
