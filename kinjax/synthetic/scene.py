"""A scene whose constraints are known: poses, the markers that carry them, and the truth.

In: rigid paths written span by span (rest, turn about a line, turn about a point, free flight). Out: `Scene`. Frames
are counted as in `kinjax.annotations`: 0-based, both ends included; spans that follow each other share a frame, so
that the interval `i`, from frame `i` to `i + 1`, belongs to exactly one of them. World axes: y up, ground at y = 0,
metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..annotations import TYPES, Annotations, Constraint, Constraints, ConstraintType
from ..errors import OptionError
from ..motion import Motion, Poses, make_poses
from .spatial import quat_exp, quat_mul, quat_rotate, unroll


@dataclass(frozen=True)
class Scene:
    """A clip with known constraints.

    poses: world poses of the objects, origin at each body's centre. truth: every constraint of every object in
    `poses`, exact by construction (residual 0). markers: object -> (frames, markers, 3), world metres. marker_layout:
    object -> (markers, 3), metres in the object's frame, centroid at its origin. motion: the skeleton's motion, where
    there is one.
    """

    name: str
    poses: Poses
    truth: Constraints
    markers: Mapping[str, np.ndarray]
    marker_layout: Mapping[str, np.ndarray]
    motion: Motion | None = None

    @property
    def rate(self) -> float:
        """Frames a second."""
        return float(self.poses.rate)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.poses.frames

    def annotations(self) -> Annotations:
        """The truth as annotations, `method="truth"`: what goes into a file beside the clip."""
        return Annotations(self.name, self.rate, self.frames, self.truth, method="truth")


def labels(truth: Scene | Constraints, object: str, frames: int | None = None, intervals: bool = False) -> np.ndarray:
    """What holds when: 0 nothing, 1 space, 2 line, 3 point, as an integer array over the frames (or `intervals`).

    A frame that two spans share takes the later one; intervals are never shared. `frames` is taken from a `Scene`, and
    must be given with bare `Constraints`.
    """
    if isinstance(truth, Scene):
        truth.poses.index(object)
        constraints, frames = truth.truth, truth.frames
    else:
        constraints = truth
    if frames is None:
        raise OptionError("labels of bare constraints need `frames`, the length of the clip")
    out = np.zeros(frames - bool(intervals), int)
    for c in sorted(constraints.of(object), key=lambda c: c.begin):
        out[c.begin : c.end + (not intervals)] = 1 + TYPES.index(c.type)
    return out


def box_markers(half: Sequence[float]) -> np.ndarray:
    """The eight corners of a box about the origin with half edges `half`, (8, 3) metres."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, 8).T
    return signs * np.asarray(half, float)


def frame_count(seconds: float, rate: float) -> int:
    """The whole number of intervals nearest to `seconds`, at least one; `OptionError` for an impossible rate."""
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")
    return max(1, int(np.floor(seconds * rate + 0.5)))


@dataclass
class RigidPath:
    """One rigid body's motion, written span by span, with its truth. Every span counts its `frames` in intervals.

    rotation (4,), position (3,): the pose at frame 0. Spans start impulsively at their full speed: a truth that is
    exact to the frame also looks exact to a detector.
    """

    name: str
    rotation: np.ndarray
    position: np.ndarray
    _rotations: list[np.ndarray] = field(default_factory=list)
    _positions: list[np.ndarray] = field(default_factory=list)
    _spans: list[tuple[ConstraintType, int, int, np.ndarray, np.ndarray | None]] = field(default_factory=list)
    end: int = 0

    def __post_init__(self) -> None:
        self._rotations.append(np.asarray(self.rotation, float)[None])
        self._positions.append(np.asarray(self.position, float)[None])

    def _append(self, rotations: np.ndarray, positions: np.ndarray) -> int:
        """Add the frames after the current one; returns the frame at which they begin."""
        begin, self.end = self.end, self.end + len(rotations)
        self._rotations.append(rotations / np.linalg.norm(rotations, axis=-1, keepdims=True))
        self._positions.append(positions)
        self.rotation, self.position = self._rotations[-1][-1], positions[-1]
        return begin

    def rest(self, frames: int) -> None:
        """Stay where it is: a space constraint."""
        at = self.position
        begin = self._append(np.tile(self.rotation, (frames, 1)), np.tile(at, (frames, 1)))
        self._spans.append(("space", begin, self.end, at, None))

    def turn(self, pivot: np.ndarray, axis: np.ndarray, angle: float, frames: int, ease: float = 0.0) -> None:
        """Turn by `angle` (rad) about the world line through `pivot` along `axis`: a line constraint.

        The angular speed is `angle / T (1 - ease cos(2 pi t / T))`: smooth inside, impulsive at both ends.
        """
        axis = np.asarray(axis, float) / np.linalg.norm(axis)
        s = np.arange(1, frames + 1) / frames
        angles = angle * (s - ease * np.sin(2 * np.pi * s) / (2 * np.pi))
        self._about(np.asarray(pivot, float), quat_exp(angles[:, None] * axis), axis)

    def swivel(self, pivot: np.ndarray, turns: np.ndarray) -> None:
        """Turn about the world point `pivot` by the world rotations `turns` (frames, 4) from here: a point
        constraint."""
        self._about(np.asarray(pivot, float), turns, None)

    def _about(self, pivot: np.ndarray, turns: np.ndarray, axis: np.ndarray | None) -> None:
        begin = self._append(quat_mul(turns, self.rotation), pivot + quat_rotate(turns, self.position - pivot))
        self._spans.append(("point" if axis is None else "line", begin, self.end, pivot, axis))

    def move(self, rotations: np.ndarray, positions: np.ndarray) -> None:
        """Free flight through the given poses (frames, 4) and (frames, 3), the current one left out: no constraint."""
        self._append(rotations, positions)

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (frames, 4), continuous in sign, and positions (frames, 3)."""
        return unroll(np.concatenate(self._rotations)), np.concatenate(self._positions)

    def truth(self, rate: float) -> list[Constraint]:
        """The constraints, positions as `kinjax.annotations` defines them: on an axis the point nearest the mean
        origin."""
        _, positions = self.poses()
        out = []
        for kind, begin, end, pivot, axis in self._spans:
            if axis is not None:
                pivot = pivot + axis * np.dot(positions[begin : end + 1].mean(0) - pivot, axis)
            line = None if axis is None else _triple(axis)
            out.append(Constraint(self.name, kind, begin, end, _triple(pivot), line, fps=float(rate)))
        return out


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def make_scene(
    name: str, rate: float, paths: Sequence[RigidPath], layouts: Mapping[str, np.ndarray], motion: Motion | None = None
) -> Scene:
    """The scene of several bodies that last equally long."""
    rotation, position = (np.stack(x, 1) for x in zip(*(p.poses() for p in paths), strict=True))
    names = [p.name for p in paths]
    layout = {n: np.asarray(layouts[n], float) for n in names}
    markers = {n: position[:, i, None] + quat_rotate(rotation[:, i, None], layout[n]) for i, n in enumerate(names)}
    truth = Constraints.sorted(c for p in paths for c in p.truth(rate))
    return Scene(name, make_poses(names, rotation, position, float(rate), clip=name), truth, markers, layout, motion)
