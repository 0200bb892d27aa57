"""Karate (2004 paper, figures 5 and 6): a front kick that goes higher while the other foot stands and the body balances.

The standing foot follows its original trajectory at high priority, the centre of mass (over the ground: a raised leg raises
it) at middle priority, the kicking ankle goes to a higher place at low priority, one that can be reached or one that cannot.
The sides are those of the clip, the paper's exchanged.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinjax.deform import CenterOfMass, Position, Through

from .clips import BODY, LEGS, distance, load_kick, places, sway
from .scene import WEIGHTS, Finding, Outcome, Scene, Variant, kept

BEGIN, TOP, END = 10, 16, 22
"""The right foot is furthest back, the left one about to lift its heel, the right foot about to come down."""
STANDS = ("lfoot", "ltoes")
GOALS = {"low": (0.20, 0.80, 1.08), "medium": (0.20, 1.05, 1.05), "high": (0.20, 1.30, 0.95)}
BEYOND = (0.20, 1.75, 1.35)
"""World metres; the last one is out of reach of who stands on the other foot."""


def build(data: Path) -> Scene:
    """The scene on the kick of 11_01."""
    support = kept(STANDS, priority=3)
    balance = CenterOfMass(axes="xz", priority=2, recruits=BODY, name="centre of mass as it was")

    def kick(at: tuple[float, float, float]) -> Position:
        return Position(
            "rfoot", through=(Through(TOP, at),), begin=BEGIN, end=END, priority=1, recruits=LEGS["rfoot"],
            name="kick to its goal",
        )  # fmt: skip

    beyond = (*support, balance, kick(BEYOND))
    variants = {
        "priorities": Variant(beyond),
        "without centre of mass": Variant((*support, kick(BEYOND))),
        "weights": Variant(beyond, WEIGHTS),
    } | {name: Variant((*support, balance, kick(at))) for name, at in GOALS.items()}
    places = (BEYOND, *GOALS.values())
    return Scene("karate", load_kick(data), variants, (13, TOP, 18), tuple(variants), places, ("rfoot",))


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """The paper's claims for figures 5 and 6."""

    def moved(o: Outcome) -> float:
        return 1e3 * max(distance(places(o.motion, j), places(scene.motion, j)).max() for j in STANDS)

    out = []
    for name, o in results.items():
        if name == "weights":
            out.append(Finding("weights: the standing foot is disturbed", moved(o), above=5.0))
        elif name.startswith("without"):
            out.append(Finding(f"{name}: the standing foot stays", moved(o), below=0.5))
            out.append(Finding(f"{name}: as closely as with it", moved(o), below=0.1, aim=True))
        else:
            out.append(Finding(f"{name}: the standing foot stays", moved(o), below=0.1))
        short = 1e3 * float(distance(places(o.motion, "rfoot")[TOP], np.array(GOALS.get(name, BEYOND))))
        if name in GOALS:
            out.append(Finding(f"{name}: the kick reaches its goal", short, below=1.0))
        elif name == "priorities":
            out.append(Finding("priorities: the goal stays out of reach", short, above=5.0))
    there, gone = (1e3 * sway(results[k].motion, scene.motion).max() for k in ("priorities", "without centre of mass"))
    out.append(Finding("balanced: the centre of mass stays", there, below=1.0))
    out.append(Finding("without its constraint it does not", gone, above=30.0))
    return out
