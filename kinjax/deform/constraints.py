"""What a person asks of a motion: constraints on points, orientations, gaze and balance, each with a priority.

In: plain numbers and joint names. Out: immutable records that `plan` turns into arrays; nothing here looks at a motion.
Sources: 2004 paper, section 4. Conventions stated here and nowhere else:

* frames are 0-based, and a constraint holds in frames `begin..end`, **both included** (`end=None`: to the last frame);
* a larger `priority` is more important, only the order counts; constraints of one priority share a layer, where `weight`
  decides between them; weight 0 is as if the constraint were not there;
* `ease_in` and `ease_out` are seconds before `begin` and after `end` in which the effector leaves its original trajectory
  and finds back to it: the constraint is active then, too. The clip's ends cut them;
* places are metres in the world, or in the moving frame of the joint `relative_to`; orientations likewise, quaternions wxyz;
* a constraint recruits the joints from its own up to the root (a position at the joint's own origin from the joint's
  parent, which is the first that can move it), or up to `recruit_to`, or exactly the joints in `recruits`. The root's
  translation is recruited with the root joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

Vector = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Through:
    """A point of a shape-constraint: the effector passes `at` in frame `frame`, and rests there `until` a later one.

    at: (3,) metres, or (4,) a quaternion for an orientation. tension, continuity, bias: of the Kochanek-Bartels spline.
    """

    frame: int
    at: Vector
    until: int | None = None
    tension: float | None = None
    continuity: float = 0.0
    bias: float = 0.0


@dataclass(frozen=True, kw_only=True)
class _Common:
    priority: float = 1.0
    weight: float = 1.0
    begin: int = 0
    end: int | None = None
    ease_in: float | None = None
    ease_out: float | None = None
    recruit_to: str | None = None
    recruits: tuple[str, ...] | None = None
    relative_to: str | None = None
    name: str = ""


@dataclass(frozen=True)
class Position(_Common):
    """A point of a joint: at a place, through places, along a path, beside its original trajectory, or on it.

    joint: whose point; point: where it is in the joint's frame (metres). One of: `at` (3,), where it rests from `begin` to
    `end`; `through`, a shape-constraint that leaves the original trajectory at `begin` and is back on it at `end`; `path`
    (frames, 3), one place a frame from `begin` to `end`; `offset` (3,), that far from the original trajectory. With none of
    them the original trajectory is kept. axes: the coordinates that count, some of "xyz". Eases: 0.3 s with `at` and
    `offset` unless given; `through` and `path` have none of their own.
    """

    joint: str
    at: Vector | None = None
    through: tuple[Through, ...] = ()
    path: np.ndarray | None = None
    offset: Vector | None = None
    point: Vector = (0.0, 0.0, 0.0)
    axes: str = "xyz"


@dataclass(frozen=True)
class Orientation(_Common):
    """The orientation of a joint: `at` a quaternion (4,) from `begin` to `end`, `through` some, along a `path` (frames, 4), turned
    by an `offset` (3,), a rotation vector in radians before the original, or kept as it is. `axes`: about which of the
    axes "xyz" of the world (or of the frame `relative_to`) it counts. Eases as for `Position`.
    """

    joint: str
    at: Vector | None = None
    through: tuple[Through, ...] = ()
    path: np.ndarray | None = None
    offset: Vector | None = None
    axes: str = "xyz"


@dataclass(frozen=True)
class LookAt(_Common):
    """The direction `axis` of a joint points from its `point` to the place `at` (3,), or along a `path` (frames, 3) of places.

    axis: unit vector in the joint's frame. Ease: 0.3 s, in which the place looked at moves over from where the input looks.
    """

    joint: str
    at: Vector | None = None
    path: np.ndarray | None = None
    axis: Vector = (0.0, 0.0, 1.0)
    point: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CenterOfMass(_Common):
    """The centre of mass, for which the whole body is recruited unless joints are listed (2004 paper, section 4.3).

    Without `support` it keeps its original trajectory. With `support`, names of joints, it keeps its place relative to their
    barycentre: N1 (P' - mean A') = N2 (P - mean A), with lengths measured in legs; `leg_length`: of the figure that the
    motion was made for, when it is another one (metres). displacement: (3,), (frames, 3) of the whole clip, or a sequence of
    (frame, (3,)), added to the wanted place: metres. at, offset as for `Position`.
    """

    at: Vector | None = None
    offset: Vector | None = None
    support: tuple[str, ...] = ()
    displacement: Sequence | np.ndarray | None = None
    leg_length: float | None = None
    axes: str = "xyz"
    joint: str = field(default="", init=False)


Goal = Position | Orientation | LookAt | CenterOfMass
"""Any constraint of a deformation."""


def title(goal: Goal, index: int) -> str:
    """How messages and reports call a constraint: its name, or its kind, joint and place in the list (from 1)."""
    kind = {"Position": "position", "Orientation": "orientation", "LookAt": "look-at", "CenterOfMass": "centre of mass"}
    if type(goal).__name__ not in kind:
        return f"constraint {index + 1}"
    if goal.name:
        return goal.name
    return f"{index + 1} {kind[type(goal).__name__]}" + (f" {goal.joint}" if goal.joint else "")
