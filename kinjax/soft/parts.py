"""Unit quaternions and mean poses on separate components (`components`): what is differentiated is never stacked.

In and out: tuples of arrays of any one shape, (w, x, y, z) or (x, y, z). Values are those of `rotations` and `detect.displacements`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..components import Parts
from ..numerics import shifted
from ..rotations import dot


def held(x: Any, never: Bool[Array, ""]) -> Any:
    """`x`, computed before anything reads it, and its gradient before anything that leads to it: `numerics.computed_once` for
    what is differentiated. `never`: False, which the compiler must not know; a branch is where it stops merging loops."""
    return jax.lax.cond(never, lambda y: jax.tree.map(lambda z: jnp.roll(z, 1, axis=-1), y), lambda y: y, x)


def normalize(q: Parts) -> Parts:
    """Unit quaternion; zero and non-finite ones become the identity, with gradient 0."""
    n2 = jax.lax.stop_gradient(dot(q, q))
    good = (n2 > 0) & jnp.isfinite(n2)
    parts = tuple(jnp.where(good, x, 0 if i else 1) for i, x in enumerate(q))
    scale = jax.lax.rsqrt(dot(parts, parts))
    return tuple(x * scale for x in parts)


def mean_pose(q: Parts, t: Parts, valid: Bool[Array, "objects frames"], half: int) -> tuple[Parts, Parts]:
    """Mean pose over the valid ones of `2 half + 1` frames around each: `detect.displacements.mean_pose`.

    Quaternions of one rotation may differ in sign from frame to frame; which signs agree is a constant.
    """
    weight = valid.astype(t[0].dtype)
    fixed = [jax.lax.stop_gradient(x) for x in q]
    here, sums_q, sums_t = weight, list(q), [jnp.zeros_like(x) for x in t]
    for s in (s for s in range(-half, half + 1) if s):
        w = shifted(weight, s)
        sign = jnp.where(dot([shifted(x, s) for x in fixed], fixed) < 0, -w, w)
        sums_q = [a + sign * shifted(x, s) for a, x in zip(sums_q, q, strict=True)]
        sums_t = [a + w * (shifted(x, s) - x) for a, x in zip(sums_t, t, strict=True)]  # exact far from the origin
        here = here + w
    scale = 1 / jnp.maximum(here, 1)
    mean_q = tuple(jnp.where(valid, a, b) for a, b in zip(normalize(tuple(sums_q)), q, strict=True))
    return mean_q, tuple(jnp.where(valid, x + a * scale, x) for x, a in zip(t, sums_t, strict=True))
