"""Which displacements are instantaneous constraints, softly (paper, section 5).

In: sigma-epsilon values and thresholds. Out: for every displacement how much it passes, in [0, 1].
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .steps import below, smooth_maximum


class Limits(NamedTuple):
    """Thresholds of a space constraint, `sigma_max` and `eps_max`: (objects,), or (objects, displacements) where they change.

    Radians and metres an interval for the paper's method, radians and metres a second for the robust one; positive.
    """

    sigma_max: Float[Array, "objects *n"]
    eps_max: Float[Array, "objects *n"]


def soft_instantaneous(
    sigma: Float[Array, "..."],
    eps: Float[Array, "..."],
    valid: Bool[Array, "..."],
    sigma_max: Float[Array, "..."],
    eps_max: Float[Array, "..."],
    temperature: Float[Array, ""],
) -> Float[Array, "..."]:
    """Space: the product of the logistic functions of `(sigma_max - sigma) / (T sigma_max)` and of the same of epsilon.

    Thresholds are positive and broadcast. 0 with gradient 0 where not `valid`; 1/4 where both thresholds are just met.
    """
    sigma, eps = (jnp.where(valid, x, jnp.zeros_like(x)) for x in (sigma, eps))
    return jnp.where(valid, below(sigma, sigma_max, temperature) * below(eps, eps_max, temperature), 0)


def soft_line(
    sigma_3: Float[Array, "..."],
    sigma_1: Float[Array, "..."],
    eps_1: Float[Array, "..."],
    valid: Bool[Array, "..."],
    sigma_max: Float[Array, "..."],
    eps_max: Float[Array, "..."],
    axis_min: Float[Array, ""],
    temperature: Float[Array, ""],
) -> Float[Array, "..."]:
    """Line: `sigma_1` and `eps_1` within their thresholds, and `sigma_3` above the larger of `sigma_max` and `axis_min`."""
    held = soft_instantaneous(sigma_1, eps_1, valid, sigma_max, eps_max, temperature)
    least = smooth_maximum(sigma_max, jnp.broadcast_to(axis_min, sigma_max.shape), temperature * axis_min)
    turning = 1 - below(jnp.where(valid, sigma_3, jnp.zeros_like(sigma_3)), least, temperature)
    return held * turning
