"""Arithmetic of intervals of frames: joined, as frames, matched with each other.

In and out: spans, integer arrays (n, 2) of first and last frame, **both included** (`kinjax.annotations`), in order; frames are
masks (frames,) of booleans. Nothing here knows what a span stands for.
"""

from __future__ import annotations

import math

import numpy as np

TIE = 1e-9  # what a product of a fraction and a count of frames may lack to a whole number


def merged(spans: np.ndarray, gap: int = -1) -> np.ndarray:
    """Disjoint spans in order: two become one where at most `gap` frames lie between them.

    gap -1: only spans that share a frame become one; 0: also spans that touch.
    """
    spans = np.asarray(spans, int).reshape(-1, 2)
    out: list[list[int]] = []
    for begin, end in spans[np.lexsort((spans[:, 1], spans[:, 0]))].tolist():
        if out and begin - out[-1][1] - 1 <= gap:
            out[-1][1] = max(out[-1][1], end)
        else:
            out.append([begin, end])
    return np.array(out, int).reshape(-1, 2)


def frames_in(spans: np.ndarray, frames: int) -> np.ndarray:
    """Mask (frames,): which frames one of the spans covers; what lies outside of the clip is cut."""
    out = np.zeros(frames, bool)
    for begin, end in np.asarray(spans, int).reshape(-1, 2).tolist():
        out[max(begin, 0) : max(end + 1, 0)] = True
    return out


def runs(mask: np.ndarray) -> np.ndarray:
    """The spans of consecutive true frames of a mask (frames,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(mask, bool), [False]]).astype(np.int8)))
    return np.stack([edges[::2], edges[1::2] - 1], 1).astype(int)


def core(begin: int, end: int, part: tuple[float, float]) -> tuple[int, int]:
    """First frame of a part of a span, and the first after it: those whose place in it is at least `part[0]` and under `part[1]`.

    The place of frame `f` is `(f - begin) / length`, and the length `end - begin + 1`. A short span may have none.
    """
    length = end - begin + 1
    first, after = (begin + math.ceil(p * length - TIE) for p in part)
    return first, after


def overlaps(found: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """How many frames each found span (n, 2) shares with each label (m, 2): (n, m)."""
    found, labels = np.asarray(found, int).reshape(-1, 1, 2), np.asarray(labels, int).reshape(1, -1, 2)
    shared = np.minimum(found[..., 1], labels[..., 1]) - np.maximum(found[..., 0], labels[..., 0]) + 1
    return np.maximum(shared, 0)


def matched(found: np.ndarray, labels: np.ndarray, iou: float) -> list[tuple[int, int]]:
    """Pairs (index of a found span, index of a label), each in one pair at most, whose overlap is enough.

    Both are disjoint and in order. Enough: they share a frame, and what they share is at least `iou` of what they cover
    together. Of all ways to pair them, one with most pairs is taken, and of those one with the greatest sum of overlaps. As disjoint
    spans that overlap never cross each other, the best way is found from left to right.
    """
    pairs = []
    first = 0
    for i, (begin, end) in enumerate(found.tolist()):
        while first < len(labels) and labels[first, 1] < begin:
            first += 1
        for j in range(first, len(labels)):
            if labels[j, 0] > end:
                break
            low, high = max(begin, labels[j, 0]), min(end, labels[j, 1])
            share = (high - low + 1) / (max(end, labels[j, 1]) - min(begin, labels[j, 0]) + 1)
            if share >= iou - TIE:
                pairs.append((i, j, float(share)))
    worth = [1.0 + len(pairs) + share for _, _, share in pairs]  # one more pair is worth more than any sum of shares
    best: list[tuple[float, int]] = [(0.0, -1)]  # of the first k pairs: the most, and the last pair of it
    before: list[int] = []
    for k, (i, j, _) in enumerate(pairs):
        m = k  # pairs[:m] lie wholly to the left of pair k
        while m and (pairs[m - 1][0] >= i or pairs[m - 1][1] >= j):
            m -= 1
        before.append(m)
        best.append(max(best[k], (best[m][0] + worth[k], k)))
    out, k = [], len(pairs)
    while best[k][1] >= 0:
        chosen = best[k][1]
        out.append(pairs[chosen][:2])
        k = before[chosen]
    return out[::-1]
