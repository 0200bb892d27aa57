"""The skeleton: what does not move. Topology (names, parents, channels) is static and hashable; lengths are arrays.

In: the hierarchy of a file, or plain lists. Out: `Skeleton`, which motion, kinematics and writers share. Offsets are
metres in the parent joint's frame at rest; world axes stay the file's, with `up` known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float

from .errors import ShapeError, find_name

Array = jax.Array | np.ndarray
Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Topology:
    """Names and parents of the joints, in an order in which each parent comes before its children.

    names: unique joint names, length J. parents: index of the parent, -1 for a root (several roots are allowed).
    channels: for each joint the file's channel names in file order ("Xposition", "Zrotation", ...), 0 to 6 of them; kept
    so that a written file has the hierarchy of the one that was read. translated: indices of the joints whose local
    translation moves (every joint with a position channel; a motion always has at least its roots here).
    end_parents, end_names: the End Sites: index of the joint that each hangs on, and its name or "".
    up: the world's up axis.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    channels: tuple[tuple[str, ...], ...] = ()
    translated: tuple[int, ...] = (0,)
    end_parents: tuple[int, ...] = ()
    end_names: tuple[str, ...] = ()
    up: Axis = "y"

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.parents) != n or (self.channels and len(self.channels) != n):
            raise ShapeError(f"{n} joint names, {len(self.parents)} parents, {len(self.channels)} channel lists")
        if len(set(self.names)) != n:
            raise ShapeError(f"joint names repeat: {sorted({x for x in self.names if self.names.count(x) > 1})}")
        if any(p >= i or p < -1 for i, p in enumerate(self.parents)) or (n and self.parents[0] != -1):
            raise ShapeError("each joint's parent must come before it, and the first joint must be a root (-1)")

    def index(self, name: str) -> int:
        """Index of the joint called `name` (any case); `UnknownNameError` lists the nearest names."""
        return find_name(name, self.names, "joint")

    def children(self, joint: int) -> tuple[int, ...]:
        """Indices of the joints whose parent is `joint`."""
        return tuple(i for i, p in enumerate(self.parents) if p == joint)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Skeleton:
    """A topology with its measures: `offsets` (J, 3) and `end_offsets` (E, 3), metres, in the parent joint's frame.

    masses: (J,) of the body parts that the joints carry, in any unit; mass_centers: (J, 3) their centres, metres in the
    joint's own frame. limits: (J, 3, 2) radians, lower and upper bound of each component of the joint's rotation vector
    from the identity. None where nothing is known: `anthropometry` then finds masses by the joints' names.
    """

    offsets: Float[Array, "joints 3"]
    end_offsets: Float[Array, "ends 3"]
    topology: Topology = field(metadata={"static": True})
    masses: Float[Array, " joints"] | None = None
    mass_centers: Float[Array, "joints 3"] | None = None
    limits: Float[Array, "joints 3 2"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names."""
        return self.topology.names

    def segment_centers(self) -> np.ndarray:
        """Centre of each joint's own segment in its own frame, (J, 3) metres.

        Half-way from the joint to the mean of its children and End Sites; the joint itself when it has none. Where the
        residual of a displacement is measured matters: at the body's own centre it is the body's motion, at a remote
        origin it is mostly the lever (2006 paper, appendix A).
        """
        offsets, ends = np.asarray(self.offsets), np.asarray(self.end_offsets)
        parents = np.array([*self.topology.parents, *self.topology.end_parents], int)
        children, below = parents >= 0, np.concatenate([offsets, ends])
        total = np.zeros_like(offsets)
        np.add.at(total, parents[children], below[children])
        count = np.bincount(parents[children], minlength=len(offsets))[:, None]
        return 0.5 * total / np.maximum(count, 1)
