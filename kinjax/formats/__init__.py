"""The file formats: motion comes in as BVH, ASF/AMC, C3D (marker clusters) and npz, and goes out as BVH and npz;
annotations as JSON, CSV, Parquet, npz and exports; the constraints of a deformation as edit files.

In: paths. Out: `Motion`, `Poses`, `Annotations` and `Edit`, in metres, seconds and radians: a file's own units, degrees and
channel orders stop here. A file is read whole or refused (`FileFormatError`: file, line, column, what was found, the
remedy); nothing is silently dropped, padded or repeated, and what was tolerated is said in `Motion.notes`. Files are
written to a temporary neighbour and moved into place. Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileFormatError, OptionError

if TYPE_CHECKING:
    from ..motion import Motion, Poses

_ROOMS = {
    "bvh": ("parse_bvh", "read_bvh"),
    "bvh_write": ("write_bvh",),
    "bvh_like": ("write_bvh_like",),
    "asf_amc": ("read_amc", "read_asf"),
    "c3d": ("Markers", "read_c3d", "read_c3d_markers", "rigid_objects"),
    "npz": ("read_motion_npz", "read_poses_npz", "write_motion_npz", "write_poses_npz"),
    "annotations_io": ("read_annotations", "write_annotations"),
    "edits": ("Edit", "parse_edit", "read_edit", "write_edit"),
    "exports": ("export",),
    "labels": ("read_labels", "write_labels"),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}
_READERS = {".bvh": "read_bvh", ".amc": "read_amc", ".c3d": "read_c3d", ".npz": "read_motion_npz"}
_WRITERS = {".bvh": "write_bvh", ".npz": "write_motion_npz"}

__all__ = ["load", "motion_suffixes", "save", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


def motion_suffixes() -> tuple[str, ...]:
    """The suffixes of the files that `load` reads, in small letters."""
    return tuple(_READERS)


def load(path: str | Path, **options: Any) -> Motion | Poses:
    """The motion in a file; the suffix (any case) chooses the reader: .bvh, .amc, .c3d or .npz.

    A .c3d, and an .npz of poses, give `Poses`.

    `options` go to that reader (`read_bvh`: unit, up, joints). Raises `FileFormatError` for another suffix or a broken file.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _READERS:
        found = f"no motion format has the suffix {Path(path).suffix!r}"
        raise FileFormatError(found, path=path, remedy=f"motion is read from {', '.join(_READERS)}")
    try:
        return __getattr__(_READERS[suffix])(path, **options)
    except FileFormatError as error:
        if suffix == ".npz" and "kinjax-poses/" in error.found:  # the file says that it is our other kind
            return __getattr__("read_poses_npz")(path, **options)
        raise


def save(path: str | Path, motion: Motion, **options: Any) -> Path:
    """Write a motion; the suffix (any case) chooses the writer: .bvh (degrees, six digits) or .npz (exact).

    `options` go to that writer (`write_bvh`: unit, digits). Returns the path. Raises `OptionError` for another suffix.
    """
    writer = _WRITERS.get(Path(path).suffix.lower())
    if writer is None:
        raise OptionError(
            f"{path}: no motion format has the suffix {Path(path).suffix!r}; write {' or '.join(_WRITERS)}"
        )
    return __getattr__(writer)(path, motion, **options)
