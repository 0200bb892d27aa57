"""Clips with known constraints: what the detector is tested on, and the samples that ship.

`sample_clips()` gives them all; `with_noise`, `with_outliers` and `with_gaps` spoil them as recordings are spoilt.
NumPy only, float64, deterministic. Truth: see `Scene` and `kinjax.annotations`.
"""

from .biped import biped_skeleton, walking_biped
from .dice import rolling_dice
from .noise import noisy_motion, rotation_noise, with_gaps, with_noise, with_outliers
from .props import ball_joint, hinge, rolling_foot
from .scene import RigidPath, Scene, box_markers, labels, make_scene
from .spatial import kabsch

__all__ = [
    "RigidPath",
    "Scene",
    "ball_joint",
    "biped_skeleton",
    "box_markers",
    "hinge",
    "kabsch",
    "labels",
    "make_scene",
    "noisy_motion",
    "rolling_dice",
    "rolling_foot",
    "rotation_noise",
    "sample_clips",
    "walking_biped",
    "with_gaps",
    "with_noise",
    "with_outliers",
]


def sample_clips() -> dict[str, Scene]:
    """The clips that ship as samples, clean: "dice", "hinge", "ball", "foot", "walk"."""
    scenes = (rolling_dice(), hinge(), ball_joint(), rolling_foot(), walking_biped())
    return {s.name: s for s in scenes}
