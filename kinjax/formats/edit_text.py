"""Edit files from constraints: the text that `edits` reads again.

In: constraints, settings. Out: TOML, in metres.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any

import numpy as np

from ..deform.constraints import Goal, Orientation, Through
from ..deform.settings import Settings
from ..errors import OptionError
from .edit_values import KINDS


def write_edit(constraints: Sequence[Goal], settings: Settings | None = None, clip: str | None = None) -> str:
    """Constraints and settings as the text of an edit file, in metres; what has its default value is left out.

    `parse_edit` of it gives the same constraints: numbers to the last digit, angles of offsets to rounding.
    """
    lines = [f"clip = {_quoted(clip)}", ""] if clip is not None else []
    changed = {f.name: getattr(settings or Settings(), f.name) for f in fields(Settings)}
    changed = {k: v for k, v in changed.items() if v != getattr(Settings(), k)}
    if changed:
        lines += ["[settings]", *(f"{k} = {_toml(False if v is None else v)}" for k, v in changed.items()), ""]
    names = {make: kind for kind, (make, _) in KINDS.items()}
    for goal in constraints:
        if type(goal) not in names:
            raise OptionError(f"a {type(goal).__name__} is no constraint")
        lines.append(f"[[{names[type(goal)]}]]")
        shown = [f for f in fields(goal) if f.init and not _is_default(f, getattr(goal, f.name))]
        shown.sort(key=lambda f: (f.name != "joint", f.name != "name"))
        for f in shown:
            key, value = f.name, getattr(goal, f.name)
            if key == "offset" and isinstance(goal, Orientation):
                key, value = "offset_degrees", np.degrees(np.asarray(value, float))
            elif key == "displacement" and _has_keys(value):
                value = [{"frame": int(k), "by": v} for k, v in value]
            lines.append(f"{key} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines).rstrip("\n") + "\n"


def _has_keys(value: Any) -> bool:
    """Whether a displacement is key frames (frame, (3,))."""
    return not isinstance(value, np.ndarray) and not np.isscalar(value[0]) and len(value[0]) == 2


def _is_default(f: Any, value: Any) -> bool:
    if f.default is MISSING:
        return False
    if value is None or f.default is None:
        return value is f.default
    return bool(np.array_equal(np.asarray(value, object), np.asarray(f.default, object)))


def _toml(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, Through):
        value = {f.name: getattr(value, f.name) for f in fields(value) if not _is_default(f, getattr(value, f.name))}
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        if not math.isfinite(value):
            raise OptionError(f"{value} cannot be written: an edit file holds finite numbers")
        return repr(float(value))
    return "[" + ", ".join(_toml(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)) + "]"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
