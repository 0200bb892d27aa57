"""The text of Acclaim files, ASF and AMC: plain bytes, lines of words with their places, numbers.

In: the bytes of a file. Out: bytes with `\\n` as line end and comments blanked (`#` up to the end of the line), as long as
before up to the line ends, so that places stay right; its lines that have words, each word a regular expression's match,
which knows where it stands. Whatever is wrong is a `FileFormatError` with line, column and remedy.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice

from ..errors import FileFormatError
from .bvh_header import NUMBER, fail, shown

_LONGEST = 400  # bytes of a number; beyond it matching would take long
MOST_WORDS = 16  # that are looked at on a line of an AMC file: a name, six numbers, and what is too much
LARGEST = 1e9  # file units, degrees; above it a number is a fault, and squares of it would overflow in float32

Word = re.Match[bytes]
_NUMBER = re.compile(NUMBER)
_COMMENT = re.compile(rb"#[^\n]*")  # where a blank is in front of it
_LATER_COMMENT = re.compile(rb"(?<=\s)#.*")
_SOLID = re.compile(rb"[^\s\x00\x1a]")
_LINE = re.compile(rb"\S[^\n]*")
_WORD = re.compile(rb"\S+")


def plain_text(raw: bytes, path: object, what: str) -> tuple[bytes, list[str]]:
    """The text of a file with `\\n` as line end and comments blanked, and notes; refuses what is no text. `what`: "an ASF file"."""
    notes = []
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if not _SOLID.search(raw):
        raise FileFormatError("the file is empty", path=path, remedy="get a complete copy")
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff") or raw[:2].count(0) == 1:
        raise FileFormatError(
            "the file is UTF-16 text", path=path, line=1, column=1, remedy="save it as UTF-8 or ASCII"
        )
    if raw[-1] in b"\x00\x1a":
        text = raw.rstrip(b"\x00\x1a")
        notes.append(f"NUL or end-of-file characters after the text were dropped ({len(raw) - len(text)})")
        raw = text
    if b"\x00" in raw[:4096]:
        raise FileFormatError(
            "the file is binary, not text", path=path, line=1, column=1, remedy=f"check that this is {what}"
        )
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"#" in raw:
        raw = _COMMENT.sub(_blanks, raw)
    if not _SOLID.search(raw):
        raise FileFormatError("the file has only comments", path=path, remedy="get a complete copy")
    return raw, notes


def _blanks(comment: Word) -> bytes:
    """A comment as blanks; what only looks like one (`1.#QNAN`) as it is, up to a comment behind it."""
    begin, text = comment.start(), comment.group()
    if begin == 0 or comment.string[begin - 1 : begin].isspace():
        return b" " * len(text)
    return _LATER_COMMENT.sub(lambda m: b" " * len(m.group()), text)


def lines_of(text: bytes, begin: int = 0, most: int | None = None) -> Iterator[list[Word]]:
    """The words of each line that has any, from byte `begin` on; at most `most` of a line, which may have millions."""
    for line in _LINE.finditer(text, begin):
        yield list(islice(_WORD.finditer(text, *line.span()), most))


def is_number(word: bytes) -> bool:
    """Whether a word is written as a finite number."""
    return len(word) < _LONGEST and bool(_NUMBER.fullmatch(word))


def number(text: bytes, word: Word, what: str, path: object) -> float:
    """The number that a word is; `FileFormatError` says what stands there instead of `what`."""
    value = word.group()
    if len(value) < _LONGEST and _NUMBER.fullmatch(value):
        if abs(found := float(value)) <= LARGEST:
            return found
        fail(text, word.start(), path, f"{what} is {shown(value)}: too large", "correct it, or check the unit")
    lower = value.lower()
    remedy = "write a plain finite number"
    if b"," in value:
        remedy = "decimals need a point, not a comma: export again with an English number format"
    elif b"nan" in lower or b"inf" in lower or b"#" in value:
        remedy = "every number must be finite: fill the gap where the file comes from, or cut these frames"
    elif re.match(NUMBER + rb"[+-]", value[:_LONGEST]):
        remedy = "a space is missing between two numbers"
    fail(text, word.start(), path, f"found {shown(value)} where {what} should stand", remedy)


def decoded(names: list[bytes]) -> tuple[list[str], list[str]]:
    """Names as text, UTF-8 or else all of them Latin-1, and a note in that case."""
    try:
        return [n.decode("utf-8") for n in names], []
    except UnicodeDecodeError:
        return [n.decode("latin-1") for n in names], ["the names are not UTF-8: read as Latin-1"]
