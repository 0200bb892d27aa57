"""From constraints and a motion to the arrays that the solver runs on.

In: a `Motion`, constraints, settings. Out: a `Plan`: the pruned chain, the tasks sorted by priority, every frame's goals, all
as NumPy arrays of padded shapes, so that edits of one kind share one compiled program. All errors of structure are raised
here, before anything is compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import OptionError
from ..motion import Motion
from .body import Body
from .constraints import CenterOfMass, Goal, LookAt, Orientation, Position, title
from .layout import kept_joints, laid_out, pruned_chain, slots
from .recruiting import check_rule
from .resolving import check_goal, check_motion, movers, resolved, whole_bodies
from .settings import Settings
from .targets import span_of
from .tasks import LOOK_AT, ORIENTATION, Kinds


@dataclass(frozen=True, eq=False)
class Plan:
    """What the solver runs on: a `Chain`, `Tasks` and `Frames` of NumPy arrays.

    kept: (P',) skeleton indices of the first P' joints of the chain (the rest is padding). order: indices into the caller's
    constraints, of those in use; slot: the task that serves each of them; active: (F, n) when. Constraints of one kind on
    one point that are never active together share a task: a walk has as many tasks as feet, however many steps.
    titles, units, layer: of the caller's constraints; layer -1 where a constraint has weight 0. layers: how many.
    kinds: what the program has to be able to do.
    """

    chain: Any
    tasks: Any
    frames: Any
    kept: Int[np.ndarray, " p"]
    order: tuple[int, ...]
    slot: tuple[int, ...]
    active: Bool[np.ndarray, "f n"]
    titles: tuple[str, ...]
    units: tuple[str, ...]
    layer: tuple[int, ...]
    layers: int
    kinds: Kinds
    origin: Float[np.ndarray, " 3"]
    notes: tuple[str, ...]


def make_plan(motion: Motion, goals: Sequence[Goal], settings: Settings) -> Plan:
    """Check the constraints against the motion and lay them out; raises `KinjaxError`s that name the constraint."""
    check_motion(motion)
    if isinstance(goals, Position | Orientation | LookAt | CenterOfMass):
        raise OptionError(f"a {type(goals).__name__} was given: put constraints in a list")
    body = Body(motion)
    top = body.top
    titles = tuple(title(g, i) for i, g in enumerate(goals))
    for g, t in zip(goals, titles, strict=True):
        check_goal(g, t)
    spans = tuple(span_of(g, t, body.frames, body.rate) for g, t in zip(goals, titles, strict=True))
    asked = [resolved(g, t, s, body) for g, t, s in zip(goals, titles, spans, strict=True)]
    live = [i for i, g in enumerate(goals) if g.weight > 0]
    active = np.array([a.path.active for a in asked]).T.reshape(body.frames, len(goals))
    asked = whole_bodies(goals, asked, body)
    check_rule(
        [titles[i] for i in live],
        [goals[i].priority for i in live],
        [asked[i].recruits for i in live],
        [movers(asked[i], top) for i in live],
        active[:, live],
        top,
    )
    ranks = sorted({goals[i].priority for i in live}, reverse=True)
    if settings.strategy == "weights":
        ranks = ranks[:1]
    layer = [-1] * len(goals)
    for i in live:
        layer[i] = ranks.index(goals[i].priority) if settings.strategy == "priority" else 0
    order = tuple(sorted(live, key=lambda i: layer[i]))
    kept = kept_joints([asked[i] for i in order], top)
    chain, new = pruned_chain(kept, motion)
    count = max(len(ranks), 1)
    used = [asked[i] for i in order]
    own = [layer[i] for i in order]
    slot = slots(used, own)
    tasks, frames = laid_out(used, own, slot, count, chain, new, body)
    kinds = Kinds(
        any(a.kind == ORIENTATION for a in used),
        any(a.kind == LOOK_AT for a in used),
        any(a.reference >= 0 for a in used),
    )
    units = tuple("rad" if isinstance(g, Orientation | LookAt) else "m" for g in goals)
    return Plan(
        chain,
        tasks,
        frames,
        np.array(kept, int),
        order,
        slot,
        active[:, list(order)],
        titles,
        units,
        tuple(layer),
        count,
        kinds,
        body.origin,
        tuple(body.notes),
    )
