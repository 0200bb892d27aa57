"""mink (MuJoCo) with the QP solver daqp: frame tasks on the feet and the hand, a posture task of tiny cost.

mink has no priorities: costs stand for them. "default" are the costs of its own examples; "tuned" is feet 100 : hand 1 and
damping 0.1, found by hand for this task.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from benchmarks.reach.protocol import Answer, Solver, Unavailable
from benchmarks.reach.scene import FEET, HAND, Scene, quaternion

POSTURE_COST = 1e-3
DT = 1.0  # a task of gain 1 aims at its whole error; the velocity is integrated over the same time


@lru_cache(maxsize=1)
def _model(file: str):
    try:
        import daqp  # noqa: F401
        import mink
        import mujoco
    except ImportError as error:
        raise Unavailable(f"{error.name} is not installed ([bench] extra)") from None
    return mink, mujoco.MjModel.from_xml_path(file)


def run(
    scene: Scene, path: str, k: int, foot_cost: float = 1.0, hand_cost: float = 1.0, damping: float = 1e-6
) -> Answer:
    """The whole clip, k differential solves a frame."""
    mink, model = _model(str(scene.folder / "hum.xml"))
    configuration = mink.Configuration(model)
    q = configuration.q.copy()
    for name, angle in scene.angles.items():
        q[model.joint(name).qposadr[0]] = angle
    configuration.update(q)
    # The figure's hinges stop at +-2.6 rad, and the solver is told, as in every script of mink.
    limits = [mink.ConfigurationLimit(model)]
    tasks = [
        mink.FrameTask(f"s_{name}", "site", position_cost=cost, orientation_cost=0.0, lm_damping=0.0)
        for name, cost in ((FEET[0], foot_cost), (FEET[1], foot_cost), (HAND, hand_cost))
    ]
    posture = mink.PostureTask(model, cost=POSTURE_COST)
    posture.set_target_from_configuration(configuration)
    paths = [scene.targets["LF"], scene.targets["RF"], scene.targets[path]]
    states = np.empty((scene.frames, model.nq))
    for frame in range(scene.frames):
        for task, goal in zip(tasks, paths, strict=True):
            task.set_target(mink.SE3.from_translation(goal[frame]))
        for _ in range(k):
            velocity = mink.solve_ik(configuration, [*tasks, posture], DT, "daqp", damping=damping, limits=limits)
            configuration.integrate_inplace(velocity, DT)
        states[frame] = configuration.q
    rotations = np.empty((scene.frames, len(scene.names), 4))
    rotations[:, 0] = states[:, 3:7]
    for j, hinges in enumerate(scene.hinges[1:], 1):
        rotations[:, j] = quaternion(states[:, [model.joint(h).qposadr[0] for h in hinges]])
    return Answer(states[:, :3], rotations)


SOLVERS = [
    Solver("mink default", run),
    Solver("mink tuned", partial(run, foot_cost=100.0, hand_cost=1.0, damping=0.1)),
]
