"""Many clips in one compiled call: clips of one shape side by side, each object of each clip in a lane of its own.

In: `Prepared` clips of one `shape_of`. Out: one `Prepared` that holds them all, and the part of a result that belongs to
each. A batch always has the same room, what is not filled is unseen: a shape of clips compiles once, however many come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from .interface import Clip, Found, Joints
from .prepare import Prepared

ROOM = 1 << 16
"""Samples (lanes times frames) that one batch holds, if a single clip has no more: what a step touches stays in the cache."""

MOST = 64
"""Clips of one batch: a batch that a few clips must fill up wastes the rest."""


def shape_of(clip: Prepared) -> tuple[object, ...]:
    """What clips that run in one batch have in common: kind, padded sizes, and rate."""
    a = clip.arrays
    if isinstance(a, Joints):
        return "joints", a.rotations.shape, _moving(a), a.at is None, clip.lanes, clip.rate
    return "poses", a.t.shape, 0, False, clip.lanes, clip.rate


def room_of(clip: Prepared) -> int:
    """How many clips a batch of such clips holds: a power of two."""
    samples = clip.lanes * clip.arrays.valid.shape[-1]
    return min(MOST, 1 << max(0, (ROOM // samples).bit_length() - 1))


def side_by_side(clips: Sequence[Prepared], room: int) -> tuple[Prepared, list[tuple[int, int]]]:
    """Clips of one shape as one, whose objects are those of all (named by clip and name); which lanes belong to which."""
    lanes = clips[0].lanes
    parts = [c.arrays for c in clips]
    arrays: Any
    if isinstance(parts[0], Joints):
        t = _moving(parts[0])
        filled = [_fixed(p, t) for p in parts if isinstance(p, Joints)]
        unseen: Any = {"valid": np.zeros_like(filled[0].valid), "used": np.zeros_like(filled[0].used)}
        nothing = filled[0]._replace(**unseen)
        arrays = jax.tree.map(lambda *x: np.stack(x), *filled, *[nothing] * (room - len(clips)))
    else:
        q, s, seen = (np.stack(x, axis=-3) for x in zip(*parts, strict=True))
        pad = lambda x, n: np.pad(x, [(0, 0)] * n + [(0, room - len(clips)), (0, 0), (0, 0)])  # noqa: E731
        q, s, seen = pad(q, 1), pad(s, 1), pad(seen, 0)
        q[0, len(clips) :] = 1
        flat: list[Any] = [x.reshape(*x.shape[:-3], room * lanes, x.shape[-1]) for x in (q, s, seen)]
        arrays = Clip(*flat)
    longest = max(c.frames for c in clips)
    seen = np.zeros((room * lanes, longest), bool)
    origin = np.zeros((room * lanes, 3))
    names = [f"{i}\0" for i in range(room * lanes)]
    spans = []
    for i, c in enumerate(clips):
        first, count = i * lanes, len(c.names)
        seen[first : first + count, : c.frames] = c.valid
        origin[first : first + count] = c.origin
        names[first : first + count] = [lane_name(i, n) for n in c.names]
        spans.append((first, first + count))
    whole = replace(
        clips[0],
        arrays=arrays,
        valid=seen,
        origin=origin,
        lanes=room * lanes,
        names=tuple(names),
        frames=longest,
        original_frames=max(c.original_frames for c in clips),
        clip=clips[0].clip if len(clips) == 1 else "batch",
    )
    return whole, spans


def lane_name(clip: int, name: str) -> str:
    """What an object of the n-th clip is called in a batch."""
    return f"{clip}\0{name}"


def lanes_of(found: Found, begin: int, end: int) -> Found:
    """The part of a batch's result that belongs to some lanes; arrays by object have them first, constraints last."""
    by_lane = lambda x: x[begin:end]  # noqa: E731
    last = {"kind", "begin", "end", "position", "axis", "residual"}
    return Found(
        **{
            f: (v if f == "overflow" else v[..., begin:end] if f in last else jax.tree.map(by_lane, v))
            for f, v in found._asdict().items()
        }
    )


def _moving(joints: Joints) -> int:
    """Room for moving joints: one, or a multiple of eight."""
    n = joints.moving.shape[0]
    return 1 if n <= 1 else 8 * -(-n // 8)


def _fixed(joints: Joints, room: int) -> Joints:
    """Moving joints filled up by repeating the first: to set it twice changes nothing."""
    n = joints.moving.shape[0]
    if n == room:
        return joints
    again = np.concatenate([np.arange(n), np.zeros(room - n, int)])
    return joints._replace(moving=np.asarray(joints.moving)[again], translated=np.asarray(joints.translated)[again])
