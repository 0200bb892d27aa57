"""Step 2 of the overview: the motion of one object as displacements from frame to frame (section 4, eq. 1 and 9 to 14).

`R` is (F, 3, 3) and `t` is (F, 3); they map the object's local coordinates to the world: x_i = R_i p + t_i (eq. 1).
Interval `i` lies between frames `i` and `i+1`; with a stride `s` its displacement is taken from frame `i` to `i+s`, and
the last `s-1` intervals have none. Intervals without a displacement are not valid and hold NaN.
"""

from typing import NamedTuple

import numpy as np


class Displacements(NamedTuple):
    """Rotations (F-1, 3, 3), translations (F-1, 3) and the mask of the valid intervals (F-1,)."""

    R: np.ndarray
    t: np.ndarray
    valid: np.ndarray


def valid_frames(R, t, valid=None):
    """The frames that can be used: those marked (all, if `valid` is None) whose numbers are all finite."""
    finite = np.isfinite(R).all(axis=(1, 2)) & np.isfinite(t).all(axis=1)
    return finite if valid is None else finite & np.asarray(valid, dtype=bool)


def displacements_loop(R, t, *, formulation="local", stride=1, valid=None):
    """One displacement after the other, as the paper writes them."""
    R, t = _checked(R, t, formulation, stride)
    frame_ok = valid_frames(R, t, valid)
    frames = len(R)
    R_D = np.full((max(frames - 1, 0), 3, 3), np.nan)
    t_D = np.full((max(frames - 1, 0), 3), np.nan)
    ok = np.zeros(max(frames - 1, 0), dtype=bool)
    for i in range(frames - stride):
        j = i + stride
        if not (frame_ok[i] and frame_ok[i + 1] and frame_ok[j]):
            continue
        if formulation == "local":
            R_D[i] = R[i].T @ R[j]  # eq. 14
            t_D[i] = R[i].T @ (t[j] - t[i])
        else:
            R_D[i] = R[j] @ R[i].T  # eq. 11
            t_D[i] = t[j] - R_D[i] @ t[i]
        ok[i] = True
    return Displacements(R_D, t_D, ok)


def displacements_vectorised(R, t, *, formulation="local", stride=1, valid=None):
    """The same for all intervals at once."""
    R, t = _checked(R, t, formulation, stride)
    frame_ok = valid_frames(R, t, valid)
    frames = len(R)
    n = max(frames - stride, 0)
    R = np.where(frame_ok[:, None, None], R, np.eye(3))
    t = np.where(frame_ok[:, None], t, 0.0)
    R_i, t_i, R_j, t_j = R[:n], t[:n], R[stride:], t[stride:]
    R_i_inv = R_i.transpose(0, 2, 1)
    if formulation == "local":
        rotation = R_i_inv @ R_j  # eq. 14
        translation = (R_i_inv @ (t_j - t_i)[:, :, None])[:, :, 0]
    else:
        rotation = R_j @ R_i_inv  # eq. 11
        translation = t_j - (rotation @ t_i[:, :, None])[:, :, 0]
    ok = frame_ok[:n] & frame_ok[1 : n + 1] & frame_ok[stride:]

    R_D = np.full((max(frames - 1, 0), 3, 3), np.nan)
    t_D = np.full((max(frames - 1, 0), 3), np.nan)
    all_ok = np.zeros(max(frames - 1, 0), dtype=bool)
    R_D[:n][ok] = rotation[ok]
    t_D[:n][ok] = translation[ok]
    all_ok[:n] = ok
    return Displacements(R_D, t_D, all_ok)


def _checked(R, t, formulation, stride):
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (len(R), 3):
        raise ValueError(f"R must be (F, 3, 3) and t (F, 3), not {R.shape} and {t.shape}")
    if formulation not in ("local", "global"):
        raise ValueError(f"formulation must be 'local' or 'global', not {formulation!r}")
    if stride < 1:
        raise ValueError(f"stride must be at least 1, not {stride}")
    return R, t
