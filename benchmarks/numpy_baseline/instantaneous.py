"""Step 5 of the overview: which interval carries an instantaneous constraint, of what kind, and where it lies.

There are two kinds, space and line: no displacement leaves a single point at rest (section 3.1). Points come from
merging lines, so line and point share one test and its pattern.
"""

from dataclasses import dataclass

import numpy as np

NONE, SPACE, LINE = 0, 1, 2


@dataclass(frozen=True)
class Instantaneous:
    """A constraint of one interval, in the world. `end` differs from `begin` for space only; a line has an axis."""

    interval: int
    kind: int
    begin: np.ndarray
    end: np.ndarray
    axis: np.ndarray | None


def curves_of_types(curves, types):
    """The curves of the types that are asked for; where line and point are and one has none, they share the other's."""
    chosen = {kind: curves[kind] for kind in types if kind in curves}
    if "line" in types and "point" in types:
        for kind, other in (("line", "point"), ("point", "line")):
            if kind not in chosen and other in chosen:
                chosen[kind] = chosen[other]
    for kind in types:
        if kind not in chosen:
            raise ValueError(f"type {kind!r} is asked for, but it has neither template nor thresholds")
    return chosen


def label_loop(projection, valid, curves, axis_min):
    """The label of every interval, one after the other."""
    space, line = curves.get("space"), curves.get("line", curves.get("point"))
    labels = np.zeros(len(valid), dtype=int)
    for i in range(len(valid)):
        if not valid[i]:
            continue
        if space is not None and projection.sigma3[i] <= space[0][i] and projection.eps3[i] <= space[1][i]:
            labels[i] = SPACE
        elif (
            line is not None
            and projection.sigma1[i] <= line[0][i]
            and projection.eps1[i] <= line[1][i]
            and projection.sigma3[i] > max(line[0][i], axis_min)
        ):
            labels[i] = LINE
    return labels


def label_vectorised(projection, valid, curves, axis_min):
    """The same at once; NaN compares as false."""
    space, line = curves.get("space"), curves.get("line", curves.get("point"))
    labels = np.zeros(len(valid), dtype=int)
    if line is not None:
        is_line = (projection.sigma1 <= line[0]) & (projection.eps1 <= line[1])
        labels[valid & is_line & (projection.sigma3 > np.maximum(line[0], axis_min))] = LINE
    if space is not None:
        labels[valid & (projection.sigma3 <= space[0]) & (projection.eps3 <= space[1])] = SPACE
    return labels


def instantaneous_constraints(R, t, projection, labels, formulation="local"):
    """The list of instantaneous constraints in time order."""
    found = []
    for i in np.flatnonzero(labels):
        i = int(i)
        if labels[i] == SPACE:
            found.append(Instantaneous(i, SPACE, t[i], t[i + 1], None))
            continue
        p, a = projection.p[i], projection.axis[i]
        if formulation == "local":
            point, axis = R[i] @ p + t[i], R[i] @ a
        else:  # already world coordinates; p is the point nearest the world's origin: slide it along the axis
            point, axis = p + a * (a @ (t[i] - p)), a
        found.append(Instantaneous(i, LINE, point, point, axis))
    return found
