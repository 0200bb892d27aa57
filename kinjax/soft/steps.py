"""Smooth steps and maxima: what the other files of this room are made of.

In and out: arrays of any shape. Each tends to its hard counterpart as its temperature goes to 0, has a finite derivative
everywhere, and takes the hard limit's boundary itself for one half.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def smoothstep(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """0 up to -1, 1 from 1 on, and the odd quintic between them: twice continuously differentiable."""
    x = jnp.clip(x, -1, 1)
    x2 = x * x
    return 0.5 + x * (0.9375 - x2 * (0.625 - 0.1875 * x2))


def smoothstep_slope(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Derivative of `smoothstep`: `15/16 (1 - x^2)^2` between -1 and 1, else 0."""
    x = jnp.clip(x, -1, 1)
    y = 1 - x * x
    return 0.9375 * (y * y)


def below(value: Float[Array, "..."], limit: Float[Array, "..."], temperature: Float[Array, ""]) -> Float[Array, "..."]:
    """How much `value <= limit` holds: the logistic function of `(limit - value) / (temperature limit)`, `limit > 0`."""
    return jax.nn.sigmoid((1 - value / limit) / temperature)


def within(
    square: Float[Array, "..."], reach: Float[Array, "..."], temperature: Float[Array, ""]
) -> Float[Array, "..."]:
    """How much a distance is within `reach`, from its square: of the slope of `below` at `reach`, and smooth at distance 0.

    A reach of 0 is never met, but by a distance of 0 half.
    """
    known = reach > 0
    reach = jnp.where(known, reach, jnp.ones_like(reach))
    inside = jax.nn.sigmoid((1 - square / (reach * reach)) / (2 * temperature))
    return jnp.where(known, inside, jnp.where(square > 0, 0.0, 0.5).astype(inside.dtype))


def smooth_maximum(a: Float[Array, "..."], b: Float[Array, "..."], width: Float[Array, "..."]) -> Float[Array, "..."]:
    """`max(a, b)` rounded over a `width > 0`: `b + width ln(1 + exp((a - b) / width))`, never less than either."""
    return b + width * jax.nn.softplus((a - b) / width)


def smooth_minimum(a: Float[Array, "..."], b: Float[Array, "..."], width: Float[Array, "..."]) -> Float[Array, "..."]:
    """`min(a, b)` rounded over a `width > 0`, never more than either."""
    return -smooth_maximum(-a, -b, width)
