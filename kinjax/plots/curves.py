"""Sigma and epsilon over time under the curves of the noise pattern (figure 6)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..detect.results import Detection
from . import style
from .style import FOUND, INK, KEPT, NONE, QUIET, REJECTED, TYPE_COLOURS, Columns


def noise_pattern(
    detection: Detection, object: str, type: str = "space", ax: Axes | Sequence[Axes] | None = None
) -> Figure:
    """Sigma and epsilon of one object over time, and the thresholds that decide (figure 6).

    Templates are shaded, their rejected displacements crossed out, control points of the curves are dots on them;
    displacements that passed are blue, and the bar at the top shows the constraints that they were merged into. `ax`:
    one axes (sigma) or two.
    """
    data = style.columns(detection, object, type)
    figure, axes = style.panels(ax, 9.2, 4.8, 2, 1, top=0.75, sharex=True)
    rate = float(detection.rate)
    names = ("σ max", "ε max")
    rows = ((data.sigma, data.sigma_max, "sigma_max"), (data.eps, data.eps_max, "eps_max"))
    title = f"{style.plain(data.object)}: noise pattern of the {data.type} constraint"
    for a, (values, limit, field), name, label in zip(axes, rows, names, data.labels, strict=False):
        style.dress(a, "", label, title if a is axes[0] else "", above=36.0)
        _row(a, data, values, limit, rate, name)
        _control_points(a, data, field, rate)
        _bars(a, data, rate)
        style.wide_scale(a, "y", values, style.span(limit))
        a.set_xlim(0, max(detection.frames - 1, 1) / rate)
        if not np.isfinite(values).any():
            a.set_ylim(0, 1)
            a.text(0.5, 0.5, "no displacement was seen", transform=a.transAxes, ha="center", color=QUIET)
    style.frame_axis(axes[0], rate)
    axes[-1].set_xlabel("time (s)", fontsize=style.NORMAL, color=INK)
    handles: dict[str, object] = {}
    for a in axes:
        for handle, text in zip(*a.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    style.legend(figure if ax is None else axes[0], list(handles.values()), list(handles))
    return figure


def _row(ax: Axes, data: Columns, values: np.ndarray, limit: np.ndarray | None, rate: float, name: str) -> None:
    """Values, threshold curve, templates."""
    time = data.middle / rate
    for i, t in enumerate(data.templates):
        ax.axvspan(t.begin / rate, t.end / rate, color=KEPT, alpha=0.16, linewidth=0, label=None if i else "template")
    ax.plot(time, values, color=NONE, linewidth=1.0, label="all displacements", zorder=2)
    for label, mask, colour, marker, size in (
        (data.found_means, data.found, FOUND, "o", 2.6),
        ("template, rejected", data.rejected, REJECTED, "X", 7.0),
    ):
        if (mask & np.isfinite(values)).any():
            ax.plot(
                time[mask], values[mask], linestyle="", marker=marker, color=colour, markersize=size,
                markeredgecolor=INK if marker == "X" else "none", markeredgewidth=0.6, label=label, zorder=3,
            )  # fmt: skip
    if limit is not None and limit.size:
        dashes = (4, 2) if name.startswith("σ") else (1.5, 1.5)
        ax.plot(time, limit, color=INK, linewidth=1.4, dashes=dashes, label=f"threshold {name}", zorder=4)


def _control_points(ax: Axes, data: Columns, field: str, rate: float) -> None:
    """The control points of a pattern that changes over time."""
    if data.turning and field == "sigma_max":
        return
    first = True
    for p in data.patterns:
        values = getattr(p, field)
        if p.frames and len(values) == len(p.frames):
            ax.plot(
                np.asarray(p.frames, float) / rate, np.asarray(values, float), linestyle="", marker="s", color=INK,
                markersize=5, markerfacecolor="white", zorder=5, label="control point" if first else None,
            )  # fmt: skip
            first = False


def _bars(ax: Axes, data: Columns, rate: float) -> None:
    """The merged constraints, as a bar at the top of the axes."""
    if len(data.constraints):
        ax.broken_barh(
            [((c.begin - 0.5) / rate, c.frames / rate) for c in data.constraints], (0.955, 0.045),
            transform=ax.get_xaxis_transform(), facecolors=TYPE_COLOURS[data.type], linewidth=0, zorder=6,
            label=f"{data.type} constraint", clip_on=True,
        )  # fmt: skip
