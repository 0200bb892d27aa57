"""kinjax itself on the reach task: the whole of `deform`, from constraints to motion and report, and the frame loop alone."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from .protocol import Answer, Solver
from .scene import Scene


def run(scene: Scene, path: str, k: int) -> Answer:
    """`kinjax.deform.deform` with its defaults and K iterations; what is compiled is kept by kinjax between calls."""
    from kinjax.deform import Settings, deform

    motion = deform(scene.motion(), constraints(scene, path), Settings(iterations=k)).motion
    return Answer(motion.translations[:, 0], motion.rotations)


def constraints(scene: Scene, path: str) -> list:
    """Both feet above the hand."""
    from kinjax.deform import Position

    left, right, hand = (scene.names[j] for j in scene.ends)
    return [
        Position(left, path=scene.targets["LF"], priority=2),
        Position(right, path=scene.targets["RF"], priority=2),
        Position(hand, path=scene.targets[path], priority=1),
    ]


@lru_cache(maxsize=4)
def _prepared(k: int) -> Any:
    from kinjax.deform import Settings

    return Settings(iterations=k)


_PLANS: dict[Any, Any] = {}


def run_loop(scene: Scene, path: str, k: int) -> Answer:
    """The compiled frame loop on arrays that were laid out before: what the other systems' loops are timed on."""
    import jax
    import numpy as np

    from kinjax.deform.pipeline import output_motion
    from kinjax.deform.plan import make_plan
    from kinjax.deform.solving import solve

    settings = _prepared(k)
    with jax.enable_x64(True):
        key = (path, k, len(scene.targets[path]))
        if key not in _PLANS:
            motion = scene.motion()
            _PLANS[key] = motion, make_plan(motion, tuple(constraints(scene, path)), settings)
        motion, plan = _PLANS[key]
        got = solve(plan, plan.frames, settings, lambda n: None)
    out = output_motion(motion, plan, got.solved)
    return Answer(np.asarray(out.translations[:, 0]), np.asarray(out.rotations))


def run_least_squares(scene: Scene, path: str, k: int) -> Answer:
    """The same problem by weights of 100 to 1 and optimistix's Levenberg-Marquardt, K steps a frame."""
    from kinjax.deform import Settings, least_squares

    got = least_squares(scene.motion(), constraints(scene, path), Settings(iterations=k), ratio=100.0)
    return Answer(got.motion.translations[:, 0], got.motion.rotations)


SOLVERS = [
    Solver("kinjax", run),
    Solver("kinjax, frame loop alone", run_loop),
    Solver("optimistix, weights", run_least_squares),
]
