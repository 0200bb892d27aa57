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
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..deform.constraints import Goal, Through
from ..deform.settings import Settings
from ..errors import FileFormatError, KinjaxError, OptionError, find_name
from .edit_text import write_edit
from .edit_values import HEADER, KINDS, NONE, Pass, Reader, Time, Wrong, merge_turns, shown
from .files import read_bytes

__all__ = ["Edit", "Entry", "Time", "parse_edit", "read_edit", "write_edit"]

LIMIT = 64 << 20  # bytes of an edit file; paths of many frames are long, but not that long


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
    if isinstance(value, Pass):
        return Through(**{k: _at_rate(v, rate) for k, v in value.values.items()})
    if isinstance(value, tuple):
        return tuple(_at_rate(v, rate) for v in value)
    return value


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
    return _File(text, path).edit(found)


class _File:
    """One file: its values checked and converted, its lines searched when something is wrong."""

    def __init__(self, text: str, path: str | Path):
        self.lines, self.path, self.scale = text.splitlines(), path, 1.0

    def edit(self, found: dict[str, Any]) -> Edit:
        """The whole file."""
        self._known(found, (*KINDS, "settings", *HEADER), "", 0, "this file")
        self.scale = self._value(found, "unit", HEADER["unit"], "", 0) if "unit" in found else 1.0
        clip = self._value(found, "clip", HEADER["clip"], "", 0) if "clip" in found else None
        entries = []
        for kind in KINDS:
            tables = found.get(kind, [])
            if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
                raise self._error(f"{kind} is a list of tables", "", 0, kind, f"write [[{kind}]]")
            entries += [(self._header(kind, n), self._entry(kind, n, t)) for n, t in enumerate(tables)]
        # in the order of the file, whatever their kinds; those that have no header of their own come last
        entries.sort(key=lambda e: (e[0] is None, e[0] or 0))
        return Edit(tuple(e for _, e in entries), self._settings(found.get("settings", {})), clip, str(self.path))

    def _entry(self, kind: str, n: int, table: dict[str, Any]) -> Entry:
        make, readers = KINDS[kind]
        what = f"[[{kind}]] {n + 1}"
        self._known(table, tuple(readers), kind, n, what)
        if "joint" in readers and "joint" not in table:
            raise self._error(f"{what} has no joint", kind, n, "", 'add a line as joint = "LeftHand"')
        values = {key: self._value(table, key, readers[key], kind, n) for key in table if key != "order"}
        try:
            merge_turns(values, table)
        except Wrong as e:
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
            if isinstance(default, bool) != isinstance(value, bool) and not (value is False and key in NONE):
                kind = "true or false" if isinstance(default, bool) else "no true or false"
                raise self._error(f"{key} = {shown(value)}: it must be {kind}", "settings", 0, key)
            values[key] = None if value is False and key in NONE else value
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

    def _value(self, table: dict[str, Any], key: str, reader: Reader, kind: str, n: int) -> Any:
        try:
            return reader(table[key], self.scale)
        except Wrong as e:
            raise self._error(f"{key} = {shown(table[key])}: {e}", kind, n, key) from None

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
