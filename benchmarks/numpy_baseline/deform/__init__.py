"""Le Callennec and Boulic 2004 in plain NumPy: prioritized inverse kinematics, as an oracle and as the baseline timed.

`recursion` is the paper's text; `Solver` is the practical form of the same, with every safeguard that a frame loop needs.
It shares no code with the package that it checks.
"""

from .body import Body, Tree, positions
from .constraints import Constraint, Task
from .linear import gains, gram_schmidt, linear_step, posture_step, row_basis, sweep
from .recursion import recursion
from .solver import Settings, Solver, Track, first_in_order

__all__ = [
    "Body",
    "Constraint",
    "Settings",
    "Solver",
    "Task",
    "Track",
    "Tree",
    "first_in_order",
    "gains",
    "gram_schmidt",
    "linear_step",
    "positions",
    "posture_step",
    "recursion",
    "row_basis",
    "sweep",
]
