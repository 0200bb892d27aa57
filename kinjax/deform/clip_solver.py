"""Levenberg-Marquardt for the problem of a whole clip: optimistix' loop around banded linear steps.

In: a `Problem` that gives its errors and their derivatives, and a start. Out: `Found`. The matrix is kept by its
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

from ..numerics import safe_divide
from .banded import Factors, factorize, solve
from .clip_problem import Local
from .tasks import Kinds

FIRST = 1e4
"""The first step size: the inverse of the damping."""

FLOOR = 2.0
"""Damping is at least so many rounding errors of the largest curvature."""

ALIKE = 32.0
"""Two sums of squares are the same if they differ by no more than so many rounding errors: they have thousands of terms."""

LITTLE, MUCH, FASTER = 0.01, 0.75, 5.0
"""A step is taken that gains the share LITTLE of what was hoped for; the step size grows by FASTER where it gains MUCH, and
shrinks by it where the step is refused."""

SLOW = 1e-3
"""In float32 a step that gains a smaller share of the sum is the last."""

LONGEST = 0.5
"""Radians or metres that any unknown moves by in one step at most, bends apart."""

MOST_ASIDE = 0.4
"""A step is bent by no more than this share of its length."""


class Found(NamedTuple):
    """Displacements, half the sum of squares, the gradient with the largest size, how many steps were tried, and whether the
    undamped step that is left is below the tolerance."""

    value: Float[Array, "f n"]
    cost: Float[Array, ""]
    gradient: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class Model(eqx.Module):
    """What is known at the last accepted displacements `at`: `local` derivatives, how far those before were (`moved`, largest
    entry), a bound of the curvature (`most`), the `cost` and what was `gained` by the last step."""

    at: Array
    local: Local
    moved: Array
    most: Array
    cost: Array
    gained: Array


def damping_of(step_size: Array, most: Array) -> Array:
    """What is added to the diagonal: never less than the rounding of the largest curvature."""
    return 1 / step_size + FLOOR * jnp.finfo(step_size.dtype).eps * most


class BandedDescent(optx.AbstractDescent):
    """The step `v = -(H + d I)^-1 g` of damping `d = 1 / step_size`, by block Cholesky, and along its parabola.

    `H` has the second derivatives of the residuals in it, where it is positive definite with them (near a minimum): along the
    valley below they are as large as the weak terms that decide there, and by the Gauss-Newton matrix alone steps swing
    from side to side. Elsewhere it is that matrix.

    The minimum lies in a narrow curved valley: weak terms along it, the constraints across. So half of the acceleration
    `-(H + d I)^-1 J' r''(v, v)` is added to the step: it bends the way so that the residuals stay as the linear model has
    them (geodesic acceleration, Transtrum and Sethna 2012), for one more solve with the same factors.
    """

    problem: Any
    kinds: Kinds = eqx.field(static=True)

    def init(self, y: Any, f_info_struct: Any) -> Model:
        like = jax.eval_shape(lambda u: self.problem.local(self.kinds, u), y)
        none = jnp.zeros((), y.dtype)
        return Model(y, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like), none, none, none, none)

    def query(self, y: Any, f_info: Any, state: Model) -> Model:
        local = self.problem.local(self.kinds, y)
        most = 4 * jnp.max(jnp.sum(jnp.abs(local.bands.diagonal), axis=-1))
        cost = f_info.as_min()
        return Model(y, local, jnp.max(jnp.abs(y - state.at)), most, cost, state.cost - cost)

    def step(self, step_size: Any, state: Model) -> Any:
        jac, gradient, bands, _ = state.local
        damping = damping_of(step_size, state.most)
        same = jnp.eye(jac.shape[-1], dtype=jac.dtype)
        newton = factorize(bands._replace(diagonal=bands.diagonal + damping * same))

        def gauss() -> Factors:
            diagonal = bands.diagonal - state.local.turning + damping * same
            return factorize(bands._replace(diagonal=diagonal))

        factors = jax.lax.cond(newton.sound, lambda: newton, gauss)
        straight = -solve(factors, gradient)
        bend = self.problem.bend(self.kinds, state.at, straight).reshape(jac.shape[:2])
        aside = -solve(factors, jnp.einsum("fm,fmn->fn", bend, jac, precision="highest")) / 2
        # half turns and more look near to rotations, and are far: no step is so long
        short = jnp.minimum(1, safe_divide(LONGEST * jnp.ones_like(damping), jnp.max(jnp.abs(straight))))
        short = jnp.where(short > 0, short, 1)
        usable = short**2 * jnp.sum(aside * aside) <= MOST_ASIDE**2 * jnp.sum(straight * straight)
        step = short * straight + jnp.where(usable, short**2 * aside, 0)
        # where rounding leaves neither positive definite: a way up, which is refused, and more damping follows
        up = gradient / (damping + state.most)
        return jnp.where(factors.sound, step, up), optx.RESULTS.successful


class TrustRegion(optx.AbstractSearch):
    """Takes a step that gains a share of what the model of second order, which `BandedDescent` follows, hopes for; its state is
    the step size, which grows where most of that came true.

    Steps that gain or lose no more than the rounding of the sum are taken: near the minimum the step itself tells more
    than what it gains.
    """

    problem: Any
    kinds: Kinds = eqx.field(static=True)

    def init(self, y: Any, f_info_struct: Any) -> Any:
        return jnp.asarray(FIRST, y.dtype)

    def step(self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: Any) -> Any:
        way = y_eval - y
        ahead = jax.tree.map(jnp.add, f_info.residual, f_info.jac.mv(way))
        ahead = ahead._replace(constraints=ahead.constraints + self.problem.bend(self.kinds, y, way) / 2)
        before, now = f_info.as_min(), f_eval_info.as_min()
        hoped = sum((jnp.sum(x * x) for x in ahead[1:]), jnp.sum(ahead[0] * ahead[0])) / 2 - before
        level = ALIKE * jnp.finfo(now.dtype).eps * before
        equal = (jnp.abs(now - before) <= level) & (jnp.abs(hoped) <= level)
        taken = ((now < before) & (now - before <= LITTLE * hoped)) | equal | first_step
        good = (now - before < MUCH * hoped) & (hoped < 0) & ~first_step
        size = state * jnp.where(good, FASTER, jnp.where(taken, 1, 1 / FASTER))
        return size, taken, optx.RESULTS.successful, size


class BandedLevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt with a `BandedDescent`, for at most `steps` trials.

    It stops where the undamped step would be shorter than `tolerance`: a damped one is as long, at least, divided by
    1 + damping / `least`, the least curvature that there can be. Where rounding hides curvatures of that size (float32), it
    stops at a step that gains less than the share `SLOW` of the sum.
    """

    rtol: float
    atol: float
    norm: Callable
    descent: BandedDescent
    search: TrustRegion
    verbose: Callable
    steps: Any
    tolerance: Any
    least: Any

    def converged(self, state: Any) -> Any:
        """Whether the last trial was accepted and led to nothing new."""
        taken = (state.num_steps_since_acceptance == 0) & (state.num_accepted_steps > 1)
        model = state.descent_state
        damping = damping_of(state.search_state / FASTER, model.most)
        short = model.moved * (1 + damping / self.least) < self.tolerance
        blunt = FLOOR * jnp.finfo(model.most.dtype).eps * model.most > self.least
        return taken & (short | (blunt & (model.gained <= SLOW * model.cost)))

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
        return self.converged(state) | (state.num_steps > self.steps), state.result


def minimise(problem: Any, kinds: Kinds, start: Array, steps: Array, tolerance: Array) -> Found:
    """The displacements near `start` of the least sum of squares."""
    solver: Any = BandedLevenbergMarquardt(
        rtol=0.0,
        atol=0.0,
        norm=optx.max_norm,
        descent=BandedDescent(problem, kinds),
        search=TrustRegion(problem, kinds),
        verbose=_quiet,
        steps=steps,
        tolerance=tolerance,
        least=problem.weights.attraction**2,
    )
    got: Any = optx.least_squares(lambda u, p: p.errors(kinds, u), solver, start, problem, max_steps=None, throw=False)
    left = problem.errors(kinds, got.value)
    cost = sum((jnp.sum(x * x) for x in left[1:]), jnp.sum(left[0] * left[0])) / 2
    gradient = jnp.max(jnp.abs(problem.local(kinds, got.value).gradient))
    return Found(got.value, cost, gradient, got.stats["num_steps"], solver.converged(got.state))


def _quiet(**_: Any) -> None:
    """Says nothing."""
