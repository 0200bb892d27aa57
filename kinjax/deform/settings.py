"""What a deformation can be told: one place for every number and choice that is not a constraint.

In: keywords. Out: `Settings`, checked. Metres, seconds, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ..errors import OptionError


@dataclass(frozen=True)
class Settings:
    """Settings of `deform`; the defaults suit every human-sized figure.

    iterations: solver iterations a frame at most; a frame stops earlier when a step moves nothing by more than `tolerance`
    radians or metres. strategy: "priority" keeps the layers strict; "weights" puts all constraints into one layer, for
    comparison (2004 paper, figures 4 and 5). attract: recruited joints are drawn to the input where no constraint needs
    them (the paper's optimization vector z); attract_root: so is the root's translation, which the paper leaves out.

    clamp: metres that a constraint asks for in one iteration at most. budget: length of one step (radians and metres
    together), spent in order of priority. damping: lambda of a layer whose error is `damped_error` metres or more; it falls
    with the error. drag, singular: the lowest layer is held back along directions in which it is nearly singular (singular
    values below the share `singular` of its rows' root mean square length): a limb that straightens does not snap; drag
    0 for none. slack, slack_ratio: how much a layer may lose to a lower one in one iteration, or to the attraction, metres
    and share.

    filter_root, filter_joints: cutoff in Hz of the low-pass filter of the displacement map's root translation and joint
    rotations, None for no filter. A map that is smooth to within `rough` metres (or radians) is left alone.
    filter_width: half width of the filter in seconds. passes: solve and filter so often at most.

    held: metres within which a constraint is said to hold (`RADIAN` metres count for a radian). precision: "float64" or
    "float32" for the solve, whatever JAX's own setting.
    """

    iterations: int = 10
    tolerance: float = 1e-5
    strategy: Literal["priority", "weights"] = "priority"
    attract: bool = True
    attract_root: bool = True
    clamp: float = 0.1
    budget: float = 1.0
    damping: float = 0.3
    damped_error: float = 0.05
    drag: float = 0.2
    singular: float = 0.12
    slack: float = 1e-7
    slack_ratio: float = 1e-4
    filter_root: float | None = 4.0
    filter_joints: float | None = None
    filter_width: float = 0.25
    rough: float = 2e-3
    passes: int = 3
    held: float = 1e-4
    precision: Literal["float64", "float32"] = "float64"

    def __post_init__(self) -> None:
        _choice("strategy", self.strategy, ("priority", "weights"))
        _choice("precision", self.precision, ("float64", "float32"))
        for name in ("iterations", "passes"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise OptionError(f"{name}={value!r}: a whole number from 1 is needed")
        for name in ("clamp", "budget", "damped_error", "singular", "filter_width", "rough", "held"):
            _positive(name, getattr(self, name))
        for name in ("tolerance", "damping", "slack", "slack_ratio", "drag"):
            _positive(name, getattr(self, name), zero=True)
        for name in ("filter_root", "filter_joints"):
            if getattr(self, name) is not None:
                _positive(name, getattr(self, name))


def _choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise OptionError(f"{name}={value!r}: choose from {', '.join(choices)}")


def _positive(name: str, value: object, zero: bool = False) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < 0 or (value == 0 and not zero):  # type: ignore[arg-type, operator]
        raise OptionError(f"{name}={value!r}: a {'non-negative' if zero else 'positive'} number is needed")
