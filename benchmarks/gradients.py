"""`python -m benchmarks.gradients`: what derivatives through the deformation cost, in time and memory.

A walk whose feet are held above a hand's reach, 240 frames, float64, one pinned core: the forward solve against the solve with
its gradient by all variables. Then clips of 250 to 2,000 frames in a process each, which compiles the program or takes it
from the compilation cache: memory at its peak, and what XLA sets aside.
Ratios within one run can be trusted.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.deform_speed import best
from benchmarks.speed import one_core


def problem(frames: int, gradient: str, iterations: int) -> Any:
    """A reach on a walk: both feet above a hand."""
    import numpy as np

    from kinjax.deform import Bend, Position, Settings
    from kinjax.synthetic import walking_biped

    motion = walking_biped(rate=60, steps=8).motion
    at = np.arange(frames) % motion.frames
    motion = replace(motion, rotations=motion.rotations[at], translations=motion.translations[at])
    goals = [
        Position("LeftFoot", priority=2),
        Position("RightFoot", priority=2),
        Position("LeftHand", offset=(0.05, 0.1, 0.1), priority=1),
    ]
    return Bend(motion, goals, Settings(iterations=iterations), gradient=gradient)  # type: ignore[arg-type]


def functions(bend: Any) -> tuple[Any, Any]:
    """The solve, and the solve with the gradient of a loss that sees every pose."""
    import jax
    import jax.numpy as jnp

    def loss(v: Any) -> Any:
        bent = bend(v)
        return jnp.sum(bent.motion.rotations**2 * jnp.arange(4.0)) + jnp.sum(bent.motion.translations**2)

    return jax.jit(lambda v: bend(v).motion.rotations), jax.jit(jax.value_and_grad(loss))


def speed(frames: int) -> None:
    """Seconds of both, and their ratio."""
    import jax

    for gradient in ("implicit", "implicit_local"):
        bend = problem(frames, gradient, 20)
        forward, both = functions(bend)
        left = bend(bend.variables).converged
        run = [lambda f=f, v=bend.variables: jax.block_until_ready(f(v)) for f in (forward, both)]
        for f in run:
            f()
        one, two = (best(f, 7) for f in run)
        print(
            f"{gradient}: {frames} frames, {int(left.sum())} converged; forward {1e3 * one:.0f} ms, "
            f"with its gradient {1e3 * two:.0f} ms: x{two / one:.1f}"
        )


def _peak() -> float:
    """Largest resident memory of this process so far, MiB (what `getrusage` says would count that of the parent, too)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024


def memory(frames: int, gradient: str) -> None:
    """Peak resident memory of this process after one gradient, and what the program asks for."""
    import jax

    bend = problem(frames, gradient, 20)
    base = _peak()
    both = functions(bend)[1]
    compiled = both.lower(bend.variables).compile()
    after = _peak()
    jax.block_until_ready(compiled(bend.variables))
    peak = _peak()
    asks = compiled.memory_analysis().temp_size_in_bytes / 2**20
    print(
        f"{gradient}: {frames} frames: peak {peak:.0f} MiB ({base:.0f} before, {after:.0f} with the compiler); "
        f"the program's own {asks:.0f} MiB"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--memory", type=int, help="only the memory of a clip of so many frames")
    parser.add_argument("--gradient", default="implicit")
    options = parser.parse_args()
    one_core()
    from kinjax.cli.cache import use_deform_flags

    use_deform_flags()
    import jax

    jax.config.update("jax_enable_x64", True)
    if options.memory:
        return memory(options.memory, options.gradient)
    speed(options.frames)
    for frames in (250, 1000, 2000):
        with tempfile.TemporaryDirectory() as kept:
            for told in ("compiled", "compiled before"):
                print(f"{told}: ", end="", flush=True)
                env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": kept, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
                subprocess.run([sys.executable, "-m", "benchmarks.gradients", "--memory", str(frames)], check=True, env=env)


if __name__ == "__main__":
    main()
