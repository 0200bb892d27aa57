"""What the sections of an ASF file are made of: bones, and lines of a keyword and its values.

In: the words of a line. Out: values, checked; every complaint is a `FileFormatError` with line, column and remedy.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NoReturn

from .asf_text import Word, number
from .bvh_header import fail, shown

ROTATIONS, TRANSLATIONS = ("rx", "ry", "rz"), ("tx", "ty", "tz")
CUT = "the file is cut short, or this is no ASF file: get a complete copy"


@dataclass
class Bone:
    """A bone, or the root: `at` is the byte of its name. `axis`: angles about x, y, z of the file's angle unit; `order`: the
    axes in the order in which they are turned about, small letters. `mass`, `center`: None where the file has none."""

    name: bytes
    at: int
    direction: tuple[float, float, float] = (0.0, 0.0, 0.0)
    length: float = 0.0
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)
    order: str = "xyz"
    dof: tuple[str, ...] = ()
    limits: bool = False
    mass: float | None = None
    center: float | None = None


@dataclass
class Sections:
    """`length`: the number behind `length` in `:units`; `bones[0]` is the root, whose axis is its orientation and whose
    direction is its position; `links`: parent and child of each link as the words of the file."""

    text: bytes
    path: object
    length: float = 1.0
    degrees: bool = True
    bones: list[Bone] = field(default_factory=list)
    links: list[tuple[Word, Word]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def fail(self, at: int, found: str, remedy: str) -> NoReturn:
        """Raise `FileFormatError` about byte `at`."""
        fail(self.text, at, self.path, found, remedy)


def values(out: Sections, words: list[Word], count: int) -> list[Word]:
    """The words behind a keyword, which must be `count`."""
    if len(words) != count + 1:
        at = words[count + 1].start() if len(words) > count + 1 else words[-1].end()
        found = f"{shown(words[0].group())} has {len(words) - 1} values here"
        out.fail(at, found, f"it has {count} (a comma is a blank, decimals need a point); or the file is cut short")
    return words[1:]


def three(out: Sections, words: list[Word], what: str) -> tuple[float, float, float]:
    """Three numbers."""
    x, y, z = (number(out.text, w, what, out.path) for w in words)
    return x, y, z


def axes_order(out: Sections, word: Word) -> str:
    """The axes in the order of a word like XYZ, small letters."""
    order = word.group().lower().decode("latin-1")
    if sorted(order) != ["x", "y", "z"]:
        out.fail(
            word.start(), f"found {shown(word.group())} as an order of axes", "write XYZ, or another order of them"
        )
    return order


def degrees_of_freedom(out: Sections, words: list[Word]) -> tuple[str, ...]:
    """Degrees of freedom, small letters, in the order of the file."""
    dof: list[str] = []
    for word in words:
        name = word.group().lower().decode("latin-1")
        if name == "l":
            found = "this bone changes its length (l among its degrees of freedom), and bones here are rigid"
            remedy = "export without the stretch; or delete l here, and its number in each frame of the AMC"
            out.fail(word.start(), found, remedy)
        if name not in ROTATIONS + TRANSLATIONS:
            out.fail(word.start(), f"found {shown(word.group())} as a degree of freedom", "they are tx ty tz rx ry rz")
        if name in dof:
            out.fail(word.start(), f"the degree of freedom {name} stands twice", "keep one of them")
        dof.append(name)
    return tuple(dof)


def keyword(out: Sections, words: list[Word], seen: dict[str, Word], known: tuple[str, ...], where: str) -> str:
    """The keyword of a line, known and not seen before in this place."""
    key = words[0].group().lower().decode("latin-1")
    if key not in known:
        found = f"found {shown(words[0].group())} in {where}"
        out.fail(words[0].start(), found, f"its keywords are {', '.join(known)}")
    if key in seen:
        out.fail(words[0].start(), f"a second {key!r} in {where}", "keep one of them")
    seen[key] = words[0]
    return key


def complete(out: Sections, head: int, seen: dict[str, Word], needed: tuple[str, ...], where: str) -> None:
    """Refuse a section or bone that begins at byte `head` and lacks a keyword."""
    if missing := [k for k in needed if k not in seen]:
        out.fail(head, f"{where} has no {' and no '.join(map(repr, missing))}", CUT)
