"""Step 4: the noise pattern, from templates or from the data itself (paper, section 6; robust method's floor).

In: sigma-epsilon values over time and template spans. Out: control points `(frame, sigma_max, eps_max)` of each object,
and from them thresholds for every displacement. All for one object; the pipeline maps over objects.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..numerics import order_statistic, over_rows, safe_divide, safe_sqrt
from ..rotations import matrix
from ..splines import monotone_cubic, natural_cubic
from .lmeds import lmeds, naive
from .sigma_epsilon import FLOOR_EPS

UNREPRESENTATIVE, MOVING = 16, 32
"""More `Kept.status` bits: it would label most of the clip; its template moves faster than `cap`."""


class Spans(NamedTuple):
    """Template spans of one object and type: frames `begin..end` (P,), `used` where there is one."""

    begin: Int[Array, " p"]
    end: Int[Array, " p"]
    used: Bool[Array, " p"]


class Pattern(NamedTuple):
    """Noise pattern as control points. `frames, sigma, eps` (2P,), `size` of them used; counts and status by template (P,)."""

    frames: Float[Array, " c"]
    sigma: Float[Array, " c"]
    eps: Float[Array, " c"]
    size: Int[Array, ""]
    intervals: Int[Array, " p"]
    kept: Int[Array, " p"]
    status: Int[Array, " p"]


def data_noise(
    q: Float[Array, "4 objects frames"], t: Float[Array, "3 objects frames"], valid: Bool[Array, "objects frames"]
) -> tuple[Float[Array, " objects"], Float[Array, " objects"]]:
    """Noise of the data itself, `nu_t` in metres and `nu_r` in radians, from third differences.

    White noise of variance s^2 has third differences of variance 20 s^2 (1 + 9 + 9 + 1); a body's own motion has hardly any.
    Median absolute ones, so that contacts and spikes do not count. Summed over 3 position components, or over the 9 of the
    rotation matrix, whose Frobenius norm is `sqrt(2)` times the angle. 0 with fewer than four frames.
    """
    n = max(valid.shape[-1] - 3, 0)
    at = lambda x, k: x[..., k : k + n]  # noqa: E731  (slices of one array vectorise)
    four = at(valid, 0) & at(valid, 1) & at(valid, 2) & at(valid, 3)
    rank = (jnp.sum(four, axis=-1, dtype=jnp.int32) - 1) // 2

    def variance(x: Float[Array, "*rows objects frames"]) -> Float[Array, "*rows objects"]:
        third = at(x, 3) - 3 * at(x, 2) + 3 * at(x, 1) - at(x, 0)
        median = order_statistic(jnp.abs(third), four, jnp.maximum(rank, 0))
        return jnp.where(rank >= 0, (jnp.asarray(1.4826, x.dtype) * jnp.nan_to_num(median)) ** 2 / 20, 0)

    nu_t = safe_sqrt(jnp.sum(over_rows(variance, t), axis=0))
    nu_r = safe_sqrt(jnp.sum(over_rows(variance, matrix(q).reshape(9, *valid.shape)), axis=0) / 2)
    return nu_t, nu_r


def template_pattern(
    sigma: Float[Array, " n"],
    eps: Float[Array, " n"],
    valid: Bool[Array, " n"],
    spans: Spans,
    span: int,
    capacity: int,
    estimator: str,
    margin: Float[Array, ""],
    floor: tuple[Float[Array, ""], Float[Array, ""]],
    ceiling: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Pattern, Int[Array, " n"]]:
    """Pattern of one object from its templates, and the mark of each displacement (0 none, 1 kept, 2 rejected).

    A template's displacements are those that lie inside it: first frames `begin..end - span`, at most `capacity` of them.
    The median is taken on sigma; `eps_max` on the displacements that sigma kept. Thresholds are `margin` times the estimate,
    at least `floor`, at most `ceiling` (status bit `MOVING` where it cuts).
    """
    keep = {"lmeds": lmeds, "naive": naive}[estimator]
    n = sigma.shape[0]

    def one(begin: Array, end: Array, used: Array) -> tuple[Array, ...]:
        at = begin + jnp.arange(capacity, dtype=jnp.int32)
        inside = used & (at + span <= end) & (at < n)
        safe = jnp.minimum(at, n - 1)
        mask = inside & valid[safe]
        by_sigma = keep(sigma[safe], mask)
        by_eps = keep(eps[safe], by_sigma.kept)
        raw_sigma, raw_eps = margin * by_sigma.largest, margin * by_eps.largest
        status = by_sigma.status | jnp.where((raw_sigma > ceiling[0]) | (raw_eps > ceiling[1]), MOVING, 0)
        mark = jnp.where(mask, jnp.where(by_eps.kept, 1, 2), 0)
        return (
            jnp.clip(raw_sigma, floor[0], ceiling[0]),
            jnp.clip(raw_eps, floor[1], ceiling[1]),
            by_sigma.size,
            jnp.sum(by_eps.kept, dtype=jnp.int32),
            status,
            jnp.where(inside, at, n),
            mark,
        )

    sigma_max, eps_max, intervals, kept, status, at, mark = jax.vmap(one)(*spans)
    marks = jnp.zeros(n + 1, jnp.int32).at[at.reshape(-1)].max(mark.reshape(-1).astype(jnp.int32))[:n]
    pattern = control_points(spans, sigma_max, eps_max)
    return pattern._replace(intervals=intervals, kept=kept, status=status), marks


def template_spread(
    q: Float[Array, "4 frames"], t: Float[Array, "3 frames"], valid: Bool[Array, " frames"], spans: Spans, capacity: int
) -> Float[Array, ""]:
    """Root mean square distance, in metres at a lever of 0.1 m, of a body's poses from their mean over the template frames
    that the least median of squares keeps; the largest over the templates (window method)."""
    frames = t.shape[-1]

    def one(begin: Array, end: Array, used: Array) -> Array:
        at = begin + jnp.arange(capacity, dtype=jnp.int32)
        safe = jnp.minimum(at, frames - 1)
        mask = used & (at <= end) & (at < frames) & valid[safe]
        weight = mask.astype(t.dtype)
        n = jnp.maximum(jnp.sum(weight), 1)
        place = t[:, safe] - t[:, begin][:, None]
        r = matrix(q[:, safe])
        apart = place - jnp.sum(place * weight, -1, keepdims=True) / n
        turned = r - jnp.sum(r * weight, -1, keepdims=True) / n
        square = jnp.sum(apart**2, 0) + jnp.asarray(0.01 / 3, t.dtype) * jnp.sum(turned**2, (0, 1))
        kept = lmeds(safe_sqrt(square), mask).kept
        return safe_sqrt(safe_divide(jnp.sum(jnp.where(kept, square, 0)), jnp.sum(kept).astype(t.dtype)))

    return jnp.max(jax.vmap(one)(*spans))


def control_points(spans: Spans, sigma_max: Float[Array, " p"], eps_max: Float[Array, " p"]) -> Pattern:
    """Two control points a template, at its first and last frame (paper, section 6.2), in time order.

    Where one template ends on the frame on which the next begins, the two points become one with the larger values.
    """
    p = spans.begin.shape[0]
    far = jnp.iinfo(jnp.int32).max
    order = jnp.argsort(jnp.where(spans.used, spans.begin, far))
    begin, end, used = spans.begin[order], spans.end[order], spans.used[order]
    values = sigma_max[order], eps_max[order]
    touch = jnp.concatenate([(begin[1:] == end[:-1]) & used[1:] & used[:-1], jnp.zeros(1, bool)])
    frames = jnp.stack([begin, end], -1).reshape(-1)
    present = jnp.stack([used & ~jnp.concatenate([jnp.zeros(1, bool), touch[:-1]]), used], -1).reshape(-1)

    def doubled(v: Array) -> Array:
        after = jnp.maximum(v, jnp.concatenate([v[1:], v[-1:]]))
        return jnp.stack([v, jnp.where(touch, after, v)], -1).reshape(-1)

    slot = jnp.argsort(~present, stable=True)
    dtype = sigma_max.dtype
    none = jnp.zeros(p, jnp.int32)
    return Pattern(
        frames[slot].astype(dtype),
        doubled(values[0])[slot],
        doubled(values[1])[slot],
        jnp.sum(present, dtype=jnp.int32),
        none,
        none,
        none,
    )


def thresholds(
    pattern: Pattern, middle: Float[Array, " n"], interpolation: str, floor: tuple[Float[Array, ""], Float[Array, ""]]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """`sigma_max` and `eps_max` of every displacement: interpolated in time, constant outside, never below `floor`.

    Without control points the floor alone.
    """
    if is_constant(pattern):
        curves = [jnp.broadcast_to(v[0], middle.shape) for v in (pattern.sigma, pattern.eps)]
    else:
        curve = {"cubic": natural_cubic, "monotone": monotone_cubic}[interpolation]
        curves = [curve(middle, pattern.frames, v, pattern.size) for v in (pattern.sigma, pattern.eps)]
    some = pattern.size > 0
    return tuple(jnp.where(some, jnp.maximum(c, f), f) for c, f in zip(curves, floor, strict=True))  # type: ignore[return-value]


def is_constant(pattern: Pattern) -> bool:
    """Whether its thresholds do not change in time: one template's two control points carry one value."""
    return pattern.frames.shape[-1] <= 2


def no_pattern(like: Float[Array, " objects"]) -> Pattern:
    """No control points: the floor decides."""
    two, one = jnp.zeros((*like.shape, 2), like.dtype), jnp.zeros((*like.shape, 1), jnp.int32)
    return Pattern(two, two, two, one[:, 0], one, one, one)


def smallest_floor(dtype: jnp.dtype) -> Array:
    """The floor under every threshold of the paper's method: rounding noise, radians or metres."""
    return jnp.asarray(FLOOR_EPS * jnp.finfo(dtype).eps, dtype)
