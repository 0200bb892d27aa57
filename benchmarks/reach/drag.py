"""`python -m benchmarks.reach.drag [--data DIR] [--k 3 10] [--drags 0.1 0.2]`: what the drag of a stretched limb costs its reach.

Drag keeps a limb that straightens from snapping, and one beyond its reach from jumping between poses that reach equally far. Here the
figure's hand is led away from where it starts on straight ways, out and half of the way back, some of them beyond its reach. Printed
are how far the hand stays from its target where that is farthest, how much of this the nearest pose would have left (the solver
without drag and filter, 60 iterations), and the largest acceleration of the joints (second differences of their turns, mrad).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinjax.cli.cache import use_deform_flags

WAYS = (
    ((1.0, -0.5, 1.0), 0.9),
    ((1.0, -0.5, 1.0), 1.1),
    ((1.0, -0.5, 1.0), 1.3),
    ((1.0, 0.6, 0.3), 1.6),
    ((-0.6, 0.2, 1.0), 1.3),
    ((0.2, -1.0, 1.0), 1.1),
)
"""Directions, and how far a hand is led along them, metres."""


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reach.drag", description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder with ik_reach/ in it")
    parser.add_argument("--k", type=int, nargs="+", default=[3, 10], help="iterations a frame")
    parser.add_argument("--drags", type=float, nargs="+", default=[0.05, 0.1, 0.2], help="drags to compare")
    args = parser.parse_args()
    use_deform_flags()

    from benchmarks.numpy_baseline.deform.rotations import conjugate, log, multiply
    from kinjax.deform import Settings, deform

    from .kinjax_solver import constraints
    from .scene import read_scene

    scene = read_scene(args.data)
    motion, start = scene.motion(), scene.targets["RH"][0]
    profile = np.sin(0.6 * np.pi * np.linspace(0, 1, motion.frames))[:, None]
    print(f"{'way':<20} {'m':>4} {'K':>3} {'drag':>5} {'farthest, mm':>13} {'more than nearest':>18} {'most, mrad':>11}")
    for way, far in WAYS:
        target = start + far * profile * np.array(way) / np.linalg.norm(way)
        goals = constraints(replace(scene, targets={**scene.targets, "RH": target}), "RH")
        nearest = deform(motion, goals, Settings(filter_root=None, drag=0.0, iterations=60)).report.residual[:, 2].max()
        for k in args.k:
            for drag in args.drags:
                done = deform(motion, goals, Settings(iterations=k, drag=drag))
                most = done.report.residual[:, 2].max()
                q = done.motion.rotations / np.linalg.norm(done.motion.rotations, axis=-1, keepdims=True)
                turns = np.diff(log(multiply(q[1:], conjugate(q[:-1]))), axis=0)
                jerky = 1e3 * np.linalg.norm(turns, axis=-1).max()
                more = f"{1e3 * (most - nearest):7.2f} mm {100 * (most / nearest - 1):5.1f} %" if nearest > 1e-3 else "within reach"
                print(f"{way!s:<20} {far:4.1f} {k:3d} {drag:5.2f} {1e3 * most:13.3f} {more:>18} {jerky:11.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
