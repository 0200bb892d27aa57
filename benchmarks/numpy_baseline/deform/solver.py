"""The practical solver: damped, clamped steps whose candidates are compared in lexicographic order, frame after frame.

The linear solve keeps priorities only to first order. So every iteration tries several steps (all layers with posture;
each prefix of the layers without it), corrects them along the same factors, again if something is still refused, and keeps
the most complete one that makes no higher layer worse than the best candidate does. What was refused is tried half as far
in the next iteration: without that, a layer whose full step bends a satisfied one by more than the slack is refused for
ever, although it is free to move.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .constraints import Task
from .linear import gains, posture_step, row_basis, sweep
from .rotations import conjugate, log, multiply, normalized


@dataclass(frozen=True)
class Settings:
    """iterations: per frame. damping: lambda of a layer whose error is `damped_from` metres (or radians) or more; it falls
    with the error down to `floor` times |J|. clamp: longest error that is acted on at once. budget: longest step, radians
    and metres alike. posture: share of the way to the reference pose per iteration. slack: an error may be worse by
    max(slack, slack_share * error). corrections: at most. least_trust: how far a refused layer is cut at most."""

    iterations: int = 10
    damping: float = 0.3
    damped_from: float = 0.05
    floor: float = 1e-6
    clamp: float = 0.1
    budget: float = 0.5
    posture: float = 0.1
    slack: float = 1e-6
    slack_share: float = 1e-3
    corrections: int = 2
    least_trust: float = 1 / 64


class Track(NamedTuple):
    """root (F, 3), rotations (F, J, 4), errors (F, layers): the norm of each layer's error after its frame's last step."""

    root: np.ndarray
    rotations: np.ndarray
    errors: np.ndarray


class Solver:
    """One body and its layers; `solve` runs the frames."""

    def __init__(self, body, layers, settings=Settings()):
        self.task, self.settings = Task(body, layers), settings
        rows, spans = self.task.spans[-1][1], self.task.spans
        count = len(spans)
        # candidates: everything with posture, then prefixes of k, k-1, ..., 1 layers; the masks are over rows
        prefix = [count, *range(count, 0, -1)]
        corrected = [count, *(max(1, k - 1) for k in range(count, 0, -1))]
        self.takes = np.array([np.arange(rows) < spans[k - 1][1] for k in prefix], float)
        self.corrects = np.array([np.arange(rows) < spans[k - 1][1] for k in corrected], float)
        self.sums = np.array([[a <= r < b for a, b in spans] for r in range(rows)], float)

    def solve(self, root, rotations, reference=None):
        """All frames, each from the last one's result: `Track`.

        root (3,), rotations (J, 4): where the first frame starts. reference (J, 4) or (F, J, 4): the pose that posture
        pulls towards, default the start.
        """
        task, joints = self.task, self.task.tree.joints
        reference = np.broadcast_to(rotations if reference is None else reference, (task.frames, *rotations.shape))
        towards = reference[:, joints]
        goals = conjugate(towards)
        out_root, out_errors = np.empty((task.frames, 3)), np.empty((task.frames, len(task.spans)))
        out = reference.copy()  # joints that no constraint recruits follow the input
        turned = np.reshape(task.turned, (-1, 1))
        follows = not bool(np.all(task.turned))
        state = root, rotations[joints], None
        trust = np.ones(len(task.spans) + 1)
        for frame in range(task.frames):
            goal = task.goal(frame)
            if frame == 0 or follows:
                q = np.where(turned, state[1], towards[frame])
                state = state[0], q, task.tree.world(state[0], q)
            error = task.errors(state[2], goal)
            for _ in range(self.settings.iterations):
                state, error, trust = self.iterate(state, error, trust, goal, goals[frame])
            state = state[0], normalized(state[1]), state[2]
            out_root[frame] = state[0]
            out[frame, joints] = state[1]
            out_errors[frame] = self.norms(error)
        return Track(out_root, out, out_errors)

    def iterate(self, state, error, trust, goal, reference):
        """One step: the new (root, rotations, world), its error rows, and the trust in each layer and in posture (N + 1,)."""
        task, tree, s = self.task, self.task.tree, self.settings
        root, q, world = state
        clamp = (s.clamp * trust[:-1]).tolist()
        J = task.jacobian(world)
        L, Q = row_basis(J)
        gain = gains(L, task.spans, self.damping(J, error))
        y = sweep(L, task.spans, gain, error, clamp, s.budget)
        tangents = (self.takes * y) @ Q
        tangents[0] += posture_step(Q, y, trust[-1] * self.attraction(q, world, reference), s.budget)

        roots, qs = tree.moved(root, q, world, tangents)
        worlds = tree.world(roots, qs)
        errors = task.errors(worlds, goal)
        for _ in range(s.corrections):
            # chord correction: what curvature left over, by the same factors, without the last layer of each candidate
            again = sweep(L, task.spans, gain, errors, clamp, s.budget)
            roots, qs = tree.moved(roots, qs, worlds, (self.corrects * again) @ Q)
            worlds = tree.world(roots, qs)
            errors = task.errors(worlds, goal)
            best = first_in_order(self.norms(errors).tolist(), s.slack, s.slack_share)
            if best == 0:
                break
        trust = np.minimum(2.0 * trust, 1.0)
        if best:  # the first layer that was left out, or posture
            trust[-best] = max(0.25 * trust[-best], s.least_trust)
        return (roots[best], qs[best], worlds[best]), errors[best], trust

    def damping(self, J, error):
        """lambda of each layer."""
        s = self.settings
        floors = s.floor * np.sqrt(np.vecdot(J, J) @ self.sums)
        return np.maximum(s.damping * np.minimum(self.norms(error) / s.damped_from, 1.0), floors)

    def norms(self, error):
        """(..., layers) of error rows (..., rows)."""
        return np.sqrt((error * error) @ self.sums)

    def attraction(self, q, world, reference):
        """The optimization vector z: a share of the way to the reference pose, which comes conjugated. The root's
        translation has no part in it (section 5.2)."""
        parents = world.take(self.task.tree.parent, 0)[:, :3, :3]
        z = np.zeros((1 + len(q), 3))
        z[1:] = -self.settings.posture * (parents @ log(multiply(q, reference))[..., None])[..., 0]
        return z.ravel()


def first_in_order(errors, slack, share):
    """Index of the first candidate that is best in lexicographic order, up to max(slack, share * error) a layer."""
    alive = list(range(len(errors)))
    for layer in range(len(errors[0])):
        least = min(errors[k][layer] for k in alive)
        bound = least + max(slack, share * least)
        alive = [k for k in alive if errors[k][layer] <= bound]
    return alive[0]
