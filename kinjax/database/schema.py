"""The tables of a store: their columns, and rows of them from what was detected.

In: detections and errors, clip by clip. Out: Arrow tables of one fixed schema each, rows in the order of the clips' names.
What the columns mean is told in docs/annotation.md; frames are 0-based, both ends included, as everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from ..annotations import TYPES

if TYPE_CHECKING:
    from ..detect.results import Detection

VERSION = "kinjax-store/1"
_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()

CLIPS = pa.schema(
    {
        "clip": _TEXT, "key": _TEXT, "path": _TEXT, "root": _TEXT, "format": _TEXT, "bytes": _WHOLE, "subject": _TEXT,
        "skeleton": _TEXT, "up": _TEXT, "joints": _WHOLE, "frames": _WHOLE, "fps": _REAL, "duration_s": _REAL,
        "objects": pa.list_(_TEXT), "constraints": _WHOLE, "missing": _WHOLE, "warnings": pa.list_(_TEXT),
        "notes": pa.list_(_TEXT),
    }
)  # fmt: skip
CONSTRAINTS = pa.schema(
    {
        "clip": _TEXT, "object": _TEXT, "role": _TEXT, "type": _TEXT, "begin": _WHOLE, "end": _WHOLE, "begin_s": _REAL,
        "end_s": _REAL, "duration_s": _REAL, "x": _REAL, "y": _REAL, "z": _REAL, "axis_x": _REAL, "axis_y": _REAL,
        "axis_z": _REAL, "residual": _REAL, "pattern": _WHOLE,
    }
)  # fmt: skip
PATTERNS = pa.schema(
    {
        "clip": _TEXT, "pattern": _WHOLE, "object": _TEXT, "role": _TEXT, "type": _TEXT, "status": _TEXT, "unit": _TEXT,
        "sigma_max": pa.list_(_REAL), "eps_max": pa.list_(_REAL), "frames": pa.list_(_WHOLE), "noise_m": _REAL,
        "noise_rad": _REAL, "missing": _WHOLE, "template": _TEXT,
    }
)  # fmt: skip
ERRORS = pa.schema(
    {
        "clip": _TEXT, "key": _TEXT, "path": _TEXT, "root": _TEXT, "format": _TEXT, "bytes": _WHOLE, "kind": _TEXT,
        "message": _TEXT, "line": _WHOLE, "column": _WHOLE, "attempts": _WHOLE,
    }
)  # fmt: skip
TABLES: Mapping[str, pa.Schema] = {"constraints": CONSTRAINTS, "patterns": PATTERNS, "errors": ERRORS, "clips": CLIPS}
"""In the order in which a part's files are put into place: the clips come last, a part without them does not count."""


class Columns:
    """Rows of the four tables, gathered column by column; a clip's come in one block."""

    def __init__(self) -> None:
        self.blocks: dict[str, list[tuple[str, Mapping[str, Sequence[Any]]]]] = {t: [] for t in TABLES}

    def add(self, name: str, clip: str, columns: Mapping[str, Sequence[Any]]) -> None:
        """A block of rows of one clip; the column `clip` is filled in."""
        self.blocks[name].append((clip, columns))

    def tables(self) -> dict[str, pa.Table]:
        """Arrow tables, rows in the order of the clips' names."""
        out = {}
        for name, schema in TABLES.items():
            gathered: dict[str, list[Any]] = {c: [] for c in schema.names}
            for clip, columns in sorted(self.blocks[name], key=lambda b: b[0]):
                count = len(next(iter(columns.values())))
                for c in schema.names:
                    gathered[c].extend([clip] * count if c == "clip" else columns[c])
            out[name] = pa.table({c: pa.array(v, schema.field(c).type) for c, v in gathered.items()}, schema=schema)
        return out


def constraint_rows(found: Detection, roles: Mapping[str, str | None]) -> Mapping[str, Sequence[Any]]:
    """Rows of `constraints`, in time order; roles: of the objects."""
    s, rate = found.segments, float(found.rate)
    order = sorted(range(len(s.begin)), key=lambda i: (s.begin[i], s.end[i], found.objects[s.object[i]], s.type[i]))
    at = np.array(order, int)
    begin, end = np.asarray(s.begin)[at], np.asarray(s.end)[at]
    objects = [found.objects[j] for j in np.asarray(s.object)[at]]
    kinds = np.asarray(s.type)[at]
    on_axis = kinds == TYPES.index("line")
    position, axis = np.asarray(s.position, float)[at], np.asarray(s.axis, float)[at]
    lines = [[float(x) if line else None for x, line in zip(axis[:, k], on_axis, strict=True)] for k in range(3)]
    return {
        "object": objects,
        "role": [roles[o] for o in objects],
        "type": [TYPES[k] for k in kinds],
        "begin": begin.tolist(),
        "end": end.tolist(),
        "begin_s": (begin / rate).tolist(),
        "end_s": (end / rate).tolist(),
        "duration_s": ((end - begin) / rate).tolist(),
        **{c: position[:, k].tolist() for k, c in enumerate("xyz")},
        **{f"axis_{c}": lines[k] for k, c in enumerate("xyz")},
        "residual": np.asarray(s.residual, float)[at].tolist(),
        "pattern": np.asarray(s.pattern)[at].tolist(),
    }


def pattern_rows(
    found: Detection, roles: Mapping[str, str | None], templates: Mapping[str, str]
) -> Mapping[str, Sequence[Any]]:
    """Rows of `patterns`: the thresholds of each object and type, and the noise that was measured; roles: of the objects;
    templates: by object the clip and frames of the example that its pattern was learnt from."""
    index = {n.casefold(): i for i, n in enumerate(found.objects)}
    lanes = [index.get(p.object.casefold()) for p in found.patterns]
    noise, missing = np.asarray(found.noise, float), np.asarray(found.missing)
    given = [p.status != "automatic" for p in found.patterns]
    return {
        "pattern": list(range(len(found.patterns))),
        "object": [p.object for p in found.patterns],
        "role": [None if i is None else roles[found.objects[i]] for i in lanes],
        "type": [p.type for p in found.patterns],
        "status": [p.status for p in found.patterns],
        "unit": [p.unit for p in found.patterns],
        "sigma_max": [list(map(float, p.sigma_max)) for p in found.patterns],
        "eps_max": [list(map(float, p.eps_max)) for p in found.patterns],
        "frames": [list(map(int, p.frames)) for p in found.patterns],
        "noise_m": [None if i is None else float(noise[i, 0]) for i in lanes],
        "noise_rad": [None if i is None else float(noise[i, 1]) for i in lanes],
        "missing": [None if i is None else int(missing[i]) for i in lanes],
        "template": [templates.get(p.object) if g else None for p, g in zip(found.patterns, given, strict=True)],
    }
