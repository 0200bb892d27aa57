"""`python -m benchmarks.whole_clip`: all frames at once against frame by frame and filter, and against a dense Jacobian.

One pinned core. 240 frames of a walk, both feet kept above a hand that is moved for two seconds. Times in seconds, first
run (with compilation) and best of three after it. The displacement map's peak acceleration is the largest second
difference of any joint's turn (radians) or of the root (metres), times the rate squared. Ratios within one run can be trusted.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from benchmarks.speed import one_core
from kinjax.cli.cache import use_deform_flags


def timed(f: Callable[[], object], times: int = 3) -> tuple[float, float]:
    """Seconds of the first run, and of the fastest of some after it."""
    out = []
    for _ in range(times + 1):
        start = time.perf_counter()
        f()
        out.append(time.perf_counter() - start)
    return out[0], min(out[1:])


def main() -> None:
    """Measure and print."""
    one_core()
    use_deform_flags()

    import numpy as np

    from kinjax.deform import Deformation, Position, Settings, deform, whole_clip
    from kinjax.synthetic import walking_biped

    walk = walking_biped(rate=60, steps=4).motion
    motion = walk.slice(0, 239)
    goals = [
        Position("LeftFoot", priority=2),
        Position("RightFoot", priority=2),
        Position("LeftHand", offset=(0.05, 0.1, 0.1), begin=60, end=180, priority=1),
    ]

    def told(name: str, first: float, warm: float, d: Deformation) -> None:
        from kinjax.deform.whole_clip import displacement

        way, turn = displacement(motion, d.motion)
        peak = [float(np.linalg.norm(np.diff(x, 2, axis=0), axis=-1).max()) * 60**2 for x in (turn, way)]
        feet, hand = (float(np.nanmax(d.report.residual[:, c])) for c in ([0, 1], [2]))
        print(
            f"{name:<26} first {first:5.1f} s, then {warm:6.3f} s; feet {1e3 * feet:.4f} mm, hand {1e3 * hand:.4f} mm; "
            f"peak acceleration of the map {peak[0]:.1f} rad/s2, root {peak[1]:.2f} m/s2"
        )

    filtered = Settings(filter_joints=4.0)
    runs: list[tuple[str, Callable[[], Deformation]]] = [
        ("deform, as it is", lambda: deform(motion, goals)),
        ("deform, joints filtered", lambda: deform(motion, goals, filtered)),
        ("whole_clip, float64", lambda: whole_clip(motion, goals)),
        ("whole_clip, float32", lambda: whole_clip(motion, goals, Settings(precision="float32"))),
        ("whole_clip, smoother x10", lambda: whole_clip(motion, goals, acceleration=5e-4)),
    ]
    print("240 frames, largest residuals")
    warm = {}
    for name, run in runs:
        first, warm[name] = timed(run)
        told(name, first, warm[name], run())
    print(
        f"whole_clip over deform, warm: {warm['whole_clip, float64'] / warm['deform, as it is']:.1f} "
        f"in float64, {warm['whole_clip, float32'] / warm['deform, as it is']:.1f} in float32"
    )
    dense(walk.slice(90, 119), [*goals[:2], Position("LeftHand", offset=(0.05, 0.1, 0.1), begin=10, end=20)])


def dense(motion, goals, steps: int = 5) -> None:
    """A few steps of the same problem by optimistix' own solver, with its QR of the clip's whole Jacobian."""
    from functools import partial

    import jax
    import numpy as np
    import optimistix as optx

    from kinjax.deform import Settings
    from kinjax.deform.clip_problem import Weights
    from kinjax.deform.clip_solver import minimise
    from kinjax.deform.plan import make_plan
    from kinjax.deform.whole_clip import _problem

    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        plan = make_plan(motion, tuple(goals), Settings())
        weights = Weights(*(np.asarray(x) for x in (5e-3, 1e-4 * 60, 5e-5 * 60**2)))
        problem, _ = _problem(plan, weights, 10.0, np.dtype("float64"))
        frames = motion.frames  # no padding: the dense solver would pay for it most
        problem = problem._replace(
            frames=jax.tree.map(lambda x: x[:frames], problem.frames), valid=problem.valid[:frames]
        )
        start = np.zeros((frames, 3 + 3 * problem.spread.shape[1]))

        @jax.jit
        def banded(p, s):
            return minimise(p, plan.kinds, s, np.int32(steps), np.float64(0.0))

        @partial(jax.jit, static_argnames="many")
        def whole(p, s, many):
            solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
            f = optx.least_squares(lambda u, q: q.errors(plan.kinds, u), solver, s, p, max_steps=many, throw=False)
            return f.value, f.stats["num_steps"], sum((x**2).sum() for x in p.errors(plan.kinds, f.value)) / 2

        def each(run: Callable[[], object], took: int) -> float:
            return timed(lambda: jax.block_until_ready(run()), 2)[1] / took

        ours = banded(problem, start)
        theirs = whole(problem, start, steps)
        a = each(lambda: banded(problem, start), int(ours.steps))
        b = each(lambda: whole(problem, start, steps), int(theirs[1]))
        print(
            f"{frames} frames, {start.size} unknowns, a step: banded {1e3 * a:.1f} ms, dense {1e3 * b:.0f} ms "
            f"(x{b / a:.0f}); half the sum of squares after {steps} steps: {float(ours.cost):.3e}, {float(theirs[2]):.3e}"
        )


if __name__ == "__main__":
    main()
