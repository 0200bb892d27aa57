"""What every solver is asked, and how its answer is scored.

Each frame starts at the last one's result and takes K inner iterations; feet in the higher layer, then the hand, posture
last. Scores are of the joint states that a solver returns, by one kinematics for all, so that nobody marks his own work;
positions that a solver reports must agree with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.numpy_baseline.deform import Body, positions
from benchmarks.numpy_baseline.deform.rotations import conjugate, log, multiply

from .scene import Scene

TURN = 4
"""Runs of a solver in a row."""


class Unavailable(Exception):
    """A solver that cannot run here; the message says why in one line."""


class Answer(NamedTuple):
    """root (F, 3), rotations (F, J, 4 wxyz): joint states. feet (2, F, 3), left first, hand (F, 3): the world positions that
    the solver itself believes in, if it has them."""

    root: np.ndarray
    rotations: np.ndarray
    feet: np.ndarray | None = None
    hand: np.ndarray | None = None


@dataclass(frozen=True)
class Solver:
    """run(scene, hand path, K) gives the whole clip: "RH" or "FAR" for the path, K inner iterations a frame.

    What it prepares once (models, compiled code) it keeps between calls: only later calls are timed. Raises `Unavailable`.
    """

    name: str
    run: Callable[[Scene, str, int], Answer]


class Score(NamedTuple):
    """Errors in millimetres; jitter: root mean square of the second difference of the rotations of the joints between
    hand and root, milliradians per frame squared; milliseconds a frame, the best of several runs."""

    feet_mean: float
    feet_max: float
    hand_mean: float
    hand_max: float
    hand_last: float
    jitter: float
    ms: float


def ends(scene: Scene, root: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World positions of the feet (2, F, 3) and the hand (F, 3) in the joint states (F, 3) and (F, J, 4)."""
    place = positions(figure(scene), root, rotations)
    left, right, hand = scene.ends
    return np.stack([place[:, left], place[:, right]]), place[:, hand]


def figure(scene: Scene) -> Body:
    """The scene's figure as the baseline's `Body`: masses at the joints."""
    return Body(np.array(scene.parents), scene.offsets, scene.masses, np.zeros_like(scene.offsets))


def score(scene: Scene, path: str, got: Answer, seconds: float = float("nan")) -> Score:
    """The score of one answer; `ValueError` if its positions are not those of its joint states to 0.01 mm."""
    root, rotations = np.asarray(got.root, float), np.asarray(got.rotations, float)
    rotations = rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
    feet_at, hand_at = ends(scene, root, rotations)
    for reported, true in ((got.feet, feet_at), (got.hand, hand_at)):
        if reported is not None and not (off := np.abs(np.asarray(reported) - true).max()) < 1e-5:
            raise ValueError(f"reported positions are {off:.3g} m off the kinematics of the joint states")
    feet = np.linalg.norm(feet_at - np.stack([scene.targets["LF"], scene.targets["RF"]]), axis=-1) * 1e3
    hand = np.linalg.norm(hand_at - scene.targets[path], axis=-1) * 1e3
    line = figure(scene).lineage(scene.ends[2])
    turned = rotations[:, line]
    speed = log(multiply(turned[1:], conjugate(turned[:-1])))
    jitter = 1e3 * np.sqrt(np.mean(np.sum(np.diff(speed, axis=0) ** 2, -1))) if scene.frames > 2 else 0.0
    return Score(
        feet.mean(), feet.max(), hand.mean(), hand.max(), hand[-1], float(jitter), 1e3 * seconds / scene.frames
    )


def compare(
    scene: Scene, solvers: Sequence[Solver], path: str, k: int, rounds: int = 3, longest: float = 20.0
) -> dict[str, Score | str]:
    """Scores by name of all solvers, or the line that says why there is none.

    After a run that does not count (it loads and compiles) the solvers take turns, `rounds` of them, so that a machine whose speed
    drifts spoils no ratio; a turn is `TURN` runs, of which the first finds the caches as the solver before it left them. A
    solver stops taking turns after `longest` seconds.
    """
    scores: dict[str, Score | str] = {}
    spent: dict[str, list[float]] = {}
    for solver in solvers:
        try:
            scores[solver.name] = score(scene, path, solver.run(scene, path, k))
            spent[solver.name] = []
        except Unavailable as why:
            scores[solver.name] = str(why)
        except Exception as error:  # a peer that fails must not take the table with it
            scores[solver.name] = f"failed: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    for _ in range(rounds):
        for solver in solvers:
            times = spent.get(solver.name)
            if times is None or sum(times) > longest:
                continue
            for _ in range(TURN):
                begin = time.perf_counter()
                solver.run(scene, path, k)
                times.append(time.perf_counter() - begin)
    for name, times in spent.items():
        had = scores[name]
        if isinstance(had, Score) and times:
            scores[name] = had._replace(ms=1e3 * min(times) / scene.frames)
    return scores
