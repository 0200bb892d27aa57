"""The clips of the scenes (CMU 35_01 and 11_01) at the paper's rate, and what the scenes measure on motions: places, centre of mass, rests.

In: the folder of real data, motions. Out: motions and NumPy arrays, float64, world metres. Everything here uses the motion's
own kinematics, nothing of the deformation.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

import kinjax
from kinjax.anthropometry import segment_masses
from kinjax.kinematics import forward_kinematics
from kinjax.motion import Motion, resample

RATE = 24.0
"""Frames a second of the paper's motions (145 frames are 6 s; no walk of the set is as long)."""

FEET = ("lfoot", "ltoes", "rfoot", "rtoes")
"""Ankles and balls of the feet: the paper's four footplants."""
LEGS = {
    "lfoot": ("ltibia", "lfemur", "root"),
    "ltoes": ("lfoot", "ltibia", "lfemur", "root"),
    "rfoot": ("rtibia", "rfemur", "root"),
    "rtoes": ("rfoot", "rtibia", "rfemur", "root"),
}
"""What a constraint on each of them recruits: `lhipjoint` and `rhipjoint` are bones of the pelvis, not joints of a person."""
SPINE = ("thorax", "upperback", "lowerback", "root")
BODY = (*dict.fromkeys(j for leg in LEGS.values() for j in leg), *SPINE[:-1])
"""What the centre of mass recruits: legs and spine. Arms carry little and would have to be thrown about for it."""


def load_walk(data: Path) -> Motion:
    """35_01: three seconds and six steps of a walk; stands on left and right foot in turn, five whole ones."""
    return resample(kinjax.load(data / "bvh" / "cmu" / "35_01.bvh"), RATE)


def load_kick(data: Path) -> Motion:
    """11_01, a kick at a ball: the left foot comes to stand in frame 9, the right one swings past it, comes down in frame 24."""
    return resample(kinjax.load(data / "bvh" / "cmu" / "11_01.bvh"), RATE).slice(70, 113)


def poses(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (F, J, 4) and places (F, J, 3)."""
    with jax.enable_x64(True):
        rotation, position = forward_kinematics(motion)
        return np.asarray(rotation, float), np.asarray(position, float)


def places(motion: Motion, joint: str) -> np.ndarray:
    """World path (F, 3) of a joint."""
    return poses(motion)[1][:, motion.skeleton.topology.index(joint)]


def center_of_mass(motion: Motion) -> np.ndarray:
    """World path (F, 3) of the centre of mass."""
    rotation, position = poses(motion)
    masses = segment_masses(motion.skeleton)
    w, v, local = rotation[..., :1], rotation[..., 1:], np.asarray(masses.centers)
    twice = 2 * np.cross(v, local)
    centers = position + local + w * twice + np.cross(v, twice)
    return np.einsum("j,fjc->fc", np.asarray(masses.fractions), centers)


def sway(a: Motion, b: Motion) -> np.ndarray:
    """Metres between the centres of mass of two motions over the ground, in each frame."""
    return distance(*(center_of_mass(m)[:, [0, 2]] for m in (a, b)))


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Metres between two paths (F, 3), or a path and a place, in each frame."""
    return np.linalg.norm(a - b, axis=-1)


def rests(path: np.ndarray, rate: float, speed: float = 0.25, shortest: int = 4) -> list[tuple[int, int]]:
    """Spans of frames, ends included, in which a path (F, 3) moves by less than `speed` m/s between neighbours."""
    still = np.linalg.norm(np.diff(path, axis=0), axis=1) * rate < speed
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in edges if b - a + 1 >= shortest]
