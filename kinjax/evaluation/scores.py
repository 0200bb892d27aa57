"""Counts of one object and type, and what follows from them: precision, recall, F1, errors of begins and ends.

In: counts of frames and intervals, errors in milliseconds (positive: found too late). Out: ratios and quartiles; NaN where there
is nothing to divide by.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any

import numpy as np

ALL, ANY = "all", "any"
"""How a total, and a label without type, are called in tables."""


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of errors, milliseconds, and their number."""

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Of milliseconds; NaN where there are none."""
        if not len(values):
            return cls(math.nan, math.nan, math.nan, 0)
        low, middle, high = np.quantile(np.asarray(values, float), (0.25, 0.5, 0.75)).tolist()
        return cls(middle, low, high, len(values))


@dataclass(frozen=True)
class Score:
    """Counts of one object and type (None: all together), in frames or seconds, and the ratios that follow.

    found, right: what was found where it counts, and what of it is right. wanted, hit: what recall is over, whole labels or the
    cores of outer bounds, and what of it was found. whole, whole_hit: the same over whole labels always.
    labels, labels_hit: intervals that are labelled, and matched. intervals, intervals_right: the same of what was found.
    """

    object: str | None
    type: str | None
    clips: int = 0
    found: float = 0.0
    right: float = 0.0
    wanted: float = 0.0
    hit: float = 0.0
    whole: float = 0.0
    whole_hit: float = 0.0
    labels: int = 0
    labels_hit: int = 0
    intervals: int = 0
    intervals_right: int = 0
    begin_errors: tuple[float, ...] = field(default=(), repr=False)
    end_errors: tuple[float, ...] = field(default=(), repr=False)

    @classmethod
    def pooled(cls, object: str | None, type: str | None, parts: Iterable[Score], clips: int) -> Score:
        """Several together: counts are summed, errors put after each other."""
        parts = list(parts)
        sums: dict[str, Any] = {f.name: sum(getattr(p, f.name) for p in parts) for f in fields(cls)[3:-2]}
        for n in ("begin_errors", "end_errors"):
            sums[n] = tuple(chain.from_iterable(getattr(p, n) for p in parts))
        return cls(object, type, clips, **sums)

    @property
    def precision(self) -> float:
        """The part of what was found that is right."""
        return _ratio(self.right, self.found)

    @property
    def recall(self) -> float:
        """The part of what is wanted that was found."""
        return _ratio(self.hit, self.wanted)

    @property
    def whole_recall(self) -> float:
        """The part of whole labels that was found: of a stance, say, from first to last contact."""
        return _ratio(self.whole_hit, self.whole)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 0 where one of them is 0, whatever the other; else NaN if one is."""
        return _harmonic(self.precision, self.recall)

    @property
    def interval_precision(self) -> float:
        """The part of the found intervals that are right."""
        return _ratio(self.intervals_right, self.intervals)

    @property
    def interval_recall(self) -> float:
        """The part of the labelled intervals that were found."""
        return _ratio(self.labels_hit, self.labels)

    @property
    def interval_f1(self) -> float:
        """Harmonic mean of the two."""
        return _harmonic(self.interval_precision, self.interval_recall)

    @property
    def begin(self) -> Spread:
        """Errors of begins, ms."""
        return Spread.of(self.begin_errors)

    @property
    def end(self) -> Spread:
        """Errors of ends, ms."""
        return Spread.of(self.end_errors)

    def row(self) -> dict[str, Any]:
        """Everything as one flat row."""
        out: dict[str, Any] = {
            "object": ALL if self.object is None else self.object,
            "type": ALL if self.type is None else self.type or ANY,
            "clips": self.clips,
        }
        for name in ("precision", "recall", "f1", "whole_recall", "interval_precision", "interval_recall", "interval_f1"):
            out[name] = getattr(self, name)
        for name in ("begin", "end"):
            spread = getattr(self, name)
            out |= {f"{name}_ms": spread.median, f"{name}_low_ms": spread.low, f"{name}_high_ms": spread.high}
        out["errors"] = len(self.begin_errors)
        counts = ("found", "right", "wanted", "hit", "whole", "whole_hit", "labels", "labels_hit", "intervals", "intervals_right")
        return out | {name: getattr(self, name) for name in counts}


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _harmonic(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return 0.0 if a == 0 or b == 0 else math.nan
    return 2 * a * b / (a + b) if a + b else 0.0
