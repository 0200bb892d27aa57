"""Shape-constraints: where an effector has to pass and when, as a trajectory and its timing (2004 paper, section 4.2).

In: a span of time, where the effector is and how fast it moves at both ends of it in the input motion, and the points that
it has to pass. Out: `ShapeCurve`, a pair of curves: `S(u)` in space, a Kochanek-Bartels spline, and `T(t)` in time,
increasing and piecewise linear; the effector belongs at `S(T(t))` (eq. 3). `OrientationCurve` is the same for rotations.
`u` is time with the rests taken out: `T` is constant while the effector rests and has slope 1 elsewhere, so that a curve
without rests is as smooth in time as it is in space. Times are seconds on the clip's own clock; host NumPy, float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ..errors import OptionError, ShapeError
from .kochanek_bartels import curve_weights, one_hemisphere, rotation_curve, rotation_legs, tangent_weights

Times = Float[np.ndarray, " n"]
_SAME = 1e-9  # seconds; times nearer than this are the same instant


@dataclass(frozen=True)
class Pass:
    """A point that the effector has to pass: there from `first` to `last` seconds, at rest if `last` is later.

    point: (3,) world metres; for an `OrientationCurve` a quaternion (4,) wxyz. tension, continuity, bias: of the spline at
    this point, 0 is neutral; the tension is 1 (tangent zero) at a rest unless given. Continuity and bias have no effect
    at the ends of the curve, where there is only one side.
    """

    first: float
    last: float
    point: Sequence[float] | np.ndarray
    tension: float | None = None
    continuity: float = 0.0
    bias: float = 0.0


@dataclass(frozen=True, eq=False)
class TimeCurve:
    """`T(t)`: parameter `u` (seconds without the rests) of each time; constant outside `begin..end`."""

    times: Float[np.ndarray, " m"]
    parameters: Float[np.ndarray, " m"]

    def __call__(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """`T` at the times `t`."""
        return np.interp(_finite(t), self.times, self.parameters)

    def slope(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """dT/dt: 0 in rests, their ends included, and outside `begin..end`; 1 elsewhere."""
        t = _finite(t)
        still = (t < self.times[0]) | (t > self.times[-1])
        for i in np.flatnonzero(np.diff(self.parameters) == 0):
            still |= (t >= self.times[i]) & (t <= self.times[i + 1])
        return np.where(still, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class ShapeCurve:
    """A trajectory with its timing, made by `shape_curve`.

    time: `T(t)`. knots: (K,) parameters of the control points. points: (K, 3) metres. end_tangents: (2, 3) velocity in
    metres a second at begin and end. incoming, outgoing: (K, K + 2) tangents as weights of [points; end_tangents].
    """

    time: TimeCurve
    knots: Float[np.ndarray, " k"]
    points: Float[np.ndarray, "k 3"]
    end_tangents: Float[np.ndarray, "2 3"]
    incoming: Float[np.ndarray, "k k_2"]
    outgoing: Float[np.ndarray, "k k_2"]

    @property
    def controls(self) -> Float[np.ndarray, "k_2 3"]:
        """What the curve is linear in: [points; end_tangents]."""
        return np.concatenate([self.points, self.end_tangents])

    def weights(self, t: Times) -> Float[np.ndarray, "n k_2"]:
        """W (n, K + 2) with `position(t) = W @ controls`: depends on times, tension, continuity and bias alone."""
        return curve_weights(self.time(t), self.knots, self.incoming, self.outgoing)

    def position(self, t: Times) -> Float[np.ndarray, "n 3"]:
        """Where the effector belongs at the times `t`, metres: `S(T(t))` (eq. 3); outside the span, where it ends."""
        return self.weights(t) @ self.controls

    def velocity(self, t: Times) -> Float[np.ndarray, "n 3"]:
        """Its velocity, metres a second: 0 in rests and outside the span; where it breaks, the later side's."""
        rows = curve_weights(self.time(t), self.knots, self.incoming, self.outgoing, derivative=1)
        return self.time.slope(t)[:, None] * (rows @ self.controls)


@dataclass(frozen=True, eq=False)
class OrientationCurve:
    """A path of rotations with its timing, made by `orientation_curve`.

    time: `T(t)`. knots: (K,). quaternions: (K, 4), neighbours in one hemisphere. legs: (K - 1, 3, 3) rotation vectors
    between the Bezier control quaternions of each segment.
    """

    time: TimeCurve
    knots: Float[np.ndarray, " k"]
    quaternions: Float[np.ndarray, "k 4"]
    legs: Float[np.ndarray, "s 3 3"]

    def orientation(self, t: Times) -> Float[np.ndarray, "n 4"]:
        """Unit quaternion wxyz at the times `t`."""
        return rotation_curve(self.time(t), self.knots, self.quaternions, self.legs)[0]

    def angular_velocity(self, t: Times) -> Float[np.ndarray, "n 3"]:
        """World angular velocity, radians a second: 0 in rests and outside the span; where it breaks, the later side's."""
        speed = rotation_curve(self.time(t), self.knots, self.quaternions, self.legs)[1]
        return self.time.slope(t)[:, None] * speed


def shape_curve(
    begin: float,
    end: float,
    start: Sequence[float] | np.ndarray,
    finish: Sequence[float] | np.ndarray,
    start_velocity: Sequence[float] | np.ndarray,
    end_velocity: Sequence[float] | np.ndarray,
    passes: Sequence[Pass] = (),
) -> ShapeCurve:
    """The trajectory from `start` at `begin` to `finish` at `end` that passes what is asked (steps 1 to 5 of section 4.2).

    begin, end: seconds. start, finish: (3,) the effector's place in the input motion, metres; start_velocity,
    end_velocity: (3,) its velocity there, metres a second, the curve's end tangents. passes: in any order, inside
    `begin..end`, apart from each other; one at `begin` or `end` replaces the input's place there. Without passes the curve
    is a cubic from the input's place and velocity to the input's place and velocity.
    `OptionError` names what cannot be: times reversed, outside or not finite, passes that overlap.
    """
    ends = np.stack([_vector(start_velocity, 3, "start_velocity"), _vector(end_velocity, 3, "end_velocity")])
    time, knots, points, tcb = _layout(begin, end, start, finish, passes, 3)
    incoming, outgoing = tangent_weights(knots, tcb)
    return ShapeCurve(time, *map(_read_only, (knots, points, ends, incoming, outgoing)))


def orientation_curve(
    begin: float,
    end: float,
    start: Sequence[float] | np.ndarray,
    finish: Sequence[float] | np.ndarray,
    start_velocity: Sequence[float] | np.ndarray,
    end_velocity: Sequence[float] | np.ndarray,
    passes: Sequence[Pass] = (),
) -> OrientationCurve:
    """As `shape_curve`, for orientations: `start`, `finish` and the passes' points are quaternions (4,) wxyz.

    start_velocity, end_velocity: (3,) world angular velocity in radians a second. Quaternions are normalised, their signs
    do not matter: each goes to the next by the shortest arc. An end velocity that would turn more than 5.4 pi over its
    segment is shortened to that.
    """
    ends = np.stack([_vector(start_velocity, 3, "start_velocity"), _vector(end_velocity, 3, "end_velocity")])
    time, knots, points, tcb = _layout(begin, end, start, finish, passes, 4)
    quaternions = one_hemisphere(points)
    legs = rotation_legs(quaternions, knots, tcb, ends)
    return OrientationCurve(time, *map(_read_only, (knots, quaternions, legs)))


def _layout(
    begin: float,
    end: float,
    start: Sequence[float] | np.ndarray,
    finish: Sequence[float] | np.ndarray,
    passes: Sequence[Pass],
    width: int,
) -> tuple[TimeCurve, np.ndarray, np.ndarray, np.ndarray]:
    """Time curve, knots (K,), control points (K, width), and tension, continuity and bias (K, 3) of each."""
    begin, end = float(begin), float(end)
    if not (np.isfinite(begin) and np.isfinite(end) and end - begin > _SAME):
        raise OptionError(f"a shape constraint from {begin} s to {end} s: it must begin before it ends")
    stops = [_stop(p, begin, end, width) for p in sorted(passes, key=lambda p: float(p.first))]
    for a, b in pairwise(stops):
        if b.first - a.last <= _SAME:
            raise OptionError(
                f"the pass {_span(b)} overlaps the pass {_span(a)}: the effector cannot be at two points at once"
            )
    start, finish = _vector(start, width, "start"), _vector(finish, width, "finish")
    if not stops or stops[0].first > begin:
        stops.insert(0, Pass(begin, begin, start))
    if stops[-1].last < end:
        stops.append(Pass(end, end, finish))
    times, parameters, knots, u, now = [], [], [], 0.0, begin
    for stop in stops:
        u += stop.first - now
        now = stop.last
        knots.append(u)
        nodes = [stop.first, stop.last] if stop.last > stop.first else [stop.first]
        times += nodes
        parameters += [u] * len(nodes)
    curve = TimeCurve(_read_only(np.array(times)), _read_only(np.array(parameters)))
    tcb = np.array([[_tension(s), s.continuity, s.bias] for s in stops], float)
    return curve, np.array(knots), np.array([s.point for s in stops], float), tcb


def _stop(p: Pass, begin: float, end: float, width: int) -> Pass:
    """The pass, checked, with times at the ends of the span exactly there."""
    numbers = [p.first, p.last, p.continuity, p.bias, 0.0 if p.tension is None else p.tension]
    if not np.isfinite(numbers).all():
        raise OptionError(f"the pass {_span(p)}: times, tension, continuity and bias must be finite numbers")
    if p.last < p.first:
        raise OptionError(f"the pass {_span(p)} ends before it begins")
    if p.first < begin - _SAME or p.last > end + _SAME:
        raise OptionError(f"the pass {_span(p)} is outside the shape constraint's {begin:.6g} s to {end:.6g} s")

    def snap(t: float) -> float:
        return begin if t - begin <= _SAME else end if end - t <= _SAME else float(t)

    first, last = snap(p.first), snap(p.last)
    point = _vector(p.point, width, f"the point of the pass {_span(p)}")
    return Pass(first, last if last - first > _SAME else first, point, p.tension, p.continuity, p.bias)


def _tension(p: Pass) -> float:
    """1 at a rest unless the user says otherwise (step 4)."""
    if p.tension is not None:
        return p.tension
    return 1.0 if p.last > p.first else 0.0


def _vector(x: Sequence[float] | np.ndarray, width: int, what: str) -> np.ndarray:
    v = np.asarray(x, float)
    if v.shape != (width,):
        raise ShapeError(f"{what} has shape {v.shape}: {'a quaternion (4,)' if width == 4 else '(3,)'} is needed")
    if not np.isfinite(v).all() or (width == 4 and not np.linalg.norm(v) > 1e-6):
        raise OptionError(f"{what} is {v.tolist()}: {'a rotation' if width == 4 else 'three finite numbers'} is needed")
    return v


def _finite(t: Times) -> np.ndarray:
    t = np.asarray(t, float)
    if t.ndim != 1:
        raise ShapeError(f"times have shape {t.shape}: one axis is needed")
    if not np.isfinite(t).all():
        raise OptionError("a time is not finite")
    return t


def _span(p: Pass) -> str:
    return f"at {p.first:.6g} s" if p.first == p.last else f"from {p.first:.6g} s to {p.last:.6g} s"


def _read_only(x: np.ndarray) -> np.ndarray:
    x.setflags(write=False)
    return x
