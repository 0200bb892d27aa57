"""A smooth order statistic: the value at which a smoothed count of the values reaches a level.

In: non-negative values with weights. Out: the root `q` of `sum_j w_j S((q - v_j) / D) = level`, `S` the quintic smoothstep and
`D = width + temperature q` its half width. It starts from the exact order statistic, which is never further than `D` away,
so a few safeguarded Newton steps find it; its derivative is that of the implicit function, in closed form, so it costs one
pass in forward mode and one in reverse, whatever the search took. As `D` goes to 0 it tends to the order statistic.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..numerics import SLICES, order_statistic
from .steps import smoothstep, smoothstep_slope

STEPS = 60
"""Most steps of the search; four or five are usual, bisection alone needs as many as a number has bits."""


def smooth_quantile(
    values: Float[Array, "... n"],
    weights: Bool[Array, "... n"] | Float[Array, "... n"],
    level: Float[Array, "..."],
    width: Float[Array, ""],
    temperature: Float[Array, ""],
) -> Float[Array, "..."]:
    """The value at which the smoothed count reaches `level`, along the last axis.

    values: non-negative, of any unit. weights: in [0, 1], each value's share in the count, or a mask; values of weight 0 may
    be anything, NaN too. level: the `h`-th smallest of equally weighted values is at level `h - 1/2`, the median
    (`N//2 + 1`-th) of any weights that sum to `N` at `N/2 + 1/4`. width: in the values' unit, >= 0; temperature: the same
    as a share of the result, in [0, 1). The two add up. All but a mask are differentiable, to any order the quintic allows.

    0 with gradient 0 where the weights sum to no more than the level (all masked, one value short). Ties share a gradient.
    """
    mask = weights.dtype == jnp.bool_
    given = (weights if mask else weights > 0) & jnp.isfinite(values)
    safe = jnp.where(given, values, jnp.zeros_like(values))
    share = given if mask else jnp.where(given, weights, 0)
    return _quantile(safe, share, level, width, temperature)


def _scale(q: Array, values: Array, width: Array, temperature: Array) -> Array:
    """The half width; never 0, however the data ties."""
    tiny = jnp.finfo(values.dtype).eps * jax.lax.stop_gradient(jnp.max(values, axis=-1, initial=0))
    tiny = jnp.where(tiny > 0, tiny, jnp.ones_like(tiny))
    return jnp.maximum(width + temperature * q, tiny)


@jax.custom_jvp
def _quantile(values: Array, weights: Array, level: Array, width: Array, temperature: Array) -> Array:
    dtype = values.dtype
    level = jnp.broadcast_to(level, values.shape[:-1])
    if weights.dtype == jnp.bool_:
        rank = jnp.ceil(level).astype(jnp.int32) - 1
        total = jnp.sum(weights, axis=-1, dtype=jnp.int32).astype(dtype)
        hard = order_statistic(values, weights, jnp.maximum(rank, 0))
        hard, slack = jnp.where(jnp.isnan(hard), 0, hard), jnp.zeros_like(hard)
        share = weights.astype(dtype)
    else:
        total = jnp.sum(weights, axis=-1)
        hard, slack = _weighted_order_statistic(values, weights, level)
        share = weights
    enough = (total > level) & (level > 0)
    eps = jnp.finfo(dtype).eps
    # every value up to `hard` is counted in full at `high`, none from it on at `low`
    low = jnp.maximum((hard - width) / (1 + temperature), 0)
    high = (hard + slack + width) / (1 - temperature) * (1 + 4 * eps)
    close = 8 * eps * jnp.maximum(total, 1)

    def search(state: Any) -> Any:
        i, q, low, high, _ = state
        half = _scale(q, values, width, temperature)
        x = (q[..., None] - values) / half[..., None]
        excess = jnp.sum(share * smoothstep(x), axis=-1) - level
        slope = jnp.sum(share * smoothstep_slope(x) * (1 - temperature * jnp.clip(x, -1, 1)), axis=-1)
        low, high = jnp.where(excess <= 0, q, low), jnp.where(excess >= 0, q, high)
        step = q - excess * half / jnp.where(slope > 0, slope, 1)
        middle = low + (high - low) / 2
        good = (slope > 0) & (step > low) & (step < high)
        done = (jnp.abs(excess) <= close) | (high - low <= 2 * eps * high) | ~enough
        return i + 1, jnp.where(done, q, jnp.where(good, step, middle)), low, high, done

    def more(state: Any) -> Any:
        return (state[0] < STEPS) & ~jnp.all(state[4])

    start = jnp.int32(0), hard, low, high, jnp.zeros(hard.shape, bool)
    return jnp.where(enough, jax.lax.while_loop(more, search, start)[1], 0)


@_quantile.defjvp
def _quantile_jvp(primals: Any, tangents: Any) -> Any:
    values, weights, level, width, temperature = primals
    d_values, d_weights, d_level, d_width, d_temperature = tangents
    q = _quantile(*primals)
    level = jnp.broadcast_to(level, q.shape)
    half = _scale(q, values, width, temperature)
    x = jnp.clip((q[..., None] - values) / half[..., None], -1, 1)
    share = weights.astype(values.dtype)
    slope = share * smoothstep_slope(x)
    turn = jnp.sum(slope * (1 - temperature * x), axis=-1)
    usable = (turn > 0) & (jnp.sum(share, axis=-1) > level) & (level > 0)
    moved = jnp.sum(slope * d_values, axis=-1) + jnp.sum(slope * x, axis=-1) * (d_width + q * d_temperature)
    counted = d_level
    if weights.dtype != jnp.bool_:
        counted = counted - jnp.sum(smoothstep(x) * d_weights, axis=-1)
    change = (moved + half * counted) / jnp.where(usable, turn, 1)
    return q, jnp.where(usable, change, 0)


def _weighted_order_statistic(values: Array, weights: Array, level: Array) -> tuple[Array, Array]:
    """The smallest value up to which the weights sum to `level`, and how far above it may be (0 in float32).

    As `numerics.order_statistic`, bit by bit, with sums in place of counts; only the first 32 bits are looked at.
    """
    bits, integer = (32, jnp.int32) if values.dtype == jnp.float32 else (64, jnp.int64)
    keys = jax.lax.bitcast_convert_type(jnp.abs(values), integer)
    short = -keys.shape[-1] % SLICES
    if short:
        room = [(0, 0)] * (keys.ndim - 1) + [(0, short)]
        keys, weights = jnp.pad(keys, room), jnp.pad(weights, room)
    parts = list(zip(jnp.split(keys, SLICES, axis=-1), jnp.split(weights, SLICES, axis=-1), strict=True))

    def refine(i: Array, low: Array) -> Array:
        trial = low | (jnp.ones((), integer) << (jnp.asarray(bits - 2, integer) - i.astype(integer)))
        sums = functools.reduce(jnp.add, (jnp.where(k < trial[..., None], w, 0) for k, w in parts))
        return jnp.where(jnp.sum(sums, axis=-1) < level, trial, low)

    found = jax.lax.fori_loop(0, 31, refine, jnp.zeros(values.shape[:-1], integer))
    value = jax.lax.bitcast_convert_type(found, values.dtype)
    finite = jnp.isfinite(value)
    value = jnp.where(finite, value, 0)
    return value, value * (0.0 if bits == 32 else 2.0**-19)
