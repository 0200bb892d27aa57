"""The number block of a BVH file: parsed as one long column, and looked at slowly only when something is wrong.

In: the bytes from the end of the header on. Out: float64 (frames, channels), every number finite, their count what the
header says, each frame beginning on a line of its own (or several whole frames on one line); else a `FileFormatError`
that points at the first number or line that is wrong. One whole frame more than declared is read, with a note: some
exporters count the intervals. One frame less is a file cut short, and refused.

Fastest, for files with one frame a line and single spaces: pyarrow's CSV reader takes the lines as rows. Else white space
becomes line ends, and it parses one column in parallel blocks, skipping empty lines. It refuses what is no number, but lets
NaN and infinities through. Nothing is allocated from the declared size.

Where only some channels are wanted, the fastest way converts only these; of the others it is known that each line has one
word for each of them, made of digits and points, perhaps with a minus before (`1.2.3` is refused only where it is converted).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice

import numpy as np

from .bvh_header import NUMBER, Header, fail, shown

_TO_LINES = bytes.maketrans(b" \t\v\f\r", b"\n" * 5)
_COMMENT = re.compile(rb"(?:(?<=\s)|\A)(?:#|//)[^\n]*")
_GOOD = re.compile(rb"(?:\s*+" + NUMBER + rb"(?=\s|\Z))*+\s*+")  # possessive: one pass, nothing to go back to
_WORD = re.compile(rb"\S+")
_WIDE = 2048  # channels: more columns than that are slower than one
_PIECE = 1 << 17  # bytes at a time: the masks of a piece stay in the cache


def read_numbers(
    raw: bytes, header: Header, channels: int, path: object = None, wanted: Sequence[int] | None = None
) -> tuple[np.ndarray, list[str]]:
    """The numbers as (frames, channels), or (frames, wanted) where only some channels are; and notes on what was tolerated.
    `FileFormatError` as the module says."""
    at = header.data_at
    if raw.find(b"#", at) < 0 and raw.find(b"/", at) < 0:
        found = _parse_rows(raw, at, channels, wanted)
        if found is not None and found.shape[1] in (header.frames, header.frames + 1) and np.isfinite(found).all():
            more = [_one_more(header)] if found.shape[1] > header.frames else []
            return found.T, more + ([] if raw[-1:].isspace() else _last_number(raw, raw[at:], header, channels, path))
    block, notes = raw[at:], []
    if b"#" in block or b"/" in block:
        block, count = _COMMENT.subn(lambda m: b" " * len(m.group()), block)  # as long as before: places stay right
        notes += ["comments between the numbers were skipped"] if count else []
    if (len(block) + 1) // 2 < header.frames * channels:  # a number takes two bytes at least
        _wrong_count(raw, block, header, channels, path)
    values = _parse(block)
    if values is None:
        _bad_word(raw, block, header, path)
        values = np.array([float(x) for x in block.split()])  # good numbers that the fast path does not take
    if not (finite := np.isfinite(values)).all():
        _bad_word(raw, block, header, path)
        word = next(islice(_WORD.finditer(block), int(finite.argmin()), None))
        fail(raw, header.data_at + word.start(), path, f"the number {shown(word.group())} is too large", "correct it")
    lines, frames = _numbers_by_line(block), header.frames
    rows = lines[lines > 0]
    even = bool((rows == channels).all())
    if even and len(rows) == frames + 1 and len(values) == len(rows) * channels:
        frames += 1
        notes.append(_one_more(header))
    if len(values) != frames * channels:
        _wrong_count(raw, block, header, channels, path)
    if not even or len(rows) != frames:
        ends, whole = np.cumsum(rows), np.arange(1, frames + 1) * channels
        if (rows % channels).any() and not np.isin(whole, ends).all():
            _ragged(raw, block, header, channels, lines, path)
        notes.append(f"the {frames} frames stand on {len(rows)} lines")
    notes += _last_number(raw, block, header, channels, path)
    values = values.reshape(frames, channels)
    return values if wanted is None else values[:, list(wanted)], notes


def _one_more(header: Header) -> str:
    return f"'Frames:' says {header.frames}, but {header.frames + 1} follow: all were read"


def _parse_rows(raw: bytes, at: int, channels: int, wanted: Sequence[int] | None) -> np.ndarray | None:
    """(channels, frames), one row of memory a channel (or a wanted one), if every line is a frame with one space between
    numbers, as most files are written; else None, and the slower way finds out. A line with a number too few or too many is
    refused by the parser."""
    import pyarrow as pa
    from pyarrow import csv

    if channels > _WIDE or (wanted is not None and not wanted):
        return None
    names = [str(i) for i in range(channels)]
    first = raw[at : at + (1 << 16)].lstrip(b"\n").partition(b"\n")[0]
    behind = ["behind"] if first.endswith(b" ") else []  # a space after the last number: an empty column
    if wanted is not None and not _plain_words(raw, at, bool(behind)):
        return None
    taken = names if wanted is None else [names[i] for i in wanted]
    try:
        table = csv.read_csv(
            pa.py_buffer(memoryview(raw)[at:]),
            read_options=csv.ReadOptions(column_names=names + behind, block_size=max(1 << 18, 64 * channels)),
            parse_options=csv.ParseOptions(delimiter=" ", quote_char=False, ignore_empty_lines=True),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.float64()) | dict.fromkeys(behind, pa.string()),
                include_columns=[*taken, *behind],
                null_values=[],
                strings_can_be_null=False,
            ),
        )
    except pa.ArrowException:
        return None
    if behind and any(x != "" for x in table["behind"].unique().to_pylist()):
        return None
    out = np.empty((len(taken), table.num_rows))
    for row, column in zip(out, table.columns[: len(taken)], strict=True):
        begin = 0
        for chunk in column.chunks:
            row[begin : begin + len(chunk)] = chunk.to_numpy()
            begin += len(chunk)
    return out


def _plain_words(raw: bytes, at: int, behind: bool) -> bool:
    """Is the block made of digits, points, minus signs that begin a word, and single spaces or line ends between words (`behind`: and
    a space at the end of lines)? Then no word of it is empty, NaN, text or a number with a decimal comma."""
    if raw[-1:] == b" " and not behind:
        return False
    text = np.frombuffer(raw, np.uint8, offset=at)
    for begin in range(0, len(text), _PIECE):
        piece = text[begin : begin + _PIECE + 1]  # the first of the next one, too: pairs are looked at
        gap, end, minus = piece == 32, piece == 10, piece == 45
        blank = gap | end
        if ((piece - np.uint8(45)) > 12).tobytes() != blank.tobytes():  # others than - . and digits; the slash is not there
            return False
        if (blank[:-1] & gap[1:]).any() or (minus[1:] > blank[:-1]).any() or (not behind and (gap[:-1] & end[1:]).any()):
            return False
    return True


def _parse(block: bytes) -> np.ndarray | None:
    """All numbers of the block in order, or None when something in it is no number."""
    import pyarrow as pa
    from pyarrow import csv

    try:
        table = csv.read_csv(
            pa.py_buffer(block.translate(_TO_LINES)),
            read_options=csv.ReadOptions(column_names=["v"], block_size=1 << 18),
            parse_options=csv.ParseOptions(delimiter="\x01", quote_char=False, ignore_empty_lines=True),
            convert_options=csv.ConvertOptions(column_types={"v": pa.float64()}, null_values=[], strings_can_be_null=False),
        )
    except pa.ArrowException:
        return None
    return table["v"].to_numpy()


def _numbers_by_line(block: bytes) -> np.ndarray:
    """How many words stand on each line of the block."""
    text, before, counts, total = np.frombuffer(block, np.uint8), False, [], 0
    for at in range(0, len(text), _PIECE):
        piece = text[at : at + _PIECE]
        begins = np.empty(len(piece), bool)
        solid = (piece != 32) & ((piece - np.uint8(9)) > 4)
        begins[0] = solid[0] and not before
        np.greater(solid[1:], solid[:-1], out=begins[1:])
        words = np.flatnonzero(begins)
        counts.append(total + np.searchsorted(words, np.flatnonzero(piece == 10)))
        before, total = bool(solid[-1]), total + len(words)
    return np.diff(np.concatenate([*counts, [total]]), prepend=0)


def _bad_word(raw: bytes, block: bytes, header: Header, path: object) -> None:
    """Raise at the first word that is not written as a number; return when there is none."""
    word = _WORD.match(block, _GOOD.match(block).end())  # type: ignore[union-attr]
    if word is None:
        return
    text = word.group()
    if b"nan" in text.lower() or b"inf" in text.lower() or b"#" in text:
        remedy = "every number must be finite: fill the gap where the file comes from, or cut these frames"
    elif b"," in text:
        remedy = "decimals need a point, not a comma: export again with an English number format"
    elif re.match(NUMBER + rb"[+-]", text[:400]):  # not all of it: a word of a million digits is matched in as many ways
        remedy = "a space is missing between two numbers"
    elif b"\x00" in text:
        remedy = "the file is damaged or binary: get a complete copy"
    else:
        remedy = "only plain decimal numbers stand after the frame time"
    fail(raw, header.data_at + word.start(), path, f"found {shown(text)} where a number should stand", remedy)


def _wrong_count(raw: bytes, block: bytes, header: Header, channels: int, path: object) -> None:
    lines = _numbers_by_line(block)
    rows, total = lines[lines > 0], int(lines.sum())
    _bad_word(raw, block, header, path)
    if (rows % channels).any() and (len(rows) == 1 or (rows == channels).mean() > 0.5):
        _ragged(raw, block, header, channels, lines, path)
    whole = f", {total // channels} frames" if total % channels == 0 else f", {total / channels:.2f} frames"
    fail(
        raw, header.frames_at, path,
        f"'Frames:' says {header.frames}, with {channels} channels {header.frames * channels} numbers, but {total} follow{whole}",
        "the file is cut short or was edited: get a complete copy, or correct the number of frames",
    )  # fmt: skip


def _ragged(raw: bytes, block: bytes, header: Header, channels: int, lines: np.ndarray, path: object) -> None:
    """Raise at the first line whose numbers make no whole frame: at its first surplus number, or at its end."""
    line = int(np.flatnonzero(lines % channels)[0])
    begin = 0
    for _ in range(line):
        begin = block.index(b"\n", begin) + 1
    stop = block.find(b"\n", begin)
    words = list(_WORD.finditer(block, begin, stop if stop >= 0 else len(block)))
    at = words[channels].start() if len(words) > channels else words[-1].end()
    fail(
        raw, header.data_at + at, path, f"this line has {len(words)} numbers, a frame has {channels}",
        "begin each frame on a line of its own, with one number for each channel; or the file is cut short: get a complete copy",
    )  # fmt: skip


def _last_number(raw: bytes, block: bytes, header: Header, channels: int, path: object) -> list[str]:
    """Is the last number whole? With nothing after it, it may be cut short, and still be a number.

    Most files write all numbers with the same number of digits after the point; then the last one tells. Where it cannot
    be told, a note says so.
    """
    if block[-1:].isspace():
        return []
    first = _WORD.finditer(block, 0, min(len(block), 64 * channels))
    words = [m.group() for _, m in zip(range(channels), first, strict=False)]
    tail = block[-64 * channels :].split()[-channels:]
    digits = {len(w.partition(b".")[2]) if b"." in w else -1 for w in (words + tail)[: len(words) + len(tail) - 1]}
    last = tail[-1]
    if header.frames * channels > 1 and len(digits) == 1 and digits != {-1}:
        if (len(last.partition(b".")[2]) if b"." in last else -1) not in digits:
            found = f"the last number, {shown(last)}, has not as many digits as all others"
            fail(raw, header.data_at + len(block) - len(last), path, found, "the file is cut short: get a complete copy")
        return []
    return ["no line end after the last number: if the file was cut there, that number has lost digits"]
