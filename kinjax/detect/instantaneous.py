"""Step 5: which displacements are instantaneous constraints (paper, sections 3.1 and 5).

In: sigma-epsilon values and thresholds. Out: 0 none, 1 space, 2 line for every displacement. A point needs several
lines, so it first appears when they are merged.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

NONE, SPACE, LINE, POINT = 0, 1, 2, 3
"""Kinds of constraint inside the engine; `annotations.TYPES` has them in the same order, from 0."""

Thresholds = tuple[Float[Array, "..."], Float[Array, "..."]]


def instantaneous(
    sigma_3: Float[Array, "..."],
    eps_3: Float[Array, "..."],
    sigma_1: Float[Array, "..."],
    eps_1: Float[Array, "..."],
    valid: Bool[Array, "..."],
    space: Thresholds | None,
    line: Thresholds | None,
    axis_min: Float[Array, ""],
) -> Int[Array, "..."]:
    """Space where `sigma_3` and `eps_3` are within their thresholds; else line where `sigma_1` and `eps_1` are, and the
    rotation is large enough to have an axis. `None`: that type is not looked for."""
    kind = jnp.zeros(sigma_3.shape, jnp.int8)
    if line is not None:
        sigma_max, eps_max = line
        turning = sigma_3 > jnp.maximum(sigma_max, axis_min)
        kind = jnp.where(valid & (sigma_1 <= sigma_max) & (eps_1 <= eps_max) & turning, LINE, kind)
    if space is not None:
        kind = jnp.where(valid & (sigma_3 <= space[0]) & (eps_3 <= space[1]), SPACE, kind)
    return kind
