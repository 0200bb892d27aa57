"""Where each constraint wants its effector in every frame: paths of places and orientations, and when they are active.

In: one constraint and the effector's path in the input motion (in the frame that the constraint is relative to). Out: `Path`.
Everything that eases is a trajectory (2004 paper, section 5.2): a constraint never switches on at a distance, it takes the
effector from its original trajectory to the goal and back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import OptionError, ShapeError
from ..quaternions import from_turns, turns
from .constraints import Goal, LookAt, Orientation, Position, Through
from .filtering import bridged
from .shape import Pass, orientation_curve, shape_curve

EASE = 0.3
"""Seconds of easing where none is given."""


class Span(NamedTuple):
    """Frames `begin..end`, and `first..last` with the eases around them."""

    begin: int
    end: int
    first: int
    last: int


class Path(NamedTuple):
    """active (F,) bool; goal (F, 3) places or (F, 4) quaternions, meaningless where not active."""

    active: np.ndarray
    goal: np.ndarray


def span_of(goal: Goal, title: str, frames: int, rate: float) -> Span:
    """The frames of a constraint; `OptionError` when they are not inside the clip."""
    begin = _frame(goal.begin, "begin", title)
    end = frames - 1 if goal.end is None else _frame(goal.end, "end", title)
    if not 0 <= begin <= end < frames:
        raise OptionError(f"{title}: frames {begin}..{end} are not inside the clip's 0..{frames - 1}")
    own = getattr(goal, "through", ()) or getattr(goal, "path", None) is not None
    kept = getattr(goal, "at", None) is None and getattr(goal, "offset", None) is None
    eases = []
    for name in ("ease_in", "ease_out"):
        value = getattr(goal, name)
        if value is not None and (own or kept):
            why = "a curve through points has its own" if own else "what keeps its trajectory has nothing to ease"
            raise OptionError(f"{title}: {name} is for at and offset; {why}: leave it out")
        value = (0.0 if own or kept else EASE) if value is None else value
        if not isinstance(value, int | float | np.integer | np.floating) or not np.isfinite(value) or value < 0:
            raise OptionError(f"{title}: {name}={value} is not a number of seconds from 0")
        eases.append(int(np.ceil(value * rate - 1e-9)))
    return Span(begin, end, max(begin - eases[0], 0), min(end + eases[1], frames - 1))


def _frame(value: object, what: str, title: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise OptionError(f"{title}: {what}={value!r} is not a frame number")
    return int(value)


def ramp(span: Span, frames: int) -> np.ndarray:
    """(F,) 1 in `begin..end`, 0 outside `first..last`, and a smooth step (zero velocity and acceleration) between."""
    t = np.arange(frames, dtype=float)
    up = (
        np.clip((t - span.first) / max(span.begin - span.first, 1), 0, 1)
        if span.begin > span.first
        else t >= span.begin
    )
    down = np.clip((span.last - t) / max(span.last - span.end, 1), 0, 1) if span.last > span.end else t <= span.end
    x = np.minimum(up, down).astype(float)
    return x**3 * (10 - 15 * x + 6 * x * x)


def vector(value: object, width: int, what: str, title: str) -> np.ndarray:
    """A finite vector of `width` numbers."""
    try:
        v = np.asarray(value, float)
    except (TypeError, ValueError):
        v = np.empty(0)
    if v.shape != (width,) or not np.isfinite(v).all():
        raise ShapeError(f"{title}: {what}={value!r} must be {width} finite numbers")
    return v


def _path(value: object, span: Span, width: int, title: str) -> np.ndarray:
    try:
        path = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ShapeError(f"{title}: path must be an array of numbers with one row a frame") from None
    want = (span.end - span.begin + 1, width)
    if path.shape != want:
        raise ShapeError(f"{title}: path has shape {path.shape}; frames {span.begin}..{span.end} need {want}")
    if not np.isfinite(path).all():
        raise ShapeError(
            f"{title}: path has numbers that are not finite in its row {int((~np.isfinite(path)).any(1).argmax())}"
        )
    return path


def _one_of(goal: Goal, names: tuple[str, ...], title: str) -> None:
    given = [n for n in names if getattr(goal, n) is not None and (n != "through" or getattr(goal, n))]
    if len(given) > 1:
        raise OptionError(f"{title}: {' and '.join(given)} are given: one of them says where to go")


def _unit(q: np.ndarray, what: str, title: str) -> np.ndarray:
    n = np.linalg.norm(q, axis=-1)
    if np.any(np.abs(n - 1) > 1e-2):
        raise ShapeError(
            f"{title}: {what} must be unit quaternions wxyz; a length of {n.flat[np.abs(n - 1).argmax()]:.4g} was found"
        )
    return q / n[..., None]


def place_path(goal: Position | Goal, title: str, span: Span, own: np.ndarray, rate: float) -> Path:
    """Places (F, 3) for a position or a centre of mass, of which `own` (F, 3) is the original trajectory."""
    _one_of(goal, tuple(n for n in ("at", "through", "path", "offset") if hasattr(goal, n)), title)
    frames = len(own)
    active = _active(span, frames)
    if goal.at is not None:  # type: ignore[union-attr]
        at = vector(goal.at, 3, "at", title)  # type: ignore[union-attr]
        return Path(active, _shaped(span, (Through(span.begin, at, span.end),), own, rate, title))
    if getattr(goal, "through", ()):
        return Path(active, _shaped(span, goal.through, own, rate, title))  # type: ignore[union-attr]
    out = own.copy()
    if getattr(goal, "path", None) is not None:
        out[span.begin : span.end + 1] = _path(goal.path, span, 3, title)  # type: ignore[union-attr]
    elif goal.offset is not None:  # type: ignore[union-attr]
        out += ramp(span, frames)[:, None] * vector(goal.offset, 3, "offset", title)  # type: ignore[union-attr]
    return Path(active, out)


def _active(span: Span, frames: int) -> np.ndarray:
    t = np.arange(frames)
    return (t >= span.first) & (t <= span.last)


def _passes(passes: tuple[Through, ...], span: Span, width: int, rate: float, title: str) -> list[Pass]:
    out = []
    for p in passes:
        first = _frame(p.frame, "frame of a pass", title)
        last = first if p.until is None else _frame(p.until, "until of a pass", title)
        if not span.first <= first <= last <= span.last:
            raise OptionError(
                f"{title}: a pass in frames {first}..{last} is outside the constraint's {span.first}..{span.last}"
            )
        at = vector(p.at, width, "at of a pass", title)
        out.append(
            Pass(
                first / rate,
                last / rate,
                _unit(at, "at of a pass", title) if width == 4 else at,
                p.tension,
                p.continuity,
                p.bias,
            )
        )
    return out


def _shaped(span: Span, passes: tuple[Through, ...], own: np.ndarray, rate: float, title: str) -> np.ndarray:
    """A shape-constraint's places in all frames (section 4.2)."""
    points = _passes(passes, span, 3, rate, title)
    if span.first == span.last:
        return np.broadcast_to(np.asarray(points[0].point, float), own.shape).copy()
    own = _known(own, np.asarray(points[0].point, float))
    speed = np.gradient(own, axis=0) * rate
    a, b = span.first, span.last
    try:
        curve = shape_curve(a / rate, b / rate, own[a], own[b], speed[a], speed[b], points)
    except OptionError as error:
        raise OptionError(f"{title}: {error}") from None
    return curve.position(np.clip(np.arange(len(own)), a, b) / rate)


def _known(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A trajectory with its lost frames bridged (they are flagged by the solver), or at rest at `other` if all are lost."""
    lost = ~np.isfinite(own).all(1)
    if lost.all():
        return np.broadcast_to(other, own.shape)
    return bridged(own, lost)


def turn_path(goal: Orientation, title: str, span: Span, own: np.ndarray, rate: float) -> Path:
    """Orientations (F, 4) for an orientation constraint, of which `own` (F, 4) is the original."""
    _one_of(goal, ("at", "through", "path", "offset"), title)
    frames = len(own)
    active = _active(span, frames)
    if goal.path is not None:
        out = own.copy()
        out[span.begin : span.end + 1] = _unit(_path(goal.path, span, 4, title), "path", title)
        return Path(active, out)
    if goal.offset is not None:
        v = ramp(span, frames)[:, None] * vector(goal.offset, 3, "offset", title)
        return Path(active, from_turns(Rotation.from_rotvec(v) * turns(own)))
    passes = goal.through
    if goal.at is not None:
        passes = (Through(span.begin, _unit(vector(goal.at, 4, "at", title), "at", title), span.end),)
    if not passes:
        return Path(active, own)
    points = _passes(passes, span, 4, rate, title)
    if span.first == span.last:
        return Path(active, np.broadcast_to(np.asarray(points[0].point, float), own.shape).copy())
    a, b = span.first, span.last
    r = turns(own)
    speed = np.zeros((frames, 3))
    speed[:-1] = (r[1:] * r[:-1].inv()).as_rotvec() * rate
    speed[-1] = speed[max(frames - 2, 0)]
    curve = orientation_curve(a / rate, b / rate, own[a], own[b], speed[a], speed[max(b - 1, 0)], points)
    return Path(active, curve.orientation(np.clip(np.arange(frames), a, b) / rate))


def look_path(goal: LookAt, title: str, span: Span, eye: np.ndarray, along: np.ndarray) -> Path:
    """Places looked at (F, 3). eye (F, 3): where the gaze starts; along (F, 3): where it goes in the input."""
    _one_of(goal, ("at", "path"), title)
    if goal.at is None and goal.path is None:
        raise OptionError(f"{title}: at or path says what to look at")
    active = _active(span, len(eye))
    if goal.path is not None:
        out = eye + along
        out[span.begin : span.end + 1] = _path(goal.path, span, 3, title)
        return Path(active, out)
    at = vector(goal.at, 3, "at", title)
    far = np.linalg.norm(at - eye, axis=1, keepdims=True)
    s = ramp(span, len(eye))[:, None]
    return Path(active, s * at + (1 - s) * (eye + far * along))
