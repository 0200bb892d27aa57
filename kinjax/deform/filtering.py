"""Low-pass filtering of what a deformation added, so that neighbouring frames stay alike (2004 paper, section 5.2).

In: the displacement map of the root's translation, or of joint rotations. Out: the same, smoothed by a symmetric FIR filter
(no delay), constant beyond the clip's ends. Host NumPy.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import correlate1d
from scipy.signal import firwin


def taps(cutoff: float, width: float, rate: float) -> Float[np.ndarray, " k"]:
    """Odd, symmetric low-pass filter (Hamming window, unit gain at rest) of `width` seconds to either side.

    cutoff: Hz. A cutoff at or above half the rate, or a width under one frame, gives the filter that changes nothing.
    """
    half = round(width * rate)
    if half < 1 or cutoff >= rate / 2:
        return np.ones(1)
    return firwin(2 * half + 1, cutoff, fs=rate)


def low_pass(path: Float[np.ndarray, "f ..."], fir: Float[np.ndarray, " k"]) -> Float[np.ndarray, "f ..."]:
    """Filtered along the first axis; beyond the ends the path is taken to stay where it was."""
    if len(fir) == 1:
        return path
    return correlate1d(path, fir, axis=0, mode="nearest")


def roughness(path: Float[np.ndarray, "f ..."], fir: Float[np.ndarray, " k"]) -> float:
    """The largest distance between a path and its filtered self, ignoring frames that are not finite."""
    if not path.size:
        return 0.0
    off = np.abs(path - low_pass(path, fir))
    return float(np.nanmax(off)) if np.isfinite(off).any() else 0.0
