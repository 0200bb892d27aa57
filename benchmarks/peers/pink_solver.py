"""pink (Pinocchio) with the QP solver daqp: as mink, on the URDF of the same figure.

"default" are the costs of its own examples; "tuned" is feet 100 : hand 1 and damping 0.1, found by hand for this task.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from benchmarks.reach.protocol import Answer, Solver, Unavailable
from benchmarks.reach.scene import FEET, HAND, Scene, quaternion

POSTURE_COST = 1e-3
DT = 1.0


@lru_cache(maxsize=1)
def _model(file: str):
    try:
        import daqp  # noqa: F401
        import pink
        import pinocchio
    except ImportError as error:
        raise Unavailable(f"{error.name} is not installed") from None
    return pink, pinocchio, pinocchio.buildModelFromUrdf(file, pinocchio.JointModelFreeFlyer())


def run(
    scene: Scene, path: str, k: int, foot_cost: float = 1.0, hand_cost: float = 1.0, damping: float = 1e-6
) -> Answer:
    """The whole clip, k differential solves a frame."""
    pink, pinocchio, model = _model(str(scene.folder / "hum.urdf"))
    q = pinocchio.neutral(model)
    q[:3] = scene.root
    for name, angle in scene.angles.items():
        q[model.joints[model.getJointId(name)].idx_q] = angle
    configuration = pink.Configuration(model, model.createData(), q)
    tasks = [
        pink.tasks.FrameTask(name, position_cost=cost, orientation_cost=0.0)
        for name, cost in ((FEET[0], foot_cost), (FEET[1], foot_cost), (HAND, hand_cost))
    ]
    posture = pink.tasks.PostureTask(cost=POSTURE_COST)
    posture.set_target(q)
    paths = [scene.targets["LF"], scene.targets["RF"], scene.targets[path]]
    states = np.empty((scene.frames, model.nq))
    for frame in range(scene.frames):
        for task, goal in zip(tasks, paths, strict=True):
            task.set_target(pinocchio.SE3(np.eye(3), goal[frame]))
        for _ in range(k):
            velocity = pink.solve_ik(configuration, [*tasks, posture], DT, "daqp", damping=damping)
            configuration.integrate_inplace(velocity, DT)
        states[frame] = configuration.q
    rotations = np.empty((scene.frames, len(scene.names), 4))
    rotations[:, 0] = states[:, [6, 3, 4, 5]]
    for j, hinges in enumerate(scene.hinges[1:], 1):
        rotations[:, j] = quaternion(states[:, [model.joints[model.getJointId(h)].idx_q for h in hinges]])
    return Answer(states[:, :3], rotations)


SOLVERS = [
    Solver("pink default", run),
    Solver("pink tuned", partial(run, foot_cost=100.0, hand_cost=1.0, damping=0.1)),
]
