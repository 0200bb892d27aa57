"""How found frames are counted against labelled ones: the two ways, each for one object of one clip.

In: masks of frames. Out: `Counts`. `against_bounds` is for outer bounds (a foot's stance by force: it is flat in some part of it,
and contact is unknown elsewhere); `against_frames` is for labels that say of every frame what it is. Source of the first: the
counting of stances in `benchmarks/forceplates`, which calls it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .spans import core

CORE = (0.25, 0.55)
"""The part of a stance in which a foot is flat in everyone's walk."""
REACH = 0.25
"""Seconds around a bound in which frames count."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Frames: `found` of those that count and `right` of these; `wanted` and `hit` of these; `whole` and `whole_hit` of these.

    `wanted` are the label's frames, or those of its core where it is an outer bound; `whole` always all of them.
    """

    found: int = 0
    right: int = 0
    wanted: int = 0
    hit: int = 0
    whole: int = 0
    whole_hit: int = 0


def near(begin: int, end: int, frames: int, fps: float, reach: float = REACH) -> np.ndarray:
    """Mask (frames,): the frames of a label and those within `reach` seconds of it."""
    around = round(reach * fps)
    out = np.zeros(frames, bool)
    out[max(0, begin - around) : max(0, end + 1 + around)] = True
    return out


def against_bounds(
    found: np.ndarray,
    begin: int,
    end: int,
    known: np.ndarray,
    fps: float,
    part: tuple[float, float] = CORE,
    reach: float = REACH,
) -> Counts:
    """Found frames (frames,) bool against one outer bound `begin..end`, both included.

    known: (frames,) what is known of each frame: positive inside of a label of the object, 0 outside, negative where
    nothing is known, which counts in nothing. Precision is over the frames within `reach` seconds, where a frame of another
    label is right too; recall over the part `part` of the bound, and over all of it.
    """
    judged = known >= 0
    here = found & judged & near(begin, end, len(found), fps, reach)
    first, after = core(begin, end, part)

    def count(low: int, high: int) -> tuple[int, int]:
        at = slice(low, max(low, high))
        return int(judged[at].sum()), int((found & judged)[at].sum())

    return Counts(int(here.sum()), int((here & (known > 0)).sum()), *count(first, after), *count(begin, end + 1))


def against_frames(found: np.ndarray, wanted: np.ndarray, judged: np.ndarray) -> Counts:
    """Found frames against wanted ones, masks (frames,), over the frames that are `judged`."""
    hit = int((found & wanted & judged).sum())
    total = int((wanted & judged).sum())
    return Counts(int((found & judged).sum()), hit, total, hit, total, hit)


def errors(spans: np.ndarray, begin: int, end: int, fps: float) -> tuple[float, float] | None:
    """Begin and end in seconds, late positive, of all spans that share a frame with `begin..end`, as one; None without any."""
    spans = np.asarray(spans, int).reshape(-1, 2)
    own = spans[(spans[:, 0] <= end) & (spans[:, 1] >= begin)]
    return (float(own[:, 0].min() - begin) / fps, float(own[:, 1].max() - end) / fps) if len(own) else None
