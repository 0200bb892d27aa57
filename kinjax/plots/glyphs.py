"""The marks of the three-dimensional pictures: bodies, boxes, trails and constraints, all in the picture's axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ..annotations import Constraint, Constraints
from ..errors import OptionError
from .style import FOUND, INK, KEPT, QUIET, SMALL, plain

MOST_NAMES = 8
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1.0])


def axes_order(up: str) -> tuple[int, int, int]:
    """Which world axis each axis of the picture shows, so that the third is up; cyclic, hence no mirror image."""
    orders = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
    if up.lower() not in orders:
        raise OptionError(f"up={up!r}: choose from x, y, z")
    return orders[up.lower()]


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of `wxyz` quaternions (..., 4), NaN where one is not finite."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def box_of(points: np.ndarray, margin: float) -> np.ndarray:
    """Bounding box (3, 2) of the finite points, no side under 0.3 m; the unit box at 0 where there are none."""
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        return np.array([[-0.5, 0.5]] * 3)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    grow = np.maximum(0.3 - (high - low), 0.0) / 2
    return np.stack([low - grow, high + grow], axis=1)


def side_view(position: np.ndarray) -> float:
    """Azimuth in degrees that looks at the path of the body from its side; a plain view of who stays in place."""
    seen = position[np.isfinite(position).all((-2, -1))].mean(axis=1) if len(position) else np.zeros((0, 3))
    way = seen[-1] - seen[0] if len(seen) > 1 else np.zeros(3)
    return float(np.degrees(np.arctan2(way[1], way[0])) - 65.0) if np.hypot(way[0], way[1]) > 0.5 else -60.0


def stage_axes(ax: Any, box: np.ndarray, order: tuple[int, int, int], azimuth: float, bare: bool) -> None:
    """Limits, equal aspect, ground; axes with numbers, or (`bare`, for small panels) a corner that names them."""
    ax.set_proj_type("persp", focal_length=1.0)
    ax.computed_zorder = False
    ax.patch.set_visible(False)
    ax.view_init(elev=14, azim=azimuth)
    ax.grid(False)
    size, step = np.ptp(box, axis=1), grid_step(box)
    for set_limits, axis, limits, world in zip(
        (ax.set_xlim, ax.set_ylim, ax.set_zlim), (ax.xaxis, ax.yaxis, ax.zaxis), box, order, strict=True
    ):
        set_limits(*limits)
        axis.set_label_text(f"{'xyz'[world]} (m)", fontsize=SMALL, color=INK)
        axis.labelpad = 3
        axis.set_pane_color((1, 1, 1, 0))
        axis.line.set_color(QUIET)
        axis.set_major_locator(MultipleLocator(step))
    ax.set_box_aspect(tuple(size / size.max()))
    ax.tick_params(labelsize=SMALL - 0.5, colors=INK, pad=-1)
    _ground(ax, box, step)
    if bare:
        ax.set_axis_off()
        _corner(ax, box, order, step)


def grid_step(box: np.ndarray) -> float:
    """A round length in metres that fits the longest side of the box three to eight times."""
    longest = float(np.ptp(box, axis=1).max())
    unit = 10.0 ** np.floor(np.log10(longest / 8))
    return float(next(unit * k for k in (1, 2, 5, 10, 20) if longest / (unit * k) <= 8))


def _ground(ax: Any, box: np.ndarray, step: float) -> None:
    """A grid of round coordinates on the floor of the box."""
    (x0, x1), (y0, y1), (z, _) = box
    ax.add_collection3d(
        Poly3DCollection(
            [[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]], facecolors="#f1f1f4", linewidths=0, zorder=-5
        ),
        autolim=False,
    )
    xs, ys = (np.arange(np.ceil(a / step), np.floor(b / step) + 1) * step for a, b in ((x0, x1), (y0, y1)))
    lines = [[(x, y0, z), (x, y1, z)] for x in xs] + [[(x0, y, z), (x1, y, z)] for y in ys]
    if lines:
        ax.add_collection3d(Line3DCollection(lines, colors=QUIET, linewidths=0.5, alpha=0.5, zorder=-4), autolim=False)


def _corner(ax: Any, box: np.ndarray, order: tuple[int, int, int], step: float) -> None:
    """The three directions at a corner of the floor, each one grid step long, with the world's names."""
    corner, far = box[:, 0], 1.25 * step * np.eye(3)
    ends = [np.stack([corner, corner + 0.8 * v]) for v in far]
    ax.add_collection3d(Line3DCollection(ends, colors=QUIET, linewidths=1.2, zorder=-3), autolim=False)
    for v, world in zip(far, order, strict=True):
        ax.text(*(corner + v), "xyz"[world], fontsize=SMALL, color=QUIET, ha="center", va="center")


def on_paper(ax: Any, points: np.ndarray) -> np.ndarray:
    """Where points (N, 3) lie in the square of the axes, as fractions (N, 2) of its side."""
    x, y, _ = proj3d.proj_transform(*points.T, ax.get_proj())
    return np.asarray(ax.transLimits.transform(np.stack([x, y], axis=-1)))


def corners(box: np.ndarray) -> np.ndarray:
    """The eight corners (8, 3) of a box (3, 2)."""
    return box.mean(axis=1) + _CORNERS * np.ptp(box, axis=1)


def skeleton(ax: Any, position: np.ndarray, bones: np.ndarray) -> None:
    """Bones (B, 2) between joints (J, 3), without those that are not finite."""
    ends = position[bones]
    ends = ends[np.isfinite(ends).all((-2, -1))]
    if len(ends):
        ax.add_collection3d(
            Line3DCollection(ends, colors=INK, linewidths=1.8, capstyle="round", zorder=4), autolim=False
        )
    seen = position[np.isfinite(position).all(-1)]
    ax.scatter(*seen.T, s=5, color=INK, depthshade=False, zorder=4)


def boxes(ax: Any, position: np.ndarray, rotation: np.ndarray, edge: float) -> None:
    """A wire box for each object, with a cross on the side where its x axis leaves, so that turning is seen."""
    seen = np.isfinite(position).all(-1) & np.isfinite(rotation).all((-2, -1))
    mark = np.array([[(0.5, -0.5, -0.5), (0.5, 0.5, 0.5)], [(0.5, 0.5, -0.5), (0.5, -0.5, 0.5)]])
    wires = np.concatenate([_CORNERS[_EDGES], mark])
    for p, r in zip(position[seen], rotation[seen], strict=True):
        ax.add_collection3d(
            Line3DCollection(edge * wires @ r.T + p, colors=INK, linewidths=1.1, zorder=4), autolim=False
        )


def trail(ax: Any, path: np.ndarray, box: np.ndarray) -> None:
    """The path (F, 3) of one joint or object, broken where it was not seen or leaves the view."""
    inside = np.isfinite(path).all(-1) & ((path >= box[:, 0]) & (path <= box[:, 1])).all(-1)
    pieces = np.split(path, np.flatnonzero(np.diff(inside.astype(int))) + 1)
    lines = [p for p in pieces if len(p) > 1 and inside_of(p[0], box)]
    if lines:
        ax.add_collection3d(Line3DCollection(lines, colors=QUIET, linewidths=0.9, alpha=0.8), autolim=False)


def inside_of(point: np.ndarray, box: np.ndarray) -> bool:
    """Whether a finite point (3,) lies in the box (3, 2)."""
    return bool(np.isfinite(point).all() and (point >= box[:, 0]).all() and (point <= box[:, 1]).all())


def constraints(
    ax: Any, items: Constraints, frame: int, rate: float, box: np.ndarray, order: tuple[int, int, int]
) -> None:
    """Constraints inside the box: faint blue, and green with the object's name while they are active.

    `frame` counts at `rate` frames a second; constraints of a resampled clip are compared in time.
    """
    size = float(np.clip(0.042 * np.ptp(box, axis=1).max(), 0.02, 0.2))
    shown: dict[bool, list[tuple[Constraint, np.ndarray]]] = {False: [], True: []}
    for c in items:
        at = np.asarray(c.position, float)[list(order)]
        now = round(frame * c.fps / rate) if c.fps and rate else frame
        if inside_of(at, box):
            shown[c.begin <= now <= c.end].append((c, at))
    _marks(ax, shown[False], size, order, FOUND, 0.28)
    _marks(ax, shown[True], size, order, KEPT, 1.0)
    named = {c.object: (at, plain(c.object, 20)) for c, at in reversed(shown[True])}
    _names(ax, list(named.values())[::-1], size)


def _names(ax: Any, active: list[tuple[np.ndarray, str]], size: float) -> None:
    """The names of active constraints, raised until none covers another; a count for those beyond the first eight."""
    shown = active[:MOST_NAMES]
    if not shown:
        return
    if len(active) > len(shown):
        shown[-1] = (shown[-1][0], f"{shown[-1][1]} and {len(active) - len(shown)} more")
    side = ax.get_position().height * ax.figure.get_figheight()
    above = np.array([0.0, 0.0, size])
    bases = np.stack([at + 1.2 * above for at, _ in shown])
    low, high = side * on_paper(ax, bases), side * on_paper(ax, bases + above)
    rise = 1.0 / np.maximum(high[:, 1] - low[:, 1], 1e-6)
    taken: list[tuple[float, float, float]] = []
    for i in np.argsort(low[:, 1], kind="stable"):
        text, half = shown[i][1], 0.037 * len(shown[i][1]) + 0.04
        x, y = low[i]
        while any(abs(x - u) < half + h and abs(y - v) < 0.165 for u, v, h in taken):
            y += 0.02
        taken.append((x, y, half))
        at = bases[i] + above * (y - low[i, 1]) * rise[i]
        if y > low[i, 1]:
            ax.plot(*np.stack([shown[i][0], at]).T, color=KEPT, linewidth=0.7, zorder=19)
        ax.text(*at, text, fontsize=SMALL, color="#00674b", ha="center", va="bottom", zorder=20,
                bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.6})  # fmt: skip


def _marks(
    ax: Any,
    items: list[tuple[Constraint, np.ndarray]],
    size: float,
    order: tuple[int, int, int],
    colour: str,
    alpha: float,
) -> None:
    """Space: a box with a cross. Line: a segment of its axis. Point: a dot. One artist a type."""
    cross = 0.5 * np.stack([-np.eye(3), np.eye(3)], axis=1)
    figure = size * np.concatenate([_CORNERS[_EDGES], cross])
    space = [figure + at for c, at in items if c.type == "space"]
    line = [at + 2.5 * size * np.outer((-1.0, 1.0), np.asarray(c.axis, float)[list(order)])
            for c, at in items if c.type == "line" and c.axis is not None]  # fmt: skip
    point = [at for c, at in items if c.type == "point" or (c.type == "line" and c.axis is None)]
    for wires, width in ((np.concatenate(space) if space else [], 1.3), (line, 3.0)):
        if len(wires):
            ax.add_collection3d(
                Line3DCollection(wires, colors=colour, linewidths=width, alpha=alpha, zorder=10), autolim=False
            )
    if point:
        ax.scatter(*np.stack(point).T, s=46, color=colour, alpha=alpha, depthshade=False, linewidths=0, zorder=10)


def legend_handles(items: Constraints, trails: tuple[int, ...], step: float) -> list[Line2D]:
    """What the colours and the marks that occur mean."""
    shapes = {"space": ("s", "space"), "line": ("_", "line (axis)"), "point": ("o", "point (pivot)")}
    kinds = [k for k in shapes if any(c.type == k for c in items)]
    out = [
        Line2D([], [], color=KEPT, linewidth=3, label="active"),
        Line2D([], [], color=FOUND, alpha=0.35, linewidth=3, label="other times"),
    ]
    out += [
        Line2D([], [], linestyle="", marker=shapes[k][0], markersize=8, markerfacecolor="none" if k == "space" else INK,
               markeredgecolor=INK, markeredgewidth=2 if k == "line" else 1, label=shapes[k][1])
        for k in kinds
    ]  # fmt: skip
    out += [Line2D([], [], color=QUIET, linewidth=1, label="path")] if trails else []
    return [*out, Line2D([], [], color=QUIET, linewidth=0.6, alpha=0.6, label=f"ground grid {step:g} m")]
