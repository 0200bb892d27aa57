"""Soft detection: smooth surrogates of detection's discrete steps, so that a loss on labels has a gradient.

steps -> quantile -> lmeds; instantaneous, merging, settling; body (forward kinematics with a cheap derivative) -> core; task
(what goes in) -> pipeline. A `temperature` in (0, 1) says how soft; as it goes to 0 the labels tend to those of
`kinjax.detect`. Names are imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core import SoftDetection
    from .instantaneous import Limits, soft_instantaneous, soft_line
    from .lmeds import SoftKept, soft_lmeds
    from .merging import SoftMerge, soft_merge, soft_opening
    from .pipeline import detect
    from .quantile import smooth_quantile
    from .task import Task, prepare

_HOME = {
    "Limits": "instantaneous",
    "SoftDetection": "core",
    "SoftKept": "lmeds",
    "SoftMerge": "merging",
    "Task": "task",
    "detect": "pipeline",
    "prepare": "task",
    "smooth_quantile": "quantile",
    "soft_instantaneous": "instantaneous",
    "soft_line": "instantaneous",
    "soft_lmeds": "lmeds",
    "soft_merge": "merging",
    "soft_opening": "merging",
}
__all__ = [
    "Limits",
    "SoftDetection",
    "SoftKept",
    "SoftMerge",
    "Task",
    "detect",
    "prepare",
    "smooth_quantile",
    "soft_instantaneous",
    "soft_line",
    "soft_lmeds",
    "soft_merge",
    "soft_opening",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
