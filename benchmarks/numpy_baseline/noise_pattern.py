"""Step 4 of the overview: the thresholds (sigma_max, eps_max), learnt from template constraints (section 6).

A template is a tuple (type, begin, end) of frames, both included; its intervals are begin..end-1, those that are not
valid left out. Space uses (sigma_3, eps_3), line and point use (sigma_1, eps_1).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from .projection import FLOOR

TYPES = ("space", "line", "point")
MIN_INTERVALS = 3


class RobustMaximum(NamedTuple):
    """What LMedS says of a set of values: centre, robust standard deviation, mask of those kept, largest kept."""

    centre: float
    scale: float
    kept: np.ndarray
    largest: float


@dataclass(frozen=True)
class TemplatePattern:
    """The noise pattern of one template; `kept` and `kept_eps`, a subset of it, are masks over `intervals`."""

    type: str
    begin: int
    end: int
    sigma_max: float
    eps_max: float
    intervals: np.ndarray
    kept: np.ndarray
    kept_eps: np.ndarray


def lmeds_loop(values):
    """Section 6.1, steps 1 to 4, with every value tried as the centre: N^2 differences, one Python loop per step."""
    values = [float(v) for v in values]
    n = len(values)
    median = n // 2  # 0-based: the (N//2 + 1)-th smallest
    centre, M_min = None, None
    for v_i in values:
        deviations = sorted(abs(v_i - v_j) for v_j in values)
        M_i = deviations[median]  # step 1, on absolute deviations instead of squares
        if M_min is None or M_i < M_min or (M_i == M_min and v_i < centre):
            centre, M_min = v_i, M_i  # step 2
    scale = 1.4826 * (1.0 + 5.0 / (n - 1)) * M_min  # step 3
    scale = max(scale, 4.0 * np.finfo(np.float64).eps * max(abs(v) for v in values))
    kept = np.array([abs(v - centre) <= 2.5 * scale for v in values])  # step 4
    return RobustMaximum(centre, scale, kept, max(v for v, keep in zip(values, kept, strict=True) if keep))


def lmeds_vectorised(values):
    """The same with one N x N table of differences."""
    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    M = np.partition(np.abs(values[:, None] - values[None, :]), n // 2, axis=1)[:, n // 2]
    M_min = M.min()
    centre = values[M_min == M].min()
    scale = 1.4826 * (1.0 + 5.0 / (n - 1)) * M_min
    scale = max(scale, 4.0 * np.finfo(np.float64).eps * np.abs(values).max())
    kept = np.abs(values - centre) <= 2.5 * scale
    return RobustMaximum(float(centre), float(scale), kept, float(values[kept].max()))


def naive(values):
    """The method that section 6 starts from: the maximum of all."""
    values = np.asarray(values, dtype=np.float64)
    return RobustMaximum(np.nan, np.nan, np.ones(len(values), dtype=bool), float(values.max()))


def template_pattern(template, projection, valid, estimator=lmeds_loop):
    """The thresholds that one template asks for. `estimator`: `lmeds_loop`, `lmeds_vectorised` or `naive`."""
    kind, begin, end = template
    if kind not in TYPES:
        raise ValueError(f"template type must be one of {TYPES}, not {kind!r}")
    if not 0 <= begin < end <= len(valid):
        raise ValueError(f"template {template} does not lie in frames 0..{len(valid)}")
    intervals = np.arange(begin, end)
    intervals = intervals[valid[begin:end]]
    if len(intervals) < MIN_INTERVALS:
        raise ValueError(f"template {template} has {len(intervals)} valid intervals; it needs {MIN_INTERVALS}")
    if kind == "space":
        sigma, eps = projection.sigma3[intervals], projection.eps3[intervals]
    else:
        sigma, eps = projection.sigma1[intervals], projection.eps1[intervals]
    by_sigma = estimator(sigma)
    by_eps = estimator(eps[by_sigma.kept])
    kept_eps = by_sigma.kept.copy()
    kept_eps[by_sigma.kept] = by_eps.kept
    sigma_max, eps_max = max(by_sigma.largest, FLOOR), max(by_eps.largest, FLOOR)
    return TemplatePattern(kind, int(begin), int(end), sigma_max, eps_max, intervals, by_sigma.kept, kept_eps)


def control_points(spans, values):
    """Section 6.2: two control points a template, its first and its last frame, in time order.

    Templates that overlap are an error; where one ends on the frame on which the next begins, the larger value stays.
    """
    frames, heights = [], []
    for (begin, end), value in sorted(zip(spans, values, strict=True)):
        if frames and begin < frames[-1]:
            raise ValueError(f"template {begin}..{end} overlaps the one that ends at frame {frames[-1]}")
        if frames and begin == frames[-1]:
            heights[-1] = max(heights[-1], value)
        else:
            frames.append(begin)
            heights.append(value)
        frames.append(end)
        heights.append(value)
    return np.array(frames, dtype=np.float64), np.array(heights, dtype=np.float64)


def threshold_curve(frames, heights, at, interpolation="cubic"):
    """The curve through the control points at the times `at` (in frames): constant outside, clamped at the floor."""
    at = np.asarray(at, dtype=np.float64)
    if interpolation == "cubic":
        curve = CubicSpline(frames, heights, bc_type="natural")
    elif interpolation == "monotone":
        curve = PchipInterpolator(frames, heights)
    else:
        raise ValueError(f"interpolation must be 'cubic' or 'monotone', not {interpolation!r}")
    inside = curve(np.clip(at, frames[0], frames[-1]))
    if len(frames) == 2:  # a single template: its own value, to the bit
        inside = np.full(at.shape, heights[0])
    inside = np.where(at <= frames[0], heights[0], np.where(at >= frames[-1], heights[-1], inside))
    return np.maximum(inside, FLOOR)


def pattern_curves(patterns, n_intervals, interpolation="cubic"):
    """{type: (sigma_max, eps_max)}, one value per interval, taken at the middle of the interval."""
    middle = np.arange(n_intervals) + 0.5
    curves = {}
    for kind in TYPES:
        own = [pattern for pattern in patterns if pattern.type == kind]
        if own:
            spans = [(pattern.begin, pattern.end) for pattern in own]
            sigma = threshold_curve(*control_points(spans, [p.sigma_max for p in own]), middle, interpolation)
            eps = threshold_curve(*control_points(spans, [p.eps_max for p in own]), middle, interpolation)
            curves[kind] = (sigma, eps)
    return curves


def constant_curves(thresholds, n_intervals):
    """Minimal thresholds given by hand, {type: (sigma_max, eps_max)}, as curves (section 8.1: the dice)."""
    curves = {}
    for kind, (sigma_max, eps_max) in thresholds.items():
        if kind not in TYPES:
            raise ValueError(f"threshold type must be one of {TYPES}, not {kind!r}")
        curves[kind] = tuple(np.full(n_intervals, max(float(value), FLOOR)) for value in (sigma_max, eps_max))
    return curves
