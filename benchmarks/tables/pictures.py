"""What was found, drawn against the labels: a panel a way to detect, a row an effector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from kinjax.annotations import Annotations, Constraint, Constraints, NoisePattern
from kinjax.plots import timeline

from .labels import Case, Labels, Span
from .scores import Score

FOUND, AMBIGUOUS, HELD, TEMPLATE = "#0072b2", "#e69f00", "#009e73", "black"
ROW = 1.55  # of one object in `plots.timeline` with truth


def picture(case: Case, labels: Labels, shown: Mapping[str, Mapping[str, Score]]) -> Figure:
    """shown: by way to detect, a score of each effector.

    Hatched: planted by eye; orange: the eye could not decide; green: held still in the air; black: the template.
    """
    figure = Figure(figsize=(13, 0.9 + len(shown) * (1.0 + 0.5 * len(case.effectors))), layout="constrained")
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    truth = [_bar(e, s, labels.fps) for e in case.effectors for s in labels.planted[e]]
    order = tuple(NoisePattern(e, "space", (), ()) for e in case.effectors)
    for ax, (way, scores) in zip(axes, shown.items(), strict=True):
        found = Constraints.sorted(c for s in scores.values() for c in s.constraints)
        timeline(Annotations(case.clip, labels.fps, labels.frames, found, order), truth, ax=ax)
        for y, e in enumerate(case.effectors):
            template = scores[e].template
            below, above = ROW * y + 0.45, ROW * y - 0.44
            _more(ax, labels.ambiguous[e], labels.fps, below, 0.42, AMBIGUOUS)
            _more(ax, labels.held_free.get(e, ()), labels.fps, below, 0.42, HELD)
            _more(ax, (template,) if template else (), labels.fps, above, 0.1, TEMPLATE)
        wrong = ", ".join(f"{e} {scores[e].mislabelled}" for e in case.effectors)
        ax.set_title(f"{case.clip} {case.title}, {way}: mislabelled frames {wrong}", fontsize=10, loc="left")
        if legend := ax.get_legend():
            legend.remove()
        for inner in ax.child_axes:
            inner.remove()
        if ax is not axes[-1]:
            ax.set_xlabel("")
    handles = [
        Patch(facecolor=FOUND, label="found"),
        Patch(facecolor="white", edgecolor=FOUND, hatch="//////", label="planted by eye"),
        Patch(facecolor=TEMPLATE, label="template"),
        Patch(facecolor=AMBIGUOUS, alpha=0.55, label="ambiguous by eye"),
        Patch(facecolor=HELD, alpha=0.55, label="held still in the air"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return figure


def _bar(effector: str, span: Span, rate: float) -> Constraint:
    return Constraint(effector, "space", span.begin, span.end, (0.0, 0.0, 0.0), fps=rate)


def _more(ax: Axes, spans: Sequence[Span], rate: float, low: float, height: float, colour: str) -> None:
    bars = [((s.begin - 0.5) / rate, s.frames / rate) for s in spans]
    ax.broken_barh(bars, (low, height), facecolors=colour, alpha=1.0 if colour == TEMPLATE else 0.55, zorder=4)
