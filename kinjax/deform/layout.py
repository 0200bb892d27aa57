"""Resolved constraints laid out as the arrays that the solver runs on, padded so that edits of one kind share one program.

In: `Asked` of the constraints in use, in order of priority, and the `Body`. Out: `Chain`, `Tasks` and `Frames` of NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..errors import OptionError
from ..motion import Motion
from ..skeleton import Topology
from .body import Body
from .chain import Chain
from .recruiting import chain_of
from .resolving import Asked
from .sequence import Frames
from .tasks import CENTER_OF_MASS, ORIENTATION, Goals, Tasks

SIZES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32)
"""Counts of tasks that programs are compiled for; above them, multiples of eight."""


def kept_joints(asked: Sequence[Asked], top: Topology) -> list[int]:
    """The joints that constraints see or move, with all their ancestors, in the skeleton's order."""
    seeds: set[int] = {0} if not asked else set()
    for a in asked:
        seeds |= {a.joint, *a.recruits, *a.support} | ({a.reference} if a.reference >= 0 else set())
    kept = sorted({j for s in seeds for j in chain_of(top, s)})
    roots = [j for j in kept if top.parents[j] < 0]
    if len(roots) > 1:
        raise OptionError(
            f"constraints on the trees of {' and '.join(top.names[r] for r in roots)}: one tree at a time can be deformed"
        )
    return kept


def pruned_chain(kept: list[int], motion: Motion) -> tuple[Any, dict[int, int]]:
    """The pruned chain, padded to a multiple of four joints, and the place of each skeleton joint in it."""
    top = motion.skeleton.topology
    new = {j: i for i, j in enumerate(kept)}
    p = _padded(len(kept), 4)
    parents = np.full(p, -1, np.int32)
    above = np.eye(p)
    for j, i in new.items():
        parents[i] = new.get(top.parents[j], -1)
        for a in chain_of(top, j):
            above[i, new[a]] = 1
    limits = None
    if motion.skeleton.limits is not None:
        limits = np.tile(np.array([-np.pi, np.pi]) * 4, (p, 3, 1))
        limits[: len(kept)] = np.asarray(motion.skeleton.limits, float)[kept]
    return _laid(Chain, parents, above, limits), new


def slots(asked: Sequence[Asked], layer: Sequence[int]) -> tuple[int, ...]:
    """The task that serves each constraint: one of its kind that is not active when it is, or a new one."""
    taken: list[tuple[object, np.ndarray]] = []
    slot = []
    for a, i in zip(asked, layer, strict=True):
        own = tuple(x.tobytes() for x in (a.point, a.look, a.axes))
        key = (i, a.kind, a.joint, a.reference, a.recruits, a.support, a.goal.weight, own)
        at = next(
            (k for k, (other, busy) in enumerate(taken) if other == key and not (busy & a.path.active).any()),
            len(taken),
        )
        if at == len(taken):
            taken.append((key, np.zeros_like(a.path.active)))
        taken[at] = key, taken[at][1] | a.path.active
        slot.append(at)
    return tuple(slot)


def laid_out(
    asked: Sequence[Asked],
    layer: Sequence[int],
    slot: Sequence[int],
    count: int,
    chain: Any,
    new: dict[int, int],
    body: Body,
) -> tuple[Any, Any]:
    """Tasks and frames, padded: tasks to one of `SIZES`, mass points to a multiple of four.

    layer, slot: of each constraint; count: of layers; chain, new: of `pruned_chain`.
    """
    f, p, n = body.frames, len(chain.parents), max(slot, default=-1) + 1
    b = next((s for s in SIZES if s >= n), _padded(n, 8))
    kind, joint = np.zeros(b, np.int32), np.zeros(b, np.int32)
    reference, layers = np.full(b, p, np.int32), np.full(b, count - 1, np.int32)
    point, scale, look = np.zeros((b, 3)), np.zeros((b, 3)), np.tile([0.0, 0, 1], (b, 1))
    recruits, root, above, beside = np.zeros((b, p)), np.zeros(b), np.zeros((b, p)), np.zeros((b, p))
    active, place, rotation = np.zeros((f, b)), np.zeros((f, b, 3)), np.tile([1.0, 0, 0, 0], (f, b, 1))
    centers: dict[int, Asked] = {}
    for a, own, i in zip(asked, layer, slot, strict=True):
        kind[i], joint[i], layers[i], point[i], look[i] = a.kind, new[a.joint], own, a.point, a.look
        scale[i] = a.axes * np.sqrt(a.goal.weight)
        recruits[i, [new[j] for j in a.recruits]] = 1
        root[i] = float(any(body.top.parents[j] < 0 for j in a.recruits))
        above[i] = chain.above[new[a.joint]]
        if a.reference >= 0:
            reference[i], beside[i] = new[a.reference], chain.above[new[a.reference]]
        on = a.path.active
        active[on, i] = 1
        (rotation if a.kind == ORIENTATION else place)[on, i] = a.path.goal[on]
        if a.kind == CENTER_OF_MASS:
            centers[i] = a
    mass_joint, mass_point, weights = _mass_points(list(centers.values()), new, p, body)
    moves = np.concatenate([chain.above, np.zeros((1, p))])  # no joint moves what is in the world
    carried = weights[:, None, :] * moves[mass_joint].T[None]
    tasks = _laid(
        Tasks,
        kind, joint, reference, point, look, scale, layers, recruits, root, above, beside,
        np.array(list(centers), np.int32), mass_joint, weights, carried,
    )  # fmt: skip
    used = np.einsum("fb,bp->fp", active, recruits) > 0
    used_root = (active @ root) > 0
    goals = _laid(Goals, place, rotation, active, mass_point, np.ones(f))
    return tasks, _frames(list(new), p, body, used, used_root, goals)


def _mass_points(
    asked: Sequence[Asked], new: dict[int, int], world: int, body: Body
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "f m 3"], Float[np.ndarray, "d m"]]:
    """Mass points of the chain: a kept joint carries its own segment's mass and that of every joint below it that is not kept,
    whose pose it takes from the input. What hangs in another root's tree is one more point, on the row `world`. Joints (M,),
    places (F, M, 3) in their frames, weights (D, M)."""
    f, top = body.frames, body.top
    if not asked:
        return np.zeros(0, np.int32), np.zeros((f, 0, 3)), np.zeros((0, 0))
    masses = body.masses
    holder = list(range(len(top.names)))
    for j, parent in enumerate(top.parents):
        if j not in new:
            holder[j] = holder[parent] if parent >= 0 else -1
    n = len(new)
    support = sorted({j for a in asked for j in a.support})
    carriers = [j for j, fraction in enumerate(masses.fractions) if fraction > 0]
    beside = n + len(support)  # the place of the point in the world
    m = _padded(beside + any(holder[j] < 0 for j in carriers), 4)
    total, moment = np.zeros(m), np.zeros((f, m, 3))
    for j in carriers:
        fraction, at = masses.fractions[j], beside if holder[j] < 0 else new[holder[j]]
        total[at] += fraction
        moment[:, at] += fraction * body.relative(holder[j])(body.point(j, masses.centers[j]))
    place = np.where(total[None, :, None] > 0, moment / np.where(total > 0, total, 1)[None, :, None], 0.0)
    joint = np.zeros(m, np.int32)
    joint[:n] = np.arange(n)
    joint[n:beside] = [new[j] for j in support]
    if total[beside:].any():
        joint[beside] = world
    weights = np.tile(total, (len(asked), 1))
    for d, a in enumerate(asked):
        for j in a.support:
            weights[d, n + support.index(j)] -= 1 / len(a.support)
    return joint, place, weights


def _frames(kept: list[int], p: int, body: Body, used: np.ndarray, used_root: np.ndarray, goals: Any) -> Any:
    """The input along the chain."""
    f, n = body.frames, len(kept)
    motion, top = body.motion, body.top
    rotation = np.tile(np.array([1.0, 0, 0, 0])[:, None], (f, 1, p))
    rotation[:, :, :n] = np.moveaxis(np.asarray(motion.rotations, float)[:, kept], 1, 2)
    offsets = np.zeros((f, p, 3))
    offsets[:, :n] = np.asarray(motion.skeleton.offsets, float)[kept]
    root = np.zeros((f, 3))
    for k, j in enumerate(top.translated):
        path = np.asarray(motion.translations, float)[:, k]
        if top.parents[j] < 0 and j in kept:
            root = path - body.origin
        elif j in kept:
            offsets[:, kept.index(j)] = path
    return _laid(
        Frames,
        rotation,
        root,
        offsets,
        used.astype(float),
        used_root.astype(float),
        np.ones(f),
        (np.arange(f) > 0).astype(float),
        goals,
    )


def _laid(kind: Any, *arrays: Any) -> Any:
    """A record of the solver's that holds NumPy arrays."""
    return kind(*arrays)


def _padded(n: int, step: int) -> int:
    return -(-n // step) * step
