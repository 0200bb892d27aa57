"""Deformation: a motion bent to constraints of any number of strict priorities, smoothly, in balance (2004 paper).

In: a `Motion` and constraints. Out: `Deformation`, the new motion and a report. `deform` is the door; `redeform` follows an
edit, `deform_many` takes several clips at once.
"""

from .arrangement import Variables
from .bending import Bend, Bent
from .cleaning import clean, constraints_from
from .comparison import least_squares
from .constraints import CenterOfMass, Goal, LookAt, Orientation, Position, Through
from .pipeline import deform, deform_many, redeform
from .results import STATUSES, Deformation, Report
from .settings import Settings
from .whole_clip import Minimum, whole_clip

__all__ = [
    "STATUSES",
    "Bend",
    "Bent",
    "CenterOfMass",
    "Deformation",
    "Goal",
    "LookAt",
    "Minimum",
    "Orientation",
    "Position",
    "Report",
    "Settings",
    "Through",
    "Variables",
    "clean",
    "constraints_from",
    "deform",
    "deform_many",
    "redeform",
    "least_squares",
    "whole_clip",
]
