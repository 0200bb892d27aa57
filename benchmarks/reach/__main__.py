"""`python -m benchmarks.reach [--data DIR] [--k 1 3 10] [--solvers NAME ...]`: every solver on the reach task, one table.

The process pins itself to one core. Solvers run in turns; each time is the best of several warm runs, and its ratio to
kinjax's (to the NumPy baseline's where kinjax does not run) can be trusted more than the milliseconds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.speed import one_core
from kinjax.cli.cache import use_deform_flags


def main() -> int:
    """Run the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reach", description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder with ik_reach/ in it")
    parser.add_argument("--k", type=int, nargs="+", default=[1, 3, 10], help="inner iterations a frame")
    parser.add_argument("--paths", nargs="+", choices=["RH", "FAR"], default=["RH", "FAR"], help="within reach, beyond")
    parser.add_argument("--solvers", nargs="+", default=[], help="only those whose names begin so")
    parser.add_argument("--frames", type=int, default=240, help="only the first so many frames")
    parser.add_argument("--rounds", type=int, default=3, help="timed runs of each solver")
    args = parser.parse_args()
    one_core()
    use_deform_flags()  # as the command line does

    from benchmarks import peers

    from . import kinjax_solver, numpy_solver
    from .protocol import Score, compare
    from .scene import read_scene

    known = [*kinjax_solver.SOLVERS, *numpy_solver.SOLVERS, *peers.solvers()]
    chosen = [s for s in known if not args.solvers or any(s.name.startswith(n) for n in args.solvers)]
    if not chosen:
        parser.error(f"no solver of that name; there are {', '.join(s.name for s in known)}")
    scene = read_scene(args.data).shortened(args.frames)
    width = max(len(s.name) for s in chosen)
    print(f"{'':<{width}}  path   K   feet mean / max     hand mean / max / last (mm)    jitter   ms a frame   ratio")
    missing: dict[str, str] = {}
    for path in args.paths:
        for k in args.k:
            scores = compare(scene, [s for s in chosen if s.name not in missing], path, k, args.rounds)
            base = next((x.ms for n in ("kinjax", "numpy") if isinstance(x := scores.get(n), Score)), float("nan"))
            for name, s in scores.items():
                if isinstance(s, str):
                    missing[name] = s
                    continue
                print(
                    f"{name:<{width}}  {path:<4} {k:>3}   {s.feet_mean:8.5f} {s.feet_max:9.5f}  {s.hand_mean:9.5f}"
                    f" {s.hand_max:10.5f} {s.hand_last:10.5f}  {s.jitter:8.3f}  {s.ms:10.4f}  {s.ms / base:7.2f}",
                    flush=True,
                )
    for name, why in missing.items():
        print(f"{name}: skipped, {why}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
