"""Reaching (2004 paper, figure 3): a walk in which the left hand takes something beside the path, with and without balance.

The feet keep their trajectories at high priority (ankle and toe joint of each), the wrist reaches at middle priority during
40 frames, with the spine's help, and the centre of mass stays over its original trajectory on the ground at low priority (its
height is free: who reaches down may bend).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from kinjax.deform import CenterOfMass, Position, deform, redeform, solving

from .clips import BODY, FEET, RATE, SPINE, distance, load_walk, places, poses, sway
from .scene import Finding, Outcome, Scene, Variant, kept

ARM = ("lradius", "lhumerus", "lclavicle")
HOLD = (33, 38)
"""Frames in which the wrist rests at its goal: a quarter of a second, while the left foot stands."""
EASED = 17
EASE = EASED / RATE
"""With 17 frames to go there and 17 back, the constraint is active in 40 frames, as the paper's."""
GOAL = (0.85, 1.0, 1.0)
"""World metres: hip high, to the left and ahead, out of an arm's reach of the walk, in reach with the spine's help."""

EDIT = (0.0, 0.05, 0.0)
LATER = 16
"""Frames by which the reach is put off for the edit: the clip's first frames have nothing to do with it then."""
FILTER = 6
"""Frames that the filter of the root reaches to either side (`Settings.filter_width` at the paper's rate)."""


def build(data: Path, later: int = 0) -> Scene:
    """The scene on the walk of 35_01; `later`: frames by which the reach is put off."""
    motion = load_walk(data)
    begin, end = HOLD[0] + later, HOLD[1] + later
    goal = np.array(GOAL) + (places(motion, "root")[begin] - places(motion, "root")[HOLD[0]]) * (0, 0, 1)
    wrist = Position(
        "lwrist", at=goal, begin=begin, end=end, ease_in=EASE, ease_out=EASE, priority=2,
        recruits=ARM + SPINE, name="wrist to its goal",
    )  # fmt: skip
    balance = CenterOfMass(axes="xz", priority=1, recruits=BODY, name="centre of mass as it was")
    feet = kept(FEET, priority=3)
    variants = {
        "balanced": Variant((*feet, wrist, balance)),
        "without centre of mass": Variant((*feet, wrist)),
    }
    return Scene("reaching", motion, variants, (26, HOLD[0]), tuple(variants), (GOAL,), ("lwrist",))


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """The paper's claims for figure 3."""
    out = []
    first, last = (max(HOLD[0] - EASED - FILTER, 0), min(HOLD[1] + EASED + FILTER, scene.motion.frames - 1))
    for name, o in results.items():
        feet = max(distance(places(o.motion, j), places(scene.motion, j)).max() for j in FEET)
        wrist = places(o.motion, "lwrist")[HOLD[0] : HOLD[1] + 1]
        report = o.deformation.report
        outside = np.r_[0:first, last + 1 : scene.motion.frames]
        out += [
            Finding(f"{name}: feet hold", 1e3 * feet, below=0.1),
            Finding(f"{name}: the wrist is at its goal", 1e3 * float(distance(wrist, np.array(GOAL)).max()), below=1.0),
            Finding(
                f"{name}: other frames are the input's", np.degrees(report.change[outside].max()), 1e-6, unit="deg"
            ),
            Finding(f"{name}: and where it was", 1e3 * report.root_change[outside].max(), below=1e-6),
        ]
    there, gone = (1e3 * sway(results[k].motion, scene.motion).max() for k in ("balanced", "without centre of mass"))
    out.append(Finding("balanced: the centre of mass stays", there, below=1.0))
    out.append(Finding("without its constraint it does not", gone, above=30.0))
    return out


def check_edit(data: Path) -> list[Finding]:
    """`redeform` after the goal alone has moved: fewer frames are solved than by `deform`, and they come out the same."""
    scene = build(data, LATER)
    before = scene.variants["balanced"].constraints
    edited = tuple(replace(g, at=np.asarray(g.at) + EDIT) if g.name == "wrist to its goal" else g for g in before)
    start = deform(scene.motion, before)
    with patch.object(solving, "_solve", wraps=solving._solve) as call:
        again = redeform(start, scene.motion, edited)
        few = sum(int(c.args[-1]) for c in call.call_args_list)
        whole = deform(scene.motion, edited)
        all_of_them = sum(int(c.args[-1]) for c in call.call_args_list) - few
    apart = np.abs(poses(again.motion)[1] - poses(whole.motion)[1]).max()
    return [
        Finding("an edit solves a part of the clip", few / all_of_them, below=0.99, unit="of its frames"),
        Finding("and gives what solving all of it gives", 1e3 * float(apart), below=1e-3),
    ]
