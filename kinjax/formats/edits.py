"""Edit files: constraints and settings of a deformation as TOML, to read and to write.

In: the path of a text file, or constraints. Out: `Edit`, whose `constraints(rate)` are those of `kinjax.deform`, or the text.
docs/edit-files.md lists every key. Conventions stated here and nowhere else:

* a frame is a whole number, counted from 0, or a time as "1.5 s"; a time between two frames means the nearer one, and
  one half-way the later; times become frames when the edit is applied to a clip, with that clip's rate;
* lengths are metres, or of the file's `unit`; the settings are not scaled;
* `euler` angles are degrees in the order of `order`: capital letters turn about axes already turned (intrinsic, `"ZXY"` is
  `Rz Rx Ry`, as BVH lists its channels), small letters about the fixed axes (extrinsic), both as in SciPy.

Nothing that a file names is read: `clip` is a note for people.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..deform.constraints import CenterOfMass, Goal, LookAt, Orientation, Position, Through
from ..deform.settings import Settings
from ..errors import FileFormatError, KinjaxError, OptionError, find_name
from .bvh_units import scale_of
from .files import read_bytes

LIMIT = 64 << 20  # bytes of an edit file; paths of many frames are long, but not that long


@dataclass(frozen=True)
class Time:
    """A time of an edit file, in seconds."""

    seconds: float

    def frame(self, rate: float) -> int:
        """The frame nearest to it; the later one of two that are equally near."""
        return math.floor(self.seconds * rate + 0.5)


@dataclass(frozen=True)
class Entry:
    """One constraint as it stands in the file: its kind, its values (times not yet frames), and where."""

    make: Callable[..., Goal]
    values: Mapping[str, Any]
    line: int | None


@dataclass(frozen=True)
class Edit:
    """What an edit file asks for. clip: the name of the clip that it was made for, if it says so. path: of the file."""

    entries: tuple[Entry, ...]
    settings: Settings
    clip: str | None = None
    path: str = ""

    def constraints(self, rate: float, joints: Sequence[str] | None = None) -> tuple[Goal, ...]:
        """The constraints for a clip of `rate` frames a second. joints: the clip's, to check names with file and line."""
        if not (math.isfinite(rate) and rate > 0):
            raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
        for entry in self.entries if joints is not None else ():
            self._check_names(entry, tuple(joints or ()))
        return tuple(e.make(**{k: _at_rate(v, rate) for k, v in e.values.items()}) for e in self.entries)

    def _check_names(self, entry: Entry, joints: tuple[str, ...]) -> None:
        where = ":".join(str(x) for x in (self.path, entry.line) if x not in ("", None))
        for key in ("joint", "recruit_to", "relative_to", "recruits", "support"):
            value = entry.values.get(key, ())
            for name in (value,) if isinstance(value, str) else value or ():
                find_name(name, joints, "joint", where)


def _at_rate(value: Any, rate: float) -> Any:
    """A value with its times as frames."""
    if isinstance(value, Time):
        return value.frame(rate)
    if isinstance(value, _Pass):
        return Through(**{k: _at_rate(v, rate) for k, v in value.values.items()})
    if isinstance(value, tuple):
        return tuple(_at_rate(v, rate) for v in value)
    return value


@dataclass(frozen=True)
class _Pass:
    values: Mapping[str, Any]


def read_edit(path: str | Path) -> Edit:
    """Read an edit file. `FileFormatError` says file, line and key of what is wrong, and the nearest key that exists."""
    data = read_bytes(path, LIMIT)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = data[: e.start].count(b"\n") + 1
        raise FileFormatError("this is no UTF-8 text", path=path, line=line, remedy="TOML is UTF-8") from e
    return parse_edit(text, path)


def parse_edit(text: str, path: str | Path = "") -> Edit:
    """The edit in a TOML text; `path` is for messages."""
    try:
        found = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as e:
        said = str(e)
        at = re.search(r"\s*\(at (?:line (\d+), column (\d+)|end of document)\)", said)
        line, column = (int(at[1]), int(at[2])) if at and at[1] else (len(text.splitlines()) or 1, None)
        said = said[: at.start()] if at else said
        raise FileFormatError(
            f"this is no TOML: {said[:1].lower()}{said[1:]}", path=path or None, line=line, column=column
        ) from e
    return _Reader(text, path).edit(found)


class _Wrong(Exception):
    """What is wrong with a value, without where."""


class _Reader:
    """One file: its values checked and converted, its lines searched when something is wrong."""

    def __init__(self, text: str, path: str | Path):
        self.lines, self.path, self.scale = text.splitlines(), path, 1.0

    def edit(self, found: dict[str, Any]) -> Edit:
        """The whole file."""
        self._known(found, (*_KINDS, "settings", "unit", "clip"), "", 0, "this file")
        self.scale = self._value(found, "unit", _unit, "", 0) if "unit" in found else 1.0
        clip = self._value(found, "clip", _text, "", 0) if "clip" in found else None
        entries = []
        for kind in _KINDS:
            tables = found.get(kind, [])
            if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
                raise self._error(f"{kind} is a list of tables", "", 0, kind, f"write [[{kind}]]")
            entries += [(self._header(kind, n), self._entry(kind, n, t)) for n, t in enumerate(tables)]
        # in the order of the file, whatever their kinds; those that have no header of their own come last
        entries.sort(key=lambda e: (e[0] is None, e[0] or 0))
        return Edit(tuple(e for _, e in entries), self._settings(found.get("settings", {})), clip, str(self.path))

    def _entry(self, kind: str, n: int, table: dict[str, Any]) -> Entry:
        make, readers = _KINDS[kind]
        what = f"[[{kind}]] {n + 1}"
        self._known(table, tuple(readers), kind, n, what)
        if "joint" in readers and "joint" not in table:
            raise self._error(f"{what} has no joint", kind, n, "", 'add a line as joint = "LeftHand"')
        values = {key: self._value(table, key, readers[key], kind, n) for key in table if key != "order"}
        try:
            _merge_turns(values, table)
        except _Wrong as e:
            raise self._error(f"{what}: {e}", kind, n, "euler" if "euler" in table else "order") from None
        return Entry(make, values, self._header(kind, n))

    def _settings(self, table: Any) -> Settings:
        if not isinstance(table, dict):
            raise self._error("settings is a table", "", 0, "settings", "write [settings]")
        known = {f.name: f for f in fields(Settings)}
        self._known(table, tuple(known), "settings", 0, "[settings]")
        values: dict[str, Any] = {}
        for key, value in table.items():
            default = known[key].default
            if isinstance(default, bool) != isinstance(value, bool) and not (value is False and key in _NONE):
                kind = "true or false" if isinstance(default, bool) else "no true or false"
                raise self._error(f"{key} = {_shown(value)}: it must be {kind}", "settings", 0, key)
            values[key] = None if value is False and key in _NONE else value
            try:
                Settings(**{key: values[key]})
            except (KinjaxError, TypeError) as e:
                raise self._error(str(e), "settings", 0, key) from None
        return Settings(**values)

    def _known(self, table: dict[str, Any], known: Sequence[str], kind: str, n: int, what: str) -> None:
        for key in table:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
                hint = f"nearest: {near[0]}" if near else f"known: {', '.join(known)}"
                raise self._error(f"{what} has no key {key!r}", kind, n, key, hint)

    def _value(self, table: dict[str, Any], key: str, reader: Callable[[Any, float], Any], kind: str, n: int) -> Any:
        try:
            return reader(table[key], self.scale)
        except _Wrong as e:
            raise self._error(f"{key} = {_shown(table[key])}: {e}", kind, n, key) from None

    # ---- where it stands: tomllib does not say, so the text is searched

    def _error(self, found: str, kind: str, n: int, key: str, remedy: str = "") -> FileFormatError:
        start = self._header(kind, n) if kind else 0
        line = start
        for i in range(start or 0, len(self.lines)):
            if re.match(rf"""\s*(\[\[?\s*)?["']?{re.escape(key)}["']?\s*[=.\]]""", self.lines[i]) and key:
                line = i + 1
                break
            if kind and re.match(r"\s*\[\[?\s*[\w\"']+", self.lines[i]):
                break
        return FileFormatError(found, path=self.path or None, line=line or None, remedy=remedy)

    def _header(self, kind: str, n: int) -> int | None:
        """The line, from 1, of the n-th header of a kind; where it was written in another way, of its key."""
        pattern = rf"""\s*\[\[?\s*["']?{kind}["']?\s*\]"""
        at = [i for i, line in enumerate(self.lines, 1) if re.match(pattern, line)]
        if n < len(at):
            return at[n]
        return next((i for i, s in enumerate(self.lines, 1) if re.match(rf"\s*{kind}\s*[=.]", s)), None)


# ---- values


def _number(value: Any, scale: float = 1.0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _Wrong("a number is needed")
    return float(value)


def _length(value: Any, scale: float) -> float:
    return scale * _number(value)


def _text(value: Any, scale: float = 1.0) -> str:
    if not isinstance(value, str):
        raise _Wrong("a text in quotes is needed")
    return value


def _texts(value: Any, scale: float = 1.0) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise _Wrong('a list of names is needed, as ["LeftArm", "LeftForeArm"]')
    return tuple(value)


def _unit(value: Any, scale: float = 1.0) -> float:
    try:
        if isinstance(value, bool) or value == "auto":
            raise OptionError("an edit file has no skeleton to infer it from: write m, cm, mm, inch or foot")
        return scale_of(value)[0]
    except (KinjaxError, TypeError) as e:
        raise _Wrong(str(e)) from None


def _seconds(value: Any, scale: float = 1.0) -> float:
    """Seconds: a number, or a text as "0.3 s"."""
    if isinstance(value, str):
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|ms)\s*", value)
        if not match:
            raise _Wrong('a number of seconds is needed, as 0.3 or "0.3 s"')
        return float(match[1]) * (1e-3 if match[2] == "ms" else 1)
    seconds = _number(value)
    if seconds < 0:
        raise _Wrong("a number of seconds from 0 is needed")
    return seconds


def _frame(value: Any, scale: float = 1.0) -> int | Time:
    if isinstance(value, str):
        try:
            return Time(_seconds(value))
        except _Wrong:
            pass
    elif isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    raise _Wrong('a frame is a whole number from 0, or a time as "1.5 s"')


def _vector(width: int, length: bool) -> Callable[[Any, float], tuple[float, ...]]:
    def read(value: Any, scale: float) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != width:
            raise _Wrong(f"{width} numbers in brackets are needed")
        return tuple((scale if length else 1.0) * _number(v) for v in value)

    return read


def _rows(width: int, length: bool) -> Callable[[Any, float], np.ndarray]:
    one = _vector(width, length)

    def read(value: Any, scale: float) -> np.ndarray:
        if not isinstance(value, list) or not value:
            raise _Wrong(f"a list of rows of {width} numbers is needed, one a frame")
        return np.array([one(v, scale) for v in value])

    return read


def _turn(value: Any, scale: float = 1.0) -> tuple[float, ...]:
    q = _vector(4, False)(value, 1.0)
    size = math.hypot(*q)
    if abs(size - 1) > 1e-2:
        raise _Wrong(f"a unit quaternion [w, x, y, z] is needed, and this one's length is {size:.4g}")
    return q


def _turns_vector(value: Any, scale: float = 1.0) -> tuple[float, ...]:
    return tuple(math.radians(v) for v in _vector(3, False)(value, 1.0))


def _passes(turns: bool) -> Callable[[Any, float], tuple[_Pass, ...]]:
    readers: dict[str, Callable[[Any, float], Any]] = {
        "frame": _frame, "until": _frame, "tension": _number, "continuity": _number, "bias": _number,
    }  # fmt: skip
    readers |= {"at": _turn, "euler": _vector(3, False), "order": _text} if turns else {"at": _vector(3, True)}

    def one(table: Any, scale: float) -> _Pass:
        if not isinstance(table, dict):
            raise _Wrong("a list of tables is needed, as [{frame = 40, at = [0, 1, 0], until = 80}]")
        for key in table:
            if key not in readers:
                near = difflib.get_close_matches(key, list(readers), n=1, cutoff=0.5)
                raise _Wrong(f"no key {key!r} (nearest: {near[0]})" if near else f"no key {key!r}")
        values = {}
        for key in table:
            try:
                values[key] = readers[key](table[key], scale)
            except _Wrong as e:
                raise _Wrong(f"{key}: {e}") from None
        values.pop("order", None)
        _merge_turns(values, table)
        for key in ("frame", "at"):
            if key not in values:
                raise _Wrong(f"a pass has no {key}")
        return _Pass(values)

    def read(value: Any, scale: float) -> tuple[_Pass, ...]:
        if not isinstance(value, list):
            raise _Wrong("a list of tables is needed, as [{frame = 40, at = [0, 1, 0], until = 80}]")
        return tuple(one(table, scale) for table in value)

    return read


def _merge_turns(values: dict[str, Any], table: dict[str, Any]) -> None:
    """`euler` and `order` of a table become `at`."""
    if "offset_degrees" in values:
        values["offset"] = values.pop("offset_degrees")
    if "euler" not in table:
        if "order" in table:
            raise _Wrong("order says how euler is meant, and there is no euler")
        return
    if "at" in table:
        raise _Wrong("at and euler are both given: one of them says the orientation")
    order = table.get("order", "XYZ")
    if (
        not isinstance(order, str)
        or sorted(order.lower()) != ["x", "y", "z"]
        or order not in (order.upper(), order.lower())
    ):
        raise _Wrong(f"order = {_shown(order)}: three axes are needed, as XYZ (turned axes) or xyz (fixed axes)")
    x, y, z, w = Rotation.from_euler(order, values.pop("euler"), degrees=True).as_quat()
    values["at"] = (float(w), float(x), float(y), float(z))


def _displacement(value: Any, scale: float) -> Any:
    """[x, y, z], a row a frame, or key frames [{frame = 0, by = [x, y, z]}, ...]."""
    if not isinstance(value, list) or not value:
        raise _Wrong("[x, y, z], rows of them, or [{frame = 0, by = [x, y, z]}] are needed")
    if not isinstance(value[0], dict):
        return (_rows(3, True) if isinstance(value[0], list) else _vector(3, True))(value, scale)
    out = []
    for key in value:
        if not isinstance(key, dict) or set(key) != {"frame", "by"}:
            raise _Wrong("each key frame is {frame = 0, by = [x, y, z]}")
        out.append((_frame(key["frame"]), _vector(3, True)(key["by"], scale)))
    return tuple(out)


def _shown(value: Any) -> str:
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 40 else text[:37] + "..."


_COMMON: dict[str, Callable[[Any, float], Any]] = {
    "priority": _number, "weight": _number, "begin": _frame, "end": _frame, "ease_in": _seconds, "ease_out": _seconds,
    "recruit_to": _text, "recruits": _texts, "relative_to": _text, "name": _text,
}  # fmt: skip
_PLACE = _vector(3, True)
_KINDS: dict[str, tuple[Callable[..., Goal], dict[str, Callable[[Any, float], Any]]]] = {
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
_NONE = tuple(f.name for f in fields(Settings) if "None" in str(f.type))  # settings that `false` switches off


# ---- writing


def write_edit(constraints: Sequence[Goal], settings: Settings | None = None, clip: str | None = None) -> str:
    """Constraints and settings as the text of an edit file, in metres; what has its default value is left out.

    `parse_edit` of it gives the same constraints: numbers to the last digit, angles of offsets to rounding.
    """
    lines = [f"clip = {_quoted(clip)}", ""] if clip is not None else []
    changed = {f.name: getattr(settings or Settings(), f.name) for f in fields(Settings)}
    changed = {k: v for k, v in changed.items() if v != getattr(Settings(), k)}
    if changed:
        lines += ["[settings]", *(f"{k} = {_toml(False if v is None else v)}" for k, v in changed.items()), ""]
    names = {make: kind for kind, (make, _) in _KINDS.items()}
    for goal in constraints:
        if type(goal) not in names:
            raise OptionError(f"a {type(goal).__name__} is no constraint")
        lines.append(f"[[{names[type(goal)]}]]")
        shown = [f for f in fields(goal) if f.init and not _is_default(f, getattr(goal, f.name))]
        shown.sort(key=lambda f: (f.name != "joint", f.name != "name"))
        for f in shown:
            key, value = f.name, getattr(goal, f.name)
            if key == "offset" and isinstance(goal, Orientation):
                key, value = "offset_degrees", np.degrees(np.asarray(value, float))
            elif key == "displacement" and _has_keys(value):
                value = [{"frame": int(k), "by": v} for k, v in value]
            lines.append(f"{key} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines).rstrip("\n") + "\n"


def _has_keys(value: Any) -> bool:
    """Whether a displacement is key frames (frame, (3,))."""
    return not isinstance(value, np.ndarray) and not np.isscalar(value[0]) and len(value[0]) == 2


def _is_default(f: Any, value: Any) -> bool:
    if f.default is MISSING:
        return False
    if value is None or f.default is None:
        return value is f.default
    return bool(np.array_equal(np.asarray(value, object), np.asarray(f.default, object)))


def _toml(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, Through):
        value = {f.name: getattr(value, f.name) for f in fields(value) if not _is_default(f, getattr(value, f.name))}
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        if not math.isfinite(value):
            raise OptionError(f"{value} cannot be written: an edit file holds finite numbers")
        return repr(float(value))
    return "[" + ", ".join(_toml(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)) + "]"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
