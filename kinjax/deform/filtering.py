"""Low-pass filtering of what a deformation added, so that neighbouring frames stay alike (2004 paper, section 5.2).

In: the displacement map of the root's translation, or of joint rotations. Out: the same, smoothed by a symmetric FIR filter
(no delay); beyond the clip's ends it goes on as its own mirror image through the end point. Frames that are lost are bridged
first: a filter would spread them. Host NumPy.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
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
    """Filtered along the first axis. Beyond its ends the path goes on as it went, turned half round about its end point: a path
    that moves there stays where it is, and does not slow down towards its end."""
    if len(fir) == 1:
        return path
    half = len(fir) // 2
    longer = np.pad(path, [(half, half)] + [(0, 0)] * (path.ndim - 1), mode="reflect", reflect_type="odd")
    return correlate1d(longer, fir, axis=0)[half:-half]


def bridged(path: Float[np.ndarray, "f ..."], lost: Bool[np.ndarray, " f"]) -> Float[np.ndarray, "f ..."]:
    """`path` with its `lost` frames on straight lines between the others, constant beyond these; as it is if all are lost."""
    if lost.all() or not lost.any():
        return path
    t, known = np.arange(len(path)), np.flatnonzero(~lost)
    after = np.clip(np.searchsorted(known, t), 0, len(known) - 1)
    before = np.maximum(after - (known[after] > t), 0)
    a, b = known[before], known[after]
    s = np.clip((t - a) / np.maximum(b - a, 1), 0, 1).reshape(-1, *[1] * (path.ndim - 1))
    return np.where(lost.reshape(s.shape), (1 - s) * path[a] + s * path[b], path)


def roughness(path: Float[np.ndarray, "f ..."], fir: Float[np.ndarray, " k"]) -> float:
    """The largest distance between a path and its filtered self; 0 of one that is not finite."""
    return float(np.nan_to_num(np.abs(path - low_pass(path, fir))).max(initial=0.0))
