"""The rules of thumb by which feet are called planted elsewhere, to compare with on one's own data.

In: the path of one marker or joint, (frames, 3) metres, and its rate, frames a second. Out: masks (frames,) of booleans, and from
those spans. A frame's speed is that to the next frame (the last one's: from the one before); a frame without such a speed, because
either is NaN, is not planted. What the rules cannot see: which way the object turns, and how noisy its data are.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..errors import OptionError, ShapeError
from .spans import runs

Rule = Callable[[np.ndarray, float], np.ndarray]
"""Path (frames, 3), rate -> mask (frames,)."""


def toe_displacement(path: np.ndarray, rate: float, limit: float = 2e-6, made_for: float | None = None) -> np.ndarray:
    """Planted where the squared displacement to the next frame is under `limit`, square metres: 0.02 square centimetres.

    In the tradition of the contact labels of motion networks (Holden, Saito and Komura, 2016, and many after them), which hold a
    squared displacement a frame against a small number of the skeleton's own units, at the rate of their data (HumanML3D, 2022:
    0.002 in square metres at 20 frames a second), some with a height beside it. As the limit is one a frame, what it means in
    metres a second grows with the rate: 0.0014 times it. made_for: the rate that the limit was made for; displacements are
    scaled to that one.
    """
    step = _speed(path, rate) / (rate if made_for is None else _positive("made_for", made_for))
    with np.errstate(invalid="ignore"):
        return step**2 < limit


def toe_speed(path: np.ndarray, rate: float, limit: float = 0.15, window: float = 0.1) -> np.ndarray:
    """Planted where the speed is under `limit`, m/s, after a median filter over `window` seconds: a vote of the frames around.

    Of the code beside Learned Motion Matching (Holden et al., 2020): 0.15 m/s of the toe, and six frames at sixty a second. A tie
    counts as planted; before the first and after the last frame those two vote on. A frame whose speed is not known votes
    against, but may be outvoted.
    """
    with np.errstate(invalid="ignore"):
        slow = _speed(path, rate) < limit
    width = max(1, math.floor(_positive("window", window) * rate + 0.5))
    padded = np.pad(slow.astype(int), (width // 2, width - width // 2 - 1), "edge") if len(slow) else slow.astype(int)
    votes = np.convolve(padded, np.ones(width, int), "valid") if len(slow) else padded
    return 2 * votes >= width


def speed_and_height(
    path: np.ndarray, rate: float, speed: float = 0.15, height: float = 0.04, up: str = "z", ground: float | None = None
) -> np.ndarray:
    """Planted where the speed is under `speed`, m/s, and the place less than `height` metres over the ground.

    Of the preparation of AMASS for HuMoR (Rempe et al., 2021): 5 mm a frame at 30 frames a second; 4 cm for toes, 8 cm for ankles.
    up: the world's up axis. ground: its coordinate there; None takes the 5th percentile of the path (HuMoR groups the heights of
    slow toes instead), so that a joint's height over its own lowest places counts.
    """
    if up not in ("x", "y", "z"):
        raise OptionError(f"up is {up!r}: x, y or z")
    still = _speed(path, rate) < _positive("speed", speed)
    level = np.asarray(path, float)[:, "xyz".index(up)]
    seen = level[np.isfinite(level)]
    if ground is None and not len(seen):
        return np.zeros(len(level), bool)
    floor = float(np.quantile(seen, 0.05)) if ground is None else ground
    return still & (level - floor < height)


RULES: dict[str, Rule] = {"toe displacement": toe_displacement, "toe speed": toe_speed, "speed and height": speed_and_height}
"""The rules by name, with their own numbers."""


def intervals(mask: np.ndarray, rate: float, min_duration: float = 0.0, fill: float = 0.0) -> np.ndarray:
    """The spans (n, 2) of a mask (frames,): first and last frame, both included.

    fill: gaps of at most so many seconds between two of them are filled first. min_duration: spans shorter than this, in seconds
    (frames over rate), are left out then.
    """
    _positive("rate", rate)
    for name, value in (("min_duration", min_duration), ("fill", fill)):
        if not (math.isfinite(value) and value >= 0):
            raise OptionError(f"{name} is {value}: a number of seconds, not negative")
    spans = runs(mask)
    if fill and len(spans):
        gap = spans[1:, 0] - spans[:-1, 1] - 1
        apart = np.concatenate([[True], gap > fill * rate + 1e-9])
        spans = np.stack([spans[apart, 0], spans[np.concatenate([apart[1:], [True]]), 1]], 1)
    return spans[(spans[:, 1] - spans[:, 0] + 1) >= min_duration * rate - 1e-9]


def _speed(path: np.ndarray, rate: float) -> np.ndarray:
    """Speed to the next frame (frames,), m/s."""
    path = np.asarray(path, float)
    if path.ndim != 2 or path.shape[1] != 3:
        raise ShapeError(f"a path is (frames, 3), not {path.shape}")
    _positive("rate", rate)
    if len(path) < 2:
        return np.full(len(path), np.nan)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * rate
    return np.concatenate([speed, speed[-1:]])


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0):
        raise OptionError(f"{name} is {value}: it must be a positive number")
    return float(value)
