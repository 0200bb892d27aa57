"""Balance: where the centre of mass belongs, from where it was over the support in the input motion (section 4.3).

In: the input's centre of mass `P` and points `A` that support it (toes and heels of a walk). Out: the offset `P' - mean A'`
that the output is to have in each frame, from `N1 (P' - mean A') = N2 (P - mean A)` with lengths measured in legs,
`N(x) = x / leg length`: of the output for N1, of the input for N2. A displacement map d(t) may be added, to lean into the
wind. The output's own `A'` comes in when it is known. Host NumPy, float64, metres, seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from ..anthropometry import leg_length
from ..errors import OptionError, ShapeError
from ..skeleton import Skeleton

Vector = Sequence[float] | np.ndarray
Displacement = Vector | Sequence[tuple[float, Vector]] | Float[np.ndarray, "frames 3"]
Interpolation = Literal["monotone", "cubic"]


def balance_offsets(
    center: Float[np.ndarray, "frames 3"],
    support: Float[np.ndarray, "frames *points 3"],
    input_leg: float | Skeleton,
    output_leg: float | Skeleton,
    displacement: Displacement | None = None,
    rate: float | None = None,
    interpolation: Interpolation = "monotone",
) -> Float[np.ndarray, "frames 3"]:
    """The wanted `P' - mean A'` of each frame, (F, 3) metres.

    center: (F, 3) centre of mass of the input, world metres. support: its supporting points (F, A, 3), or their barycentre
    (F, 3). input_leg, output_leg: leg length in metres of who moved and of who is to move, or the skeleton to measure
    it on. displacement, rate, interpolation: see `displacement_path`; added as it is, in metres of the output.
    """
    center, base = _path(center, "center"), barycentre(support)
    if len(base) != len(center):
        raise ShapeError(f"support has {len(base)} frames, center has {len(center)}")
    offsets = _leg(output_leg, "output") / _leg(input_leg, "input") * (center - base)
    if displacement is None:
        return offsets
    return offsets + displacement_path(displacement, len(center), rate, interpolation)


def barycentre(support: Float[np.ndarray, "frames *points 3"]) -> Float[np.ndarray, "frames 3"]:
    """Mean of the supporting points (F, A, 3) in each frame; (F, 3) is one already."""
    points = np.asarray(support, float)
    if points.ndim not in (2, 3) or points.shape[-1] != 3 or 0 in points.shape[1:]:
        raise ShapeError(f"support has shape {points.shape}: (frames, points, 3) or (frames, 3) is needed")
    return points if points.ndim == 2 else points.mean(1)


def displacement_path(
    displacement: Displacement, frames: int, rate: float | None = None, interpolation: Interpolation = "monotone"
) -> Float[np.ndarray, "frames 3"]:
    """A displacement map d(t) at every frame, (F, 3) metres.

    displacement: (3,) for all frames; or (F, 3); or key frames, a sequence of (time in seconds, (3,)), for which `rate`
    (frames a second) is needed. Key frames in any order; constant before the first and after the last; between them
    "monotone" (PCHIP, never beyond two neighbours) or "cubic" (natural: smoother, overshoots).
    """
    keys = _keys(displacement)
    if keys is None:
        try:
            whole = np.asarray(displacement, float)
        except ValueError as e:
            raise ShapeError("displacement is neither (3,), (frames, 3) nor a sequence of (seconds, (3,))") from e
        if whole.shape not in ((3,), (frames, 3)):
            raise ShapeError(
                f"displacement has shape {whole.shape}: (3,), ({frames}, 3) or a sequence of (seconds, (3,)) is needed"
            )
        if not np.isfinite(whole).all():
            raise OptionError("the displacement has numbers that are not finite")
        return np.broadcast_to(whole, (frames, 3)).copy()
    return _between(*keys, frames, rate, interpolation)


def _keys(displacement: Displacement) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (K,) and vectors (K, 3) of key frames, in order of time; None if these are no key frames."""
    rows: list[Any] = [] if isinstance(displacement, np.ndarray) else list(displacement)
    if not rows or not all(isinstance(r, Sequence) and len(r) == 2 and np.shape(r[1]) == (3,) for r in rows):
        return None
    times, vectors = np.array([float(r[0]) for r in rows]), np.array([np.asarray(r[1], float) for r in rows])
    if not (np.isfinite(times).all() and np.isfinite(vectors).all()):
        raise OptionError("a key frame of the displacement is not finite")
    order = np.argsort(times, kind="stable")
    times, vectors = times[order], vectors[order]
    if (same := np.flatnonzero(np.diff(times) <= 0)).size:
        raise OptionError(f"two key frames of the displacement are at {times[same[0]]:g} s")
    return times, vectors


def _between(
    times: np.ndarray, vectors: np.ndarray, frames: int, rate: float | None, interpolation: Interpolation
) -> np.ndarray:
    from scipy.interpolate import CubicSpline, PchipInterpolator

    if rate is None or not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: key frames of a displacement need the clip's frames a second")
    if interpolation not in get_args(Interpolation):
        raise OptionError(f"interpolation={interpolation!r}: choose {' or '.join(get_args(Interpolation))}")
    if len(times) == 1:
        return np.repeat(vectors, frames, 0)
    at = np.clip(np.arange(frames) / rate, times[0], times[-1])
    if interpolation == "monotone":
        return PchipInterpolator(times, vectors)(at)
    return CubicSpline(times, vectors, bc_type="natural")(at)


def _path(x: Float[np.ndarray, "frames 3"], what: str) -> np.ndarray:
    path = np.asarray(x, float)
    if path.ndim != 2 or path.shape[1] != 3:
        raise ShapeError(f"{what} has shape {path.shape}: (frames, 3) is needed")
    return path


def _leg(leg: float | Skeleton, what: str) -> float:
    length = leg_length(leg) if isinstance(leg, Skeleton) else float(leg)
    if not (np.isfinite(length) and length > 0):
        raise OptionError(f"the {what}'s leg length is {length} m: it must be positive")
    return length
