"""Steps 1 and 2: poses made comparable, and the displacement of each object from one frame to a later one.

In: world poses, components first: `q` (4, objects, frames), `t` (3, objects, frames), `valid` (objects, frames), where
invalid frames hold the identity. Out: `Displacement`, or poses cleaned of spikes and averaged (robust method).

A displacement `D = W_i^-1 W_{i+k}` (2006 paper, eq. 13) is kept in world components: the rotation's half-angle vector
`v = sin(theta/2) a` and cosine `w`, and the translation `d` of the object's origin. A rotation of the frame in which they
are written changes none of the paper's quantities, and the world's is the cheapest.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..numerics import computed_once, over_rows
from ..rotations import conjugate, dot, matrix, multiply, normalize


class Displacement(NamedTuple):
    """Rotation half-angle vector `v` (3, ...), cosine `w`, translation `d` (3, ...) in metres, and which are `valid`."""

    v: Float[Array, "3 objects n"]
    w: Float[Array, "objects n"]
    d: Float[Array, "3 objects n"]
    valid: Bool[Array, "objects n"]


def displacements(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    k: int,
) -> Displacement:
    """Displacements from frame `i` to `i + k`, for the `frames - k` intervals that have both."""
    q0, q1 = q[..., :-k], q[..., k:]
    r = multiply(q1, conjugate(q0))
    d = jnp.stack([x[..., k:] - x[..., :-k] for x in t])  # by component: a difference of stacks would not vectorise
    return Displacement(r[1:], r[0], d, valid[..., :-k] & valid[..., k:])


def shifted(x: Array, s: int, fill: float | bool = 0) -> Array:
    """`y[..., i] = x[..., i + s]`, `fill` where that is outside."""
    if s == 0:
        return x
    n = x.shape[-1]
    s = max(-n, min(n, s))
    pad = jnp.full((*x.shape[:-1], abs(s)), fill, x.dtype)
    return jnp.concatenate([x[..., s:], pad] if s > 0 else [pad, x[..., :s]], axis=-1)


def mean_pose(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    h: int,
) -> tuple[Float[Array, "4 objects frames"], Float[Array, "3 objects frames"]]:
    """Mean pose over the valid ones of `2h + 1` frames around each frame (fewer at the clip's ends).

    Rotations: sum of quaternions turned to the centre's half-sphere, normalised: the chordal mean for the small angles of
    40 ms. Invalid centres stay as they are.
    """
    qs, ts, n = jnp.zeros_like(q), jnp.zeros_like(t), jnp.zeros_like(t[0])
    for s in range(-h, h + 1):
        here = shifted(valid, s, False)
        other = shifted(q, s)
        sign = jnp.where(dot(other, q) < 0, -jnp.ones_like(n), jnp.ones_like(n))
        weight = here.astype(q.dtype)
        qs = qs + weight * sign * other
        ts = ts + weight * (shifted(t, s) - t)  # differences: exact far from the origin
        n = n + weight
    n = jnp.maximum(n, 1)
    return jnp.where(valid, normalize(qs), q), jnp.where(valid, t + ts / n, t)


def spikes(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    half: int,
    spike: Float[Array, ""],
    never: Bool[Array, ""],
) -> Bool[Array, "objects frames"]:
    """Frames that a Hampel filter rejects: a coordinate off its running median by `max(4 * 1.4826 MAD, spike)`.

    The coordinates are the origin and three points 0.1 m from it along the object's axes, so that a flipped orientation
    counts like a jump. Window: `2 half + 1` frames, the valid ones of it. `never`: as `computed_once` has it.
    """
    lever = jnp.asarray(0.1, t.dtype)
    r = matrix(q)
    coordinates = jnp.concatenate([t, *(t + lever * r[:, k] for k in range(3))])
    frames, big = valid.shape[-1], jnp.asarray(jnp.finfo(t.dtype).max, t.dtype)
    # what is missing is the largest number, also beyond the ends: a window is then slices of one array, which vectorise
    rows = jnp.pad(jnp.where(valid, coordinates, big), [(0, 0), (0, 0), (half, half)], constant_values=big)
    around = jnp.pad(valid.astype(jnp.int32), [(0, 0), (half, half)])
    around, rows = computed_once((around, rows), never)
    count = sum(around[:, s : s + frames] for s in range(2 * half + 1))

    def median(window: list[Array]) -> Array:
        window = _sorted_network(window)
        low, high = (count - 1) // 2, count // 2
        parts = [
            jnp.where(low == i, x, 0) / 2 + jnp.where(high == i, x, 0) / 2 for i, x in enumerate(window[: half + 2])
        ]
        return functools.reduce(jnp.add, parts)

    def outlying(x: Array) -> Array:
        x = computed_once(x, never)  # a slice of `rows` inside the sorting keeps it from vectorising
        window = [x[..., s : s + frames] for s in range(2 * half + 1)]
        x, middle = window[half], computed_once(median(window), never)
        mad = median([jnp.where(w == big, big, jnp.abs(w - middle)) for w in window])
        return jnp.abs(x - middle) > jnp.maximum(jnp.asarray(4 * 1.4826, x.dtype) * mad, spike)

    found = over_rows(outlying, rows)
    return valid & jnp.any(found, axis=0)


def _sorted_network(rows: list[Array]) -> list[Array]:
    """Rows sorted element by element (Batcher's odd-even merge sort network): no data-dependent branch, so it vectorises."""
    rows, n = list(rows), len(rows)
    p = 1
    while p < n:
        k = p
        while k >= 1:
            for j in range(k % p, n - k, 2 * k):
                for i in range(min(k, n - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):
                        a, b = rows[i + j], rows[i + j + k]
                        less = (
                            a < b
                        )  # cheaper than minimum and maximum, which also have to pass on what is not a number
                        rows[i + j], rows[i + j + k] = jnp.where(less, a, b), jnp.where(less, b, a)
            k //= 2
        p *= 2
    return rows
