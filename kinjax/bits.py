"""Flags of a clip's frames packed 32 to a word: what looks at their runs reads a thirty-second of the memory.

In: flags by lane and frame. Out: words, and from them neighbours, places and counts of true flags.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from .numerics import running_sum

Bits = UInt32[Array, "lanes words"]
"""Flags packed 32 to a word, the first in the lowest bit."""


def packed_bits(flags: Bool[Array, "lanes n"]) -> Bits:
    """32 flags a word, the first in the lowest bit.

    Four flags are the four bytes of a word, which one product brings together in its highest byte. Missing flags at the end
    are False.
    """
    lanes, n = flags.shape
    whole = flags if n % 32 == 0 else jnp.pad(flags, [(0, 0), (0, -n % 32)])
    fours = jax.lax.bitcast_convert_type(whole.astype(jnp.uint8).reshape(lanes, -1, 4), jnp.uint32)
    eights = ((fours * jnp.uint32(0x01020408)) >> jnp.uint32(24)).reshape(lanes, -1, 8)
    parts = (eights[..., k] << jnp.uint32(4 * k) for k in range(8))
    return functools.reduce(jnp.bitwise_or, parts)


def bits_before(words: Bits) -> Bits:
    """Each flag's predecessor (False before the first)."""
    above = jnp.concatenate([jnp.zeros_like(words[:, :1]), words[:, :-1]], axis=1)
    return (words << jnp.uint32(1)) | (above >> jnp.uint32(31))


def bits_after(words: Bits) -> Bits:
    """Each flag's successor (False after the last)."""
    below = jnp.concatenate([words[:, 1:], jnp.zeros_like(words[:, :1])], axis=1)
    return (words >> jnp.uint32(1)) | (below << jnp.uint32(31))


class Flags(NamedTuple):
    """Packed flags, and how many are true up to each word's end, and before its begin."""

    words: Bits
    until: Int[Array, "lanes words"]
    before: Int[Array, "lanes words"]


def counted(words: Bits) -> Flags:
    """Flags ready to be counted (exact up to 2^24): once, where a loop looks things up in them."""
    own = jax.lax.population_count(words).astype(jnp.int32)
    until = running_sum(own.astype(jnp.float32)).astype(jnp.int32)
    return Flags(words, until, until - own)


def true_positions(
    flags: Flags, most: int, first: int | Int[Array, ""] = 0
) -> tuple[Int[Array, "lanes most"], Int[Array, " lanes"]]:
    """Indices of `most` true flags of each lane from number `first` on (beyond the last word where there are fewer), and the
    number of all."""
    words, until, before = flags
    rank = first + jnp.arange(1, most + 1, dtype=jnp.int32)
    block = jnp.sum(until[:, None, :] < rank[:, None], axis=-1, dtype=jnp.int32)
    found = jnp.minimum(block, words.shape[-1] - 1)
    left = rank - jnp.take_along_axis(before, found, axis=1)
    word = jnp.take_along_axis(words, found, axis=1)
    upto = (jnp.uint32(2) << jnp.arange(32, dtype=jnp.uint32)) - jnp.uint32(1)  # masks of the lowest 1, 2, ..., 32 bits
    seen = jax.lax.population_count(word[..., None] & upto).astype(jnp.int32)
    place = found * jnp.asarray(32, jnp.int32) + jnp.sum(seen < left[..., None], axis=-1, dtype=jnp.int32)
    total = until[:, -1]
    return jnp.where(rank <= total[:, None], place, jnp.asarray(32 * words.shape[-1], jnp.int32)), total


def counts_at(flags: Flags, index: Int[Array, "lanes k"]) -> Int[Array, "lanes k"]:
    """How many flags are true up to each index, that one included."""
    words, _, before = flags
    block, bit = index // 32, (index % 32).astype(jnp.uint32)
    upto = (jnp.uint32(2) << bit) - jnp.uint32(1)
    own = jax.lax.population_count(jnp.take_along_axis(words, block, axis=1) & upto).astype(jnp.int32)
    return jnp.take_along_axis(before, block, axis=1) + own
