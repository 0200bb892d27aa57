"""The clips of the scenes at the paper's rate, and what the scenes measure on motions: places, centre of mass, rests.

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
"""Frames a second of the paper's motions (145 frames are 6 s)."""

WALK_LEG = ("Leg", "UpLeg", "HipJoint")
FEET = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")


def load_walk(data: Path) -> Motion:
    """12_01: six steps, the longest walk of the set (4.3 s; the paper's has 6 s). Its first frame, a T-pose, is left out."""
    clip = kinjax.load(data / "bvh" / "cmu" / "cmu_12_01_walk.bvh")
    return resample(clip.slice(1, clip.frames - 1), RATE)


def load_kick(data: Path) -> Motion:
    """A front kick of 131_01: the right foot steps up, kicks and comes back, the left one stands from frame 8 of 36 on."""
    clip = kinjax.load(data / "bvh" / "cmu" / "131_01.bvh")
    return resample(clip.slice(640, 815), RATE)


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


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Metres between two paths (F, 3), or a path and a place, in each frame."""
    return np.linalg.norm(a - b, axis=-1)


def rests(path: np.ndarray, rate: float, speed: float = 0.25, shortest: int = 4) -> list[tuple[int, int]]:
    """Spans of frames, ends included, in which a path (F, 3) moves by less than `speed` m/s between neighbours."""
    still = np.linalg.norm(np.diff(path, axis=0), axis=1) * rate < speed
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in edges if b - a + 1 >= shortest]
