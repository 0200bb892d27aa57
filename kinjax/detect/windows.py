"""The paper's idea at interval level: the best segmentation of a clip into windows that turn about something, or rest.

In: poses, which frames may be used, and the noise to measure against. Out: the windows of the best segmentation. A window
of `n` frames earns `n (beta - E / nu^2)` less an opening cost, with `E` the mean squared motion that its pivot (or rest)
leaves; the best set of disjoint windows is found by dynamic programming. The moments of all windows of one length follow
from those of one frame less by adding one frame to each, taken from the window's own first frame: O(1) a window, as with
prefix sums, but without their cancellation, so float32 suffices.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..rotations import apply_transposed, dot, matrix
from .refit import Moments, pivot_energy, quadratic


class Reward(NamedTuple):
    """What a window earns: `beta`, the noise `nu` (objects,) in metres, the `opening` cost, the `reach` of a pivot in
    metres, and the `ridge` on `M` ((2 mm / 15 cm)^2: a pivot is known to 2 mm where a lever of 15 cm moves).

    A pivot `p` is measured against `level`: no less than `nu`, nor than `sqrt(near^2 + (turn |p|)^2)`, as noise of rotation moves
    it more the farther it is from the origin; `near` (objects,) metres, `turn` (objects,) radians."""

    beta: Float[Array, ""]
    nu: Float[Array, " objects"]
    opening: Float[Array, ""]
    reach: Float[Array, ""]
    ridge: Float[Array, ""]
    near: Float[Array, " objects"]
    turn: Float[Array, " objects"]

    def level(self, square: Float[Array, "*rows objects"]) -> Float[Array, "*rows objects"]:
        """Squared metres that pivots are measured against, by their squared distance from the origin."""
        return jnp.maximum(self.nu**2, self.near**2 + self.turn**2 * square)


class Windows(NamedTuple):
    """The chosen windows: their first frames, their last frames, and all frames `inside` one."""

    is_first: Bool[Array, "objects frames"]
    is_last: Bool[Array, "objects frames"]
    inside: Bool[Array, "objects frames"]


def window_rewards(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    blocked: Bool[Array, "objects frames"],
    shortest: int,
    longest: int,
    reward: Reward,
    rest: bool,
) -> Float[Array, "lengths objects frames"]:
    """Reward of every window of `shortest..longest` frames, at its **last** frame; -inf where it is not allowed.

    Not allowed: windows outside the clip, that begin or end on a frame that was not seen, or hold a blocked one, and
    pivots farther from the object's origin than `reach`. rest: reward rest (`E = c + (r^2/3) tr M`, r = 0.1 m), not a pivot.
    """
    frames = valid.shape[-1]
    columns = reward._replace(nu=reward.nu[:, None], near=reward.near[:, None], turn=reward.turn[:, None])
    pad = [(0, 0)] * (t.ndim - 1) + [(0, longest)]
    weight = valid.astype(t.dtype)
    rows = jnp.concatenate(
        [matrix(q).reshape(9, *valid.shape) * weight, t, weight[None], blocked.astype(t.dtype)[None]]
    )
    rows = jnp.pad(rows, pad)
    start_ok = valid
    at = jnp.arange(frames, dtype=jnp.int32)

    def one(length: Int[Array, ""], sums: tuple[Moments, Array]) -> tuple[tuple[Moments, Array], Array]:
        moments, stopped = sums
        ahead = jax.lax.dynamic_slice_in_dim(rows, length - 1, frames, axis=-1)
        r, w = ahead[:9].reshape(3, 3, *valid.shape), ahead[12]
        d = w * (ahead[9:12] - t)
        moments = moments.plus(Moments(w, r, d, apply_transposed(r, d), dot(d, d)))
        stopped = stopped + ahead[13]
        e = quadratic(moments)
        if rest:
            energy = e.c + jnp.asarray(0.01 / 3, t.dtype) * (e.m[0, 0] + e.m[1, 1] + e.m[2, 2])
            near, level = jnp.ones_like(valid), columns.nu**2
        else:
            energy, p = pivot_energy(e, reward.ridge)
            square = dot(p, p)
            near, level = square <= reward.reach**2, columns.level(square)
        earned = moments.n * (reward.beta - energy / level) - reward.opening
        allowed = near & start_ok & (w > 0) & (stopped == 0) & (at + length <= frames)
        return (moments, stopped), jnp.where(allowed, earned, -jnp.inf)

    zero = jnp.zeros_like(t[0])
    start = (Moments(zero, jnp.zeros((3, 3, *zero.shape), t.dtype), jnp.zeros_like(t), jnp.zeros_like(t), zero), zero)
    sums = jax.lax.fori_loop(1, shortest, lambda length, s: one(length, s)[0], start)

    def keep(sums: tuple[Moments, Array], length: Int[Array, ""]) -> tuple[tuple[Moments, Array], Array]:
        sums, earned = one(length, sums)
        return sums, jnp.where(at >= length - 1, jnp.roll(earned, length - 1, axis=-1), -jnp.inf)

    return jax.lax.scan(keep, sums, jnp.arange(shortest, longest + 1, dtype=jnp.int32))[1]


def best_segmentation(rewards: Float[Array, "lengths objects frames"], shortest: int) -> Windows:
    """Disjoint windows of greatest total reward, by dynamic programming over frames; ties take the shorter window."""
    lengths, objects, frames = rewards.shape
    longest = shortest + lengths - 1

    def forward(best: Float[Array, "longest objects"], j: Int[Array, ""]) -> tuple[Array, Array]:
        # best[i]: greatest reward of the frames before j - i
        here = jax.lax.dynamic_index_in_dim(rewards, j, axis=2, keepdims=False)
        total = best[shortest - 1 :] + here
        choice = jnp.argmax(total, axis=0)
        value = jnp.max(total, axis=0)
        better = value > best[0]
        length = jnp.where(better, choice + shortest, 0)
        return jnp.concatenate([jnp.maximum(value, best[0])[None], best[:-1]]), length

    start = jnp.full((longest, objects), -jnp.inf, rewards.dtype).at[0].set(0)
    chosen = jax.lax.scan(forward, start, jnp.arange(frames, dtype=jnp.int32))[1]

    def backward(left: Int[Array, " objects"], length: Int[Array, " objects"]) -> tuple[Array, tuple[Array, ...]]:
        is_last = (left == 0) & (length > 0)
        left = jnp.where(left == 0, length, left)
        return jnp.maximum(left - 1, 0), (left == 1, is_last, left > 0)

    flags = jax.lax.scan(backward, jnp.zeros(objects, chosen.dtype), chosen, reverse=True)[1]
    return Windows(*(f.T for f in flags))
