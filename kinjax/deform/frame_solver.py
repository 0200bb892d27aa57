"""The nonlinear solve of one frame: prioritized steps, tried, corrected, and accepted in lexicographic order.

In: a start pose, the frame's goals and the input's pose. Out: the pose that serves the layers in order, and what it leaves.

The linear guarantee does not survive the step (2004 paper, section 3.2, says nothing on it), so each iteration moves to
several candidates at once: everything with the attraction to the input, and each prefix of the layers without it. Each is
corrected once by the same factors, in the layers above its last: what the step's curvature did to them is undone. The
candidate that is best in lexicographic order is kept, the pose as it is among them.

That still lets a lower layer lead a higher one, which does not arrive, into another corner than it would have found alone. So
where a layer that has others below it keeps an error, the frame is solved again for the first layer alone, for the first
two, and so on; each time the result must leave the layers above as the one before left them, or it starts from there under
that cap. The bound `err_i(all) <= err_i(without the lower ones) + slack` then holds by construction.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..numerics import safe_divide, safe_sqrt
from ..rotations import log
from .chain import Chain, Pose, World, answers, compose, forward, inverse_of, parent_rotations, stepped
from .loops import Loop, plain
from .prioritized import combined, factorize, layered_step, outside, times
from .tasks import CENTER_OF_MASS, Goals, Kinds, Tasks, jacobian, look, residuals

PULLS = (1.0, 0.25)
"""Shares of the attraction (of as much of it as is trusted) that are tried."""


LEAST = 1 / 64
"""The least that a layer is trusted with."""


class Solving(NamedTuple):
    """Numbers of the solver (metres and radians): see `settings.Settings`."""

    clamp: float = 0.1
    budget: float = 1.0
    damping: float = 0.3
    damped_error: float = 0.05
    slack: float = 1e-7
    slack_ratio: float = 1e-4
    tolerance: float = 1e-5
    iterations: int = 10
    drag: Array | float = 0.2
    singular: float = 0.12


class Tried(NamedTuple):
    """Candidates: their steps in the row basis, where they lead, and what they leave."""

    along: Float[Array, "m c"]
    pose: Pose
    world: World
    residual: Float[Array, "m c"]
    errors: Float[Array, "layers c"]
    best: Int[Array, ""]
    times: Int[Array, ""]


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
    candidate was better than the pose as it was. travel: (n,) the steps since the frame began, all together. trust:
    (N,) how much of its clamp each layer asks for: one that was refused asks for less the next time.
    pull: how much of the attraction is asked for, so that what it costs the constraints stays within its slack.
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
    travel: Float[Array, " n"]
    trust: Float[Array, " layers"]
    pull: Float[Array, ""]


class Attempt(NamedTuple):
    """One run of the iteration within a frame, and what the next is to start from.

    now: where it is. depth: layers that count. caps: (N,) errors that layers above the last must not exceed. whole: what all
    layers together led to, from the start. upper: what the layers above `depth` led to. capped: this run starts from
    `upper`. runs: how many there were.
    """

    now: State
    depth: Int[Array, ""]
    caps: Float[Array, " layers"]
    whole: State
    upper: State
    capped: Bool[Array, ""]
    runs: Int[Array, ""]
    over: Bool[Array, ""]


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
    trust: Float[Array, " layers"],
    pull: Float[Array, ""],
    drag: Float[Array, ""] | float = 1.0,
    loop: Loop = plain,
) -> State:
    """Iterate from `start` until nothing is gained, `solving.iterations` times at most in each run. drag: 0 for a frame that has
    none before it, from which to move smoothly. loop: how loops are run (`loops`)."""
    solving = solving._replace(drag=solving.drag * drag)
    step = _Iteration(chain, tasks, goals, offsets, reference, layers, solving, kinds, loop)
    first = step.begin(start, trust, pull)
    # layers below the last active one are not there
    every = 1 + jnp.max(jnp.where(goals.active > 0, tasks.layer, -1)).astype(jnp.int32)
    free = jnp.full_like(first.errors, jnp.inf)
    low = jnp.arange(layers, dtype=jnp.int32)

    def run(a: Attempt) -> Attempt:
        end = loop(
            lambda s: (s.iterations < solving.iterations) & ~s.done, lambda s: step.iterate(s, a.depth, a.caps), a.now
        )
        # 0: all layers; then for depth 1, 2, ...: from the start, and from `upper` where that one broke the caps
        begun = a.runs == 0
        whole = _select(begun, end, a.whole)
        left = jnp.any((end.errors > solving.slack) & (low < every - 1))
        limit = a.upper.errors + jnp.maximum(solving.slack, solving.slack_ratio * a.upper.errors)
        broken = ~a.capped & ~begun & jnp.any((end.errors > limit) & (low < a.depth - 1))
        upper = _select(begun | broken, a.upper, end)
        depth = jnp.where(begun, 1, jnp.where(broken, a.depth, a.depth + 1)).astype(jnp.int32)
        # the last depth is that of run 0: what it found is looked at, not solved again
        last = ~begun & ~broken & (depth == every)
        limit = upper.errors + jnp.maximum(solving.slack, solving.slack_ratio * upper.errors)
        fits = ~jnp.any((whole.errors > limit) & (low < every - 1))
        capped = broken | (last & ~fits)
        over = (begun & ~left) | (last & fits) | (depth > every)
        now = _select(capped, upper._replace(iterations=0 * end.iterations, done=~jnp.ones_like(end.done)), first)
        now = _select(over, _select(begun | (last & fits), whole, end), now)
        caps = jnp.where(capped & (low < depth - 1), limit, free)
        return Attempt(now, depth, caps, whole, upper, capped, a.runs + 1, over)

    none = jnp.zeros((), bool)
    attempt = Attempt(first, every, free, first, first, none, jnp.zeros((), jnp.int32), none)
    return loop(lambda a: ~a.over, run, attempt).now


def _select(which: Bool[Array, ""], a: State, b: State) -> State:
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)


class _Iteration:
    """The iteration of one frame: everything that does not change while it runs."""

    def __init__(self, chain, tasks, goals, offsets, reference, layers, solving, kinds, loop):
        self.loop = loop
        self.chain, self.tasks, self.goals, self.offsets = chain, tasks, goals, offsets
        self.reference, self.layers, self.solving, self.kinds = reference, layers, solving, kinds
        self.rows = jnp.repeat(tasks.layer, 3)
        self.limbs = jnp.repeat(tasks.kind, 3) != CENTER_OF_MASS  # a centre of mass has no joint that snaps
        self.members = (self.rows[None, :] == jnp.arange(layers, dtype=jnp.int32)[:, None]).astype(offsets.dtype)

    def evaluate(self, pose: Pose) -> tuple[World, Float[Array, "m c"], Float[Array, "layers c"]]:
        """World transforms, residuals and each layer's error of all trials."""
        world = forward(self.chain, pose, self.offsets)
        r = residuals(self.tasks, self.goals, look(self.tasks, self.goals, world), self.kinds)
        r = r.reshape(-1, r.shape[-1])
        return world, r, safe_sqrt(times(self.members, r * r))

    def begin(self, pose: Pose, trust: Float[Array, " layers"], pull: Float[Array, ""]) -> State:
        """The state before the first iteration; done where nothing is asked, or where it is not finite."""
        world, r, errors = self.evaluate(pose)
        dtype = r.dtype
        return State(
            pose,
            world,
            r[:, 0].reshape(-1, 3),
            errors[:, 0],
            jnp.zeros((), jnp.int32),
            ~(jnp.any(self.goals.active > 0) & jnp.isfinite(errors).all()),
            jnp.zeros((), bool),
            jnp.zeros(self.layers, jnp.int32),
            jnp.ones(self.tasks.kind.shape[0], dtype),
            jnp.ones(self.layers, dtype),
            jnp.zeros(3 + 3 * self.offsets.shape[0], dtype),
            trust,
            pull,
        )

    def iterate(self, s: State, depth: Int[Array, ""], caps: Float[Array, " layers"]) -> State:
        """One iteration for the first `depth` layers."""
        solving, rows, layers, members = self.solving, self.rows, self.layers, self.members
        counts = (rows < depth).astype(self.offsets.dtype)
        seen = look(self.tasks, self.goals, s.world)
        r0 = s.residual.reshape(-1) * counts
        jac = jacobian(self.chain, self.tasks, self.goals, s.world, seen, self.kinds) * counts[:, None]
        damping = solving.damping * jnp.minimum(1, (members.T @ s.errors) / solving.damped_error)
        held = jnp.where((rows == depth - 1) & self.limbs, solving.drag, 0.0).astype(jac.dtype)
        factors = factorize(jac, rows, damping, (held, solving.singular), s.travel)
        across = factors.basis.rows
        correct = partial(layered_step, factors, layer=rows, layers=layers, width=3, budget=solving.budget)
        y = correct(r0, clamp=solving.clamp * s.trust[rows], drag=True)
        parent = parent_rotations(self.chain, s.world)
        z = outside(factors.basis, attraction(self.reference, s.pose, parent))
        left, asked = safe_sqrt(solving.budget**2 - y @ y), safe_sqrt(z @ z)
        z = z * jnp.where(asked > left, safe_divide(left, asked), jnp.ones_like(asked))
        # candidates: all layers with z, with less of it, then all without it, all but the last, ..., the first alone
        pulls = len(PULLS)
        last = jnp.concatenate([jnp.full((pulls,), layers, jnp.int32), jnp.arange(layers, 0, -1, dtype=jnp.int32)])
        posture = jnp.concatenate([s.pull * jnp.asarray(PULLS, jac.dtype), jnp.zeros(layers, jac.dtype)])
        use = (rows[:, None] < last[None, :]).astype(jac.dtype)
        # what a step may leave: of the last layer what damping left, of those above it nothing
        expected = r0[:, None] - times(factors.basis.factors, y[:, None] * use)
        expected = jnp.where((rows < depth - 1)[:, None], jnp.zeros_like(expected), expected)
        # the layers above the last of a candidate (all of them, under posture) take back what the step left besides
        mend = (
            rows[:, None] < jnp.maximum(last - (jnp.arange(layers + pulls) >= pulls).astype(jnp.int32), 1)[None, :]
        ).astype(jac.dtype)
        fix = partial(correct, clamp=solving.clamp)

        below = jnp.arange(layers, dtype=jnp.int32)[:, None] >= depth

        def wrong(r: Float[Array, "m c"]) -> Float[Array, "m c"]:
            return mend * (r * counts[:, None] - expected)

        # of all trials the same: how the pose answers, and the steps of its joints axis by axis
        answer = answers(s.pose, parent)
        turns, home = (jnp.swapaxes(x[..., 3:].reshape(*x.shape[:-1], -1, 3), -1, -2) for x in (across, z))

        def attempt(tried: Tried) -> Tried:
            # nothing has gone wrong before the first attempt
            along = jax.lax.cond(
                tried.times > 0, lambda: tried.along + mend * fix(wrong(tried.residual)), lambda: tried.along
            )
            turn = combined(turns, along) + posture[:, None, None] * home
            root = combined(across[:, :3], along) + posture[:, None] * z[:3]
            trial = stepped(self.chain, s.pose, answer, root.T, jnp.swapaxes(turn, 0, 1))
            world, r, errors = self.evaluate(trial)
            everything = jnp.concatenate([errors, s.errors[:, None]], axis=1)
            allowed = (everything <= caps[:, None]).all(0).at[-1].set(True)
            best = lexicographic(jnp.where(below, 0, everything), allowed, solving)
            return Tried(along, trial, world, r, errors, best, tried.times + 1)

        def unsettled(tried: Tried) -> Bool[Array, ""]:
            # one correction where the step was curved, two more where all layers together, posture apart, are still refused
            curved = jnp.max(jnp.abs(wrong(tried.residual))) > 0.1 * solving.slack
            return (tried.times < 1) | (curved & ((tried.times < 2) | ((tried.times < 4) & (tried.best > pulls))))

        # nothing has gone wrong before the first attempt: its residuals are those expected
        spread = jax.tree.map(lambda x: jnp.repeat(x, layers + pulls, axis=-1), (s.pose, s.world))
        zero = jnp.zeros((), jnp.int32)
        none = Tried(y[:, None] * use, spread[0], spread[1], expected, s.errors[:, None] + 0 * posture, zero, zero)
        along, trial, world, r, errors, best, _ = self.loop(unsettled, attempt, none)
        everything = jnp.concatenate([errors, s.errors[:, None]], axis=1)
        stay = best == layers + pulls
        pick = jnp.minimum(best, layers + pulls - 1)

        def take(x: Array, old: Array) -> Array:
            return jnp.where(stay, old, jax.lax.dynamic_index_in_dim(x, pick, x.ndim - 1, keepdims=True))

        kept = take(along, jnp.zeros_like(y)[:, None])[:, 0] @ across + take(posture, jnp.zeros_like(posture[:1])) * z
        # what the whole attraction cost, and how much of it would cost half the slack (the cost grows with its square)
        best_yet = jnp.min(everything, axis=1)
        room = jnp.maximum(solving.slack, solving.slack_ratio * best_yet)
        cost = jnp.max(jnp.where(below[:, 0], 0, (everything[:, 0] - best_yet) / room))
        pull = jnp.clip(s.pull * jnp.clip(safe_sqrt(safe_divide(0.5 * jnp.ones_like(cost), cost)), 1 / 8, 2), 1e-4, 1)
        pull = jnp.where(cost > 0, pull, jnp.minimum(2 * s.pull, 1))
        # where a layer keeps an error, the attraction bends a stretched limb that the layer stretches again: no more of it then
        far = jnp.any((best_yet > jnp.maximum(solving.slack, 0.5 * s.errors)) & ~below[:, 0])
        pull = jnp.where(far, jnp.minimum(pull, s.pull), pull)
        waiting = (best >= pulls) & (s.pull > 1e-3) & (jnp.max(jnp.abs(z)) > solving.tolerance)
        refused = jnp.arange(layers, dtype=jnp.int32) == layers + pulls - best
        waiting |= jnp.any(refused & (s.trust > LEAST) & (s.errors > solving.slack) & ~below[:, 0])
        solo, own = _gains(factors.basis.factors, jac, r0, rows, members)
        return State(
            jax.tree.map(take, trial, s.pose),
            take(world, s.world),
            take(r, s.residual.reshape(-1, 1)).reshape(-1, 3),
            take(errors, s.errors[:, None])[:, 0],
            s.iterations + 1,
            (stay | (jnp.max(jnp.abs(kept)) < solving.tolerance)) & ~waiting,
            stay,
            (members @ jnp.sum(across**2, axis=1)).round().astype(jnp.int32),
            solo,
            own,
            s.travel + kept,
            self._trust(s.trust, best),
            pull,
        )

    def _trust(self, trust: Float[Array, " layers"], best: Int[Array, ""]) -> Float[Array, " layers"]:
        """Twice the trust for the layers of the candidate that was kept, half for the first that was refused; what lies below
        could not be judged."""
        level = jnp.arange(self.layers, dtype=jnp.int32)
        kept = jnp.where(best < len(PULLS), self.layers, self.layers + len(PULLS) - best)
        less = jnp.maximum(trust / 2, LEAST)
        return jnp.where(level < kept, jnp.minimum(2 * trust, 1), jnp.where(level == kept, less, trust))


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
    left = times(members, factors * same * r[:, None])  # (N, m): each layer's own R_ii' r
    layer = safe_sqrt(members @ size) * safe_sqrt(times(members, r * r))
    return solo, safe_divide(safe_sqrt((left * left).sum(1)), layer)


def attraction(reference: Reference, pose: Pose, parent: Float[Array, "p 3 3"]) -> Float[Array, " n"]:
    """The optimization vector `z` of eq. 1: the step along world axes that would take the pose back to the input."""
    q = pose.rotations[:, :, 0]
    turn = log(compose(reference.rotations, inverse_of(q))) * reference.attracted
    turn = jnp.sum(parent * turn.T[:, None, :], axis=-1)  # (P, 3), from the parent's frame to the world
    root = (reference.root - pose.root[:, 0]) * reference.root_attracted
    return jnp.concatenate([root, turn.reshape(-1)])


def lexicographic(errors: Float[Array, "layers c"], allowed: Bool[Array, " c"], solving: Solving) -> Int[Array, ""]:
    """The first candidate among the `allowed` that no other beats: layer by layer, whoever is worse than the best by more than
    `max(slack, slack_ratio * best)` is out."""

    def narrow(i: Int[Array, ""], alive: Bool[Array, " c"]) -> Bool[Array, " c"]:
        e = jax.lax.dynamic_index_in_dim(errors, i, 0, keepdims=False)
        best = jnp.min(jnp.where(alive, e, jnp.inf))
        return alive & (e <= best + jnp.maximum(solving.slack, solving.slack_ratio * best))

    alive = jax.lax.fori_loop(0, errors.shape[0], narrow, allowed & jnp.isfinite(errors).all(0))
    return jnp.argmax(alive).astype(jnp.int32)
