"""The articulated figure: forward kinematics of many states at once, and moves along world-frame rotation vectors.

A state is the root's translation (..., 3) in metres and one unit quaternion per joint (..., J, 4) relative to its parent.
A tangent has three numbers for the root's translation and three per joint: a rotation vector in the *world* frame,
`q_j <- exp(R_parent^T w_j) q_j`. The world frame makes the Jacobian of a point plain, `w x (p - p_j)`.
"""

from dataclasses import dataclass

import numpy as np

from .rotations import exp, matrices, multiply


@dataclass(frozen=True)
class Body:
    """parents: (J,), -1 for the root, which is joint 0. offsets: (J, 3) metres in the parent's frame; the root's is not
    used. masses: (J,) kilograms. centers: (J, 3) where each mass sits, in its joint's frame."""

    parents: np.ndarray
    offsets: np.ndarray
    masses: np.ndarray
    centers: np.ndarray

    def lineage(self, joint):
        """The joint and its ancestors, the root last."""
        line = []
        while joint >= 0:
            line.append(int(joint))
            joint = self.parents[joint]
        return line


class Tree:
    """Forward kinematics of the joints `joints` of a body (ancestors of all of them included), by pointer jumping.

    After round r each joint's matrix is relative to its ancestor 2^r above: depth 8 takes three batched products instead
    of a walk over the joints. The last row of every result is the identity, the parent of the root.
    """

    def __init__(self, body, joints):
        self.joints = sorted({j for joint in joints for j in body.lineage(joint)})
        self.row = {j: k for k, j in enumerate(self.joints)}
        count = len(self.joints)
        self.parent = np.array([self.row.get(int(body.parents[j]), count) for j in self.joints])
        self.rest = np.tile(np.eye(4), (count + 1, 1, 1))
        self.rest[:count, :3, 3] = body.offsets[self.joints]
        self.rounds = []
        above = np.append(self.parent, count)
        while (above < count).any():
            self.rounds.append(above)
            above = above[above]

    def world(self, root, rotations):
        """World matrices (..., rows + 1, 4, 4) from `root` (..., 3) and `rotations` (..., rows, 4)."""
        count = len(self.joints)
        world = np.empty((*rotations.shape[:-2], count + 1, 4, 4))
        world[...] = self.rest
        world[..., :count, :3, :3] = matrices(rotations)
        world[..., 0, :3, 3] = root
        for above in self.rounds:
            world = world.take(above, -3) @ world
        return world

    def moved(self, root, rotations, world, tangent):
        """The states (root, rotations) one tangent (..., 3 + 3 rows) away; one state and many tangents, or one each.

        world: of the states that move. Quaternions leave unit length by rounding only; the frame loop sees to that.
        """
        steps = tangent[..., 3:].reshape(*tangent.shape[:-1], -1, 1, 3)
        parents = world.take(self.parent, -3)[..., :3, :3]
        local = (steps @ parents)[..., 0, :]  # R_parent^T w
        return root + tangent[..., :3], multiply(exp(local), rotations)


def positions(body, root, rotations):
    """World positions (..., J, 3) of all joints, joint by joint: slow and plain, for scores and tests."""
    turn = matrices(rotations)
    world = np.empty_like(turn)
    place = np.empty((*rotations.shape[:-1], 3))
    for j, parent in enumerate(body.parents):
        if parent < 0:
            world[..., j, :, :], place[..., j, :] = turn[..., j, :, :], root
        else:
            world[..., j, :, :] = world[..., parent, :, :] @ turn[..., j, :, :]
            place[..., j, :] = place[..., parent, :] + world[..., parent, :, :] @ body.offsets[j]
    return place
