"""Line and point constraints at window level: of real bodies they exist only there (robust and window methods).

In: poses, and the space constraints that were found. Out: merged pivots with their refit. In the frames that are not at
rest the best segmentation into pivoting windows is sought; neighbouring windows become one where a common pivot earns at
least as much as two; and a pivot is kept if it touches a space constraint of its object (a heel before, a toe after a
stance), directly or through other pivots, or if free pivots are asked for.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..bits import packed_bits
from ..numerics import safe_sqrt
from ..rotations import dot
from .instantaneous import LINE, NONE, POINT, SPACE
from .merging import Runs, Spans, elements, packed
from .refit import Moments, fit, pivot_energy, quadratic, span_moments
from .windows import Reward, best_segmentation, window_rewards

BETA = 4.0
"""Reward of a frame on its pivot, in units of the squared noise."""
OPENING = 0.06
"""Cost of a window: that of so many seconds of perfect frames."""
RIDGE = (0.002 / 0.15) ** 2
"""Added to `M`: a pivot known to 2 mm where the body moves like a lever of 15 cm."""
TOUCH = 0.05
"""Pivots that begin or end within so many seconds of a constraint touch it."""
AXIS_RATIO = 0.1
"""An axis wanders less than the body turns: smallest to middle eigenvalue of `M`."""

Constraintlike = tuple[Array, Array, Array, Array, Array, Array]
"""kind, begin, end (slots, objects); position, axis (3, slots, objects); residual (slots, objects)."""


def merged_pivots(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    space: tuple[Int[Array, "slots objects"], ...],
    taught: Float[Array, " objects"],
    floor: Float[Array, ""],
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]],
    lengths: tuple[int, int],
    free: bool,
    capacity: int,
    reach: Float[Array, ""],
    line_below: Float[Array, ""],
    rate: Float[Array, ""],
) -> tuple[Constraintlike, Int[Array, " objects"]]:
    """Pivots of every object, and how many windows there were (more than `capacity`: repeat with more).

    space: kind, begin, end of what is at rest. taught: metres that templates and patterns leave, 0 without any. floor: metres
    that a real body's pivot wanders. noise: of the data, metres and radians; at lever `p` it moves a pivot by
    `sqrt(noise[0]^2 + 2/3 (noise[1] |p|)^2)`. line_below: eigenvalue of `M` under which an axis is one.
    """
    dtype = t.dtype
    place_noise, turn_noise = noise
    reward = Reward(
        jnp.asarray(BETA, dtype),
        taught,
        jnp.asarray(BETA * OPENING, dtype) * rate,
        reach,
        jnp.asarray(RIDGE, dtype),
        jnp.hypot(floor, place_noise),
        jnp.asarray((2 / 3) ** 0.5, dtype) * turn_noise,  # `noise[1]` is summed over three axes, of which two move a point
    )
    resting = _inside(space, valid.shape[-1])
    rewards = window_rewards(q, t, valid, resting, *lengths, reward, rest=False)
    windows = best_segmentation(rewards, lengths[0])
    kind, seen = jnp.where(windows.inside, LINE, NONE), packed_bits(valid)

    def nowhere(at: Array) -> tuple[Array, ...]:
        return (jnp.zeros(at.shape, dtype),) * 3

    find, total = elements(
        kind,
        Runs(*map(packed_bits, (windows.inside, windows.is_first, windows.is_last))),
        seen,
        ~seen,
        nowhere,
        nowhere,
    )
    items = find(0, capacity)
    spans = _merged(q, t, valid, items.kind != NONE, items.first, items.last, reward, rate)
    used = spans.kind != NONE
    moments, origin = span_moments(q, t, valid, spans.first, spans.last, used)
    found = fit(moments, line_below, 2 * 2.5**2 * turn_noise**2, AXIS_RATIO)
    turning = found.eigenvalues[1] > 2 * 2.5**2 * turn_noise**2 + 32 * jnp.finfo(dtype).eps
    used &= turning
    if not free:
        used &= _touching(spans, used, space, jnp.asarray(TOUCH, dtype) * rate)
    kind = jnp.where(used, jnp.where(found.is_line, LINE, POINT), NONE)
    return (kind, spans.first, spans.last, found.point + origin, found.axis, found.residual), total


def template_noise(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    begin: Int[Array, "objects templates"],
    end: Int[Array, "objects templates"],
    used: Bool[Array, "objects templates"],
) -> Float[Array, " objects"]:
    """Root mean square motion in metres that the best pivot of a line or point template leaves; the largest of them, 0 for
    an object without one."""
    moments, _ = span_moments(q, t, valid, begin.T, end.T, used.T)
    energy, _ = pivot_energy(quadratic(moments), jnp.asarray(RIDGE, t.dtype))
    return jnp.max(jnp.where(used.T, safe_sqrt(energy), 0), axis=0)


def _inside(space: tuple[Array, ...], frames: int) -> Bool[Array, "objects frames"]:
    """Frames strictly inside a space constraint; its first and last may also be a pivot's."""
    kind, begin, end = space
    objects = kind.shape[1]
    lane = jnp.broadcast_to(jnp.arange(objects, dtype=jnp.int32), kind.shape)
    used = (kind == SPACE) & (end - begin >= 2)
    change = jnp.zeros((objects, frames + 1), jnp.int32)
    change = change.at[lane, jnp.where(used, begin + 1, frames)].add(1).at[lane, jnp.where(used, end, frames)].add(-1)
    return jnp.cumsum(change[:, :frames], axis=-1) > 0


def _merged(
    q: Array, t: Array, valid: Array, used: Array, first: Array, last: Array, reward: Reward, rate: Array
) -> Spans:
    """Neighbouring windows joined, in time order, where one pivot for both earns at least what two earn."""
    moments, origin = span_moments(q, t, valid, first, last, used)
    touch = jnp.asarray(TOUCH, t.dtype) * rate

    def earned(x: Moments) -> Array:
        energy, p = pivot_energy(quadratic(x), reward.ridge)
        square = dot(p, p)
        earns = x.n * (reward.beta - energy / reward.level(square)) - reward.opening
        return jnp.where(square <= reward.reach**2, earns, -jnp.inf)

    def step(open_: tuple, new: tuple) -> tuple[tuple, tuple]:
        is_open, o_first, o_last, o_origin, o_moments, o_earned = open_
        n_used, n_first, n_last, n_origin, n_moments = new
        n_earned = earned(n_moments)
        both = o_moments.plus(n_moments.moved(n_origin - o_origin))
        together = earned(both)
        joins = is_open & n_used & ((n_first - o_last).astype(t.dtype) <= touch) & (together >= o_earned + n_earned)
        closes = n_used & ~joins
        out = jnp.where(closes & is_open, LINE, NONE), o_first, o_last
        state = (
            is_open | n_used,
            jnp.where(closes, n_first, o_first),
            jnp.where(n_used, n_last, o_last),
            jnp.where(closes, n_origin, o_origin),
            jax.tree.map(lambda n, b, o: jnp.where(closes, n, jnp.where(joins, b, o)), n_moments, both, o_moments),
            jnp.where(closes, n_earned, jnp.where(joins, together, o_earned)),
        )
        return state, out

    lanes = first.shape[1]
    one = jax.tree.map(lambda m: jnp.zeros_like(m[..., 0, :]), moments)
    zero = jnp.zeros(lanes, first.dtype)
    start = (jnp.zeros(lanes, bool), zero, zero, jnp.zeros_like(origin[:, 0]), one, jnp.zeros(lanes, t.dtype))
    xs = (used, first, last, jnp.moveaxis(origin, 1, 0), jax.tree.map(lambda m: jnp.moveaxis(m, -2, 0), moments))
    state, out = jax.lax.scan(step, start, xs)
    kind = jnp.concatenate([out[0], jnp.where(state[0], LINE, NONE)[None]])
    spans = Spans(kind, *(jnp.concatenate([o, s[None]]) for o, s in zip(out[1:], state[1:3], strict=True)))
    return packed(spans, jnp.max(jnp.sum(used, axis=0, dtype=jnp.int32), initial=0))


def _touching(spans: Spans, used: Array, space: tuple[Array, ...], touch: Array) -> Bool[Array, "slots objects"]:
    """Pivots within `touch` frames of a space constraint of their object, or of another pivot that is."""
    kind, begin, end = space
    rest = kind == SPACE

    def near(a: Array, b: Array) -> Array:
        return jnp.abs((a[:, None] - b[None]).astype(touch.dtype)) <= touch

    direct = used & jnp.any((near(spans.first, end) | near(spans.last, begin)) & rest[None], axis=1)

    def step(before: tuple[Array, Array], x: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        edge, kept = before
        is_used, this_kept, near_edge, far_edge = x
        chained = is_used & (this_kept | (kept & (jnp.abs(near_edge - edge).astype(touch.dtype) <= touch)))
        return (jnp.where(is_used, far_edge, edge), jnp.where(is_used, chained, kept)), chained

    start = jnp.zeros_like(spans.first[0]), jnp.zeros_like(used[0])
    after = jax.lax.scan(step, start, (used, direct, spans.first, spans.last))[1]
    return jax.lax.scan(step, start, (used, direct | after, spans.last, spans.first), reverse=True)[1]
