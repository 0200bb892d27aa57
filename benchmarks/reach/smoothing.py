"""`python -m benchmarks.reach.smoothing [--data DIR] [--k 3]`: what it would cost a hand to go beyond its reach more smoothly.

A limb that is on its target until it is straight stops bending all at once: its angle goes as the root of what is left to
straighten. Any smoother way there begins before the target leaves reach, and leaves the target for it. Here the joints of
"FAR", as `deform` returns them, are smoothed by Hann windows of growing width, and both prices are printed: how far the hand is
then from a target that it could have had, and the feet from theirs (those a solver could give back; the hand's it could not
without the acceleration). Accelerations are second differences of joint turns, beside those of "RH", which stays within reach.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from benchmarks.speed import one_core
from kinjax.cli.cache import use_deform_flags


def smoothed(path: np.ndarray, half: int) -> np.ndarray:
    """(F, ...) by a Hann window of `half` frames to either side."""
    from kinjax.deform.filtering import low_pass

    window = np.hanning(2 * half + 3)[1:-1]
    return low_pass(path, window / window.sum())


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reach.smoothing", description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder with ik_reach/ in it")
    parser.add_argument("--k", type=int, default=3, help="iterations a frame")
    parser.add_argument("--widths", type=int, nargs="+", default=[0, 10, 20, 40, 60, 80], help="frames to either side")
    args = parser.parse_args()
    one_core()
    use_deform_flags()

    from scipy.spatial.transform import Rotation

    from benchmarks.numpy_baseline.deform.rotations import conjugate, log, multiply

    from . import kinjax_solver
    from .protocol import Answer, ends, figure, score
    from .scene import read_scene

    scene = read_scene(args.data)
    arm = figure(scene).lineage(scene.ends[2])

    def accelerations(q: np.ndarray) -> np.ndarray:
        return 1e3 * np.linalg.norm(np.diff(log(multiply(q[1:], conjugate(q[:-1]))), axis=0), axis=-1)

    def told(name: str, path: str, got: Answer) -> tuple[float, float]:
        _, hand = ends(scene, got.root, got.rotations)
        off = 1e3 * np.linalg.norm(hand - scene.targets[path], axis=-1)
        s, a = score(scene, path, got), accelerations(got.rotations)
        reached = off[within].max() if path == "FAR" else off.max()
        most, arms = a.max(), np.sqrt((a[:, arm] ** 2).mean())
        times = "" if base is None else f"x{most / base[0]:5.1f} x{arms / base[1]:5.1f}"
        print(f"{name:<26} {s.feet_max:9.4f} {reached:16.3f} {s.hand_max:14.3f} {most:12.3f} {arms:10.3f}  {times}")
        return most, arms

    print(f"{'':<26} {'feet, mm':>9} {'hand in reach, mm':>16} {'hand, most':>14} {'most, mrad':>12} {'arm, RMS':>10}  of RH")
    base: tuple[float, float] | None = None
    base = told("RH, deform", "RH", kinjax_solver.run(scene, "RH", args.k))
    far = kinjax_solver.run(scene, "FAR", args.k)
    q = far.rotations / np.linalg.norm(far.rotations, axis=-1, keepdims=True)
    _, hand = ends(scene, far.root, q)
    within = np.linalg.norm(hand - scene.targets["FAR"], axis=-1) < 1e-4
    first = Rotation.from_quat(np.broadcast_to(q[:1], q.shape).reshape(-1, 4), scalar_first=True)
    turn = (Rotation.from_quat(q.reshape(-1, 4), scalar_first=True) * first.inv()).as_rotvec().reshape(*q.shape[:2], 3)
    for half in args.widths:
        turned = Rotation.from_rotvec(smoothed(turn, half).reshape(-1, 3)) * first
        got = Answer(smoothed(far.root, half), turned.as_quat(scalar_first=True).reshape(q.shape))
        told(f"FAR, {half} frames each way" if half else "FAR, deform", "FAR", got)
    return 0


if __name__ == "__main__":
    sys.exit(main())
