"""The four scenes of section 6 of the 2004 paper, rebuilt on clips of the CMU database: `python -m benchmarks.scenes`.

Each module has `build(data)`, the motion and its constraints, and `check(scene, results)`, what has to come out.
"""

from . import karate, reaching, stairs, stepping

SCENES = {"reaching": reaching, "stepping": stepping, "karate": karate, "stairs": stairs}
"""The scenes by name, in the paper's order."""
