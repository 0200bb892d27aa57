"""Detection of kinematic constraints (Le Callennec and Boulic 2006): from poses to constraints.

displacements -> sigma_epsilon -> lmeds, noise -> instantaneous -> merging, settling, refit, windows, pivots -> engine; then
prepare (clips), planning (templates, patterns) -> pipeline -> records. `interface` holds what the engine takes and gives,
`settings` holds every number, `results` what comes back, `prepare` what goes in.
"""

from .pipeline import calibrate, detect, detect_many
from .results import Detection
from .settings import Settings

__all__ = ["Detection", "Settings", "calibrate", "detect", "detect_many"]
