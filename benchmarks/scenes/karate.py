"""Karate (2004 paper, figures 5 and 6): a front kick that goes higher while the other foot stands and the body balances.

The standing foot follows its original trajectory at high priority, the centre of mass at middle priority, the kicking ankle
goes to a higher place at low priority, one that can be reached or one that cannot.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinjax.deform import CenterOfMass, Position, Through

from .clips import center_of_mass, distance, load_kick, places
from .scene import WEIGHTS, Finding, Outcome, Scene, Variant, kept

BEGIN, TOP, END = 14, 20, 27
"""The kick leaves the ground and comes back; its foremost frame."""
STANDS = ("LeftAnkle", "LeftToe")
GOALS = {"low": (0.30, 0.80, 1.25), "medium": (0.30, 1.10, 1.20), "high": (0.30, 1.35, 1.05)}
BEYOND = (0.30, 1.75, 1.35)
"""World metres; the last one is out of reach of who stands on the other foot."""


def build(data: Path) -> Scene:
    """The scene on the kick of 131_01."""
    support = kept(STANDS, priority=3)
    balance = CenterOfMass(priority=2, name="centre of mass as it was")

    def kick(at: tuple[float, float, float]) -> Position:
        return Position(
            "RightAnkle", through=(Through(TOP, at),), begin=BEGIN, end=END, priority=1, name="kick to its goal"
        )

    beyond = (*support, balance, kick(BEYOND))
    variants = {
        "priorities": Variant(beyond),
        "without centre of mass": Variant((*support, kick(BEYOND))),
        "weights": Variant(beyond, WEIGHTS),
    } | {name: Variant((*support, balance, kick(at))) for name, at in GOALS.items()}
    places = (BEYOND, *GOALS.values())
    return Scene("karate", load_kick(data), variants, (17, TOP, 23), tuple(variants), places, ("RightAnkle",))


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """The paper's claims for figures 5 and 6."""

    def moved(o: Outcome) -> float:
        return 1e3 * max(distance(places(o.motion, j), places(scene.motion, j)).max() for j in STANDS)

    def off(o: Outcome) -> float:
        return 1e3 * float(distance(center_of_mass(o.motion), center_of_mass(scene.motion)).max())

    out = []
    for name, o in results.items():
        if name == "weights":
            out.append(Finding("weights: the standing foot is disturbed", moved(o), above=5.0))
        else:
            out.append(Finding(f"{name}: the standing foot stays", moved(o), below=0.1, aim=name.startswith("without")))
        short = 1e3 * float(distance(places(o.motion, "RightAnkle")[TOP], np.array(GOALS.get(name, BEYOND))))
        if name in GOALS:
            out.append(Finding(f"{name}: the kick reaches its goal", short, below=1.0))
        elif name == "priorities":
            out.append(Finding("priorities: the goal stays out of reach", short, above=5.0))
    if {"priorities", "without centre of mass"} <= set(results):
        there, gone = off(results["priorities"]), off(results["without centre of mass"])
        out.append(Finding("balanced: the centre of mass stays", there, below=10.0))
        out.append(
            Finding("balance: without it the centre of mass is further off", gone / max(there, 1.0), above=3, unit="x")
        )
    return out
