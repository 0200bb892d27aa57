"""Annotations on disk: one record in, one file out, and back. The suffix chooses the format.

| suffix | what it keeps | for |
|---|---|---|
| .json | everything, readable; `annotations.schema.json` beside this module describes it | exchange, archives |
| .parquet | everything; one row a constraint, the rest as JSON in the table's metadata (`kinjax`) | queries |
| .npz | everything, and a label for each frame and object (`annotations_frames`) | training |
| .csv | the constraints, with clip, fps, frames and method in each row; no patterns, no warnings | spreadsheets |

Frames are 0-based and `begin..end` includes both (`kinjax.annotations`); `begin_s` and `end_s` are the times of those
frames. Every file is written whole or not at all. A file of an unknown version is refused, never guessed at.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..annotations import Annotations
from ..errors import FileFormatError, OptionError
from .files import read_bytes, write_atomically

SUFFIXES = (".json", ".csv", ".parquet", ".npz")


def write_annotations(path: str | Path, annotations: Annotations, objects: Sequence[str] | None = None) -> Path:
    """Write annotations; the suffix of `path` (any case) chooses the format. Returns the path.

    objects: for .npz only, the names of its columns, in order (default: those with a constraint, in order of appearance).
    Raises `OptionError`: an unknown suffix, frames outside the clip, names missing from `objects`.
    """
    from . import annotations_frames, annotations_json, annotations_tables

    kind = _suffix(path)
    if kind not in SUFFIXES:
        raise OptionError(f"{path}: annotations are written as {', '.join(SUFFIXES)}, not as {kind or 'a file without suffix'}")
    if objects is not None and kind != ".npz":
        raise OptionError(f"{path}: objects= names the columns of an .npz file; {kind} has none")
    if kind == ".npz":
        return annotations_frames.write(path, annotations, objects)
    encode = {".json": annotations_json.encode, ".csv": annotations_tables.to_csv, ".parquet": annotations_tables.to_parquet}
    return write_atomically(path, encode[kind](annotations))


def read_annotations(path: str | Path) -> Annotations:
    """Read annotations that `write_annotations` wrote; the suffix (any case) says how.

    Raises `FileFormatError` with what was found and the remedy: another suffix, another version, damage, a constraint
    outside its clip.
    """
    from . import annotations_frames, annotations_json, annotations_tables

    kind = _suffix(path)
    if kind not in SUFFIXES:
        found = f"no format of annotations has the suffix {kind!r}"
        raise FileFormatError(found, path=path, remedy=f"annotations are read from {', '.join(SUFFIXES)}")
    if kind == ".npz":
        return annotations_frames.read(path)
    decode = {".json": annotations_json.decode, ".csv": annotations_tables.from_csv, ".parquet": annotations_tables.from_parquet}
    return decode[kind](read_bytes(path), path)


def _suffix(path: str | Path) -> str:
    return Path(path).suffix.lower()
