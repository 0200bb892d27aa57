"""How well a motion serves its constraints: measured on the motion itself, whatever solver made it.

In: a motion, the plan, and what the solver says of each frame. Out: a `Report`. Residuals are computed anew from the final
motion by its own kinematics, on the host.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from ..motion import Motion
from ..quaternions import inverse, known, multiply, turns
from .body import Body
from .plan import Plan
from .results import CONFLICT, CONVERGED, FREE, MAX_ITER, NONFINITE, STALLED, UNREACHABLE, Report
from .settings import Settings
from .tasks import CENTER_OF_MASS, LOOK_AT, ORIENTATION, RADIAN

BLOCKED = 0.03
"""A constraint whose residual is so nearly at right angles to all that its joints can do (cosine) is out of reach."""


def residual_table(motion: Motion, plan: Plan) -> Float[np.ndarray, "f b"]:
    """Distance (m) or angle (rad) that each of the plan's constraints, in the plan's order, is off; NaN where not active."""
    body = Body(motion, plan.origin)
    tasks, goals = plan.tasks, plan.frames.goals
    out = np.full((motion.frames, len(plan.order)), np.nan)
    for k, b in enumerate(plan.slot):
        joint = int(plan.kept[tasks.joint[b]])
        world = tasks.reference[b] == len(plan.chain.parents)
        back = None if world else turns(body.turn(int(plan.kept[tasks.reference[b]]))).inv()
        origin = 0.0 if world else body.place(int(plan.kept[tasks.reference[b]]))
        axes = tasks.scale[b] > 0
        seen = turns(body.turn(joint))
        if tasks.kind[b] == ORIENTATION:
            own = seen if back is None else back * seen
            goal = turns(goals.rotation[:, b])
            off = (goal * own.inv()).as_rotvec() * axes
            value = np.linalg.norm(off, axis=1)
        else:
            point = (
                _center(body, plan, b)
                if tasks.kind[b] == CENTER_OF_MASS
                else body.place(joint) + seen.apply(tasks.point[b])
            )
            place = point - origin if back is None else back.apply(point - origin)
            away = goals.place[:, b] - place
            if tasks.kind[b] == LOOK_AT:
                along = seen.apply(tasks.look[b])
                along = along if back is None else back.apply(along)
                value = np.arctan2(np.linalg.norm(np.cross(along, away), axis=1), (along * away).sum(1))
            else:
                value = np.linalg.norm(away * axes, axis=1)
        lost = body.lost(joint) | ~np.isfinite(goals.place[:, b]).all(1) | ~np.isfinite(goals.rotation[:, b]).all(1)
        out[:, k] = np.where(plan.active[:, k] & ~lost, value, np.nan)
    return out


def _center(body: Body, plan: Plan, b: int) -> np.ndarray:
    """Centre of mass of the whole body, less the barycentre of the supports where there are some."""
    center = body.center()
    d = list(plan.tasks.centers).index(b)
    weights = plan.tasks.weights[d]
    for m in np.flatnonzero(weights < 0):
        center = center + weights[m] * body.place(int(plan.kept[plan.tasks.mass_joint[m]]))
    return center


def status_table(residual: np.ndarray, plan: Plan, solved: Any, settings: Settings) -> np.ndarray:
    """(F, B) indices into `STATUSES`, in the plan's order."""
    slot = list(plan.slot)
    active = plan.active
    held = np.array([settings.held / (RADIAN if k in (ORIENTATION, LOOK_AT) else 1.0) for k in plan.tasks.kind[slot]])
    layer = plan.tasks.layer[slot]
    why = np.where(solved.stayed[:, None] | (solved.iterations[:, None] < settings.iterations), STALLED, MAX_ITER)
    why = np.broadcast_to(why, active.shape)
    blocked = solved.own[:, layer] < BLOCKED
    why = np.where(blocked, CONFLICT, why)
    why = np.where(solved.solo[:, slot] < BLOCKED, UNREACHABLE, why)
    status = np.where(residual <= held, CONVERGED, why)
    status = np.where(np.isfinite(residual) & solved.sound[:, None], status, NONFINITE)
    return np.where(active, status, FREE).astype(int)


def make_report(before: Motion, after: Motion, plan: Plan, solved: Any, settings: Settings, passes: int) -> Report:
    """The report of a finished deformation, in the order in which the caller gave the constraints."""
    table = residual_table(after, plan)
    status = status_table(table, plan, solved, settings)
    f, b = len(table), len(plan.titles)
    residual, code = np.full((f, b), np.nan), np.zeros((f, b), int)
    residual[:, list(plan.order)] = table
    code[:, list(plan.order)] = status
    change = _changes(np.asarray(before.rotations, float), np.asarray(after.rotations, float))
    top = before.skeleton.topology
    root = top.translated.index(int(plan.kept[0])) if len(plan.kept) and int(plan.kept[0]) in top.translated else 0
    moved = np.linalg.norm(
        np.asarray(after.translations, float)[:, root] - np.asarray(before.translations, float)[:, root], axis=1
    )
    return Report(
        titles=plan.titles,
        unit=tuple(plan.units),
        layer=plan.layer,
        residual=residual,
        status=code,
        rank=solved.rank,
        iterations=solved.iterations,
        joints=before.skeleton.names,
        change=change,
        root_change=moved,
        passes=passes,
        notes=plan.notes,
    )


def _changes(q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """(F, J) angles between two motions' rotations; NaN where one is not finite. Most joints are the same, bit for bit."""
    out = np.zeros(q0.shape[:2])
    some = (q0 != q1).any((0, 2))  # true of NaN, too
    a, b = q0[:, some], q1[:, some]
    finite = np.isfinite(a).all(-1) & np.isfinite(b).all(-1)
    turn = multiply(known(b), inverse(known(a)))
    angle = 2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    out[:, some] = np.where(finite, angle, np.nan)
    return out
