"""Levenberg-Marquardt for the problem of a whole clip: optimistix' loop around banded linear steps.

In: a `Problem` that gives its errors, its Gauss-Newton matrix and its gradient, and a start. Out: `Found`. The matrix is kept by its
bands (`banded`), never as a Jacobian of the clip. Own are the descent (the damped banded solve), where the trust region
starts, and when to stop; the loop and the acceptance of steps are `optimistix.AbstractGaussNewton`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .banded import Bands, factorize, solve
from .tasks import Kinds

FIRST = 1e4
"""The first step size: the inverse of the damping."""

FLOOR = 10.0
"""Damping is at least so many rounding errors of the largest curvature."""


class Found(NamedTuple):
    """Displacements, half the sum of squares, the gradient with the largest size, how many steps were tried, and whether the
    undamped step that is left is below the tolerance."""

    value: Float[Array, "f n"]
    cost: Float[Array, ""]
    gradient: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class Local(eqx.Module):
    """The quadratic model at the last accepted displacements `at`, and how far those before were (`moved`, largest entry)."""

    at: Array
    bands: Bands
    gradient: Array
    moved: Array


class BandedDescent(optx.AbstractDescent):
    """The step `-(A + d I)^-1 g` of damping `d = 1 / step_size`, by block Cholesky."""

    problem: Any
    kinds: Kinds = eqx.field(static=True)

    def init(self, y: Any, f_info_struct: Any) -> Local:
        none = jnp.zeros((*y.shape, y.shape[1]), y.dtype)
        return Local(y, Bands(none, none, none), jnp.zeros_like(y), jnp.zeros((), y.dtype))

    def query(self, y: Any, f_info: Any, state: Local) -> Local:
        return Local(y, *self.problem.curvature(self.kinds, y), jnp.max(jnp.abs(y - state.at)))

    def step(self, step_size: Any, state: Local) -> Any:
        diagonal = state.bands.diagonal
        same = jnp.eye(diagonal.shape[1], dtype=diagonal.dtype)
        most = jnp.max(jnp.sum(jnp.abs(diagonal), axis=-1))
        damping = 1 / step_size + FLOOR * jnp.finfo(diagonal.dtype).eps * most
        factors = factorize(state.bands._replace(diagonal=diagonal + damping * same))
        # where rounding leaves it not positive definite: so short a way down that the model holds
        down = state.gradient / (damping + 4 * most)
        return -jnp.where(factors.sound, solve(factors, state.gradient), down), optx.RESULTS.successful


class TrustRegion(optx.ClassicalTrustRegion):
    """optimistix' classical one that starts with little damping: steps are long where the problem is nearly linear."""

    def init(self, y: Any, f_info_struct: Any) -> Any:
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, jnp.asarray(FIRST, y.dtype))


class BandedLevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt with a `BandedDescent`, for at most `steps` trials.

    It stops where the undamped step would be shorter than `tolerance`: a damped one is that long, at least, divided by
    1 + damping / (least curvature), and no curvature is below `least`.
    """

    descent: BandedDescent
    search: TrustRegion
    steps: Any
    tolerance: Any
    least: Any
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = optx.max_norm
    verbose: Callable = eqx.field(static=True, default=lambda **_: None)

    def converged(self, state: Any) -> Any:
        """Whether the last trial was accepted and led to nothing new."""
        taken = (state.num_steps_since_acceptance == 0) & (state.num_accepted_steps > 1)
        damping = self.search.high_constant / state.search_state.step_size
        return taken & (state.descent_state.moved * (1 + damping / self.least) < self.tolerance)

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
        return self.converged(state) | (state.num_steps > self.steps), state.result


def minimise(problem: Any, kinds: Kinds, start: Array, steps: Array, tolerance: Array) -> Found:
    """The displacements near `start` of the least sum of squares."""
    search = TrustRegion(high_cutoff=0.75, low_cutoff=0.01, high_constant=10.0, low_constant=0.1)
    least = problem.weights.attraction**2
    solver = BandedLevenbergMarquardt(BandedDescent(problem, kinds), search, steps, tolerance, least)
    got: Any = optx.least_squares(lambda u, p: p.errors(kinds, u), solver, start, problem, max_steps=None, throw=False)
    left = problem.errors(kinds, got.value)
    cost = sum(jnp.sum(x * x) for x in left) / 2
    gradient = jnp.max(jnp.abs(problem.curvature(kinds, got.value)[1]))
    return Found(got.value, cost, gradient, got.stats["num_steps"], solver.converged(got.state))
