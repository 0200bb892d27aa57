"""What holds thresholds in (step 4): the floor under all of them, and what a template may teach at most.

In: the settings that are data, widths of a plan, the noise of the data itself. Out: `Bounds`. For the engine and its soft counterpart.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .interface import Numbers
from .noise import smallest_floor

Pair = tuple[Float[Array, " objects"], Float[Array, " objects"]]


class Bounds(NamedTuple):
    """(sigma, eps) of each object, by second for the robust method, as they are for the paper's.

    `floor`: under all thresholds. `least` and `cap`: around what templates teach (for the paper's method rounding noise and
    infinity). `margin`: by how much that is more than they show.
    """

    least: Pair
    floor: Pair
    cap: Pair
    margin: Float[Array, ""]


def bounds(method: str, span: int, half: int, numbers: Numbers, noise: Pair) -> Bounds:
    """span: frames of a displacement. half: half width of the mean of poses. noise: `noise.data_noise`, metres and radians; it
    shakes a displacement's speed by its share in the difference of two means (robust method)."""
    if method == "paper":
        low = jnp.broadcast_to(smallest_floor(numbers.rate.dtype), noise[0].shape)
        none = jnp.full_like(low, jnp.inf)
        floor = jnp.maximum(low, numbers.sigma_floor), jnp.maximum(low, numbers.eps_floor)
        return Bounds((low, low), floor, (none, none), jnp.ones_like(numbers.margin))
    width = jnp.asarray(2.5 * (2 / (2 * half + 1)) ** 0.5, numbers.rate.dtype) * numbers.rate / span
    jitter = width * noise[1], width * noise[0]
    floor = jnp.hypot(numbers.sigma_floor, jitter[0]), jnp.hypot(numbers.eps_floor, jitter[1])
    return Bounds(floor, floor, (numbers.sigma_cap + jitter[0], numbers.eps_cap + jitter[1]), numbers.margin)
