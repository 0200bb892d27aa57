"""Motion and poses as .npz: exact, fast, every bit of every number kept.

In: a `Motion` or `Poses` of any batch shape and precision. Out: a file, and back the same record with NumPy arrays. What
is static (names, parents, channels, up axis, rate) is the JSON document of `npz_container`; the arrays are
`translations, rotations, offsets, end_offsets` of a motion, and `masses, mass_centers, limits` where its skeleton has them;
`rotation, position, valid` of poses; shapes and units as in `kinjax.motion` and `kinjax.skeleton`. Versions:
"kinjax-motion/1", "kinjax-poses/1".
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from ..errors import FileFormatError, OptionError, ShapeError
from ..motion import Motion, Poses
from ..skeleton import Axis, Skeleton, Topology
from .files import clean_text
from .npz_container import read_npz, write_npz

MOTION, POSES = "kinjax-motion/1", "kinjax-poses/1"
MEASURES = ("masses", "mass_centers", "limits")
"""What a skeleton may know beside its lengths; a file holds those that are known."""

Record = TypeVar("Record", bound=msgspec.Struct)


class _MotionMeta(msgspec.Struct, forbid_unknown_fields=True):
    schema: str
    names: tuple[str, ...]
    parents: tuple[int, ...]
    channels: tuple[tuple[str, ...], ...]
    translated: tuple[int, ...]
    end_parents: tuple[int, ...]
    end_names: tuple[str, ...]
    up: Axis
    rate: float
    name: str
    notes: tuple[str, ...]


class _PosesMeta(msgspec.Struct, forbid_unknown_fields=True):
    schema: str
    names: tuple[str, ...]
    rate: float
    clip: str
    up: Axis


def write_motion_npz(path: str | Path, motion: Motion) -> Path:
    """Write a motion, batch axes and precision included; returns the path. `ShapeError` if its arrays do not fit it."""
    t = motion.skeleton.topology
    arrays = {
        "translations": np.asarray(motion.translations),
        "rotations": np.asarray(motion.rotations),
        "offsets": np.asarray(motion.skeleton.offsets),
        "end_offsets": np.asarray(motion.skeleton.end_offsets),
    }
    known = {n: getattr(motion.skeleton, n) for n in MEASURES}
    arrays |= {n: np.asarray(x) for n, x in known.items() if x is not None}
    if wrong := _motion_shapes(t, arrays):
        raise ShapeError(f"{motion.name or 'motion'}: {wrong}")
    names = ("names", "parents", "channels", "translated", "end_parents", "end_names", "up")
    text = {"name": clean_text(motion.name), "notes": [clean_text(n) for n in motion.notes]}
    return write_npz(path, MOTION, {**{n: getattr(t, n) for n in names}, "rate": _rate(motion.rate), **text}, arrays)


def read_motion_npz(path: str | Path) -> Motion:
    """Read a motion: the record that was written, with NumPy arrays. `FileFormatError` if it is none, or damaged."""
    document, arrays = read_npz(path, MOTION)
    meta = _record(document, _MotionMeta, path)
    shared = {n: getattr(meta, n) for n in ("names", "parents", "channels", "translated", "end_parents", "end_names", "up")}
    try:
        topology = Topology(**shared)
    except ShapeError as e:
        raise FileFormatError(str(e), path=path, remedy="get a complete copy") from e
    if wrong := _motion_shapes(topology, arrays):
        raise FileFormatError(wrong, path=path, remedy="get a complete copy")
    known = {n: arrays[n] for n in MEASURES if n in arrays}
    skeleton = Skeleton(arrays["offsets"], arrays["end_offsets"], topology, **known)
    return Motion(arrays["translations"], arrays["rotations"], skeleton, meta.rate, meta.name, meta.notes)


def write_poses_npz(path: str | Path, poses: Poses) -> Path:
    """Write poses, batch axes and precision included; returns the path. `ShapeError` if the arrays do not fit the names."""
    arrays = {"rotation": np.asarray(poses.rotation), "position": np.asarray(poses.position), "valid": np.asarray(poses.valid)}
    if wrong := _poses_shapes(poses.names, arrays):
        raise ShapeError(f"{poses.clip or 'poses'}: {wrong}")
    meta = {"names": poses.names, "rate": _rate(poses.rate), "clip": clean_text(poses.clip), "up": poses.up}
    return write_npz(path, POSES, meta, arrays)


def read_poses_npz(path: str | Path) -> Poses:
    """Read poses: the record that was written, with NumPy arrays. `FileFormatError` if it is none, or damaged."""
    document, arrays = read_npz(path, POSES)
    meta = _record(document, _PosesMeta, path)
    if wrong := _poses_shapes(meta.names, arrays):
        raise FileFormatError(wrong, path=path, remedy="get a complete copy")
    return Poses(arrays["rotation"], arrays["position"], arrays["valid"], meta.rate, meta.names, meta.clip, meta.up)


def _rate(rate: Any) -> float:
    value = float(rate)
    if not (math.isfinite(value) and value > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
    return value


def _record(document: dict[str, Any], kind: type[Record], path: object) -> Record:
    try:
        record = msgspec.convert(document, kind)
        _rate(record.rate)  # type: ignore[attr-defined]
    except (msgspec.ValidationError, OptionError) as e:
        raise FileFormatError(f"its description is wrong: {e}", path=path, remedy="get a complete copy") from e
    return record


def _missing(arrays: dict[str, np.ndarray], wanted: dict[str, str]) -> str:
    """What is wrong with the names and kinds ("f" floats, "b" booleans) of the arrays, or ""."""
    if set(arrays) != set(wanted):
        return f"the arrays are {', '.join(sorted(arrays))}, not {', '.join(wanted)}"
    return next((f"{n} is of type {arrays[n].dtype}" for n, kind in wanted.items() if arrays[n].dtype.kind != kind), "")


def _motion_shapes(t: Topology, arrays: dict[str, np.ndarray]) -> str:
    """What does not fit, or ""."""
    known = [n for n in MEASURES if n in arrays]
    if wrong := _missing(arrays, dict.fromkeys(("translations", "rotations", "offsets", "end_offsets", *known), "f")):
        return wrong
    joints, moving, ends = len(t.names), len(t.translated), len(t.end_parents)
    if len(t.end_names) not in (0, ends) or any(not 0 <= i < joints for i in (*t.translated, *t.end_parents)):
        return f"the moving joints or End Sites do not fit the {joints} joints"
    shapes = {n: a.shape for n, a in arrays.items()}
    measured = {"masses": (joints,), "mass_centers": (joints, 3), "limits": (joints, 3, 2)}
    if wrong := next((n for n in known if shapes[n] != measured[n]), ""):
        return f"{wrong} has the shape {shapes[wrong]}, not {measured[wrong]} for {joints} joints"
    fits = shapes["offsets"] == (joints, 3) and shapes["end_offsets"] == (ends, 3)
    fits &= shapes["rotations"][-2:] == (joints, 4) and shapes["translations"][-2:] == (moving, 3)
    if not fits or shapes["rotations"][:-2] != shapes["translations"][:-2] or len(shapes["rotations"]) < 3:
        return f"the arrays have the shapes {shapes} for {joints} joints, {moving} of them moving, and {ends} End Sites"
    return ""


def _poses_shapes(names: tuple[str, ...], arrays: dict[str, np.ndarray]) -> str:
    """What does not fit, or ""."""
    if wrong := _missing(arrays, {"rotation": "f", "position": "f", "valid": "b"}):
        return wrong
    shapes = {n: a.shape for n, a in arrays.items()}
    lead = shapes["valid"]
    if len(lead) < 2 or lead[-1] != len(names) or shapes["rotation"] != (*lead, 4) or shapes["position"] != (*lead, 3):
        return f"the arrays have the shapes {shapes} for {len(names)} names"
    return ""
