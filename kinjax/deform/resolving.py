"""Constraints resolved against a motion: joints, recruits and every frame's goal, and what can be wrong with them.

In: constraints and a `Body`. Out: `Asked`, one for each constraint. Errors name the constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..anthropometry import leg_length
from ..errors import KinjaxError, OptionError, ShapeError, UnknownNameError, find_name
from ..motion import Motion
from ..quaternions import from_turns, known, turns
from ..skeleton import Topology
from .balance import balance_offsets, displacement_path
from .body import Body
from .constraints import CenterOfMass, Goal, LookAt, Orientation, Position, Through
from .recruiting import chain_of, recruited
from .targets import Path, Span, look_path, place_path, turn_path, vector
from .tasks import CENTER_OF_MASS, LOOK_AT, ORIENTATION, POSITION

LIGHT = 0.01
"""Joints that carry a smaller share of the body's mass are not moved for the sake of its centre."""


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


def check_motion(motion: Motion) -> None:
    """`ShapeError` unless it is one clip of at least one frame."""
    if np.ndim(motion.rotations) != 3:
        raise ShapeError(
            f"rotations {np.shape(motion.rotations)}: one clip is (frames, joints, 4); deform_many takes several"
        )
    if motion.frames < 1:
        raise ShapeError("the motion has no frames")


def check_goal(goal: Goal, name: str) -> None:
    """What can be wrong with any constraint, before the motion is looked at."""
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


def resolved(goal: Goal, name: str, span: Span, body: Body) -> Asked:
    """One constraint's joints, path and recruits; `name` comes before the message of every error."""
    return _named(name, _resolved, goal, name, span, body)


def _resolved(goal: Goal, name: str, span: Span, body: Body) -> Asked:
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
    to_ref = body.relative(reference)
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


def _named(name: str, make: Callable[..., Asked], *args: Any) -> Asked:
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


def _from_origin(goal: Position, name: str, span: Span, body: Body, joint: int, point: np.ndarray) -> Path:
    """World targets that the user gave count from the world's origin, the solver's from `body.origin`."""
    path = place_path(goal, name, span, body.point(joint, point) + body.origin, body.rate)
    return Path(path.active, path.goal - body.origin)


def _center_path(
    goal: CenterOfMass, name: str, span: Span, body: Body, to_ref: Callable[[np.ndarray], np.ndarray]
) -> tuple[Path, tuple[int, ...]]:
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


def _in_seconds(goal: CenterOfMass, body: Body) -> Any:
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


def whole_bodies(goals: Sequence[Goal], asked: list[Asked], body: Body) -> list[Asked]:
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


def movers(asked: Asked, top: Topology) -> frozenset[int]:
    """Joints whose turns a constraint feels."""
    if asked.kind == CENTER_OF_MASS:
        return frozenset(range(len(top.names)))
    own = chain_of(top, asked.joint)
    if asked.kind == POSITION and not asked.point.any():
        own = own[1:]
    beside = chain_of(top, asked.reference) if asked.reference >= 0 else []
    return frozenset(own) ^ frozenset(beside)
