"""The figure, its start pose and its targets, read from the files that every peer reads too.

In: a folder with `hum.xml` (MJCF), `hum.urdf` and `targets.npz`. Out: `Scene`. The hinges x, y, z of a body are one joint
of three rotations here; world axes stay the file's, z up.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

FEET = ("LFoot", "RFoot")
HAND = "RHand"
# The start pose, by hinge, radians; all others are zero.
START = {
    **{f"{side}{name}_y": angle for side in "LR" for name, angle in (("UpLeg", -0.25), ("Leg", 0.5), ("Foot", -0.25))},
    "LArm_x": -1.0,
    "RArm_x": 1.0,
    "LForeArm_z": -0.5,
    "RForeArm_z": 0.5,
}


@dataclass(frozen=True)
class Scene:
    """names, parents (-1 for the root), offsets (J, 3) metres, masses (J,) kilograms, at the joints: the figure.

    hinges: by joint the names of its hinges in the file's order, none for the root. root (3,), rotations (J, 4 wxyz): the
    start pose. angles: its hinge angles by name. targets: world paths (F, 3) by name: "LF", "RF" the ankles, "RH" and
    "FAR" the right hand. folder: where the files are.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    masses: np.ndarray
    hinges: tuple[tuple[str, ...], ...]
    root: np.ndarray
    rotations: np.ndarray
    angles: dict[str, float]
    targets: dict[str, np.ndarray]
    folder: Path

    def index(self, name: str) -> int:
        """Index of a joint."""
        return self.names.index(name)

    @property
    def frames(self) -> int:
        """Length of the target paths."""
        return len(self.targets["LF"])

    @property
    def ends(self) -> tuple[int, int, int]:
        """Indices of the left foot, the right foot and the hand."""
        return self.index(FEET[0]), self.index(FEET[1]), self.index(HAND)

    def shortened(self, frames: int) -> Scene:
        """The same with only the first `frames` frames of every target."""
        return Scene(**{**self.__dict__, "targets": {k: v[:frames] for k, v in self.targets.items()}})

    def motion(self):
        """The start pose, held for as long as the targets last, as a kinjax `Motion` at 60 frames a second (the files name no
        rate)."""
        from kinjax.motion import Motion
        from kinjax.skeleton import Skeleton, Topology

        topology = Topology(self.names, self.parents, up="z")
        return Motion(
            np.tile(self.root, (self.frames, 1, 1)),
            np.tile(self.rotations, (self.frames, 1, 1)),
            Skeleton(self.offsets, np.zeros((0, 3)), topology),
            60.0,
            "reach",
        )


def read_scene(data: str | Path) -> Scene:
    """The scene of `data`/ik_reach, or of `data` itself if the files lie there."""
    folder = Path(data)
    if (folder / "ik_reach").is_dir():
        folder = folder / "ik_reach"
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    masses: list[float] = []
    hinges: list[tuple[str, ...]] = []

    def visit(element: ET.Element, parent: int) -> None:
        for body in element.findall("body"):
            here = len(names)
            names.append(body.get("name", ""))
            parents.append(parent)
            offsets.append([float(x) for x in body.get("pos", "0 0 0").split()])
            inertial = body.find("inertial")
            masses.append(0.0 if inertial is None else float(inertial.get("mass", 0)))
            own = body.findall("joint")
            if any(j.get("type") != "hinge" for j in own) or (own and [j.get("axis") for j in own] != _AXES):
                raise ValueError(f"{folder / 'hum.xml'}: body {names[-1]!r} has other joints than hinges about x, y, z")
            hinges.append(tuple(j.get("name", "") for j in own))
            visit(body, here)

    world = ET.parse(folder / "hum.xml").getroot().find("worldbody")
    if world is None:
        raise ValueError(f"{folder / 'hum.xml'}: no worldbody")
    visit(world, -1)
    angles = {name: START.get(name, 0.0) for own in hinges for name in own}
    if unknown := START.keys() - angles.keys():
        raise ValueError(f"{folder / 'hum.xml'}: no hinges {sorted(unknown)}, which the start pose turns")
    with np.load(folder / "targets.npz", allow_pickle=False) as stored:
        targets = {name: stored[name] for name in ("LF", "RF", "RH", "FAR")}
    rotations = np.array([quaternion([angles[h] for h in own]) for own in hinges])
    root = np.array(offsets[0])
    offsets[0] = [0.0, 0.0, 0.0]
    return Scene(
        tuple(names),
        tuple(parents),
        np.array(offsets),
        np.array(masses),
        tuple(hinges),
        root,
        rotations,
        angles,
        targets,
        folder,
    )


_AXES = ["1 0 0", "0 1 0", "0 0 1"]


def quaternion(angles: Sequence[float] | np.ndarray) -> np.ndarray:
    """wxyz of hinge angles (..., 3) about x, then y, then z, each carried by the one before; the identity if there are none."""
    angles = np.asarray(angles, float)
    if angles.size == 0:
        return np.array([1.0, 0.0, 0.0, 0.0])
    xyzw = Rotation.from_euler("XYZ", angles.reshape(-1, 3)).as_quat()
    return xyzw[:, [3, 0, 1, 2]].reshape(*angles.shape[:-1], 4)
