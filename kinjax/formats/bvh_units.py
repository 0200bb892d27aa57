"""The unit of a BVH file: given, or inferred from the height of the skeleton at rest.

In: rest positions in file units. Out: metres in one file unit, and the words that say what was assumed. The words also
carry the scale to the writer (`Motion` has no field for it), so they are made and taken apart here and nowhere else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from ..errors import OptionError
from ..skeleton import Skeleton

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
_LOWEST, _HIGHEST, _TYPICAL = 0.5, 3.0, 1.7  # metres
# How much likelier a unit must be by height alone (logarithm of the ratio to 1.7 m) to stand against centimetres:
# 70 units are read as inches (1.8 m), 90 as centimetres, 30 as inches times 0.45, in which much of CMU's data comes.
_RARITY = {"m": 0.0, "cm": 0.0, "mm": 0.0, "inch": 0.4, "cmu": 0.4}
_NOTE = re.compile(r"1 file unit = (\S+) m \(")


def scale_of(unit: str | float) -> tuple[float, str]:
    """Metres in one unit, and its name. `OptionError` for an unknown name, or a scale that is not positive."""
    if isinstance(unit, str):
        if (name := unit.strip().lower()) in UNITS:
            return UNITS[name], name
        raise OptionError(f"no unit {unit!r}: choose from {', '.join(UNITS)}, or give the metres in one unit")
    scale = float(unit)
    if not (math.isfinite(scale) and scale > 0):
        raise OptionError(f"a unit of {unit} m: it must be a positive number")
    return scale, next((n for n, s in UNITS.items() if s == scale), "given")


def rest_extent(offsets: np.ndarray, parents: Sequence[int], ends: np.ndarray, end_parents: Sequence[int]) -> float:
    """Longest side of the box around the skeleton at rest, roots at the origin, in the unit of the offsets.

    The longest side, not the side along `up`: files disagree on their axes, and a T pose is as wide as it is tall.
    """
    at = np.zeros((len(offsets) + len(ends), 3))
    for i, p in enumerate(parents):
        if p >= 0:
            at[i] = at[p] + offsets[i]
    for i, p in enumerate(end_parents):
        at[len(offsets) + i] = at[p] + ends[i]
    return float(np.ptp(at, axis=0).max())


def infer_unit(extent: float) -> tuple[float, str]:
    """Metres in one file unit for a skeleton `extent` units tall, and a note that says what was assumed and why."""
    fits = {n: s for n, s in UNITS.items() if _LOWEST <= s * extent <= _HIGHEST}
    if not fits:
        size = "has no size at rest" if extent == 0 else f"is {extent:g} units tall at rest, in no known unit 0.5 to 3 m"
        return UNITS["cm"], unit_note(UNITS["cm"], "cm", f"assumed, for the skeleton {size}: give unit= if it is wrong")
    name = min(fits, key=lambda n: abs(math.log(fits[n] * extent / _TYPICAL)) + _RARITY[n])
    return fits[name], unit_note(fits[name], name, f"inferred: the skeleton is then {fits[name] * extent:.2f} m tall at rest")


def unit_note(scale: float, name: str, why: str) -> str:
    """The note on a unit, from which `scale_in_notes` takes the scale."""
    return f"1 file unit = {scale!r} m ({name}, {why})"


def scale_in_notes(notes: Sequence[str]) -> float:
    """Metres in one unit of the file that a motion was read from; a centimetre when it came from nowhere."""
    for note in notes:
        if match := _NOTE.match(note):
            return float(match.group(1))
    return UNITS["cm"]


def additive_notes(skeleton: Skeleton, translations: np.ndarray) -> list[str]:
    """Notes on joints whose position channels stay near zero although their OFFSET does not: some writers add the two."""
    out = []
    for n, j in enumerate(skeleton.topology.translated):
        offset, moved = np.asarray(skeleton.offsets[j]), translations[:, n]
        size = np.linalg.norm(offset)
        if size > 1e-3 and np.linalg.norm(moved, axis=-1).max() < 0.5 * size:
            out.append(
                f"{skeleton.names[j]}: its position channels replace its OFFSET of {size:.2f} m, but stay near 0; "
                "if the file means them to be added, move the motion by that offset"
            )
    return out
