"""The nonlinear solve of one frame: prioritized steps, tried, corrected, and accepted in lexicographic order.

In: a start pose, the frame's goals and the input's pose. Out: the pose that serves the layers in order, and what it leaves.

The linear guarantee does not survive the step (2004 paper, section 3.2, says nothing on it), so each iteration moves to
several candidates at once: everything with the attraction to the input, and each prefix of the layers without it. Each is
corrected once by the same factors, in the layers above its last: what the step's curvature did to them is undone. The
candidate that is best in lexicographic order is kept, the pose as it is among them: no layer is ever worsened for a lower
one by more than a slack.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..numerics import safe_divide, safe_sqrt
from ..rotations import log
from .chain import Chain, Pose, World, compose, forward, inverse_of, moved, parent_rotations
from .prioritized import factorize, layered_step, outside
from .tasks import Goals, Kinds, Tasks, jacobian, look, residuals


class Solving(NamedTuple):
    """Numbers of the solver (metres and radians): see `settings.Settings`."""

    clamp: float = 0.1
    budget: float = 1.0
    damping: float = 0.3
    damped_error: float = 0.05
    slack: float = 1e-6
    slack_ratio: float = 1e-4
    tolerance: float = 1e-5
    iterations: float = 10


class Tried(NamedTuple):
    """Candidates: their steps in the row basis, where they lead, and what they leave."""

    along: Float[Array, "m c"]
    pose: Pose
    world: World
    residual: Float[Array, "m c"]
    errors: Float[Array, "layers c"]


class Reference(NamedTuple):
    """What the pose is attracted to: the input's (4, P) rotations and (3,) root, and how strongly each joint is (0 or 1)."""

    rotations: Float[Array, "4 p"]
    root: Float[Array, " 3"]
    attracted: Float[Array, " p"]
    root_attracted: Float[Array, ""]


class State(NamedTuple):
    """One pose (trials C = 1) with everything that follows from it.

    solo: (B,) how much of each constraint's residual its own recruited joints could still remove, as the cosine between it
    and what they can do (0: out of reach). own: (N,) the same of each layer with what the layers above leave it (0: nothing
    more to gain). rank: (N,) freedoms that each layer took. Those three are of the pose before the last step. stayed: no
    candidate was better than the pose as it was.
    """

    pose: Pose
    world: World
    residual: Float[Array, "b 3"]
    errors: Float[Array, " layers"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]
    stayed: Bool[Array, ""]
    rank: Int[Array, " layers"]
    solo: Float[Array, " b"]
    own: Float[Array, " layers"]


def solve_frame(
    chain: Chain,
    tasks: Tasks,
    goals: Goals,
    start: Pose,
    offsets: Float[Array, "p 3"],
    reference: Reference,
    layers: int,
    solving: Solving,
    kinds: Kinds,
) -> State:
    """Iterate from `start` until nothing is gained, `solving.iterations` times at most."""
    rows = jnp.repeat(tasks.layer, 3)
    members = (rows[None, :] == jnp.arange(layers, dtype=jnp.int32)[:, None]).astype(offsets.dtype)  # (N, m)
    block = jnp.kron(jnp.eye(tasks.kind.shape[0], dtype=offsets.dtype), jnp.ones((3, 3), offsets.dtype))

    def evaluate(pose: Pose) -> tuple[World, Float[Array, "m c"], Float[Array, "n c"]]:
        world = forward(chain, pose, offsets)
        seen = look(tasks, goals, world)
        r = residuals(tasks, goals, seen, kinds)
        r = r.reshape(-1, r.shape[-1])
        return world, r, safe_sqrt(jnp.einsum("nm,mc->nc", members, r * r, precision="highest"))

    def iterate(s: State) -> State:
        seen = look(tasks, goals, s.world)
        r0 = s.residual.reshape(-1)
        jac = jacobian(chain, tasks, goals, s.world, seen, kinds)
        error = members.T @ s.errors
        damping = solving.damping * jnp.minimum(1, error / solving.damped_error)
        factors = factorize(jac, rows, damping)
        y = layered_step(factors, r0, rows, layers, block, solving.clamp, solving.budget)
        parent = parent_rotations(chain, s.world)
        z = attraction(reference, s.pose, parent)
        z = outside(factors.basis, z)
        left = safe_sqrt(solving.budget**2 - y @ y)
        z = z * jnp.minimum(1, safe_divide(left, safe_sqrt(z @ z)))
        # candidates: all with z, layers 0..N-1, 0..N-2, ..., 0
        depth = jnp.concatenate([jnp.full((1,), layers, jnp.int32), jnp.arange(layers, 0, -1, dtype=jnp.int32)])
        use = (rows[:, None] < depth[None, :]).astype(jac.dtype)
        posture = (jnp.arange(layers + 1, dtype=jnp.int32) == 0).astype(jac.dtype)
        expected = r0[:, None] - factors.basis.factors @ (y[:, None] * use)
        correct = jax.vmap(
            lambda r: layered_step(factors, r, rows, layers, block, solving.clamp, solving.budget),
            in_axes=1,
            out_axes=1,
        )
        # the layers above the last of a candidate (all of them, under posture) take back what the step's curvature did
        mend = (rows[:, None] < jnp.maximum(depth - 1 + posture.astype(jnp.int32), 1)[None, :]).astype(jac.dtype)

        def attempt(_: Int[Array, ""], tried: Tried) -> Tried:
            along = tried.along + mend * correct(tried.residual - expected)
            trial = moved(chain, s.pose, parent, factors.basis.rows.T @ along + z[:, None] * posture[None, :])
            return Tried(along, trial, *evaluate(trial))

        # nothing has gone wrong before the first attempt: its residuals are those expected
        spread = jax.tree.map(lambda x: jnp.repeat(x, layers + 1, axis=-1), (s.pose, s.world))
        none = Tried(y[:, None] * use, *spread, expected, s.errors[:, None] + 0 * posture)
        along, trial, world, r, errors = jax.lax.fori_loop(0, 2, attempt, none)
        step = factors.basis.rows.T @ along + z[:, None] * posture[None, :]
        everything = jnp.concatenate([errors, s.errors[:, None]], axis=1)
        best = lexicographic(everything, solving)
        stay = best == layers + 1
        pick = jnp.minimum(best, layers)
        take = lambda x, old: jnp.where(stay, old, jax.lax.dynamic_index_in_dim(x, pick, x.ndim - 1, keepdims=True))
        kept = take(step, jnp.zeros_like(step[:, :1]))
        done = stay | (jnp.max(jnp.abs(kept)) < solving.tolerance)
        residual = jnp.where(stay, r0, jax.lax.dynamic_index_in_dim(r, pick, 1, keepdims=False))
        solo, own = _gains(factors.basis.factors, jac, r0, rows, members)
        return State(
            Pose(take(trial.rotations, s.pose.rotations), take(trial.root, s.pose.root)),
            take(world, s.world),
            residual.reshape(-1, 3),
            jnp.where(stay, s.errors, jax.lax.dynamic_index_in_dim(errors, pick, 1, keepdims=False)),
            s.iterations + 1,
            done,
            stay,
            (members @ jnp.sum(factors.basis.rows**2, axis=1)).round().astype(jnp.int32),
            solo,
            own,
        )

    world, r, errors = evaluate(start)
    b = tasks.kind.shape[0]
    first = State(
        start,
        world,
        r[:, 0].reshape(-1, 3),
        errors[:, 0],
        jnp.zeros((), jnp.int32),
        ~(jnp.any(goals.active > 0) & jnp.isfinite(errors).all()),
        jnp.zeros((), bool),
        jnp.zeros(layers, jnp.int32),
        jnp.ones(b, offsets.dtype),
        jnp.ones(layers, offsets.dtype),
    )
    return jax.lax.while_loop(lambda s: (s.iterations < solving.iterations) & ~s.done, iterate, first)


def _gains(
    factors: Float[Array, "m m"],
    jac: Float[Array, "m n"],
    r: Float[Array, " m"],
    rows: Int[Array, " m"],
    members: Float[Array, "layers m"],
) -> tuple[Float[Array, " b"], Float[Array, " layers"]]:
    """`solo` and `own` of `State`, from the factors `J = R Q`: lengths of gradients `J' r` are lengths of `R' r`."""
    size = jnp.sum(jac * jac, axis=1)
    pull = (factors * r[:, None]).reshape(-1, 3, r.shape[0]).sum(1)  # (B, m): each constraint's R' r
    whole = safe_sqrt(size.reshape(-1, 3).sum(1)) * safe_sqrt((r * r).reshape(-1, 3).sum(1))
    solo = safe_divide(safe_sqrt((pull * pull).sum(1)), whole)
    same = (rows[:, None] == rows[None, :]).astype(jac.dtype)
    left = members @ (factors * same * r[:, None])  # (N, m): each layer's own R_ii' r
    layer = safe_sqrt(members @ size) * safe_sqrt(members @ (r * r))
    return solo, safe_divide(safe_sqrt((left * left).sum(1)), layer)


def attraction(reference: Reference, pose: Pose, parent: Float[Array, "p 3 3"]) -> Float[Array, " n"]:
    """The optimization vector `z` of eq. 1: the step along world axes that would take the pose back to the input."""
    q = pose.rotations[:, :, 0]
    turn = log(compose(reference.rotations, inverse_of(q))) * reference.attracted
    turn = jnp.sum(parent * turn.T[:, None, :], axis=-1)  # (P, 3), from the parent's frame to the world
    root = (reference.root - pose.root[:, 0]) * reference.root_attracted
    return jnp.concatenate([root, turn.reshape(-1)])


def lexicographic(errors: Float[Array, "layers c"], solving: Solving) -> Int[Array, ""]:
    """The first candidate among those that no other beats: layer by layer, whoever is worse than the best by more than
    `max(slack, slack_ratio * best)` is out."""

    def narrow(i: Int[Array, ""], alive: Bool[Array, " c"]) -> Bool[Array, " c"]:
        e = jax.lax.dynamic_index_in_dim(errors, i, 0, keepdims=False)
        best = jnp.min(jnp.where(alive, e, jnp.inf))
        return alive & (e <= best + jnp.maximum(solving.slack, solving.slack_ratio * best))

    alive = jax.lax.fori_loop(0, errors.shape[0], narrow, jnp.isfinite(errors).all(0))
    return jnp.argmax(alive).astype(jnp.int32)
