"""The container under every .npz file here: named arrays and one JSON document, in a zip that cannot hurt its reader.

In: arrays and a plain record. Out: bytes that depend on nothing else (no clock), and back. A reader gets no pickles, no
member whose header claims more than it holds, no zip that unpacks to more than it should. `meta` is the JSON document,
stored as bytes; its `schema` says what the file is and in which version.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..errors import FileFormatError
from .files import read_bytes, write_atomically

MEMBERS, MEMBER_BYTES, TOTAL_BYTES = 64, 2 << 30, 4 << 30
# A member over RATIO_FROM bytes may be RATIO times smaller in the file; honest arrays that compress better are small.
RATIO, RATIO_FROM = 200, 16 << 20
_KINDS = "biufU"  # booleans, integers, floats, text: no objects, no records
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, KeyError, ValueError)


def write_npz(
    path: str | Path, schema: str, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray], compress: bool = False
) -> Path:
    """Write arrays and `meta` (with `schema` added) to `path`, whole or not at all; the same content gives the same bytes."""
    document = msgspec.json.encode({"schema": schema, **meta})
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, array in {"meta": np.frombuffer(document, np.uint8), **arrays}.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = archive.compression, 0o644 << 16
            archive.writestr(entry, member.getvalue())
    return write_atomically(path, out.getvalue())


def read_npz(path: str | Path, schema: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The document and the arrays of a file written by `write_npz` with the same `schema`.

    Raises `FileFormatError`: no zip, pickles, too large or too many members, another schema or another version of it.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            arrays = {name: _member(archive, entry, path) for name, entry in _entries(archive, path).items()}
    except FileFormatError:
        raise
    except _ZIP_ERRORS as e:
        raise FileFormatError(f"this is no readable .npz file: {e}", path=path, remedy="get a complete copy") from e
    document = arrays.pop("meta", None)
    if document is None or document.dtype != np.uint8:
        found = f"an .npz file with the arrays {', '.join(arrays) or 'none'}, but without a description"
        raise FileFormatError(found, path=path, remedy=f"it was not written by kinjax as {schema.partition('/')[0]}")
    try:
        meta = msgspec.json.decode(document.tobytes(), type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as e:
        raise FileFormatError(f"its description is not JSON: {e}", path=path, remedy="get a complete copy") from e
    check_schema(meta.get("schema"), schema, path)
    return meta, arrays


def check_schema(found: object, wanted: str, path: object) -> None:
    """`FileFormatError` unless `found` is the schema `wanted`, a name and a version: "kinjax-motion/1"."""
    if found == wanted:
        return
    if isinstance(found, str) and found.partition("/")[0] == wanted.partition("/")[0]:
        remedy = "update kinjax, or write the file again with this version"
        raise FileFormatError(f"the file is of version {found!r}; {wanted!r} is read here", path=path, remedy=remedy)
    shown = f"the file says it is {found!r}" if found is not None else "the file does not say what it is"
    raise FileFormatError(f"{shown}; {wanted!r} is read here", path=path, remedy="check that this is the file that you mean")


def _entries(archive: zipfile.ZipFile, path: object) -> dict[str, zipfile.ZipInfo]:
    """The members by array name, after looking at what they claim to unpack to."""
    entries = archive.infolist()
    out = {e.filename.removesuffix(".npy"): e for e in entries}
    total = sum(e.file_size for e in entries)
    bomb = "it was made to fill memory, or is no motion: do not trust it"
    if len(entries) > MEMBERS or len(out) != len(entries):
        found, remedy = f"a zip of {len(entries)} members, some perhaps twice", f"at most {MEMBERS} are read"
        raise FileFormatError(found, path=path, remedy=remedy)
    for e in entries:
        name, ratio = f"its member {e.filename!r}", e.file_size / max(e.compress_size, 1)
        if e.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or e.flag_bits & 1:
            raise FileFormatError(f"{name} is encrypted or packed in another way", path=path, remedy="store it plain")
        if e.file_size > MEMBER_BYTES or total > TOTAL_BYTES:
            raise FileFormatError(f"{name} claims {e.file_size >> 20} MiB, all {total >> 20} MiB", path=path, remedy=bomb)
        if e.file_size > RATIO_FROM and ratio > RATIO:
            raise FileFormatError(f"{name} unpacks to {ratio:.0f} times its size", path=path, remedy=bomb)
    return out


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: object) -> np.ndarray:
    """One array: its header is compared with the bytes that are there before anything is made of its shape."""
    data = archive.read(entry)
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of the array format")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError, UnicodeDecodeError) as e:
        raise FileFormatError(f"its member {entry.filename!r} is no array: {e}", path=path, remedy="get a complete copy") from e
    if dtype.hasobject or dtype.kind not in _KINDS:
        found = f"its member {entry.filename!r} holds Python objects ({dtype})"
        raise FileFormatError(found, path=path, remedy="only numbers and text are read: a pickle could run any program")
    count = math.prod(shape)
    if any(n < 0 for n in shape) or count * dtype.itemsize != len(data) - stream.tell():
        found = f"its member {entry.filename!r} claims the shape {shape} of {dtype}, but has {len(data) - stream.tell()} bytes"
        raise FileFormatError(found, path=path, remedy="get a complete copy")
    return np.frombuffer(bytearray(data), dtype, count, stream.tell()).reshape(shape, order="F" if fortran else "C")
