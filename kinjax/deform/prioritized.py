"""One linear solve with any number of strict priorities.

In: Jacobian rows in order of priority, the residuals that they should remove, each row's layer. Out: a step in every layer's
coordinates such that no layer moves what the layers above it control. Source: 2004 paper, section 3.2, whose recursion
over null-space projectors is done here in task space: an orthonormal basis of the rows used so far takes the place of the
projector, so that nothing of size n x n is ever made.

With `J = R Q` (rows of `Q` orthonormal, `R` lower triangular), layer `i` owns its rows of `Q`: its step `y_i` there cannot
be seen by the rows above. Damping acts on `y_i` only; the basis keeps every direction above rounding noise, since a
direction dropped for being small would leak into the layer that dropped it. What is promised, at every configuration:
`|J_i (dm_all - dm_i)| <= 20 eps |J_i| (|dm_all| + |dm_i|)`, `dm_i` being the step without the layers below `i`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..numerics import eps_of, safe_divide, safe_sqrt

NOISE = 16.0
"""A row whose part outside the basis is below so many eps of its length adds no direction."""


class Basis(NamedTuple):
    """`J = R Q`: `rows` Q (m, n), orthonormal or zero; `factors` R (m, m), lower triangular."""

    rows: Float[Array, "m n"]
    factors: Float[Array, "m m"]


def times(a: Float[Array, "i j"], b: Float[Array, "j *k"]) -> Float[Array, "i *k"]:
    """Product of small matrices, written out: a library call would cost more than the arithmetic, and keep XLA from making
    one native function of the loop around it."""
    return jnp.sum(a.reshape(*a.shape, *[1] * (b.ndim - 1)) * b[None], axis=1)


def product(a: Float[Array, "i j"], b: Float[Array, "j k"]) -> Float[Array, "i k"]:
    """Product of two matrices: written out where they are small, else row by row, which vectorises."""
    if a.shape[0] < 16:
        return times(a, b)
    return jax.lax.scan(lambda _, row: (None, jnp.matmul(row, b, precision="highest")), None, a)[1]


def combined(rows: Float[Array, "m *n"], along: Float[Array, "m c"]) -> Float[Array, "c *n"]:
    """For every trial the sum of the rows by its shares `along`."""
    flat = jnp.matmul(along.T, rows.reshape(rows.shape[0], -1), precision="highest")
    return flat.reshape(-1, *rows.shape[1:])


def row_basis(jacobian: Float[Array, "m n"]) -> Basis:
    """Orthonormal basis of the rows in their order, by classical Gram-Schmidt applied twice.

    A row that lies in the span of those before it to within `16 eps` of its length, or is zero, gets a zero row.
    """
    m, n = jacobian.shape
    tau2 = (NOISE * eps_of(jacobian)) ** 2
    index = jnp.arange(m, dtype=jnp.int32)

    def add(k: Int[Array, ""], basis: Basis) -> Basis:
        # rows from the k-th on are still those of the Jacobian: the product with all rows gives the row's own square, too
        q, r = basis
        before = index < k
        v = jax.lax.dynamic_index_in_dim(q, k, 0, keepdims=False)
        c1 = q @ v
        size2 = jax.lax.dynamic_index_in_dim(c1, k, 0, keepdims=False)
        c1 = jnp.where(before, c1, jnp.zeros_like(c1))
        v1 = v - c1 @ q
        q = jax.lax.dynamic_update_index_in_dim(q, v1, k, 0)
        c2 = q @ v1
        first2 = jax.lax.dynamic_index_in_dim(c2, k, 0, keepdims=False)
        c2 = jnp.where(before, c2, jnp.zeros_like(c2))
        v2 = v1 - c2 @ q
        left2 = first2 - jnp.sum(c2 * c2)
        # the second pass loses length only where the first left nothing but noise
        keep = (first2 > tau2 * size2) & (left2 > 0.25 * first2)
        left = jnp.sqrt(jnp.where(keep, left2, jnp.ones_like(left2)))
        row = v2 * jnp.where(keep, 1 / left, jnp.zeros_like(left))
        factors = jnp.where(index == k, jnp.where(keep, left, jnp.zeros_like(left)), c1 + c2)
        return Basis(
            jax.lax.dynamic_update_index_in_dim(q, row, k, 0),
            jax.lax.dynamic_update_index_in_dim(r, factors, k, 0),
        )

    # rows of whole vectors: their products have no remainder
    start = Basis(jnp.pad(jacobian, ((0, 0), (0, -n % 8))), jnp.zeros((m, m), jacobian.dtype))
    rows, factors = jax.lax.fori_loop(0, m, add, start)
    return Basis(rows[:, :n], factors)


class Layered(NamedTuple):
    """The factors of one configuration, ready to be applied to any residual."""

    basis: Basis
    pull: Float[Array, "m m"]
    """Damped inverse of each layer's own block of R: `(R_ii' R_ii + lambda_i^2 + G_i)^-1 R_ii'`."""
    rest: Float[Array, " m"]
    """What the drag `G` adds to each layer's step."""
    carry: Float[Array, "m m"]
    """R without those blocks: what the steps of the layers above do to a layer."""


def factorize(
    jacobian: Float[Array, "m n"],
    layer: Int[Array, " m"],
    damping: Float[Array, " m"],
    drag: tuple[Array, Array | float] | None = None,
    travel: Float[Array, " n"] | None = None,
) -> Layered:
    """Basis and damped inverses of all layers at once.

    layer: of each row, not decreasing. damping: lambda of each row's layer, in units of the Jacobian; it is raised to
    `1e-6 |J_i|` in float64 and `1e-3 |J_i|` in float32, below which rounding would decide.

    drag: (strength (m,) of each row's layer, sigma as a share of the layer's root mean square row) holds a layer back where it
    is nearly singular: along a direction with singular value `s` it is `G = strength^2 / (1 + (s / sigma)^2)^8`, and it pulls
    at the whole `travel` (n,), not only at this step, so that what it allows does not depend on the number of steps.
    """
    basis = row_basis(jacobian)
    same = layer[:, None] == layer[None, :]
    own = jnp.where(same, basis.factors, jnp.zeros_like(basis.factors))
    size2 = jnp.sum(jnp.where(same, jnp.sum(jacobian * jacobian, axis=1)[None, :], 0), axis=1)
    least = 1e-6 if jacobian.dtype == jnp.float64 else 1e-3
    lambda2 = jnp.maximum(damping * damping, least**2 * size2)
    lambda2 = jnp.where(lambda2 > 0, lambda2, jnp.ones_like(lambda2))
    normal = product(own.T, own)
    carry = basis.factors - own
    if drag is None or travel is None:
        return Layered(basis, product(inverse(normal + jnp.diag(lambda2)), own.T), jnp.zeros_like(lambda2), carry)
    strength, sigma = drag
    used = times(same.astype(own.dtype), (jnp.sum(jacobian * jacobian, axis=1) > 0).astype(own.dtype))
    sigma2 = jnp.where(used > 0, sigma**2 * size2 / jnp.maximum(used, 1), jnp.ones_like(size2))
    hold = fading(normal, sigma2, strength)
    solve = inverse(normal + jnp.diag(lambda2) + hold)
    return Layered(basis, product(solve, own.T), -times(solve, times(hold, basis.rows @ travel)), carry)


def fading(
    normal: Float[Array, "m m"], sigma2: Float[Array, " m"], strength: Float[Array, " m"]
) -> Float[Array, "m m"]:
    """`strength^2 / (1 + (s / sigma)^2)^8` along each singular direction, of value `s`, of the layers' own rows; normal: R_ii' R_ii."""
    fade = inverse(jnp.eye(len(sigma2), dtype=normal.dtype) + normal / safe_sqrt(sigma2[:, None] * sigma2[None, :]))
    fade = product(fade, fade)
    fade = product(fade, fade)
    return strength[:, None] * strength[None, :] * product(fade, fade)


def inverse(a: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Inverse of a symmetric positive definite matrix by Gauss-Jordan sweeps, without a library call.

    (A call to LAPACK costs more than the arithmetic at this size, and loops over a batch.) No pivoting is needed.
    """

    def sweep(k: Int[Array, ""], a: Float[Array, "m m"]) -> Float[Array, "m m"]:
        row = jax.lax.dynamic_index_in_dim(a, k, 0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(a, k, 1, keepdims=False)
        here = jnp.arange(a.shape[0], dtype=jnp.int32) == k
        p = 1 / row[k]
        swept = a - (column * p)[:, None] * row[None, :]
        swept = jnp.where(here[:, None], (row * p)[None, :], swept)
        swept = jnp.where(here[None, :], -(column * p)[:, None], swept)
        return jnp.where(here[:, None] & here[None, :], p, swept)

    return jax.lax.fori_loop(0, a.shape[0], sweep, a)


def layered_step(
    factors: Layered,
    residual: Float[Array, "m *c"],
    layer: Int[Array, " m"],
    layers: int,
    width: int,
    clamp: Float[Array, "*m"] | float,
    budget: Float[Array, ""] | float,
    drag: bool = False,
) -> Float[Array, "m *c"]:
    """Coordinates `y` of the step in the row basis: `dm = y Q`. Those of a layer do not depend on the layers below it.

    residual: what each row should still move by, of one trial or of several (last axis). width: rows of one constraint; no
    constraint of a layer asks for more than `clamp` (one number, or one a row, the same for a whole layer). budget: the longest
    step in all, spent in order of priority (cutting the whole step would let a lower layer's long step shrink a higher
    one's). drag: whether the drag of `factorize` takes part.
    """
    trials = residual.reshape(residual.shape[0], -1)
    rest = (factors.rest if drag else jnp.zeros_like(factors.rest))[:, None]
    owner = layer[::width]
    below = (owner[None, :] < owner[:, None]).astype(residual.dtype)
    beside = owner[None, :] == owner[:, None]
    most = jnp.broadcast_to(jnp.asarray(clamp, residual.dtype), layer.shape)[::width, None]

    def squares(x: Float[Array, "m c"]) -> Float[Array, "b c"]:
        x = x.reshape(-1, width, x.shape[1])
        return jnp.sum(x * x, axis=1)

    def scaled(x: Float[Array, "m c"], by: Float[Array, "b c"]) -> Float[Array, "m c"]:
        return (x.reshape(-1, width, x.shape[1]) * by[:, None]).reshape(x.shape)

    def sweep(_: Int[Array, ""], y: Float[Array, "m c"]) -> Float[Array, "m c"]:
        r = trials - times(factors.carry, y)
        # one factor for a layer, that of its farthest constraint: weights keep their say
        length = safe_sqrt(squares(r))
        length = jnp.max(jnp.where(beside[..., None], length[None], jnp.zeros_like(length)), axis=1)
        # 1, not 0, where the length is 0: the derivative is that of what is not clamped
        far = length > most
        r = scaled(r, jnp.where(far, most / jnp.where(far, length, jnp.ones_like(length)), jnp.ones_like(length)))
        y = times(factors.pull, r) + rest
        # what the layers above have spent, and what this one asks for
        square = squares(y)
        left = safe_sqrt(budget**2 - times(below, square))
        asked = times(beside.astype(y.dtype), square)
        return scaled(y, jnp.where(asked > left * left, safe_divide(left, safe_sqrt(asked)), jnp.ones_like(asked)))

    # layer i is final after i + 1 sweeps
    return jax.lax.fori_loop(0, layers, sweep, jnp.zeros_like(trials)).reshape(residual.shape)


def outside(basis: Basis, z: Float[Array, " n"]) -> Float[Array, " n"]:
    """The part of `z` that no row sees: `P_N(J) z` of eq. 1, projected twice."""
    z = z - (basis.rows @ z) @ basis.rows
    return z - (basis.rows @ z) @ basis.rows


def solve(
    jacobian: Float[Array, "m n"],
    residual: Float[Array, " m"],
    layer: Int[Array, " m"],
    layers: int,
    damping: Float[Array, " m"],
    z: Float[Array, " n"] | None = None,
    clamp: float = jnp.inf,
    budget: float = jnp.inf,
) -> Float[Array, " n"]:
    """One whole step `dm` (n,): the recursion of section 3.2 with `k` layers, and `z` in what freedom is left (eq. 1).

    jacobian, residual: rows sorted by layer, the most important first (layer 0). damping: lambda of each row's layer.
    """
    factors = factorize(jacobian, layer, damping)
    y = layered_step(factors, residual, layer, layers, 1, clamp, budget)
    step = y @ factors.basis.rows
    return step if z is None else step + outside(factors.basis, z)
