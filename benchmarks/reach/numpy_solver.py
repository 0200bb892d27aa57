"""The NumPy baseline on the reach task."""

from __future__ import annotations

from functools import partial

from benchmarks.numpy_baseline.deform import Constraint, Settings
from benchmarks.numpy_baseline.deform import Solver as Baseline

from .protocol import Answer, Solver, figure
from .scene import Scene


def layers_of(scene: Scene, path: str, order: tuple[str, ...]) -> list[list[Constraint]]:
    """The task's constraints in layers: "feet" for both in one, "LF", "RF", "hand", or the hand's "x", "y", "z"."""
    left, right, hand = scene.ends
    feet = [Constraint("position", scene.targets["LF"], left), Constraint("position", scene.targets["RF"], right)]
    rows = {"feet": feet, "LF": feet[:1], "RF": feet[1:], "hand": [Constraint("position", scene.targets[path], hand)]}
    for k, axis in enumerate("xyz"):
        rows[axis] = [Constraint("position", scene.targets[path], hand, axes=tuple(i == k for i in range(3)))]
    return [rows[name] for name in order]


def run(
    scene: Scene, path: str, k: int, order: tuple[str, ...] = ("feet", "hand"), settings: Settings | None = None
) -> Answer:
    """The whole clip; set-up is a millisecond and is not kept."""
    own = Settings(iterations=k) if settings is None else settings
    track = Baseline(figure(scene), layers_of(scene, path, order), own).solve(scene.root, scene.rotations)
    return Answer(track.root, track.rotations)


SOLVERS = [Solver("numpy", run), Solver("numpy LF, RF, hand", partial(run, order=("LF", "RF", "hand")))]
