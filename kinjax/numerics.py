"""Small numerical tools with a defined value and a finite gradient everywhere.

In: arrays of any shape. Out: the same, with the hard spots (0, inf, empty, one zero row in a batch) handled by
substituting *before* an operation and selecting *after* it, so that neither value nor gradient ever sees the bad operand.
Besides: running sums, and ways to have XLA compute a thing once, row by row, or for as many rows as there are.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .lengths import BLOCK

SLICES = 16


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
    short = -keys.shape[-1] % SLICES
    if short:
        keys = jnp.pad(keys, [(0, 0)] * (keys.ndim - 1) + [(0, short)], constant_values=jnp.iinfo(integer).max)
    slices = jnp.split(keys, SLICES, axis=-1)

    def refine(i: Int[Array, ""], low: Int[Array, "..."]) -> Int[Array, "..."]:
        trial = low | (jnp.ones((), integer) << (jnp.asarray(bits - 2, integer) - i.astype(integer)))
        # XLA does not vectorise a reduction to a count: slices are added up element by element, what is left is short
        counts = functools.reduce(jnp.add, ((part < trial[..., None]).astype(jnp.int32) for part in slices))
        below = jnp.sum(counts, axis=-1, dtype=jnp.int32)
        return jnp.where(below <= rank, trial, low)

    found = jax.lax.fori_loop(0, bits - 1, refine, jnp.zeros(x.shape[:-1], integer))
    enough = jnp.sum(mask, axis=-1, dtype=jnp.int32) > rank
    value = jax.lax.bitcast_convert_type(found, x.dtype)
    return jnp.where(enough, value, jnp.full_like(value, jnp.nan))


def shifted(x: Array, s: int, fill: float | bool = 0) -> Array:
    """`y[..., i] = x[..., i + s]`, `fill` where that is outside."""
    if s == 0:
        return x
    n = x.shape[-1]
    s = max(-n, min(n, s))
    pad = jnp.full((*x.shape[:-1], abs(s)), fill, x.dtype)
    return jnp.concatenate([x[..., s:], pad] if s > 0 else [pad, x[..., :s]], axis=-1)


def running_sum(x: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Inclusive running sum along the last axis: inside blocks by a product with a triangle of ones, and a short scan over blocks
    (XLA's own cumulative sum takes a pass for every power of two)."""
    n = x.shape[-1]
    whole = x if n % BLOCK == 0 else jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -n % BLOCK)])
    blocks = whole.reshape(*x.shape[:-1], -1, BLOCK)
    inside = jnp.matmul(blocks, jnp.triu(jnp.ones((BLOCK, BLOCK), x.dtype)), precision="highest")
    total = inside[..., -1]
    before = jnp.cumsum(total, axis=-1) - total
    return (inside + before[..., None]).reshape(*x.shape[:-1], -1)[..., :n]


def running_count(flags: Bool[Array, "... n"]) -> Int[Array, "... n"]:
    """Inclusive running count along the last axis; exact up to 2^24."""
    return running_sum(flags.astype(jnp.float32)).astype(jnp.int32)


def over_rows(f: Callable[[Array], Array], rows: Array) -> Array:
    """`f` on every row of the first axis, `f` being one that broadcasts: all at once while they are small (fewer steps of a
    loop), one by one when they are not (they stay in cache)."""
    return f(rows) if rows.size <= 1 << 16 else jax.lax.map(f, rows)


def computed_once(x: Any, never: Bool[Array, ""]) -> Any:
    """`x`, which is computed before anything reads it: else XLA computes it again inside each of its readers. (It removes
    optimization barriers on the CPU before it fuses.) `never` is a value that is False, which the compiler cannot know:
    what carries `x` is a loop that does not run."""

    def again(carried: Any) -> Any:
        return jax.tree.map(lambda y: jnp.roll(y, 1), carried[0]), carried[1]

    return jax.lax.while_loop(lambda carried: carried[1], again, (x, never))[0]


def at_frames(x: Array, index: Int[Array, "k lanes"]) -> Array:
    """`x` (lanes, n) at each lane's own places, of which all are inside: (k, lanes)."""
    return jnp.take_along_axis(x, index.T, axis=-1, mode="promise_in_bounds").T


CHUNK = 16
"""Rows that `in_chunks` takes at once."""


def in_chunks(step: Any, state: Any, rows: int, count: Int[Array, ""]) -> tuple[Any, Any]:
    """The last state and the outputs of `step(state, first) -> state, CHUNK rows` over the first `count` of `rows` rows: room
    for many costs nothing where there are few. `rows` is a multiple of `CHUNK`; the outputs of rows not visited are 0.
    """
    like = jax.eval_shape(step, state, jax.ShapeDtypeStruct((), jnp.int32))[1]
    out = jax.tree.map(lambda y: jnp.zeros((rows, *y.shape[1:]), y.dtype), like)

    def chunk(i: Int[Array, ""], carried: Any) -> Any:
        state, out = carried
        first = i * jnp.asarray(CHUNK, jnp.int32)
        state, new = step(state, first)
        return state, jax.tree.map(lambda o, n: jax.lax.dynamic_update_slice_in_dim(o, n, first, 0), out, new)

    needed = jnp.minimum((count + CHUNK - 1) // CHUNK, rows // CHUNK)
    return jax.lax.fori_loop(jnp.zeros_like(needed), needed, chunk, (state, out))
