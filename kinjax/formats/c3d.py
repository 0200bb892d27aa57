"""C3D, the exchange format of motion laboratories: markers in, as world poses of rigid objects.

In: a path. Out: `Markers`, every marker's way in metres, or `Poses` of the rigid objects that the markers make up. Read here
in full, from Intel, DEC and MIPS files of integers or floats; analog data, events and force plates are passed over. Units are
those of POINT:UNITS, the rate POINT:RATE's, up is POINT:Y_SCREEN, z where a file does not say. Writes no C3D.

A point is missing where its residual is negative, where a coordinate is not finite or beyond all bounds, and where it is at
exactly 0, 0, 0 while it is elsewhere in other frames: some programs write gaps so. All are counted in the notes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import FileFormatError, OptionError
from ..motion import Poses, clip_name
from .c3d_layout import Layout, read_layout
from .c3d_objects import Markers, rigid_objects
from .c3d_sections import floats
from .files import clean_text, read_bytes

FARTHEST = 1000.0
"""Metres; no marker is farther from the origin, in any direction."""

__all__ = ["Markers", "read_c3d", "read_c3d_markers", "rigid_objects"]


def read_c3d(path: str | Path, clusters: str | Mapping[str, Sequence[str]] = "auto", *, up: str = "auto") -> Poses:
    """World poses of the rigid objects in a C3D file; masked in the frames that do not show all of an object's markers.

    clusters: "auto" for body parts by the labels of the usual marker sets (`kinjax.marker_sets`), or {object: [labels]}. up:
    "x", "y", "z", or "auto" for what the file says. An object's origin is the centroid of its markers: a foot is heel, toe
    and ankle. What was assumed and left out is told by `read_c3d_markers` and `rigid_objects`, of which this is both.

    Raises `FileFormatError` for a file that is none, is damaged, or has no object; `OptionError` and `UnknownNameError` for
    clusters and axes that make no sense.
    """
    return rigid_objects(read_c3d_markers(path, up=up), clusters, path)[0]


def read_c3d_markers(path: str | Path, *, up: str = "auto") -> Markers:
    """The markers of a C3D file, float64 metres, NaN where missing; `notes` say what was assumed and counted.

    up: "x", "y", "z", or "auto" for what the file says. Raises `FileFormatError` for a file that is none or is damaged.
    """
    if up not in ("auto", "x", "y", "z"):
        raise OptionError(f"up={up!r}: choose from auto, x, y, z")
    data = read_bytes(path)
    layout = read_layout(data, path)
    if up != "auto":
        layout = replace(layout, up=up, notes=(*(n for n in layout.notes if " is up, " not in n), f"{up} is up, as given"))
    if not layout.markers:
        found = f"none of the {layout.points} points is a marker: all are listed as angles, forces or the like"
        raise FileFormatError(found, path=path, remedy="export markers with it")
    labels = tuple(layout.labels[i] for i in layout.markers)
    positions, notes = _positions(data, layout, path)
    clip = clean_text(clip_name(path))
    return Markers(labels, positions, layout.rate, layout.up, clip, (*layout.notes, *notes))


def _positions(data: bytes, layout: Layout, path: object) -> tuple[np.ndarray, list[str]]:
    """(frames, markers, 3) metres with NaN where missing, and notes on what is missing."""
    width = 4 if layout.floats else 2
    frame = (4 * layout.points + layout.analog) * width
    raw = np.frombuffer(data, np.uint8, count=layout.frames * frame, offset=layout.start).reshape(layout.frames, frame)
    raw = raw[:, : 4 * width * layout.points].reshape(layout.frames, layout.points, 4 * width)[:, list(layout.markers)]
    if layout.floats:
        values = floats(raw, layout.processor)
    else:
        values = np.ascontiguousarray(raw).view(">i2" if layout.processor == "MIPS" else "<i2").astype(np.float64)
    positions = values[..., :3] * (layout.scale * layout.unit)
    lost = (values[..., 3] < 0) | ~np.isfinite(positions).all(-1)
    with np.errstate(invalid="ignore"):
        far = ~lost & (np.abs(positions) > FARTHEST).any(-1)
    if (count := int(far.sum())) > 0.01 * (~lost).sum():
        found = f"{count} of {lost.size} marker positions are more than {FARTHEST:g} m away: the numbers are damaged"
        raise FileFormatError(found, path=path, remedy="get a complete copy, or export the recording again")
    lost |= far
    origin = ~lost & (positions == 0).all(-1)
    origin &= (~lost & ~origin).any(0)
    positions[lost | origin] = np.nan
    notes = []
    if count:
        notes.append(f"{count} marker positions more than {FARTHEST:g} m away are taken as missing")
    if count := int(lost.sum()):
        notes.append(f"{count} of {lost.size} marker positions are missing")
    if count := int(origin.sum()):
        notes.append(f"{count} marker positions at exactly 0, 0, 0 are taken as missing")
    return positions, notes
