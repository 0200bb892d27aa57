"""The scene in three dimensions with its constraints (figure 7): a skeleton, or objects without one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..annotations import Annotations, Constraint, Constraints
from ..detect.results import Detection
from ..errors import OptionError, ShapeError, find_name
from ..motion import Motion, Poses
from . import glyphs, style
from .style import INK

Body = Motion | tuple[Sequence[str], Sequence[int], Any]
Source = Detection | Annotations | Iterable[Constraint] | None


@dataclass(frozen=True)
class Stage:
    """What a panel shows besides constraints; arrays in the picture's axes (the third is up).

    `position` (F, J, 3) with `bones` (B, 2) as pairs of J, `boxes` the rotation (F, J, 3, 3) of objects of edge `edge`,
    `trails` names and indices of J. `order`: which world axis each axis of the picture is.
    """

    position: np.ndarray
    bones: np.ndarray
    boxes: np.ndarray | None
    edge: float
    trails: tuple[int, ...]
    order: tuple[int, int, int]
    rate: float


def skeleton_3d(
    body: Body,
    constraints: Source = None,
    frame: int | Sequence[int] | None = None,
    *,
    trail: Sequence[str] = (),
    up: str | None = None,
    rate: float | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """A skeleton and the constraints of the clip: active ones green, the others faint blue (figure 7).

    body: a `Motion`, or (names, parents, positions (F, J, 3) in metres). constraints: a `Detection`, `Annotations` or
    constraints: space is a box with a cross and its object's name, a line lies along its axis, a point is a dot.
    frame: one frame, several as a strip, or `None` for up to four in
    the middle of constraints, spread over the clip. trail: joints whose path is drawn.
    up: "x", "y" or "z", by default the skeleton's own, "y" without one. ax: axes of `projection="3d"`, one a frame.
    """
    if isinstance(body, Motion):
        names, parents, position = skeleton_positions(body)
        up, rate = up or body.skeleton.topology.up, rate or float(body.rate)
    else:
        names, parents, position = tuple(body[0]), tuple(body[1]), np.asarray(body[2], float)
    if position.ndim != 3 or position.shape[1:] != (len(names), 3) or len(parents) != len(names):
        found = f"{len(names)} names, {len(parents)} parents, positions {position.shape}"
        raise ShapeError(f"{found}: positions must be (frames, {len(names)}, 3)")
    bones = np.array([(p, i) for i, p in enumerate(parents) if p >= 0], int).reshape(-1, 2)
    trails = tuple(find_name(t, names, "joint") for t in trail)
    order = glyphs.axes_order(up or "y")
    stage = Stage(position[..., order], bones, None, 0.0, trails, order, rate or _rate(constraints))
    return _draw(stage, constraints, frame, ax)


def objects_3d(
    poses: Poses,
    constraints: Source = None,
    frame: int | Sequence[int] | None = None,
    *,
    edge: float | None = None,
    trail: bool = True,
    up: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Objects without a skeleton (dice, props, marker clusters) as boxes with their paths, and the constraints.

    edge: length of a box's edge in metres, by default what suits the scene. The other arguments as in `skeleton_3d`.
    """
    position = np.where(np.asarray(poses.valid, bool)[..., None], np.asarray(poses.position, float), np.nan)
    if position.ndim != 3:
        raise ShapeError(f"poses of shape {position.shape}: a picture shows one clip, (frames, objects, 3)")
    order = glyphs.axes_order(up or poses.up)
    position = position[..., order]
    boxes = glyphs.matrices(np.asarray(poses.rotation, float))[..., order, :]
    if edge is None:
        seen = position[np.isfinite(position).all(-1)]
        edge = float(np.clip(0.08 * np.ptp(seen, axis=0).max(initial=0.0), 0.05, 0.5)) if len(seen) else 0.1
    trails = tuple(range(len(poses.names))) if trail else ()
    stage = Stage(position, np.zeros((0, 2), int), boxes, edge, trails, order, float(poses.rate))
    return _draw(stage, constraints, frame, ax)


def skeleton_positions(motion: Motion) -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray]:
    """Names, parents and world positions (F, J + E, 3) of joints and End Sites, without which feet have no toes."""
    from ..kinematics import forward_kinematics

    rotation, position = (np.asarray(a, float) for a in forward_kinematics(motion))
    if position.ndim != 3:
        raise ShapeError(f"a motion of shape {position.shape}: a picture shows one clip, (frames, joints, 3)")
    topology, ends = motion.skeleton.topology, np.asarray(motion.skeleton.end_offsets, float)
    at = np.array(topology.end_parents, int)
    tips = position[:, at] + (glyphs.matrices(rotation[:, at]) @ ends[..., None])[..., 0]
    names = (*topology.names, *(f"{topology.names[p]} end {i}" for i, p in enumerate(topology.end_parents)))
    return names, (*topology.parents, *topology.end_parents), np.concatenate([position, tips], axis=1)


def _rate(source: Source) -> float:
    if isinstance(source, Detection):
        return float(source.rate)
    if isinstance(source, Annotations):
        return float(source.fps)
    return next((c.fps for c in style.constraints_of(source) if c.fps), 0.0)


def _telling_frames(constraints: Sequence[tuple[Constraint, float]], count: int) -> list[int]:
    """Four frames spread over the clip, each moved to the middle of the nearest constraint (times its frames' scale)."""
    spread = np.linspace(0, count - 1, min(count, 6))[1:-1].astype(int).tolist() if count > 2 else [0]
    middles = sorted({int((c.begin + c.end) / 2 * scale) for c, scale in constraints})
    middles = [m for m in middles if 0 <= m < count]
    chosen = {min(middles, key=lambda m: abs(m - f)) if middles else f for f in spread}
    return sorted(chosen)


def _draw(stage: Stage, source: Source, frame: int | Sequence[int] | None, ax: Axes | Sequence[Axes] | None) -> Figure:
    """A panel a frame, all to one scale and seen from one side."""
    constraints, count = style.constraints_of(source), len(stage.position)
    if frame is None:
        frame = _telling_frames([(c, (stage.rate or c.fps) / (c.fps or stage.rate or 1)) for c in constraints], count)
    frames = [int(f) for f in np.atleast_1d(np.asarray(frame))]
    if any(not 0 <= f < count for f in frames) or not frames:
        raise OptionError(f"frames {frames} are not inside the clip's 0..{count - 1}")
    whole = stage.boxes is not None or len(frames) == 1
    boxes, azimuth = _views(stage, constraints, frames, whole), glyphs.side_view(stage.position)
    own = ax is None
    figure, axes = (Figure(dpi=100, facecolor=style.PAPER), []) if own else style.panels(ax, 0, 0, 1, len(frames))
    if own:
        axes = [figure.add_subplot(projection="3d") for _ in frames]
    for a, box in zip(axes, boxes, strict=False):
        glyphs.stage_axes(a, box, stage.order, azimuth, bare=len(frames) > 1)
    titles = [f"frame {f}" + (f", {f / stage.rate:.2f} s" if stage.rate else "") for f in frames]
    if own:
        _arrange(figure, axes, boxes, titles)
    else:
        for a, title in zip(axes, titles, strict=False):
            a.set_title(title, fontsize=style.NORMAL, color=INK)
    for a, f, box in zip(axes, frames, boxes, strict=False):
        _panel(a, stage, constraints, f, box)
    handles = glyphs.legend_handles(constraints, stage.trails, glyphs.grid_step(boxes[0]))
    style.legend(figure if own else axes[0], handles, columns=7 if figure.get_figwidth() > 8 else 4)
    return figure


def _arrange(figure: Figure, axes: Sequence[Any], boxes: Sequence[np.ndarray], titles: Sequence[str]) -> None:
    """Panels that what they show just fills, and a figure to hold them: title above, legend below.

    Three-dimensional axes are squares, mostly empty; they overlap here, so that their contents stand side by side.
    """
    spots = np.concatenate([glyphs.on_paper(a, glyphs.corners(b)) for a, b in zip(axes, boxes, strict=True)])
    middle, extent = (spots.max(axis=0) + spots.min(axis=0)) / 2, np.ptp(spots, axis=0)
    flat, single = extent[0] > 1.5 * extent[1], len(axes) == 1
    columns = min(len(axes), 2 if flat else 4)
    rows = -(-len(axes) // columns)
    room, pad = ((6.2, 4.6), (1.7, 0.9)) if single else ((4.4 if flat else 2.5, 3.4), (0.35, 0.15))
    side = min(room[0] / extent[0], room[1] / extent[1])
    cell = side * extent + pad + (0.0, 0.3)
    width, height = max(columns * cell[0], 6.0), rows * cell[1] + 0.55
    figure.set_size_inches(width, height)
    for i, a in enumerate(axes):
        x = (i % columns + 0.5 - columns / 2) * cell[0] + width / 2
        y = height - (i // columns) * cell[1] - 0.3 - (cell[1] - 0.3) / 2
        left, bottom = x - side * middle[0], y - side * middle[1]
        a.set_position((left / width, bottom / height, side / width, side / height))
        top = (height - (i // columns) * cell[1] - 0.1) / height
        figure.text(x / width, top, titles[i], fontsize=style.NORMAL, color=INK, ha="center", va="top")


def _views(stage: Stage, constraints: Constraints, frames: list[int], whole: bool) -> list[np.ndarray]:
    """The box (3, 2) of the world that each panel shows: the scene, or as much room round the body in every panel."""
    spots = np.array([c.position for c in constraints], float).reshape(-1, 3)[:, stage.order]
    if whole:
        shown = stage.position if stage.boxes is not None else stage.position[frames]
        parts = [shown.reshape(-1, 3), spots, *(stage.position[:, t] for t in stage.trails)]
        cloud = np.concatenate(parts)
        box = glyphs.box_of(cloud, max(0.06, stage.edge))
        grow = np.maximum(0.4 * np.ptp(box, axis=1).max() - np.ptp(box, axis=1)[:2], 0.0) / 2
        box[:2] += np.stack([-grow, grow], axis=1)
        return [box] * len(frames)
    boxes = [glyphs.box_of(stage.position[f], 0.0) for f in frames]
    half = np.max([np.ptp(b, axis=1) for b in boxes], axis=0) / 2 + 0.12
    half[:2] = max(half[0], half[1], 0.45 * half[2])
    return [b.mean(axis=1, keepdims=True) + np.array([-1.0, 1.0]) * half[:, None] for b in boxes]


def _panel(ax: Any, stage: Stage, constraints: Constraints, frame: int, box: np.ndarray) -> None:
    """One frame: trails, body, then constraints, the active ones on top."""
    for t in stage.trails:
        glyphs.trail(ax, stage.position[:, t], box)
    if stage.boxes is None:
        glyphs.skeleton(ax, stage.position[frame], stage.bones)
    else:
        glyphs.boxes(ax, stage.position[frame], stage.boxes[frame], stage.edge)
    glyphs.constraints(ax, constraints, frame, stage.rate, box, stage.order)
