"""`kinjax query` and `kinjax store`: questions to a store, and its upkeep.

In: options. Out: rows as a table, CSV or JSON; exit code 0, or 3 from a check that found something.
"""

from __future__ import annotations

import csv
import json
import math
import shlex
import sys
from typing import Any

import pyarrow as pa

from ..database.overlaps import When, overlapping
from ..database.query import query
from ..database.store import Store
from ..errors import OptionError
from .database_options import Query, StoreCommand
from .show import Screen, table

WRONG = 3


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
        found = overlapping(store, *(_when(text) for text in options.when), least=options.least)
    if options.play:
        return _play(found)
    if options.format == "csv":
        _csv(found)
    elif options.format == "json":
        print(json.dumps([_finite(row) for row in found.to_pylist()], default=str, indent=1))
    else:
        _table(found, options.limit)
    return 0


def _when(text: str) -> When:
    """A condition of `OBJECT[:TYPE][:SECONDS]`; * is any object."""
    name, *more = text.split(":")
    kind, longer = None, 0.0
    for part in more:
        try:
            longer = float(part)
        except ValueError:
            if kind is not None:
                raise OptionError(f"--when {text!r}: write OBJECT, OBJECT:TYPE, OBJECT:TYPE:SECONDS") from None
            kind = part
    return When(None if name in ("", "*") else name, kind, longer)


def _table(found: pa.Table, limit: int) -> None:
    shown = found.slice(0, limit) if limit > 0 else found
    numbers = [i for i, f in enumerate(found.schema) if pa.types.is_integer(f.type) or pa.types.is_floating(f.type)]
    rows = [tuple(_cell(v) for v in row.values()) for row in shown.to_pylist()]
    screen = Screen()
    screen.print(table(tuple(found.schema.names), rows, numbers=numbers))
    rest = found.num_rows - shown.num_rows
    more = f", {rest:,} more: --limit 0 shows all" if rest else ""
    screen.print(f"{found.num_rows:,} row{'s' * (found.num_rows != 1)}{more}")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_cell(v) for v in value)
    return "".join(c if c.isprintable() else "?" for c in str(value))


def _csv(found: pa.Table) -> None:
    """Rows as CSV; what a spreadsheet would take for a formula gets an apostrophe in front."""
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(found.schema.names)
    for row in found.to_pylist():
        out.writerow([_safe(v) for v in row.values()])


def _safe(value: Any) -> Any:
    if isinstance(value, str) and value[:1] in tuple("=+-@\t\r"):
        return "'" + value
    return json.dumps(value) if isinstance(value, list) else value


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def _play(found: pa.Table) -> int:
    """The command for each row: the clip, around the frames of the row where it has them."""
    if "path" not in found.schema.names:
        raise OptionError('--play needs the column path: SELECT clip, path, begin, "end" FROM constraints ...')
    for row in found.to_pylist():
        command = ["kinjax", "plot", str(row["path"])]
        if row.get("begin") is not None and row.get("end") is not None:
            command += ["--frames", f"{row['begin']}:{row['end']}"]
        objects = [str(v) for k, v in row.items() if (k == "object" or k.startswith("object_")) and v]
        if objects:
            command += ["--object", *dict.fromkeys(objects)]
        print(shlex.join(command))
    return 0


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
