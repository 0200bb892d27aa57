"""Annotations as tables: CSV for spreadsheets, Parquet for queries. One row a constraint.

In: `Annotations`. Out: bytes, and back. Columns: those of `Constraints.columns()`. Parquet carries the rest (clip, rate,
patterns, warnings) as JSON under `kinjax` in the metadata of its schema. CSV repeats `clip, fps, frames, method` in each row,
so that files can be put under each other; a clip without constraints is one row whose `object` is empty.

CSV and spreadsheets: text that begins with `=`, `+`, `-`, `@`, a tab or a line end would be run as a formula. It gets
an apostrophe in front (as does text that begins with one), which reading takes off again. Numbers are left as they are.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from ..annotations import Annotations, Constraints
from ..errors import FileFormatError, KinjaxError
from .annotations_json import SCHEMA, check, from_record, numbers, to_record
from .files import clean_text

_CLIP = ("clip", "fps", "frames", "method")
_COLUMNS = tuple(Constraints().columns())
_WHOLE = {"begin", "end", "pattern", "frames"}
_TEXT = {"object", "type", "clip", "method"}
_RISKY = ("=", "+", "-", "@", "\t", "\r", "\n", "'")


def safe_cell(text: str) -> str:
    """Text as it may stand in a CSV cell: never the begin of a formula; one leading apostrophe is to be taken off."""
    text = clean_text(text)
    return f"'{text}" if text.startswith(_RISKY) else text


def _unsafe_cell(cell: str) -> str:
    return cell[1:] if cell.startswith("'") else cell


def _number_cell(value: Any) -> str:
    value = value.item() if isinstance(value, np.generic) else value
    return "" if isinstance(value, float) and math.isnan(value) else repr(value)


def _table(annotations: Annotations) -> dict[str, np.ndarray]:
    """The constraints as columns, all with the clip's rate."""
    check(annotations)
    fps = float(annotations.fps)
    return Constraints(tuple(replace(c, fps=fps) for c in annotations.constraints)).columns()


def to_csv(annotations: Annotations) -> bytes:
    """The bytes of a .csv file (UTF-8, CRLF). `OptionError` for a constraint outside its clip."""
    a, columns, out = annotations, _table(annotations), io.StringIO()
    writer = csv.writer(out)
    clip = [safe_cell(a.clip), _number_cell(float(a.fps)), _number_cell(int(a.frames)), safe_cell(a.method)]
    writer.writerow([*_CLIP, *columns])
    for row in zip(*columns.values(), strict=True):
        cells = [safe_cell(str(x)) if n in _TEXT else _number_cell(x) for n, x in zip(columns, row, strict=True)]
        writer.writerow([*clip, *cells])
    if not len(a.constraints):
        writer.writerow([*clip, *[""] * len(columns)])
    return out.getvalue().encode()


def from_csv(data: bytes, path: object = None) -> Annotations:
    """The annotations in the bytes of a .csv file: without patterns and warnings, which it does not hold."""
    try:
        rows = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        head = next(rows, [])
        if head != [*_CLIP, *_COLUMNS]:
            remedy = f"the first line must be {','.join((*_CLIP, *_COLUMNS))}"
            raise FileFormatError("these columns are not those of annotations", path=path, line=1, remedy=remedy)
        records = [_record(head, row, rows.line_num, path) for row in rows if row]
    except (csv.Error, UnicodeDecodeError) as e:
        raise FileFormatError(f"this is no readable CSV: {e}", path=path, remedy="get a complete copy in UTF-8") from e
    clips = {tuple(r[k] for k in _CLIP) for r in records}
    if len(clips) != 1:
        found = f"the file holds {len(clips)} clips" if clips else "the file has no row"
        raise FileFormatError(found, path=path, remedy="one clip is read from one file: divide it by the column clip")
    (clip, fps, frames, method) = clips.pop()
    constraints = [_constraint(r) for r in records if r["object"] or r["type"]]
    if len(constraints) != len(records) and len(records) > 1:
        raise FileFormatError("a row without object and type", path=path, remedy="only a clip without constraints has one")
    whole = {"schema": SCHEMA, "clip": clip, "fps": fps, "frames": frames, "unit": "m", "method": method}
    return from_record({**whole, "constraints": constraints, "patterns": [], "warnings": []}, path)


def _record(head: list[str], row: list[str], line: int, path: object) -> dict[str, Any]:
    """One row as values by column; empty cells of numbers are NaN."""
    if len(row) != len(head):
        raise FileFormatError(f"{len(row)} cells under {len(head)} columns", path=path, line=line, remedy="complete the row")
    out: dict[str, Any] = {}
    blank = not row[head.index("object")] and not row[head.index("type")]
    for name, cell in zip(head, row, strict=True):
        try:
            if name in _TEXT:
                out[name] = _unsafe_cell(cell)
            elif blank and name not in _CLIP:
                out[name] = None
            else:
                out[name] = int(cell) if name in _WHOLE else float(cell) if cell else math.nan
        except ValueError:
            found = f"{cell[:40]!r} in the column {name}"
            raise FileFormatError(found, path=path, line=line, remedy="write a number with a decimal point") from None
    return out


def _constraint(row: dict[str, Any]) -> dict[str, Any]:
    """A row of numbers as the record of a constraint."""
    axis = [row[f"axis_{k}"] for k in "xyz"]
    return {
        **{k: row[k] for k in ("object", "type", "begin", "end", "pattern")},
        **{k: numbers([row[k]])[0] for k in ("begin_s", "end_s", "residual")},
        "position": numbers(row[k] for k in "xyz"),
        "axis": None if all(math.isnan(x) for x in axis) else numbers(axis),
    }


def to_parquet(annotations: Annotations) -> bytes:
    """The bytes of a .parquet file. `OptionError` for a constraint outside its clip."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = _table(annotations)
    rest = {k: v for k, v in to_record(annotations).items() if k != "constraints"}
    text = {n: [clean_text(str(x)) for x in columns[n]] for n in ("object", "type")}
    types = {n: pa.string() if n in _TEXT else pa.int64() if n in _WHOLE else pa.float64() for n in columns}
    arrays = [pa.array(text.get(n, values), types[n]) for n, values in columns.items()]
    table = pa.table(arrays, pa.schema(types.items(), metadata={"kinjax": msgspec.json.encode(rest)}))
    out = io.BytesIO()
    parquet.write_table(table, out)
    return out.getvalue()


def from_parquet(data: bytes, path: object = None) -> Annotations:
    """The annotations in the bytes of a .parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(pa.BufferReader(data), use_threads=False)
        rest = msgspec.json.decode((table.schema.metadata or {}).get(b"kinjax", b"{}"), type=dict[str, Any])
        rows = table.select(list(_COLUMNS)).to_pylist() if rest else []
        found = [_constraint(row) for row in rows]
    except KinjaxError:
        raise
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError, msgspec.MsgspecError, RecursionError) as e:
        raise FileFormatError(f"this is no Parquet file of annotations: {e}", path=path, remedy="get a complete copy") from e
    return from_record({**rest, "constraints": found}, path)
