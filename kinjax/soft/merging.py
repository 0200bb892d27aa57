"""Soft merging: from how much each displacement passes to how much it belongs to a constraint (paper, section 7, appendix B).

In: pass probabilities of one object's displacements, where each begins and ends. Out: `SoftMerge`, and from it labels of
frames. The soft merge is the *expectation of the hard merge when every displacement passes independently* with its own
probability: two passing displacements that follow each other with `g` valid failing ones between become one constraint with the
probability that their distance allows, and then all in between is labelled. It is exact for any bits, and equal to the hard
merge where the probabilities are 0 and 1 and the distances clear.

The hard rule `g <= ftol(d) = floor(Fmax^(1 - d/d_max))` is, for a gap `g >= 1`, the same as `d <= d_max (1 - ln g / ln Fmax)`:
one distance for each gap, which is softened.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..components import Parts
from ..numerics import running_count, shifted
from ..rotations import dot
from .steps import within


class SoftMerge(NamedTuple):
    """For each displacement: how much it is `covered` by a constraint, how much one covers both it and its successor
    (`joined`), and how much it is the first (`begins`) and the last (`ends`) of one."""

    covered: Float[Array, " n"]
    joined: Float[Array, " n"]
    begins: Float[Array, " n"]
    ends: Float[Array, " n"]


def soft_merge(
    passed: Float[Array, " n"],
    valid: Bool[Array, " n"],
    start: Parts,
    stop: Parts,
    max_gap: int,
    max_jump: Float[Array, ""],
    max_missing: int,
    temperature: Float[Array, ""],
) -> SoftMerge:
    """The expected merge of one object's displacements.

    passed: probabilities, 0 where not `valid`. start, stop: where each lies at its begin and its end, three components (n,), metres.
    max_gap (`Fmax`) and max_missing: displacements, whole numbers that shape the program. max_jump (`d_max`): metres.

    Missing displacements are left out of the sequence: they make no gap longer, and at most `max_missing` of them are bridged.
    O(n max_gap).
    """
    n = passed.shape[0]
    at = jnp.arange(n, dtype=jnp.int32)
    count = jnp.sum(valid, dtype=jnp.int32)

    def straight(x: Any) -> SoftMerge:
        p, a, b = x
        return _merge_in_sequence(p, at, a, b, max_gap, max_jump, max_missing, temperature)

    def around_gaps(x: Any) -> SoftMerge:
        rank = running_count(valid) - 1
        # where the valid ones are, in order; what is left over points at the last displacement and has probability 0
        place = jnp.full(n, n - 1, jnp.int32).at[jnp.where(valid, rank, n)].set(at, mode="drop")
        p, a, b = jax.tree.map(lambda y: y[place], x)
        dense = _merge_in_sequence(
            jnp.where(at < count, p, 0), place, a, b, max_gap, max_jump, max_missing, temperature
        )
        known = rank >= 0
        covered, joined, begins, ends = (jnp.where(known, y[jnp.maximum(rank, 0)], 0) for y in dense)
        return SoftMerge(
            jnp.where(valid, covered, joined), joined, jnp.where(valid, begins, 0), jnp.where(valid, ends, 0)
        )

    # usually only what follows the clip's end is missing: then nothing has to be moved
    whole = jnp.all(valid == (at < count))
    return jax.lax.cond(whole, straight, around_gaps, (passed, start, stop))


def _reaches(max_gap: int) -> np.ndarray:
    """How far apart, as a share of `d_max`, two displacements with 0, 1, ..., `max_gap` failing ones between may be."""
    gaps = np.maximum(np.arange(max_gap + 1), 1)
    return 1 - np.log(gaps) / np.log(max(max_gap, 2)) if max_gap > 1 else np.ones(max_gap + 1)


def _merge_in_sequence(
    p: Array,
    index: Int[Array, " n"],
    start: Parts,
    stop: Parts,
    max_gap: int,
    max_jump: Array,
    max_missing: int,
    temperature: Array,
) -> SoftMerge:
    """The merge of displacements that follow each other in the given order, `index` being the place that each has in time."""
    n, room = p.shape[0], max_gap + 1
    later_p = jnp.concatenate([p, jnp.zeros(room, p.dtype)])
    later_i = jnp.concatenate([index, jnp.broadcast_to(index[-1:], room)])
    later_x = [jnp.concatenate([x, jnp.broadcast_to(x[-1:], room)]) for x in start]
    reach = jnp.asarray(_reaches(max_gap), p.dtype) * max_jump

    def step(fails: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        g, far = x
        take = lambda y: jax.lax.dynamic_slice(y, (g + 1,), (n,))  # noqa: E731
        other, missing = take(later_p), take(later_i) - index - g - 1
        apart = [take(x) - y for x, y in zip(later_x, stop, strict=True)]
        near = jnp.where(missing <= max_missing, within(dot(apart, apart), far, temperature), 0)
        near = jnp.where((g == 0) & (missing <= 0), 1, near)  # neighbours are one constraint by definition
        return fails * (1 - other), p * fails * other * near

    gaps = jnp.arange(room, dtype=jnp.int32)
    _, pairs = jax.lax.scan(step, jnp.ones_like(p), (gaps, reach))

    # h: joined to the next one across a gap of at least g. An edge is covered by those that began u <= g before it
    def cover(state: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
        h, covered = state
        h = h + pair
        return (h, h + shifted(covered, -1)), None

    zero = jnp.zeros_like(p)
    (h, joined), _ = jax.lax.scan(cover, (zero, zero), pairs, reverse=True)
    covered = p + joined - h
    return SoftMerge(covered, joined, covered - shifted(joined, -1), p - h)


def frames_and_edges(merged: SoftMerge, low: int, high: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """How much each frame is in a constraint, and how much it and its successor are in the same one.

    A displacement `i` stands for the frames `i + low .. i + high`, `high - low` being 0 or 1.
    """
    if high == low:
        return shifted(merged.covered, -low), shifted(merged.joined, -low)
    # in either of two neighbours: both of them are covered only by one and the same constraint
    either = merged.covered + shifted(merged.covered - merged.joined, -1)
    return shifted(either, -low), shifted(merged.covered, -low)


def soft_opening(frames: Float[Array, " n"], edges: Float[Array, " n"], least: int) -> Float[Array, " n"]:
    """Labels of frames without constraints shorter than `least` steps from frame to frame (an opening, softly).

    edges: how much a frame and its successor are in one constraint. A frame stays as far as one of the `least + 1` windows of
    `least` edges that touch it holds throughout: `frames (1 - prod(1 - prod(edges)))`. It never adds to a label.
    """
    whole = _window_product(edges, least, 0.0)
    none = _window_product(shifted(1 - whole, -least, 1.0), least + 1, 1.0)
    return frames * (1 - none)


def _window_product(x: Array, size: int, beyond: float) -> Array:
    """`y[i]`: product of `x[i .. i + size - 1]`, by doubling; `beyond` what stands after the end."""
    power, length, out, done = x, 1, None, 0
    while True:
        if size & length:
            out = power if out is None else out * shifted(power, done, beyond)
            done += length
        length *= 2
        if length > size:
            return jnp.ones_like(x) if out is None else out
        power = power * shifted(power, length // 2, beyond)
