"""Step 6 of the overview: instantaneous constraints become the fewest constraints that explain them (section 7).

One pass in time order holds one open constraint against the next instantaneous one. Two meet if they intersect in space
and if the gap between them is within the frame tolerance of their distance (appendix B).
"""

import math
from dataclasses import dataclass

import numpy as np

from .instantaneous import LINE, SPACE
from .refit import refit_rotation, refit_space


@dataclass(frozen=True)
class Constraint:
    """A kinematic constraint over the frames begin..end, both included. `axis` is NaN unless it is a line."""

    type: str
    begin: int
    end: int
    position: np.ndarray
    axis: np.ndarray
    residual: float


@dataclass
class _Open:
    """The constraint that is being built; `position` and `axis` are those that the next one is compared with."""

    type: str
    first: int
    last: int
    position: np.ndarray
    axis: np.ndarray | None


def in_frames(seconds, rate):
    """A duration as a number of intervals, rounded half up."""
    return math.floor(seconds * rate + 0.5)


def frame_tolerance(d, f_max, d_max):
    """Appendix B, eq. 16: the gap allowed at the distance `d`, with the end points in branches of their own."""
    if d == 0.0:
        return f_max
    if d == d_max:
        return 1
    if d < d_max:
        return math.floor(f_max ** (1.0 - d / d_max))
    return 0


def point_line_distance(x, point, axis):
    """Distance of `x` from the line through `point` along the unit vector `axis`."""
    return float(np.linalg.norm(np.cross(x - point, axis)))


def lines_angle(axis_1, axis_2):
    """Angle of two lines, 0 to pi/2; the senses of the axes do not matter."""
    return math.atan2(np.linalg.norm(np.cross(axis_1, axis_2)), abs(axis_1 @ axis_2))


def shortest_segment(point_1, axis_1, point_2, axis_2):
    """(length, middle) of the shortest segment between two lines that are not parallel."""
    n = np.cross(axis_1, axis_2)
    apart = point_2 - point_1
    foot_1 = point_1 + axis_1 * (np.cross(apart, axis_2) @ n) / (n @ n)
    foot_2 = point_2 + axis_2 * (np.cross(apart, axis_1) @ n) / (n @ n)
    return float(np.linalg.norm(foot_2 - foot_1)), 0.5 * (foot_1 + foot_2)


def absorbed_intervals(labels, min_intervals):
    """Space runs shorter than `min_intervals` that touch a line interval: a hinge that rests for a moment."""
    absorbed = np.zeros(len(labels), dtype=bool)
    i = 0
    while i < len(labels):
        if labels[i] != SPACE:
            i += 1
            continue
        stop = i
        while stop < len(labels) and labels[stop] == SPACE:
            stop += 1
        touches = (i > 0 and labels[i - 1] == LINE) or (stop < len(labels) and labels[stop] == LINE)
        if touches and stop - i < min_intervals:
            absorbed[i:stop] = True
        i = stop
    return absorbed


def merge(found, labels, valid, absorbed, *, alpha_max, dist_max, f_max, d_max, max_missing):
    """[(is_space, first interval, last interval)] of the merged constraints. The counts are in intervals."""
    done, cur = [], None
    for new in found:
        if absorbed[new.interval]:
            continue
        if cur is not None:
            between = slice(cur.last + 1, new.interval)
            gap = int(np.sum(valid[between] & (labels[between] == 0)))
            missing = int(np.sum(~valid[between]))
            if missing <= max_missing and _join(cur, new, gap, alpha_max, dist_max, f_max, d_max):
                cur.last = new.interval
                continue
            done.append(cur)
        kind = "space" if new.kind == SPACE else "line"
        cur = _Open(kind, new.interval, new.interval, new.end, new.axis)
    if cur is not None:
        done.append(cur)
    return [(c.type == "space", c.first, c.last) for c in done]


def _join(cur, new, gap, alpha_max, dist_max, f_max, d_max):
    """Whether `new` continues `cur`; if so, `cur` takes the place that the next one is compared with."""
    if (cur.type == "space") != (new.kind == SPACE):
        return False
    if cur.type == "space":
        d = float(np.linalg.norm(new.begin - cur.position))
        if d <= d_max and gap <= frame_tolerance(d, f_max, d_max):
            cur.position = new.end
            return True
        return False

    if cur.type == "point":
        d, place = point_line_distance(cur.position, new.begin, new.axis), None
    elif lines_angle(cur.axis, new.axis) < alpha_max:
        d, place = point_line_distance(new.begin, cur.position, cur.axis), None
    else:
        d, place = shortest_segment(cur.position, cur.axis, new.begin, new.axis)
    if d > dist_max or gap > frame_tolerance(d, f_max, d_max):
        return False
    if place is not None:  # two lines that cross: a point from here on
        cur.type, cur.position, cur.axis = "point", place, None
    elif cur.type == "line":
        cur.position, cur.axis = new.begin, new.axis
    return True


def finish(merged, R, t, frame_ok, *, types, alpha_max, min_intervals):
    """Refit every merged constraint on its valid frames, then leave out the short ones and the types not asked for."""
    constraints = []
    for is_space, first, last in merged:
        begin, end = first, last + 1
        frames = np.arange(begin, end + 1)
        frames = frames[frame_ok[begin : end + 1]]
        if is_space:
            kind, axis = "space", None
            position, residual = refit_space(t[frames])
        else:
            kind, position, axis, residual = refit_rotation(R[frames], t[frames], alpha_max)
        if kind in types and end - begin >= min_intervals:
            axis = np.full(3, np.nan) if axis is None else axis
            constraints.append(Constraint(kind, begin, end, position, axis, residual))
    return constraints
