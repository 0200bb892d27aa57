"""From what was typed to what the engine takes: clips, objects, templates, settings.

In: options. Out: a loaded clip and the arguments of `kinjax.detect`. Everything wrong here is one `OptionError` line.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..annotations import Template, check_type
from ..detect.settings import Settings
from ..errors import FileFormatError, OptionError, find_name
from ..motion import Motion, Poses
from .assignments import changed_settings
from .options import Detecting, Reading

Clip = Motion | Poses
SUFFIXES = (".json", ".csv", ".parquet", ".npz")  # of annotations


def check_file(path: Path, what: str = "clip") -> Path:
    """`path`, if it is a file that can be opened; else one line that says what is wrong."""
    if path.is_dir():
        raise OptionError(f"{path} is a directory: give its files, as {path / '*'}")
    if not path.exists():
        raise OptionError(f"no such file: {path}")
    if not os.access(path, os.R_OK):
        raise OptionError(f"{path} may not be read (permissions)")
    if path.stat().st_size == 0:
        raise FileFormatError(f"the {what} is empty", path=path)
    return path


def load_clip(path: Path, reading: Reading) -> Clip:
    """The clip in a file: a motion, or poses (.npz)."""
    from ..formats import load

    options = {k: v for k, v in (("unit", reading.unit), ("up", reading.up)) if v not in ("auto", None)}
    if check_file(path).suffix.lower() != ".npz":
        return load(path, **options)
    if options:
        raise OptionError(f"{path.name} says its own unit and axes (npz): --unit and --up go with BVH")
    return load(path)


@dataclass(frozen=True)
class Request:
    """Arguments of one detection: objects in the clip's own spelling, templates for each, settings."""

    objects: tuple[str, ...]
    templates: tuple[Template, ...]
    relative_to: str | None
    settings: Settings
    note: str = ""


def request(options: Detecting, clip: Clip, name: str) -> Request:
    """What `options` ask for of this clip."""
    known = clip.names if isinstance(clip, Poses) else clip.skeleton.names
    asked = [parse_template(text) for group in options.template for text in group]
    named = [n for group in options.object for n in group]
    settings = make_settings(options, [kind for *_, kind in asked if kind])

    def spelled(n: str) -> str:
        return known[find_name(n, known, "joint" if isinstance(clip, Motion) else "object", name)]

    note = ""
    if named:
        objects = tuple(dict.fromkeys(spelled(n) for n in named))
    elif any(n for n, *_ in asked):
        objects = tuple(dict.fromkeys(spelled(n) for n, *_ in asked if n))
    else:
        objects, how = default_objects(clip)
        note = f"looking at {', '.join(objects)} ({how}; --object NAME chooses others)"
    templates = []
    for n, begin, end, kind in asked:
        if n is None and not (named or len(known) == 1):
            raise OptionError(f"--template {begin}:{end} is an example of every --object, and none is given: add --object NAME")
        if n is not None and spelled(n) not in objects:
            raise OptionError(f"--template {n}=...: {spelled(n)} is not among the objects ({', '.join(objects)})")
        for thing in objects if n is None else (spelled(n),):
            templates.append(Template(thing, begin, end, kind or settings.types[0]))
    reference = None if options.relative_to is None else spelled(options.relative_to)
    return Request(objects, tuple(templates), reference, settings, note)


def parse_template(text: str) -> tuple[str | None, int, int, Any]:
    """(object or None, begin, end, type or None) of `[NAME=]BEGIN:END[:TYPE]`."""
    name, _, span = text.rpartition("=")
    parts = span.split(":")
    if len(parts) not in (2, 3) or not all(re.fullmatch(r"\s*\d+\s*", p) for p in parts[:2]) or (not name and "=" in text):
        raise OptionError(f"--template {text!r}: write BEGIN:END, NAME=BEGIN:END or NAME=BEGIN:END:TYPE, with frame numbers from 0")
    begin, end = int(parts[0]), int(parts[1])
    return name or None, begin, end, check_type(parts[2]) if len(parts) == 3 else None


def make_settings(options: Detecting, template_types: Sequence[Any] = ()) -> Settings:
    """The settings that the options change, and those of `--set`."""
    changes: dict[str, Any] = {
        "types": options.type or tuple(dict.fromkeys(template_types)) or None,
        "method": options.method,
        "thresholds": options.thresholds,
        "estimator": options.estimator,
        "rate": options.rate,
        "stride": options.stride,
        "min_duration": options.min_duration,
        "free_pivots": options.free_pivots or None,
    }
    changes = {k: v for k, v in changes.items() if v is not None}
    return Settings().but(**(changes | changed_settings(options.set)))


def default_objects(clip: Clip) -> tuple[tuple[str, ...], str]:
    """What is looked at when nothing is said, and why: feet and hands by name, else the ends of the body, else all."""
    if isinstance(clip, Poses):
        found = _feet_and_hands(clip.names)
        return (found, "feet and hands, by name") if found else (clip.names, "every object")
    top = clip.skeleton.topology
    found = _feet_and_hands(top.names)
    if found:
        return found, "feet and hands, by name"
    ends = dict.fromkeys(top.names[p] for p in top.end_parents)
    leaves = dict.fromkeys(n for i, n in enumerate(top.names) if not top.children(i))
    return tuple(ends or leaves), "no foot or hand by name, so the ends of the body"


def _feet_and_hands(names: Sequence[str]) -> tuple[str, ...]:
    """Names that end with foot or hand, else that contain it; toes where there is no foot."""

    def of(word: str) -> list[str]:
        folded = [(n, n.casefold()) for n in names]
        return [n for n, f in folded if f.endswith(word)] or [n for n, f in folded if word in f]

    found = set((of("foot") or of("toe")) + of("hand"))
    return tuple(n for n in names if n in found)
