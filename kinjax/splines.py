"""Interpolation through a few control points: natural cubic, and monotone cubic (PCHIP).

In: knots (strictly increasing among the `count` that are used; the rest is padding) and values. Out: values at any times,
constant outside the knots. Everything is masked, so curves with different numbers of knots share one compiled function.
Checked against `scipy.interpolate.CubicSpline(bc_type="natural")` and `PchipInterpolator`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .numerics import safe_divide


def natural_cubic(
    at: Float[Array, " n"], knots: Float[Array, " k"], values: Float[Array, " k"], count: Int[Array, ""]
) -> Float[Array, " n"]:
    """Natural cubic spline (second derivative 0 at both ends), constant outside."""
    k = knots.shape[0]
    if k < 2:
        return jnp.broadcast_to(values[0], at.shape)
    i = jnp.arange(k, dtype=jnp.int32)
    values = jnp.where(i < count, values, values[0])  # padding may hold anything
    h = jnp.where(i[:-1] + 1 < count, knots[1:] - knots[:-1], 1)
    slope = safe_divide(values[1:] - values[:-1], h)
    interior = (i > 0) & (i + 1 < count)
    h0 = jnp.concatenate([jnp.ones_like(h[:1]), h])  # h0[i] before knot i
    h1 = jnp.concatenate([h, jnp.ones_like(h[:1])])  # h1[i] after it
    s0, s1 = jnp.concatenate([slope[:1], slope]), jnp.concatenate([slope, slope[-1:]])
    system = jnp.where(
        interior[:, None],
        jnp.diag(2 * (h0 + h1)) + jnp.diag(h1[:-1], 1) + jnp.diag(h0[1:], -1),
        jnp.eye(k, dtype=values.dtype),
    )
    m = jnp.linalg.solve(system, jnp.where(interior, 6 * (s1 - s0), 0))
    j = _segment(at, knots, count)
    x = jnp.clip(at, knots[0], knots[count - 1]) - knots[j]
    d = slope[j] - h[j] * (2 * m[j] + m[j + 1]) / 6
    return values[j] + x * (d + x * (m[j] / 2 + x * (m[j + 1] - m[j]) / (6 * h[j])))


def monotone_cubic(
    at: Float[Array, " n"], knots: Float[Array, " k"], values: Float[Array, " k"], count: Int[Array, ""]
) -> Float[Array, " n"]:
    """Monotone cubic interpolation (Fritsch and Carlson 1980, PCHIP's slopes): never leaves the range of two neighbours."""
    k = knots.shape[0]
    if k < 2:
        return jnp.broadcast_to(values[0], at.shape)
    i = jnp.arange(k, dtype=jnp.int32)
    values = jnp.where(i < count, values, values[0])  # padding may hold anything
    used = i[:-1] + 1 < count
    h = jnp.where(used, knots[1:] - knots[:-1], 1)
    slope = jnp.where(used, (values[1:] - values[:-1]) / h, 0)
    h0, h1 = jnp.concatenate([h[:1], h]), jnp.concatenate([h, h[-1:]])
    s0, s1 = jnp.concatenate([slope[:1], slope]), jnp.concatenate([slope, slope[-1:]])
    w0, w1 = 2 * h1 + h0, h1 + 2 * h0
    harmonic = safe_divide(w0 + w1, safe_divide(w0, s0) + safe_divide(w1, s1))
    inner = jnp.where(s0 * s1 > 0, harmonic, 0)

    def end(ha: Array, hb: Array, sa: Array, sb: Array) -> Array:
        d = safe_divide((2 * ha + hb) * sa - ha * sb, ha + hb)
        d = jnp.where(jnp.sign(d) != jnp.sign(sa), 0, d)
        steep = (jnp.sign(sa) != jnp.sign(sb)) & (jnp.abs(d) > 3 * jnp.abs(sa))
        return jnp.where(steep, 3 * sa, d)

    n = count - 1
    two = count == 2
    first = jnp.where(two, slope[0], end(h[0], h[min(1, k - 2)], slope[0], slope[min(1, k - 2)]))
    last = jnp.where(two, slope[0], end(h[n - 1], h[jnp.maximum(n - 2, 0)], slope[n - 1], slope[jnp.maximum(n - 2, 0)]))
    d = jnp.where(i == 0, first, jnp.where(i == n, last, inner))
    j = _segment(at, knots, count)
    u = (jnp.clip(at, knots[0], knots[n]) - knots[j]) / h[j]
    a, b = values[j], values[j + 1]
    return (
        a * (1 + 2 * u) * (1 - u) ** 2
        + b * u**2 * (3 - 2 * u)
        + h[j] * (d[j] * u * (1 - u) ** 2 + d[j + 1] * u**2 * (u - 1))
    )


def _segment(at: Array, knots: Array, count: Array) -> Array:
    """Index of the knot interval in which each time lies."""
    used = jnp.where(jnp.arange(knots.shape[0], dtype=jnp.int32) < count, knots, jnp.inf)
    return jnp.clip(jnp.searchsorted(used, at, side="right") - 1, 0, jnp.maximum(count - 2, 0))
