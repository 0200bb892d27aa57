"""`python -m benchmarks.scenes [--data DIR] [-o OUT] [names]`: deforms, checks, times and draws the scenes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from kinjax.cli.cache import use_deform_flags
from kinjax.plots import residuals_over_time, side_by_side

from . import SCENES, reaching
from .scene import Outcome, Scene, run

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
PAPER = (
    "The paper's (2004, Pentium M 1.6 GHz): reaching and stepping 6 s of motion in 9 s, karate under 2 s, stairs 40 s."
)
HEAD = (
    f"{'scene':<10}{'variant':<24}{'frames':>7}{'motion s':>9}{'cold s':>8}{'warm s':>8}{'x real':>8}"
    f"{'passes':>7}{'solved':>7}{'iter':>6}"
)


def row(scene: Scene, name: str, outcome: Outcome) -> str:
    """One line of the table: frames solved in all passes, iterations a frame; the largest residual of each layer."""
    seconds = scene.motion.frames / float(scene.motion.rate)
    residuals = ", ".join(outcome.by_layer())
    solved, steps = outcome.work()
    return (
        f"{scene.name:<10}{name:<24}{scene.motion.frames:>7}{seconds:>9.2f}{outcome.cold:>8.2f}{outcome.warm:>8.3f}"
        f"{seconds / outcome.warm:>8.1f}{outcome.deformation.report.passes:>7}{solved:>7}{steps:>6.1f}  {residuals}"
    )


def draw(scene: Scene, results: dict[str, Outcome], out: Path) -> None:
    """The scene's picture, and what is left of its first variant's constraints."""
    motions = {name: results[name].motion for name in scene.shown} | {"input": scene.motion}
    picture = side_by_side(
        motions, scene.frames, goals=scene.goals, lines=scene.lines, trail=scene.trail, reference="input"
    )
    picture.savefig(out / f"{scene.name}.png", dpi=90)
    residuals_over_time(next(iter(results.values())).deformation).savefig(out / f"{scene.name}_residuals.png", dpi=80)


def main(arguments: list[str] | None = None) -> int:
    """1 if a claim does not hold; aims may be missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scenes", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=f"scenes: {', '.join(SCENES)} (default: all)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the motion data")
    parser.add_argument("-o", type=Path, default=None, dest="out", help="folder for the pictures")
    parser.add_argument("--repeats", type=int, default=3, help="warm runs, of which the fastest counts")
    options = parser.parse_args(arguments)
    use_deform_flags()  # before the first computation
    if unknown := [n for n in options.names if n not in SCENES]:
        parser.error(f"no scene {unknown[0]!r}: choose from {', '.join(SCENES)}")
    lines, held = [], True
    for name in options.names or SCENES:
        scene = SCENES[name].build(options.data)
        results = run(scene, repeats=max(options.repeats, 1))
        lines += [row(scene, k, o) for k, o in results.items()]
        findings = SCENES[name].check(scene, results)
        if name == "reaching":
            findings += reaching.check_edit(options.data)
        print(f"{name}\n" + "\n".join(f"  {f}" for f in findings), flush=True)
        held &= all(f.holds or f.aim for f in findings)
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            draw(scene, results, options.out)
    print("\n" + "\n".join([HEAD + "  largest residual by layer", *lines, PAPER]))
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
