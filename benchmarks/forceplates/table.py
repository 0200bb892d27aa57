"""All methods on all trials under all conditions, and the table of it.

In: trials. Out: `Total`s by method and condition, and text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from .conditions import CONDITIONS, disturbed
from .methods import METHODS, PIVOTS, labels_of
from .scoring import Score, Total, flat_frames, score, total
from .trials import Stance, Trial

Results = dict[tuple[str, str], list[tuple[Trial, Stance, Score]]]
"""By method and condition: the score of every stance."""


def evaluate(
    trials: Iterable[Trial],
    methods: Sequence[str] | None = None,
    conditions: Sequence[str] | None = None,
    seeds: int = 1,
    progress: Callable[[str], object] = lambda line: None,
) -> Results:
    """Score the stances of `trials` by the named methods under the named conditions (all when None).

    seeds: draws of each noise. progress: is told of every trial that is done, in one line.
    """
    out: Results = {}
    for trial in trials:
        flat = [flat_frames(trial.markers[s.foot], s, trial.rate) for s in trial.stances]
        contact = {foot: trial.contact(foot) for foot in trial.markers}
        for condition in conditions or CONDITIONS:
            for seed in range(1 if condition == "clean" else seeds):
                markers = disturbed(trial.markers, trial.rate, condition, trial.name, seed)
                for method in methods or (*METHODS, *PIVOTS):
                    for s, f, y in zip(trial.stances, flat, labels_of(method, trial, markers), strict=True):
                        one = score(y.frames, y.spans, s, contact[s.foot], trial.rate, f)
                        out.setdefault((method, condition), []).append((trial, s, one))
        found = ", ".join(f"{s.foot} {s.begin}:{s.end} {s.source}" for s in trial.stances)
        counts = f"{len(trial.stances)} stances ({found}), {len(trial.left_out)} left out"
        progress(f"{trial.name}: {trial.frames} frames at {trial.rate:g} Hz, {counts}")
    return out


def totals(results: Results) -> dict[tuple[str, str], Total]:
    """Pooled by method and condition."""
    return {key: total(one for _, _, one in rows) for key, rows in results.items()}


def report(results: Results, markdown: bool = False) -> str:
    """The tables as text: space against the core of stance, and space with pivots against the whole stance."""
    pooled = totals(results)
    conditions = list(dict.fromkeys(c for _, c in pooled))
    methods = list(dict.fromkeys(m for m, _ in pooled))
    parts = []
    space = {m: {c: pooled[m, c] for c in conditions} for m in methods if m not in PIVOTS}
    pivots = {m: {c: pooled[m, c] for c in conditions} for m in methods if m in PIVOTS}
    if space:
        title = "P, core recall, begin/end against the flat foot (median, ms)"
        parts += [title, _lines(space, _space_cell, _worst_core, markdown)]
        parts += ["recall of the whole stance", _lines(space, lambda t: _ratio(t.recall), _worst_recall, markdown)]
    if pivots:
        parts += [
            "P, recall of the whole stance, heel strike/toe-off (median, ms)",
            _lines(pivots, _pivot_cell, _worst_whole, markdown),
        ]
    return "\n\n".join(parts)


def misses(results: Results, least: float = 0.98) -> list[str]:
    """One line for each stance whose own precision or core recall is under `least`."""
    out = []
    for (method, condition), rows in results.items():
        for trial, s, one in rows:
            precision = one.right / one.labelled if one.labelled else np.nan
            core = one.core_hit / one.core if one.core else np.nan
            low_core = core < least and method not in PIVOTS
            if precision < least or low_core:
                out.append(
                    f"{method} | {condition} | {trial.name} {s.foot} {s.begin}:{s.end} | P {_ratio(precision)} "
                    f"({one.labelled - one.right} frames wrong), core {_ratio(core)}"
                )
    return out


def _space_cell(t: Total) -> str:
    return f"{_ratio(t.precision)} {_ratio(t.core)} {_ms(t.begin)}/{_ms(t.end)}"


def _pivot_cell(t: Total) -> str:
    return f"{_ratio(t.precision)} {_ratio(t.recall)} {_ms(t.strike)}/{_ms(t.off)}"


def _worst_core(row: Sequence[Total]) -> str:
    return f"{_least(t.precision for t in row)} {_least(t.core for t in row)}"


def _worst_recall(row: Sequence[Total]) -> str:
    return _least(t.recall for t in row)


def _worst_whole(row: Sequence[Total]) -> str:
    return f"{_least(t.precision for t in row)} {_least(t.recall for t in row)}"


def _least(values: Iterable[float]) -> str:
    finite = [v for v in values if np.isfinite(v)]
    return _ratio(min(finite, default=np.nan))


def _ratio(x: float) -> str:
    return f"{x:.3f}" if np.isfinite(x) else "-"


def _ms(x: float) -> str:
    return f"{x:+.0f}" if np.isfinite(x) else "-"


def _lines(
    rows: Mapping[str, Mapping[str, Total]],
    cell: Callable[[Total], str],
    worst: Callable[[Sequence[Total]], str],
    markdown: bool,
) -> str:
    """Rows of cells, with a last column of the worst."""
    conditions = list(next(iter(rows.values())))
    table = [["", *conditions, "worst"]]
    table += [[name, *(cell(row[c]) for c in conditions), worst(list(row.values()))] for name, row in rows.items()]
    widths = [max(len(line[i]) for line in table) for i in range(len(table[0]))]
    text = [" | ".join(x.ljust(w) for x, w in zip(line, widths, strict=True)).rstrip() for line in table]
    text.insert(1, "-|-".join("-" * w for w in widths))
    return "\n".join(f"| {line} |" if markdown else line for line in text)
