"""How labels are counted against a stance.

In: the labelled frames of one foot, and one stance of it. Out: `Score`, counts of that stance; `total` pools stances. Frames
are counted by `kinjax.evaluation`.

Contact is unknown elsewhere on the floor, so precision counts only labels within 0.25 s of the stance, and none
in a contact that was left out. Core recall is that of the middle 25 to 55 % of the stance. The constraints' begin and
end are held against the frames in which every marker of the foot moves under 0.15 m/s, and against the stance itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from kinjax.evaluation.counting import REACH as AROUND
from kinjax.evaluation.counting import against_bounds, errors

from .trials import CORE, Stance, speeds

STILL = 0.15
"""m/s: a foot is flat while every marker of it is slower."""


@dataclass(frozen=True)
class Score:
    """One stance. Counts of frames: `labelled` near it, and `right` of these; `core` and `stance`, and those `hit`.

    Errors in seconds, NaN where nothing overlaps the stance: `begin`, `end` against the flat foot, `strike`, `off`
    against the stance; negative is too early.
    """

    labelled: int
    right: int
    core: int
    core_hit: int
    stance: int
    stance_hit: int
    begin: float = np.nan
    end: float = np.nan
    strike: float = np.nan
    off: float = np.nan


@dataclass(frozen=True)
class Total:
    """Pooled stances: precision, core and stance recall, median errors in milliseconds, and how many there were."""

    precision: float
    core: float
    recall: float
    begin: float
    end: float
    strike: float
    off: float
    stances: int
    worst_precision: float
    worst_core: float


def score(
    labelled: np.ndarray,
    spans: Sequence[tuple[int, int]],
    stance: Stance,
    contact: np.ndarray,
    rate: float,
    flat: tuple[int, int] | None = None,
) -> Score:
    """Count one stance.

    labelled: frames under a constraint (bool). spans: the constraints, first and last frame. contact: by frame, 1 in a
    stance that counts, -1 in one that does not (see `Trial.contact`). flat: first and last frame of the flat foot.
    """
    first, last = stance.begin, stance.end - 1
    counts = against_bounds(labelled, first, last, contact, rate, CORE, AROUND)
    late = errors(np.array(spans, int).reshape(-1, 2), first, last, rate)
    flat_late = (np.nan, np.nan)
    if late and flat:  # both are off by what the flat foot and the stance differ
        flat_late = late[0] - (flat[0] - first) / rate, late[1] - (flat[1] - last) / rate
    return Score(*astuple(counts), *flat_late, *(late or (np.nan, np.nan)))


def flat_frames(markers: np.ndarray, stance: Stance, rate: float) -> tuple[int, int] | None:
    """First and last frame of the stance in which every marker is under `STILL`; None if there is no such frame."""
    with np.errstate(invalid="ignore"):
        still = (speeds(markers, rate) < STILL).all(-1)
    at = stance.begin + np.flatnonzero(still[stance.begin : stance.end])
    return (int(at[0]), int(at[-1])) if len(at) else None


def total(scores: Iterable[Score]) -> Total:
    """All stances together: frames pooled, medians of errors. Precision is NaN where nothing was labelled."""
    scores = list(scores)

    def ratio(hit: str, of: str) -> tuple[float, float]:
        x = np.array([[getattr(s, hit), getattr(s, of)] for s in scores], float).reshape(-1, 2)
        each = x[x[:, 1] > 0]
        if not len(each):
            return np.nan, np.nan
        return float(each[:, 0].sum() / each[:, 1].sum()), float((each[:, 0] / each[:, 1]).min())

    def median(name: str) -> float:
        x = np.array([getattr(s, name) for s in scores], float)
        x = x[np.isfinite(x)]
        return float(np.median(x) * 1e3) if len(x) else np.nan

    (precision, worst_precision), (core, worst_core) = ratio("right", "labelled"), ratio("core_hit", "core")
    return Total(
        precision, core, ratio("stance_hit", "stance")[0], *(median(n) for n in ("begin", "end", "strike", "off")),
        len(scores), worst_precision, worst_core,
    )
