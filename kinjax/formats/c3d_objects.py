"""Rigid objects from the markers of a recording: which markers belong together, and whether they can carry a pose.

In: `Markers`. Out: `Poses`, and notes on what was left out. An object is the cluster of its markers: its origin is their
centroid, its orientation the Kabsch fit of `kinematics.cluster_poses` to their typical shape.

A marker that is missing where others of its object are seen would mask those frames. If it is present in less than `SEEN` of
the frames that show any marker of the object, and three others are not, it is left out. The frames that lack one of the rest
are masked: a fit to fewer markers is possible, but skin moves markers against each other by millimetres, and at the edges of
every gap the object would jump by as much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import FileFormatError, OptionError, find_name
from ..kinematics import cluster_poses
from ..marker_sets import ENOUGH, body_parts, split_label
from ..motion import Poses

SEEN = 0.8
"""Part of an object's frames in which each of its markers is to be present."""
THINNEST = 0.02
"""Markers are on a line if their spread across it is less than this part of their spread along it."""


@dataclass(frozen=True)
class Markers:
    """The markers of one recording.

    positions: (frames, markers, 3) world metres, float64, NaN where a marker is missing. labels: one a marker, as in the
    file; they may repeat. rate: frames a second. up: "x", "y" or "z". clip: the file's name. notes: what was assumed.
    """

    labels: tuple[str, ...]
    positions: Float[np.ndarray, "frames markers 3"]
    rate: float
    up: str = "z"
    clip: str = ""
    notes: tuple[str, ...] = ()

    @property
    def seen(self) -> np.ndarray:
        """(frames, markers): where a marker is present."""
        return np.asarray(np.isfinite(self.positions).all(-1))


def rigid_objects(
    markers: Markers, clusters: str | Mapping[str, Sequence[str]] = "auto", path: object = None
) -> tuple[Poses, tuple[str, ...]]:
    """World poses of the rigid objects, and notes on objects and markers that were left out.

    clusters: "auto" for the body parts that `marker_sets.body_parts` finds, or {object: labels}, three or more a object (any
    case; the subject before a colon may be left away). path: what messages call the recording; default its clip.

    `OptionError` for clusters that make no sense, `UnknownNameError` for a label that is not there (lists the nearest),
    `FileFormatError` if no object can be made: it lists the labels.
    """
    where = path if path is not None else (markers.clip or None)
    seen = markers.seen
    at, notes = _clusters(markers, np.asarray(seen.any(0)), clusters)
    chosen: dict[str, np.ndarray] = {}
    for name, members in at.items():
        kept, note = _usable(members, markers, seen)
        if note:
            notes.append(f"{name}{note}")
        if len(kept):
            chosen[name] = markers.positions[:, kept]
    if not chosen:
        labels = list(dict.fromkeys(label for label in markers.labels if label))
        shown = ", ".join(labels[:60]) + (f", ... ({len(labels)} in all)" if len(labels) > 60 else "")
        why = f" ({'; '.join(notes)})" if notes else ""
        found = f"no rigid object can be made of the markers{why}; the labels are: {shown or 'none'}"
        remedy = 'name the objects: clusters={"left_foot": ["LHEE", "LTOE", "LANK"]}, three markers or more each'
        raise FileFormatError(found, path=where, remedy=remedy)
    return cluster_poses(chosen, markers.rate, clip=markers.clip, up=markers.up), tuple(notes)


def _clusters(
    markers: Markers, present: np.ndarray, clusters: str | Mapping[str, Sequence[str]]
) -> tuple[dict[str, tuple[int, ...]], list[str]]:
    """The markers of each object, as indices; only objects with enough of them. Notes on the others."""
    if isinstance(clusters, str):
        if clusters != "auto":
            raise OptionError(f'clusters={clusters!r}: give "auto", or a mapping {{object: [labels]}}')
        known = np.flatnonzero([p and bool(label) for p, label in zip(present, markers.labels, strict=True)])
        parts = body_parts([markers.labels[i] for i in known])
        at = {name: tuple(int(known[i]) for i in part) for name, part in parts.items()}
        few = [f"{n} is left out: only {_names(x, markers)} of it" for n, x in at.items() if len(x) < ENOUGH]
        return {n: x for n, x in at.items() if len(x) >= ENOUGH}, few
    if not isinstance(clusters, Mapping) or not clusters:
        raise OptionError(f'clusters={clusters!r}: give "auto", or a mapping {{object: [labels]}}')
    first = {label: i for i, label in reversed(list(enumerate(markers.labels))) if label}
    bare = {split_label(label)[1]: i for label, i in reversed(first.items())}
    bare = {label: i for label, i in bare.items() if label not in first}
    known_labels = (*first, *bare)
    out = {}
    for name, labels in clusters.items():
        if isinstance(labels, str):
            raise OptionError(f"clusters: {name!r} has the text {labels!r}; give a list of labels")
        found = [find_name(str(label), known_labels, "marker", markers.clip) for label in labels]
        members = tuple(dict.fromkeys((first | bare)[known_labels[i]] for i in found))
        if len(members) < ENOUGH:
            raise OptionError(f"clusters: {name!r} has {len(members)} different markers; a rigid object needs {ENOUGH}")
        out[str(name)] = members
    return out, []


def _usable(members: tuple[int, ...], markers: Markers, seen: np.ndarray) -> tuple[np.ndarray, str]:
    """The markers of an object that its pose is made of, none if it has no pose; and what is to be said of it."""
    at = np.array(members, int)
    shown = seen[:, at]
    part = shown.sum(0) / max(int(shown.any(1).sum()), 1)
    often = at[part >= SEEN]
    note = ""
    if len(often) < len(at) and len(often) >= ENOUGH and not _thin(markers.positions[:, often]):
        rare = ", ".join(f"{markers.labels[i]} ({p:.0%} of its frames)" for i, p in zip(at, part, strict=True) if p < SEEN)
        note, at = f" is made without {rare}", often
    if not seen[:, at].all(1).any():
        return at[:0], f" is left out: no frame shows {_names(at, markers)} together"
    if _thin(markers.positions[:, at]):
        return at[:0], f" is left out: {_names(at, markers)} lie on one line"
    return at, note


def _thin(points: np.ndarray) -> bool:
    """Whether markers (frames, markers, 3) lie on one line, in the middle of the frames that show them all."""
    whole = points[np.isfinite(points).all((1, 2))]
    if not len(whole):
        return False
    spread = np.linalg.svd(whole - whole.mean(1, keepdims=True), compute_uv=False)
    return bool(np.median(spread[:, 1]) <= THINNEST * np.median(spread[:, 0]))


def _names(at: Sequence[int] | np.ndarray, markers: Markers) -> str:
    return ", ".join(markers.labels[i] for i in at)
