"""Annotation of whole databases: folders of motion in, a store of Parquet tables out, and questions answered in SQL.

catalogue (which files, in what parts) -> work (one part: read, detect in batches, write aside) -> engines (where parts are
worked on) -> job (commit, retry, resume) -> store (the tables) -> query, overlaps. `configuration` holds what is asked for,
`schema` the tables' columns. Only this room and the command line know about processes and folders of results.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_ROOMS = {
    "configuration": ("Configuration", "TemplateRule", "read_configuration"),
    "job": ("Report", "annotate"),
    "overlaps": ("When", "overlapping"),
    "sql": ("query",),
    "store": ("Store",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
