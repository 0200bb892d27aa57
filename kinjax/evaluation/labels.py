"""Labels: what a person, a force plate or another program says of a clip, one interval each.

In: values. Out: `Label`. Conventions stated here and nowhere else:

* `begin..end` are frames, 0-based, both included, or `begin_s..end_s` the times of the first and last of them in seconds, which
  mean the nearest frames of whatever rate the clip has (half-way: the later one). Where both are given, the times are taken.
* `type` is that of a constraint, or empty where any type will do (contact); `none` says that nothing must be found there.
* `kind` is `exact` where all of the interval is wanted and nothing else in that clip of that object; `outer` where the interval
  is a bound: wanted is its core, and nothing is known farther away; `unknown` where found frames are neither right nor wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from ..annotations import TYPES
from ..errors import OptionError

Kind = Literal["exact", "outer", "unknown"]
KINDS: tuple[Kind, ...] = get_args(Kind)
NONE = "none"
MOST = 1e12  # frames or seconds; no clip is that long
_ANY, _EMPTY = ("", "any", "all"), (NONE, "empty")


def label_type(name: str | None) -> str:
    """The type of a label as it is kept: "" for any, "none", or a constraint's type; `OptionError` for another word."""
    word = (name or "").strip().lower()
    if word in _ANY:
        return ""
    if word in _EMPTY:
        return NONE
    if word in TYPES:
        return word
    raise OptionError(f"no type {name!r} of a label: choose from {', '.join((*TYPES, NONE))}, or leave it empty for any")


@dataclass(frozen=True, slots=True)
class Label:
    """One interval that is labelled; the module's docstring says what its fields mean. `OptionError` for one that cannot be.

    object: a joint's or object's name, or its role (as left_foot). clip: the clip's id in a store, or its file's name.
    """

    clip: str
    object: str
    begin: int | None = None
    end: int | None = None
    begin_s: float | None = None
    end_s: float | None = None
    type: str = ""
    kind: Kind = "exact"

    def __post_init__(self) -> None:
        for name in ("clip", "object"):
            if not isinstance(getattr(self, name), str) or not getattr(self, name).strip():
                raise OptionError(f"a label without {name}")
        object.__setattr__(self, "type", label_type(self.type))
        kind = (self.kind or "exact").strip().lower()
        if kind not in KINDS:
            raise OptionError(f"no kind {self.kind!r} of a label: choose from {', '.join(KINDS)}")
        object.__setattr__(self, "kind", kind)
        for name in ("begin", "end", "begin_s", "end_s"):
            object.__setattr__(self, name, _number(name, getattr(self, name), whole=not name.endswith("_s")))
        given = [pair for pair in (self.seconds, self.frames) if None not in pair]
        halves = [pair for pair in (self.seconds, self.frames) if (pair[0] is None) != (pair[1] is None)]
        if not given or halves:
            raise OptionError("a label needs begin and end in frames, or begin_s and end_s in seconds")
        for begin, end in given:
            if begin > end:  # type: ignore[operator]
                raise OptionError(f"a label ends at {end:g}, before it begins at {begin:g}")

    @property
    def seconds(self) -> tuple[float | None, float | None]:
        """Times of the first and last frame, as they were given."""
        return self.begin_s, self.end_s

    @property
    def frames(self) -> tuple[int | None, int | None]:
        """First and last frame, as they were given."""
        return self.begin, self.end

    def span(self, fps: float) -> tuple[int, int]:
        """First and last frame in a clip of `fps` frames a second; not cut to its length."""
        if self.begin_s is not None and self.end_s is not None:
            return math.floor(self.begin_s * fps + 0.5), math.floor(self.end_s * fps + 0.5)
        assert self.begin is not None and self.end is not None
        return self.begin, self.end


FIELDS: tuple[str, ...] = tuple(f.name for f in fields(Label))


def labels_of(table: Label | Iterable[Label] | Mapping[str, Sequence[Any]]) -> tuple[Label, ...]:
    """Labels from a sequence of them, or from columns with the names of their fields; other columns are ignored.

    Empty strings, None and NaN stand for what is not said. `OptionError` names the first label (0-based) that cannot be.
    """
    from .tables import columns

    if isinstance(table, Label):
        return (table,)
    if not isinstance(table, Mapping) and not hasattr(table, "columns") and not hasattr(table, "column_names"):
        items = tuple(table)
        if all(isinstance(x, Label) for x in items):
            return items
        raise OptionError("labels are a sequence of Label, or a table with the columns " + ", ".join(FIELDS))
    given = columns(table, ("clip", "object"), FIELDS[2:], what="labels")
    out = []
    for n, values in enumerate(zip(*given.values(), strict=True)):
        said = {k: v for k, v in zip(given, values, strict=True) if not _missing(v)}
        try:
            out.append(Label(**{"clip": "", "object": "", **said}))
        except OptionError as error:
            raise OptionError(f"label {n}: {error}") from None
    return tuple(out)


def _missing(value: Any) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))


def _number(name: str, value: Any, whole: bool) -> Any:
    """A finite number, as int where it must be whole; None stays."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MOST:
        raise OptionError(f"{name} of a label is {str(value)[:40]}: it must be a number of a clip's size")
    if whole and value != int(value):
        raise OptionError(f"{name} of a label is {value!r}: a frame is a whole number; times are begin_s and end_s")
    return int(value) if whole else float(value)
