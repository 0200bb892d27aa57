"""A motion in the world, and what constraints look up in it: poses of joints, paths of points, the centre of mass.

In: a `Motion`. Out: `Body`. Places are taken from `origin`, the root's first place, so that precision does not depend on where
in the world the clip plays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..anthropometry import SegmentMasses, segment_masses
from ..motion import Motion
from ..quaternions import multiply, rotate, turns
from .recruiting import chain_of


class Body:
    """A motion in the world, less `origin`, and what constraints look up in it.

    Joints are placed when they are asked for, in NumPy: nothing has to be compiled for it, and it is float64 whatever JAX is
    set to.
    """

    def __init__(self, motion: Motion, origin: np.ndarray | None = None):
        self.motion, self.top = motion, motion.skeleton.topology
        self.rate, self.frames = float(motion.rate), motion.frames
        if origin is None:
            root = np.asarray(motion.translations, float)[:, 0]
            finite = np.isfinite(root).all(1)
            origin = root[finite.argmax()].copy() if finite.any() else np.zeros(3)
        self.origin = origin
        self.notes: list[str] = []
        self._masses: SegmentMasses | None = None
        self._world: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _at(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """World quaternions (F, 4) and places (F, 3) of a joint."""
        missing = [j for j in chain_of(self.top, joint) if j not in self._world]
        for j in reversed(missing):
            q = np.asarray(self.motion.rotations[:, j], float)
            if j in self.top.translated:
                own = np.asarray(self.motion.translations[:, self.top.translated.index(j)], float)
            else:
                own = np.asarray(self.motion.skeleton.offsets[j], float)
            if self.top.parents[j] < 0:
                self._world[j] = q, np.broadcast_to(own - self.origin, (self.frames, 3))
            else:
                up, place = self._world[self.top.parents[j]]
                self._world[j] = multiply(up, q), place + rotate(up, own)
        return self._world[joint]

    def turn(self, joint: int) -> np.ndarray:
        """World quaternions (F, 4) of a joint."""
        return self._at(joint)[0]

    def place(self, joint: int) -> np.ndarray:
        """World places (F, 3) of a joint, less the origin."""
        return self._at(joint)[1]

    @property
    def rotation(self) -> np.ndarray:
        """World quaternions (F, J, 4) of all joints."""
        return np.stack([self.turn(j) for j in range(len(self.top.names))], axis=1)

    @property
    def position(self) -> np.ndarray:
        """World places (F, J, 3) of all joints, less the origin."""
        return np.stack([self.place(j) for j in range(len(self.top.names))], axis=1)

    def lost(self, joint: int) -> np.ndarray:
        """(F,) where a joint's pose is not finite."""
        q, p = self._at(joint)
        return ~(np.isfinite(q).all(1) & np.isfinite(p).all(1))

    @property
    def masses(self) -> SegmentMasses:
        """Mass fractions (J,) and centres (J, 3) of the joints' segments."""
        if self._masses is None:
            self._masses = segment_masses(self.motion.skeleton)
            self.notes += [n for n in self._masses.notes if n not in self.notes]
        return self._masses

    def point(self, joint: int, local: np.ndarray) -> np.ndarray:
        """World path (F, 3) of a point of a joint."""
        q, p = self._at(joint)
        return p + rotate(q, np.asarray(local, float)) if np.any(local) else p

    def center(self) -> np.ndarray:
        """World path (F, 3) of the centre of mass."""
        m = self.masses
        parts = [f * self.point(j, c) for j, (f, c) in enumerate(zip(m.fractions, m.centers, strict=True)) if f > 0]
        return np.sum(parts, axis=0)

    def relative(self, reference: int) -> Callable[[np.ndarray], np.ndarray]:
        """World paths (F, 3) as seen from a joint's moving frame; as they are for -1, the world."""
        if reference < 0:
            return lambda x: x
        back = turns(self.turn(reference)).inv()
        return lambda x: back.apply(x - self.place(reference))
