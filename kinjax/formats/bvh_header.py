"""The header of a BVH file: the hierarchy, the number of frames and the frame time, with a place for every complaint.

In: the bytes of a file, line ends already `\\n`. Out: a `Header` with the joints in file order and the offset at which the
numbers begin. A hand parser without recursion: it looks at words and braces, not at lines, so indentation, blank lines,
comments (`#` or `//` up to the end of the line) and braces on the same line make no difference; only names take the
rest of their line, spaces included. Keywords may be in any case.
"""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NoReturn

from ..errors import FileFormatError

MAX_DEPTH = 256
POSITIONS = {f"{x.lower()}position": f"{x}position" for x in "XYZ"}
ROTATIONS = {f"{x.lower()}rotation": f"{x}rotation" for x in "XYZ"}
CHANNELS = POSITIONS | ROTATIONS
NUMBER = rb"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"

_NUMBER = re.compile(NUMBER)
_SKIP = re.compile(rb"(?:\s++|(?:#|//)[^\n]*+)*+")
_WORD = re.compile(rb"[{}]|[^\s{}]+")
_NAME = re.compile(rb"[ \t\v\f]*([^\n{]*)")
_FRAME_TIME = re.compile(rb"frame[ \t]*time[ \t]*:?", re.IGNORECASE)
_FRAMES = re.compile(rb"frames?[ \t]*:?", re.IGNORECASE)


@dataclass
class Node:
    """A joint, or an End Site (`index` -1): `index`, `parent` among the joints, -1 for none; `offset` in file units."""

    name: bytes
    index: int
    parent: int
    offset: tuple[float, float, float] | None = None
    channels: tuple[str, ...] | None = None


@dataclass
class Header:
    """What stands before the numbers. `frames_at`: offset of the declared count; `data_at`: where the numbers begin."""

    joints: list[Node] = field(default_factory=list)
    ends: list[Node] = field(default_factory=list)
    frames: int = -1
    frames_at: int = 0
    frame_time: float = math.nan
    data_at: int = 0
    notes: list[str] = field(default_factory=list)


_RECENT: deque[tuple[bytes, Header]] = deque(maxlen=16)


def fail(raw: bytes, at: int, path: object, found: str, remedy: str) -> NoReturn:
    """Raise `FileFormatError` with the line and column (both from 1) of byte `at`."""
    begin = raw.rfind(b"\n", 0, at) + 1
    line, column = raw.count(b"\n", 0, at) + 1, len(raw[begin:at].decode("utf-8", "replace")) + 1
    raise FileFormatError(found, path=path, line=line, column=column, remedy=remedy)


def shown(word: bytes) -> str:
    """A piece of the file for a message: printable, at most 40 characters."""
    text = word[:80].decode("utf-8", "replace")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return repr(text if len(text) <= 40 else text[:37] + "...")


class _Parser:
    def __init__(self, raw: bytes, path: object):
        self.raw, self.path, self.at, self.begin = raw, path, 0, 0
        self.header = Header()

    def fail(self, found: str, remedy: str, at: int | None = None) -> NoReturn:
        """Complain about the word read last, or about byte `at`."""
        fail(self.raw, self.begin if at is None else at, self.path, found, remedy)

    def word(self) -> bytes:
        """The next word or brace, `b""` at the end; `self.begin` is where it begins."""
        self.begin = _SKIP.match(self.raw, self.at).end()  # type: ignore[union-attr]
        match = _WORD.match(self.raw, self.begin)
        self.at = match.end() if match else self.begin
        return match.group() if match else b""

    def number(self, what: str) -> float:
        word = self.word()
        value = float(word) if len(word) < 400 and _NUMBER.fullmatch(word) else math.nan
        if not math.isfinite(value):
            if not word:
                self.fail(f"the file ends where {what} should stand", "the file is cut short: get a complete copy")
            comma = "; decimals need a point, not a comma" if b"," in word else ""
            self.fail(f"found {shown(word)} where {what} should stand", f"write a plain finite number{comma}")
        return value

    def name(self, what: str) -> bytes:
        match = _NAME.match(self.raw, self.at)
        text = match.group(1).strip()  # type: ignore[union-attr]
        if b"}" in text or any(c < 32 and c != 9 for c in text):
            self.fail(f"the name of this {what} has a brace or a control character", "rename it")
        self.at = match.end()  # type: ignore[union-attr]
        return text.replace(b"\t", b" ")

    def open_brace(self, what: str) -> None:
        word = self.word()
        if word != b"{":
            found = shown(word) if word else "the end of the file"
            self.fail(f"found {found} where the {{ of {what} should open", "add it")

    def hierarchy(self) -> None:
        header = self.header
        stack: list[Node] = []
        if self.word().lower() != b"hierarchy":
            self.fail("a BVH file begins with the word HIERARCHY", "check that this is a BVH file")
        while True:
            key = (word := self.word()).lower()
            top = stack[-1] if stack else None
            in_joint = top is not None and top.index >= 0
            if key in (b"root", b"joint", b"end"):
                self.node(key, stack, in_joint)
            elif key == b"offset" and top is not None:
                if top.offset is not None:
                    self.fail("a second OFFSET for one joint", "keep one of them")
                x, y, z = (self.number("a number of OFFSET") for _ in range(3))
                top.offset = (x, y, z)
            elif key == b"channels" and in_joint:
                self.channels(stack[-1])
            elif key == b"}" and top is not None:
                if top.offset is None:
                    self.fail("a joint or End Site without OFFSET", "add its OFFSET")
                stack.pop()
            elif key == b"motion":
                if stack:
                    where = f"MOTION begins inside {shown(stack[-1].name)}"
                    self.fail(f"{where}: {len(stack)} closing brace(s) are missing", "add them")
                if not header.joints:
                    self.fail("MOTION begins before any ROOT", "the hierarchy is missing: get a complete copy")
                return
            elif not word:
                where = "inside the hierarchy" if stack else "before MOTION"
                remedy = "the file is cut short, or holds a skeleton without motion: get a complete copy"
                self.fail(f"the file ends {where}", remedy)
            else:
                self.unexpected(word, key)

    def unexpected(self, word: bytes, key: bytes) -> NoReturn:
        if key.decode("latin-1") in CHANNELS:
            self.fail(f"{shown(word)} is one channel more than CHANNELS says", "correct the number after CHANNELS")
        if _NUMBER.fullmatch(word):
            self.fail(f"found the number {shown(word)} where a keyword should stand", "OFFSET takes three numbers")
        remedy = "ROOT, JOINT, End Site, OFFSET, CHANNELS, braces and MOTION make a hierarchy"
        self.fail(f"found {shown(word)} here", remedy)

    def node(self, key: bytes, stack: list[Node], in_joint: bool) -> None:
        at, what = self.begin, key.decode().upper()
        if key == b"root" and stack:
            self.fail("ROOT inside a joint", "close the joint above with }, or write JOINT", at)
        if key != b"root" and not in_joint:
            self.fail(f"{what} outside a joint", "only ROOT stands at the top, and nothing stands inside an End Site", at)
        if len(stack) >= MAX_DEPTH:
            self.fail(f"joints are nested more than {MAX_DEPTH} deep", "no skeleton is: check the braces", at)
        name = self.name(what)
        if key == b"end" and name[:4].lower() == b"site":
            name = name[4:].strip()
        if key != b"end" and not name:
            self.fail(f"{what} without a name", "write the name on the same line", at)
        joints = self.header.joints
        node = Node(name, -1 if key == b"end" else len(joints), stack[-1].index if stack else -1)
        (self.header.ends if key == b"end" else joints).append(node)
        self.open_brace(shown(name) if name else "the End Site")
        stack.append(node)

    def channels(self, node: Node) -> None:
        if node.channels is not None:
            self.fail("a second CHANNELS for one joint", "keep one of them")
        count = self.word()
        if not re.fullmatch(rb"[0-6]", count):
            self.fail(f"found {shown(count)} as the number of channels", "a joint has 0 to 6")
        found: list[str] = []
        for _ in range(int(count)):
            name = CHANNELS.get((word := self.word()).lower().decode("latin-1"))
            if name is None:
                self.fail(
                    f"found {shown(word)} where channel {len(found) + 1} of {int(count)} should stand",
                    f"the channels are {', '.join(CHANNELS.values())}",
                )
            if name in found:
                self.fail(f"the channel {name} stands twice in one joint", "a joint has each channel at most once")
            found.append(name)
        node.channels = tuple(found)

    def motion(self) -> None:
        header = self.header
        while header.frames < 0 or math.isnan(header.frame_time):
            self.at = _SKIP.match(self.raw, self.at).end()  # type: ignore[union-attr]
            if match := _FRAME_TIME.match(self.raw, self.at):
                self.at = match.end()
                header.frame_time = self.frame_time()
            elif match := _FRAMES.match(self.raw, self.at):
                self.at = match.end()
                word, header.frames_at = self.word(), self.begin
                if not re.fullmatch(rb"[0-9]{1,18}", word) or int(word) == 0:
                    self.fail(f"found {shown(word)} as the number of frames", "write a whole number, 1 or more")
                header.frames = int(word)
            else:
                missing = "Frames:" if header.frames < 0 else "Frame Time:"
                word = self.word()
                here = "the file ends" if not word else f"found {shown(word)}"
                self.fail(f"{here} where {missing!r} should stand", "after MOTION come 'Frames:' and 'Frame Time:'")
        header.data_at = self.at

    def frame_time(self) -> float:
        value = self.number("the frame time in seconds")
        if not value > 0 or not 1.0 <= 1.0 / value <= 1000.0:
            hint = f"; {value:g} looks like milliseconds, write {value / 1000:g}" if 1 < value <= 1000 else ""
            self.fail(f"a frame time of {value:g} s", f"1 to 1000 frames a second are read: 0.001 to 1 s{hint}")
        return value


def parse_header(raw: bytes, path: object = None) -> Header:
    """The header of a BVH file. `FileFormatError` with line, column and remedy where it is none.

    A hierarchy that stood in one of the last files, word for word, is not parsed again: its nodes are shared.
    """
    parser = _Parser(raw, path)
    for text, before in _RECENT:
        if raw.startswith(text):
            parser.header = Header(before.joints, before.ends, notes=list(before.notes))
            parser.at = len(text)
            break
    else:
        parser.hierarchy()
        text = raw[: parser.at + 1]
        if text[-1:].isspace():  # else the word may go on in another file
            _RECENT.appendleft((text, replace(parser.header, notes=list(parser.header.notes))))
    parser.motion()
    return parser.header
