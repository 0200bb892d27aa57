"""The frames of an AMC file as one array of numbers, quickly: names are blanked out, and what is left is parsed at once.

In: the bytes of the file and the nodes of a skeleton. Out: `Frames`: float64 (frames, numbers), and where each node's
numbers stand. The quick path takes files whose frames all look like the first, each bone on a line of its own, as all
programs write them; everything else, and every complaint, is left to `asf_lines`, which looks at one line after the other.
Nothing is allocated from a number in the file: the first frame's number may be 10^9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .asf import Node
from .asf_lines import read_lines
from .asf_text import LARGEST, MOST_WORDS, Word, lines_of, number, plain_text
from .bvh_header import fail, shown
from .bvh_numbers import _parse as parse_column

_PIECE = 1 << 17  # bytes at a time: the masks of a piece stay in the cache
_BLOCK = 512  # frames at a time, for the same reason
_EXACT = 15  # digits of a frame number that float64 tells apart
_CUT = "the file is cut short: get a complete copy"


@dataclass
class Header:
    """What stands before the first frame, at `data_at`. `degrees`: None where the file does not say. `rate`: frames a second,
    `frames`: how many it announces, with the byte where it does; None as in most files."""

    data_at: int = 0
    degrees: bool | None = None
    rate: float | None = None
    frames: tuple[int, int] | None = None
    notes: list[str] = field(default_factory=list)


@dataclass
class Frames:
    """values: (frames, numbers). columns: for each node the column of its first number. first: the number of frame 0."""

    values: np.ndarray
    columns: list[int]
    first: int
    header: Header
    notes: list[str]


def read_frames(raw: bytes, nodes: Sequence[Node], path: object, skeleton: str) -> Frames:
    """The frames of an AMC file. `FileFormatError` with line, column and remedy; `skeleton`: the ASF's name for messages."""
    text, notes = plain_text(raw, path, "an AMC file")
    header = _header(text, path)
    found = _quick(text, header.data_at, nodes)
    values, columns, first = found or read_lines(text, header.data_at, nodes, path, skeleton)
    if first != 1:
        notes.append(f"the first frame has the number {first}")
    if header.frames is not None and header.frames[0] != len(values):
        says = f":FRAME-RANGE says {header.frames[0]} frames, but {len(values)} follow"
        if len(values) < header.frames[0]:
            fail(text, header.frames[1], path, says, "the file is cut short: get a complete copy, or correct the line")
        notes.append(f"{says}: all were read")
    notes += _last_number(text, header.data_at, path)
    return Frames(values, columns, first, header, notes)


def _header(text: bytes, path: object) -> Header:
    header = Header()
    fully = False
    for words in lines_of(text, most=MOST_WORDS):
        key, at = words[0].group().upper(), words[0].start()
        if key.isdigit() and len(words) == 1:
            header.data_at = at
            if not fully:
                header.notes.append("the file does not say :FULLY-SPECIFIED")
            return header
        if not key.startswith(b":"):
            remedy = "an AMC file has words with a colon, then each frame's number on a line of its own; check that this is one"
            fail(text, at, path, f"found {shown(words[0].group())} where the first frame's number should stand", remedy)
        if key == b":FULLY-SPECIFIED":
            fully = True
        elif key in (b":DEGREES", b":RADIANS"):
            if header.degrees is (key == b":RADIANS"):
                fail(text, at, path, "the file says both :DEGREES and :RADIANS", "keep the right one")
            header.degrees = key == b":DEGREES"
        elif key == b":SAMPLES-PER-SECOND":
            header.rate = _header_numbers(text, words, 1, path)[0]
            if not 1 <= header.rate <= 1000:
                fail(text, words[1].start(), path, f"a rate of {header.rate:g} frames a second", "1 to 1000 are read")
        elif key == b":FRAME-RANGE":
            begin, end = _header_numbers(text, words, 2, path)
            header.frames = math.floor(end) - math.floor(begin) + 1, at
        else:
            header.notes.append(f"the line {shown(words[0].group())} is not used")
    fail(text, len(text), path, "the file has no frame", _CUT)


def _header_numbers(text: bytes, words: list[Word], count: int, path: object) -> list[float]:
    if len(words) != count + 1:
        found = f"{shown(words[0].group())} has {len(words) - 1} values"
        fail(text, words[-1].end(), path, found, f"it has {count}")
    return [number(text, word, f"a value of {words[0].group().decode('latin-1')}", path) for word in words[1:]]


def _quick(text: bytes, begin: int, nodes: Sequence[Node]) -> tuple[np.ndarray, list[int], int] | None:
    """Values without the frame numbers, columns and the first frame's number; None when anything is not as usual."""
    layout = _first_frame(text, begin, nodes)
    if layout is None:
        return None
    first, bones = layout  # of each line after the frame number: node, and how many numbers
    block = np.frombuffer(text[begin:] + b"\n", np.uint8).copy()
    words, rows = _words(block)
    pattern = np.array([1, *(n + 1 for _, n in bones)])
    if len(rows) % len(pattern) or not (rows.reshape(-1, len(pattern)) == pattern).all():
        return None
    words = words.reshape(-1, int(pattern.sum()))
    if not _blank_names(block, words, [(nodes[node].key, count) for node, count in bones]):
        return None
    values = parse_column(block.tobytes())
    if values is None or len(values) != len(words) * (1 + sum(count for _, count in bones)):
        return None
    values = values.reshape(len(words), -1)
    numbers = first + np.arange(len(values), dtype=np.float64)
    if not (values[:, 0] == numbers).all() or not (np.abs(values[:, 1:]) <= LARGEST).all():
        return None
    digits = np.searchsorted(10.0 ** np.arange(1, _EXACT + 2), numbers, side="right") + 1
    if not _blank(block[words[:, 0] + digits]).all():  # "1.0", or another way to write a whole number
        return None
    columns = [0] * len(nodes)
    at = 0
    for node, count in bones:
        columns[node] = at
        at += count
    return values[:, 1:], columns, first


def _blank_names(block: np.ndarray, words: np.ndarray, bones: list[tuple[bytes, int]]) -> bool:
    """Whether each frame's lines begin with these names, which become line ends. words: (frames, words of a frame), places;
    bones: the name of each line after the frame's number, and how many numbers follow it."""
    places = [np.lib.stride_tricks.sliding_window_view(block, len(key) + 1, writeable=True) for key, _ in bones]
    for f in range(0, len(words), _BLOCK):
        at = 1
        for (key, count), place in zip(bones, places, strict=True):
            here = words[f : f + _BLOCK, at]
            names = place[here]
            if not ((names[:, :-1] == np.frombuffer(key, np.uint8)).all() and _blank(names[:, -1]).all()):
                return False
            place[here] = 10
            at += count + 1
    return True


def _first_frame(text: bytes, begin: int, nodes: Sequence[Node]) -> tuple[int, list[tuple[int, int]]] | None:
    """The first frame's number, and of each of its lines the node and how many numbers; None if it is not as it should be."""
    of = {node.key: j for j, node in enumerate(nodes)}
    lines = lines_of(text, begin, MOST_WORDS)
    word = next(lines)[0].group()
    if len(word) > _EXACT:
        return None
    bones: list[tuple[int, int]] = []
    for words in lines:
        if words[0].group().isdigit() and len(words) == 1:
            break
        j = of.pop(words[0].group(), -1)
        if j < 0 or len(words) != len(nodes[j].dof) + 1:
            return None
        bones.append((j, len(words) - 1))
    if any(nodes[j].dof for j in of.values()):
        return None
    return int(word), bones


def _blank(characters: np.ndarray) -> np.ndarray:
    return (characters == 32) | ((characters - np.uint8(9)) <= 4)


def _words(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each word begins, and how many words stand on each line that has any."""
    begins, ends, total, before = [], [], 0, False
    for at in range(0, len(block), _PIECE):
        piece = block[at : at + _PIECE]
        solid = ~_blank(piece)
        begin = np.empty(len(piece), bool)
        begin[0] = solid[0] and not before
        np.greater(solid[1:], solid[:-1], out=begin[1:])
        words = np.flatnonzero(begin)
        ends.append(total + np.searchsorted(words, np.flatnonzero(piece == 10)))
        begins.append(words + at)
        before, total = bool(solid[-1]), total + len(words)
    rows = np.diff(np.concatenate([*ends, [total]]), prepend=0)
    return np.concatenate(begins), rows[rows > 0]


def _last_number(text: bytes, begin: int, path: object) -> list[str]:
    """Is the last number whole? With nothing after it, it may be cut short, and still be a number.

    Where all other numbers of the last lines have the same number of digits after the point, that tells; else a note does.
    """
    if text[-1:].isspace():
        return []
    *others, last = (w for w in text[max(begin, len(text) - 4096) :].split()[1:] if b"." in w or w[-1:].isdigit())
    digits = {len(w.partition(b".")[2]) if b"." in w else -1 for w in others if not w.isdigit()}
    if len(others) > 8 and len(digits) == 1 and digits != {-1}:
        if (len(last.partition(b".")[2]) if b"." in last else -1) not in digits:
            found = f"the last number, {shown(last)}, has not as many digits as all others"
            fail(text, len(text) - len(last), path, found, _CUT)
        return []
    return ["no line end after the last number: if the file was cut there, that number has lost digits"]
