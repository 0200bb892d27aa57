"""The least median of squares, softly: thresholds from a template with a gradient to its values and to its extent.

In: non-negative values and each one's membership in the template. Out: `SoftKept`. As `detect.lmeds` (paper, section 6.1),
with a smooth median of the deviations from each value, a soft choice of the centre, a soft rejection, and a smooth maximum.
All deviations are held at once: O(N^2) in time and memory, for templates of at most a few hundred values.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .quantile import smooth_quantile


class SoftKept(NamedTuple):
    """`largest` value kept, how much of each is kept (`weights`), the robust standard deviation `spread`, the `center`."""

    largest: Float[Array, ""]
    weights: Float[Array, " n"]
    spread: Float[Array, ""]
    center: Float[Array, ""]


def soft_lmeds(values: Float[Array, " n"], weights: Float[Array, " n"], temperature: Float[Array, ""]) -> SoftKept:
    """Soft least median of squares of `values` (n,) >= 0 of any unit, `weights` (n,) in [0, 1] saying what belongs.

    * `M_i`: smooth median of `|v_i - v_j|` over `j`, at level `N/2 + 1/4`, which is the `N//2 + 1`-th of a sharp template;
    * centre: mean of the values by their shares `w_i M_i^(-1/T)`; a value 7 % worse than the best has half its share at T = 0.1;
    * `s = 1.4826 (1 + 5/(N-1)) Mmin`, floored at 4 eps of the largest value;
    * kept: `w_j` times the logistic function of `(1 - (r_j / 2.5 s)^2) / 2T`, `r_j` the deviation from the centre;
    * largest kept: where the smoothed count of what is kept is half a value short of all. (A maximum with exponential
      weights would believe outliers again, since those grow faster than the rejection falls.)

    All 0 where nothing belongs. Source: paper section 6.1; Rousseeuw and Leroy 1987.
    """
    dtype = values.dtype
    finite = jnp.isfinite(values)
    weights = jnp.where(finite, weights, 0)
    v = jnp.where(weights > 0, jnp.where(finite, values, 0), 0)
    count = jnp.sum(weights)
    zero = jnp.zeros((), dtype)
    some = count > 1
    apart = jnp.abs(v[:, None] - v[None, :])
    shares = jnp.broadcast_to(weights[None, :], apart.shape)
    medians = smooth_quantile(apart, shares, jnp.broadcast_to(count / 2 + 0.25, v.shape), zero, temperature)
    floor = 4 * jnp.finfo(dtype).eps * jax.lax.stop_gradient(jnp.max(v, initial=0))
    floor = jnp.where(floor > 0, floor, jnp.finfo(dtype).tiny ** 0.5)
    belongs = weights > 0
    share = jnp.where(
        belongs, jnp.log(jnp.where(belongs, weights, 1)) - jnp.log(medians + floor) / temperature, -jnp.inf
    )
    share = jnp.where(some, share, 0)
    chosen = jax.nn.softmax(share)
    center, smallest = jnp.sum(chosen * v), jnp.sum(chosen * medians)
    factor = jnp.asarray(1.4826, dtype) * (1 + 5 / jnp.where(some, count - 1, 1))
    spread = jnp.maximum(factor * smallest, floor)
    ratio = (v - center) / (2.5 * spread)
    kept = weights * jax.nn.sigmoid((1 - ratio * ratio) / (2 * temperature))
    largest = smooth_quantile(v, kept, jnp.sum(kept) - 0.5, zero, temperature)
    return SoftKept(
        jnp.where(some, largest, 0), jnp.where(some, kept, 0), jnp.where(some, spread, 0), jnp.where(some, center, 0)
    )
