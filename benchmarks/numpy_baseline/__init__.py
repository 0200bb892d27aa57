"""Le Callennec and Boulic 2006 in plain NumPy, step by step: the baseline that is timed and the oracle of the tests.

It follows docs/paper-method.md and shares no code with the package that it checks.
"""

from .detect import Detection, detect
from .displacements import Displacements, displacements_loop, displacements_vectorised, valid_frames
from .instantaneous import LINE, NONE, SPACE, Instantaneous, instantaneous_constraints, label_loop, label_vectorised
from .merging import Constraint, absorbed_intervals, frame_tolerance, in_frames, merge
from .noise_pattern import (
    RobustMaximum,
    TemplatePattern,
    control_points,
    lmeds_loop,
    lmeds_vectorised,
    naive,
    pattern_curves,
    template_pattern,
    threshold_curve,
)
from .projection import FLOOR, Projection, project_loop, project_one, project_vectorised
from .refit import refit_rotation, refit_space

__all__ = [
    "FLOOR",
    "LINE",
    "NONE",
    "SPACE",
    "Constraint",
    "Detection",
    "Displacements",
    "Instantaneous",
    "Projection",
    "RobustMaximum",
    "TemplatePattern",
    "absorbed_intervals",
    "control_points",
    "detect",
    "displacements_loop",
    "displacements_vectorised",
    "frame_tolerance",
    "in_frames",
    "instantaneous_constraints",
    "label_loop",
    "label_vectorised",
    "lmeds_loop",
    "lmeds_vectorised",
    "merge",
    "naive",
    "pattern_curves",
    "project_loop",
    "project_one",
    "project_vectorised",
    "refit_rotation",
    "refit_space",
    "template_pattern",
    "threshold_curve",
    "valid_frames",
]
