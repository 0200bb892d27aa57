"""The refit: what is stationary over a whole span of frames, in closed form, with its residual.

In: poses and which span each frame belongs to. Out: moments, and from them the pivot, the axis and the residual. For
weights w over the frames of a span, with means `Rbar`, `tbar` and `u = mean(R^T t)`, the mean squared motion of body point
`p` is `E(p) = p^T M p + 2 b^T p + c`, `M = I - Rbar^T Rbar`, `b = u - Rbar^T tbar`, `c = mean|t|^2 - |tbar|^2`. Its
minimum is the pivot, the null space of `M` the axis. Positions are taken from an origin near the span, so float32 suffices.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..bits import counted, counts_at, packed_bits
from ..components import Parts
from ..numerics import CHUNK, at_frames, in_chunks, running_count, running_sum, safe_divide, safe_norm, safe_sqrt
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
    return jnp.take_along_axis(x, jnp.broadcast_to(frame.T, (*x.shape[:-1], frame.shape[0])), axis=-1, mode="promise_in_bounds")


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


PART = 8
"""Frames whose places are added up once for all spans."""


class PartMoments(NamedTuple):
    """Of each `PART` frames of each object: how many were seen, their `mean` place (3), and the sum of squared distances to it."""

    number: Float[Array, "objects parts"]
    mean: Parts
    square: Float[Array, "objects parts"]


def part_moments(t: Float[Array, "3 objects frames"] | Parts, valid: Bool[Array, "objects frames"]) -> PartMoments:
    """`t` is 0 where nothing is `valid`; frames are whole words of bits."""
    seen, part = packed_bits(valid), jnp.uint32(2**PART - 1)
    counts = [jax.lax.population_count((seen >> jnp.uint32(k)) & part) for k in range(0, 32, PART)]
    number = jnp.stack(counts, axis=-1).reshape(valid.shape[0], -1).astype(t[0].dtype)

    # added up one by one: XLA's own reduction of so short rows takes several times as long
    rows = lambda x: [x.reshape(*number.shape, PART)[..., i] for i in range(PART)]  # noqa: E731
    total = functools.partial(functools.reduce, jnp.add)
    mean = tuple(total(rows(x)) / jnp.maximum(number, 1) for x in t)
    apart = ([x - m for x in rows(y)] for y, m in zip(t, mean, strict=True))
    return PartMoments(number, mean, total(jnp.where(v, dot(d, d), 0) for v, *d in zip(rows(valid), *apart, strict=True)))


class Place(NamedTuple):
    """Mean world position of the object's origin over spans (3, spans, objects), and the root mean square distance to it."""

    center: Float[Array, "3 spans objects"]
    spread: Float[Array, "spans objects"]


def span_places(
    t: Float[Array, "3 objects frames"] | Parts,
    valid: Bool[Array, "objects frames"],
    begin: Int[Array, "spans objects"],
    end: Int[Array, "spans objects"],
    used: Bool[Array, "spans objects"],
) -> Place:
    """Refit of space constraints, of places that are 0 where nothing is `valid`. Spans as for `span_moments`.

    A span takes the parts that lie inside it as they are, and goes through its first and last part frame by frame. Distances are
    never longer than a span is wide, so float32 suffices.
    """
    number, mean, square = part_moments(t, valid)
    (objects, parts), slots = number.shape, begin.shape[0]
    counts = counted(packed_bits(valid))

    # the parts inside of spans, and what each is measured from, which is where its span begins: running sums of steps
    begins, ends = jnp.where(used, begin, 0), jnp.where(used, end, 0)
    before = jnp.concatenate([begins[:1], begins])[:slots]  # where the span before begins
    count = jnp.max(jnp.sum(used, axis=0, dtype=jnp.int32), initial=0)
    lane = jnp.broadcast_to(jnp.arange(objects, dtype=jnp.int32), (CHUNK, objects))
    rows = lambda x, first: jax.lax.dynamic_slice_in_dim(x, first, CHUNK, 0)  # noqa: E731
    take = jax.vmap(lambda x, i: x.at[i[:, 0]].get(mode="promise_in_bounds"))
    whole = lambda x, part: take(x.reshape(objects, parts, PART), part)  # noqa: E731

    def mark(marks: tuple[Array, ...], at: Int[Array, ""]) -> tuple[tuple[Array, ...], None]:
        *steps, switches = marks
        here, earlier, real = rows(begins, at), rows(before, at), rows(used, at)
        first, last = here // PART + 1, rows(ends, at) // PART
        is_first = (at + jnp.arange(CHUNK, dtype=jnp.int32) == 0)[:, None]
        place = lane, jnp.where(real, first, parts)
        for k, x in enumerate(t):
            step = at_frames(x, here) - jnp.where(is_first, 0, at_frames(x, earlier))
            steps[k] = steps[k].at[place].add(step, mode="drop")
        some = real & (last > first)
        switches = switches.at[lane, jnp.where(some, first, parts)].add(1, mode="drop")
        switches = switches.at[lane, jnp.where(some, last, parts)].add(-1, mode="drop")
        return (*steps, switches), None

    nothing = jnp.zeros_like(number)
    *path, inside = (running_sum(x) for x in in_chunks(mark, (nothing,) * 4, slots, count)[0])
    off = [jnp.where(inside > 0, m - x, 0) for m, x in zip(mean, path, strict=True)]
    sums = [running_sum(number * x) for x in off]
    sums.append(running_sum(jnp.where(inside > 0, square, 0) + number * dot(off, off)))

    def place(state: None, at: Int[Array, ""]) -> tuple[None, tuple[Array, ...]]:
        first, last = rows(begins, at), rows(ends, at)
        begun, ended = first // PART, last // PART
        some = ended > begun + 1
        follows = jnp.minimum(begun + 1, parts - 1)
        origin = [jnp.where(some, at_frames(y, follows), at_frames(x, first)) for x, y in zip(t, path, strict=True)]
        # the frames of the first part, and of the last if it is another; parts are fetched whole, which takes a third as long
        two = lambda x, y: jnp.concatenate([x, y]).T[..., None]  # noqa: E731  (objects, 2 CHUNK, 1)
        part = two(begun, ended)
        frame = PART * part + jnp.arange(PART, dtype=jnp.int32)
        mine = (frame >= two(first, PART * (begun + 1))) & (frame <= two(last, last)) & whole(valid, part)
        near = [jnp.where(mine, whole(x, part) - two(o, o), 0) for x, o in zip(t, origin, strict=True)]

        def total(x: Array) -> Array:  # XLA's own sum over so few numbers hands them to another thread
            each = functools.reduce(jnp.add, (x[..., i] for i in range(PART))).T
            return each[:CHUNK] + each[CHUNK:]

        between = [jnp.where(some, at_frames(x, jnp.maximum(ended - 1, 0)) - at_frames(x, begun), 0) for x in sums]
        *moments, squares = (total(x) + y for x, y in zip((*near, dot(near, near)), between, strict=True))
        seen_until = counts_at(counts, last.T) - jnp.where(first.T > 0, counts_at(counts, jnp.maximum(first.T - 1, 0)), 0)
        n = jnp.maximum(seen_until.T.astype(number.dtype), 1)
        center = [x / n for x in moments]
        spread = safe_sqrt(jnp.maximum(squares / n - dot(center, center), 0))
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
