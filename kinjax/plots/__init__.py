"""Pictures of detection and deformation: what the papers' figures show, for any clip.

In: a `Detection`, a `Deformation`, `Annotations`, a `Motion` or plain arrays. Out: a `matplotlib.figure.Figure` each, drawn without
pyplot and without any window; `figure.savefig` writes it. An `ax=` draws into axes of one's own. Colours mean the same
in every picture (`style.py` names them). Figure numbers are those of the 2006 paper,
in `deformation` of the 2004 paper.
"""

from .curves import noise_pattern
from .deformation import residuals_over_time, side_by_side
from .scene import objects_3d, skeleton_3d
from .space import local_against_global, sigma_epsilon
from .timeline import timeline

__all__ = [
    "local_against_global",
    "noise_pattern",
    "objects_3d",
    "residuals_over_time",
    "side_by_side",
    "sigma_epsilon",
    "skeleton_3d",
    "timeline",
]
