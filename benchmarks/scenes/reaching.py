"""Reaching (2004 paper, figure 3): a walk in which the left hand takes something beside the path, with and without balance.

The feet keep their trajectories at high priority (ankle and toe joint of each), the wrist reaches at middle priority during
40 frames, with the spine's help, and the centre of mass stays on its original trajectory at low priority.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kinjax.deform import CenterOfMass, Position, deform, redeform

from .clips import FEET, RATE, center_of_mass, distance, load_walk, places
from .scene import Finding, Outcome, Scene, Variant, kept

TRUNK = ("Spine1", "Spine", "LowerBack", "Hips")
ARM = ("LeftForeArm", "LeftArm", "LeftShoulder")
HOLD = (47, 52)
"""Frames in which the wrist rests at its goal: a quarter of a second."""
EASE = 17 / RATE
"""With 17 frames to go there and 17 back, the constraint is active in 40 frames, as the paper's."""
GOAL = (0.70, 0.95, 0.62)
"""World metres: low and far to the left, out of an arm's reach of the walk, in reach with the spine's help."""

EDIT = (0.0, 0.05, 0.0)
SETTLE = 3
"""Frames after the reach in which the last rounding of the way back may still be seen."""


def build(data: Path) -> Scene:
    """The scene on the walk of 12_01."""
    wrist = Position(
        "LeftHand", at=GOAL, begin=HOLD[0], end=HOLD[1], ease_in=EASE, ease_out=EASE, priority=2,
        recruits=ARM + TRUNK, name="wrist to its goal",
    )  # fmt: skip
    balance = CenterOfMass(priority=1, name="centre of mass as it was")
    feet = kept(FEET, priority=3)
    variants = {
        "balanced": Variant((*feet, wrist, balance)),
        "without centre of mass": Variant((*feet, wrist)),
    }
    return Scene("reaching", load_walk(data), variants, (40, HOLD[0]), tuple(variants), (GOAL,), ("LeftHand",))


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """The paper's claims for figure 3, and that an edit of the reach alone gives the same as a new start."""
    balanced = results["balanced"]
    wrist = places(balanced.motion, "LeftHand")[HOLD[0] : HOLD[1] + 1]
    feet = max(distance(places(balanced.motion, j), places(scene.motion, j)).max() for j in FEET)
    before, after = active(scene)
    change = balanced.deformation.report.change
    outside = np.concatenate([change[: max(before - 1, 0)], change[after + SETTLE :]])
    off = center_off(scene, balanced)
    out = [
        Finding("feet hold", 1e3 * feet, below=0.1),
        Finding("the wrist is at its goal", 1e3 * float(distance(wrist, np.array(GOAL)).max()), below=1.0),
        Finding("the centre of mass stays", 1e3 * off, below=30.0),
        Finding("other frames are the input's", float(np.degrees(outside.max())), below=0.1, unit="deg", aim=True),
    ]
    if "without centre of mass" in results:
        gone = center_off(scene, results["without centre of mass"])
        out.append(
            Finding(
                "without its constraint it is further off, in its distance or mm",
                gone / max(off, 1e-3),
                above=3.0,
                unit="x",
            )
        )
    return out


def active(scene: Scene) -> tuple[int, int]:
    """First and last frame in which the wrist is asked for anything."""
    frames = int(np.ceil(EASE * RATE - 1e-9))
    return max(HOLD[0] - frames, 0), min(HOLD[1] + frames, scene.motion.frames - 1)


def center_off(scene: Scene, outcome: Outcome) -> float:
    """The largest distance of the centre of mass from its original trajectory, metres."""
    return float(distance(center_of_mass(outcome.motion), center_of_mass(scene.motion)).max())


def edited(scene: Scene) -> Scene:
    """The same with the goal 5 cm higher."""
    own = scene.variants["balanced"]
    goals = tuple(replace(g, at=np.array(GOAL) + EDIT) if g.name == "wrist to its goal" else g for g in own.constraints)
    return replace(scene, variants={"balanced": Variant(goals, own.settings)})


def check_edit(scene: Scene, balanced: Outcome) -> list[Finding]:
    """`redeform` after an edit of the goal against `deform` of the edited constraints: the same."""
    new = edited(scene)
    constraints = new.variants["balanced"].constraints
    again = redeform(balanced.deformation, scene.motion, constraints)
    whole = deform(scene.motion, constraints, new.variants["balanced"].settings)
    apart = np.abs(np.asarray(again.motion.rotations) - np.asarray(whole.motion.rotations)).max()
    return [Finding("an edit followed is the same as solved anew", float(apart), below=1e-6, unit="")]
