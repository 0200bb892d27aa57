"""The deformation of a clip, from constraints to a motion and a report.

In: a `Motion`, constraints, `Settings`. Out: `Deformation`. Source: 2004 paper, section 5: every frame is solved from the one
before it; where the displacement map is rough it is low-pass filtered, and the constraints that this violates are enforced
again, in as many passes as it takes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import OptionError, ShapeError
from ..motion import Motion
from ..quaternions import from_turns, turns
from .constraints import Goal
from .filtering import bridged, low_pass, roughness, taps
from .plan import Plan, make_plan
from .reporting import make_report, residual_table
from .results import Deformation
from .reuse import alike
from .settings import Settings
from .solving import Run, solve, solve_many

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Again:
    """What a later edit can start from."""

    settings: Settings
    runs: tuple[Run, ...]


def deform(
    motion: Motion, constraints: Sequence[Goal], settings: Settings | None = None, progress: Progress | None = None
) -> Deformation:
    """Bend `motion` to `constraints`, the more important ones first, changing it as little as they allow.

    motion: one clip (frames, joints, ...). constraints: see `constraints`. progress: called with (frames done, frames in
    all). Raises `KinjaxError`s for what cannot be meant, before anything is compiled; targets out of reach and frames that
    are not finite are no errors but a status in the report.
    """
    return _deform(motion, constraints, settings or Settings(), progress, ())


def redeform(
    previous: Deformation, motion: Motion, constraints: Sequence[Goal], progress: Progress | None = None
) -> Deformation:
    """`deform(motion, constraints)` with the settings of `previous`, the deformation of the same motion by other constraints:
    only frames that the difference can reach are solved again."""
    if not isinstance(previous.again, Again):
        raise ShapeError("the deformation to start from does not hold what it was made of: make it with deform")
    return _deform(motion, constraints, previous.again.settings, progress, previous.again.runs)


def deform_many(
    motions: Sequence[Motion],
    constraints: Sequence[Sequence[Goal]],
    settings: Settings | None = None,
    progress: Progress | None = None,
    together: bool | None = None,
) -> list[Deformation]:
    """`deform` of several clips, each with its own constraints; lengths may differ.

    Clips whose constraints lead to arrays of one shape (as many joints, constraints and layers) share one compiled program.
    together: whether it takes them all at once (`vmap`), frame by frame, or one after another; default: all at once, but not
    on a CPU, where the frame loop of one clip is faster (`benchmarks.deform_speed`). The results are those of `deform`, up to
    rounding. Filtering passes run clip by clip.
    """
    settings = settings or Settings()
    if len(motions) != len(constraints):
        raise OptionError(f"{len(motions)} motions, {len(constraints)} lists of constraints: one list for each motion")
    total, done = sum(m.frames for m in motions), 0

    def tell(n: int) -> None:
        nonlocal done
        done += n
        if progress is not None:
            progress(done, max(total, done))

    out: list[Deformation | None] = [None] * len(motions)
    with jax.enable_x64(settings.precision == "float64"):
        plans = [make_plan(m, tuple(c), settings) for m, c in zip(motions, constraints, strict=True)]
        groups: dict[object, list[int]] = {}
        for i, plan in enumerate(plans):
            groups.setdefault(_shape(plan), []).append(i)
        at_once = jax.default_backend() != "cpu" if together is None else together
        for members in groups.values():
            if at_once:
                solved = solve_many([plans[i] for i in members], settings, tell)
                runs = [Run(plans[i], plans[i].frames, s) for i, s in zip(members, solved, strict=True)]
            else:
                runs = [solve(plans[i], plans[i].frames, settings, tell) for i in members]
            for i, run in zip(members, runs, strict=True):
                out[i] = _finish(motions[i], plans[i], settings, lambda n: None, run, (), None)
    return [d for d in out if d is not None]


def _shape(plan: Plan) -> object:
    arrays = jax.tree.leaves((plan.chain, plan.tasks, jax.tree.map(lambda x: x[0], plan.frames)))
    return plan.layers, plan.kinds, plan.chain.limits is None, tuple(a.shape for a in arrays)


def _deform(
    motion: Motion, constraints: Sequence[Goal], settings: Settings, progress: Progress | None, old: tuple[Run, ...]
) -> Deformation:
    total, done = motion.frames, 0

    def tell(n: int) -> None:
        nonlocal done
        done += n
        if progress is not None:
            progress(done, -(-done // total) * total)

    with jax.enable_x64(settings.precision == "float64"):
        plan = make_plan(motion, constraints, settings)
        same = alike(plan, old[0].plan) if old else None
        first = solve(plan, plan.frames, settings, tell, old[0] if old else None, same)
        return _finish(motion, plan, settings, tell, first, old, same)


def _finish(
    motion: Motion,
    plan: Plan,
    settings: Settings,
    tell: Callable[[int], None],
    first: Run,
    old: tuple[Run, ...],
    same: np.ndarray | None,
) -> Deformation:
    """Filter where the displacement map is rough, enforce the constraints again, and report.

    The second pass holds the root's translation where the filter put it. Where that costs a constraint more than it may,
    a third pass frees it again, from there.
    """
    runs = [first]
    frames = smoothed(plan, first.solved, settings, float(motion.rate)) if settings.passes > 1 else None
    while frames is not None:
        runs.append(solve(plan, frames, settings, tell, old[len(runs)] if len(runs) < len(old) else None, same))
        held = not frames.goals.root_free.all()
        if len(runs) == settings.passes or not held or not _worse(motion, plan, runs, settings):
            break
        last = runs[-1].solved
        free = frames.goals._replace(root_free=np.ones_like(frames.warm))
        frames = frames._replace(rotations=last.rotations.astype(float), root=last.root.astype(float), goals=free)
    result = output_motion(motion, plan, runs[-1].solved)
    report = make_report(motion, result, plan, runs[-1].solved, settings, len(runs))
    return Deformation(result, report, Again(settings, tuple(runs)))


def _worse(motion: Motion, plan: Plan, runs: list[Run], settings: Settings) -> bool:
    """Whether the last pass lost more than a tenth of `settings.held` of any constraint."""
    before, after = (residual_table(output_motion(motion, plan, r.solved), plan) for r in runs[-2:])
    return bool((np.nan_to_num(after) > np.nan_to_num(before) + 0.1 * settings.held).any())


def output_motion(motion: Motion, plan: Plan, solved: Any) -> Motion:
    """The input with the chain's joints and root as solved; whatever was not controlled stays as it is, bit for bit."""
    top = motion.skeleton.topology
    frames, n = plan.frames, len(plan.kept)
    q = np.array(motion.rotations, float)
    new = solved.rotations[:, :, :n]
    changed = (new != frames.rotations[:, :, :n].astype(new.dtype, copy=False)).any(1)[..., None]
    q[:, plan.kept] = np.where(changed, np.moveaxis(new, 1, 2), q[:, plan.kept])
    t = np.array(motion.translations, float)
    root = int(plan.kept[0])
    if root in top.translated:
        k = top.translated.index(root)
        moved = (solved.root != frames.root.astype(solved.root.dtype)).any(1)
        t[:, k] = np.where(moved[:, None], solved.root + plan.origin, t[:, k])
    return replace(motion, translations=t, rotations=q)


def smoothed(plan: Plan, solved: Any, settings: Settings, rate: float) -> Any:
    """The frames of the next pass, which start at the filtered poses and are drawn to them; None when nothing is rough.

    Frames that could not be solved are the input's: for the filter their displacement is that between their neighbours, and they
    stay the input's.
    """
    frames = plan.frames
    root, turned = frames.root, frames.rotations
    lost = ~(solved.sound & np.isfinite(root).all(1) & np.isfinite(turned).all((1, 2)))
    rough = held = False
    if settings.filter_root is not None:
        fir = taps(settings.filter_root, settings.filter_width, rate)
        moved = bridged(solved.root - frames.root, lost)
        if roughness(moved, fir) > settings.rough:
            root, rough, held = frames.root + low_pass(moved, fir), True, True
    if settings.filter_joints is not None:
        fir = taps(settings.filter_joints, settings.filter_width, rate)
        r0, r1 = (turns(np.moveaxis(q, 1, 2)) for q in (frames.rotations, solved.rotations))
        v = bridged((r1 * r0.inv()).as_rotvec().reshape(len(root), -1, 3), lost)
        if roughness(v, fir) > settings.rough:
            q = from_turns(Rotation.from_rotvec(low_pass(v, fir).reshape(-1, 3)) * r0)
            turned, rough = np.moveaxis(q.reshape(len(root), -1, 4), 2, 1), True
    if not rough:
        return None
    if turned is frames.rotations:
        turned = solved.rotations.astype(float)  # the root is filtered alone: joints go on from where they are
    if not held:
        root = solved.root.astype(float)
    root = np.where(lost[:, None], frames.root, root)
    turned = np.where(lost[:, None, None], frames.rotations, turned)
    free = np.zeros_like(frames.warm) if held else np.ones_like(frames.warm)
    goals = frames.goals._replace(root_free=free)
    return frames._replace(rotations=turned, root=root, warm=np.zeros_like(frames.warm), goals=goals)
