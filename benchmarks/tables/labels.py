"""The labels made by eye, and the clips of the two tables.

In: the fixture `tests/fixtures/labels_by_eye.json` (its `how` tells how the labels were made). Out: `Labels` of a clip,
and the `Target`s of an effector: which spans serve as templates, and which frames should be found.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinjax.errors import OptionError
from kinjax.formats import read_bvh
from kinjax.motion import Motion

FIXTURE = Path(__file__).resolve().parents[2] / "tests" / "fixtures" / "labels_by_eye.json"


@dataclass(frozen=True)
class Case:
    """A clip of the tables, its `effectors` (the first one is the paper's), and the paper's section of the like."""

    clip: str
    title: str
    effectors: tuple[str, ...]
    section: str


CASES = (
    Case("02_01", "walk", ("lfoot", "rfoot"), "8.2"),
    Case("01_03", "step ladder", ("lfoot", "rfoot", "lhand", "rhand"), "8.3"),
    Case("49_20", "gymnastics", ("lhand", "rhand", "lfoot", "rfoot"), "8.4"),
)


@dataclass(frozen=True)
class Span:
    """Frames `begin..end`, both included; either end is known to `uncertainty` frames."""

    begin: int
    end: int
    uncertainty: int = 0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.end - self.begin + 1


@dataclass(frozen=True)
class Target:
    """What a detection of one effector is held against.

    truth: "planted" (in contact and still), or "at rest" (planted, or held still in the air). spans: the labelled
    constraints, each of them a template in its turn. ambiguous: frames that the eye could not decide.
    """

    effector: str
    truth: str
    spans: tuple[Span, ...]
    ambiguous: tuple[Span, ...]
    frames: int

    def mask(self) -> np.ndarray:
        """(frames,) bool: labelled frames."""
        return covered(self.spans, self.frames)

    def scored(self) -> np.ndarray:
        """(frames,) bool: frames outside ambiguous spans."""
        return ~covered(self.ambiguous, self.frames)

    def edges(self) -> np.ndarray:
        """(frames,) bool: frames nearer to a begin or an end than the labeller was sure of it."""
        out = np.zeros(self.frames, bool)
        for s in self.spans:
            for cut in (s.begin, s.end + 1):
                if 0 < cut < self.frames:
                    out[max(cut - s.uncertainty, 0) : cut + s.uncertainty] = True
        return out


@dataclass(frozen=True)
class Labels:
    """The labels of one clip, spans by effector."""

    clip: str
    fps: float
    frames: int
    planted: dict[str, tuple[Span, ...]]
    ambiguous: dict[str, tuple[Span, ...]]
    held_free: dict[str, tuple[Span, ...]]

    def targets(self, effector: str) -> list[Target]:
        """Planted where the effector ever is; and at rest where it is also held still in the air."""
        planted, held = self.planted[effector], self.held_free.get(effector, ())
        sets = [("planted", planted)] * bool(planted) + [("at rest", (*planted, *held))] * bool(held)
        return [Target(effector, truth, spans, self.ambiguous[effector], self.frames) for truth, spans in sets]


def covered(spans: tuple[Span, ...], frames: int) -> np.ndarray:
    """(frames,) bool: frames inside one of the spans."""
    out = np.zeros(frames, bool)
    for s in spans:
        out[s.begin : s.end + 1] = True
    return out


def read_labels(path: str | Path = FIXTURE) -> dict[str, Labels]:
    """The labels of all clips, by clip."""
    raw = json.loads(Path(path).read_text(encoding="utf-8"))

    def spans(by_effector: dict[str, list[dict[str, int]]]) -> dict[str, tuple[Span, ...]]:
        return {
            e: tuple(Span(s["begin"], s["end"], s.get("uncertainty", 0)) for s in some)
            for e, some in by_effector.items()
        }

    return {
        name: Labels(
            name, c["fps"], c["frames"], spans(c["labels"]), spans(c["ambiguous"]), spans(c.get("held_free", {}))
        )
        for name, c in raw["clips"].items()
    }  # fmt: skip


def read_clip(data: str | Path, clip: str) -> Motion:
    """The clip below the folder `data`; `OptionError` where there is none."""
    found = sorted(Path(data).rglob(f"{clip}.bvh"))
    if not found:
        raise OptionError(f"no {clip}.bvh below {data}: get it from the CMU motion capture database (mocap.cs.cmu.edu)")
    return read_bvh(found[0])
