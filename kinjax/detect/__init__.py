"""Detection of kinematic constraints (Le Callennec and Boulic 2006): from poses to constraints.

displacements -> sigma_epsilon -> lmeds, noise, bounds -> instantaneous: steps 1 to 5, which `observing` puts together for a few
objects at a time; merging, settling, refit, windows, pivots: step 6, which `engine` does for all. Then
prepare (clips), planning (templates, patterns), batches -> pipeline -> records. `interface` holds what the engine takes and
gives, `settings` holds every number, `results` what comes back, `prepare` what goes in. Names are imported on first use:
what only needs the settings loads no engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .pipeline import calibrate, detect, detect_many
    from .results import Detection
    from .settings import Settings

__all__ = ["Detection", "Settings", "calibrate", "detect", "detect_many"]
_HOME = {"Detection": "results", "Settings": "settings", "calibrate": "pipeline", "detect": "pipeline", "detect_many": "pipeline"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
