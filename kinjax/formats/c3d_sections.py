"""The two descriptions inside a C3D file, taken apart: the header's fields and the parameter section.

In: the bytes of a file. Out: `Header` and `Parameters`, as the file states them; `c3d_layout` judges what they claim. Both
are read by their lengths before a value is taken, so that no claim costs memory. A damaged entry is left out and named; where
the chain of entries breaks, `Parameters.broken` says where. The three number formats (Intel, DEC, MIPS) end here. Source:
the user guide of the C3D format (www.c3d.org), sections on the header and on parameters.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import FileFormatError

BLOCK = 512
"""Bytes of a block: headers count in blocks, from 1."""
_MAGIC = 0x50
_PROCESSORS = {84: "Intel", 85: "DEC", 86: "MIPS"}
_COPY = "get a complete copy, or export the recording again"


@dataclass(frozen=True)
class Header:
    """What the first block says. analog: analog values in a frame, all samples. start: block of the data. scale: negative
    where the data are floats. parameters: block of the parameter section. processor: "Intel", "DEC" or "MIPS"."""

    processor: str
    parameters: int
    points: int
    analog: int
    first: int
    last: int
    scale: float
    start: int
    samples: int
    rate: float


@dataclass(frozen=True)
class Parameters:
    """values: by (GROUP, NAME), arrays of numbers (as stored) or tuples of stripped strings. damaged: entries that were left
    out. overwritten: the entry, sound in itself, into which the data begin, or "". broken: where no entry can be, or ""."""

    values: dict[tuple[str, str], Any] = field(default_factory=dict)
    damaged: tuple[str, ...] = ()
    overwritten: str = ""
    broken: str = ""

    def numbers(self, group: str, name: str) -> list[float]:
        """The numbers of a parameter; none where it is missing or is text."""
        value = self.values.get((group, name))
        return value.ravel().tolist() if isinstance(value, np.ndarray) else []

    def texts(self, group: str, name: str) -> tuple[str, ...]:
        """The strings of a parameter and of its continuations (LABELS, LABELS2, ...); none where it is missing or numbers."""
        out: tuple[str, ...] = ()
        for n in range(1, 256):
            value = self.values.get((group, name if n == 1 else f"{name}{n}"))
            if not isinstance(value, tuple):
                break
            out += value
        return out


def read_header(data: bytes, path: object = None) -> Header:
    """The header. `FileFormatError` for what is no C3D file, or ends before its descriptions do."""
    if len(data) < BLOCK:
        raise FileFormatError(f"the file has {len(data)} bytes: a C3D header alone has {BLOCK}", path=path, remedy=_COPY)
    if data[1] != _MAGIC or data[0] == 0:
        found = f"this is no C3D file: its first two bytes are {data[:2].hex(' ')}, not a block's number and {_MAGIC:x}"
        raise FileFormatError(found, path=path, remedy="check that it is the file that you mean")
    at = (data[0] - 1) * BLOCK
    if at + 4 > len(data):
        found = f"the parameters are said to begin at byte {at}, but the file has {len(data)} bytes"
        raise FileFormatError(found, path=path, remedy=_COPY)
    if (kind := data[at + 3]) not in _PROCESSORS:
        found = f"the processor type is {kind}, none of " + ", ".join(f"{k} ({n})" for k, n in _PROCESSORS.items())
        raise FileFormatError(found, path=path, remedy=_COPY)
    processor = _PROCESSORS[kind]
    order = ">" if processor == "MIPS" else "<"
    points, analog, first, last, _gap = struct.unpack_from(order + "5H", data, 2)
    start, samples = struct.unpack_from(order + "2H", data, 16)
    scale, rate = (float(floats(data[i : i + 4], processor)[0]) for i in (12, 20))
    return Header(processor, data[0], points, analog, first, last, scale, start, samples, rate)


def floats(data: bytes | np.ndarray, processor: str) -> np.ndarray:
    """float64 from stored 32-bit floats (bytes, or an array of them whose last axis is a multiple of four bytes)."""
    raw = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else np.ascontiguousarray(data)
    with np.errstate(all="ignore"):
        if processor != "DEC":
            return raw.view(">f4" if processor == "MIPS" else "<f4").astype(np.float64)
        words = raw.view("<u2").astype(np.uint32)  # the half with sign and exponent comes first
        bits = (words[..., 0::2] << 16) | words[..., 1::2]
        value = bits.view(np.float32).astype(np.float64) / 4  # another bias, and the mantissa begins with .1, not 1.
        return np.where((bits >> 23) & 0xFF == 0, 0.0, value)


def read_parameters(data: bytes, header: Header) -> Parameters:
    """The parameter section, as far as it can be read; it ends before the data, whatever length it claims."""
    at = (header.parameters - 1) * BLOCK
    end = len(data)
    if data[at + 2]:
        end = min(end, at + data[at + 2] * BLOCK)
    if (start := (header.start - 1) * BLOCK) > at:
        end = min(end, start)
    order = ">" if header.processor == "MIPS" else "<"
    groups: dict[int, str] = {}
    entries: list[tuple[int, str, Any]] = []
    overwritten = broken = ""
    i = at + 4
    while i + 2 <= end:
        length, group = struct.unpack_from("bb", data, i)
        if length == 0:
            break
        after = i + 2 + abs(length)
        name = data[i + 2 : after].decode("ascii", "replace").strip().upper()
        if group == 0 or after + 2 > end or not name.isprintable() or not name.isascii():
            broken = f"byte {i}"
            break
        (offset,) = struct.unpack_from(order + "H", data, after)
        following = after + offset if offset else end
        if following > end or offset == 1:
            sound = group > 0 and _length(data[after + 2 :][:260]) == offset - 2
            overwritten, broken = (f"{name} at byte {i}", "") if sound else ("", f"{name} at byte {i}")
            break
        if group < 0:
            groups.setdefault(-group, name)
        else:
            entries.append((group, name, _value(data[after + 2 : following], header.processor)))
        if not offset:
            break
        i = following
    values: dict[tuple[str, str], Any] = {}
    damaged = []
    for group, name, value in entries:
        if value is None:
            damaged.append(f"{groups.get(group, group)}:{name}")
        else:
            values.setdefault((groups.get(group, str(group)), name), value)
    return Parameters(values, tuple(damaged), overwritten, broken)


def _length(data: bytes) -> int:
    """Bytes that an entry's type, dimensions and values take, with a byte for a description of none; -1 if they cannot."""
    if len(data) < 2 or len(data) < 2 + data[1]:
        return -1
    size = 1 if data[0] in (255, 1) else data[0] if data[0] in (2, 4) else -1
    for d in data[2 : 2 + data[1]]:
        size *= d
    return 3 + data[1] + size if size >= 0 else -1


def _value(data: bytes, processor: str) -> np.ndarray | tuple[str, ...] | None:
    """The value of an entry from the bytes after its offset; None where they do not hold what type and dimensions say."""
    if len(data) < 2:
        return None
    (kind,) = struct.unpack_from("b", data)
    dimensions = tuple(data[2 : 2 + data[1]])
    size = abs(kind)
    for d in dimensions:
        size *= d
    begin = 2 + data[1]
    if kind not in (-1, 1, 2, 4) or len(dimensions) < data[1] or begin + size > len(data):
        return None
    stored = data[begin : begin + size]
    if kind == -1:
        width = dimensions[0] if dimensions else 1
        return tuple(_text(stored[i : i + width]) for i in range(0, size, width)) if size else ()
    if kind == 4:
        return floats(stored, processor)
    order = ">" if processor == "MIPS" else "<"
    return np.frombuffer(stored, np.int8 if kind == 1 else order + "i2").astype(np.int64)


def _text(stored: bytes) -> str:
    """A string of the file without its padding; what cannot be printed becomes a question mark."""
    try:
        text = stored.decode("utf-8")
    except UnicodeDecodeError:
        text = stored.decode("latin-1")
    return "".join(c if c.isprintable() else "?" for c in text.rstrip("\0 ").replace("\0", " ")).strip()
