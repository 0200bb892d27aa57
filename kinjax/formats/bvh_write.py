"""Writing BVH: the hierarchy and the channel orders of the motion's skeleton, continuous angles, a fixed point of reading.

In: a `Motion` without batch axes. Out: a file; reading it gives the joint positions to 1e-6 m, and writing that again gives
the same bytes. What a joint's channels cannot express is refused with its name, never projected away.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..errors import OptionError, ShapeError
from ..motion import Motion
from ..skeleton import Skeleton, Topology
from .bvh_header import CHANNELS, MAX_DEPTH
from .bvh_units import scale_in_notes, scale_of
from .euler import euler_to_quaternion, quaternion_to_euler, rotation_between
from .files import clean_text, write_atomically

_POSITION = ("Xposition", "Yposition", "Zposition")
_ROTATION = ("Zrotation", "Xrotation", "Yrotation")


def write_bvh(path: str | Path, motion: Motion, unit: str | float = "same", digits: int = 6) -> Path:
    """Write a motion as BVH (ASCII, or UTF-8 where names need it), and return the path.

    unit: "same" is the unit of the file that the motion was read from, centimetres if it came from nowhere; or a unit as
    `read_bvh` takes it. digits: decimals of angles in degrees, and of lengths in centimetres (larger units get more, so
    that the step stays the same). A skeleton without channel lists gets six channels on joints that move and
    `Zrotation Xrotation Yrotation` on the others.
    Raises `OptionError` (a joint whose channels cannot express its motion, a frame that is not finite, a name that BVH
    cannot hold, a rate that a reader would refuse) and `ShapeError` (batch axes; arrays that do not fit the skeleton).
    """
    return write_atomically(path, bvh_bytes(motion, unit, digits))


def bvh_bytes(motion: Motion, unit: str | float = "same", digits: int = 6) -> bytes:
    """The bytes of the file that `write_bvh` writes."""
    scale = scale_in_notes(motion.notes) if unit == "same" else scale_of(unit)[0]
    if not 1 <= digits <= 15:
        raise OptionError(f"digits is {digits}: choose 1 to 15")
    lengths = digits + max(0, math.ceil(math.log10(scale / 0.01) - 1e-9))
    translations, rotations = _checked(motion)
    topology, channels = motion.skeleton.topology, _channels(motion.skeleton.topology)
    order = _depth_first(topology)
    columns = [
        column
        for j in order
        for column in _joint_columns(motion, j, channels[j], translations, rotations, scale, digits, lengths)
    ]
    lines = ["HIERARCHY", *_hierarchy(motion.skeleton, channels, scale, lengths)]
    lines += ["MOTION", f"Frames: {motion.frames}", f"Frame Time: {_frame_time(motion.rate)}"]
    row = " ".join(f"%.{n}f" for _, n in columns)
    if not columns:
        raise OptionError(f"{motion.name or 'motion'}: no joint has a channel, so there is no motion to write")
    numbers = np.stack([np.round(c, n) for c, n in columns], axis=1) + 0.0  # + 0.0: no "-0.000000"
    lines += [row % tuple(frame) for frame in numbers.tolist()]
    return ("\n".join(lines) + "\n").encode("utf-8")


def _checked(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Translations and unit rotations in float64, after checking shapes and that every number is finite."""
    topology, what = motion.skeleton.topology, motion.name or "motion"
    translations, rotations = np.asarray(motion.translations, np.float64), np.asarray(motion.rotations, np.float64)
    wanted = (motion.frames, len(topology.translated), 3), (motion.frames, len(topology.names), 4)
    if translations.shape != wanted[0] or rotations.shape != wanted[1]:
        found = f"translations {translations.shape} and rotations {rotations.shape}"
        raise ShapeError(f"{what}: {found} must be {wanted[0]} and {wanted[1]}; write the clips of a batch one by one")
    if not motion.frames:
        raise ShapeError(f"{what}: there is no frame to write")
    measures = [("offset", np.asarray(motion.skeleton.offsets)), ("end offset", np.asarray(motion.skeleton.end_offsets))]
    for name, values in measures:
        if not np.isfinite(values).all():
            raise OptionError(f"{what}: an {name} of the skeleton is not finite")
    named = ("translation", translations, topology.translated), ("rotation", rotations, range(len(topology.names)))
    for kind, values, joints in named:
        bad = np.argwhere(~np.isfinite(values).all(-1))
        if len(bad):
            where = f"the {kind} of {topology.names[joints[bad[0][1]]]!r} at frame {bad[0][0]}"
            raise OptionError(f"{what}: {where} is not finite; BVH has no gaps: fill it first")
    norm = np.linalg.norm(rotations, axis=-1, keepdims=True)
    frame, joint = np.unravel_index(np.abs(norm[..., 0] - 1).argmax(), norm.shape[:2])
    if abs(norm[frame, joint, 0] - 1) > 1e-3:
        where = f"the quaternion of {topology.names[joint]!r} at frame {frame}"
        raise OptionError(f"{what}: {where} has length {norm[frame, joint, 0]:.4g}; normalise rotations first")
    return translations, rotations / norm


def _channels(topology: Topology) -> tuple[tuple[str, ...], ...]:
    """Each joint's channels, invented where the skeleton has none; `OptionError` for what is no channel."""
    if not topology.channels:
        return tuple((*_POSITION, *_ROTATION) if j in topology.translated else _ROTATION for j in range(len(topology.names)))
    for name, channels in zip(topology.names, topology.channels, strict=True):
        wrong = [c for c in channels if c not in CHANNELS.values()]
        if wrong or len(set(channels)) != len(channels):
            raise OptionError(f"joint {name!r} has the channels {channels}: each of {', '.join(CHANNELS.values())} at most once")
    return topology.channels


def _depth_first(topology: Topology) -> list[int]:
    """Joints in the order of a file: each followed by its descendants."""
    children: list[list[int]] = [[] for _ in topology.names]
    for j, p in enumerate(topology.parents):
        if p >= 0:
            children[p].append(j)
    order, stack = [], [j for j, p in enumerate(topology.parents) if p < 0][::-1]
    while stack:
        order.append(stack.pop())
        stack += children[order[-1]][::-1]
    return order


def _joint_columns(
    motion: Motion, joint: int, channels: tuple[str, ...], translations: np.ndarray, rotations: np.ndarray,
    scale: float, digits: int, lengths: int,
) -> list[tuple[np.ndarray, int]]:  # fmt: skip
    """The numbers (frames,) of each channel of a joint, in file units and degrees, each with its number of decimals."""
    skeleton, name = motion.skeleton, motion.skeleton.names[joint]
    double = np.asarray(motion.rotations).dtype.itemsize >= 8 and np.asarray(motion.translations).dtype.itemsize >= 8
    rounding = 1e-7 if double else 1e-5  # metres and radians: what rounding alone makes of a motion
    offset = np.asarray(skeleton.offsets, np.float64)[joint]
    moving = joint in skeleton.topology.translated
    local = translations[:, skeleton.topology.translated.index(joint)] if moving else np.broadcast_to(offset, (motion.frames, 3))
    for axis, letter in enumerate("XYZ"):
        off = np.abs(local[:, axis] - offset[axis])
        if f"{letter}position" not in channels and off.max() > rounding:
            raise OptionError(
                f"joint {name!r} moves by {off.max():.3g} m along its {letter} axis (frame {off.argmax()}), but has no "
                f"{letter}position channel: add one to the channels of the skeleton"
            )
    axes = "".join(c[0].lower() for c in channels if c.endswith("rotation"))
    angles = quaternion_to_euler(rotations[:, joint], axes, digits)
    if len(axes) < 3:
        off = rotation_between(euler_to_quaternion(angles, axes), rotations[:, joint])
        if off.max() > rounding + 2 * np.radians(10.0**-digits):
            raise OptionError(
                f"joint {name!r} turns by {np.degrees(off.max()):.3g} degrees (frame {off.argmax()}) about an axis that its "
                f"channels {channels} do not have: give it three rotation channels"
            )
    turns = iter(angles.T)
    return [(next(turns), digits) if c.endswith("rotation") else (local[:, "XYZ".index(c[0])] / scale, lengths) for c in channels]


def _hierarchy(skeleton: Skeleton, channels: tuple[tuple[str, ...], ...], scale: float, digits: int) -> list[str]:
    topology = skeleton.topology
    lines: list[str] = []
    open_: list[int] = []
    ends: dict[int, list[int]] = {}
    for e, parent in enumerate(topology.end_parents):
        ends.setdefault(parent, []).append(e)

    def offset(indent: str, values: np.ndarray) -> str:
        numbers = np.round(np.asarray(values, np.float64) / scale, digits) + 0.0
        return f"{indent}OFFSET " + " ".join(f"{x:.{digits}f}" for x in numbers)

    def close() -> None:
        indent, j = "\t" * len(open_), open_.pop()
        for e in ends.get(j, ()):
            name = topology.end_names[e] if e < len(topology.end_names) else ""
            lines.append(f"{indent}End Site{' ' + _name(name, 'End Site') if name else ''}")
            lines.extend([f"{indent}{{", offset(indent + "\t", np.asarray(skeleton.end_offsets)[e]), f"{indent}}}"])
        lines.append(f"{indent[1:]}}}")

    for j in _depth_first(topology):
        while open_ and open_[-1] != topology.parents[j]:
            close()
        indent = "\t" * len(open_)
        if len(open_) + (j in ends) >= MAX_DEPTH:
            raise OptionError(f"joint {topology.names[j]!r} is nested too deep: {MAX_DEPTH} levels are read")
        lines += [f"{indent}{'JOINT' if open_ else 'ROOT'} {_name(topology.names[j], 'joint')}", f"{indent}{{"]
        lines.append(offset(indent + "\t", np.asarray(skeleton.offsets)[j]))
        lines.append(f"{indent}\tCHANNELS {' '.join([str(len(channels[j])), *channels[j]])}")
        open_.append(j)
    while open_:
        close()
    return lines


def _name(name: str, what: str) -> str:
    """A name as it stands in a file; `OptionError` when it would be read as another."""
    if clean_text(name) != name or name != name.strip() or not name or any(c in "{}" or ord(c) < 32 for c in name):
        raise OptionError(f"the {what} name {name!r} cannot be written: no braces, control characters or spaces at its ends")
    return name


def _frame_time(rate: float) -> str:
    """The shortest decimal number whose inverse is the rate, in the precision in which the rate is held."""
    kind = np.float32 if np.asarray(rate).dtype == np.float32 else np.float64
    value = float(rate)
    if not (math.isfinite(value) and 1.0 <= value <= 1000.0):
        raise OptionError(f"a rate of {value:g} frames a second cannot be written: BVH is read with 1 to 1000")
    # Not every number is the inverse of one; then the nearest that is, which is what reading it gives.
    for target in (kind(value), kind(1.0 / (1.0 / value))):
        for digits in range(1, 18):
            text = f"{1.0 / value:.{digits}g}"
            if kind(1.0 / float(text)) == target:
                return f"{float(text):.20f}".rstrip("0") if "e" in text else text
    return f"{1.0 / value:.17g}"
