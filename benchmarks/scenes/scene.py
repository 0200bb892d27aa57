"""What a scene is: a motion, its variants of constraints, what has to come out, and what it costs.

In: a motion and constraints. Out: `Outcome`, one `Deformation` a variant with its times; `Finding`, one claim each.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from kinjax.deform import Deformation, Position, Settings, deform
from kinjax.deform.constraints import Goal
from kinjax.motion import Motion

from .clips import LEGS

WEIGHTS = Settings(strategy="weights")


@dataclass(frozen=True)
class Variant:
    """One way to deform the scene's motion."""

    constraints: tuple[Goal, ...]
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True)
class Scene:
    """`variants` by name, the first one the scene's own. Of the picture: its `frames`, the variants `shown` (the input
    comes last), `goals` as places, `trail` of joints, `lines` in the world."""

    name: str
    motion: Motion
    variants: dict[str, Variant]
    frames: tuple[int, ...]
    shown: tuple[str, ...]
    goals: tuple[tuple[float, float, float], ...] = ()
    trail: tuple[str, ...] = ()
    lines: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Finding:
    """A claim, the number that decides it and the bound: `value` must be below `below`, and above `above`.

    aim: not one of the paper's claims but a figure of merit; it is reported and fails no test.
    """

    claim: str
    value: float
    below: float = np.inf
    above: float = -np.inf
    unit: str = "mm"
    aim: bool = False

    @property
    def holds(self) -> bool:
        """Whether the claim is true."""
        return bool(self.above < self.value < self.below)

    @property
    def word(self) -> str:
        """What stands before it in a list."""
        return "ok " if self.holds else "aim" if self.aim else "NOT"

    def __str__(self) -> str:
        bounds = [f"> {self.above:g}"] * (self.above > -np.inf) + [f"< {self.below:g}"] * (self.below < np.inf)
        return f"{self.word} {self.claim}: {self.value:.4g} {self.unit} ({' and '.join(bounds)})"


@dataclass(frozen=True)
class Outcome:
    """A variant's deformation, with the seconds that it took the first time (compilation included) and then."""

    deformation: Deformation
    cold: float
    warm: float

    @property
    def motion(self) -> Motion:
        """The deformed motion."""
        return self.deformation.motion

    def work(self) -> tuple[int, float]:
        """Frames solved in all passes, and the mean number of iterations in one."""
        counts = np.concatenate([r.solved.iterations for r in self.deformation.again.runs])
        return len(counts), float(counts.mean())

    def by_layer(self) -> list[str]:
        """The largest residual of each priority layer, most important first, in words."""
        report = self.deformation.report
        out = []
        for k in sorted({a for a in report.layer if a >= 0}):
            mine = [i for i, a in enumerate(report.layer) if a == k]
            worst = {u: [report.residual[:, i] for i in mine if report.unit[i] == u] for u in ("m", "rad")}
            far = [f"{1e3 * np.nanmax(worst['m'], initial=0.0):.3g} mm"] if worst["m"] else []
            turned = [f"{np.degrees(np.nanmax(worst['rad'], initial=0.0)):.2g} deg"] if worst["rad"] else []
            out.append(" and ".join(far + turned))
        return out


def run(scene: Scene, names: Sequence[str] | None = None, repeats: int = 0) -> dict[str, Outcome]:
    """Deform by every variant, or those in `names`; `repeats` warm runs, of which the fastest counts."""
    out = {}
    for name in names or scene.variants:
        v = scene.variants[name]
        result, cold = _timed(scene.motion, v)
        warm = min((_timed(scene.motion, v)[1] for _ in range(repeats)), default=float("nan"))
        out[name] = Outcome(result, cold, warm)
    return out


def _timed(motion: Motion, variant: Variant) -> tuple[Deformation, float]:
    begin = time.perf_counter()
    result = deform(motion, variant.constraints, variant.settings)
    return result, time.perf_counter() - begin


def kept(joints: Sequence[str], root: bool = True, **common) -> tuple[Goal, ...]:
    """Constraints that keep joints of the feet on their original trajectories, by their legs and the root, or by the legs alone."""
    return tuple(
        Position(j, name=f"{j} as it was", recruits=LEGS[j] if root else LEGS[j][:-1], **common) for j in joints
    )
