"""Walking trials with force plates: the feet's markers, and the stances that plates and laboratory events tell.

In: a folder of `NAME.npz` (names, xyz, rate) and `NAME.json` (stances by plate, events). Out: `Trial`s. Metres, z up; a
stance is `begin <= frame < end`.

Plates do not name feet: a plate's stance belongs to the foot whose markers move least in its core. A laboratory's Foot
Strike and the Foot Off after it are a stance where no plate saw one of that foot. A foot's clip ends where its markers
do: stances that are cut there, and those under 0.45 s, are known contacts, but they are left out of the counting.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kinjax.evaluation.counting import CORE
from kinjax.evaluation.spans import core
from kinjax.kinematics import cluster_poses
from kinjax.motion import Poses

FEET = ("L", "R")
MARKERS = ("HEE", "TOE", "ANK")
SHORTEST = 0.45
"""Seconds; a stance of walking is longer."""
SEEN = 0.8
"""A foot counts if all its markers are present in this part of the frames from the first that shows it to the last."""


@dataclass(frozen=True)
class Stance:
    """One contact of a foot ("L" or "R"), frames `begin <= f < end`; `source` is "plate" or "events"."""

    foot: str
    begin: int
    end: int
    source: str = "plate"

    @property
    def core(self) -> tuple[int, int]:
        """First frame of the core, and the first after it."""
        return core(self.begin, self.end - 1, CORE)

    def overlaps(self, other: Stance) -> bool:
        """Whether it is the same foot at the same time."""
        return self.foot == other.foot and self.begin < other.end and other.begin < self.end


@dataclass(frozen=True)
class Trial:
    """One clip: `markers` by foot (frames, 3, 3) in the order of `MARKERS`, stances that count, and those left out."""

    name: str
    rate: float
    markers: dict[str, np.ndarray]
    stances: tuple[Stance, ...]
    left_out: tuple[Stance, ...]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(next(iter(self.markers.values())))

    def contact(self, foot: str) -> np.ndarray:
        """What is known of each frame: 1 in a stance that counts, -1 in one that was left out (frames of the clip)."""
        known = np.zeros(self.frames, int)
        for value, group in ((-1, self.left_out), (1, self.stances)):
            for s in group:
                if s.foot == foot:
                    known[s.begin : s.end] = value
        return known


def load_trials(folder: str | Path) -> list[Trial]:
    """All trials of a folder in the order of their names; `folder` may also be the data folder that holds it."""
    folder = Path(folder)
    inner = folder / "c3d" / "forceplates"
    found = sorted((inner if inner.is_dir() else folder).glob("*.npz"))
    if not found:
        raise FileNotFoundError(f"no trial (*.npz) in {folder}, nor in {inner}")
    return [load_trial(f) for f in found]


def load_trial(path: str | Path) -> Trial:
    """The trial of one `.npz` and of the `.json` beside it; of markers of one name the first is taken."""
    path = Path(path)
    with np.load(path) as file:
        names, xyz, rate = [str(n) for n in file["names"]], np.asarray(file["xyz"], float), float(file["rate"])
    about = json.loads(path.with_suffix(".json").read_text())
    markers = {foot: xyz[:, [names.index(foot + m) for m in MARKERS]] for foot in FEET}
    counted, left_out = stances(markers, rate, about["plates"], about["events"])
    return Trial(path.stem, rate, markers, counted, left_out)


def stances(
    markers: Mapping[str, np.ndarray],
    rate: float,
    plates: Sequence[Mapping[str, Any]],
    events: Sequence[Mapping[str, Any]],
) -> tuple[tuple[Stance, ...], tuple[Stance, ...]]:
    """The stances that count, in time order, and known contacts that do not (cut, short, of a foot too rarely seen).

    markers: by foot, (frames, markers, 3). plates: each with `stances`, pairs of first frame and first frame after.
    events: `side`, `label` ("Foot Strike", "Foot Off"), `frame0`; those with `frame0 < 0` are ignored.
    """
    frames = len(next(iter(markers.values())))
    found: list[Stance] = []
    for begin, end in sorted((int(b), int(e)) for plate in plates for b, e in plate["stances"]):
        foot = _stillest(markers, rate, Stance("", begin, end).core)
        if foot is not None:
            found.append(Stance(foot, begin, end))
    found = _united(found)
    for foot in markers:
        known = [s for s in found if s.foot == foot]
        found += [s for s in _from_events(foot, events, frames) if not any(s.overlaps(k) for k in known)]
    seen = {foot: _span_seen(x) for foot, x in markers.items()}

    def counts(s: Stance) -> bool:
        first, last = seen[s.foot]
        return first < s.begin and s.end <= last and s.end - s.begin >= SHORTEST * rate

    found.sort(key=lambda s: (s.begin, s.foot))
    return tuple(s for s in found if counts(s)), tuple(s for s in found if not counts(s))


def poses_of(markers: Mapping[str, np.ndarray], rate: float, clip: str = "") -> Poses:
    """Both feet as rigid objects, their origins at the centroids of their markers."""
    return cluster_poses(markers, rate, clip=clip, up="z")


def speeds(markers: np.ndarray, rate: float) -> np.ndarray:
    """Speed of each marker (frames, markers), m/s, over 40 ms around the frame; NaN where it is not seen there."""
    half = max(1, round(0.02 * rate))
    out = np.full(markers.shape[:2], np.nan)
    if len(markers) > 2 * half:
        out[half:-half] = np.linalg.norm(markers[2 * half :] - markers[: -2 * half], axis=-1) * rate / (2 * half)
    return out


def _stillest(markers: Mapping[str, np.ndarray], rate: float, middle: tuple[int, int]) -> str | None:
    """The foot whose markers are slowest in the middle, on average; None where neither is seen."""
    speed = {foot: speeds(x, rate)[slice(*middle)] for foot, x in markers.items()}
    speed = {foot: float(np.nanmean(v)) for foot, v in speed.items() if np.isfinite(v).any()}
    return min(speed, key=speed.__getitem__) if speed else None


def _united(found: Sequence[Stance]) -> list[Stance]:
    """Overlapping stances of one foot (on two plates) as one."""
    out: list[Stance] = []
    for s in found:
        i = next((i for i, o in enumerate(out) if s.overlaps(o)), None)
        if i is None:
            out.append(s)
        else:
            out[i] = Stance(s.foot, min(s.begin, out[i].begin), max(s.end, out[i].end), s.source)
    return out


def _from_events(foot: str, events: Sequence[Mapping[str, Any]], frames: int) -> list[Stance]:
    """Contacts of one foot from strike to off; those that the clip's ends cut begin at 0 or end at `frames`."""
    own = sorted(
        (int(e["frame0"]), str(e["label"])) for e in events if str(e["side"]).startswith(foot) and int(e["frame0"]) >= 0
    )
    out, strike = [], None
    for i, (frame, label) in enumerate(own):
        if label == "Foot Strike":
            strike = frame
        elif label == "Foot Off":
            begin = 0 if i == 0 else strike
            if begin is not None and begin < frame:
                out.append(Stance(foot, begin, frame, "events"))
            strike = None
    if strike is not None and strike < frames:
        out.append(Stance(foot, strike, frames, "events"))
    return out


def _span_seen(x: np.ndarray) -> tuple[int, int]:
    """First and last frame that show all markers; an empty span if fewer than `SEEN` of the frames between them do."""
    seen = np.isfinite(x).all((1, 2))
    at = np.flatnonzero(seen)
    if not len(at) or seen[at[0] : at[-1] + 1].mean() < SEEN:
        return len(x), -1
    return int(at[0]), int(at[-1])
