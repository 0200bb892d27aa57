"""`python -m benchmarks.deform_speed`: what a deformation costs to compile, a frame alone, and a frame among 64 clips.

One pinned core, the figure of the tests' reach problem, both feet above a hand, three iterations a frame. Ratios within one
run can be trusted.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from benchmarks.speed import one_core
from kinjax.cli.cache import use_deform_flags


def best(f: Callable[[], object], times: int) -> float:
    """Seconds of the fastest of several runs."""
    out = float("inf")
    for _ in range(times):
        start = time.perf_counter()
        f()
        out = min(out, time.perf_counter() - start)
    return out


def main() -> None:
    """Measure and print."""
    one_core()
    use_deform_flags()

    from kinjax.deform import Position, Settings, deform, deform_many
    from kinjax.synthetic import walking_biped

    motion = walking_biped(rate=60, steps=4).motion
    settings = Settings(iterations=3, filter_root=None)
    goals = [
        Position("LeftFoot", priority=2),
        Position("RightFoot", priority=2),
        Position("LeftHand", offset=(0.05, 0.1, 0.1), begin=60, end=180, priority=1),
    ]
    cold = best(lambda: deform(motion, goals, settings), 1)
    warm = best(lambda: deform(motion, goals, settings), 5) / motion.frames
    print(f"first deformation, with compilation: {cold:.1f} s")
    print(
        f"a frame, from constraints to report: {1e6 * warm:.0f} us ({1 / warm / float(motion.rate):.0f} x real time at 60 fps)"
    )
    for count in (8, 64):
        clips, asked = [motion] * count, [goals] * count
        deform_many(clips, asked, settings)
        each = best(lambda c=clips, a=asked: deform_many(c, a, settings), 2) / motion.frames / count
        print(
            f"a frame of one of {count} clips side by side: {1e6 * each:.0f} us, x{warm / each:.2f} of the single clip's throughput"
        )


if __name__ == "__main__":
    main()
