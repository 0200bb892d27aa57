"""The whole detection for one object: poses in, labels, noise patterns and constraints out (section 3.2, steps 2 to 6).

Metres, radians, seconds; frames are 0-based. `vectorised=False` goes through the frames one by one, as one would write
the paper down; `vectorised=True` is the same in whole-array NumPy, except for the merging, which is a loop by nature.
"""

import math
from dataclasses import dataclass

import numpy as np

from .displacements import displacements_loop, displacements_vectorised, valid_frames
from .instantaneous import curves_of_types, instantaneous_constraints, label_loop, label_vectorised
from .merging import Constraint, absorbed_intervals, finish, in_frames, merge
from .noise_pattern import (
    TYPES,
    TemplatePattern,
    constant_curves,
    lmeds_loop,
    lmeds_vectorised,
    naive,
    pattern_curves,
    template_pattern,
)
from .projection import project_loop, project_vectorised

ALPHA_MAX = math.radians(5.0)


@dataclass(frozen=True)
class Detection:
    """The result. Arrays have one value per interval, NaN where it is not valid.

    `label`: 0 none, 1 space, 2 line, before absorption; `absorbed`: the space intervals taken into a rotation.
    `sigma_max`, `eps_max`: {type: thresholds} of the types that were asked for. `patterns`: one per template.
    """

    valid: np.ndarray
    sigma3: np.ndarray
    eps3: np.ndarray
    sigma1: np.ndarray
    eps1: np.ndarray
    label: np.ndarray
    absorbed: np.ndarray
    sigma_max: dict[str, np.ndarray]
    eps_max: dict[str, np.ndarray]
    patterns: list[TemplatePattern]
    constraints: list[Constraint]


def detect(
    R,
    t,
    *,
    rate,
    types,
    templates=(),
    thresholds=None,
    estimator="lmeds",
    interpolation="cubic",
    valid=None,
    formulation="local",
    stride=1,
    axis_min=1e-3,
    alpha_max=ALPHA_MAX,
    dist_max=0.01,
    f_max_s=0.1,
    d_max=0.05,
    min_duration=0.08,
    max_missing_s=0.3,
    vectorised=False,
):
    """Find the constraints of one object with rotations `R` (F, 3, 3) and positions `t` (F, 3) at `rate` frames/s.

    `types`: those of 'space', 'line', 'point' that are wanted. Each needs templates, tuples (type, begin frame, end
    frame), or minimal `thresholds`, {type: (sigma_max, eps_max)}, which take the place of the templates of that type.
    """
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    types = (types,) if isinstance(types, str) else tuple(types)
    for kind in types:
        if kind not in TYPES:
            raise ValueError(f"types must be among {TYPES}, not {kind!r}")
    if estimator not in ("lmeds", "naive"):
        raise ValueError(f"estimator must be 'lmeds' or 'naive', not {estimator!r}")
    displace, project, label, lmeds = (
        (displacements_vectorised, project_vectorised, label_vectorised, lmeds_vectorised)
        if vectorised
        else (displacements_loop, project_loop, label_loop, lmeds_loop)
    )

    D = displace(R, t, formulation=formulation, stride=stride, valid=valid)
    projection = project(D.R, D.t, D.valid)

    method = lmeds if estimator == "lmeds" else naive
    patterns = [template_pattern(template, projection, D.valid, method) for template in templates]
    curves = pattern_curves(patterns, len(D.valid), interpolation)
    curves.update(constant_curves(thresholds or {}, len(D.valid)))
    curves = curves_of_types(curves, types)

    labels = label(projection, D.valid, curves, axis_min)
    found = instantaneous_constraints(R, t, projection, labels, formulation)

    min_intervals = max(1, in_frames(min_duration, rate))
    absorbed = absorbed_intervals(labels, min_intervals)
    merged = merge(
        found,
        labels,
        D.valid,
        absorbed,
        alpha_max=alpha_max,
        dist_max=dist_max,
        f_max=max(1, in_frames(f_max_s, rate)),
        d_max=d_max,
        max_missing=in_frames(max_missing_s, rate),
    )
    frame_ok = valid_frames(R, t, valid)
    constraints = finish(merged, R, t, frame_ok, types=types, alpha_max=alpha_max, min_intervals=min_intervals)
    return Detection(
        valid=D.valid,
        sigma3=projection.sigma3,
        eps3=projection.eps3,
        sigma1=projection.sigma1,
        eps1=projection.eps1,
        label=labels,
        absorbed=absorbed,
        sigma_max={kind: curve[0] for kind, curve in curves.items()},
        eps_max={kind: curve[1] for kind, curve in curves.items()},
        patterns=patterns,
        constraints=constraints,
    )
