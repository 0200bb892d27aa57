"""The constraints of a clip over time, a row an object."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ..annotations import TYPES, Annotations, Constraint, Constraints
from ..detect.results import Detection
from . import style
from .style import INK, QUIET, SMALL, TYPE_COLOURS, TYPE_HEIGHTS

MOST_ROWS = 40


def timeline(
    detection_or_annotations: Detection | Annotations,
    truth: Annotations | Iterable[Constraint] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """All constraints of a clip: a row an object, a bar a constraint, seconds below and frames above.

    Colour and height of a bar say its type. A bar reaches half a frame beyond its first and last frame. With `truth`, a
    hatched row under each object shows what should have been found. Objects without any constraint are left out only
    where there are more than 40 objects.
    """
    source = detection_or_annotations
    found = source.constraints
    real = None if truth is None else style.constraints_of(truth)
    rate = _rate(source)
    everything = [*found, *(real or ())]
    known = source.objects if isinstance(source, Detection) else tuple(p.object for p in source.patterns)
    names = list(dict.fromkeys([*known, *(c.object for c in everything)]))
    left_out = 0
    if len(names) > MOST_ROWS:
        busy = {c.object for c in everything}
        left_out = sum(n not in busy for n in names)
        names = [n for n in names if n in busy]
    row = 1.0 if real is None else 1.55
    own = ax is None
    longest = max((sum(0.082 if c.isupper() or c in "mw" else 0.06 for c in style.plain(n)) for n in names), default=0)
    height = min(1.6 + 0.27 * row * max(len(names), 1), 60.0)
    figure, (ax,) = style.panels(ax, 9.2, height, left=0.4 + longest, bottom=0.85, top=0.75)
    for i, name in enumerate(names):
        _bars(ax, style.owned(found, name), i * row, 0.72, rate, hatched=False)
        if real is not None:
            _bars(ax, style.owned(real, name), i * row + 0.66, 0.46, rate, hatched=True)
    _dress(ax, names, row, source.frames - 1, rate, style.plain(source.clip, 60), left_out)
    handles = [
        Patch(facecolor=TYPE_COLOURS[t], label=f"{t} ({len(found.of(type=t))})")
        for t in TYPES
        if any(c.type == t for c in everything) or t == "space"
    ]
    if real is not None:
        handles.append(
            Patch(facecolor="white", edgecolor=INK, hatch="////", linewidth=0.6, label=f"truth ({len(real)})")
        )
    style.legend(figure if own else ax, handles)
    return figure


def _rate(source: Detection | Annotations) -> float:
    """Frames a second; one where it is not known, so that the axis counts frames."""
    rate = float(source.rate if isinstance(source, Detection) else source.fps)
    return rate if rate > 0 else 1.0


def _bars(ax: Axes, constraints: Constraints, middle: float, height: float, rate: float, hatched: bool) -> None:
    """The bars of one object, one collection a type; narrow types lie on top of tall ones."""
    for order, kind in enumerate(TYPES):
        some = constraints.of(type=kind)
        if not len(some):
            continue
        tall = height * TYPE_HEIGHTS[kind]
        look: dict[str, Any] = {
            "facecolors": "white",
            "edgecolors": TYPE_COLOURS[kind],
            "hatch": "//////",
            "linewidth": 0.8,
        }
        ax.broken_barh(
            [((c.begin - 0.5) / rate, c.frames / rate) for c in some], (middle - tall / 2, tall), zorder=3 + order,
            **(look if hatched else {"facecolors": TYPE_COLOURS[kind], "edgecolors": "white", "linewidth": 0.5}),
        )  # fmt: skip


def _dress(ax: Axes, names: list[str], row: float, last: int, rate: float, clip: str, left_out: int) -> None:
    """Axes, names of the rows, title."""
    style.dress(ax, "time (s)", "", f"Constraints of {clip}" if clip else "Constraints", above=36.0)
    ax.set_yticks([i * row for i in range(len(names))], [style.plain(n) for n in names], fontsize=SMALL)
    ax.set_ylim(max(len(names), 1) * row - 0.5 * (2 - 1 / row), -0.6)
    ax.set_xlim(-0.5 / rate, (last + 0.5) / rate)
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    for i in range(0, len(names), 2):
        ax.axhspan(i * row - 0.5, (i + 1) * row - 0.5, color=QUIET, alpha=0.08, linewidth=0, zorder=0)
    style.frame_axis(ax, rate)
    if left_out:
        ax.set_ylabel(f"{left_out} objects without constraints are not shown", fontsize=SMALL, color=QUIET)
    if not ax.collections:
        ax.text(0.5, 0.5, "no constraint", transform=ax.transAxes, ha="center", va="center", color=QUIET)
