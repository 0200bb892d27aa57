"""What an evaluation says: scores by object and type and in all, each label's fate, and what was left out of the counting.

In: counts. Out: `Evaluation`, as rows (`table`), text (`str`) and JSON (`to_json`). Ratios are NaN (null in JSON) where there is
nothing to divide by; errors are milliseconds, positive where what was found is later than the label.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

from ..errors import OptionError
from .counting import CORE, REACH
from .scores import ALL, ANY, Score

SCHEMA = "kinjax-evaluation/1"


@dataclass(frozen=True)
class Counting:
    """How is counted. core: the part of an outer bound that recall is over. reach: seconds around one in which frames count.

    iou: overlap that makes an exact interval found. join: seconds between found constraints of any type that are one contact, for
    labels without type. weigh: every frame alike, or every second ("seconds": clips of different rates weigh the same).
    """

    core: tuple[float, float] = CORE
    reach: float = REACH
    iou: float = 0.5
    join: float = 0.05
    weigh: str = "frames"

    def __post_init__(self) -> None:
        object.__setattr__(self, "core", tuple(map(float, self.core)))
        if len(self.core) != 2 or not 0 <= self.core[0] < self.core[1] <= 1:
            raise OptionError(f"core is {self.core}: two parts of a label's length, 0 <= first < second <= 1")
        for name in ("reach", "join"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise OptionError(f"{name} is {getattr(self, name)}: a number of seconds, not negative")
        if not 0 <= self.iou <= 1:
            raise OptionError(f"iou is {self.iou}: a share from 0 (any overlap) to 1 (the same frames)")
        if self.weigh not in ("frames", "seconds"):
            raise OptionError(f"weigh is {self.weigh!r}: choose frames or seconds")


@dataclass(frozen=True)
class LabelScore:
    """One label: where it is in the clip's frames, what part of its wanted frames was found, its errors in ms if something was."""

    clip: str
    object: str
    type: str
    kind: str
    begin: int
    end: int
    matched: bool
    recall: float
    begin_ms: float = math.nan
    end_ms: float = math.nan


@dataclass(frozen=True)
class Left:
    """What counts in nothing, and is not hidden.

    clips: clips of the store without a label. labels: names of clips in the labels that the store does not have, and how many labels
    each has. constraints: found in labelled clips, but of objects or types without a label there. cut: labels that reach beyond
    their clip and were cut. outside: labels wholly beyond it. unnamed: objects of labels for which nothing was found anywhere.
    """

    clips: int = 0
    labels: tuple[tuple[str, int], ...] = ()
    constraints: int = 0
    cut: int = 0
    outside: int = 0
    unnamed: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """In words, one line for each that is not zero."""
        out = []
        if self.clips:
            out.append(f"{_many(self.clips, 'clip')} without labels, left out")
        if self.labels:
            names = ", ".join(name for name, _ in self.labels[:5]) + (", ..." if len(self.labels) > 5 else "")
            count = _many(sum(n for _, n in self.labels), "label")
            out.append(f"{count} of {_many(len(self.labels), 'clip')} that the store does not have, left out: {names}")
        if self.constraints:
            out.append(f"{_many(self.constraints, 'constraint')} of objects or types without labels in their clip, left out")
        if self.cut:
            out.append(f"{_many(self.cut, 'label')} cut where the clip begins or ends")
        if self.outside:
            out.append(f"{_many(self.outside, 'label')} wholly outside of the clip, left out")
        if self.unnamed:
            out.append(f"nothing was found of {', '.join(self.unnamed)}: if that surprises, compare the names")
        return out


@dataclass(frozen=True)
class Evaluation:
    """`scores` of each object and type, of each object, of each type, and the total (the last); `labels`: the fate of each.

    clips: how many were judged. left: what was left out. counting: how was counted.
    """

    scores: tuple[Score, ...]
    labels: tuple[LabelScore, ...]
    clips: int
    left: Left
    counting: Counting

    @property
    def total(self) -> Score:
        """All together."""
        return self.scores[-1]

    def of(self, object: str | None = None, type: str | None = None) -> Score:
        """The score of an object (any case), of a type ("any": labels without type), of both, or of all."""
        name, kind = None if object is None else object.casefold(), "" if type == ANY else type
        for s in self.scores:
            if (None if s.object is None else s.object.casefold(), s.type) == (name, kind):
                return s
        known = ", ".join(f"{s.object or ALL} {ALL if s.type is None else s.type or ANY}" for s in self.scores)
        raise OptionError(f"no score of {object or ALL} {type or ALL}; there are {known}")

    def missed(self) -> tuple[LabelScore, ...]:
        """The labels that were not found."""
        return tuple(x for x in self.labels if not x.matched)

    def table(self) -> list[dict[str, Any]]:
        """One row a score: names, ratios, errors, counts."""
        return [s.row() for s in self.scores]

    def to_json(self, labels: bool = False) -> str:
        """As JSON; NaN is null. labels: with the fate of each label."""
        record: dict[str, Any] = {
            "schema": SCHEMA, "clips": self.clips, "counting": asdict(self.counting), "left_out": asdict(self.left),
            "scores": self.table(),
        }  # fmt: skip
        record |= {"labels": [asdict(x) for x in self.labels]} if labels else {}
        return json.dumps(_plain(record), indent=1, allow_nan=False, ensure_ascii=False) + "\n"

    def __str__(self) -> str:
        from .text import describe

        return describe(self)


def _many(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
