"""Where the points of a C3D file are: what header and parameters claim, held against each other and the file's size.

In: the bytes of a file. Out: a `Layout` whose frames are all in the file, or a `FileFormatError` that says what is claimed
and what is there; nothing is allocated by a claim. Header and parameters state most numbers twice. Where they agree, the
file must hold that much; where they do not, the one combination that fills the file to its last block is taken, and said;
if none does, or several do, the file is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

from ..errors import FileFormatError
from .c3d_sections import BLOCK, Header, Parameters, read_header, read_parameters

UNITS = {
    "mm": 0.001, "millimeter": 0.001, "millimeters": 0.001, "millimetre": 0.001, "millimetres": 0.001,
    "cm": 0.01, "centimeter": 0.01, "centimeters": 0.01, "centimetre": 0.01, "centimetres": 0.01,
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "dm": 0.1, "in": 0.0254, "inch": 0.0254,
}  # fmt: skip
"""Metres in a unit by its name in POINT:UNITS."""

_FULL = 65535  # a 16-bit count that stands for "more"
_FINEST, _COARSEST = 1e-5, 100.0  # scales of integers: 0.3 units to 3 million for the whole space
_COPY = "get a complete copy, or export the recording again"
_NOT_MARKERS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")
_NEEDED = ("USED", "SCALE", "RATE", "UNITS", "LABELS")


@dataclass(frozen=True)
class Layout:
    """What is needed to read the points.

    start: byte of the first frame. frames, points, analog: counts; a frame holds 4 numbers a point, then `analog` others.
    floats: 32-bit floats, else 16-bit integers times `scale`. unit: metres in one unit. labels: one a point, "" where the
    file has none. markers: the points that are markers, not angles or forces. rate: frames a second. notes: what was
    assumed or mended.
    """

    processor: str
    start: int
    frames: int
    points: int
    analog: int
    floats: bool
    scale: float
    unit: float
    rate: float
    up: str
    labels: tuple[str, ...]
    markers: tuple[int, ...]
    notes: tuple[str, ...]


def read_layout(data: bytes, path: object = None) -> Layout:
    """The layout of a file; `FileFormatError` where it cannot be what it claims."""
    header = read_header(data, path)
    parameters = read_parameters(data, header)
    notes: list[str] = []
    if parameters.broken:
        found = f"the parameters are damaged: no entry can be what {parameters.broken} says"
        raise FileFormatError(found, path=path, remedy=_COPY)
    names = {name for group, name in parameters.values if group == "POINT"}
    needed = [d for d in parameters.damaged if d.startswith("POINT:") and d[6:] in _NEEDED]
    if parameters.overwritten:
        notes.append(f"the data begin inside the parameters, in {parameters.overwritten}: what follows it is lost")
        needed += [f"POINT:{n}" for n in _NEEDED if n not in names]
    if needed:
        raise FileFormatError(f"damaged or lost parameters: {', '.join(needed)}", path=path, remedy=_COPY)
    if "LABELS" not in names:
        raise FileFormatError("no POINT:LABELS: the points have no names", path=path, remedy="export markers with names")
    if parameters.damaged:
        notes.append(f"damaged parameters, not read: {', '.join(parameters.damaged)}")
    floats, scale = _storage(header, parameters, notes, path)
    start, frames, points, analog = _extent(data, header, parameters, 4 if floats else 2, notes, path)
    labels, markers = _labels(points, parameters, notes)
    unit, rate, up = _unit(parameters, notes, path), _rate(header, parameters, notes, path), _up(parameters, notes)
    if header.first > 1:
        notes.append(f"frame 0 is frame {header.first} of the recording")
    return Layout(
        header.processor, start, frames, points, analog, floats, scale, unit, rate, up, labels, markers, tuple(notes)
    )


def _storage(header: Header, parameters: Parameters, notes: list[str], path: object) -> tuple[bool, float]:
    """Whether the numbers are floats, and what integers are to be multiplied with: the header's scale, where the two differ."""
    claims = {"header": header.scale}
    if given := parameters.numbers("POINT", "SCALE"):
        claims["POINT:SCALE"] = given[0]
    text = ", ".join(f"{k} {v:g}" for k, v in claims.items())
    if len({v < 0 for v in claims.values()}) > 1:
        found = f"the scales contradict each other, negative means floats: {text}"
        raise FileFormatError(found, path=path, remedy=_COPY)
    if header.scale < 0:
        return True, 1.0
    usable = [v for v in claims.values() if _FINEST <= v <= _COARSEST]
    if not usable:
        raise FileFormatError(f"no usable scale of the integers: {text}", path=path, remedy=_COPY)
    scale = usable[0]
    if any(abs(v - scale) > 1e-4 * scale for v in claims.values()):
        notes.append(f"the scales of the integers differ ({text}): {scale:g} is taken")
    return False, scale


def _extent(
    data: bytes, header: Header, parameters: Parameters, width: int, notes: list[str], path: object
) -> tuple[int, int, int, int]:
    """Byte of the first frame, frames, points and analog values in a frame; `width` bytes a number."""
    size, (frame_claims, more) = len(data), _frame_claims(header, parameters)
    used = [int(u) % 65536 for u in parameters.numbers("POINT", "USED")[:1] if math.isfinite(u)]
    channels = [int(u) for u in parameters.numbers("ANALOG", "USED")[:1] if math.isfinite(u) and u >= 0]
    begins = [int(u) % 65536 for u in parameters.numbers("POINT", "DATA_START")[:1] if math.isfinite(u) and u != 0]
    claims = {
        "the data's block": {"header": header.start} | dict.fromkeys(["POINT:DATA_START"] * len(begins), sum(begins)),
        "frames": frame_claims,
        "points": {"header": header.points} | dict.fromkeys(["POINT:USED"] * len(used), sum(used)),
        "analog values a frame": {"header": header.analog}
        | dict.fromkeys(["ANALOG:USED"] * len(channels), sum(channels) * header.samples),
    }
    said = "; ".join(f"{what} {' and '.join(f'{v} ({k})' for k, v in c.items())}" for what, c in claims.items())
    first = (header.parameters - 1) * BLOCK + 4  # where the parameters begin: data that lie before them are none
    ways = [sorted(set(c.values())) for c in claims.values()]
    agreed = all(len(w) == 1 for w in ways)
    fitting: list[tuple[int, int, int, int]] = []
    for block, frames, points, analog in product(*ways):
        begin, need = (block - 1) * BLOCK, frames * (4 * points + analog) * width
        rest = size - begin - need
        if points > 0 and frames > 0 and begin >= first and rest >= 0 and (agreed or rest <= BLOCK):
            fitting.append((begin, frames, points, analog))
    if len(fitting) == 1:
        if not agreed:
            begin, frames, points, analog = fitting[0]
            notes.append(f"header and parameters differ ({said}); {frames} frames of {points} points fill the file")
        return _all_frames(data, *fitting[0], width, notes) if more else fitting[0]
    if not any(ways[1]) or not any(ways[2]):
        raise FileFormatError(f"the file holds no points: it claims {said}", path=path, remedy="export markers with it")
    least = min(f * (4 * p + a) * width for _, f, p, a in product(*ways))
    found = f"the file claims {said}: {least if agreed else f'{least} or more'} bytes of {8 * width}-bit numbers; it has {size} bytes"
    if not agreed:
        found += f", and {len(fitting) or 'none'} of the combinations fill{'' if len(fitting) > 1 else 's'} it"
    raise FileFormatError(found, path=path, remedy=_COPY)


def _all_frames(
    data: bytes, begin: int, frames: int, points: int, analog: int, width: int, notes: list[str]
) -> tuple[int, int, int, int]:
    """`_extent` of a file whose counts are all full: its size tells how many frames there are, zeros in the last block not."""
    step = (4 * points + analog) * width
    held = (len(data) - begin) // step
    while held > frames and begin + held * step > len(data) - BLOCK and not any(data[begin + (held - 1) * step :][:step]):
        held -= 1
    notes.append(f"{held} frames by the file's size: its counts end at {_FULL}")
    return begin, held, points, analog


def _frame_claims(header: Header, parameters: Parameters) -> tuple[dict[str, int], bool]:
    """Numbers of frames by who states them, and whether all are full; a full 16-bit count says nothing beside a wider one."""
    claims = {}
    if header.last >= header.first:
        claims["header"] = header.last - header.first + 1 if header.first else header.last + 1
    stated = ("POINT", "FRAMES"), ("POINT", "LONG_FRAMES")
    for group, name in stated:
        value = parameters.numbers(group, name)[:1]
        if value and math.isfinite(value[0]) and value[0] != 0:
            claims[f"{group}:{name}"] = int(value[0] % 65536 if value[0] < 0 else value[0])
    ends = [parameters.numbers("TRIAL", f"ACTUAL_{end}_FIELD")[:2] for end in ("START", "END")]
    if all(len(e) == 2 and all(map(math.isfinite, e)) for e in ends):
        begin, last = (int(e[0]) % 65536 + 65536 * (int(e[1]) % 65536) for e in ends)
        if last >= begin:
            claims["TRIAL"] = last - begin + 1
    full = {k for k, v in claims.items() if v == _FULL} | ({"header"} if header.last == _FULL else set())
    wide = {k: v for k, v in claims.items() if k not in full}
    return wide or claims, bool(claims) and not wide


def _labels(points: int, parameters: Parameters, notes: list[str]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """A label for each point, and which points are markers."""
    labels = parameters.texts("POINT", "LABELS")[:points]
    if len(labels) < points:
        notes.append(f"{points - len(labels)} of {points} points have no label")
    labels += ("",) * (points - len(labels))
    derived = {label for name in _NOT_MARKERS for label in parameters.texts("POINT", name) if label}
    markers = tuple(i for i, label in enumerate(labels) if label not in derived)
    if len(markers) < points:
        notes.append(f"{points - len(markers)} points are angles, forces or the like by the file's own lists: left out")
    return labels, markers


def _unit(parameters: Parameters, notes: list[str], path: object) -> float:
    """Metres in one unit of the file."""
    given = next((t for t in parameters.texts("POINT", "UNITS") if t), "")
    if not given:
        notes.append("no POINT:UNITS: millimetres assumed")
        return UNITS["mm"]
    name = given.strip("[]() .").casefold()
    if name not in UNITS:
        found, known = f"the unit of the points is {given!r}", "mm, cm, dm, m and in"
        raise FileFormatError(found, path=path, remedy=f"POINT:UNITS may be {known}; export the recording again")
    notes.append(f"unit {given}, by POINT:UNITS")
    return UNITS[name]


def _rate(header: Header, parameters: Parameters, notes: list[str], path: object) -> float:
    """Frames a second: what the parameters say, else the header."""
    claims = {"POINT:RATE": parameters.numbers("POINT", "RATE")[:1], "header": [header.rate]}
    usable = {k: v[0] for k, v in claims.items() if v and math.isfinite(v[0]) and 0.01 <= v[0] <= 1e5}
    if not usable:
        found = "no frame rate: " + ", ".join(f"{k} {v[0] if v else 'missing'}" for k, v in claims.items())
        raise FileFormatError(found, path=path, remedy="a rate is 0.01 to 100000 frames a second; export it again")
    source, rate = next(iter(usable.items()))
    if abs(usable.get("header", rate) - rate) > 1e-3 * rate or source == "header":
        others = ", ".join(f"{k} {v[0] if v else 'missing'}" for k, v in claims.items() if k != source)
        notes.append(f"{rate:g} fps by {source} ({others})")
    return rate


def _up(parameters: Parameters, notes: list[str]) -> str:
    """The axis that points up on the screen, "x", "y" or "z"."""
    screen = {n: (parameters.texts("POINT", n) or ("",))[0].strip().casefold() for n in ("X_SCREEN", "Y_SCREEN")}
    right, up = (s.lstrip("+-") for s in screen.values())
    if up in ("x", "y", "z") and up != right:
        notes.append(f"{up} is up, by POINT:Y_SCREEN = {screen['Y_SCREEN'].upper()}")
        return up
    why = "no POINT:Y_SCREEN" if not any(screen.values()) else "POINT:X_SCREEN = {X_SCREEN!r}, Y_SCREEN = {Y_SCREEN!r}".format(**screen)
    notes.append(f"z is up, assumed ({why}): give up= if it is not")
    return "z"
