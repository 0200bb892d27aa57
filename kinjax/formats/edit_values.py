"""Values of an edit file: what each key takes, and from TOML to the arguments of constraints.

In: what `tomllib` gives for one key, and the metres of the file's unit. Out: the value, times still as `Time`; or `Wrong`, which
says what is wrong with it and not where. `KINDS` lists every key of every kind of constraint. Conventions: see `edits`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..deform.constraints import CenterOfMass, Goal, LookAt, Orientation, Position
from ..deform.settings import Settings
from ..errors import KinjaxError, OptionError
from ..quaternions import from_turns
from .bvh_units import scale_of

Reader = Callable[[Any, float], Any]


class Wrong(Exception):
    """What is wrong with a value, without where."""


@dataclass(frozen=True)
class Time:
    """A time of an edit file, in seconds."""

    seconds: float

    def frame(self, rate: float) -> int:
        """The frame nearest to it; the later one of two that are equally near."""
        return math.floor(self.seconds * rate + 0.5)


@dataclass(frozen=True)
class Pass:
    """A `Through` whose times are not frames yet."""

    values: Mapping[str, Any]


def _number(value: Any, scale: float = 1.0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Wrong("a number is needed")
    return float(value)


def _length(value: Any, scale: float) -> float:
    return scale * _number(value)


def _text(value: Any, scale: float = 1.0) -> str:
    if not isinstance(value, str):
        raise Wrong("a text in quotes is needed")
    return value


def _texts(value: Any, scale: float = 1.0) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise Wrong('a list of names is needed, as ["LeftArm", "LeftForeArm"]')
    return tuple(value)


def _unit(value: Any, scale: float = 1.0) -> float:
    try:
        if isinstance(value, bool) or value == "auto":
            raise OptionError("an edit file has no skeleton to infer it from: write m, cm, mm, inch or foot")
        return scale_of(value)[0]
    except (KinjaxError, TypeError) as e:
        raise Wrong(str(e)) from None


def _seconds(value: Any, scale: float = 1.0) -> float:
    """Seconds: a number, or a text as "0.3 s"."""
    if isinstance(value, str):
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|ms)\s*", value)
        if not match:
            raise Wrong('a number of seconds is needed, as 0.3 or "0.3 s"')
        return float(match[1]) * (1e-3 if match[2] == "ms" else 1)
    seconds = _number(value)
    if seconds < 0:
        raise Wrong("a number of seconds from 0 is needed")
    return seconds


def _frame(value: Any, scale: float = 1.0) -> int | Time:
    if isinstance(value, str):
        try:
            return Time(_seconds(value))
        except Wrong:
            pass
    elif isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    raise Wrong('a frame is a whole number from 0, or a time as "1.5 s"')


def _vector(width: int, length: bool) -> Callable[[Any, float], tuple[float, ...]]:
    def read(value: Any, scale: float) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != width:
            raise Wrong(f"{width} numbers in brackets are needed")
        return tuple((scale if length else 1.0) * _number(v) for v in value)

    return read


def _rows(width: int, length: bool) -> Callable[[Any, float], np.ndarray]:
    one = _vector(width, length)

    def read(value: Any, scale: float) -> np.ndarray:
        if not isinstance(value, list) or not value:
            raise Wrong(f"a list of rows of {width} numbers is needed, one a frame")
        return np.array([one(v, scale) for v in value])

    return read


def _turn(value: Any, scale: float = 1.0) -> tuple[float, ...]:
    q = _vector(4, False)(value, 1.0)
    size = math.hypot(*q)
    if abs(size - 1) > 1e-2:
        raise Wrong(f"a unit quaternion [w, x, y, z] is needed, and this one's length is {size:.4g}")
    return q


def _turns_vector(value: Any, scale: float = 1.0) -> tuple[float, ...]:
    return tuple(math.radians(v) for v in _vector(3, False)(value, 1.0))


def _passes(turns: bool) -> Callable[[Any, float], tuple[Pass, ...]]:
    readers: dict[str, Reader] = {
        "frame": _frame, "until": _frame, "tension": _number, "continuity": _number, "bias": _number,
    }  # fmt: skip
    readers |= {"at": _turn, "euler": _vector(3, False), "order": _text} if turns else {"at": _vector(3, True)}

    def one(table: Any, scale: float) -> Pass:
        if not isinstance(table, dict):
            raise Wrong("a list of tables is needed, as [{frame = 40, at = [0, 1, 0], until = 80}]")
        for key in table:
            if key not in readers:
                near = difflib.get_close_matches(key, list(readers), n=1, cutoff=0.5)
                raise Wrong(f"no key {key!r} (nearest: {near[0]})" if near else f"no key {key!r}")
        values = {}
        for key in table:
            try:
                values[key] = readers[key](table[key], scale)
            except Wrong as e:
                raise Wrong(f"{key}: {e}") from None
        values.pop("order", None)
        merge_turns(values, table)
        for key in ("frame", "at"):
            if key not in values:
                raise Wrong(f"a pass has no {key}")
        return Pass(values)

    def read(value: Any, scale: float) -> tuple[Pass, ...]:
        if not isinstance(value, list):
            raise Wrong("a list of tables is needed, as [{frame = 40, at = [0, 1, 0], until = 80}]")
        return tuple(one(table, scale) for table in value)

    return read


def merge_turns(values: dict[str, Any], table: dict[str, Any]) -> None:
    """`euler` and `order` of a table become `at`."""
    if "offset_degrees" in values:
        values["offset"] = values.pop("offset_degrees")
    if "euler" not in table:
        if "order" in table:
            raise Wrong("order says how euler is meant, and there is no euler")
        return
    if "at" in table:
        raise Wrong("at and euler are both given: one of them says the orientation")
    order = table.get("order", "XYZ")
    if (
        not isinstance(order, str)
        or sorted(order.lower()) != ["x", "y", "z"]
        or order not in (order.upper(), order.lower())
    ):
        raise Wrong(f"order = {shown(order)}: three axes are needed, as XYZ (turned axes) or xyz (fixed axes)")
    values["at"] = tuple(from_turns(Rotation.from_euler(order, values.pop("euler"), degrees=True)).tolist())


def _displacement(value: Any, scale: float) -> Any:
    """[x, y, z], a row a frame, or key frames [{frame = 0, by = [x, y, z]}, ...]."""
    if not isinstance(value, list) or not value:
        raise Wrong("[x, y, z], rows of them, or [{frame = 0, by = [x, y, z]}] are needed")
    if not isinstance(value[0], dict):
        return (_rows(3, True) if isinstance(value[0], list) else _vector(3, True))(value, scale)
    out = []
    for key in value:
        if not isinstance(key, dict) or set(key) != {"frame", "by"}:
            raise Wrong("each key frame is {frame = 0, by = [x, y, z]}")
        out.append((_frame(key["frame"]), _vector(3, True)(key["by"], scale)))
    return tuple(out)


def shown(value: Any) -> str:
    """A value as it is shown in a message: as in TOML, and not too long."""
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 40 else text[:37] + "..."


_COMMON: dict[str, Reader] = {
    "priority": _number, "weight": _number, "begin": _frame, "end": _frame, "ease_in": _seconds, "ease_out": _seconds,
    "recruit_to": _text, "recruits": _texts, "relative_to": _text, "name": _text,
}  # fmt: skip
_PLACE = _vector(3, True)
HEADER: dict[str, Reader] = {"unit": _unit, "clip": _text}
"""Keys of the file itself."""

KINDS: dict[str, tuple[Callable[..., Goal], dict[str, Reader]]] = {
    "position": (Position, {
        "joint": _text, "at": _PLACE, "through": _passes(False), "path": _rows(3, True), "offset": _PLACE, "point": _PLACE,
        "axes": _text, **_COMMON,
    }),
    "orientation": (Orientation, {
        "joint": _text, "at": _turn, "euler": _vector(3, False), "order": _text, "through": _passes(True),
        "path": _rows(4, False), "offset_degrees": _turns_vector, "axes": _text, **_COMMON,
    }),
    "look_at": (LookAt, {
        "joint": _text, "at": _PLACE, "path": _rows(3, True), "axis": _vector(3, False), "point": _PLACE, **_COMMON,
    }),
    "center_of_mass": (CenterOfMass, {
        "at": _PLACE, "offset": _PLACE, "support": _texts, "displacement": _displacement, "leg_length": _length,
        "axes": _text, **_COMMON,
    }),
}  # fmt: skip
"""The constraint that each kind of table makes, and what reads each of its keys."""

NONE = tuple(f.name for f in fields(Settings) if "None" in str(f.type))
"""Settings that `false` switches off."""
