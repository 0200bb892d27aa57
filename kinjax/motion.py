"""Motion over time: `Motion` moves a skeleton, `Poses` are named rigid objects in the world.

In: arrays from readers or from a person. Out: what every engine consumes. Deformation changes a `Motion`; detection
looks only at `Poses`, whether they come from joints, marker clusters or props. Conventions stated here and nowhere else:
quaternions are `wxyz`, unit, `q` and `-q` equal; metres; seconds; a clip of `F` frames at `rate` frames a second has
frame `i` at `i / rate`, and interval `i` between frames `i` and `i + 1`; leading axes are batch axes.
Readers leave float64 NumPy arrays here; the engines take them to JAX's working precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from .errors import OptionError, ShapeError, find_name
from .skeleton import Skeleton

Array = jax.Array | np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """A skeleton's motion.

    translations: (..., frames, T, 3) local translation in metres of the `T` joints in `skeleton.topology.translated`, in
    the parent's frame (the world's for a root); it replaces the joint's offset, it is not added to it.
    rotations: (..., frames, joints, 4) rotation of each joint relative to its parent.
    rate: frames a second. name: where it came from, for messages and results.
    """

    translations: Float[Array, "... frames moving 3"]
    rotations: Float[Array, "... frames joints 4"]
    skeleton: Skeleton
    rate: float
    name: str = field(default="", metadata={"static": True})
    notes: tuple[str, ...] = field(default=(), metadata={"static": True})

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.rotations.shape[-3])

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.rotations.shape[-2])

    @property
    def duration(self) -> float:
        """Seconds from the first to the last frame."""
        return max(self.frames - 1, 0) / float(self.rate)

    @property
    def root(self) -> Array:
        """(..., frames, 3) translation of the first root, world metres."""
        return self.translations[..., 0, :]

    def slice(self, begin: int, end: int) -> Motion:
        """Frames `begin..end`, both included."""
        if not 0 <= begin <= end < self.frames:
            raise OptionError(f"frames {begin}..{end} are not inside the clip's 0..{self.frames - 1}")
        return replace(
            self,
            translations=self.translations[..., begin : end + 1, :, :],
            rotations=self.rotations[..., begin : end + 1, :, :],
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Poses:
    """World poses of named rigid objects over time.

    rotation: (..., frames, objects, 4) object to world. position: (..., frames, objects, 3) the object's origin, world
    metres; put it at the centre of the body, it is where residuals are measured. valid: (..., frames, objects), False
    where the object was not seen (its numbers there are ignored, whatever they are). rate: frames a second.
    """

    rotation: Float[Array, "... frames objects 4"]
    position: Float[Array, "... frames objects 3"]
    valid: Bool[Array, "... frames objects"]
    rate: float
    names: tuple[str, ...] = field(metadata={"static": True})
    clip: str = field(default="", metadata={"static": True})
    up: str = field(default="y", metadata={"static": True})

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.position.shape[-3])

    @property
    def objects(self) -> int:
        """Number of objects."""
        return int(self.position.shape[-2])

    def index(self, name: str) -> int:
        """Index of the object called `name` (any case); `UnknownNameError` lists the nearest names."""
        return find_name(name, self.names, "object", self.clip)

    def select(self, names: Sequence[str]) -> Poses:
        """Only the named objects (any case), in the order asked for."""
        at = np.array([self.index(n) for n in names], int)
        return replace(
            self,
            rotation=self.rotation[..., at, :],
            position=self.position[..., at, :],
            valid=self.valid[..., at],
            names=tuple(self.names[i] for i in at),
        )

    def slice(self, begin: int, end: int) -> Poses:
        """Frames `begin..end`, both included."""
        if not 0 <= begin <= end < self.frames:
            raise OptionError(f"frames {begin}..{end} are not inside the clip's 0..{self.frames - 1}")
        at = slice(begin, end + 1)
        return replace(
            self,
            rotation=self.rotation[..., at, :, :],
            position=self.position[..., at, :, :],
            valid=self.valid[..., at, :],
        )


def make_poses(
    names: Sequence[str],
    rotation: Array,
    position: Array,
    rate: float,
    valid: Array | None = None,
    clip: str = "",
    up: str = "y",
) -> Poses:
    """`Poses` from plain arrays, checked: shapes, unit quaternions, finite rate; frames of NaN become invalid.

    Shapes as in `Poses`; `valid` defaults to "every number of the frame is finite". Quaternions that are not unit to 1e-3
    are refused (`ShapeError`), others are normalised by the engine.
    """
    rotation, position = np.asarray(rotation), np.asarray(position)
    if rotation.shape[-1:] != (4,) or position.shape[-1:] != (3,) or rotation.shape[:-1] != position.shape[:-1]:
        raise ShapeError(
            f"rotation {rotation.shape} must be (..., frames, objects, 4) and position {position.shape} (..., frames, objects, 3)"
        )
    if position.ndim < 3 or position.shape[-2] != len(names):
        raise ShapeError(
            f"{len(names)} names for position of shape {position.shape}; the last axes are frames, objects, 3"
        )
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
    finite: Any = np.isfinite(rotation).all(-1) & np.isfinite(position).all(-1)
    if valid is not None:
        valid = np.asarray(valid, bool)
        if valid.shape != finite.shape:
            raise ShapeError(f"valid {valid.shape} must be {finite.shape}, as position without its last axis")
        finite &= valid
    norm = np.linalg.norm(np.where(finite[..., None], rotation, 1.0), axis=-1)
    off = np.abs(np.where(finite, norm, 1.0) - 1.0)
    if off.size and off.max() > 1e-3:
        frame, thing = (int(x) for x in np.unravel_index(off.argmax(), off.shape)[-2:])
        raise ShapeError(
            f"the quaternion of {names[thing]!r} at frame {frame} has length {1 + off.max():.4g}: normalise rotations first"
        )
    return Poses(rotation=rotation, position=position, valid=finite, rate=rate, names=tuple(names), clip=clip, up=up)


def resample(motion: Motion, rate: float) -> Motion:
    """The clip at another rate, frame 0 at its time: translations linear in between, rotations along the shorter arc (slerp).

    The last frame is the last one of the new rate inside the clip; a rest of the clip after it is told in `notes`. Frames that
    are not finite spoil those interpolated from them, and no others.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
    count, old = motion.frames, float(motion.rate)
    if count < 1 or not (np.isfinite(old) and old > 0):
        raise ShapeError(
            f"{motion.name or 'the motion'} has {count} frames at {old:g} fps: there is nothing to resample"
        )
    last = int(np.floor(motion.duration * rate + 1e-6))
    at = np.minimum(np.arange(last + 1) * (old / rate), count - 1)
    near = np.round(at)
    at = np.where(np.abs(at - near) < 1e-6, near, at)
    i = np.clip(at.astype(int), 0, max(count - 2, 0))
    j = np.minimum(i + 1, count - 1)
    u = (at - i)[:, None, None]
    t, q = np.asarray(motion.translations), np.asarray(motion.rotations)
    left = motion.duration - last / rate
    note = f"resampled from {old:.6g} to {rate:.6g} fps" + (
        f"; the last {left:.3g} s have no frame" if left > 1e-6 else ""
    )
    return replace(
        motion,
        translations=_between(t[..., i, :, :], t[..., j, :, :], u.astype(t.dtype), _linear),
        rotations=_between(q[..., i, :, :], q[..., j, :, :], u.astype(q.dtype), _slerp),
        rate=rate,
        notes=(*motion.notes, note),
    )


def _between(a: np.ndarray, b: np.ndarray, u: np.ndarray, mix: Any) -> np.ndarray:
    """`mix(a, b, u)`, and exactly `a` or `b` at their own times, whatever the other is."""
    return np.where(u == 0, a, np.where(u == 1, b, mix(a, b, u)))


def _linear(a: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    return (1 - u) * a + u * b


def _slerp(a: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) between `a` and `b`; the angle from chords, which is exact for small ones too."""
    b = np.where((a * b).sum(-1, keepdims=True) < 0, -b, b)
    half = 2 * np.arctan2(np.linalg.norm(b - a, axis=-1, keepdims=True), np.linalg.norm(b + a, axis=-1, keepdims=True))
    small = half < 1e-4
    s = np.where(small, 1, np.sin(half))
    mixed = np.where(small, _linear(a, b, u), (np.sin((1 - u) * half) * a + np.sin(u * half) * b) / s)
    return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)


def clip_name(path: str | Path) -> str:
    """The name that a result gives to a file: its last path component."""
    return Path(path).name
