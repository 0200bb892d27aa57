"""Where a rest really begins and ends: frames at its edges that are still in its place.

In: space spans of the robust method, raw and averaged poses. Out: the same spans, longer by the frames that the averaging
hid. A displacement of 40 ms between means of 40 ms passes only where all of it is at rest, so a rest that ends abruptly
loses as much at either end. A frame outside is in the place of the rest if its pose agrees with the mean pose at the edge
to the noise of the data plus 1 mm (at a lever of 0.1 m).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..numerics import safe_norm
from ..rotations import conjugate, multiply
from .merging import Spans

PLACE = 0.001
"""Metres (and radians times 0.1 m) by which a pose in the same place may differ, besides the noise."""


class Poses(NamedTuple):
    """`q` (4, objects, frames), `t` (3, objects, frames), `valid` (objects, frames)."""

    q: Float[Array, "4 objects frames"]
    t: Float[Array, "3 objects frames"]
    valid: Bool[Array, "objects frames"]


def settle(
    spans: Spans,
    raw: Poses,
    mean: Poses,
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]],
    span: int,
    most: int,
) -> Spans:
    """Each span with up to `most` more frames at either end, as long as each is seen and in the same place.

    The place is the mean pose at the inner end of the outermost displacement (of `span` frames), which was seen.
    """
    frames = raw.valid.shape[-1]
    offset = jnp.arange(1, most + 1, dtype=jnp.int32)

    def at(x: Array, index: Array) -> Array:
        flat = jnp.broadcast_to(index.reshape(index.shape[0], -1), (*x.shape[:-1], index[0].size))
        return jnp.take_along_axis(x, flat, axis=-1).reshape(*x.shape[:-1], *index.shape[1:])

    def frames_more(edge: Array, way: int) -> Array:
        lanes = edge.T[..., None]  # (objects, slots, 1)
        place = jnp.clip(lanes - way * (span - span // 2 if way < 0 else (span + 1) // 2), 0, frames - 1)
        index = lanes + way * offset
        inside = (index >= 0) & (index < frames)
        index = jnp.clip(index, 0, frames - 1)
        apart = at(raw.t, index) - at(mean.t, place)
        turned = 2 * safe_norm(multiply(at(raw.q, index), conjugate(at(mean.q, place)))[1:], axis=0)
        wide = lambda nu, allowed: (allowed + 2.5 * nu)[:, None, None]  # noqa: E731
        same = (safe_norm(apart, axis=0) <= wide(noise[0], PLACE)) & (turned <= wide(noise[1], PLACE / 0.1))
        grown = jnp.cumprod(same & inside & at(raw.valid, index), axis=-1, dtype=edge.dtype)
        return jnp.sum(grown, axis=-1, dtype=edge.dtype).T

    return Spans(spans.kind, spans.first - frames_more(spans.first, -1), spans.last + frames_more(spans.last, 1))
