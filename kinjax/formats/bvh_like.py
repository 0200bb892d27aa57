"""BVH of a motion that was made from another BVH file: with that file's own angles wherever nothing has changed.

In: a `Motion`, and the file that it came from. Out: a file as `write_bvh` writes it. A rotation has two triples of Euler
angles (and any number of whole turns); which of them a file uses is not in the motion. So each frame takes the triple that is
nearest to the file's, and where the rotation is the file's, its very numbers, up to whole turns that keep them continuous.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..motion import Motion
from .bvh import _plain
from .bvh_header import Header, parse_header
from .bvh_numbers import read_numbers
from .bvh_write import bvh_bytes
from .euler import euler_to_quaternion, rotation_between
from .files import read_bytes, write_atomically

SAME = 1e-7
"""Radians within which two rotations are one: what six decimals of a degree tell apart."""


def write_bvh_like(path: str | Path, motion: Motion, source: str | Path, digits: int = 6) -> Path:
    """Write a motion as BVH, its angles like those in the file `source`, which has the same joints, channels and frames.

    Where it has others, this is `write_bvh`. Returns the path; raises what that raises.
    """
    raw = bvh_bytes(motion, "same", digits)
    ours, theirs = parse_header(raw), _parsed(source)
    if theirs is None or not _alike(ours, theirs[0], motion.frames):
        return write_atomically(path, raw)
    width = sum(len(j.channels or ()) for j in ours.joints)
    own, _ = read_numbers(raw, ours, width)
    numbers = theirs[1]
    words = np.array(raw[ours.data_at :].split()).reshape(own.shape)
    at = 0
    for joint in ours.joints:
        channels = joint.channels or ()
        columns = [at + k for k, c in enumerate(channels) if c.endswith("rotation")]
        at += len(channels)
        if columns:
            axes = "".join(channels[k - at + len(channels)][0].lower() for k in columns)
            angles = np.round(_like(own[:, columns], numbers[:, columns], axes), digits) + 0.0
            words[:, columns] = np.char.mod(f"%.{digits}f", angles).astype(bytes)
    lines = b"\n".join(b" ".join(row) for row in words.tolist())
    return write_atomically(path, raw[: ours.data_at].rstrip() + b"\n" + lines + b"\n")


def _parsed(source: str | Path) -> tuple[Header, np.ndarray] | None:
    """Header and numbers of a BVH file; None where it cannot be taken as it stands."""
    raw, _ = _plain(read_bytes(source), source)
    header = parse_header(raw, source)
    width = sum(len(j.channels or ()) for j in header.joints)
    return (header, read_numbers(raw, header, width, source)[0]) if width else None


def _alike(a: Header, b: Header, frames: int) -> bool:
    joints = [[(j.parent, j.channels or ()) for j in h.joints] for h in (a, b)]
    return joints[0] == joints[1] and b.frames == frames


def _like(own: np.ndarray, theirs: np.ndarray, axes: str) -> np.ndarray:
    """Angles (frames, axes) in degrees of the rotations of `own`, the nearest to `theirs`."""
    candidates = [own]
    if len(axes) == 3:
        candidates.append(np.stack([own[:, 0] + 180, 180 - own[:, 1], own[:, 2] + 180], axis=1))
    away = np.stack([np.abs(_turned(c - theirs)).sum(1) for c in candidates])
    out = np.where((away.argmin(0) == 0)[:, None], candidates[0], candidates[-1])
    same = rotation_between(euler_to_quaternion(own, axes), euler_to_quaternion(theirs, axes)) < SAME
    out = np.where(same[:, None], theirs, out)
    out = np.unwrap(out, period=360.0, axis=0)
    return out + 360.0 * np.round((theirs[0] - out[0]) / 360.0)


def _turned(degrees: np.ndarray) -> np.ndarray:
    return (degrees + 180.0) % 360.0 - 180.0
