"""Reading Acclaim motion, an AMC file with its ASF skeleton: `read_amc` gives a `Motion` as one read from BVH.

In: paths. Out: a `Motion` with float64 NumPy arrays in metres and unit quaternions, whose joints are `root` and the bones,
each at its bone's start; every frame is the world's at rest (`asf` has the convention). What the format leaves open, decided:

* AMC has no frame rate: 120 frames a second, CMU's, unless the caller or a line `:SAMPLES-PER-SECOND` says otherwise;
* without `:DEGREES` or `:RADIANS` the angle unit is the ASF's;
* each frame gives every bone that has degrees of freedom once, and frames are numbered one after the other: else refused.
  A file that was cut between two frames cannot be told from a whole one.

The skeleton is read in `asf`, the numbers in `asf_frames`.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..errors import FileFormatError, OptionError
from ..motion import Motion, clip_name
from ..quaternions import multiply, rotate
from ..skeleton import Axis, Skeleton
from .asf import AsfSkeleton, parse_asf, read_asf
from .asf_frames import Frames, read_frames
from .asf_keywords import ROTATIONS, TRANSLATIONS
from .euler import euler_to_quaternion
from .files import read_bytes

__all__ = ["AsfSkeleton", "parse_amc", "parse_asf", "read_amc", "read_asf"]

CMU_RATE = 120.0
_MOST = 1 << 27  # joint-frames: 4 GiB of rotations
_BLOCK = 128  # frames at a time: what lies between numbers and quaternions stays in the cache


def read_amc(
    path: str | Path, skeleton: str | Path | Skeleton | None = None, *, rate: float = CMU_RATE, up: Axis = "y",
    unit: str | float = "asf",
) -> Motion:  # fmt: skip
    """Read an AMC file.

    skeleton: the path of its ASF file, or what `read_asf` gave. None looks beside the AMC file: the ASF with its name, or with
    the name up to one of its underscores (02.asf for 02_01.amc, in any case of letters), else the only ASF in the folder.
    rate: frames a second; a line `:SAMPLES-PER-SECOND` in the file comes before the default.
    up, unit: as in `read_asf`; a skeleton that was read already keeps its own.
    Returns a `Motion`: float64 translations (frames, moving, 3) in metres, rotations (frames, joints, 4) `wxyz`, a plain
    `Skeleton`, `name` the file's name, `notes` the unit, the rate, the skeleton's file and whatever was tolerated.
    Raises `FileFormatError` with file, line, column, what was found and the remedy, and `OptionError` for an option.
    """
    raw = read_bytes(path)
    if skeleton is None:
        skeleton = find_asf(path)
    if not isinstance(skeleton, Skeleton):
        skeleton = read_asf(skeleton, up, unit=unit)
    elif (up, unit) not in (("y", "asf"), (skeleton.topology.up, "asf")):
        raise OptionError("the skeleton was read already: give up and unit to read_asf")
    return parse_amc(raw, skeleton, rate=rate, path=path)


def parse_amc(raw: bytes, skeleton: Skeleton, *, rate: float = CMU_RATE, path: str | Path | None = None) -> Motion:
    """As `read_amc`, from the bytes of a file and the skeleton of `read_asf`; `path` is used in messages and for the name."""
    if not isinstance(skeleton, AsfSkeleton):
        raise OptionError("this skeleton does not say what the numbers of an AMC file mean: give one from read_asf")
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
    reading, joints = skeleton.reading, len(skeleton.names)
    frames = read_frames(raw, reading.nodes, path, reading.name)
    if len(frames.values) * joints > _MOST:
        found = f"{len(frames.values)} frames of {joints} joints are too many"
        raise FileFormatError(found, path=path, remedy="split the file")
    degrees, notes = frames.header.degrees, []
    if degrees is None:
        degrees = reading.degrees
        unit = "degrees" if degrees else "radians"
        notes.append(f"the file says neither :DEGREES nor :RADIANS: {unit}, as {reading.name} has them")
    rate, about_rate = _rate(float(rate), frames.header.rate)
    unit_note, *about_skeleton = reading.notes
    notes = [
        unit_note,
        about_rate,
        f"the skeleton is {reading.name}",
        *about_skeleton,
        *notes,
        *frames.header.notes,
        *frames.notes,
    ]
    rotations = _rotations(frames, skeleton, 1.0 if degrees else 180.0 / np.pi)
    translations = _translations(frames, skeleton)
    if not np.isfinite(translations).all():
        raise OptionError(f"with a unit of {reading.scale:g} m the motion is not finite")
    name = "" if path is None else clip_name(path)
    return Motion(translations, rotations, skeleton.plain(), rate, name, tuple(notes))


def _rate(given: float, in_file: float | None) -> tuple[float, str]:
    if in_file is None:
        why = "CMU's; give rate= if it is another" if given == CMU_RATE else "as given"
        return given, f"AMC has no frame rate: {given:g} frames a second ({why})"
    if given == CMU_RATE:
        return in_file, f"{in_file:g} frames a second, from :SAMPLES-PER-SECOND"
    return given, f"{given:g} frames a second, as given; :SAMPLES-PER-SECOND says {in_file:g}"


def find_asf(path: str | Path) -> Path:
    """The ASF file that belongs to an AMC file, as `read_amc` looks for it; `FileFormatError` says what was looked for."""
    path = Path(path)
    folder = path.parent
    try:
        here = sorted(name for name in os.listdir(folder) if name.lower().endswith(".asf"))
    except OSError as e:
        remedy = "give the skeleton's path"
        raise FileFormatError(
            f"the folder {str(folder)!r} cannot be searched for the skeleton", path=path, remedy=remedy
        ) from e
    parts = path.stem.split("_")
    wanted = [f"{'_'.join(parts[:n])}.asf" for n in range(len(parts), 0, -1)]
    for name in wanted:
        found = [n for n in here if n == name] or [n for n in here if n.lower() == name.lower()]
        if len(found) == 1:
            return folder / found[0]
    if len(here) == 1:
        return folder / here[0]
    there = (
        f"{len(here)} others are there ({', '.join(here[:4])}{', ...' if len(here) > 4 else ''})"
        if here
        else "there is no .asf at all"
    )
    found_text = (
        f"no skeleton beside it: looked in {str(folder)!r} for {' and '.join(wanted)} in any case of letters; {there}"
    )
    raise FileFormatError(found_text, path=path, remedy="put the ASF file there, or give its path as skeleton")


def _rotations(frames: Frames, skeleton: AsfSkeleton, turn: float) -> np.ndarray:
    """Local rotations (frames, joints, 4); `turn`: degrees in one unit of the file's angles."""
    nodes, values = skeleton.reading.nodes, frames.values
    groups: dict[str, list[tuple[int, list[int]]]] = {}
    for j, node in enumerate(nodes):
        turns = [(d[1], frames.columns[j] + n) for n, d in enumerate(node.dof) if d in ROTATIONS]
        turns.reverse()  # the first listed turns first: it stands last in the product
        groups.setdefault("".join(axis for axis, _ in turns), []).append((j, [column for _, column in turns]))
    out = np.empty((len(values), len(nodes), 4))
    for axes, members in groups.items():
        members.sort(key=lambda m: m[0] > 0 and any(nodes[m[0]].axes[1:]))  # those with turned axes come last
        joints, columns = [j for j, _ in members], np.array([c for _, c in members], int)
        if not axes:
            out[:, joints] = (1.0, 0.0, 0.0, 0.0)
            continue
        turned = [nodes[j].axes for j in joints if j > 0 and any(nodes[j].axes[1:])]
        c = rotate(np.array(turned).reshape(-1, 1, 4), np.eye(3))  # the axes of each as rows
        for f in range(0, len(values), _BLOCK):
            angles = values[f : f + _BLOCK, columns]
            q = euler_to_quaternion(angles if turn == 1.0 else angles * turn, axes)
            if turned:  # C R C^-1: the axis is turned, the angle stays
                v = q[:, -len(turned) :, 1:]
                v[...] = np.matmul(v.transpose(1, 0, 2), c).transpose(1, 0, 2)
            out[f : f + _BLOCK, joints] = q
    if any(nodes[0].axes[1:]):
        out[:, 0] = multiply(np.array(nodes[0].axes), out[:, 0])
    return out


def _translations(frames: Frames, skeleton: AsfSkeleton) -> np.ndarray:
    """Local translations (frames, moving, 3) in metres: the offset, and the bone's movement in its own axes."""
    reading, topology = skeleton.reading, skeleton.topology
    out = np.zeros((len(frames.values), len(topology.translated), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for n, j in enumerate(topology.translated):
            node = reading.nodes[j]
            for c, dof in enumerate(node.dof):
                if dof in TRANSLATIONS:
                    out[:, n, "xyz".index(dof[1])] = frames.values[:, frames.columns[j] + c] * reading.scale
            if any(node.axes[1:]):
                out[:, n] = rotate(np.array(node.axes), out[:, n])
            out[:, n] += np.asarray(skeleton.offsets)[j]
    return out
