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

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..numerics import computed_once, over_rows
from ..rotations import conjugate, matrix, multiply, normalize


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


def mean_pose(
    q: Float[Array, "4 objects frames"],
    t: Float[Array, "3 objects frames"],
    valid: Bool[Array, "objects frames"],
    h: int,
    never: Bool[Array, ""] | None = None,
) -> tuple[Float[Array, "4 objects frames"], Float[Array, "3 objects frames"]]:
    """Mean pose over the valid ones of `2h + 1` frames around each frame (fewer at the clip's ends).

    Rotations: sum of quaternions turned to the centre's half-sphere, normalised: the chordal mean for the small angles of
    40 ms. Invalid centres stay as they are. `never`: as `computed_once` has it, for speed; without it there is a gradient.
    """
    frames, shifts = valid.shape[-1], range(2 * h + 1)
    # padded once and by component: what is around a frame is then slices of one array, which vectorise
    wide = [jnp.pad(x, [(0, 0), (h, h)]) for x in (valid.astype(t.dtype), *q, *t)]
    wide = wide if never is None else computed_once(wide, never)
    around = [[x[..., s : s + frames] for s in shifts] for x in wide]
    seen, qs, ts = around[0], around[1:5], around[5:]
    centers = [x[h] for x in qs], [x[h] for x in ts]
    same = [sum(x[s] * c for x, c in zip(qs, centers[0], strict=True)) for s in shifts]
    weights = [jnp.where(d < 0, -w, w) for d, w in zip(same, seen, strict=True)]
    count = jnp.maximum(sum(seen), 1)
    turned = [sum(w * y for w, y in zip(weights, x, strict=True)) for x in qs]
    moved = [sum(w * (y - c) for w, y in zip(seen, x, strict=True)) for x, c in zip(ts, centers[1], strict=True)]
    q_mean = [jnp.where(valid, x, c) for x, c in zip(normalize(jnp.stack(turned)), centers[0], strict=True)]
    t_mean = [jnp.where(valid, c + x / count, c) for x, c in zip(moved, centers[1], strict=True)]  # exact far from the origin
    return jnp.stack(q_mean), jnp.stack(t_mean)


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
    frames, big = valid.shape[-1], jnp.asarray(jnp.finfo(t.dtype).max, t.dtype)
    # what is missing is the largest number, also beyond the ends: a window is then slices of one array, which vectorise. Each
    # coordinate is written where it belongs: what computes inside a concatenation does not vectorise
    rows = jnp.full((12, valid.shape[0], frames + 2 * half), big)
    for k in range(12):
        x = t[k % 3] if k < 3 else t[k % 3] + lever * r[k % 3, k // 3 - 1]
        rows = jax.lax.dynamic_update_slice(rows, jnp.where(valid, x, big)[None], (k, 0, half))
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
