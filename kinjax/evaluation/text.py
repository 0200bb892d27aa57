"""An evaluation in words: a table of scores, and what was left out.

In: `Evaluation`. Out: text without colours, at most as wide as its names ask for.
"""

from __future__ import annotations

import math

from .results import Evaluation
from .scores import ALL, ANY, Score, Spread

HEAD = ("object", "type", "labels", "P", "R", "F1", "whole R", "int. P", "int. R", "int. F1", "begin ms", "end ms")


def shown(evaluation: Evaluation) -> list[Score]:
    """The scores without those that say what another one says: an object of one type, a type of one object, a single row."""
    scores = evaluation.scores
    pairs = [(s.object, s.type) for s in scores if s.object is not None and s.type is not None]
    objects: list[str | None] = [o for o, _ in pairs]
    types: list[str | None] = [t for _, t in pairs]

    def worth(s: Score) -> bool:
        if s.object is not None and s.type is not None:
            return True
        if s.object is None and s.type is None:
            return len(pairs) != 1
        if s.type is None:
            return objects.count(s.object) > 1 and len(set(objects)) > 1
        return types.count(s.type) > 1 and len(set(types)) > 1

    return [s for s in scores if worth(s)]


def cells(score: Score) -> tuple[str, ...]:
    """One score as the cells under `HEAD`."""
    kind = ALL if score.type is None else score.type or ANY
    ratios = (score.precision, score.recall, score.f1, score.whole_recall)
    by_interval = (score.interval_precision, score.interval_recall, score.interval_f1)
    errors = _spread(score.begin), _spread(score.end)
    return (score.object or ALL, kind, str(score.labels), *map(_ratio, (*ratios, *by_interval)), *errors)


def describe(evaluation: Evaluation) -> str:
    """The whole evaluation as text."""
    rows = [HEAD, *map(cells, shown(evaluation))]
    widths = [max(len(r[i]) for r in rows) for i in range(len(HEAD))]
    lines = [
        "  ".join(x.ljust(w) if i < 2 else x.rjust(w) for i, (x, w) in enumerate(zip(r, widths, strict=True))).rstrip()
        for r in rows
    ]
    n = len(evaluation.labels)
    clips = f"{evaluation.clips} clip{'s' * (evaluation.clips != 1)}, {n} labelled interval{'s' * (n != 1)}"
    return "\n".join([clips, *lines, *evaluation.left.lines()])


def _ratio(x: float) -> str:
    return "-" if math.isnan(x) else f"{x:.3f}"


def _spread(x: Spread) -> str:
    return f"{_ms(x.median)} [{_ms(x.low)}, {_ms(x.high)}]" if x.count else "-"


def _ms(x: float) -> str:
    return f"{round(x):+d}"
