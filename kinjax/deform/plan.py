"""From constraints and a motion to the arrays that the solver runs on.

In: a `Motion`, constraints, settings. Out: a `Plan`: the pruned chain, the tasks sorted by priority, every frame's goals, all
as NumPy arrays of padded shapes, so that edits of one kind share one compiled program. All errors of structure are raised
here, before anything is compiled. Places are taken from `origin`, the root's first place, so that precision does not depend
on where in the world the clip plays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..anthropometry import SegmentMasses, leg_length, segment_masses
from ..errors import KinjaxError, OptionError, ShapeError, UnknownNameError, find_name
from ..motion import Motion
from ..quaternions import from_turns, known, multiply, rotate, turns
from ..skeleton import Topology
from .balance import balance_offsets, displacement_path
from .chain import Chain
from .constraints import CenterOfMass, Goal, LookAt, Orientation, Position, Through, title
from .recruiting import chain_of, check_rule, recruited
from .sequence import Frames
from .settings import Settings
from .targets import Path, Span, look_path, place_path, span_of, turn_path, vector
from .tasks import CENTER_OF_MASS, LOOK_AT, ORIENTATION, POSITION, Goals, Kinds, Tasks


@dataclass(frozen=True, eq=False)
class Plan:
    """What the solver runs on: a `Chain`, `Tasks` and `Frames` of NumPy arrays.

    kept: (P',) skeleton indices of the first P' joints of the chain (the rest is padding). order: indices into the caller's
    constraints, of those in use; slot: the task that serves each of them; active: (F, n) when. Constraints of one kind on
    one point that are never active together share a task: a walk has as many tasks as feet, however many steps.
    titles, units, layer, spans: of the caller's constraints; layer -1 where a constraint has weight 0. layers: how many.
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
    spans: tuple[Span, ...]
    layers: int
    kinds: Kinds
    origin: Float[np.ndarray, " 3"]
    notes: tuple[str, ...]


class Body:
    """A motion in the world, less `origin`, and what constraints look up in it.

    Joints are placed when they are asked for, in NumPy: nothing has to be compiled for it, and it is float64 whatever JAX is
    set to.
    """

    def __init__(self, motion: Motion, origin: np.ndarray | None = None):
        self.motion, self.top = motion, motion.skeleton.topology
        self.rate, self.frames = float(motion.rate), motion.frames
        if origin is None:
            root = np.asarray(motion.translations, float)[:, 0]
            finite = np.isfinite(root).all(1)
            origin = root[finite.argmax()].copy() if finite.any() else np.zeros(3)
        self.origin = origin
        self.notes: list[str] = []
        self._masses: SegmentMasses | None = None
        self._world: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _at(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """World quaternions (F, 4) and places (F, 3) of a joint."""
        missing = [j for j in chain_of(self.top, joint) if j not in self._world]
        for j in reversed(missing):
            q = np.asarray(self.motion.rotations[:, j], float)
            if j in self.top.translated:
                own = np.asarray(self.motion.translations[:, self.top.translated.index(j)], float)
            else:
                own = np.asarray(self.motion.skeleton.offsets[j], float)
            if self.top.parents[j] < 0:
                self._world[j] = q, np.broadcast_to(own - self.origin, (self.frames, 3))
            else:
                up, place = self._world[self.top.parents[j]]
                self._world[j] = multiply(up, q), place + rotate(up, own)
        return self._world[joint]

    def turn(self, joint: int) -> np.ndarray:
        """World quaternions (F, 4) of a joint."""
        return self._at(joint)[0]

    def place(self, joint: int) -> np.ndarray:
        """World places (F, 3) of a joint, less the origin."""
        return self._at(joint)[1]

    @property
    def rotation(self) -> np.ndarray:
        """World quaternions (F, J, 4) of all joints."""
        return np.stack([self.turn(j) for j in range(len(self.top.names))], axis=1)

    @property
    def position(self) -> np.ndarray:
        """World places (F, J, 3) of all joints, less the origin."""
        return np.stack([self.place(j) for j in range(len(self.top.names))], axis=1)

    def lost(self, joint: int) -> np.ndarray:
        """(F,) where a joint's pose is not finite."""
        q, p = self._at(joint)
        return ~(np.isfinite(q).all(1) & np.isfinite(p).all(1))

    @property
    def masses(self) -> SegmentMasses:
        """Mass fractions (J,) and centres (J, 3) of the joints' segments."""
        if self._masses is None:
            self._masses = segment_masses(self.motion.skeleton)
            self.notes += [n for n in self._masses.notes if n not in self.notes]
        return self._masses

    def point(self, joint: int, local: np.ndarray) -> np.ndarray:
        """World path (F, 3) of a point of a joint."""
        q, p = self._at(joint)
        return p + rotate(q, np.asarray(local, float)) if np.any(local) else p

    def center(self) -> np.ndarray:
        """World path (F, 3) of the centre of mass."""
        m = self.masses
        parts = [f * self.point(j, c) for j, (f, c) in enumerate(zip(m.fractions, m.centers, strict=True)) if f > 0]
        return np.sum(parts, axis=0)


def make_plan(motion: Motion, goals: Sequence[Goal], settings: Settings) -> Plan:
    """Check the constraints against the motion and lay them out; raises `KinjaxError`s that name the constraint."""
    _check_motion(motion)
    if isinstance(goals, Position | Orientation | LookAt | CenterOfMass):
        raise OptionError(f"a {type(goals).__name__} was given: put constraints in a list")
    body = Body(motion)
    top = body.top
    titles = tuple(title(g, i) for i, g in enumerate(goals))
    for g, t in zip(goals, titles, strict=True):
        _check_common(g, t)
    spans = tuple(span_of(g, t, body.frames, body.rate) for g, t in zip(goals, titles, strict=True))
    asked = [_named(t, _task, g, t, s, body) for g, t, s in zip(goals, titles, spans, strict=True)]
    live = [i for i, g in enumerate(goals) if g.weight > 0]
    active = np.array([a.path.active for a in asked]).T.reshape(body.frames, len(goals))
    asked = _whole_bodies(goals, asked, body)
    check_rule(
        [titles[i] for i in live],
        [goals[i].priority for i in live],
        [asked[i].recruits for i in live],
        [_movers(asked[i], top) for i in live],
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
    kept = _kept([asked[i] for i in order], top)
    chain, new = _chain(kept, motion)
    count = max(len(ranks), 1)
    used = [asked[i] for i in order]
    own = [layer[i] for i in order]
    slot = _slots(used, own)
    tasks, frames = _arrays(used, own, slot, count, kept, new, chain, body)
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
        spans,
        count,
        kinds,
        body.origin,
        tuple(body.notes),
    )


@dataclass(frozen=True, eq=False)
class Asked:
    """One constraint, resolved against the skeleton."""

    kind: int
    goal: Goal
    joint: int
    reference: int
    recruits: frozenset[int]
    point: np.ndarray
    look: np.ndarray
    axes: np.ndarray
    path: Path
    support: tuple[int, ...] = ()


LIGHT = 0.01
"""Joints that carry a smaller share of the body's mass are not moved for the sake of its centre."""


def _whole_bodies(goals: Sequence[Goal], asked: list[Asked], body: Body) -> list[Asked]:
    """Centres of mass that name no joints recruit the whole body: every joint that carries a share of its mass worth moving,
    and, since these move the centre too, every joint that another constraint recruits."""
    if not any(isinstance(g, CenterOfMass) and g.recruits is None for g in goals):
        return asked
    carried = np.array(body.masses.fractions, float)
    for j in range(len(carried) - 1, 0, -1):
        if body.top.parents[j] >= 0:
            carried[body.top.parents[j]] += carried[j]
    whole = frozenset(int(j) for j in np.flatnonzero(carried >= LIGHT))
    named = [
        a.recruits
        for g, a in zip(goals, asked, strict=True)
        if not isinstance(g, CenterOfMass) or g.recruits is not None
    ]
    whole = whole.union(*named)
    return [
        replace(a, recruits=whole) if isinstance(g, CenterOfMass) and g.recruits is None else a
        for g, a in zip(goals, asked, strict=True)
    ]


def _movers(asked: Asked, top: Topology) -> frozenset[int]:
    """Joints whose turns a constraint feels."""
    if asked.kind == CENTER_OF_MASS:
        return frozenset(range(len(top.names)))
    own = chain_of(top, asked.joint)
    if asked.kind == POSITION and not asked.point.any():
        own = own[1:]
    beside = chain_of(top, asked.reference) if asked.reference >= 0 else []
    return frozenset(own) ^ frozenset(beside)


def _check_motion(motion: Motion) -> None:
    if np.ndim(motion.rotations) != 3:
        raise ShapeError(
            f"rotations {np.shape(motion.rotations)}: one clip is (frames, joints, 4); deform_many takes several"
        )
    if motion.frames < 1:
        raise ShapeError("the motion has no frames")


def _check_common(goal: Goal, name: str) -> None:
    if not isinstance(goal, Position | Orientation | LookAt | CenterOfMass):
        raise OptionError(f"{name}: a {type(goal).__name__} is no constraint")
    for what in ("priority", "weight"):
        value = getattr(goal, what)
        number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
        if not number or not np.isfinite(value):
            raise OptionError(f"{name}: {what}={value!r} is not a finite number")
    for what in ("recruits", "support"):
        if isinstance(getattr(goal, what, None), str):
            raise OptionError(f"{name}: {what}={getattr(goal, what)!r} is one name: give a tuple of names")
    through = getattr(goal, "through", ())
    if not isinstance(through, tuple | list) or any(not isinstance(t, Through) for t in through):
        raise OptionError(f"{name}: through={through!r} must be a tuple of Through")
    if goal.weight < 0:
        raise OptionError(f"{name}: weight={goal.weight} is negative; 0 switches a constraint off")


def _named(name, make, *args):
    """`make(*args)`, with the constraint's name before the message of what it raises."""
    try:
        return make(*args)
    except UnknownNameError as error:
        error.args = (f"{name}: {error}",)
        raise
    except KinjaxError as error:
        if not str(error).startswith(name):
            error.args = (f"{name}: {error}",)
        raise


def _task(goal: Goal, name: str, span: Span, body: Body) -> Asked:
    """One constraint's joints, path and recruits."""
    top = body.top
    joint = 0 if isinstance(goal, CenterOfMass) else find_name(goal.joint, top.names, "joint")
    reference = -1 if goal.relative_to is None else find_name(goal.relative_to, top.names, "joint")
    if reference == joint and not isinstance(goal, CenterOfMass):
        raise OptionError(f"{name}: {top.names[joint]} cannot be relative to itself")
    recruits = recruited(goal, top, name)
    axes = _axes(goal, name)
    point = vector(getattr(goal, "point", (0, 0, 0)), 3, "point", name)
    look = np.array([0.0, 0, 1])
    support: tuple[int, ...] = ()
    to_ref = _relative(body, reference)
    if isinstance(goal, CenterOfMass):
        kind = CENTER_OF_MASS
        path, support = _center_path(goal, name, span, body, to_ref)
    elif isinstance(goal, Position):
        kind, path = POSITION, place_path(goal, name, span, to_ref(body.point(joint, point)), body.rate)
        if reference < 0 and (goal.at is not None or goal.through or goal.path is not None):
            path = _from_origin(goal, name, span, body, joint, point)
    elif isinstance(goal, Orientation):
        own = known(body.turn(joint))
        if reference >= 0:
            own = from_turns(turns(body.turn(reference)).inv() * turns(own))
        kind, path = ORIENTATION, turn_path(goal, name, span, own, body.rate)
        path.goal[body.lost(joint)] = np.nan
    else:
        kind = LOOK_AT
        look = vector(goal.axis, 3, "axis", name)
        length = np.linalg.norm(look)
        if length < 1e-9:
            raise ShapeError(f"{name}: axis is zero")
        look = look / length
        eye = body.point(joint, point)
        tip = body.point(joint, point + look)
        world = body.origin if reference < 0 else np.zeros(3)
        path = look_path(goal, name, span, to_ref(eye) + world, to_ref(tip) - to_ref(eye))
        path = Path(path.active, path.goal - world)
    return Asked(kind, goal, joint, reference, recruits, point, look, axes, path, support)


def _relative(body: Body, reference: int):
    """World paths (F, 3) as seen from the reference joint's moving frame."""
    if reference < 0:
        return lambda x: x
    back = turns(body.turn(reference)).inv()
    return lambda x: back.apply(x - body.place(reference))


def _from_origin(goal: Position, name: str, span: Span, body: Body, joint: int, point: np.ndarray) -> Path:
    """World targets that the user gave count from the world's origin, the solver's from `body.origin`."""
    path = place_path(goal, name, span, body.point(joint, point) + body.origin, body.rate)
    return Path(path.active, path.goal - body.origin)


def _center_path(goal: CenterOfMass, name: str, span: Span, body: Body, to_ref) -> tuple[Path, tuple[int, ...]]:
    """Where the centre of mass belongs; with supports, relative to their barycentre."""
    own = body.center()
    extra = 0.0 if goal.displacement is None else displacement_path(_in_seconds(goal, body), body.frames, body.rate)
    if not goal.support:
        world = 0.0 if goal.relative_to is not None else body.origin
        path = place_path(goal, name, span, to_ref(own) + world, body.rate)
        return Path(path.active, path.goal - world + extra), ()
    if goal.relative_to is not None or goal.at is not None or goal.offset is not None:
        raise OptionError(f"{name}: support already says relative to what: leave at, offset and relative_to out")
    support = tuple(find_name(n, body.top.names, "joint") for n in goal.support)
    base = np.stack([body.place(j) for j in support], axis=1)
    output = leg_length(body.motion.skeleton)
    offsets = balance_offsets(own, base, goal.leg_length if goal.leg_length is not None else output, output)
    path = place_path(Position("", begin=goal.begin, end=goal.end), name, span, offsets + extra, body.rate)
    return path, support


def _in_seconds(goal: CenterOfMass, body: Body):
    """The displacement with its key frames, if it has any, as times."""
    keys: Any = goal.displacement
    if not isinstance(keys, np.ndarray) and (np.ndim(keys) == 0 if np.isscalar(keys) else not len(keys)):
        raise OptionError(
            f"displacement={keys!r}: three numbers, one row a frame, or (frame, three numbers) are needed"
        )
    if isinstance(keys, np.ndarray) or np.isscalar(keys[0]):
        return keys
    return [(k[0] / body.rate, k[1]) for k in keys] if np.ndim(keys[0][1]) else keys


def _axes(goal: Goal, name: str) -> np.ndarray:
    axes = getattr(goal, "axes", "xyz")
    if not axes or set(axes) - set("xyz") or len(set(axes)) != len(axes):
        raise OptionError(f"{name}: axes={axes!r}: some of x, y and z, each once")
    return np.array([float(a in axes) for a in "xyz"])


def _kept(asked: Sequence[Asked], top: Topology) -> list[int]:
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


def _laid(kind: Any, *arrays: Any) -> Any:
    """A record of the solver's that holds NumPy arrays."""
    return kind(*arrays)


def _padded(n: int, step: int) -> int:
    return -(-n // step) * step


def _chain(kept: list[int], motion: Motion) -> tuple[Any, dict[int, int]]:
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


SIZES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32)


def _slots(asked: Sequence[Asked], layer: Sequence[int]) -> tuple[int, ...]:
    """The task that serves each constraint: one of its kind that is not active when it is, or a new one."""
    taken: list[tuple[object, np.ndarray]] = []
    slot = []
    for a, i in zip(asked, layer, strict=True):
        arrays = tuple(x.tobytes() for x in (a.point, a.look, a.axes))
        key = (i, a.kind, a.joint, a.reference, a.recruits, a.support, a.goal.weight, arrays)
        at = next(
            (k for k, (other, busy) in enumerate(taken) if other == key and not (busy & a.path.active).any()),
            len(taken),
        )
        if at == len(taken):
            taken.append((key, np.zeros_like(a.path.active)))
        taken[at] = key, taken[at][1] | a.path.active
        slot.append(at)
    return tuple(slot)


def _arrays(asked, layer, slot, count, kept, new, chain, body) -> tuple[Any, Any]:
    """Tasks and frames, padded: tasks to one of `SIZES`, mass points to a multiple of four."""
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
    mass_joint, mass_point, weights = _mass_points(list(centers.values()), kept, new, body)
    carried = weights[:, None, :] * chain.above[mass_joint].T[None]
    tasks = _laid(
        Tasks,
        kind, joint, reference, point, look, scale, layers, recruits, root, above, beside,
        np.array(list(centers), np.int32), mass_joint, weights, carried,
    )  # fmt: skip
    used = np.einsum("fb,bp->fp", active, recruits) > 0
    used_root = (active @ root) > 0
    return tasks, _frames(kept, p, body, used, used_root, _laid(Goals, place, rotation, active, mass_point, np.ones(f)))


def _mass_points(asked, kept, new, body):
    """Mass points of the chain: a kept joint carries its own segment's mass and that of every joint below it that is not kept,
    whose pose it takes from the input. Joints (M,), places (F, M, 3) in their frames, weights (D, M)."""
    f, top = body.frames, body.top
    if not asked:
        return np.zeros(0, np.int32), np.zeros((f, 0, 3)), np.zeros((0, 0))
    masses = body.masses
    holder = list(range(len(top.names)))
    for j, parent in enumerate(top.parents):
        if j not in new:
            holder[j] = holder[parent] if parent >= 0 else -1
    n = len(kept)
    support = sorted({j for a in asked for j in a.support})
    m = _padded(n + len(support), 4)
    total, moment = np.zeros(m), np.zeros((f, m, 3))
    for j, (fraction, center) in enumerate(zip(masses.fractions, masses.centers, strict=True)):
        if fraction > 0 and holder[j] >= 0:
            to_holder = _relative(body, holder[j])
            total[new[holder[j]]] += fraction
            moment[:, new[holder[j]]] += fraction * to_holder(body.point(j, center))
    place = np.where(total[None, :, None] > 0, moment / np.where(total > 0, total, 1)[None, :, None], 0.0)
    joint = np.zeros(m, np.int32)
    joint[:n] = np.arange(n)
    joint[n : n + len(support)] = [new[j] for j in support]
    weights = np.tile(total, (len(asked), 1))
    for d, a in enumerate(asked):
        for j in a.support:
            weights[d, n + support.index(j)] -= 1 / len(a.support)
    return joint, place, weights


def _frames(kept, p, body, used, used_root, goals) -> Any:
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
