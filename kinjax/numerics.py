"""Small numerical tools with a defined value and a finite gradient everywhere.

In: arrays of any shape. Out: the same, with the hard spots (0, inf, empty, one zero row in a batch) handled by
substituting *before* an operation and selecting *after* it, so that neither value nor gradient ever sees the bad operand.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def eps_of(x: Float[Array, "..."]) -> float:
    """Machine epsilon of `x`'s dtype."""
    return float(jnp.finfo(x.dtype).eps)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root; 0 with gradient 0 where `x <= 0`. NaN stays NaN."""
    positive = ~(x <= 0)
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x))


def safe_norm(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm along `axis`; 0 with gradient 0 at 0. Scaled by the largest component: neither over- nor underflows."""
    if x.shape[axis] == 0:
        return jnp.zeros(x.shape[:axis] + x.shape[axis % x.ndim + 1 :], x.dtype)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    usable = (largest > 0) & jnp.isfinite(largest)
    scale = jnp.where(usable, largest, jnp.ones_like(largest))
    return jnp.squeeze(scale, axis) * safe_sqrt(jnp.sum((x / scale) ** 2, axis=axis))


def safe_divide(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """`a / b`; 0 with gradient 0 where `b` is 0."""
    usable = b != 0
    return jnp.where(usable, a / jnp.where(usable, b, jnp.ones_like(b)), jnp.zeros_like(a / jnp.ones_like(b)))


def order_statistic(x: Float[Array, "... n"], mask: Bool[Array, "... n"], rank: Int[Array, "..."]) -> Float[Array, "..."]:
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


def running_count(flags: Bool[Array, "... n"]) -> Int[Array, "... n"]:
    """Inclusive running count along the last axis, by blocks: one short scan inside blocks, one over blocks."""
    n = flags.shape[-1]
    block = 64
    padded = jnp.pad(flags.astype(jnp.float32), [(0, 0)] * (flags.ndim - 1) + [(0, -n % block)])
    blocks = padded.reshape(*flags.shape[:-1], -1, block)
    inside = blocks @ jnp.triu(jnp.ones((block, block), jnp.float32))  # exact: counts up to 64
    before = jnp.cumsum(inside[..., -1].astype(jnp.int32), axis=-1)
    before = before - inside[..., -1].astype(jnp.int32)
    return (inside.astype(jnp.int32) + before[..., None]).reshape(*flags.shape[:-1], -1)[..., :n]


def bucket(n: int, smallest: int = 64) -> int:
    """The next array length from 64, 80, 96, 112, 128, 160, ...: four sizes an octave, so at most a fifth is padding."""
    size = smallest
    while size * 2 <= n:
        size *= 2
    quarter = size // 4
    return size if n <= size else size + quarter * -(-(n - size) // quarter)
