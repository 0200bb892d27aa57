"""kinjax: find the kinematic constraints in motion data, and bend motion to constraints.

Names here are the public ones; each is imported on first use, so that `import kinjax` loads no reader, plot or engine.
The rooms `kinjax.detect` and `kinjax.deform` have their doors inside, `kinjax.detect.detect` and `kinjax.deform.deform`;
`kinjax.Settings` are those of detection, `kinjax.deform.Settings` those of deformation.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_ROOMS = {
    "errors": (
        "KinjaxError",
        "FileFormatError",
        "UnknownNameError",
        "TemplateError",
        "TemplateTooShort",
        "OptionError",
        "ShapeError",
    ),
    "annotations": ("Annotations", "Constraint", "Constraints", "NoisePattern", "Template"),
    "skeleton": ("Skeleton", "Topology"),
    "motion": ("Motion", "Poses", "make_poses"),
    "kinematics": ("object_poses", "cluster_poses", "forward_kinematics"),
    "detect": ("Detection", "Settings", "calibrate", "detect_many"),
    "deform": (
        "CenterOfMass",
        "Deformation",
        "LookAt",
        "Orientation",
        "Position",
        "Through",
        "clean",
        "deform_many",
        "redeform",
    ),
    "formats": ("load", "save", "read_bvh", "write_bvh", "read_annotations", "write_annotations", "read_edit"),
    "database": ("Configuration", "Store", "TemplateRule", "When", "annotate"),
    "evaluation": ("Label", "evaluate"),
    "memory": ("keep_memory",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

_SUBMODULES = ("database", "deform", "detect", "evaluation", "formats", "kinematics", "plots", "report", "soft", "synthetic")

__all__ = ["__version__", *sorted(_HOME), *_SUBMODULES]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    if name in _SUBMODULES:  # a room, whose door is inside
        return import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
