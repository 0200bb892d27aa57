"""Step 6: instantaneous constraints merged into constraints (paper, section 7 and appendix B).

In: the kind of every displacement of every object, and where its constraint lies. Out: merged spans. Consecutive
displacements at rest are one constraint by definition, so they are encoded as runs in parallel over time; the scan in
time order then steps over the few runs (and single line displacements), all objects side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..bits import Bits, bits_after, bits_before, counted, counts_at, packed_bits, true_positions
from ..numerics import CHUNK, at_frames, in_chunks, safe_divide, safe_norm
from ..rotations import cross, dot
from .instantaneous import LINE, NONE, POINT, SPACE


class Tolerance(NamedTuple):
    """When two constraints are one: `max_gap` (displacements, `Fmax`), `max_jump` (m, `d_max`), `max_missing`
    (displacements), `alpha_max` (rad), `dist_max` (m)."""

    max_gap: Int[Array, ""]
    max_jump: Float[Array, ""]
    max_missing: Int[Array, ""]
    alpha_max: Float[Array, ""]
    dist_max: Float[Array, ""]


class Elements(NamedTuple):
    """What the scan steps over, (capacity, objects): kind, first and last displacement, where it begins and ends, its axis.

    `fails`: failing valid displacements before it (an element has none). `gone`: invalid ones before the first, and up to the last.
    """

    kind: Int[Array, "capacity objects"]
    first: Int[Array, "capacity objects"]
    last: Int[Array, "capacity objects"]
    start: Float[Array, "3 capacity objects"]
    stop: Float[Array, "3 capacity objects"]
    axis: Float[Array, "3 capacity objects"]
    fails: Int[Array, "capacity objects"]
    gone: Int[Array, "2 capacity objects"]


Find = Callable[[Any, int], Elements]
"""Elements by the number of the first one and how many are wanted."""


class Spans(NamedTuple):
    """Merged constraints in time order, (slots, objects): kind (`NONE`: an empty slot), first and last displacement."""

    kind: Int[Array, "slots objects"]
    first: Int[Array, "slots objects"]
    last: Int[Array, "slots objects"]


def frame_tolerance(
    distance: Float[Array, "..."], most: Int[Array, "..."], reach: Float[Array, ""]
) -> Int[Array, "..."]:
    """`ftol(d) = floor(Fmax^(1 - d/d_max))` (appendix B) in explicit branches: `Fmax` at 0, 1 at `d_max`, 0 beyond, and
    0 for a distance that is not a number."""
    most_f = most.astype(distance.dtype)
    inner = jnp.floor(most_f ** (1 - safe_divide(distance, reach)))
    inner = jnp.clip(inner, 1, most_f).astype(jnp.int32)
    return jnp.where(distance <= 0, most, jnp.where(distance <= reach, inner, 0))


def absorb_short_rests(
    kind: Int[Array, "objects n"], least: Int[Array, ""]
) -> tuple[Int[Array, "objects n"], Bool[Array, "objects n"]]:
    """Space runs shorter than `least` that touch a line displacement are no constraint and no gap; also where they were."""
    n = kind.shape[-1]
    at = jnp.arange(n, dtype=jnp.int32)
    space = kind == SPACE
    before = jnp.concatenate([jnp.zeros_like(space[:, :1]), space[:, :-1]], -1)
    after = jnp.concatenate([space[:, 1:], jnp.zeros_like(space[:, :1])], -1)
    first = jax.lax.cummax(jnp.where(space & ~before, at, 0), axis=1)
    last = jax.lax.cummin(jnp.where(space & ~after, at, n - 1), axis=1, reverse=True)

    def is_line(i: Array) -> Array:
        inside = (i >= 0) & (i < n)
        return inside & (jnp.take_along_axis(kind, jnp.clip(i, 0, n - 1), axis=1) == LINE)

    absorbed = space & (last - first + 1 < least) & (is_line(first - 1) | is_line(last + 1))
    return jnp.where(absorbed, NONE, kind), absorbed


class Runs(NamedTuple):
    """Displacements that carry a constraint, and where elements begin and end."""

    carry: Bits
    begin: Bits
    end: Bits


def runs(kind: Int[Array, "objects n"], lines: bool) -> Runs:
    """Runs of consecutive space displacements, and every single line displacement."""
    space = packed_bits(kind == SPACE)
    begin, end = space & ~bits_before(space), space & ~bits_after(space)
    if not lines:
        return Runs(space, begin, end)
    line = packed_bits(kind == LINE)
    return Runs(space | line, begin | line, end | line)


Where = Callable[[Int[Array, "k objects"]], tuple[Float[Array, "k objects"], ...]]
"""The components of a vector at some displacements of each object."""


def elements(
    kind: Int[Array, "objects n"],
    runs: Runs,
    countable: Bits,
    missing: Bits,
    start: Where,
    stop: Where,
    axis: Where | None = None,
) -> tuple[Find, Int[Array, " objects"]]:
    """What lies between each begin and end of `runs`, in time order: a function of the first one's number and of how many,
    since fetching all that there is room for costs more than the few that there are; and their number.

    countable: displacements that make a gap longer when they carry no constraint. missing: those that were not seen.
    start, stop: where a displacement's constraint lies at its begin and at its end.
    """
    n = kind.shape[-1]
    begins, ends = counted(runs.begin), counted(runs.end)
    failed, lost = counted(countable & ~runs.carry), counted(missing)

    def find(begin: int | Int[Array, ""], most: int) -> Elements:
        first, _ = true_positions(begins, most, begin)
        last, _ = true_positions(ends, most, begin)
        i, j = jnp.minimum(first, n - 1), jnp.minimum(last, n - 1)
        begun, ended = jnp.stack(start(i.T)), jnp.stack(stop(j.T))
        return Elements(
            jnp.where((first < n).T, at_frames(kind, i.T).astype(jnp.int32), NONE),
            i.T,
            j.T,
            begun,
            ended,
            jnp.zeros_like(begun) if axis is None else jnp.stack(axis(i.T)),
            counts_at(failed, i).T,
            jnp.stack([counts_at(lost, i).T, counts_at(lost, j).T]),
        )

    return find, begins.until[:, -1]


def merge(find: Find, total: Int[Array, " objects"], capacity: int, tolerance: Tolerance, lines: bool) -> Spans:
    """The pass in time order: each element joins the open constraint or closes it. `lines=False`: all are space.

    Of more than `capacity` elements the first ones.
    """
    most = jnp.max(total, initial=0)
    return (_merged_in_order if lines else _merged_rests)(find, most, total.shape[0], capacity, tolerance)


def _merged_rests(find: Find, most: Int[Array, ""], objects: int, capacity: int, tolerance: Tolerance) -> Spans:
    """Rests only: whether one joins the rest before it depends on these two alone, so nothing has to wait for anything."""
    zero = jnp.zeros((1, objects), jnp.int32)

    def chunk(before: tuple[Array, ...], first: Int[Array, ""]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        items = find(first, CHUNK)
        new = items.kind != NONE, items.fails, items.gone[1], *items.stop
        some, fails, gone, *at = (jnp.concatenate([b, x[:-1]]) for b, x in zip(before, new, strict=True))
        gap = items.fails - fails
        distance = safe_norm(items.start - jnp.stack(at), axis=0)
        joins = some & (items.gone[0] - gone <= tolerance.max_missing) & (distance <= tolerance.max_jump)
        joins &= gap <= frame_tolerance(distance, tolerance.max_gap, tolerance.max_jump)
        return tuple(x[-1:] for x in new), (new[0], joins, items.first, items.last)

    start = (zero > 0, zero, zero, *(jnp.zeros((1, objects), tolerance.max_jump.dtype),) * 3)
    real, joins, first, last = in_chunks(chunk, start, capacity, most)[1]
    follows = jnp.concatenate([(real & joins)[1:], jnp.zeros((1, objects), bool)])
    begins, ends = (counted(packed_bits(x.T)) for x in (real & ~joins, real & ~follows))

    def pick(state: None, at: Int[Array, ""]) -> tuple[None, Spans]:
        (begin, total), (end, _) = true_positions(begins, CHUNK, at), true_positions(ends, CHUNK, at)
        begin, end = (jnp.minimum(x, capacity - 1).T for x in (begin, end))
        used = (at + jnp.arange(CHUNK, dtype=jnp.int32))[:, None] < total
        span = (jnp.take_along_axis(x, i, axis=0) for x, i in ((first, begin), (last, end)))
        return state, Spans(jnp.where(used, jnp.int32(SPACE), jnp.int32(NONE)), *span)

    return in_chunks(pick, None, capacity, most)[1]


def _merged_in_order(find: Find, most: Int[Array, ""], objects: int, capacity: int, tolerance: Tolerance) -> Spans:
    """Lines among them: what a constraint has become decides what joins it."""
    zero3 = jnp.zeros((3, objects), tolerance.max_jump.dtype)
    zero = jnp.zeros(objects, jnp.int32)

    def step(open_: Any, new: Any) -> tuple[Any, Any]:
        kind, first, last, at, axis, fails, gone = open_
        n_kind, n_first, n_last, n_start, n_stop, n_axis, n_fails, n_gone = new
        gap = n_fails - fails
        connected = (n_gone[0] - gone <= tolerance.max_missing) & (kind != NONE)
        apart = n_start - at
        distance = safe_norm(apart, axis=0)
        reach = gap <= frame_tolerance(distance, tolerance.max_gap, tolerance.max_jump)
        joins = (kind == SPACE) & (n_kind == SPACE) & reach & (distance <= tolerance.max_jump)
        normal = cross(axis, n_axis)
        sine = safe_norm(normal, axis=0)
        parallel = jnp.arctan2(sine, jnp.abs(dot(axis, n_axis))) < tolerance.alpha_max
        beside = safe_norm(cross(apart, axis), axis=0)
        skew = jnp.abs(safe_divide(dot(apart, normal), sine))
        # feet of the common perpendicular of two lines that are not parallel
        s = safe_divide(dot(cross(apart, n_axis), normal), sine**2)
        u = safe_divide(dot(cross(apart, axis), normal), sine**2)
        crossing = (at + s * axis + n_start + u * n_axis) / 2
        from_point = safe_norm(cross(apart, n_axis), axis=0)
        d = jnp.where(kind == POINT, from_point, jnp.where(parallel, beside, skew))
        near = (d <= tolerance.dist_max) & (gap <= frame_tolerance(d, tolerance.max_gap, tolerance.max_jump))
        joins |= ((kind == LINE) | (kind == POINT)) & (n_kind == LINE) & near
        meets = (kind == POINT) | ((kind == LINE) & ~parallel)
        becomes = jnp.where(n_kind == SPACE, SPACE, jnp.where(meets, POINT, LINE))
        point = jnp.where(kind == POINT, at, jnp.where((n_kind == LINE) & meets, crossing, n_stop))
        joins &= connected
        real = n_kind != NONE
        closes = real & ~joins
        out = jnp.where(closes, kind, NONE), first, last
        state = (
            jnp.where(real, jnp.where(joins, becomes, n_kind), kind),
            jnp.where(closes, n_first, first),
            jnp.where(real, n_last, last),
            jnp.where(real, jnp.where(joins, point, n_stop), at),
            jnp.where(real, n_axis, axis),
            jnp.where(real, n_fails, fails),
            jnp.where(real, n_gone[1], gone),
        )
        return state, out

    def chunk(state: Any, first: Int[Array, ""]) -> tuple[Any, Any]:
        items = find(first, CHUNK)
        start, stop, axis, gone = (jnp.moveaxis(x, 1, 0) for x in (items.start, items.stop, items.axis, items.gone))
        along = *items[:3], start, stop, axis, items.fails, gone
        return jax.lax.scan(step, state, along)

    start = (jnp.full_like(zero, NONE), zero, zero, zero3, zero3, zero, zero)
    state, out = in_chunks(chunk, start, capacity, most)
    return packed(Spans(*(jnp.concatenate([o, s[None]]) for o, s in zip(out, state[:3], strict=True))), most)


def packed(spans: Spans, count: Int[Array, ""]) -> Spans:
    """Empty slots last, order kept; at most `count` are used, and the last slot goes: there is one more than elements."""
    slots = spans.kind.shape[0] - 1
    used = counted(packed_bits(spans.kind.T != NONE))

    def chunk(state: None, first: Int[Array, ""]) -> tuple[None, Spans]:
        at, total = true_positions(used, CHUNK, first)
        kind, begin, end = (jnp.take_along_axis(x, jnp.minimum(at, slots).T, axis=0) for x in spans)
        rank = first + jnp.arange(CHUNK, dtype=jnp.int32)
        return state, Spans(jnp.where(rank[:, None] < total, kind, NONE), begin, end)

    return in_chunks(chunk, None, slots, count)[1]
