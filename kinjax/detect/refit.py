"""The refit: what is stationary over a whole span of frames, in closed form, with its residual.

In: poses and which span each frame belongs to. Out: moments, and from them the pivot, the axis and the residual. For
weights w over the frames of a span, with means `Rbar`, `tbar` and `u = mean(R^T t)`, the mean squared motion of body point
`p` is `E(p) = p^T M p + 2 b^T p + c`, `M = I - Rbar^T Rbar`, `b = u - Rbar^T tbar`, `c = mean|t|^2 - |tbar|^2`. Its
minimum is the pivot, the null space of `M` the axis. Positions are taken from an origin near the span, so float32 suffices.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..numerics import running_count, safe_divide, safe_norm, safe_sqrt
from ..rotations import matrix


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
            self.n, self.r, self.t + self.n * by, self.u + jnp.sum(self.r * by[:, None], axis=0),
            self.tt + 2 * jnp.sum(by * self.t, axis=0) + self.n * jnp.sum(by * by, axis=0),
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
    u = jnp.sum(r * d[:, None], axis=0)
    rows = jnp.concatenate([jnp.ones_like(d[:1]), r.reshape(9, *d.shape[1:]), d, u, jnp.sum(d * d, 0)[None]])
    return jnp.where(weight > 0, rows * weight, 0)


def span_moments(
    q: Float[Array, "4 objects frames"], t: Float[Array, "3 objects frames"], valid: Bool[Array, "objects frames"],
    begin: Int[Array, "spans objects"], end: Int[Array, "spans objects"], used: Bool[Array, "spans objects"],
) -> tuple[Moments, Float[Array, "3 spans objects"]]:
    """Moments of spans in time order that share no frame but one's last with the next one's first; and their origins.

    Positions are taken from the object's place at the span's first frame. Unused slots come last; their moments are 0.
    """
    slots, objects = begin.shape
    frames = valid.shape[-1]
    lane = jnp.broadcast_to(jnp.arange(objects, dtype=jnp.int32), begin.shape)
    starts = jnp.zeros((objects, frames + 1), bool).at[lane, jnp.where(used, begin, frames)].set(True)[:, :frames]
    span = jnp.clip(running_count(starts) - 1, 0, slots - 1)
    inside = jnp.arange(frames, dtype=jnp.int32) < jnp.take_along_axis(jnp.where(used, end, 0).T, span, axis=1)
    inside &= (jnp.cumsum(used, axis=0, dtype=jnp.int32)[-1] > 0)[:, None] & (
        jnp.arange(frames, dtype=jnp.int32) >= jnp.take_along_axis(begin.T, span, axis=1)
    )
    span = jnp.where(inside, span, slots)
    weight = valid.astype(t.dtype)

    def at(x: Array, frame: Array) -> Array:
        index = jnp.broadcast_to(jnp.where(used, frame, 0).T, (*x.shape[:-2], objects, slots))
        return jnp.take_along_axis(x, index, axis=-1)

    origin = at(t, begin)
    o = jnp.take_along_axis(origin, jnp.broadcast_to(jnp.minimum(span, slots - 1), t.shape), axis=-1)
    rows = _rows(q, t - o, weight)
    total = jax.vmap(lambda x, i: jax.ops.segment_sum(x.T, i, slots + 1), in_axes=(1, 0))(rows, span)
    s = jnp.moveaxis(total[:, :slots], -1, 0)
    s = s + _rows(at(q, end), at(t, end) - origin, jnp.where(used.T, at(weight, end), 0))  # the last frame may be the next one's first
    s = jnp.swapaxes(s, -1, -2)
    return Moments(s[0], s[1:10].reshape(3, 3, *s.shape[1:]), s[10:13], s[13:16], s[16]), jnp.swapaxes(origin, -1, -2)


def quadratic(x: Moments) -> Quadratic:
    """The mean squared motion of every body point."""
    n = jnp.maximum(x.n, 1)
    r, t, u = x.r / n, x.t / n, x.u / n
    eye = jnp.eye(3, dtype=t.dtype).reshape(3, 3, *([1] * x.n.ndim))
    m = eye - jnp.sum(r[:, :, None] * r[:, None, :], axis=0)
    b = u - jnp.sum(r * t[:, None], axis=0)
    return Quadratic(m, b, x.tt / n - jnp.sum(t * t, axis=0), r, t)


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
    eye = jnp.eye(3, dtype=e.c.dtype).reshape(3, 3, *([1] * e.c.ndim))
    p = -solve_symmetric(e.m + ridge * eye, e.b)
    return jnp.maximum(e.c + jnp.sum(e.b * p, axis=0), 0), p


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
    values, vectors = jnp.linalg.eigh(batch)
    shape = x.n.shape
    values = jnp.moveaxis(values, -1, 0).reshape(3, *shape)
    vectors = jnp.moveaxis(vectors, 0, -1).reshape(3, 3, *shape)  # columns: eigenvectors
    floor = 32 * jnp.finfo(values.dtype).eps
    line = (values[0] <= jnp.minimum(line_below, ratio * values[1])) | (values[0] <= noise)
    along = jnp.sum(vectors * e.b[:, None], axis=0)
    solid = (values > floor).at[0].set((values[0] > floor) & ~line)  # along its axis a line's pivot is free
    inverse = jnp.where(solid, 1 / jnp.where(solid, values, 1), 0)
    p = -jnp.sum(vectors * (inverse * along)[None], axis=1)
    energy = jnp.maximum(e.c - jnp.sum(inverse * along**2, axis=0), 0)
    point = jnp.sum(e.r * p[None], axis=1) + e.t
    axis = jnp.sum(e.r * vectors[:, 0][None], axis=1)
    axis = safe_divide(axis, safe_norm(axis, axis=0))
    nearest = point + axis * jnp.sum(axis * (e.t - point), axis=0)
    return Fit(
        values, jnp.where(line, nearest, point), axis, safe_sqrt(energy), e.t, safe_sqrt(jnp.maximum(e.c, 0)), line
    )
