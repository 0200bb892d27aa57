"""What the pictures share: colours, axes, names made safe to draw, and what one picture shows of a detection.

Colours are those of Okabe and Ito, which stay apart for colour-blind eyes; shape or height always says the same again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ..annotations import Annotations, Constraint, Constraints, ConstraintType, NoisePattern, Template, check_type
from ..detect.results import Detection
from ..errors import OptionError, find_name

INK, QUIET, PAPER = "#2b2b33", "#8a8a94", "#ffffff"
NONE, KEPT, REJECTED, FOUND = "#b98079", "#009e73", "#e69f00", "#0072b2"
TYPE_COLOURS: dict[str, str] = {"space": "#0072b2", "line": "#cc79a7", "point": "#d55e00"}
TYPE_HEIGHTS: dict[str, float] = {"space": 1.0, "line": 0.7, "point": 0.4}
SMALL, NORMAL, TITLE = 8.5, 10.0, 11.5


def panels(
    ax: Axes | Sequence[Axes] | None,
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    left: float = 0.8,
    bottom: float = 1.05,
    top: float = 0.35,
    gap: float = 0.85,
    **options: Any,
) -> tuple[Figure, list[Axes]]:
    """The axes to draw on: those given (one or several), or those of a new figure of so many inches.

    Margins in inches: they are known beforehand, and a layout that measures every text takes as long as the drawing.
    """
    if ax is None:
        figure = Figure(figsize=(width, height), dpi=100, facecolor=PAPER)
        wide, tall = (
            (width - left - 0.2 - gap * (columns - 1)) / columns,
            (height - bottom - top - 0.2 * (rows - 1)) / rows,
        )
        figure.subplots_adjust(left / width, bottom / height, 1 - 0.2 / width, 1 - top / height, gap / wide, 0.2 / tall)
        return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)
    given = [ax] if isinstance(ax, Axes) else list(np.ravel(np.asarray(ax, dtype=object)))
    if not 1 <= len(given) <= rows * columns:
        raise OptionError(f"{len(given)} axes were given: this picture draws on 1 to {rows * columns}")
    return given[0].figure.figure, given


def legend(
    target: Figure | Axes, handles: Sequence[Any], labels: Sequence[str] | None = None, columns: int = 4
) -> None:
    """The legend: below the panels of a figure of ours, inside axes that were given."""
    texts = [h.get_label() for h in handles] if labels is None else list(labels)
    if isinstance(target, Figure):
        target.legend(list(handles), texts, loc="lower center", ncols=columns, fontsize=SMALL, frameon=False)
    else:
        target.legend(list(handles), texts, loc="best", fontsize=SMALL, framealpha=0.9)


def dress(ax: Axes, x: str, y: str, title: str = "", above: float = 6.0) -> None:
    """Labels, quiet grid, no box; the title stands so many points above the axes."""
    ax.set_xlabel(x, fontsize=NORMAL, color=INK)
    ax.set_ylabel(y, fontsize=NORMAL, color=INK)
    if title:
        ax.set_title(title, fontsize=TITLE, color=INK, loc="left", y=1.0, pad=above)
    ax.tick_params(labelsize=SMALL, colors=INK)
    ax.grid(True, color=QUIET, alpha=0.25, linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


@cache
def _drawable(character: str) -> bool:
    return character.isprintable() and get_font(findfont("DejaVu Sans")).get_char_index(ord(character)) != 0


def plain(name: object, longest: int = 28) -> str:
    """A name as text that can always be drawn: no mathematics mode, no missing glyph, no line break, not too long."""
    text = "".join(c if " " <= c <= "~" or _drawable(c) else "\u25a1" for c in str(name))
    if len(text) > longest:
        text = f"{text[: longest - longest // 3 - 1]}\u2026{text[-(longest // 3) :]}"
    return text.replace("$", r"\$")


def wide_scale(ax: Axes, which: str, values: np.ndarray, marks: Iterable[float] = ()) -> None:
    """Logarithmic with a linear piece at 0 where the values span more than a decade, linear elsewhere; limits to match.

    `which` is "x" or "y"; `marks` are thresholds that must stay in sight.
    """
    values = np.asarray(values, float)
    marks = [m for m in marks if np.isfinite(m) and m > 0]
    positive = values[np.isfinite(values) & (values > 0)]
    high = max([*marks, positive.max() if positive.size else 0.0])
    if high == 0:
        return
    low = min([*(0.3 * m for m in marks), max(np.percentile(positive, 5), 1e-4 * high) if positive.size else high])
    set_scale = ax.set_xscale if which == "x" else ax.set_yscale
    if high > 10 * low:
        start = 10.0 ** np.floor(np.log10(low))
        set_scale("symlog", linthresh=start, linscale=0.4)
        plain_ticks(ax, which, -0.15 * start, 1.8 * high)
    else:
        plain_ticks(ax, which, -0.02 * high, 1.1 * high, few=True)


def plain_ticks(ax: Axes, which: str, low: float, high: float, few: bool = False) -> None:
    """Limits and tick labels that are plain numbers however small they are; `few`: at most six of them."""
    (ax.set_xlim if which == "x" else ax.set_ylim)(low, high)
    axis = ax.xaxis if which == "x" else ax.yaxis
    if few:
        axis.set_major_locator(MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.4g}"))


def frame_axis(ax: Axes, rate: float) -> None:
    """A second axis at the top that counts frames, for an axis in seconds."""
    top = ax.secondary_xaxis("top", functions=(partial(np.multiply, rate), partial(np.multiply, 1 / rate)))
    top.xaxis.set_major_locator(MaxNLocator(nbins=9, integer=True, min_n_ticks=1))
    top.set_xlabel("frame", fontsize=NORMAL, color=INK)
    top.tick_params(labelsize=SMALL, colors=INK)
    top.spines["top"].set_color(QUIET)


def constraints_of(source: Detection | Annotations | Iterable[Constraint] | None) -> Constraints:
    """The constraints of whatever carries some."""
    if source is None:
        return Constraints()
    if isinstance(source, Detection | Annotations):
        return source.constraints
    return source if isinstance(source, Constraints) else Constraints(tuple(source))


def owned(constraints: Constraints, name: str) -> Constraints:
    """Those of the object of exactly this name; two names may differ in case alone."""
    return Constraints(tuple(c for c in constraints if c.object == name))


@dataclass(frozen=True)
class Columns:
    """What one picture shows of a detection: one object, one constraint type, NumPy arrays over displacements (N,).

    `sigma`, `eps` are NaN where an end was not seen. `found`, `kept`, `rejected`: masks. `sigma_max`, `eps_max`: (N,)
    or `None`. `turning`: sigma is the rotation, since sigma_1 of a rigid object is rounding noise and decides nothing.
    """

    object: str
    type: ConstraintType
    middle: np.ndarray
    sigma: np.ndarray
    eps: np.ndarray
    found: np.ndarray
    kept: np.ndarray
    rejected: np.ndarray
    sigma_max: np.ndarray | None
    eps_max: np.ndarray | None
    found_means: str
    turning: bool
    labels: tuple[str, str]
    units: tuple[str, str]
    constraints: Constraints
    patterns: tuple[NoisePattern, ...]
    templates: tuple[Template, ...]


def columns(detection: Detection, object: str, type: str = "space") -> Columns:
    """The columns of one object and one constraint type; `UnknownNameError` lists the nearest names."""
    kind = check_type(type)
    at = find_name(object, detection.objects, "object", detection.clip)
    name = detection.objects[at]

    def column(values: Any, dtype: Any = float) -> np.ndarray:
        return np.asarray(values)[:, at].astype(dtype)

    middle, valid = np.asarray(detection.middle, float), column(detection.valid, bool)
    sigma, eps = (detection.sigma_3, detection.eps_3) if kind == "space" else (detection.sigma_1, detection.eps_1)
    sigma, eps = np.where(valid, column(sigma), np.nan), np.where(valid, column(eps), np.nan)
    sigma_max = column(detection.sigma_max[kind]) if kind in detection.sigma_max else None
    eps_max = column(detection.eps_max[kind]) if kind in detection.eps_max else None
    turning = kind != "space" and not (sigma > 1e-4).any()
    if turning:
        sigma, sigma_max = np.where(valid, column(detection.sigma_3), np.nan), None
    mine = tuple(p for p in detection.patterns if p.object == name) or tuple(
        p for p in detection.patterns if p.object.casefold() == name.casefold()
    )
    templates = tuple(dict.fromkeys(t for p in mine for t in p.templates if t.object.casefold() == name.casefold()))
    marks = column(detection.template, int) * valid
    own = tuple(t for t in templates if t.type == kind)
    if templates:
        marks = marks * np.any([np.zeros_like(valid), *((middle >= t.begin) & (middle <= t.end) for t in own)], axis=0)
    else:
        own = _runs(marks > 0, middle, name, kind)
    constraints = owned(detection.constraints.of(type=kind), name)
    found, means = (column(detection.passed, int) == (1 if kind == "space" else 2)) & valid, "detected"
    if kind != "space" and not found.any() and len(constraints):
        means = f"inside a {kind} constraint"
        found = valid & np.any([(middle >= c.begin) & (middle <= c.end) for c in constraints], axis=0)
    second = "second" in detection.unit or "/s" in detection.unit
    units = ("rad/s", "m/s") if second else ("rad", "m")
    across = "rotation σ₃" if kind == "space" or turning else "singular value σ₁"
    upward = "residual ε₃" if kind == "space" else "residual ε₁"
    return Columns(
        object=name, type=kind, middle=middle, sigma=sigma, eps=eps, found=found, kept=marks == 1, rejected=marks == 2,
        sigma_max=sigma_max, eps_max=eps_max, found_means=means, turning=turning,
        labels=(f"{across} ({units[0]})", f"{upward} ({units[1]})"), units=units, constraints=constraints,
        patterns=tuple(p for p in mine if p.type == kind), templates=own,
    )  # fmt: skip


def _runs(marked: np.ndarray, middle: np.ndarray, name: str, kind: ConstraintType) -> tuple[Template, ...]:
    """Runs of marked displacements, as templates."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    return tuple(
        Template(name, int(np.floor(middle[a])), int(np.ceil(middle[b - 1])), kind) for a, b in edges.reshape(-1, 2)
    )


def span(values: np.ndarray | None) -> tuple[float, ...]:
    """Least and greatest finite value, one number where they agree, nothing where there is none."""
    if values is None or not np.isfinite(values).any():
        return ()
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return (low,) if high - low <= 1e-6 * abs(high) else (low, high)
