"""What goes wrong with a person's input, as one family of exceptions.

Every error that a user can cause derives from `KinjaxError`, is raised before any `jit`, and says where (file, line,
joint), what was found, and what to do. The command line turns each into one message and exit code 2. Bad *data* (a lost
marker, a frame of NaN) is no error: it becomes a mask and a count.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence


class KinjaxError(ValueError):
    """Base of all errors that a user's input can cause."""


class FileFormatError(KinjaxError):
    """A file that cannot be read as what it claims to be: says file, line, column, what was found and the remedy."""

    def __init__(
        self, found: str, *, path: object = None, line: int | None = None, column: int | None = None, remedy: str = ""
    ):
        self.path, self.line, self.column, self.found, self.remedy = path, line, column, found, remedy
        where = "" if path is None else str(path)
        if line is not None:
            where += f"{':' if where else 'line '}{line}"
            if column is not None:
                where += f":{column}"
        super().__init__(": ".join(s for s in (where, found) if s) + (f" ({remedy})" if remedy else ""))


class UnknownNameError(KinjaxError):
    """A joint or object name that is not there; lists the nearest names that are."""

    def __init__(self, name: str, known: Sequence[str], what: str = "object", where: str = ""):
        folded = {k.casefold(): k for k in known}
        near = [folded[m] for m in difflib.get_close_matches(name.casefold(), list(folded), n=5, cutoff=0.4)]
        if not near:
            near = [k for k in known if name.casefold() in k.casefold()][:5]
        hint = (
            f"nearest: {', '.join(near)}"
            if near
            else f"known: {', '.join(list(known)[:12])}" + (", ..." if len(known) > 12 else "")
        )
        super().__init__(f"{where + ': ' if where else ''}no {what} named {name!r} ({hint})")
        self.name, self.near = name, near


class TemplateError(KinjaxError):
    """A template constraint that cannot be used: outside the clip, reversed, overlapping another."""


class TemplateTooShort(TemplateError):
    """A template with fewer usable intervals than the least median of squares needs (three)."""


class OptionError(KinjaxError):
    """An option, or a combination of options, that makes no sense."""


class ShapeError(KinjaxError):
    """Arrays whose shapes do not fit together."""


def find_name(name: str, known: Sequence[str], what: str = "object", where: str = "") -> int:
    """Index of `name` in `known`: an exact match first, else a single match without regard to case.

    Raises `UnknownNameError` with the nearest names when there is none, or when the case-insensitive match is ambiguous.
    """
    if name in known:
        return list(known).index(name)
    hits = [i for i, k in enumerate(known) if k.casefold() == name.casefold()]
    if len(hits) == 1:
        return hits[0]
    raise UnknownNameError(name, known, what, where)
