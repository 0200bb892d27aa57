"""Public systems on the reach task. Each is optional: one that is not installed says so in one line and is left out."""

from __future__ import annotations

from benchmarks.reach.protocol import Solver


def solvers() -> list[Solver]:
    """All adapters; nothing is imported before a solver runs."""
    from . import mink_solver, pink_solver, placo_solver

    return [*mink_solver.SOLVERS, *pink_solver.SOLVERS, *placo_solver.SOLVERS]
