"""`python -m benchmarks.reach.optimum [--data DIR]`: where the hand beyond reach ends in the best case, by SLSQP.

An optimiser that knows nothing of layers, on the last frame of "FAR": feet held exactly; then either the whole hand error is
minimised, or one axis after the other, each error found being held (to `SLACK`) while the next is minimised.
What a prioritized solver may be asked for is this, and no more. Its kinematics are SciPy's rotations and central differences.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from .scene import Scene, read_scene

SLACK = 1e-6  # metres: an error at its minimum has no gradient to hold it by, so that it is held from above
STEP = 1e-6


class Chain:
    """Feet and hand (9,) as a function of root translation and one rotation vector per joint above them."""

    def __init__(self, scene: Scene):
        self.scene = scene
        lines = [self._lineage(end) for end in scene.ends]
        self.used = sorted({j for line in lines for j in line})
        self.turned = sorted({j for line in lines for j in line[1:]})
        q = scene.rotations[self.turned][:, [1, 2, 3, 0]]
        self.start = np.concatenate([scene.root, Rotation.from_quat(q).as_rotvec().ravel()])

    def _lineage(self, joint: int) -> list[int]:
        line = []
        while joint >= 0:
            line.append(joint)
            joint = self.scene.parents[joint]
        return line

    def batch(self, x: np.ndarray) -> np.ndarray:
        """(B, 9) of (B, variables)."""
        own = Rotation.from_rotvec(x[:, 3:].reshape(-1, 3)).as_matrix().reshape(len(x), -1, 3, 3)
        turn, place = {}, {}
        for j in self.used:
            parent = self.scene.parents[j]
            at = own[:, self.turned.index(j)] if j in self.turned else np.eye(3)
            if parent < 0:
                turn[j], place[j] = at, x[:, :3]
            else:
                turn[j], place[j] = turn[parent] @ at, place[parent] + turn[parent] @ self.scene.offsets[j]
        return np.concatenate([place[end] for end in self.scene.ends], 1)

    def value(self, x: np.ndarray) -> np.ndarray:
        """(9,)."""
        return self.batch(x[None])[0]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """(9, variables) by central differences."""
        ways = STEP * np.eye(len(x))
        both = self.batch(np.concatenate([x + ways, x - ways]))
        return (both[: len(x)] - both[len(x) :]).T / (2 * STEP)


def lexicographic(chain: Chain, goal: np.ndarray, stages: list[list[int]], start: np.ndarray) -> np.ndarray:
    """Errors (9,) in metres after minimising the rows of each stage in turn, feet held and earlier stages not made worse."""
    x = start
    held: list[dict] = []
    for rows in stages:
        limits = [
            {"type": "eq", "fun": lambda x: (chain.value(x) - goal)[:6], "jac": lambda x: chain.jacobian(x)[:6]},
            *held,
        ]
        done = minimize(
            lambda x, rows=rows: 0.5 * np.sum((chain.value(x) - goal)[rows] ** 2),
            x,
            jac=lambda x, rows=rows: (chain.value(x) - goal)[rows] @ chain.jacobian(x)[rows],
            constraints=limits,
            method="SLSQP",
            options={"maxiter": 500, "ftol": 1e-14},
        )
        x = done.x
        for row in rows:
            bound = abs((chain.value(x) - goal)[row]) + SLACK
            for sign in (1.0, -1.0):
                held.append(
                    {
                        "type": "ineq",
                        "fun": lambda x, r=row, b=bound, s=sign: b - s * (chain.value(x) - goal)[r],
                        "jac": lambda x, r=row, s=sign: -s * chain.jacobian(x)[r],
                    }
                )
    return chain.value(x) - goal


def main() -> int:
    """Print the optimum of each order of layers, from several starts."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reach.optimum", description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder with ik_reach/ in it")
    parser.add_argument("--starts", type=int, default=6, help="the start pose and random ones about it")
    args = parser.parse_args()
    scene = read_scene(args.data)
    chain = Chain(scene)
    goal = np.concatenate([scene.targets[name][-1] for name in ("LF", "RF", "FAR")])
    rng = np.random.default_rng(0)
    orders = {"hand": [[6, 7, 8]], "x, y, z": [[6], [7], [8]], "y, x, z": [[7], [6], [8]], "z, y, x": [[8], [7], [6]]}
    for name, stages in orders.items():
        for k in range(args.starts):
            start = chain.start + 0.15 * k * rng.normal(size=len(chain.start))
            e = 1e3 * lexicographic(chain, goal, stages, start)
            print(
                f"feet, then {name:<8} start {k}: hand {np.linalg.norm(e[6:]):9.4f} mm"
                f" ({e[6]:9.4f} {e[7]:9.4f} {e[8]:9.4f}), feet {np.abs(e[:6]).max():.1e}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
