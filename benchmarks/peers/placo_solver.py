"""placo (C++ over Pinocchio, its own QP): soft position tasks on feet and hand, a joints task of tiny weight.

Its hard priority for the feet would be the natural choice, but beyond reach its QP then fails as infeasible at the usual
regularization. "default" is weights 1 : 1 and the regularization of its examples (1e-4); "tuned" is feet 1e4 : hand 1 and
regularization 0.3, found by hand for this task.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from benchmarks.reach.protocol import Answer, Solver, Unavailable
from benchmarks.reach.scene import FEET, HAND, Scene, quaternion


@lru_cache(maxsize=1)
def _robot(folder: str):
    try:
        import placo
    except ImportError as error:
        raise Unavailable(f"{error.name} is not installed") from None
    return placo, placo.RobotWrapper(folder, placo.Flags.ignore_collisions)


def run(scene: Scene, path: str, k: int, foot_weight: float = 1.0, regularization: float = 1e-4) -> Answer:
    """The whole clip, k differential solves a frame."""
    placo, robot = _robot(str(scene.folder / "hum.urdf"))
    robot.reset()
    start = np.eye(4)
    start[:3, 3] = scene.root
    robot.set_T_world_fbase(start)
    for name, angle in scene.angles.items():
        robot.set_joint(name, angle)
    robot.update_kinematics()
    solver = placo.KinematicsSolver(robot)
    paths = [scene.targets["LF"], scene.targets["RF"], scene.targets[path]]
    tasks = []
    for name, goal, weight in zip((*FEET, HAND), paths, (foot_weight, foot_weight, 1.0), strict=True):
        task = solver.add_position_task(name, goal[0])
        task.configure(name, "soft", weight)
        tasks.append(task)
    posture = solver.add_joints_task()
    posture.set_joints(dict(scene.angles))
    posture.configure("posture", "soft", 1e-6)
    solver.add_regularization_task(regularization)
    hinges = [robot.get_joint_offset(h) for own in scene.hinges[1:] for h in own]
    states = np.empty((scene.frames, len(robot.state.q)))
    for frame in range(scene.frames):
        for task, goal in zip(tasks, paths, strict=True):
            task.target_world = goal[frame]
        for _ in range(k):
            solver.solve(True)
            robot.update_kinematics()
        states[frame] = robot.state.q
    rotations = np.empty((scene.frames, len(scene.names), 4))
    rotations[:, 0] = states[:, [6, 3, 4, 5]]
    rotations[:, 1:] = quaternion(states[:, hinges].reshape(scene.frames, -1, 3))
    return Answer(states[:, :3], rotations)


SOLVERS = [
    Solver("placo default", run),
    Solver("placo tuned", partial(run, foot_weight=1e4, regularization=0.3)),
]
