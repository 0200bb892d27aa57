"""Stepping (2004 paper, figure 4): a foot lifted in the middle of a walk, by priorities and by weights.

All four footplants hold their original trajectories over the whole clip at low priority; the left ankle goes higher in one
step at high priority. In conflict, priorities let the ankle reach its goal; weights end between the two. All of them recruit
their legs and not the root: one lifts a foot by its leg.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinjax.deform import Position, Through

from .clips import FEET, LEGS, distance, load_walk, places
from .scene import WEIGHTS, Finding, Outcome, Scene, Variant, kept

BEGIN, TOP, END = 42, 51, 57
"""The swing of the left foot between its second and its third stand."""
LIFT = np.array([0.0, 0.3, 0.0])


def build(data: Path) -> Scene:
    """The scene on the walk of 12_01."""
    motion = load_walk(data)
    ankle = Position(
        "lfoot", through=(Through(TOP, goal(motion)),), begin=BEGIN, end=END, priority=2, name="ankle lifted",
        recruits=LEGS["lfoot"][:-1],
    )  # fmt: skip
    constraints = (*kept(FEET, root=False, priority=1), ankle)
    variants = {
        "priorities": Variant(constraints),
        "weights": Variant(constraints, WEIGHTS),
    }
    at = tuple(float(x) for x in goal(motion))
    return Scene("stepping", motion, variants, (47, TOP), tuple(variants), (at,), ("lfoot",))


def goal(motion) -> np.ndarray:
    """Where the ankle goes: 30 cm over its own place in the middle of the swing."""
    return places(motion, "lfoot")[TOP] + LIFT


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """The paper's claims for figure 4."""
    to = goal(scene.motion)
    off = {k: 1e3 * distance(places(o.motion, "lfoot")[TOP], to) for k, o in results.items()}
    out = [Finding("priorities: the ankle is at its goal", off["priorities"], below=1.0)]
    stands = max(
        1e3 * distance(places(results["priorities"].motion, j), places(scene.motion, j)).max() for j in FEET[2:]
    )
    out.append(Finding("priorities: the standing foot stays", stands, below=0.1))
    if "weights" in off:
        share = off["weights"] / (1e3 * np.linalg.norm(LIFT))
        out.append(Finding("weights: the ankle ends between goal and footplant", share, 0.9, 0.1, "of the lift"))
    return out
