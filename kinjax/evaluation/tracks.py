"""One object of one clip: what was found of it against what is labelled.

In: `Track`, spans in the frames of the clip. Out: a `Score` and the fate of each label. What counts where:

* exact labels: every frame of the clip, but unknown ones. Found and labelled intervals are matched one to one by overlap.
* outer bounds: the frames within reach of each bound, for each bound on its own (a frame within reach of two counts at both, as
  each stance of a walk is judged with the swing before and after it), and every frame where nothing must be found. A bound is
  found by the found interval that has most of its frames in it.
* no label but "none": the frames of those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from .counting import Counts, against_bounds, against_frames, errors, near
from .results import Counting, LabelScore
from .scores import Score
from .spans import frames_in, matched, merged, overlaps

NOTHING = np.zeros((0, 2), int)


@dataclass(frozen=True)
class Track:
    """Spans (n, 2), first and last frame, of one object in one clip of `frames` frames at `fps` a second.

    type: of the labels; "" where any type will do. kind: of `labels`, "exact" or "outer". none: nothing must be found there;
    unknown: nothing counts there, whatever else is said of it.
    """

    clip: str
    object: str
    type: str
    kind: str
    frames: int
    fps: float
    found: np.ndarray
    labels: np.ndarray
    none: np.ndarray
    unknown: np.ndarray


def judge(track: Track, how: Counting) -> tuple[Score, list[LabelScore]]:
    """Count one track."""
    gap = -1 if track.type else int(how.join * track.fps + 1e-9)
    spans = merged(track.found)
    intervals = merged(track.found, gap)
    judged = ~frames_in(track.unknown, track.frames)
    found = frames_in(spans, track.frames)
    empty = frames_in(track.none, track.frames) & judged
    if track.kind == "outer":
        return _outer(track, how, spans, intervals, found, judged, empty)
    if len(track.labels):
        return _exact(track, how, intervals, merged(track.labels, gap), found, judged)
    wrong = int(np.count_nonzero(_mostly(intervals, empty)))
    return _score(track, how, [against_frames(found, np.zeros_like(found), empty)], intervals=wrong), []


def _exact(
    track: Track, how: Counting, intervals: np.ndarray, labels: np.ndarray, found: np.ndarray, judged: np.ndarray
) -> tuple[Score, list[LabelScore]]:
    wanted = frames_in(track.labels, track.frames)  # without the gaps that labels were joined over
    labels = labels[_mostly(labels, judged)]
    pairs = {j: i for i, j in matched(intervals, labels, how.iou)}
    free = np.ones(len(intervals), bool)
    free[list(pairs.values())] = False
    fates = []
    for j, (begin, end) in enumerate(labels.tolist()):
        inside = (judged & wanted)[begin : end + 1]
        recall = float(found[begin : end + 1][inside].mean()) if inside.any() else np.nan
        late = (intervals[pairs[j]] - labels[j]) / track.fps if j in pairs else None
        fates.append(_fate(track, begin, end, j in pairs, recall, late))
    score = _score(
        track,
        how,
        [against_frames(found, wanted, judged)],
        fates,
        intervals=len(pairs) + int(np.count_nonzero(free & _mostly(intervals, judged))),
        intervals_right=len(pairs),
    )
    return score, fates


def _outer(
    track: Track,
    how: Counting,
    spans: np.ndarray,
    intervals: np.ndarray,
    found: np.ndarray,
    judged: np.ndarray,
    empty: np.ndarray,
) -> tuple[Score, list[LabelScore]]:
    labels = merged(track.labels)
    known = np.where(judged, frames_in(labels, track.frames).astype(int), -1)
    shared = overlaps(intervals, labels)
    owners = set(shared.argmax(1)[shared.any(1)].tolist())
    reach = np.zeros(track.frames, bool)
    counts, fates = [], []
    for j, (begin, end) in enumerate(labels.tolist()):
        one = against_bounds(found, begin, end, known, track.fps, how.core, how.reach)
        reach |= near(begin, end, track.frames, track.fps, how.reach)
        recall = one.hit / one.wanted if one.wanted else np.nan
        fates.append(_fate(track, begin, end, j in owners, recall, errors(spans, begin, end, track.fps)))
        counts.append(one)
    counts.append(against_frames(found, np.zeros_like(found), empty & ~reach))
    right = shared.any(1)
    wrong = ~right & _mostly(intervals, (reach & judged) | empty)
    score = _score(
        track, how, counts, fates, intervals=int(np.count_nonzero(right | wrong)), intervals_right=int(np.count_nonzero(right))
    )
    return score, fates


def _mostly(spans: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Of which spans (n, 2) at least half of the frames are in the mask: (n,) bool."""
    total = np.concatenate([[0], np.cumsum(mask)])
    return 2 * (total[spans[:, 1] + 1] - total[spans[:, 0]]) >= spans[:, 1] - spans[:, 0] + 1


def _fate(
    track: Track, begin: int, end: int, hit: bool, recall: float, late: tuple[float, float] | np.ndarray | None
) -> LabelScore:
    begin_ms, end_ms = (np.nan, np.nan) if late is None else (1e3 * float(late[0]), 1e3 * float(late[1]))
    return LabelScore(track.clip, track.object, track.type, track.kind, begin, end, hit, recall, begin_ms, end_ms)


def _score(
    track: Track,
    how: Counting,
    counts: list[Counts],
    fates: Sequence[LabelScore] = (),
    intervals: int = 0,
    intervals_right: int = 0,
) -> Score:
    weight = 1.0 if how.weigh == "frames" else 1.0 / track.fps
    sums = {f.name: weight * sum(getattr(c, f.name) for c in counts) for f in fields(Counts)}
    timed = [f for f in fates if np.isfinite(f.begin_ms)]
    return Score(
        track.object, track.type, 1, **sums,
        labels=len(fates), labels_hit=sum(f.matched for f in fates), intervals=intervals, intervals_right=intervals_right,
        begin_errors=tuple(f.begin_ms for f in timed), end_errors=tuple(f.end_ms for f in timed),
    )  # fmt: skip
