"""Constraints in layers, and what the solver asks of them: errors and Jacobian rows, in priority order.

Three kinds (section 4 of the paper): a point of a joint at a place, a joint's orientation, the centre of mass at a place.
Each has three rows, of which `axes` keeps some. `layers` is a list of lists, the most important layer first.
"""

from dataclasses import dataclass, field

import numpy as np

from .body import Tree
from .rotations import log, matrices

# d -> the 3 x 3 matrix of w -> w x d, flattened: the derivative of a point by the rotation vectors above it
_LEVER = np.zeros((3, 9))
for _r, _c, _k, _sign in ((0, 1, 2, 1), (0, 2, 1, -1), (1, 0, 2, -1), (1, 2, 0, 1), (2, 0, 1, 1), (2, 1, 0, -1)):
    _LEVER[_k, 3 * _r + _c] = _sign


@dataclass(frozen=True)
class Constraint:
    """kind: "position", "orientation" or "com". joint: index, unused for "com". point: (3,) in the joint's frame.
    goal: (F, 3) world metres, or (F, 4) unit quaternions for an orientation. axes: which of the three rows count. recruits: the
    joints that may serve it (section 4.1), default all above it; the root's translation goes with joint 0."""

    kind: str
    goal: np.ndarray
    joint: int = 0
    point: np.ndarray = field(default_factory=lambda: np.zeros(3))
    axes: tuple = (True, True, True)
    recruits: tuple | None = None

    def __post_init__(self):
        if self.kind not in ("position", "orientation", "com"):
            raise ValueError(f"constraint of kind {self.kind!r}: choose position, orientation or com")


class Task:
    """The rows of all layers over one body, with every index array computed once.

    tree: kinematics of the joints involved. turned: whether each of its rows can move anything; the columns of the others
    are zero. columns: 3 + 3 rows of the tree. spans: (begin, end) rows of each layer.
    """

    def __init__(self, body, layers):
        flat = [c for layer in layers for c in layer]
        points = [c for c in flat if c.kind == "position"]
        turns = [c for c in flat if c.kind == "orientation"]
        masses = [c for c in flat if c.kind == "com"]
        heavy = np.flatnonzero(body.masses) if masses else np.zeros(0, int)
        self.tree = Tree(body, [c.joint for c in points + turns] + list(heavy))
        row = self.tree.row

        # who turns what: a point on its joint's own origin is not moved by that joint
        above = [body.lineage(c.joint)[0 if np.any(c.point) else 1 :] for c in points]
        above += [body.lineage(c.joint) for c in turns]
        above += [[j for h in heavy for j in body.lineage(h)[0 if np.any(body.centers[h]) else 1 :]] for _ in masses]
        may = [range(len(body.parents)) if c.recruits is None else c.recruits for c in points + turns + masses]
        acts = np.array(
            [[j in line and j in own for j in self.tree.joints] for line, own in zip(above, may, strict=True)], float
        )
        self.turned = acts.any(0)
        self.columns = 3 + 3 * len(self.tree.joints)

        self.joints = np.array([row[c.joint] for c in points], int)
        self.points = np.array([[*c.point, 1.0] for c in points]).reshape(-1, 4, 1)
        self.acts, self.acts_mass = acts[: len(points), :, None], acts[len(points) + len(turns) :, :, None]
        self.turns = np.array([row[c.joint] for c in turns], int)
        self.heavy = np.array([row[h] for h in heavy], int)
        self.shares = body.masses[heavy] / body.masses.sum()
        self.centers = np.concatenate([body.centers[heavy], np.ones((len(heavy), 1))], 1)[..., None]
        below = [[j in body.lineage(h) for h in heavy] for j in self.tree.joints]
        self.carries = np.array(below, float).reshape(len(below), len(heavy)) * self.shares
        self.count = len(points), len(turns), len(masses)

        # the part of the Jacobian that no state changes: (constraints, 3, root and rows, 3)
        self.constant = np.zeros((len(flat), 3, 1 + len(self.tree.joints), 3))
        self.constant[:, :, 0] = np.array([0 in own for own in may], float)[:, None, None] * np.eye(3)
        oriented = slice(len(points), len(points) + len(turns))
        self.constant[oriented, :, 0] = 0.0
        self.constant[oriented, :, 1:] = acts[oriented, None, :, None] * np.eye(3)[:, None, :]

        # rows are computed kind by kind, and then taken in the order of the layers
        at = {id(c): 3 * k for k, c in enumerate(points + turns + masses)}
        chosen = [[at[id(c)] + r for c in layer for r in range(3) if c.axes[r]] for layer in layers]
        order = np.array([r for layer in chosen for r in layer], int)
        self.order = None if np.array_equal(order, np.arange(3 * len(flat))) else order
        ends = np.cumsum([len(layer) for layer in chosen])
        self.spans = [(int(e - len(layer)), int(e)) for e, layer in zip(ends, chosen, strict=True)]
        self.goals = [np.stack([c.goal for c in kind], 1) if kind else None for kind in (points, turns, masses)]
        self.frames = min((len(c.goal) for c in flat), default=0)

    def goal(self, frame):
        """What `errors` needs of one frame: goal points, goal rotation matrices, goal centre of mass."""
        points, turns, mass = (None if g is None else g[frame] for g in self.goals)
        return points, None if turns is None else matrices(turns), mass

    def errors(self, world, goal):
        """Goal minus state (..., rows) in layer order; rotation vectors in the world frame for orientations."""
        points, turns, mass = goal
        parts = []
        if points is not None:
            parts.append(points - (world.take(self.joints, -3) @ self.points)[..., :3, 0])
        if turns is not None:
            parts.append(_log_matrices(turns @ world.take(self.turns, -3)[..., :3, :3].swapaxes(-1, -2)))
        if mass is not None:
            parts.append(mass - self._com(world)[..., None, :])
        stacked = parts[0] if len(parts) == 1 else np.concatenate(parts, -2)
        flat = stacked.reshape(*stacked.shape[:-2], -1)
        return flat if self.order is None else flat[..., self.order]

    def jacobian(self, world):
        """(rows, columns) of one state, in layer order: how the tasks change along the tangent."""
        pivots = world[:-1, :3, 3]
        n_points, _, n_mass = self.count
        J = self.constant.copy()
        if n_points:
            places = (world.take(self.joints, 0) @ self.points)[:, :3, 0]
            J[:n_points, :, 1:] = self._levers((places[:, None] - pivots) * self.acts)
        if n_mass:  # a joint's lever is to the centre of what it carries, as a share of the body
            levers = self.carries @ self._masses(world) - self.carries.sum(1)[:, None] * pivots
            J[-n_mass:, :, 1:] = self._levers(levers * self.acts_mass)
        rows = J.reshape(-1, self.columns)
        return rows if self.order is None else rows[self.order]

    def _levers(self, d):
        """(C, 3, T, 3) of lever arms (C, T, 3)."""
        return (d @ _LEVER).reshape(*d.shape, 3).transpose(0, 2, 1, 3)

    def _masses(self, world):
        return (world.take(self.heavy, -3) @ self.centers)[..., :3, 0]

    def _com(self, world):
        return np.einsum("h,...hk->...k", self.shares, self._masses(world))


def _log_matrices(R):
    """Rotation vectors (..., 3) of rotation matrices, well-conditioned up to a half turn."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]]
    return log(q).reshape(*R.shape[:-2], 3)
