"""Every number of detection that a person may change, in one place, in seconds, metres and radians.

In: keyword arguments. Out: a hashable `Settings`, static under `jit`. Defaults of the robust method were measured against
force plates; `docs/robust-method.md` tells how, `docs/paper-method.md` states the paper's.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

from ..annotations import ConstraintType, check_type
from ..errors import OptionError

Method = Literal["robust", "paper", "window"]
Projection = Literal["closed", "svd"]
Formulation = Literal["local", "global"]
Estimator = Literal["lmeds", "naive"]
Interpolation = Literal["cubic", "monotone"]
_CHOICES = {
    "method": get_args(Method),
    "projection": get_args(Projection),
    "formulation": get_args(Formulation),
    "estimator": get_args(Estimator),
    "interpolation": get_args(Interpolation),
}


@dataclass(frozen=True)
class Settings:
    """Settings of detection; one object serves all methods, each reads what it needs.

    types: constraint types to look for.
    method: "robust" (default), "paper" (exact to the 2006 text), "window" (space at interval level too).
    projection: "closed" form, or "svd" as the paper has it (paper section 5; needed where poses scale or shear).
    formulation: "local" or "global" displacements (paper section 4 and appendix A). estimator, interpolation: section 6.
    stride: frames that one displacement of the paper's method spans. rate: resample the clip to so many frames a second.
    thresholds: (sigma_max rad, eps_max m) of one interval, in place of templates (`method="paper"`).
    axis_min: no axis is read from a smaller rotation, rad. alpha_max, dist_max: lines are parallel, lines or points meet
    (paper section 7). max_gap, max_jump: `Fmax` in seconds and `d_max` in metres of the frame tolerance (appendix B).
    max_missing: missing frames count as no gap up to so many seconds. min_duration: shorter constraints are left out.
    still, cap: (m/s, rad/s) that a stationary body keeps below whatever its template says, and that no template exceeds.
    margin: factor on what the template shows. smooth, span: half width of the mean pose and length of a displacement, s.
    hampel, spike: half width of the running median in seconds, and the least outlier that it removes in metres.
    free_pivots: keep line and point constraints that touch no space constraint (hinges, doors, dice).
    pivot_window, pivot_reach: (shortest, longest) window in seconds, and the greatest distance of a pivot from the object.
    pivot_noise: metres that a pivot of a real body wanders, besides the noise of the data.
    """

    types: tuple[ConstraintType, ...] = ("space",)
    method: Method = "robust"
    projection: Projection = "closed"
    formulation: Formulation = "local"
    estimator: Estimator = "lmeds"
    interpolation: Interpolation = "cubic"
    stride: int = 1
    rate: float | None = None
    thresholds: tuple[float, float] | None = None
    axis_min: float = 1e-3
    alpha_max: float = 0.08726646259971647  # 5 degrees
    dist_max: float = 0.01
    max_gap: float = 0.1
    max_jump: float = 0.05
    max_missing: float = 0.3
    min_duration: float = 0.08
    still: tuple[float, float] = (0.15, 1.5)
    cap: tuple[float, float] = (0.3, 3.0)
    margin: float = 1.25
    smooth: float = 0.02
    span: float = 0.04
    hampel: float = 0.03
    spike: float = 0.006
    free_pivots: bool = False
    pivot_window: tuple[float, float] = (0.06, 0.4)
    pivot_reach: float = 0.2
    pivot_noise: float = 0.002

    def __post_init__(self) -> None:
        object.__setattr__(self, "types", tuple(dict.fromkeys(check_type(t) for t in self.types)))
        if not self.types:
            raise OptionError("no constraint type asked for: give at least one of space, line, point")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise OptionError(f"{name}={getattr(self, name)!r}: choose from {', '.join(choices)}")
        if self.stride < 1:
            raise OptionError(f"stride={self.stride}: it must be at least one frame")
        if self.rate is not None and not self.rate > 0:
            raise OptionError(f"rate={self.rate}: it must be a positive number of frames a second")
        if self.thresholds is not None and self.method != "paper":
            raise OptionError(
                'thresholds are those of one interval: they go with method="paper"; the robust method has still=(m/s, rad/s)'
            )

    def but(self, **changes: Any) -> Settings:
        """These settings with some changed; an unknown name is an `OptionError` that lists the nearest."""
        known = [f.name for f in fields(self)]
        for name in changes:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3)
                raise OptionError(f"no setting named {name!r} (nearest: {', '.join(near) or ', '.join(known)})")
        return replace(self, **changes)
