"""Annotations as JSON, version "kinjax-annotations/1", and the checks that every format shares.

In: `Annotations`. Out: UTF-8 bytes with one constraint a line, and back. What JSON cannot say is said like this: a number
that is not there (NaN) is `null`, an infinite one is `"inf"` or `"-inf"`. `begin_s` and `end_s` follow from the frames;
they are written for people and checked for nothing. `annotations.schema.json` is the same as a JSON Schema.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import msgspec

from ..annotations import Annotations, Constraint, Constraints, ConstraintType, NoisePattern, Template
from ..errors import FileFormatError, OptionError
from .files import clean_text
from .npz_container import check_schema

SCHEMA = "kinjax-annotations/1"
SCHEMA_FILE = Path(__file__).with_name("annotations.schema.json")
Number = float | None | Literal["inf", "-inf"]


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    pass


class _Constraint(_Strict):
    object: str
    type: ConstraintType
    begin: int
    end: int
    begin_s: Number
    end_s: Number
    position: tuple[Number, Number, Number]
    axis: tuple[Number, Number, Number] | None
    residual: Number
    pattern: int


class _Template(_Strict):
    object: str
    begin: int
    end: int
    type: ConstraintType


class _Pattern(_Strict):
    object: str
    type: ConstraintType
    sigma_max: tuple[Number, ...]
    eps_max: tuple[Number, ...]
    frames: tuple[int, ...]
    alpha_max: Number
    dist_max: Number
    intervals: int
    kept: int
    status: str
    templates: tuple[_Template, ...]
    unit: Literal["per_interval", "per_second", "per_window"]


class _Annotations(_Strict):
    schema: str
    clip: str
    fps: float
    frames: int
    unit: Literal["m"]
    method: str
    constraints: tuple[_Constraint, ...]
    patterns: tuple[_Pattern, ...]
    warnings: tuple[str, ...]


def encode(annotations: Annotations) -> bytes:
    """The bytes of a .json file. `OptionError` for a constraint outside its clip."""
    check(annotations)
    record = to_record(annotations)
    lines = [f"{key}: {value}" for key, value in ((_text(k), _text(record[k])) for k in _Annotations.__struct_fields__[:6])]
    for key in _Annotations.__struct_fields__[6:]:
        items = ",\n    ".join(_text(x) for x in record[key])
        lines.append(f"{_text(key)}: [\n    {items}\n  ]" if items else f"{_text(key)}: []")
    return ("{\n  " + ",\n  ".join(lines) + "\n}\n").encode()


def decode(data: bytes, path: object = None) -> Annotations:
    """The annotations in the bytes of a .json file. `FileFormatError` as `read_annotations` says."""
    try:
        found = msgspec.json.decode(data, type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as e:
        raise FileFormatError(f"this is not JSON: {e}", path=path, remedy="get a complete copy") from e
    return from_record(found, path)


def _text(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def to_record(annotations: Annotations) -> dict[str, Any]:
    """Plain dictionaries, lists, strings and numbers: what JSON holds."""
    a, fps = annotations, float(annotations.fps)
    return {
        "schema": SCHEMA, "clip": clean_text(a.clip), "fps": fps, "frames": int(a.frames), "unit": "m", "method": a.method,
        "constraints": [
            {
                "object": clean_text(c.object), "type": c.type, "begin": int(c.begin), "end": int(c.end),
                "begin_s": int(c.begin) / fps if fps else None, "end_s": int(c.end) / fps if fps else None,
                "position": numbers(c.position), "axis": None if c.axis is None else numbers(c.axis),
                "residual": numbers([c.residual])[0], "pattern": int(c.pattern),
            }
            for c in a.constraints
        ],
        "patterns": [
            {
                "object": clean_text(p.object), "type": p.type, "sigma_max": numbers(p.sigma_max), "eps_max": numbers(p.eps_max),
                "frames": [int(f) for f in p.frames], "alpha_max": numbers([p.alpha_max])[0], "dist_max": numbers([p.dist_max])[0],
                "intervals": int(p.intervals), "kept": int(p.kept), "status": p.status,
                "templates": [
                    {"object": clean_text(t.object), "begin": int(t.begin), "end": int(t.end), "type": t.type} for t in p.templates
                ],
                "unit": p.unit,
            }
            for p in a.patterns
        ],
        "warnings": [clean_text(w) for w in a.warnings],
    }  # fmt: skip


def from_record(found: dict[str, Any], path: object) -> Annotations:
    """The annotations in a record as `to_record` makes it; `FileFormatError` for anything else."""
    check_schema(found.get("schema"), SCHEMA, path)
    try:
        a = msgspec.convert(found, _Annotations)
    except msgspec.ValidationError as e:
        raise FileFormatError(f"these are no annotations: {e}", path=path, remedy="see annotations.schema.json") from e
    constraints = (
        Constraint(c.object, c.type, c.begin, c.end, _three(c.position), _three(c.axis), _float(c.residual), c.pattern, a.fps)
        for c in a.constraints
    )
    patterns = (
        NoisePattern(
            p.object, p.type, tuple(map(_float, p.sigma_max)), tuple(map(_float, p.eps_max)), p.frames, _float(p.alpha_max),
            _float(p.dist_max), p.intervals, p.kept, p.status,
            tuple(Template(t.object, t.begin, t.end, t.type) for t in p.templates), p.unit,
        )
        for p in a.patterns
    )  # fmt: skip
    out = Annotations(a.clip, a.fps, a.frames, Constraints(tuple(constraints)), tuple(patterns), a.warnings, a.unit, a.method)
    try:
        check(out)
    except OptionError as e:
        raise FileFormatError(str(e), path=path, remedy="correct the file, or write it again") from e
    return out


def check(annotations: Annotations) -> None:
    """`OptionError` unless the clip has a rate and a length, the unit is metres, and each constraint lies inside."""
    a = annotations
    if not (math.isfinite(a.fps) and a.fps >= 0) or a.frames < 0 or a.unit != "m":
        found = f"{a.frames} frames at {a.fps} a second, in {a.unit!r}"
        raise OptionError(f"{a.clip or 'annotations'}: {found}; the unit is 'm', the rate finite and not negative")
    for c in a.constraints:
        if not 0 <= c.begin <= c.end < a.frames:
            where = f"the {c.type} constraint of {c.object!r}, frames {c.begin}..{c.end}"
            raise OptionError(f"{a.clip or 'annotations'}: {where}, is not inside the clip's 0..{a.frames - 1}")


def numbers(values: Any) -> list[Number]:
    """Numbers as JSON can hold them: NaN is None, infinities are words."""
    return [None if math.isnan(x) else (x if math.isfinite(x) else "inf" if x > 0 else "-inf") for x in map(float, values)]


def _float(x: Number) -> float:
    return math.nan if x is None else float(x)


def _three(values: Any) -> Any:
    return None if values is None else tuple(_float(x) for x in values)
