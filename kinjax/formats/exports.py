"""Annotations for other programs: subtitles on a video, markers in Blender, events in a gait table. One way only.

In: `Annotations`. Out: a text file, written whole or not at all. A constraint covers the frames `begin..end`, both
included; what each format makes of the end stands in its own header:

* WebVTT: a cue's end is **exclusive**, so it is `(end + 1) / fps`, and a cue is on screen for all of its frames;
* Blender: a marker at `begin` and one at `end`, the last frame included, shifted to the frame at which the scene begins;
* events: `<type> begin` at `begin / fps`, `<type> end` at `end / fps`, the time of the last frame included.

Names come from files of strangers: they are escaped for each syntax (markup, Python source, spreadsheet formulas).
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from pathlib import Path

from ..annotations import Annotations
from ..errors import OptionError
from .annotations_json import check
from .annotations_tables import safe_cell
from .files import clean_text, write_atomically

_BONES = "hip|femur|tibia|foot|toe|clav|hum|radius|wrist|hand|finger|thumb"  # of CMU's names: lfemur, rtoes


def _side_pattern(word: str, letter: str) -> re.Pattern[str]:
    either = f"[{letter}{letter.upper()}]"
    return re.compile(rf"(?i:{word})|^{either}(?=[A-Z][a-z]|[_.\s-])|[_.\s:-]{either}$|^{letter}(?={_BONES})")


_SIDES = {"Left": _side_pattern("left", "l"), "Right": _side_pattern("right", "r")}


def export(annotations: Annotations, path: str | Path, format: str | None = None, first_frame: int = 1) -> Path:
    """Write annotations for another program and return the path.

    format: "webvtt" (.vtt), "blender" (.py) or "events" (.csv); None takes it from the suffix of `path`.
    first_frame: Blender only, the scene's frame number of the clip's frame 0.
    Raises `OptionError`: an unknown format, a clip without a rate, a constraint outside its clip.
    """
    by_suffix = {suffix: name for name, (suffix, _) in FORMATS.items()}
    name = format.strip().lower() if format is not None else by_suffix.get(Path(path).suffix.lower())
    if name not in FORMATS:
        known = ", ".join(f"{n} ({s})" for n, (s, _) in FORMATS.items())
        raise OptionError(f"{path}: no export {format or Path(path).suffix!r}; choose from {known}")
    check(annotations)
    if not annotations.fps > 0:
        raise OptionError(f"{annotations.clip or 'annotations'}: the clip has no frame rate, so its frames have no times")
    return write_atomically(path, FORMATS[name][1](annotations, first_frame).encode())


def _marks(a: Annotations) -> list[tuple[int, str, str]]:
    """Frame, object and label of each begin and end, in time order."""
    return sorted((f, c.object, f"{c.type} {w}") for c in a.constraints for f, w in ((c.begin, "begin"), (c.end, "end")))


def _one_line(text: str) -> str:
    """A name for one line of text: control characters and line ends become spaces."""
    return " ".join("".join(c if c.isprintable() else " " for c in clean_text(text)).split())


def _markup(text: str) -> str:
    """A name inside WebVTT text: no tags, no entities, no arrow that would begin a new cue."""
    return _one_line(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _clock(seconds: float) -> str:
    milliseconds = round(seconds * 1000)
    return f"{milliseconds // 3600000:02}:{milliseconds // 60000 % 60:02}:{milliseconds // 1000 % 60:02}.{milliseconds % 1000:03}"


def _webvtt(a: Annotations, _: int) -> str:
    lines = [
        "WEBVTT", "",
        f"NOTE Kinematic constraints of {_markup(a.clip)}, {a.frames} frames at {a.fps:g} a second.",
        "A cue begins at the time of its first frame and ends, exclusive, one frame after its last: (end + 1) / fps.",
    ]  # fmt: skip
    for n, c in enumerate(sorted(a.constraints, key=lambda c: c.begin), 1):  # WebVTT wants cues in order of their begin
        begin, end = c.begin / a.fps, max((c.end + 1) / a.fps, c.begin / a.fps + 0.001)
        lines += ["", str(n), f"{_clock(begin)} --> {_clock(end)}", f"{_markup(c.object)}: {c.type}"]
    return "\n".join(lines) + "\n"


def _blender(a: Annotations, first_frame: int) -> str:
    # Names enter as Python literals in ASCII: nothing in them can end the string or the comment.
    rows = "\n".join(f"    ({frame}, {f'{_one_line(name)} {label}'!a})," for frame, name, label in _marks(a))
    return f'''# Timeline markers for Blender: run this in the text editor of the scene.
# Clip: {a.clip!a}, {a.frames} frames at {a.fps:g} a second.
# Two markers a constraint: at its first frame, and at its last frame, which is included.
# Frames are the clip's, from 0; they land on FIRST_FRAME + frame, so import the motion at the same first frame and
# without scaling to the scene's rate.
import bpy

FIRST_FRAME = {int(first_frame)}
MARKERS = (
{rows}
)

markers = bpy.context.scene.timeline_markers
for frame, name in MARKERS:
    markers.new(name, frame=FIRST_FRAME + frame)
'''


def _side(name: str) -> str:
    """Left, Right or General, as contexts of events are called in C3D files."""
    return next((side for side, pattern in _SIDES.items() if pattern.search(name)), "General")


def _events(a: Annotations, _: int) -> str:
    out = io.StringIO()
    writer = csv.writer(out)
    clip = re.sub(r'[,;"\s]+', " ", _one_line(a.clip))  # no separator: the line must stay one cell
    out.write(f"# Kinematic constraints of {clip} as events: {a.frames} frames at {a.fps:g} a second\r\n")
    out.write("# begin is the time of the first frame and end that of the last (included). Frames count from 0.\r\n")
    writer.writerow(["object", "side", "label", "time_s", "frame"])
    for frame, name, label in _marks(a):
        writer.writerow([safe_cell(name), _side(name), label, repr(frame / float(a.fps)), int(frame)])
    return out.getvalue()


FORMATS: dict[str, tuple[str, Callable[[Annotations, int], str]]] = {
    "webvtt": (".vtt", _webvtt),
    "blender": (".py", _blender),
    "events": (".csv", _events),
}
