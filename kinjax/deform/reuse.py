"""Which frames a change of constraints leaves as they were.

In: two plans over the same motion. Out: for every frame, whether the same is asked of it in both.
"""

from __future__ import annotations

import hashlib

import numpy as np

from .plan import Plan
from .tasks import ORIENTATION


def alike(plan: Plan, old: Plan) -> np.ndarray:
    """(F,) the frames of which the same is asked in both plans; none, where they are for clips of other lengths."""
    ours, theirs = signatures(plan), signatures(old)
    if len(ours) != len(theirs):
        return np.zeros(len(ours), bool)
    return np.array([a == b for a, b in zip(ours, theirs, strict=True)])


def signatures(plan: Plan) -> list[bytes]:
    """A digest of what is asked in each frame: the active constraints in order of priority, with their targets, whatever else
    is in the plan and wherever its joints are in the chain."""
    tasks, goals = plan.tasks, plan.frames.goals
    names = np.append(plan.kept, -np.ones(len(plan.chain.parents) + 1 - len(plan.kept), int))
    count = max(plan.slot, default=-1) + 1
    fixed = []
    for b in range(count):
        used = sorted(int(names[j]) for j in np.flatnonzero(tasks.recruits[b]))
        at = list(tasks.centers).index(b) if b in tasks.centers else -1
        parts = (
            tasks.kind[b], names[tasks.joint[b]], names[tasks.reference[b]], tasks.point[b], tasks.look[b], tasks.scale[b],
            np.array(used), tasks.root_recruited[b],
        )  # fmt: skip
        mass = b"" if at < 0 else np.sort(tasks.weights[at][tasks.weights[at] != 0]).tobytes()
        fixed.append(b"|".join(np.asarray(x).tobytes() for x in parts) + mass)
    out = []
    for f in range(len(plan.frames.root)):
        digest = hashlib.blake2b(digest_size=16)
        last: int = -1
        for b in map(int, np.flatnonzero(goals.active[f, :count])):
            digest.update(b"same" if tasks.layer[b] == last else b"next")
            last = int(tasks.layer[b])
            digest.update(fixed[b])
            digest.update((goals.rotation if tasks.kind[b] == ORIENTATION else goals.place)[f, b].tobytes())
        out.append(digest.digest())
    return out
