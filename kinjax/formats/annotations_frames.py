"""Annotations as labels of frames, in .npz: what a training loop reads without looking at intervals.

In: `Annotations`. Out: a file with the arrays

* `objects` (O,) names of the columns;
* `codes` (frames, O) uint8: the sum of 1 where a space constraint covers the frame, 2 a line, 4 a point; 0 is free;
* `types` (3,) and `bits` (3,): which type is which number;
* `fps` (): frames a second.

The whole record is there too, as JSON in `meta`, so reading gives back every position and pattern, not only the labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..annotations import TYPES, Annotations
from ..errors import FileFormatError, OptionError
from .annotations_json import SCHEMA, check, from_record, to_record
from .files import clean_text
from .npz_container import read_npz, write_npz

_ARRAYS = {"objects", "codes", "types", "bits", "fps"}


def frame_codes(annotations: Annotations, objects: Sequence[str]) -> np.ndarray:
    """Labels (frames, objects) uint8 as the module describes them; constraints of other objects are left out."""
    codes = np.zeros((annotations.frames, len(objects)), np.uint8)
    column = {name: n for n, name in enumerate(objects)}
    for c in annotations.constraints:
        if c.object in column:
            codes[c.begin : c.end + 1, column[c.object]] |= 1 << TYPES.index(c.type)
    return codes


def write(path: str | Path, annotations: Annotations, objects: Sequence[str] | None = None) -> Path:
    """Write the .npz file. `OptionError` if `objects` repeats a name or leaves out one that has a constraint."""
    check(annotations)
    found = list(dict.fromkeys(c.object for c in annotations.constraints))
    columns = found if objects is None else list(objects)
    if missing := [n for n in found if n not in set(columns)]:
        raise OptionError(f"{path}: objects= leaves out {', '.join(missing)}, which have constraints")
    if len(set(columns)) != len(columns):
        raise OptionError(f"{path}: objects= repeats a name")
    arrays = {
        "objects": np.array([clean_text(n) for n in columns], dtype=str),
        "codes": frame_codes(annotations, columns),
        "types": np.array(TYPES),
        "bits": np.array([1 << n for n in range(len(TYPES))], np.uint8),
        "fps": np.array(float(annotations.fps)),
    }
    record = to_record(annotations)
    return write_npz(path, SCHEMA, {k: v for k, v in record.items() if k != "schema"}, arrays, compress=True)


def read(path: str | Path) -> Annotations:
    """The annotations in the .npz file; `FileFormatError` if its labels are not theirs."""
    meta, arrays = read_npz(path, SCHEMA)
    annotations = from_record(meta, path)
    if set(arrays) != _ARRAYS:
        remedy = f"expected {', '.join(sorted(_ARRAYS))}"
        raise FileFormatError(f"the arrays are {', '.join(sorted(arrays))}", path=path, remedy=remedy)
    codes, names = arrays["codes"], [str(n) for n in arrays["objects"].ravel()]
    fits = codes.dtype == np.uint8 and codes.shape == (annotations.frames, len(names))
    if not fits or not np.array_equal(codes, frame_codes(annotations, names)):
        remedy = "the file was edited: write it again"
        raise FileFormatError("the labels of the frames are not those of the constraints", path=path, remedy=remedy)
    return annotations
