"""What a deformation did: bodies side by side with their goals, and what is left of each constraint over time.

In: motions, a `Deformation`. Out: a `matplotlib.figure.Figure` each. Figure numbers are those of the 2004 paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ..errors import OptionError, ShapeError, find_name
from ..motion import Motion
from . import glyphs, style
from .scene import skeleton_positions
from .style import FOUND, INK, KEPT, QUIET

if TYPE_CHECKING:
    from ..deform.results import Deformation

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#b98079")
LEAST = 1e-4
"""Millimetres, or degrees, under which a residual is drawn as this much: nothing is seen below."""


def side_by_side(
    motions: Mapping[str, Motion],
    frame: int | Sequence[int],
    *,
    goals: Any = (),
    lines: Mapping[str, Any] | None = None,
    trail: Sequence[str] = (),
    reference: str | None = None,
) -> Figure:
    """The same frames of several motions of one skeleton, a column each, as in figures 3 to 7 (a row each, with more frames).

    motions: by title. frame: one, or several, a row each. goals: places (N, 3) in world metres, drawn as crosses. lines:
    polylines (M, 3) by name, a floor or stairs. trail: joints whose path is drawn. reference: the motion that is drawn faintly
    behind all others, the input usually.
    """
    if not motions:
        raise OptionError("no motion to draw")
    bodies = {title: skeleton_positions(m) for title, m in motions.items()}
    first = next(iter(motions.values()))
    names, parents, _ = next(iter(bodies.values()))
    if any(b[:2] != (names, parents) for b in bodies.values()):
        raise ShapeError("motions of different skeletons cannot be compared joint by joint: draw them one by one")
    if reference is not None and reference not in bodies:
        raise OptionError(f"reference={reference!r}: choose from {', '.join(bodies)}")
    order = glyphs.axes_order(first.skeleton.topology.up)
    position = {t: b[2][..., order] for t, b in bodies.items()}
    frames = [int(f) for f in np.atleast_1d(np.asarray(frame))]
    count = min(len(p) for p in position.values())
    if not frames or any(not 0 <= f < count for f in frames):
        raise OptionError(f"frames {frames} are not inside the clips' 0..{count - 1}")
    places = np.asarray(goals, float).reshape(-1, 3)[:, order]
    drawn = {k: np.asarray(v, float)[:, order] for k, v in (lines or {}).items()}
    bones = np.array([(p, i) for i, p in enumerate(parents) if p >= 0], int).reshape(-1, 2)
    trails = [find_name(t, names, "joint") for t in trail]
    boxes = _boxes(position, frames, places, trails)
    azimuth = glyphs.side_view(position[reference or next(iter(position))])
    figure = Figure(dpi=100, facecolor=style.PAPER)
    axes = [[figure.add_subplot(projection="3d") for _ in position] for _ in frames]
    for row, f, box in zip(axes, frames, boxes, strict=True):
        for ax, (title, path) in zip(row, position.items(), strict=True):
            glyphs.stage_axes(ax, box, order, azimuth, bare=True)
            for line in drawn.values():
                _polyline(ax, line, box)
            for t in trails:
                glyphs.trail(ax, path[:, t], box)
            if reference is not None and title != reference:
                _ghost(ax, position[reference][f], bones)
            glyphs.skeleton(ax, path[f], bones)
            seen = np.array([p for p in places if glyphs.inside_of(p, box)]).reshape(-1, 3)
            ax.scatter(*seen.T, s=60, marker="x", color=KEPT, linewidths=2, depthshade=False, zorder=12)
    titles, rows = list(position), [f"frame {f}" for f in frames]
    spots = [glyphs.on_paper(a, glyphs.corners(b)) for row, b in zip(axes, boxes, strict=True) for a in row]
    if len(frames) > len(position):
        axes, titles, rows = [list(column) for column in zip(*axes, strict=True)], rows, titles
    _lay_out(figure, axes, np.concatenate(spots), titles, rows)
    handles = [Line2D([], [], color=INK, linewidth=2, label="this motion")]
    if reference is not None:
        handles.append(Line2D([], [], color=FOUND, alpha=0.45, linewidth=2, label=style.plain(reference)))
    if len(places):
        handles.append(
            Line2D([], [], color=KEPT, linestyle="", marker="x", markersize=8, markeredgewidth=2, label="goal")
        )
    if trails:
        handles.append(Line2D([], [], color=QUIET, linewidth=1, label="path"))
    handles += [Line2D([], [], color="#d55e00", linewidth=1.4, label=style.plain(k)) for k in drawn]
    grid = glyphs.grid_step(boxes[0])
    handles.append(Line2D([], [], color=QUIET, linewidth=0.6, alpha=0.6, label=f"ground grid {grid:g} m"))
    style.legend(figure, handles, columns=6 if figure.get_figwidth() > 8 else 3)
    return figure


def _boxes(
    position: Mapping[str, np.ndarray], frames: Sequence[int], goals: np.ndarray, trails: Sequence[int]
) -> list[np.ndarray]:
    """The box (3, 2) of the world that the panels of each row show: all bodies and near goals, of one size in all rows."""
    out = []
    for f in frames:
        cloud = np.concatenate([p[f] for p in position.values()])
        middle = np.nanmean(np.where(np.isfinite(cloud), cloud, np.nan), axis=0) if np.isfinite(cloud).any() else 0.0
        near = goals[np.linalg.norm(goals - middle, axis=1) < 2.0]
        out.append(glyphs.box_of(np.concatenate([cloud, near]), 0.0))
    half = np.max([np.ptp(b, axis=1) for b in out], axis=0) / 2 + 0.1
    half[:2] = np.maximum(half[:2], 0.4 * half[2])
    return [b.mean(axis=1, keepdims=True) + np.array([-1.0, 1.0]) * half[:, None] for b in out]


def _ghost(ax: Any, position: np.ndarray, bones: np.ndarray) -> None:
    ends = position[bones]
    ends = ends[np.isfinite(ends).all((-2, -1))]
    if len(ends):
        ax.add_collection3d(
            Line3DCollection(ends, colors=FOUND, linewidths=1.4, alpha=0.35, capstyle="round", zorder=2), autolim=False
        )


def _polyline(ax: Any, line: np.ndarray, box: np.ndarray) -> None:
    """The parts of a polyline inside the box, cut at its faces."""
    fine = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(line)])
    inside = ((fine >= box[:, 0]) & (fine <= box[:, 1])).all(-1)
    pieces = [p for p in np.split(fine, np.flatnonzero(np.diff(inside.astype(int))) + 1) if len(p) > 1]
    shown = [p for p in pieces if glyphs.inside_of(p[0], box)]
    if shown:
        ax.add_collection3d(Line3DCollection(shown, colors="#d55e00", linewidths=1.4, zorder=1), autolim=False)


def _lay_out(
    figure: Figure, axes: list[list[Any]], spots: np.ndarray, titles: Sequence[str], rows: Sequence[str]
) -> None:
    """Panels that what they show, inside `spots` (N, 2), just fills, close together: titles above and beside."""
    middle, extent = (spots.max(axis=0) + spots.min(axis=0)) / 2, np.ptp(spots, axis=0)
    tall = 3.6 if len(axes) == 1 else 2.7
    side = min(3.4 / extent[0], tall / extent[1])
    cell = side * extent + (0.12, 0.15)
    width, height = max(len(titles) * cell[0] + 0.9, 6.0), len(axes) * cell[1] + 0.95
    figure.set_size_inches(width, height)
    begin = (width - len(titles) * cell[0] + 0.6) / 2
    for j, line in enumerate(axes):
        y = height - 0.45 - (j + 0.5) * cell[1]
        figure.text(
            0.15 / width, y / height, rows[j], fontsize=style.SMALL, color=INK, rotation=90, ha="center", va="center"
        )
        for i, a in enumerate(line):
            x = begin + (i + 0.5) * cell[0]
            left, bottom = x - side * middle[0], y - side * middle[1]
            a.set_position((left / width, bottom / height, side / width, side / height))
    for i, title in enumerate(titles):
        x = (begin + (i + 0.5) * cell[0]) / width
        text = style.plain(title, 40)
        figure.text(x, 1 - 0.1 / height, text, fontsize=style.NORMAL, color=INK, ha="center", va="top")


def residuals_over_time(deformation: Deformation, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """What is left of each constraint in each frame, over time: distances above, angles below, logarithmic.

    A line is interrupted where its constraint is not active, thick where it does not hold. `ax`: one axes for each unit
    that occurs, metres first.
    """
    report, rate = deformation.report, float(deformation.motion.rate)
    units = [u for u in ("m", "rad") if u in report.unit] or ["m"]
    figure, axes = style.panels(ax, 9.2, 1.7 + 2.4 * len(units), len(units), 1, top=0.75, sharex=True)
    if len(axes) != len(units):
        raise OptionError(f"{len(axes)} axes were given: this deformation has {len(units)} kinds of residual")
    time = np.arange(len(report.residual)) / rate
    handles: dict[str, Any] = {}
    for a, unit in zip(axes, units, strict=True):
        title = "What is left of each constraint" if a is axes[0] else ""
        style.dress(a, "", "distance (mm)" if unit == "m" else "angle (deg)", title, above=36.0)
        scale = 1e3 if unit == "m" else np.degrees(1.0)
        high = 1.0
        for i, name in enumerate(report.titles):
            if report.unit[i] != unit or report.layer[i] < 0:
                continue
            value = np.maximum(scale * report.residual[:, i], LEAST)
            label = f"{style.plain(name)} ({report.layer[i] + 1})"
            style_of: dict[str, Any] = {
                "color": COLOURS[i % len(COLOURS)],
                "linestyle": ("-", "--", ":")[i // len(COLOURS) % 3],
            }
            (handles[label],) = a.plot(time, value, linewidth=1.2, **style_of)
            a.plot(time, np.where(report.status[:, i] > 1, value, np.nan), linewidth=3.0, **style_of)
            high = max(high, float(np.nanmax(value, initial=1.0)))
        a.set_yscale("log")
        a.set_ylim(0.5 * LEAST, 3 * high)
        a.set_xlim(0, max(time[-1] if len(time) else 0.0, 1 / rate))
    style.frame_axis(axes[0], rate)
    axes[-1].set_xlabel("time (s)", fontsize=style.NORMAL, color=INK)
    style.legend(figure if ax is None else axes[0], list(handles.values()), list(handles), columns=3)
    return figure
