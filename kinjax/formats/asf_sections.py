"""The sections of an ASF file as they stand in it: units, root, bones, hierarchy.

In: the bytes of a file. Out: `Sections`, in file units and degrees or radians as the file has them; `asf` makes a skeleton of
them. A keyword that begins with a colon opens a section; inside one, each line is a keyword and its values. Commas and
parentheses count as blanks (Acclaim Skeleton File definition 1.10). A `FileFormatError` says what is wrong, and where.
"""

from __future__ import annotations

import re

from .asf_keywords import CUT, Bone, Sections, axes_order, complete, degrees_of_freedom, keyword, three, values
from .asf_text import Word, is_number, lines_of, number, plain_text
from .bvh_header import shown

_SECTIONS = (b":version", b":name", b":units", b":documentation", b":root", b":bonedata", b":hierarchy")
_NEEDED = (b":units", b":root", b":bonedata", b":hierarchy")
_INFINITE = re.compile(rb"[+-]?inf(inity)?")
_LONGEST_NAME = 256
_BLANKS = bytes.maketrans(b"(),", b"   ")


def read_sections(raw: bytes, path: object) -> Sections:
    """The sections of an ASF file. `FileFormatError` with line, column and remedy where it is none."""
    text, notes = plain_text(raw, path, "an ASF file")
    out = Sections(text.translate(_BLANKS), path, notes=notes)
    parts: dict[bytes, tuple[Word, list[list[Word]]]] = {}
    body: list[list[Word]] | None = None
    for words in lines_of(out.text):
        key = words[0].group().lower()
        if key.startswith(b":"):
            if key in parts:
                out.fail(words[0].start(), f"a second section {shown(key)}", "keep one of them")
            if key not in _SECTIONS:
                out.notes.append(f"the section {shown(key)} of the skeleton is not used")
            body = []
            parts[key] = words[0], body
        elif body is None:
            found = f"found {shown(words[0].group())} where a section should begin"
            out.fail(words[0].start(), found, "an ASF file begins with :version; check that this is one")
        else:
            body.append(words)
    for key in _NEEDED:
        if key not in parts:
            out.fail(len(out.text), f"there is no section {key.decode()}", CUT)
    if not out.text[-1:].isspace() and list(parts)[-1] in (b":units", b":root"):
        out.notes.append("no line end after the skeleton's last number: if the file was cut there, it has lost digits")
    _units(out, *parts[b":units"])
    _root(out, *parts[b":root"])
    _bonedata(out, *parts[b":bonedata"])
    _hierarchy(out, *parts[b":hierarchy"])
    return out


def _units(out: Sections, head: Word, body: list[list[Word]]) -> None:
    seen: dict[str, Word] = {}
    for words in body:
        key = keyword(out, words, seen, ("mass", "length", "angle"), ":units")
        value = values(out, words, 1)[0]
        if key == "angle":
            if value.group().lower() not in (b"deg", b"rad"):
                out.fail(value.start(), f"found {shown(value.group())} as the unit of angles", "write deg or rad")
            out.degrees = value.group().lower() == b"deg"
            continue
        size = number(out.text, value, f"the unit of {key}", out.path)
        if key == "length":
            if not 1e-6 <= size <= 1e6:
                out.fail(value.start(), f"a unit of length of {size:g}", "CMU's is 0.45, a plain inch is 1.0")
            out.length = size
    complete(out, head.start(), seen, ("length", "angle"), ":units")


def _root(out: Sections, head: Word, body: list[list[Word]]) -> None:
    seen: dict[str, Word] = {}
    root = Bone(b"root", head.start())
    for words in body:
        key = keyword(out, words, seen, ("order", "axis", "position", "orientation"), ":root")
        if key == "order":
            root.dof = degrees_of_freedom(out, words[1:])
        elif key == "axis":
            root.order = axes_order(out, values(out, words, 1)[0])
        elif key == "position":
            root.direction = three(out, values(out, words, 3), "a number of the root's position")
        else:
            root.axis = three(out, values(out, words, 3), "an angle of the root's orientation")
    complete(out, head.start(), seen, ("order", "axis", "position", "orientation"), ":root")
    if not root.dof:
        out.fail(seen["order"].start(), "the root has no degree of freedom", "write order TX TY TZ RX RY RZ")
    out.bones.append(root)


_KEYS = ("id", "name", "direction", "length", "axis", "dof", "limits", "bodymass", "cofmass")


def _bonedata(out: Sections, head: Word, body: list[list[Word]]) -> None:
    at = 0
    while at < len(body):
        if len(body[at]) != 1 or body[at][0].group().lower() != b"begin":
            out.fail(
                body[at][0].start(), f"found {shown(body[at][0].group())} where a bone should begin", "write begin"
            )
        end = next((n for n in range(at + 1, len(body)) if body[n][0].group().lower() == b"end"), None)
        if end is None:
            out.fail(body[at][0].start(), "a bone begins here and does not end", CUT)
        values(out, body[end], 0)
        out.bones.append(_bone(out, body[at][0], body[at + 1 : end]))
        at = end + 1


def _bone(out: Sections, begin: Word, body: list[list[Word]]) -> Bone:
    seen: dict[str, Word] = {}
    bone = Bone(b"", begin.start())
    key = ""
    for words in body:
        first = words[0].group().lower()
        if key == "limits" and (is_number(first) or _INFINITE.fullmatch(first)):
            continue  # more of the limits, a pair a line
        key = keyword(out, words, seen, _KEYS, "a bone")
        if key == "id":
            values(out, words, 1)
        elif key == "name":
            word = values(out, words, 1)[0]
            if is_number(word.group()) or word.group().startswith(b":"):
                out.fail(
                    word.start(), f"a bone is called {shown(word.group())}", "rename it: a frame would be taken for it"
                )
            if len(word.group()) > _LONGEST_NAME:
                out.fail(word.start(), f"a bone's name has {len(word.group())} bytes", f"{_LONGEST_NAME} are read")
            bone.name, bone.at = word.group(), word.start()
        elif key == "direction":
            bone.direction = three(out, values(out, words, 3), "a number of the direction")
        elif key == "axis":
            *angles, order = values(out, words, 4)
            bone.axis, bone.order = three(out, angles, "an angle of the axis"), axes_order(out, order)
        elif key == "dof":
            bone.dof = degrees_of_freedom(out, words[1:])
        elif key == "limits":
            bone.limits = True
        else:
            value = number(out.text, values(out, words, 1)[0], f"the bone's {key}", out.path)
            if value < 0:
                out.fail(words[1].start(), f"a {key} of {value:g}", "it cannot be negative")
            if key == "length":
                bone.length = value
            elif key == "bodymass":
                bone.mass = value
            else:
                bone.center = value
    complete(out, begin.start(), seen, ("name", "direction", "length", "axis"), "this bone")
    return bone


def _hierarchy(out: Sections, head: Word, body: list[list[Word]]) -> None:
    if not body or [w.group().lower() for w in body[0]] != [b"begin"]:
        at = body[0][0].start() if body else head.end()
        out.fail(at, "the hierarchy does not begin with 'begin'", CUT)
    end = next((n for n, words in enumerate(body) if [w.group().lower() for w in words] == [b"end"]), None)
    if end is None:
        out.fail(len(out.text), "the hierarchy has no 'end'", CUT)
    if end + 1 < len(body):
        out.fail(
            body[end + 1][0].start(), f"found {shown(body[end + 1][0].group())} after the hierarchy's end", "delete it"
        )
    for parent, *children in body[1:end]:
        if not children:
            out.fail(
                parent.end(),
                f"{shown(parent.group())} stands alone",
                "write its children behind it, or delete the line",
            )
        out.links += [(parent, child) for child in children]
