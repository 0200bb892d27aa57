"""Step 6: instantaneous constraints merged into constraints (paper, section 7 and appendix B).

In: the kind of every displacement of every object, and where its constraint lies. Out: merged spans. Consecutive
displacements at rest are one constraint by definition, so they are encoded as runs in parallel over time; the scan in
time order then steps over the few runs (and single line displacements), all objects side by side.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..numerics import Bits, bits_after, bits_before, counts_at, packed_bits, safe_divide, safe_norm, true_positions
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

    `fails` and `gone`: failing valid, and invalid, displacements before the first and up to the last one (two rows each).
    `overflow` (objects,): how many elements there are in all; more than the capacity means that some are not here.
    """

    kind: Int[Array, "capacity objects"]
    first: Int[Array, "capacity objects"]
    last: Int[Array, "capacity objects"]
    start: Float[Array, "3 capacity objects"]
    stop: Float[Array, "3 capacity objects"]
    axis: Float[Array, "3 capacity objects"]
    fails: Int[Array, "2 capacity objects"]
    gone: Int[Array, "2 capacity objects"]
    total: Int[Array, " objects"]


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


def runs(kind: Int[Array, "objects n"]) -> tuple[Bits, Bits]:
    """Where elements begin and end: runs of consecutive space displacements, and every single line displacement."""
    space, line = packed_bits(kind == SPACE), packed_bits(kind == LINE)
    return (space & ~bits_before(space)) | line, (space & ~bits_after(space)) | line


def elements(
    kind: Int[Array, "objects n"],
    bounds: tuple[Bits, Bits],
    counted: Bool[Array, "objects n"],
    missing: Bool[Array, "objects n"],
    start: Float[Array, "3 objects n"],
    stop: Float[Array, "3 objects n"],
    axis: Float[Array, "3 objects n"] | None,
    capacity: int,
) -> Elements:
    """What lies between each begin and end of `bounds`, in time order.

    counted: displacements that make a gap longer when they carry no constraint. missing: those that were not seen.
    start, stop: where a displacement's constraint lies at its begin and at its end.
    """
    n = kind.shape[-1]
    first, total = true_positions(bounds[0], capacity)
    last, _ = true_positions(bounds[1], capacity)
    failed, lost = packed_bits(counted & (kind == NONE)), packed_bits(missing)
    real = first < n
    i, j = jnp.minimum(first, n - 1), jnp.minimum(last, n - 1)

    def take(x: Array, at: Array) -> Array:
        return jnp.take_along_axis(x, at, axis=-1)

    def take3(x: Array, at: Array) -> Array:
        return jnp.take_along_axis(x, jnp.broadcast_to(at, (3, *at.shape)), axis=-1)

    lanes = lambda x: jnp.moveaxis(x, -1, -2)  # noqa: E731  (objects, capacity) -> (capacity, objects)
    return Elements(
        lanes(jnp.where(real, take(kind, i), NONE)),
        lanes(i),
        lanes(j),
        lanes(take3(start, i)),
        lanes(take3(stop, j)),
        lanes(take3(axis, i) if axis is not None else jnp.zeros((3, *i.shape), start.dtype)),
        lanes(jnp.stack([counts_at(failed, i), counts_at(failed, j)])),
        lanes(jnp.stack([counts_at(lost, i), counts_at(lost, j)])),
        total,
    )


def merge(items: Elements, tolerance: Tolerance, lines: bool) -> Spans:
    """The pass in time order: each element joins the open constraint or closes it. `lines=False` drops what only lines need."""
    objects = items.kind.shape[1]
    dtype = items.start.dtype
    zero3 = jnp.zeros((3, objects), dtype)
    zero = jnp.zeros(objects, jnp.int32)

    def step(open_: Any, new: Any) -> tuple[Any, Any]:
        kind, first, last, at, axis, fails, gone = open_
        n_kind, n_first, n_last, n_start, n_stop, n_axis, n_fails, n_gone = new
        gap = n_fails[0] - fails
        connected = (n_gone[0] - gone <= tolerance.max_missing) & (kind != NONE)
        apart = n_start - at
        distance = safe_norm(apart, axis=0)
        reach = gap <= frame_tolerance(distance, tolerance.max_gap, tolerance.max_jump)
        joins = (kind == SPACE) & (n_kind == SPACE) & reach & (distance <= tolerance.max_jump)
        becomes, point = jnp.full_like(kind, SPACE), n_stop
        if lines:
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
            jnp.where(real, n_fails[1], fails),
            jnp.where(real, n_gone[1], gone),
        )
        return state, out

    xs = (
        items.kind,
        items.first,
        items.last,
        jnp.moveaxis(items.start, 1, 0),
        jnp.moveaxis(items.stop, 1, 0),
        jnp.moveaxis(items.axis, 1, 0),
        jnp.moveaxis(items.fails, 1, 0),
        jnp.moveaxis(items.gone, 1, 0),
    )
    start = (jnp.full_like(zero, NONE), zero, zero, zero3, zero3, zero, zero)
    state, out = scan_as_far(step, start, xs, jnp.max(items.total, initial=0))
    return packed(Spans(*(jnp.concatenate([o, s[None]]) for o, s in zip(out, state[:3], strict=True))))


CHUNK = 32
"""Steps that `scan_as_far` takes at once."""


def scan_as_far(step: Any, start: Any, xs: Any, count: Int[Array, ""]) -> tuple[Any, Any]:
    """`jax.lax.scan` over the first `count` elements (rounded up to a chunk): room for many costs nothing where there are few.

    What lies beyond is not visited; its outputs are 0.
    """
    capacity = jax.tree.leaves(xs)[0].shape[0]
    if capacity % CHUNK:
        return jax.lax.scan(step, start, xs)
    chunks = jax.tree.map(lambda x: x.reshape(-1, CHUNK, *x.shape[1:]), xs)
    one = jax.tree.map(lambda x: x[0], chunks)
    like = jax.eval_shape(lambda s, x: jax.lax.scan(step, s, x)[1], start, one)
    out = jax.tree.map(lambda y: jnp.zeros((capacity // CHUNK, *y.shape), y.dtype), like)

    def chunk(i: Int[Array, ""], carried: Any) -> Any:
        state, out = carried
        here = jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, i, 0, keepdims=False), chunks)
        state, new = jax.lax.scan(step, state, here)
        return state, jax.tree.map(lambda o, n: jax.lax.dynamic_update_index_in_dim(o, n, i, 0), out, new)

    needed = jnp.minimum((count + CHUNK - 1) // CHUNK, capacity // CHUNK)
    state, out = jax.lax.fori_loop(0, needed, chunk, (start, out))
    return state, jax.tree.map(lambda y: y.reshape(capacity, *y.shape[2:]), out)


def packed(spans: Spans) -> Spans:
    """Empty slots last, order kept."""
    slots = spans.kind.shape[0]
    at, total = true_positions(packed_bits(spans.kind.T != NONE), slots)
    at = jnp.minimum(at, slots - 1).T
    kind, first, last = (jnp.take_along_axis(x, at, axis=0) for x in spans)
    return Spans(jnp.where(jnp.arange(slots, dtype=jnp.int32)[:, None] < total, kind, NONE), first, last)
