"""The refit: what is stationary over a whole span of frames, in closed form, with its residual.

In: poses and which span each frame belongs to. Out: moments, and from them the pivot, the axis and the residual. For
weights w over the frames of a span, with means `Rbar`, `tbar` and `u = mean(R^T t)`, the mean squared motion of body point
`p` is `E(p) = p^T M p + 2 b^T p + c`, `M = I - Rbar^T Rbar`, `b = u - Rbar^T tbar`, `c = mean|t|^2 - |tbar|^2`. Its
minimum is the pivot, the null space of `M` the axis. Positions are taken from an origin near the span, so float32 suffices.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..bits import bits_between, counted, counts_at, packed_bits, unpacked_bits
from ..numerics import CHUNK, in_chunks, running_count, running_sum, running_sum_at, safe_divide, safe_norm, safe_sqrt
from ..rotations import apply, apply_transposed, dot, matrix


class Moments(NamedTuple):
    """Sums over the frames of spans: weight `n`, `r` (3, 3), `t` (3), `u` = R^T t (3), `tt` = |t|^2; components first."""

    n: Float[Array, "..."]
    r: Float[Array, "3 3 ..."]
    t: Float[Array, "3 ..."]
    u: Float[Array, "3 ..."]
    tt: Float[Array, "..."]

    def moved(self, by: Float[Array, "3 ..."]) -> Moments:
        """The same sums with every position larger by `by`."""
        return Moments(
            self.n,
            self.r,
            self.t + self.n * by,
            self.u + apply_transposed(self.r, by),
            self.tt + 2 * dot(by, self.t) + self.n * dot(by, by),
        )

    def plus(self, other: Moments) -> Moments:
        """Sums of both, about the same origin."""
        return jax.tree.map(jnp.add, self, other)


class Quadratic(NamedTuple):
    """`E(p) = p^T M p + 2 b^T p + c` and the means it came from."""

    m: Float[Array, "3 3 ..."]
    b: Float[Array, "3 ..."]
    c: Float[Array, "..."]
    r: Float[Array, "3 3 ..."]
    t: Float[Array, "3 ..."]


def _rows(q: Float[Array, "4 ..."], d: Float[Array, "3 ..."], weight: Float[Array, "..."]) -> Float[Array, "17 ..."]:
    """One frame's contribution to `Moments`."""
    r = matrix(q)
    u = apply_transposed(r, d)
    rows = jnp.concatenate([jnp.ones_like(d[:1]), r.reshape(9, *d.shape[1:]), d, u, dot(d, d)[None]])
    return jnp.where(weight > 0, rows * weight, 0)


class _Layout(NamedTuple):
    """Which `span` each frame is in (their count: none), frames from begin to the last but one; each span's `origin`."""

    span: Int[Array, "objects frames"]
    inside: Bool[Array, "objects frames"]
    origin: Float[Array, "3 objects spans"]
    shifted: Float[Array, "3 objects frames"]


def _at(x: Array, frame: Int[Array, "spans objects"]) -> Array:
    """Values of (..., objects, frames) arrays at each span's `frame`: (..., objects, spans)."""
    return jnp.take_along_axis(x, jnp.broadcast_to(frame.T, (*x.shape[:-1], frame.shape[0])), axis=-1)


def _layout(t: Array, valid: Array, begin: Array, end: Array, used: Array) -> _Layout:
    slots, objects = begin.shape
    frames = valid.shape[-1]
    lane = jnp.broadcast_to(jnp.arange(objects, dtype=jnp.int32), begin.shape)
    starts = jnp.zeros((objects, frames + 1), bool).at[lane, jnp.where(used, begin, frames)].set(True)[:, :frames]
    span = running_count(starts) - 1
    ended = jnp.take_along_axis(jnp.where(used, end, 0).T, jnp.clip(span, 0, slots - 1), axis=1)
    inside = valid & (span >= 0) & (jnp.arange(frames, dtype=jnp.int32) < ended)
    span = jnp.clip(span, 0, slots - 1)
    origin = _at(t, jnp.where(used, begin, 0))
    return _Layout(span, inside, origin, t - jnp.take_along_axis(origin, jnp.broadcast_to(span, t.shape), axis=-1))


class Place(NamedTuple):
    """Mean world position of the object's origin over spans (3, spans, objects), and the root mean square distance to it."""

    center: Float[Array, "3 spans objects"]
    spread: Float[Array, "spans objects"]


def span_places(
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    begin: Int[Array, "spans objects"],
    end: Int[Array, "spans objects"],
    used: Bool[Array, "spans objects"],
) -> Place:
    """Refit of space constraints: running sums are enough, and no frame is gathered. Spans as for `span_moments`.

    Each frame's origin is a running sum of the steps from one span's first place to the next one's; which frames are inside one,
    and how many of them were seen, are questions of bits.
    """
    objects, frames = valid.shape
    slots, nothing = begin.shape[0], jnp.zeros((objects, frames), t.dtype)
    seen = packed_bits(valid)
    none = jnp.zeros_like(seen)
    begins, ends = jnp.where(used, begin, 0), jnp.where(used, end, 0)
    before = jnp.concatenate([begins[:1], begins])[:slots]  # where the span before begins
    count = jnp.max(jnp.sum(used, axis=0, dtype=jnp.int32), initial=0)
    lane, one = jnp.broadcast_to(jnp.arange(objects, dtype=jnp.int32), (CHUNK, objects)), jnp.uint32(1)
    rows = lambda x, first: jax.lax.dynamic_slice_in_dim(x, first, CHUNK, 0)  # noqa: E731

    def mark(carried: tuple[Array, ...], at: Int[Array, ""]) -> tuple[tuple[Array, ...], None]:
        begun, ended, *steps = carried
        here, earlier, real = rows(begins, at), rows(before, at), rows(used, at)
        first, until = jnp.where(real, here, frames), rows(ends, at)
        some = until > here  # of these no two begin, or end, at one frame: bits can be added
        begun, ended = (
            bits.at[lane, jnp.where(some, x // 32, seen.shape[-1])].add(one << (x % 32).astype(jnp.uint32), mode="drop")
            for bits, x in ((begun, here), (ended, until))
        )
        is_first = (at + jnp.arange(CHUNK, dtype=jnp.int32) == 0)[:, None]
        for i, x in enumerate(t):
            step = jnp.where(real, _at(x, here).T - jnp.where(is_first, 0, _at(x, earlier).T), 0)
            steps[i] = steps[i].at[lane, first].add(step, mode="drop")
        return (begun, ended, *steps), None

    (begun, ended, *steps), _ = in_chunks(mark, (none, none, nothing, nothing, nothing), slots, count)
    inside = unpacked_bits(seen & bits_between(begun ^ ended), frames)
    path = [running_sum(s) for s in steps]
    d = [x - y for x, y in zip(t, path, strict=True)]
    sums = [running_sum_at(jnp.where(inside, x, 0)) for x in (*d, dot(d, d))]
    seen_until = counted(seen)

    def place(state: None, at: Int[Array, ""]) -> tuple[None, tuple[Array, ...]]:
        first, last, real = rows(begins, at), rows(ends, at), rows(used, at)
        origin = [_at(x, first).T for x in path]
        end_d = [_at(x, last).T - o for x, o in zip(t, origin, strict=True)]
        ending = *end_d, dot(end_d, end_d)  # the last frame may be the next span's first
        earlier, until = jnp.maximum(first - 1, 0).T, jnp.maximum(last - 1, 0).T
        with_last, after_first = _at(valid, last).T, first > 0

        def total(sums: Callable[[Array], Array], ending: Array) -> Array:
            between = jnp.where(real, sums(until).T - jnp.where(after_first, sums(earlier).T, 0), 0)
            return between + jnp.where(with_last, ending, 0)

        *moments, square = (total(x, y) for x, y in zip(sums, ending, strict=True))
        number = counts_at(seen_until, last.T) - jnp.where(after_first.T, counts_at(seen_until, earlier), 0)
        n = jnp.maximum(number.T.astype(t.dtype), 1)
        center = [x / n for x in moments]
        spread = safe_sqrt(jnp.maximum(square / n - dot(center, center), 0))
        return state, (*(x + o for x, o in zip(center, origin, strict=True)), spread)

    *center, spread = in_chunks(place, None, slots, count)[1]
    return Place(jnp.stack(center), spread)


def span_moments(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    begin: Int[Array, "spans objects"],
    end: Int[Array, "spans objects"],
    used: Bool[Array, "spans objects"],
) -> tuple[Moments, Float[Array, "3 spans objects"]]:
    """Moments of spans in time order that share no frame but one's last with the next one's first; and their origins.

    Positions are taken from the object's place at the span's first frame. Unused slots come last; their moments are 0.
    """
    slots = begin.shape[0]
    x = _layout(t, valid, begin, end, used)
    rows = _rows(q, x.shifted, valid.astype(t.dtype))
    span = jnp.where(x.inside, x.span, slots)
    total = jax.vmap(lambda r, i: jax.ops.segment_sum(r.T, i, slots + 1), in_axes=(1, 0))(rows, span)
    s = jnp.moveaxis(total[:, :slots], -1, 0)
    last = jnp.where(used, end, 0)
    weight = jnp.where(used.T, _at(valid, last), False).astype(t.dtype)
    s = s + _rows(_at(q, last), _at(t, last) - x.origin, weight)  # the last frame may be the next one's first
    s = jnp.swapaxes(s, -1, -2)
    return Moments(s[0], s[1:10].reshape(3, 3, *s.shape[1:]), s[10:13], s[13:16], s[16]), jnp.swapaxes(x.origin, -1, -2)


def quadratic(x: Moments) -> Quadratic:
    """The mean squared motion of every body point."""
    n = jnp.maximum(x.n, 1)
    r, t, u = x.r / n, x.t / n, x.u / n
    m = jnp.stack([jnp.stack([(1 if i == j else 0) - dot(r[:, i], r[:, j]) for j in range(3)]) for i in range(3)])
    return Quadratic(m, u - apply_transposed(r, t), x.tt / n - dot(t, t), r, t)


def solve_symmetric(m: Float[Array, "3 3 ..."], b: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """`m^-1 b` for positive definite 3 x 3 matrices, by cofactors: no library call, so it vectorises."""
    (a, d, e), (_, f, g), (_, _, h) = m
    c00, c01, c02 = f * h - g * g, e * g - d * h, d * g - e * f
    c11, c12, c22 = a * h - e * e, d * e - a * g, a * f - d * d
    det = a * c00 + d * c01 + e * c02
    x, y, z = b
    return safe_divide(
        jnp.stack([c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z]), det[None]
    )


def pivot_energy(e: Quadratic, ridge: Float[Array, ""]) -> tuple[Float[Array, "..."], Float[Array, "3 ..."]]:
    """Mean squared motion that the best pivot leaves, `c - b^T (M + ridge I)^-1 b`, and that body point."""
    m = jnp.stack([e.m[i].at[i].add(ridge) for i in range(3)])
    p = -solve_symmetric(m, e.b)
    return jnp.maximum(e.c + dot(e.b, p), 0), p


@jax.custom_jvp
def _eigen(m: Float[Array, "n 3 3"]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Eigenvalues, ascending, and eigenvectors (columns); where two values coincide, as at rest, their vectors count as constant."""
    values, vectors = jnp.linalg.eigh(m)
    return values, vectors


@_eigen.defjvp
def _eigen_change(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    values, vectors = _eigen(*primals)
    symmetric = (tangents[0] + jnp.swapaxes(tangents[0], 1, 2)) / 2
    inner = jnp.matmul(jnp.matmul(jnp.swapaxes(vectors, 1, 2), symmetric, precision="highest"), vectors, precision="highest")
    gap = values[:, None, :] - values[:, :, None]
    apart = jnp.abs(gap) > 32 * jnp.finfo(values.dtype).eps
    mixed = jnp.where(apart, inner / jnp.where(apart, gap, 1), 0)
    change = jnp.diagonal(inner, axis1=1, axis2=2), jnp.matmul(vectors, mixed, precision="highest")
    return (values, vectors), change


class Fit(NamedTuple):
    """Refitted constraint: `eigenvalues` of `M` ascending (3, ...), world `point` (from the origin of the moments), unit
    world `axis`, root mean square `residual` of the pivot and `spread` of the object's origin about its mean `center`."""

    eigenvalues: Float[Array, "3 ..."]
    point: Float[Array, "3 ..."]
    axis: Float[Array, "3 ..."]
    residual: Float[Array, "..."]
    center: Float[Array, "3 ..."]
    spread: Float[Array, "..."]
    is_line: Bool[Array, "..."]


def fit(x: Moments, line_below: Float[Array, "..."], noise: Float[Array, "..."], ratio: float) -> Fit:
    """Pivot or axis of each span. A line where the smallest eigenvalue of `M` is at most `line_below` and at most `ratio`
    times the middle one, or at most `noise`; else a point.

    Of a line, the point of the axis nearest the mean origin of the object.
    """
    e = quadratic(x)
    batch = jnp.moveaxis(e.m.reshape(3, 3, -1), -1, 0)
    values, vectors = _eigen(batch)
    shape = x.n.shape
    values = jnp.moveaxis(values, -1, 0).reshape(3, *shape)
    vectors = jnp.moveaxis(vectors, 0, -1).reshape(3, 3, *shape)  # columns: eigenvectors
    floor = 32 * jnp.finfo(values.dtype).eps
    line = (values[0] <= jnp.minimum(line_below, ratio * values[1])) | (values[0] <= noise)
    along = apply_transposed(vectors, e.b)
    solid = (values > floor).at[0].set((values[0] > floor) & ~line)  # along its axis a line's pivot is free
    inverse = jnp.where(solid, 1 / jnp.where(solid, values, 1), 0)
    p = -apply(vectors, inverse * along)
    energy = jnp.maximum(e.c - dot(inverse * along, along), 0)
    point = apply(e.r, p) + e.t
    axis = apply(e.r, vectors[:, 0])
    axis = safe_divide(axis, safe_norm(axis, axis=0))
    nearest = point + axis * dot(axis, e.t - point)
    return Fit(
        values, jnp.where(line, nearest, point), axis, safe_sqrt(energy), e.t, safe_sqrt(jnp.maximum(e.c, 0)), line
    )
