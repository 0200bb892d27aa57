"""Evaluation: the constraints found in many clips against labels of some of them.

In: a table of found constraints, labels, a table of clips. Out: `Evaluation`. An object of a clip is judged if it has a label
there, by the types of these: found constraints of other objects, clips and types are left out, and counted as left out.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..annotations import check_type
from ..errors import OptionError, UnknownNameError
from .counting import CORE, REACH
from .labels import NONE, Label, labels_of
from .results import Counting, Evaluation, LabelScore, Left
from .scores import Score
from .spans import frames_in
from .tables import clip_indices, clip_sizes, columns
from .tracks import NOTHING, Track, judge


def evaluate(
    found: Any,
    labels: Any,
    clips: Any,
    *,
    objects: Sequence[str] = (),
    types: Sequence[str] = (),
    core: tuple[float, float] = CORE,
    reach: float = REACH,
    iou: float = 0.5,
    join: float = 0.05,
    weigh: str = "frames",
) -> Evaluation:
    """How well found constraints agree with labels.

    found: columns `clip, object, type, begin, end` (frames, both included) and perhaps `role`: a mapping, or a pyarrow or pandas
    table; other columns are ignored. labels: a sequence of `Label`, or columns of its fields. clips: columns `clip, frames, fps` of
    all clips that were searched, also of those in which nothing was found. objects: only labels that name one of these (any case).
    types: only constraints and labels of these, and labels without type. The rest: see `Counting`.

    Raises `OptionError` for labels that contradict themselves, a clip's name that means several, constraints outside of their
    clip or of no clip, and options that make no sense; `UnknownNameError` for an object that no label names.
    """
    how = Counting(core, reach, iou, join, weigh)
    kinds = tuple(check_type(t) for t in types)
    said = _chosen(labels_of(labels), objects, kinds)
    ids, frames, rates = clip_sizes(clips)
    where = clip_indices((x.clip for x in said), ids)
    store = _Found(found, ids, kinds)
    by_clip: dict[int, list[Label]] = defaultdict(list)
    missing: Counter[str] = Counter()
    for x in said:
        n = where[x.clip]
        if n is None:
            missing[x.clip] += 1
        else:
            by_clip[n].append(x)
    cut, outside, left_out = 0, 0, 0
    parts: dict[tuple[str, str], list[tuple[int, Score]]] = defaultdict(list)
    spelled: dict[str, str] = {}
    fates: list[LabelScore] = []
    for n in sorted(by_clip):
        size, fps = _size(ids[n], frames[n], rates[n])
        store.check(n, ids[n], size)
        inside: dict[str, list[tuple[Label, int, int]]] = defaultdict(list)
        for x in by_clip[n]:
            name = x.object.casefold()
            spelled.setdefault(name, x.object)
            begin, end = x.span(fps)
            first, last = max(begin, 0), min(end, size - 1)
            cut += first <= last and (begin, end) != (first, last)
            outside += first > last
            inside[name] += [(x, first, last)] if first <= last else []
        used: dict[int, str] = {}
        for name, rows in inside.items():
            hits = store.rows(n, name)
            if shared := [r for r in hits if r in used]:
                both = f"{used[shared[0]]!r} and {spelled[name]!r}"
                raise OptionError(f"{ids[n]}: labels name one object as {both}: use one of its names in a clip")
            counted: set[int] = set()
            for track, its in _tracks(ids[n], spelled[name], size, fps, rows, store, hits):
                score, more = judge(track, how)
                parts[name, track.type].append((n, score))
                fates += more
                counted.update(its)
            used |= dict.fromkeys(hits, spelled[name])
            left_out += len(hits) - len(counted)
        left_out += len(store.of_clip(n)) - len(used)
    unnamed = tuple(spelled[k] for k in spelled if k not in store.names)
    left = Left(len(ids) - len(by_clip), tuple(sorted(missing.items())), left_out, cut, outside, unnamed)
    return Evaluation(_scores(parts, spelled), tuple(fates), len(by_clip), left, how)


class _Found:
    """The table of found constraints by clip and name; rows are numbered as in the table."""

    def __init__(self, table: Any, ids: Sequence[str], types: Sequence[str]):
        given = columns(table, ("clip", "object", "type", "begin", "end"), ("role",), what="constraints")
        index = {name: n for n, name in enumerate(ids)}
        if strangers := sorted({str(c) for c in given["clip"] if c not in index})[:3]:
            raise OptionError(f"constraints of clips that are not in the table of clips: {', '.join(strangers)}")
        self.type = [check_type(str(t)) for t in given["type"]]
        self.spans = _whole(given["begin"], given["end"])
        roles = given.get("role", [None] * len(self.type))
        self._clips: dict[int, list[int]] = defaultdict(list)
        self._named: dict[tuple[int, str], list[int]] = defaultdict(list)
        self.names: set[str] = set()
        for row, (clip, name, role) in enumerate(zip(given["clip"], given["object"], roles, strict=True)):
            if types and self.type[row] not in types:
                continue
            n = index[clip]
            self._clips[n].append(row)
            for word in {str(w).casefold() for w in (name, role) if w is not None and w == w}:
                self._named[n, word].append(row)
                self.names.add(word)

    def of_clip(self, n: int) -> list[int]:
        """Rows of a clip."""
        return self._clips.get(n, [])

    def rows(self, n: int, name: str) -> list[int]:
        """Rows of a clip whose object or role has this name (folded)."""
        return self._named.get((n, name), [])

    def check(self, n: int, clip: str, frames: int) -> None:
        """`OptionError` unless the constraints lie inside of their clip."""
        for row in self.of_clip(n):
            begin, end = self.spans[row]
            if not 0 <= begin <= end < frames:
                raise OptionError(f"{clip}: a constraint in frames {begin}..{end} is not inside the clip's 0..{frames - 1}")


def _tracks(
    clip: str,
    name: str,
    frames: int,
    fps: float,
    rows: list[tuple[Label, int, int]],
    store: _Found,
    hits: list[int],
) -> Iterator[tuple[Track, list[int]]]:
    """The tracks of one object in one clip, by type of the labels, each with the rows of constraints that it judges."""

    def spans(keep: Iterable[tuple[Label, int, int]]) -> np.ndarray:
        return np.array([(b, e) for _, b, e in keep], int).reshape(-1, 2)

    unknown = spans(r for r in rows if r[0].kind == "unknown")
    none = spans(r for r in rows if r[0].type == NONE and r[0].kind != "unknown")
    wanted = [r for r in rows if r[0].type != NONE and r[0].kind != "unknown"]
    kinds = sorted({r[0].kind for r in wanted})
    types = sorted({r[0].type for r in wanted})
    where = f"{clip}, {name}"
    if len(kinds) > 1:
        raise OptionError(f"{where}: exact labels and outer bounds of one object in one clip: are the other frames known or not?")
    if len(types) > 1 and "" in types:
        raise OptionError(f"{where}: labels with and without type of one object in one clip: give each a type, or none")
    if (frames_in(none, frames) & frames_in(spans(wanted), frames)).any():
        raise OptionError(f"{where}: a label says that nothing must be found where another says that something must")

    def track(kind: str, type: str, its: list[int], labels: np.ndarray) -> tuple[Track, list[int]]:
        its_spans = store.spans[its] if its else NOTHING
        return Track(clip, name, type, kind, frames, fps, its_spans, labels, none, unknown), its

    for kind in types:
        its = [r for r in hits if not kind or store.type[r] == kind]
        yield track(kinds[0], kind, its, spans(r for r in wanted if r[0].type == kind))
    if len(none) and "" not in types:  # found constraints of the types without label are wrong there, too
        yield track("exact", "", [r for r in hits if store.type[r] not in types], NOTHING)


def _scores(parts: dict[tuple[str, str], list[tuple[int, Score]]], spelled: dict[str, str]) -> tuple[Score, ...]:
    """Each object and type, each object, each type, all."""

    groups: dict[tuple[str | None, str | None], list[tuple[int, Score]]] = {k: parts[k] for k in sorted(parts)}
    for of_object, of_type in ((True, False), (False, True), (False, False)):
        for o, t in sorted(parts, key=lambda k: k if of_object else k[::-1]):
            groups.setdefault((o if of_object else None, t if of_type else None), []).extend(parts[o, t])
    groups.setdefault((None, None), [])
    return tuple(
        Score.pooled(None if o is None else spelled[o], t, (score for _, score in groups[o, t]), len({n for n, _ in groups[o, t]}))
        for o, t in groups
    )


def _chosen(labels: tuple[Label, ...], objects: Sequence[str], types: Sequence[str]) -> tuple[Label, ...]:
    known = {x.object.casefold(): x.object for x in labels}
    for name in objects:
        if name.casefold() not in known:
            raise UnknownNameError(name, list(known.values()), "object in the labels")
    wanted = {name.casefold() for name in objects} or set(known)
    allowed = ("", NONE, *types)
    return tuple(x for x in labels if x.object.casefold() in wanted and (not types or x.type in allowed))


def _size(clip: str, frames: Any, fps: Any) -> tuple[int, float]:
    if frames is None or fps is None or not (frames > 0 and math.isfinite(fps) and fps > 0):
        raise OptionError(f"{clip}: {frames} frames at {fps} a second: both must be positive")
    return int(frames), float(fps)


def _whole(begin: list[Any], end: list[Any]) -> np.ndarray:
    """(n, 2) integers; `OptionError` for frames that are none."""
    try:
        out = np.array([begin, end], float).reshape(2, -1).T
    except (TypeError, ValueError):
        raise OptionError("constraints: begin and end must be frames, whole numbers") from None
    if not (np.isfinite(out).all() and (out == np.round(out)).all()):
        row = int(np.flatnonzero(~(np.isfinite(out) & (out == np.round(out))).all(1))[0])
        raise OptionError(f"constraints: row {row} covers frames {begin[row]}..{end[row]}: whole numbers are needed")
    return out.astype(int)
