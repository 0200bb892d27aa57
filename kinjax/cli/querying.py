"""`kinjax query` and `kinjax store`: questions to a store, and its upkeep.

In: options. Out: rows as a table, CSV or JSON; exit code 0, or 3 from a check that found something.
"""

from __future__ import annotations

import csv
import json
import math
import shlex
import sys
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import pyarrow as pa
from rich.cells import cell_len

from ..annotations import TYPES, check_type
from ..database.overlaps import When, overlapping
from ..database.sql import query
from ..database.store import Store
from ..errors import OptionError, UnknownNameError
from ..formats.annotations_tables import safe_cell
from .database_options import Query, StoreCommand
from .show import Screen

WRONG = 3
CELL = 60  # characters of a table's cell on a terminal


def query_command(options: Query) -> int:
    """`kinjax query`."""
    if options.store is None:
        raise OptionError('no store is given: kinjax query STORE "SELECT ..."')
    if (options.sql is None) == (not options.when):
        raise OptionError("give SQL, or --when conditions")
    store = Store(options.store)
    if options.sql is not None:
        found = query(store, options.sql)
    else:
        conditions = [_when(text) for text in options.when]
        found = overlapping(store, *conditions, least=options.least)
        if not found.num_rows:
            _unknown(store, conditions)
    if options.play:
        return _play(found)
    if options.format == "csv":
        _csv(found)
    elif options.format == "json":
        print(json.dumps(_plain(found.to_pylist()), default=str, indent=1))
    else:
        _table(found, options.limit)
    return 0


def _when(text: str) -> When:
    """A condition of `OBJECT[:TYPE][:SECONDS]`, read from its end, since an object's name may hold colons; * is any object."""
    parts, kind, longer = text.split(":"), None, 0.0
    if len(parts) > 1 and (seconds := _seconds(parts[-1])) is not None:
        longer = seconds
        parts.pop()
    if len(parts) > 1 and parts[-1] in ("", *TYPES):
        kind = parts.pop() or None
    name = ":".join(parts)
    if len(parts) > 1 and _seconds(parts[-1]) is not None:
        raise OptionError(f"--when {text!r}: write OBJECT, OBJECT:TYPE, OBJECT:SECONDS or OBJECT:TYPE:SECONDS")
    return When(None if name in ("", "*") else name, kind, longer)


def _seconds(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _unknown(store: Store, conditions: Sequence[When]) -> None:
    """Nothing was found: `OptionError` if that is because no clip has what a condition names."""
    asked = [c.object for c in conditions if c.object is not None]
    if not asked:
        return
    found = query(store, "SELECT unnest(objects) FROM clips UNION SELECT role FROM patterns UNION SELECT object FROM patterns")
    known = [name for name in found[0].to_pylist() if name is not None]
    for name in asked:
        if known and name.casefold() not in {k.casefold() for k in known}:
            head, colon, last = name.rpartition(":")
            if colon and head.casefold() in {k.casefold() for k in known}:
                check_type(last)
            raise UnknownNameError(name, sorted(known), "object or role", str(store.path))


def _table(found: pa.Table, limit: int) -> None:
    """Rows in columns as wide as they need, whatever the terminal is; on one, cells that are very long are cut."""
    shown = found.slice(0, limit) if limit > 0 else found
    screen = Screen()
    most = CELL if screen.live else sys.maxsize
    rows = [[_cell(v, most) for v in row.values()] for row in shown.to_pylist()]
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
    right = [any(is_kind(f.type) for is_kind in kinds) for f in found.schema]
    rows.insert(0, [_cell(name, most) for name in found.schema.names])
    widths = [max(map(cell_len, column)) for column in zip(*rows, strict=True)]
    screen.print("\n".join(_line(row, widths, right) for row in rows))
    rest = found.num_rows - shown.num_rows
    more = f", {rest:,} more: --limit 0 shows all" if rest else ""
    screen.print(f"{found.num_rows:,} row{'s' * (found.num_rows != 1)}{more}")


def _line(row: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    room = (" " * (w - cell_len(x)) for x, w in zip(row, widths, strict=True))
    return "  ".join(r + x if at_right else x + r for x, r, at_right in zip(row, room, right, strict=True)).rstrip()


def _cell(value: Any, most: int = sys.maxsize) -> str:
    text = _text(value)
    return text if len(text) <= most else text[: most - 1] + "…"


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return "".join(c if c.isprintable() else "?" for c in str(value))


def _csv(found: pa.Table) -> None:
    """Rows as CSV; what a spreadsheet would take for a formula gets an apostrophe in front."""
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(map(safe_cell, found.schema.names))
    for row in found.to_pylist():
        out.writerow([_safe(v) for v in row.values()])


def _safe(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | Decimal):
        return value
    return safe_cell(value if isinstance(value, str) else json.dumps(_plain(value), default=str))


def _plain(value: Any) -> Any:
    """Values that JSON has: what is no number is null, sums of whole numbers are whole."""
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _play(found: pa.Table) -> int:
    """The command for each row: the clip, around the frames of the row where it has them."""
    if "path" not in found.schema.names:
        raise OptionError('--play needs the column path: SELECT clip, path, begin, "end" FROM constraints ...')
    for row in found.to_pylist():
        if row["path"] is None:
            continue
        command = ["kinjax", "plot", str(row["path"])]
        if row.get("begin") is not None and row.get("end") is not None:
            command += ["--frames", f"{max(0, math.floor(row['begin']))}:{math.ceil(row['end'])}"]
        if objects := _values(row, "object"):
            command += ["--object", *objects]
        if set(types := _values(row, "type")) - {"space"}:
            command += ["--type", *dict.fromkeys(("space", *types))]  # pivots are found beside rests
        print(" ".join(map(_quoted, command)))
    return 0


def _values(row: dict[str, Any], name: str) -> list[str]:
    """What a row has under NAME, NAME_1, NAME_2, ..., each once."""
    return list(dict.fromkeys(str(v) for k, v in row.items() if (k == name or k.startswith(f"{name}_")) and v))


def _quoted(text: str) -> str:
    """A word for a shell; control characters as escapes (bash and zsh), so that a terminal shows them and does not obey."""
    return shlex.quote(text) if text.isprintable() else "$'" + "".join(map(_escaped, text)) + "'"


def _escaped(c: str) -> str:
    return c if c.isprintable() and c not in "\\'" else f"\\U{ord(c):08x}"


def store_command(options: StoreCommand) -> int:
    """`kinjax store check` and `kinjax store compact`."""
    from ..database.upkeep import check, compact

    screen = Screen(options.quiet)
    store = Store(options.store)
    if options.action == "compact":
        before, after = compact(store)
        screen.print(f"{before:,} parts are now {after:,}: {options.store}")
        return 0
    complaints = check(store)
    for complaint in complaints:
        screen.warn(complaint)
    if complaints:
        screen.print(f"{len(complaints)} complaints: {options.store}")
    else:
        counts = (f"{store.table(t, ['clip']).num_rows:,} {t}" for t in ("clips", "constraints", "patterns", "errors"))
        screen.print(f"whole: {', '.join(counts)}")
    return WRONG if complaints else 0
