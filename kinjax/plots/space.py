"""The sigma-epsilon space (figures 3 and 5), and the residual in local and global displacements (figures 8 and 9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..detect.results import Detection
from ..errors import OptionError
from . import style
from .style import FOUND, INK, KEPT, NONE, QUIET, REJECTED, SMALL, Columns


def sigma_epsilon(
    detection: Detection, object: str, type: str = "space", ax: Axes | Sequence[Axes] | None = None
) -> Figure:
    """Each displacement of one object as a point of the sigma-epsilon space (figures 3 and 5).

    Two panels, all of it and a close-up round the thresholds: displacements under no constraint, detected ones, those
    of templates that the estimator kept, and those that it rejected. Dashed lines are the thresholds; two of a kind are
    the least and the greatest value of a threshold that changes over time. `ax`: one axes (all of it) or two.
    """
    data = style.columns(detection, object, type)
    figure, axes = style.panels(ax, 9.2, 4.1, 1, 2)
    titles = (f"{style.plain(data.object)}: {data.type} constraint", "close-up at the thresholds")
    for i, (a, title) in enumerate(zip(axes, titles, strict=False)):
        style.dress(a, *data.labels, title)
        _points(a, data, size=13.0 if i == 0 else 20.0)
        _thresholds(a, data)
        if not np.isfinite(data.eps).any():
            a.text(0.5, 0.5, "no displacement was seen", transform=a.transAxes, ha="center", color=QUIET)
            a.set(xlim=(0, 1), ylim=(0, 1))
        elif i == 0:
            style.wide_scale(a, "x", data.sigma, style.span(data.sigma_max))
            style.wide_scale(a, "y", data.eps, style.span(data.eps_max))
        else:
            _close_up(a, data)
    style.legend(figure if ax is None else axes[0], *axes[0].get_legend_handles_labels(), columns=3)
    return figure


def _points(ax: Axes, data: Columns, size: float) -> None:
    """One scatter a class, most telling on top; each point belongs to one class."""
    seen, marked = np.isfinite(data.sigma) & np.isfinite(data.eps), data.kept | data.rejected
    classes = (
        ("none", seen & ~data.found & ~marked, NONE, "o", 0.55),
        (data.found_means, seen & data.found & ~marked, FOUND, "o", 0.6),
        ("template, kept", seen & data.kept, KEPT, "D", 0.9),
        ("template, rejected", seen & data.rejected, REJECTED, "X", 1.0),
    )
    for label, mask, colour, marker, alpha in classes:
        if mask.any() or label == "none":
            ax.scatter(
                data.sigma[mask], data.eps[mask], s=size * (2.2 if marker == "X" else 1.0), c=colour, marker=marker,
                alpha=alpha, linewidths=0.6 if marker == "X" else 0, edgecolors=INK if marker == "X" else "none",
                label=f"{label} ({mask.sum()})", zorder=3,
            )  # fmt: skip


def _thresholds(ax: Axes, data: Columns) -> None:
    """Threshold lines, named with their values, and the shaded rectangle in which a displacement passes."""
    x, y = style.span(data.sigma_max), style.span(data.eps_max)
    for values, draw, name, unit, dashes in (
        (x, ax.axvline, "σ max", data.units[0], (4, 2)),
        (y, ax.axhline, "ε max", data.units[1], (1.5, 1.5)),
    ):
        label = f"{name} {' to '.join(f'{v:.3g}' for v in values)} {unit}"
        for v in values:
            draw(v, color=INK, linewidth=1.1, dashes=dashes, label=label if v == values[0] else None, zorder=2)
    if y:
        right = x[-1] if x else 1.0
        where: dict[str, Any] = {} if x else {"transform": ax.get_yaxis_transform()}
        ax.add_patch(Rectangle((0, 0), right, y[-1], facecolor=FOUND, alpha=0.08, linewidth=0, zorder=1, **where))


def _close_up(ax: Axes, data: Columns) -> None:
    """Linear axes to twice the thresholds; without thresholds to the median."""
    for values, limits, which in ((data.sigma, data.sigma_max, "x"), (data.eps, data.eps_max, "y")):
        seen, marks = values[np.isfinite(values)], style.span(limits)
        high = 2.0 * marks[-1] if marks else float(np.percentile(seen, 90 if data.turning else 50))
        high = high if high > 0 else max(float(seen.max()), 1e-6)
        style.plain_ticks(ax, which, -0.02 * high, high, few=True)


def local_against_global(
    times: np.ndarray,
    local_here: np.ndarray,
    local_there: np.ndarray,
    global_here: np.ndarray,
    global_there: np.ndarray,
    offset: float | Sequence[float],
    unit: str = "m",
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """The residual of one motion at two places of the scene, in global and in local displacements (figures 8 and 9).

    `times` (N,) seconds; the others (N,) residuals of the clip as it stands and moved by `offset` (metres, a distance
    or a vector). One scale for both panels: the global residual depends on the place, the local one does not.
    """
    figure, axes = style.panels(ax, 9.2, 3.9, 1, 2, bottom=0.6, gap=0.25, sharey=True)
    if len(axes) != 2:
        raise OptionError("one axes was given: this picture draws on two, global and local")
    far = float(np.linalg.norm(np.atleast_1d(np.asarray(offset, float))))
    times = np.asarray(times, float)
    pairs = [[np.asarray(v, float) for v in p] for p in ((global_here, global_there), (local_here, local_there))]
    for a, name, (here, there) in zip(axes, ("global", "local"), pairs, strict=True):
        differ = np.abs(here - there)
        most = f"{np.nanmax(differ):.2g} {unit}" if np.isfinite(differ).any() else "none seen"
        style.dress(a, "time (s)", f"residual ε ({unit})", f"{name} displacements: differ by up to {most}")
        a.plot(times, there, color=REJECTED, linewidth=2.6, label=f"moved by {far:g} m")
        a.plot(times, here, color=INK, linewidth=1.0, linestyle=(0, (4, 1.5)), label="where it was recorded")
        style.wide_scale(a, "y", np.concatenate([v for p in pairs for v in p]))
    axes[1].set_ylabel("")
    axes[0].legend(fontsize=SMALL, loc="best", framealpha=0.9)
    return figure
