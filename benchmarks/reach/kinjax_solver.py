"""kinjax itself on the reach task."""

from __future__ import annotations

from .protocol import Answer, Solver, Unavailable
from .scene import Scene


def run(scene: Scene, path: str, k: int) -> Answer:
    """The whole clip; what is compiled is kept by kinjax between calls."""
    raise Unavailable("kinjax.deform is not plugged in yet")


SOLVERS = [Solver("kinjax", run)]
