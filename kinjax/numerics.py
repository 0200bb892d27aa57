"""Small numerical tools with a defined value and a finite gradient everywhere.

In: arrays of any shape. Out: the same, with the hard spots (0, inf, empty, one zero row in a batch) handled by
substituting *before* an operation and selecting *after* it, so that neither value nor gradient ever sees the bad operand.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

BLOCK = 32
"""Running sums work in blocks of so many; padded lengths are multiples of it (XLA pads slowly)."""


def eps_of(x: Float[Array, "..."]) -> float:
    """Machine epsilon of `x`'s dtype."""
    return float(jnp.finfo(x.dtype).eps)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root; 0 with gradient 0 where `x <= 0`. NaN stays NaN."""
    positive = ~(x <= 0)
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x))


def safe_norm(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm along `axis`; 0 with gradient 0 at 0. Scaled by the largest component: neither over- nor underflows.

    Components are added one by one, not by a reduction: a few long rows then run at the speed of memory.
    """
    n = x.shape[axis]
    if n == 0:
        return jnp.zeros(x.shape[:axis] + x.shape[axis % x.ndim + 1 :], x.dtype)
    parts = [jax.lax.index_in_dim(x, i, axis, keepdims=False) for i in range(n)]
    largest = jnp.abs(parts[0])
    for part in parts[1:]:
        largest = jnp.maximum(largest, jnp.abs(part))
    largest = jax.lax.stop_gradient(largest)
    usable = (largest > 0) & jnp.isfinite(largest)
    scale = jnp.where(usable, largest, jnp.ones_like(largest))
    shrink = 1 / scale
    squares = sum(((part * shrink) ** 2 for part in parts[1:]), (parts[0] * shrink) ** 2)
    return jnp.where(jnp.isfinite(largest), scale * safe_sqrt(squares), largest)


def safe_divide(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """`a / b`; 0 with gradient 0 where `b` is 0."""
    usable = b != 0
    return jnp.where(usable, a / jnp.where(usable, b, jnp.ones_like(b)), jnp.zeros_like(a / jnp.ones_like(b)))


def order_statistic(
    x: Float[Array, "... n"], mask: Bool[Array, "... n"], rank: Int[Array, "..."]
) -> Float[Array, "..."]:
    """The `rank`-th smallest (0-based) of the masked, **non-negative** values along the last axis, exactly.

    The bits of non-negative floats order as integers, so the value is found bit by bit, each by one counting pass: no sort
    (XLA's is slow on a CPU), no gather, any rank, any mask. NaN when fewer than `rank + 1` values are masked in.
    """
    bits, integer = (32, jnp.int32) if x.dtype == jnp.float32 else (64, jnp.int64)
    keys = jax.lax.bitcast_convert_type(jnp.abs(x), integer)
    keys = jnp.where(mask, keys, jnp.iinfo(integer).max)

    def refine(i: Int[Array, ""], low: Int[Array, "..."]) -> Int[Array, "..."]:
        trial = low | (jnp.ones((), integer) << (jnp.asarray(bits - 2, integer) - i.astype(integer)))
        below = jnp.sum(keys < trial[..., None], axis=-1, dtype=jnp.int32)
        return jnp.where(below <= rank, trial, low)

    found = jax.lax.fori_loop(0, bits - 1, refine, jnp.zeros(x.shape[:-1], integer))
    enough = jnp.sum(mask, axis=-1, dtype=jnp.int32) > rank
    value = jax.lax.bitcast_convert_type(found, x.dtype)
    return jnp.where(enough, value, jnp.full_like(value, jnp.nan))


def _blocks(x: Float[Array, "... n"]) -> tuple[Float[Array, "... blocks size"], Float[Array, "... blocks"]]:
    """Inclusive running sums inside blocks, and the sum before each block: a product with a triangle of ones, and a short
    scan over blocks (XLA's own cumulative sum takes a pass for every power of two)."""
    n = x.shape[-1]
    whole = x if n % BLOCK == 0 else jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -n % BLOCK)])
    blocks = whole.reshape(*x.shape[:-1], -1, BLOCK)
    inside = jnp.matmul(blocks, jnp.triu(jnp.ones((BLOCK, BLOCK), x.dtype)), precision="highest")
    total = inside[..., -1]
    return inside, jnp.cumsum(total, axis=-1) - total


def running_sum(x: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Inclusive running sum along the last axis."""
    inside, before = _blocks(x)
    return (inside + before[..., None]).reshape(*x.shape[:-1], -1)[..., : x.shape[-1]]


def running_count(flags: Bool[Array, "... n"]) -> Int[Array, "... n"]:
    """Inclusive running count along the last axis; exact up to 2^24."""
    return running_sum(flags.astype(jnp.float32)).astype(jnp.int32)


def true_positions(flags: Bool[Array, "lanes n"], most: int) -> tuple[Int[Array, "lanes most"], Int[Array, " lanes"]]:
    """Indices of the first `most` true flags of each lane (`n` or more where there are fewer), and how many there are.

    By rank: the block is looked up, then the place in it, so no running count of full length is written.
    """
    inside, before = _blocks(flags.astype(jnp.float32))
    rank = jnp.arange(1, most + 1, dtype=jnp.float32)
    until = before + inside[..., -1]
    block = jnp.sum(until[:, None, :] < rank[:, None], axis=-1, dtype=jnp.int32)
    found = jnp.minimum(block, until.shape[-1] - 1)
    row = jnp.take_along_axis(inside, found[..., None], axis=1)
    left = rank - jnp.take_along_axis(before, found, axis=1)
    place = found * jnp.asarray(BLOCK, jnp.int32) + jnp.sum(row < left[..., None], axis=-1, dtype=jnp.int32)
    total = until[..., -1].astype(jnp.int32)
    return jnp.where(rank.astype(jnp.int32) <= total[:, None], place, flags.shape[-1]), total


def counts_at(flags: Bool[Array, "lanes n"], index: Int[Array, "lanes k"]) -> Int[Array, "lanes k"]:
    """Inclusive running count of flags at some indices only."""
    inside, before = _blocks(flags.astype(jnp.float32))
    flat = inside.reshape(*inside.shape[:-2], -1)
    at = jnp.take_along_axis(flat, index, axis=-1) + jnp.take_along_axis(before, index // BLOCK, axis=-1)
    return at.astype(jnp.int32)


def bucket(n: int, smallest: int = 64) -> int:
    """The next array length from 64, 96, 128, 160, 192, 224, 256, 320, ...: from 128 on four sizes an octave, so at most a
    fifth of a long clip is padding. All are multiples of `BLOCK`."""
    size = smallest
    while size * 2 <= n:
        size *= 2
    step = max(BLOCK, size // 4)
    return size + step * max(0, -(-(n - size) // step))
