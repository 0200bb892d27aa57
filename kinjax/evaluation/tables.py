"""Tables as they come in: columns of anything that has them, and clips by the names that people give them.

In: mappings of sequences, or tables with `column_names` (pyarrow) or `columns` (pandas). Out: lists of plain values, and indices.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..annotations import Annotations
from ..errors import OptionError, ShapeError


def columns(table: Any, needed: Sequence[str], wanted: Sequence[str] = (), what: str = "table") -> dict[str, list[Any]]:
    """The columns `needed`, and those of `wanted` that are there, as lists of one length.

    Raises `OptionError` where one is missing, `ShapeError` where they differ in length.
    """
    if hasattr(table, "column_names"):
        names = list(table.column_names)
    elif hasattr(table, "keys"):
        names = list(table.keys())
    else:
        raise OptionError(f"{what}: {type(table).__name__} is no table: give a mapping of columns")
    if missing := [n for n in needed if n not in names]:
        raise OptionError(f"{what}: no column {', '.join(missing)}; there are {', '.join(map(str, names)) or 'none'}")
    out = {n: _values(table[n]) for n in (*needed, *wanted) if n in names}
    lengths = {n: len(v) for n, v in out.items()}
    if len(set(lengths.values())) > 1:
        raise ShapeError(f"{what}: columns of different lengths: {', '.join(f'{n} {k}' for n, k in lengths.items())}")
    return out


def _values(column: Any) -> list[Any]:
    if hasattr(column, "to_pylist"):
        return column.to_pylist()
    return column.tolist() if hasattr(column, "tolist") else list(column)


def clip_indices(names: Iterable[str], ids: Sequence[str]) -> dict[str, int | None]:
    """Which clip each name means: the index of its id, or None where there is none.

    A name is an id ("walks/day1/a.bvh"), the end of one at a slash ("day1/a.bvh", "a.bvh"), or such an end without the file's
    suffix ("a"), in this order. `OptionError` lists the ids where a name means several.
    """
    index = {name: n for n, name in enumerate(ids)}
    if len(index) != len(ids):
        twice = next(n for n, name in enumerate(ids) if index[name] != n)
        raise OptionError(f"clips: the id {ids[twice]!r} is there twice")
    names = list(dict.fromkeys(names))
    wanted = {n for n in names if n not in index}
    with_suffix: dict[str, list[int]] = {n: [] for n in wanted}
    without: dict[str, list[int]] = {n: [] for n in wanted}
    for n, name in enumerate(ids) if wanted else ():
        for end in _ends(name):
            if end in wanted:
                with_suffix[end].append(n)
            folder, slash, file = end.rpartition("/")
            stem = folder + slash + (file.rpartition(".")[0] or file)
            if stem != end and stem in wanted:
                without[stem].append(n)
    out: dict[str, int | None] = {}
    for name in names:
        hits = [index[name]] if name in index else with_suffix[name] or without[name]
        if len(hits) > 1:
            shown = ", ".join(ids[i] for i in hits[:8]) + (", ..." if len(hits) > 8 else "")
            raise OptionError(f"the clip {name!r} may be any of {len(hits)}: {shown}; give the whole id")
        out[name] = hits[0] if hits else None
    return out


def _ends(name: str) -> Iterable[str]:
    """The name and all its ends at slashes."""
    yield name
    while "/" in name:
        name = name.partition("/")[2]
        if name:
            yield name


def from_annotations(items: Iterable[Annotations]) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The columns of constraints (with `clip`) and of clips, of annotations as `kinjax.detect` makes them: what is evaluated."""
    items = list(items)
    parts = [a.constraints.columns() for a in items]
    clip = [a.clip for a, part in zip(items, parts, strict=True) for _ in range(len(part["begin"]))]
    names = parts[0] if parts else ("object", "type", "begin", "end")
    found: dict[str, Any] = {"clip": clip, **{n: np.concatenate([p[n] for p in parts]) if parts else [] for n in names}}
    clips: dict[str, list[Any]] = {"clip": [a.clip for a in items], "frames": [a.frames for a in items]}
    return found, clips | {"fps": [float(a.fps) for a in items]}


def clip_sizes(clips: Mapping[str, Any] | Any) -> tuple[list[str], list[int], list[float]]:
    """Ids, numbers of frames and rates of the table of clips."""
    given = columns(clips, ("clip", "frames", "fps"), what="clips")
    return [str(c) for c in given["clip"]], given["frames"], given["fps"]
