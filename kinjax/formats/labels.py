"""Labels on disk: what found constraints are compared with (`kinjax.evaluation`), from files that people and programs make.

In: the path of a file, or of a folder of such files. Out: `Label`s; what their fields mean is said in `kinjax.evaluation.labels`. Read are

* .json: `{"schema": "kinjax-labels/1", "labels": [{"clip": "walk.bvh", "object": "left_foot", "begin_s": 0.4, "end_s": 1.1}, ...]}`,
  each with `clip`, `object`, either `begin` and `end` (frames, both included) or `begin_s` and `end_s` (seconds), and if it likes
  `type` (space, line, point, none) and `kind` (exact, outer, unknown). `note` at the top is for people;
* .csv: the same names in the first line, in any order; an empty cell is what is not said;
* .npz: arrays of the same names, each (labels,), as NumPy's `savez` writes them; text and numbers, no pickles;
* annotations of `kinjax detect` (.json, .csv, .parquet, .npz): each constraint is an exact label of its type.

Nothing that is not understood is passed over: another column, key or version is a `FileFormatError`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from ..annotations import Annotations
from ..errors import FileFormatError, OptionError
from ..evaluation.labels import FIELDS, Label
from .annotations_io import SUFFIXES, read_annotations
from .annotations_tables import safe_cell
from .files import clean_text, read_bytes, write_atomically
from .npz_container import _ZIP_ERRORS, _entries, _member, check_schema

SCHEMA = "kinjax-labels/1"
_WHOLE, _TIMES = ("begin", "end"), ("begin_s", "end_s")
_REMEDY = f"the columns are {', '.join(FIELDS)}"


def read_labels(path: str | Path) -> tuple[Label, ...]:
    """The labels in a file, or in all label and annotation files of a folder and its folders, in the order of their names.

    Raises `FileFormatError`: another format, version, column or key; a label that cannot be, with its line (.csv) or number; an
    empty folder.
    """
    path = Path(path)
    if not path.is_dir():
        return _read_file(path)
    files = sorted(f for f in path.rglob("*") if f.suffix.lower() in SUFFIXES and f.is_file())
    if not files:
        raise FileFormatError("no labels in this folder", path=path, remedy=f"labels are read from {', '.join(SUFFIXES)}")
    return tuple(label for f in files for label in _read_file(f))


def write_labels(path: str | Path, labels: Iterable[Label], note: str = "") -> Path:
    """Write labels; the suffix chooses .json or .csv (which holds no note). Returns the path. `OptionError` for another suffix."""
    path, rows = Path(path), [_said(x) for x in labels]
    if path.suffix.lower() == ".json":
        lines = ",\n    ".join(json.dumps(r, ensure_ascii=False) for r in rows)
        head = f'"schema": "{SCHEMA}",\n  ' + (f'"note": {json.dumps(clean_text(note), ensure_ascii=False)},\n  ' if note else "")
        return write_atomically(path, ("{\n  " + head + f'"labels": [\n    {lines}\n  ]\n}}\n').encode())
    if path.suffix.lower() == ".csv":
        out = io.StringIO()
        writer = csv.writer(out)
        writer.writerow(FIELDS)
        for r in rows:
            writer.writerow([safe_cell(v) if isinstance(v := r.get(n, ""), str) else repr(v) for n in FIELDS])
        return write_atomically(path, out.getvalue().encode())
    raise OptionError(f"{path}: labels are written as .json or .csv, not as {path.suffix or 'a file without suffix'}")


def _said(label: Label) -> dict[str, Any]:
    values = {n: getattr(label, n) for n in FIELDS}
    return {n: clean_text(v) if isinstance(v, str) else v for n, v in values.items() if v is not None and v != ""}


def _read_file(path: Path) -> tuple[Label, ...]:
    kind = path.suffix.lower()
    if kind == ".json":
        return _from_json(read_bytes(path), path)
    if kind == ".csv":
        return _from_csv(read_bytes(path), path)
    if kind == ".npz":
        return _from_npz(path)
    if kind == ".parquet":
        return _of(read_annotations(path), path)
    found = f"no format of labels has the suffix {path.suffix!r}"
    raise FileFormatError(found, path=path, remedy=f"labels are read from {', '.join(SUFFIXES)}")


def _of(a: Annotations, path: Path) -> tuple[Label, ...]:
    """Annotations as labels: in seconds where the rate is known, so that they fit a clip of another rate."""
    try:
        if not a.fps > 0:
            return tuple(Label(a.clip, c.object, c.begin, c.end, type=c.type) for c in a.constraints)
        return tuple(Label(a.clip, c.object, begin_s=c.begin / a.fps, end_s=c.end / a.fps, type=c.type) for c in a.constraints)
    except OptionError as e:
        raise FileFormatError(f"these annotations cannot be labels: {e}", path=path, remedy="give clip and object a name") from e


def _from_json(data: bytes, path: Path) -> tuple[Label, ...]:
    try:
        record = json.loads(data.decode("utf-8-sig"))
    except json.JSONDecodeError as e:
        found = f"this is not JSON: {e.msg}"
        raise FileFormatError(found, path=path, line=e.lineno, column=e.colno, remedy="correct the file there") from e
    except (ValueError, RecursionError) as e:
        raise FileFormatError(f"this is not JSON: {e}", path=path, remedy="get a complete copy in UTF-8") from e
    if not isinstance(record, dict):
        raise FileFormatError("these are no labels", path=path, remedy=f'write {{"schema": "{SCHEMA}", "labels": [...]}}')
    if str(record.get("schema")).startswith("kinjax-annotations/"):
        return _of(read_annotations(path), path)
    check_schema(record.get("schema"), SCHEMA, path)
    try:
        rows = msgspec.convert(record, _File).labels
    except msgspec.ValidationError as e:
        raise FileFormatError(f"these are no labels: {e}", path=path, remedy=_REMEDY) from e
    return tuple(_label(row, path, name=f"labels[{n}]") for n, row in enumerate(rows))


class _File(msgspec.Struct, forbid_unknown_fields=True):
    schema: str
    labels: tuple[dict[str, str | int | float | None], ...]
    note: str = ""


def _from_csv(data: bytes, path: Path) -> tuple[Label, ...]:
    try:
        rows = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        head = [cell.strip() for cell in next(rows, [])]
        if head[:4] == ["clip", "fps", "frames", "method"]:
            return _of(read_annotations(path), path)
        _check_names(head, path, line=1)
        if len(set(head)) != len(head):
            raise FileFormatError("a column is there twice", path=path, line=1, remedy=_REMEDY)
        out = []
        for row in rows:
            if not any(row):
                continue
            if len(row) != len(head):
                found = f"{len(row)} cells under {len(head)} columns"
                raise FileFormatError(found, path=path, line=rows.line_num, remedy="complete the row")
            said = {n: _cell(n, x.strip(), path, rows.line_num, k + 1) for k, (n, x) in enumerate(zip(head, row, strict=True))}
            out.append(_label(said, path, line=rows.line_num))
        return tuple(out)
    except (csv.Error, UnicodeDecodeError) as e:
        raise FileFormatError(f"this is no readable CSV: {e}", path=path, remedy="get a complete copy in UTF-8") from e


def _cell(name: str, cell: str, path: Path, line: int, column: int) -> Any:
    if name not in (*_WHOLE, *_TIMES):
        return cell.removeprefix("'")
    if not cell:
        return None
    try:
        return int(cell) if name in _WHOLE else float(cell)
    except ValueError:
        found, what = f"{cell[:40]!r} in the column {name} (the {column}. of the row)", "number with a decimal point"
        remedy = f"write a {'whole number: frames are counted from 0' if name in _WHOLE else what}"
        raise FileFormatError(found, path=path, line=line, remedy=remedy) from None


def _from_npz(path: Path) -> tuple[Label, ...]:
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            entries = _entries(archive, path)
            if "meta" in entries:
                return _of(read_annotations(path), path)
            _check_names(list(entries), path)
            arrays = {name: _member(archive, entry, path) for name, entry in entries.items()}
    except FileFormatError:
        raise
    except _ZIP_ERRORS as e:
        raise FileFormatError(f"this is no readable .npz file: {e}", path=path, remedy="get a complete copy") from e
    shapes = {name: a.shape for name, a in arrays.items()}
    if any(len(s) != 1 for s in shapes.values()) or len(set(shapes.values())) > 1:
        found = ", ".join(f"{n} {s}" for n, s in shapes.items())
        raise FileFormatError(f"the arrays are {found}", path=path, remedy="each holds one value a label, in the same order")
    for name, a in arrays.items():
        if (a.dtype.kind == "U") == (name in (*_WHOLE, *_TIMES)):
            raise FileFormatError(f"the array {name} is of {a.dtype}", path=path, remedy="names are text, times are numbers")
    rows = zip(*(a.tolist() for a in arrays.values()), strict=True)
    return tuple(_label(dict(zip(arrays, row, strict=True)), path, name=f"label {n}") for n, row in enumerate(rows))


def _check_names(names: list[str], path: Path, line: int | None = None) -> None:
    if strange := [n for n in names if n not in FIELDS]:
        raise FileFormatError(f"the column {strange[0]!r} is not known", path=path, line=line, remedy=_REMEDY)
    if missing := [n for n in ("clip", "object") if n not in names]:
        raise FileFormatError(f"there is no column {missing[0]!r}", path=path, line=line, remedy=_REMEDY)


def _label(row: Mapping[str, Any], path: Path, line: int | None = None, name: str = "") -> Label:
    said = {k: v for k, v in row.items() if v is not None and not (isinstance(v, float) and math.isnan(v)) and v != ""}
    where = f"{name}: " if name else ""
    if strange := [k for k in said if k not in FIELDS]:
        raise FileFormatError(f"{where}the key {strange[0]!r} is not known", path=path, line=line, remedy=_REMEDY)
    try:
        return Label(**{"clip": "", "object": "", **said})
    except OptionError as e:
        raise FileFormatError(f"{where}{e}", path=path, line=line, remedy="correct the label") from e
