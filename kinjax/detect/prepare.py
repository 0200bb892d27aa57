"""From the motion that a person gives to the arrays that the engine takes: checked, named, padded to a bucket.

In: a `Motion` or `Poses`, object names, `Settings`. Out: `Prepared`. Errors of names and shapes are raised here, before
any `jit`. Positions are taken from a place near each
object (float64 on the host), so that float32 is as good 1 km from the origin as at it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from ..errors import OptionError, ShapeError, find_name
from ..kinematics import object_poses
from ..lengths import BLOCK, bucket
from ..motion import Motion, Poses
from ..quaternions import from_turns, turns
from .interface import Clip, Joints
from .settings import Settings

Padded = Callable[[int], int]
"""From a number of frames to the length of the arrays: `lengths.bucket` or `lengths.octave`."""

_PIECE = 512  # frames
_LINE = 64  # bytes
_ROUNDING = 1e-5
"""How far squares of unit quaternions may be off on average."""


@dataclass(frozen=True)
class Prepared:
    """One clip, ready to run: what the engine takes (NumPy arrays), `valid` (objects, frames) without padding, and the
    `origin` (objects, 3) to be added to the positions that come out."""

    arrays: Clip | Joints
    valid: np.ndarray
    origin: np.ndarray
    lanes: int
    names: tuple[str, ...]
    frames: int
    rate: float
    clip: str
    up: str
    original_rate: float
    original_frames: int

    @property
    def missing(self) -> np.ndarray:
        """(objects,) frames in which each object was not seen."""
        rows = self.valid if self.valid.strides[0] else self.valid[:1]  # one row for all needs to be counted once
        return np.broadcast_to(self.frames - np.count_nonzero(rows, axis=1), len(self.valid))


def working_dtype() -> np.dtype:
    """float64 where JAX has it enabled, else float32."""
    double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    return np.dtype(np.float64 if double else np.float32)


def as_poses(source: Motion | Poses, objects: Sequence[str] | None, relative_to: str | None) -> Poses:
    """The poses of the objects asked for, in the frame of another object where `relative_to` names one."""
    known = source.skeleton.names if isinstance(source, Motion) else getattr(source, "names", ())
    names = None if objects is None else list(dict.fromkeys(known[find_name(n, known, "object")] for n in objects))
    wanted = None if names is None or relative_to is None else [*names, relative_to]
    if isinstance(source, Motion):
        poses = object_poses(source, wanted or names)
    elif isinstance(source, Poses):
        poses = source.select(wanted or names) if names is not None else source
    else:
        raise ShapeError(f"detection takes a Motion or Poses, not {type(source).__name__}; read files with kinjax.load")
    if poses.position.ndim != 3:
        raise ShapeError(
            f"poses of shape {poses.position.shape}: one clip is (frames, objects, 3); give a list of clips for a batch"
        )
    if relative_to is None:
        return poses
    reference = poses.index(relative_to)
    others = [i for i in range(poses.objects) if i != reference]
    if not others:
        raise OptionError(f"relative_to={relative_to!r} leaves no object to look at")
    q, t = np.asarray(poses.rotation, float), np.asarray(poses.position, float)
    seen = np.asarray(poses.valid)[:, reference]
    back = turns(np.where(seen[:, None], q[:, reference], np.nan)).inv()
    rotation, position = np.empty((len(q), len(others), 4)), np.empty((len(q), len(others), 3))
    for k, i in enumerate(others):
        ok = np.asarray(poses.valid)[:, i]
        rotation[:, k] = from_turns(back * turns(np.where(ok[:, None], q[:, i], np.nan)))
        position[:, k] = back.apply(np.where((ok & seen)[:, None], t[:, i] - t[:, reference], 0))
    return replace(
        poses,
        rotation=rotation,
        position=position,
        valid=np.asarray(poses.valid)[:, others] & seen[:, None],
        names=tuple(poses.names[i] for i in others),
    )


def resampled(poses: Poses, rate: float | None) -> Poses:
    """The clip at another rate: positions interpolated linearly, rotations by slerp; times outside valid pairs are masked."""
    if rate is None or rate == poses.rate or poses.frames < 2:
        return poses
    q, t, valid = (np.asarray(x) for x in (poses.rotation, poses.position, poses.valid))
    at = np.arange(int(np.floor((poses.frames - 1) / poses.rate * rate + 1e-9)) + 1) * (poses.rate / rate)
    i = np.minimum(at.astype(int), poses.frames - 2)
    u = (at - i)[:, None, None]
    a, b = q[i], q[i + 1]
    b = np.where((a * b).sum(-1, keepdims=True) < 0, -b, b)
    half = np.arccos(np.clip((a * b).sum(-1, keepdims=True), -1, 1))
    small = half < 1e-6
    s = np.where(small, 1, np.sin(half))
    mixed = np.where(small, (1 - u) * a + u * b, (np.sin((1 - u) * half) * a + np.sin(u * half) * b) / s)
    exact = u[..., 0] < 1e-9
    ok = valid[i] & (valid[i + 1] | exact)
    return replace(
        poses, rotation=mixed, position=np.where(u < 1e-9, t[i], (1 - u) * t[i] + u * t[i + 1]), valid=ok, rate=rate
    )


def prepared(
    source: Motion | Poses,
    objects: Sequence[str] | None,
    relative_to: str | None,
    settings: Settings,
    padded: Padded = bucket,
) -> Prepared:
    """Arrays padded to a bucket: objects to a power of two, frames to what `padded` makes of their number."""
    near = settings.formulation == "local"  # the comparison of appendix A is about the world's own origin
    if (
        isinstance(source, Motion)
        and source.rotations.ndim == 3
        and relative_to is None
        and settings.rate in (None, source.rate)
    ):
        return _prepared_joints(source, objects, near, padded)
    poses = as_poses(source, objects, relative_to)
    original = float(poses.rate), poses.frames
    check_rate(original[0])
    poses = resampled(poses, settings.rate)
    if poses.objects == 0:
        raise OptionError("no object to look at")
    valid: Any = np.array(poses.valid, bool).T
    t = np.asarray(poses.position, float)
    first = np.argmax(valid, axis=1)
    origin = np.where(valid.any(1)[:, None] & near, t[first, np.arange(poses.objects)], 0.0)
    world = _padded_poses(np.asarray(poses.rotation), t, origin, valid, padded)
    return Prepared(
        world,
        valid,
        origin,
        world.valid.shape[0],
        poses.names,
        poses.frames,
        float(poses.rate),
        poses.clip,
        poses.up,
        *original,
    )


def check_rate(rate: float) -> None:
    """`OptionError` unless it is a positive number of frames a second."""
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")


def _aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An array that begins where a cache line does: JAX then takes it as it is, not a copy of it."""
    size = int(np.prod(shape)) * dtype.itemsize
    raw = np.empty(size + _LINE, np.uint8)
    return raw[-raw.ctypes.data % _LINE :][:size].view(dtype).reshape(shape)


def _padded_poses(
    rotation: np.ndarray, position: np.ndarray, origin: np.ndarray, valid: np.ndarray, padded: Padded
) -> Clip:
    """Poses (frames, objects, components) from each object's `origin` as the engine takes them; what is not `valid`
    (objects, frames), and the padding, are identity poses."""
    objects, frames = valid.shape
    lanes, length, dtype = 1 << (objects - 1).bit_length(), padded(frames + BLOCK), working_dtype()
    q, t, seen = _aligned((4, lanes, length), dtype), _aligned((3, lanes, length), dtype), np.zeros((lanes, length), bool)
    seen[:objects, :frames] = valid
    for x, at_rest in ((q, [[[1]], [[0]], [[0]], [[0]]]), (t, 0)):
        x[:, :, frames:] = x[:, objects:] = at_rest
    with np.errstate(over="ignore", invalid="ignore"):  # in frames that are masked
        for begin in range(0, frames, _PIECE):
            some = slice(begin, min(begin + _PIECE, frames))
            q[:, :objects, some] = rotation[some].T
            t[:, :objects, some] = (position[some] - origin).T
    if not valid.all():
        q[:, ~seen], t[:, ~seen] = [[1], [0], [0], [0]], 0
    return Clip(q, t, seen)  # type: ignore[arg-type]


def used_joints(motion: Motion, objects: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The joints that objects need, themselves and those above them, in the skeleton's order; and the rows of the motion's
    translations that are theirs."""
    top = motion.skeleton.topology
    needed: set[int] = set()
    for j in objects:
        while j >= 0 and j not in needed:
            needed.add(j)
            j = top.parents[j]
    return tuple(sorted(needed)), tuple(k for k, j in enumerate(top.translated) if j in needed)


def _frames_last(
    q: np.ndarray, joints: Sequence[int], room: int, length: int, dtype: np.dtype
) -> tuple[np.ndarray, bool]:
    """Rotations (frames, all, 4) of some joints as (room, 4, length), filled up with the identity; and is every number finite?

    How far the sums of all squares are from those of unit quaternions tells whether the numbers have to be looked at one by one.
    """
    frames, count = len(q), len(joints)
    out = _aligned((room, 4, length), dtype)
    out[:, :, frames:] = out[count:] = np.eye(4)[0][:, None]
    off = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        if q.strides[0] == q.itemsize:  # as the readers leave it: each row is copied whole
            for i, j in enumerate(joints):
                out[i, :, :frames] = q[:, j].T
                flat = out[i].reshape(-1)
                off += abs(float(np.dot(flat, flat)) - length)
        else:
            some = slice(None) if count == q.shape[1] else list(joints)
            for begin in range(0, frames, _PIECE):  # what is turned round stays in the cache
                piece = q[begin : begin + _PIECE, some].astype(dtype)
                out[:count, :, begin : begin + len(piece)] = piece.transpose(1, 2, 0)
                flat = piece.reshape(-1)
                off += abs(float(np.dot(flat, flat)) - len(piece) * count)
        if off > _ROUNDING * count * length or not np.isfinite(off):
            norm = np.sqrt(np.einsum("jkf,jkf->jf", out, out))[:, None]
            out /= np.where((norm > 0) & (norm < np.inf), norm, 1)
            out[:, :1][norm == 0] = 1
    return out, bool(np.isfinite(off)) or bool(np.isfinite(out).all())


def _prepared_joints(motion: Motion, objects: Sequence[str] | None, near: bool, padded: Padded) -> Prepared:
    """A motion as the engine takes it: only the objects and their ancestors, so that one hand costs one arm."""
    check_rate(float(motion.rate))
    top = motion.skeleton.topology
    at = list(range(len(top.names)))
    if objects is not None:
        at = list(dict.fromkeys(find_name(n, top.names, "joint", motion.name) for n in objects))
    if not at:
        raise OptionError("no object to look at")
    joints, rows = used_joints(motion, at)
    new = {old: i for i, old in enumerate(joints)}
    moving = [top.translated[k] for k in rows]
    dtype, frames = working_dtype(), motion.frames
    length, room = padded(frames + BLOCK), 8 * -(-len(joints) // 8)
    t = np.asarray(motion.translations)[:, list(rows)].astype(float)
    valid: Any = np.ones(frames, bool)
    rotations, finite = _frames_last(np.asarray(motion.rotations), joints, room, length, dtype)
    if not (finite and np.isfinite(t).all()):  # frame by frame takes three times as long
        valid = np.isfinite(rotations[..., :frames]).all((0, 1)) & np.isfinite(t).all((1, 2))
    root = np.array([top.parents[j] < 0 for j in moving])
    origin = t[np.argmax(valid), int(np.argmax(root))].copy() if near and valid.any() and root.any() else np.zeros(3)
    t -= root[:, None] * origin
    if not valid.all():
        t[~valid] = 0
        rotations[:, :, np.flatnonzero(~valid)] = np.array([1, 0, 0, 0], dtype)[:, None]
    translations = np.zeros((len(moving), 3, length), dtype)
    translations[..., :frames] = t.transpose(1, 2, 0)
    mask = np.zeros(length, bool)
    mask[:frames] = valid
    offsets = np.zeros((room, 3), dtype)
    offsets[: len(joints)] = np.asarray(motion.skeleton.offsets)[list(joints)]
    parents = np.full(room, -1, np.int32)
    parents[: len(joints)] = [new.get(top.parents[j], -1) for j in joints]
    lanes = 1 << (len(at) - 1).bit_length()
    centers, index = np.zeros((lanes, 3), dtype), np.full(lanes, -1, np.int32)
    centers[: len(at)] = motion.skeleton.segment_centers()[at]
    index[: len(at)] = [new[j] for j in at]
    in_order = list(at) == list(joints) and lanes <= room
    arrays: Any = (
        rotations,
        translations,
        mask,
        offsets,
        parents,
        np.array([new[j] for j in moving], np.int32),
        None if in_order else index,
        centers,
        np.arange(lanes) < len(at),
    )
    rate = float(motion.rate)
    return Prepared(
        Joints(*arrays),
        np.broadcast_to(valid, (len(at), frames)),
        np.broadcast_to(origin, (len(at), 3)),
        lanes,
        tuple(top.names[j] for j in at),
        frames,
        rate,
        motion.name,
        top.up,
        rate,
        frames,
    )
