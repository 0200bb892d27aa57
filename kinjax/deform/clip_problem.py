"""What the deformation of a whole clip minimises: its terms, their exact derivatives, and the bands of their matrix.

In: a chain, tasks and frames as `plan` lays them out, and weights. Out: `Problem`, which gives errors, Gauss-Newton matrix and
gradient for any displacement map. The formulas are in `whole_clip`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..rotations import exp
from .banded import Bands, times
from .chain import Chain, Pose, compose, forward, parent_rotations
from .sequence import Frames
from .tasks import Kinds, Tasks, levers, look, residuals

TOGETHER = 32
"""Frames whose second derivatives are worked out at once."""


class Weights(NamedTuple):
    """Of the terms: attraction (metres a radian), velocity (times the rate: metres a radian a frame) and acceleration (times its
    square)."""

    attraction: Float[Array, ""]
    velocity: Float[Array, ""]
    acceleration: Float[Array, ""]


class Errors(NamedTuple):
    """All terms of the sum of squares."""

    constraints: Float[Array, "f b 3"]
    attraction: Float[Array, "f n"]
    velocity: Float[Array, "f n"]
    acceleration: Float[Array, "f n"]


class Local(NamedTuple):
    """How each frame's 3 B constraint residuals grow with its displacement; of half the sum of all squares, the gradient and the
    second derivatives; turning: those of the residuals' part in them, without which it is the Gauss-Newton matrix."""

    jac: Float[Array, "f m n"]
    gradient: Float[Array, "f n"]
    bands: Bands
    turning: Float[Array, "f n n"]


class Problem(NamedTuple):
    """F frames and what is to be minimised over their displacements (F, 3 + 3 Q) of the root and Q joints.

    tasks: with the layers' weights in `scale`. spread: (P, Q) 1 where the column's joint is the row's of the chain; columns of
    zeros fill up. root_free: 0 where no constraint recruits the root's translation. valid: (F,) 0 for frames that are lost or
    only fill up; nothing is asked of them.
    """

    chain: Chain
    tasks: Tasks
    frames: Frames
    spread: Float[Array, "p q"]
    root_free: Float[Array, ""]
    valid: Float[Array, " f"]
    weights: Weights

    def pose(self, frame: Frames, u: Float[Array, " n"]) -> Pose:
        """One frame's input, displaced (trials C = 1)."""
        turn = jnp.matmul(self.spread, u[3:].reshape(-1, 3), precision="highest")
        q = compose(exp(turn.T), frame.rotations)
        return Pose(q[..., None], (frame.root + self.root_free * u[:3])[:, None])

    def asked(self, kinds: Kinds, frame: Frames, u: Float[Array, " n"]) -> Float[Array, "b 3"]:
        """What one frame's constraints leave."""
        world = forward(self.chain, self.pose(frame, u), frame.offsets)
        return residuals(self.tasks, frame.goals, look(self.tasks, frame.goals, world), kinds)[..., 0]

    def errors(self, kinds: Kinds, u: Float[Array, "f n"]) -> Errors:
        """All terms; what touches a frame that is not there is 0."""
        own = jax.vmap(partial(self.asked, kinds))(self.frames, u)
        pairs, triples = self._together()
        step = jnp.roll(u, -1, 0) - u
        bend = jnp.roll(step, -1, 0) - step
        w = self.weights
        return Errors(own, w.attraction * u, w.velocity * pairs * step, w.acceleration * triples * bend)

    def local(self, kinds: Kinds, u: Float[Array, "f n"]) -> Local:
        """Jacobian, gradient and matrix of second derivatives."""

        def all_of(x: tuple[Frames, Array]) -> tuple[Array, Array, Array]:
            frame, at = x

            def slope(x: Float[Array, " n"]) -> tuple[Array, tuple[Array, Array]]:
                jac, r = self.jacobian(kinds, frame, x)
                own = jnp.matmul(r, jac, precision="highest")
                return own, (jac, own)

            hessian, (jac, own) = jax.jacfwd(slope, has_aux=True)(at)
            return jac, own, (hessian + hessian.T) / 2

        # some at a time: on the way to its n x n matrix a frame takes 3 B times as much
        jac, gradient, hessian = jax.lax.map(all_of, (self.frames, u), batch_size=TOGETHER)
        smooth = self._smoothness(u.shape[1])
        bands = smooth._replace(diagonal=smooth.diagonal + hessian)
        turning = hessian - jnp.einsum("fmi,fmj->fij", jac, jac, precision="highest")
        return Local(jac, gradient + times(smooth, u), bands, turning)

    def bend(self, kinds: Kinds, u: Float[Array, "f n"], way: Float[Array, "f n"]) -> Float[Array, "f b 3"]:
        """The second derivative of the constraints' residuals along a way; that of the other terms is 0."""
        zero, one = jnp.zeros((), u.dtype), jnp.ones((), u.dtype)

        def along(s: Float[Array, ""]) -> Array:
            return jax.vmap(partial(self.asked, kinds))(self.frames, u + s * way)

        return jax.jvp(lambda s: jax.jvp(along, (s,), (one,))[1], (zero,), (one,))[1]

    def jacobian(
        self, kinds: Kinds, frame: Frames, u: Float[Array, " n"]
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """How one frame's 3 B residuals grow with its displacement, exactly, and the residuals.

        Only what a constraint sees is differentiated by JAX, with a twist of its body that is small and the same for all;
        what a joint twists it by is known in closed form. (Forward mode through the kinematics takes 30 times as long.)
        """
        pose = self.pose(frame, u)
        world = forward(self.chain, pose, frame.offsets)
        seen = look(self.tasks, frame.goals, world)

        def twisted(way: Float[Array, " 3"], turn: Float[Array, " 3"]) -> tuple[Array, Array]:
            rotation = seen.rotation + jnp.einsum("ik,bkjc->bijc", _cross(turn), seen.rotation, precision="highest")
            moved = seen._replace(point=seen.point + way[:, None], rotation=rotation)
            r = residuals(self.tasks, frame.goals, moved, kinds)[..., 0]
            return r, r

        none = jnp.zeros(3, u.dtype)
        (by_way, by_turn), r = jax.jacfwd(twisted, argnums=(0, 1), has_aux=True)(none, none)  # (B, 3 rows, 3) each
        # the reference's own motion is that of the body the other way round: residuals do not see what moves both
        arm, moves, rootward = levers(self.chain, self.tasks, seen, world[:-1, :, 3, 0])
        turn = jnp.matmul(self.spread, u[3:].reshape(-1, 3), precision="highest")
        axes = jnp.matmul(parent_rotations(self.chain, world), left_jacobian(turn), precision="highest")
        axes = jnp.einsum("pic,pq->qci", axes, self.spread, precision="highest")  # world axes of each unknown's turn
        arm = jnp.einsum("bpi,pq->bqi", arm, self.spread, precision="highest")
        moves = jnp.matmul(moves, self.spread, precision="highest")
        ways = jnp.cross(axes[None], arm[:, :, None, :])  # (B, Q, 3 unknowns, 3)
        turns = moves[:, :, None, None] * axes[None]
        columns = jnp.einsum("bri,bqci->brqc", by_way, ways, precision="highest")
        if kinds.turns or kinds.looks:
            columns = columns + jnp.einsum("bri,bqci->brqc", by_turn, turns, precision="highest")
        root = by_way * (rootward * self.root_free)[:, None, None]
        rows = r.size
        return jnp.concatenate([root.reshape(rows, 3), columns.reshape(rows, -1)], axis=1), r.reshape(rows)

    def _together(self) -> tuple[Float[Array, "f 1"], Float[Array, "f 1"]]:
        """1 for each frame that the next one, and the next two, are there with."""
        last = jnp.arange(self.valid.shape[0], dtype=jnp.int32)[::-1]
        one, two = jnp.roll(self.valid, -1), jnp.roll(self.valid, -2)
        pairs = jnp.where(last >= 1, self.valid * one, 0)
        return pairs[:, None], jnp.where(last >= 2, pairs * two, 0)[:, None]

    def _smoothness(self, n: int) -> Bands:
        """The matrix of the terms other than the constraints': multiples of the identity."""
        pairs, triples = (x[:, 0] for x in self._together())
        a, v, c = (w * w for w in self.weights)
        middle, end = (
            jnp.roll(triples, 1),
            jnp.roll(triples, 2),
        )  # a roll brings in zeros: none begins in the last frames
        diagonal = a + v * (pairs + jnp.roll(pairs, 1)) + c * (triples + 4 * middle + end)
        first = -v * pairs - 2 * c * (triples + middle)
        same = jnp.eye(n, dtype=diagonal.dtype)
        return Bands(*(x[:, None, None] * same for x in (diagonal, first, c * triples)))


def _cross(v: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """The matrix of `v x`."""
    return jnp.swapaxes(jnp.cross(v[..., None, :], jnp.eye(3, dtype=v.dtype)), -1, -2)


def left_jacobian(v: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """By what small turn, to be made after it, `exp(v)` changes with `v`: `exp(v + d) = exp(J d) exp(v)`."""
    square = jnp.sum(v * v, axis=-1)[..., None, None]
    small = square < 2.5e-3
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sine, across = (jnp.sin(angle / 2) / angle) ** 2, (angle - jnp.sin(angle)) / angle**3
    # by their series where the quotients would lose digits
    a = jnp.where(small, 0.5 - square / 24 + square * square / 720, 2 * sine)
    b = jnp.where(small, 1 / 6 - square / 120 + square * square / 5040, across)
    k = _cross(v)
    return jnp.eye(3, dtype=v.dtype) + a * k + b * jnp.matmul(k, k, precision="highest")
