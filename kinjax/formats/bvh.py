"""Reading BVH, as it is found: `read_bvh` gives a `Motion` in metres, seconds and unit quaternions.

In: a path (or the bytes of a file). Out: a `Motion` with float64 NumPy arrays. What the format leaves open, decided:

* a position channel **replaces** that component of the joint's OFFSET (as exporters of motion capture mean it); a joint
  with none of them keeps its OFFSET in every frame; a root is always counted as moving;
* rotations follow the order of the channels, `R = R1 R2 R3`, missing ones are zero;
* a joint name that repeats (two figures in one file) gets a number behind it, `Foot`, `Foot_2`, and a note says so;
* `Frames: 0`, a joint without OFFSET, a frame of NaN, a wrong number of numbers are refused, not repaired.

The header is parsed in `bvh_header`, the numbers in `bvh_numbers`, the unit is decided in `bvh_units`; writing is in
`bvh_write`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import get_args

import numpy as np

from ..errors import FileFormatError, OptionError
from ..motion import Motion, clip_name
from ..skeleton import Axis, Skeleton, Topology
from .bvh_header import Header, fail, parse_header
from .bvh_numbers import read_numbers
from .bvh_units import additive_notes, infer_unit, rest_extent, scale_of, unit_note
from .euler import quaternion_parts
from .files import read_bytes

_SOLID = re.compile(rb"[^ \t\r\n\v\f\x00\x1a]")
_MOST = 1 << 27  # joint-frames: 4 GiB of rotations
_BLOCK = 1 << 13  # joint-frames at a time: what lies between numbers and quaternions stays in the cache


Choose = Callable[[tuple[str, ...]], Iterable[int]]


def read_bvh(path: str | Path, unit: str | float = "auto", up: Axis = "y", joints: Choose | None = None) -> Motion:
    """Read a BVH file.

    unit: "auto" infers it from the height of the skeleton at rest (0.5 to 3 m) and says in `Motion.notes` what it assumed;
    "m", "cm", "mm", "inch", "cmu" (inches divided by 0.45), or a number: metres in one file unit.
    up: the file's up axis ("x", "y", "z"); it is kept, nothing is turned.
    joints: which joints are wanted, as a function from all names to indices. Rotations and translations of those that are
    neither wanted nor above a wanted one are left out (NaN), which saves half of the time; of their numbers it is checked
    that they are there and look like numbers.
    Returns a `Motion`: float64 translations (frames, moving, 3) in metres, rotations (frames, joints, 4) `wxyz`, `name` the
    file's name, `notes` the unit and whatever was tolerated. The rate is 1 / frame time, not rounded.
    Raises `FileFormatError` with file, line, column, what was found and the remedy.
    """
    return parse_bvh(read_bytes(path), unit=unit, up=up, path=path, joints=joints)


def parse_bvh(
    raw: bytes,
    unit: str | float = "auto",
    up: Axis = "y",
    path: str | Path | None = None,
    joints: Choose | None = None,
) -> Motion:
    """As `read_bvh`, from the bytes of a file; `path` is used in messages and for the motion's name."""
    if up not in get_args(Axis):
        raise OptionError(f"up is {up!r}: choose from {', '.join(get_args(Axis))}")
    given = None if unit == "auto" else scale_of(unit)
    raw, notes = _plain(raw, path)
    header = parse_header(raw, path)
    names, end_names, naming = _names(header)
    topology = _topology(header, names, end_names, up)
    width = sum(len(c) for c in topology.channels)
    if width == 0:
        fail(raw, header.frames_at, path, "no joint has a channel, so the file has no motion", "give a file with CHANNELS")
    wanted = None if joints is None else _with_ancestors(joints(topology.names), topology.parents)
    columns = _columns(topology, range(len(names)))
    taken = None
    if wanted is not None:
        taken = [c + n for j, c in columns.items() if j in wanted for n in range(len(topology.channels[j]))]
        columns = _columns(topology, sorted(wanted))
    values, about_numbers = read_numbers(raw, header, width, path, taken)
    if len(values) * len(names) > _MOST:
        fail(raw, header.frames_at, path, f"{len(values)} frames of {len(names)} joints are too many", "split the file")

    offsets, ends = (np.array([n.offset for n in nodes], float).reshape(-1, 3) for nodes in (header.joints, header.ends))
    if given is None:
        scale, unit_text = infer_unit(rest_extent(offsets, topology.parents, ends, topology.end_parents))
    else:
        scale, unit_text = given[0], unit_note(*given, "given")
    skeleton = Skeleton(offsets * scale, ends * scale, topology)
    translations = _translations(values, skeleton, scale, columns)
    bare = [n for n, j in zip(names, header.joints, strict=True) if j.channels is None]
    if bare:
        naming.append(f"no CHANNELS, so no motion, in {', '.join(map(repr, bare[:8]))}{' ...' if len(bare) > 8 else ''}")
    notes = [unit_text, *notes, *naming, *about_numbers, *additive_notes(skeleton, translations)]
    name = "" if path is None else clip_name(path)
    return Motion(translations, _rotations(values, topology, columns), skeleton, 1.0 / header.frame_time, name, tuple(notes))


def _plain(raw: bytes, path: object) -> tuple[bytes, list[str]]:
    """The text of a file with `\\n` as line end, and notes; refuses what is no text."""
    notes = []
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if _SOLID.search(raw) is None:
        raise FileFormatError("the file is empty", path=path, remedy="get a complete copy")
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff") or raw[:2].count(0) == 1:
        raise FileFormatError("the file is UTF-16 text", path=path, line=1, column=1, remedy="save it as UTF-8 or ASCII")
    if raw[-1] in b"\x00\x1a":
        text = raw.rstrip(b"\x00\x1a")
        notes.append(f"NUL or end-of-file characters after the text were dropped ({len(raw) - len(text)})")
        raw = text
    if b"\x00" in raw[:4096]:
        raise FileFormatError("the file is binary, not text", path=path, line=1, column=1, remedy="check that this is a BVH file")
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return raw, notes


def _names(header: Header) -> tuple[list[str], list[str], list[str]]:
    """Unique joint names, the names of End Sites, and notes on what was changed."""
    raw, notes = [n.name for n in (*header.joints, *header.ends)], []
    try:
        names = [n.decode("utf-8") for n in raw]
    except UnicodeDecodeError:
        names = [n.decode("latin-1") for n in raw]
        notes.append("the names are not UTF-8: read as Latin-1")
    names, ends = names[: len(header.joints)], names[len(header.joints) :]
    taken, count, changed = set(names), dict.fromkeys(names, 0), []
    for i, name in enumerate(names):
        count[name] += 1
        if count[name] > 1:
            while f"{name}_{count[name]}" in taken:
                count[name] += 1
            names[i] = f"{name}_{count[name]}"
            taken.add(names[i])
            changed.append(f"{name!r} is now {names[i]!r}")
    if changed:
        more = f" and {len(changed) - 8} more" if len(changed) > 8 else ""
        notes.append(f"joint names repeat: the later {', '.join(changed[:8])}{more}")
    return names, ends, notes


def _topology(header: Header, names: list[str], end_names: list[str], up: Axis) -> Topology:
    channels = tuple(j.channels or () for j in header.joints)
    moving = (i for i, j in enumerate(header.joints) if j.parent < 0 or any(c.endswith("position") for c in channels[i]))
    return Topology(
        names=tuple(names),
        parents=tuple(j.parent for j in header.joints),
        channels=channels,
        translated=tuple(moving),
        end_parents=tuple(e.parent for e in header.ends),
        end_names=tuple(end_names),
        up=up,
    )


def _columns(topology: Topology, joints: Sequence[int]) -> dict[int, int]:
    """The column of each joint's first channel, where the numbers are those of these joints."""
    return dict(zip(joints, accumulate((len(topology.channels[j]) for j in joints), initial=0), strict=False))


def _translations(values: np.ndarray, skeleton: Skeleton, scale: float, columns: Mapping[int, int]) -> np.ndarray:
    """Local translations (frames, moving, 3) in metres; NaN for a joint that has no column."""
    topology = skeleton.topology
    out = np.empty((len(values), len(topology.translated), 3))
    out[...] = np.asarray(skeleton.offsets)[list(topology.translated)]
    for n, j in enumerate(topology.translated):
        if j not in columns:
            out[:, n] = np.nan
            continue
        for c, channel in enumerate(topology.channels[j]):
            if channel.endswith("position"):
                out[:, n, "XYZ".index(channel[0])] = values[:, columns[j] + c] * scale
    return out


def _with_ancestors(joints: Iterable[int], parents: tuple[int, ...]) -> set[int]:
    found: set[int] = set()
    for j in joints:
        while j >= 0 and j not in found:
            found.add(j)
            j = parents[j]
    return found


def _rotations(values: np.ndarray, topology: Topology, columns: Mapping[int, int]) -> np.ndarray:
    """Local rotations (frames, joints, 4), NaN for a joint that has no column; in memory one row of frames a component. Few
    joints of short clips are done together."""
    groups: dict[str, list[tuple[int, list[int]]]] = {}
    for j, first in columns.items():
        turns = [(c[0].lower(), first + n) for n, c in enumerate(topology.channels[j]) if c.endswith("rotation")]
        groups.setdefault("".join(axis for axis, _ in turns), []).append((j, [column for _, column in turns]))
    frames = len(values)
    out = np.empty((len(topology.names), 4, frames))
    out[[j for j in range(len(out)) if j not in columns]] = np.nan
    rows, some = values.T, max(1, _BLOCK // max(frames, 1))
    for axes, members in groups.items():
        for at in range(0, len(members), some):
            block = members[at : at + some]
            at_rows = np.array([c for _, c in block], int)
            parts = quaternion_parts(rows[at_rows.T] if len(block) > 1 else rows[at_rows[0]][:, None], axes)
            for component, part in enumerate(parts):
                out[[j for j, _ in block], component] = part
    return out.transpose(2, 0, 1)
