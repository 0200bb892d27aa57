"""What detection finds, what deformation enforces, and what every file format stores: constraints, templates, patterns.

In: numbers from a detector, a person or a file. Out: small immutable records and a columnar table of them. No engine,
no disk. Conventions stated here and nowhere else:

* frames are 0-based, and a constraint covers `begin..end`, **both included** (the paper's `[kc_begin, kc_end]`);
  `Constraint.begin_s` and `end_s` are the times of those two frames;
* `position` is a world point in metres: of a space constraint the mean place of the object's origin, of a line
  constraint the point of the axis nearest the object, of a point constraint the pivot;
* `axis` is a unit world vector, up to sign, for line constraints only (else `None`);
* `residual` is the root mean square distance in metres by which the constrained point moves over the constraint.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args, overload

import numpy as np

from .errors import OptionError

ConstraintType = Literal["space", "line", "point"]
TYPES: tuple[ConstraintType, ...] = get_args(ConstraintType)


def check_type(name: str) -> ConstraintType:
    """The constraint type called `name`, in any case; `OptionError` when there is none."""
    for t in TYPES:
        if t == name.strip().lower():
            return t
    raise OptionError(f"no constraint type {name!r}: choose from {', '.join(TYPES)}")


@dataclass(frozen=True, slots=True)
class Template:
    """An example constraint given by a person: `object` is under a constraint of `type` in frames `begin..end`.

    Its intervals are `begin..end-1`. Source: 2006 paper, sections 3.1 and 6.
    """

    object: str
    begin: int
    end: int
    type: ConstraintType = "space"


@dataclass(frozen=True, slots=True)
class Constraint:
    """One kinematic constraint; the module's docstring states frames and units.

    `pattern` is the index of the noise pattern, in the `patterns` of the same result, that found it.
    """

    object: str
    type: ConstraintType
    begin: int
    end: int
    position: tuple[float, float, float]
    axis: tuple[float, float, float] | None = None
    residual: float = 0.0
    pattern: int = 0
    fps: float = 0.0

    @property
    def begin_s(self) -> float:
        """Time of the first frame, seconds from the clip's begin."""
        return self.begin / self.fps if self.fps else float("nan")

    @property
    def end_s(self) -> float:
        """Time of the last frame (included), seconds from the clip's begin."""
        return self.end / self.fps if self.fps else float("nan")

    @property
    def frames(self) -> int:
        """Number of frames covered, both ends included."""
        return self.end - self.begin + 1


@dataclass(frozen=True)
class Constraints(Sequence[Constraint]):
    """An ordered, immutable list of constraints with selection and a table view (`print` it, or `.columns()`)."""

    items: tuple[Constraint, ...] = ()

    def __len__(self) -> int:
        return len(self.items)

    @overload
    def __getitem__(self, i: int) -> Constraint: ...
    @overload
    def __getitem__(self, i: slice) -> Constraints: ...
    def __getitem__(self, i: int | slice) -> Constraint | Constraints:
        return Constraints(self.items[i]) if isinstance(i, slice) else self.items[i]

    def __iter__(self) -> Iterator[Constraint]:
        return iter(self.items)

    def of(self, object: str | None = None, type: str | None = None) -> Constraints:
        """Those of one object (any case) and/or of one type."""
        kind = check_type(type) if type is not None else None
        return Constraints(
            tuple(
                c
                for c in self.items
                if (object is None or c.object.casefold() == object.casefold()) and (kind is None or c.type == kind)
            )
        )

    def columns(self) -> dict[str, np.ndarray]:
        """Column arrays: object, type, begin, end, begin_s, end_s, x, y, z, axis_x, axis_y, axis_z, residual, pattern.

        Axis components are NaN where a constraint has no axis.
        """
        n = len(self.items)
        position = np.array([c.position for c in self.items], float).reshape(n, 3)
        axis = np.array([c.axis if c.axis is not None else (np.nan,) * 3 for c in self.items], float).reshape(n, 3)
        out: dict[str, np.ndarray] = {
            "object": np.array([c.object for c in self.items], dtype=str),
            "type": np.array([c.type for c in self.items], dtype=str),
        }
        for name, kind in (("begin", int), ("end", int), ("begin_s", float), ("end_s", float)):
            out[name] = np.array([getattr(c, name) for c in self.items], dtype=kind)
        out |= {k: position[:, i] for i, k in enumerate("xyz")} | {f"axis_{k}": axis[:, i] for i, k in enumerate("xyz")}
        out["residual"] = np.array([c.residual for c in self.items], float)
        out["pattern"] = np.array([c.pattern for c in self.items], int)
        return out

    def mask(self, frames: int, object: str | None = None, type: str | None = None) -> np.ndarray:
        """Boolean array (frames,): which frames one of the selected constraints covers."""
        out = np.zeros(frames, bool)
        for c in self.of(object, type):
            out[c.begin : c.end + 1] = True
        return out

    def __str__(self) -> str:
        if not self.items:
            return "no constraints"
        head = f"{'object':<16} {'type':<6} {'begin':>6} {'end':>6} {'begin s':>8} {'end s':>8} {'residual mm':>12}"
        rows = [
            f"{c.object:<16} {c.type:<6} {c.begin:>6} {c.end:>6} {c.begin_s:>8.3f} {c.end_s:>8.3f} {1e3 * c.residual:>12.2f}"
            for c in self.items
        ]
        return "\n".join([head, *rows])

    @classmethod
    def sorted(cls, items: Iterable[Constraint]) -> Constraints:
        """Ordered by first frame, then object, then type."""
        return cls(tuple(sorted(items, key=lambda c: (c.begin, c.end, c.object, TYPES.index(c.type)))))


@dataclass(frozen=True)
class NoisePattern:
    """The thresholds that decide, for one object and one constraint type (paper, section 6), as control points in time.

    `frames` (K,) control-point frames (empty: constant); `sigma_max` and `eps_max` (K,) or (1,): per interval for
    `method="paper"` (radians approximately, as singular values; metres), per second for `"robust"` (rad/s, m/s);
    per window for its line and point constraints (`eps_max`: the noise in metres that a pivot is measured against).
    `intervals`: template intervals used; `kept`: those that the least median of squares kept. `status` names what is
    worth knowing: `ok, few_intervals, exact_fit, ambiguous, unrepresentative, template_moving, automatic, given`,
    several joined by `+`. `templates` are those that it came from.
    """

    object: str
    type: ConstraintType
    sigma_max: tuple[float, ...]
    eps_max: tuple[float, ...]
    frames: tuple[int, ...] = ()
    alpha_max: float = 0.0
    dist_max: float = 0.0
    intervals: int = 0
    kept: int = 0
    status: str = "ok"
    templates: tuple[Template, ...] = field(default=())
    unit: Literal["per_interval", "per_second", "per_window"] = "per_interval"

    def with_object(self, name: str) -> NoisePattern:
        """The same thresholds for another object."""
        return replace(self, object=name)


@dataclass(frozen=True)
class Annotations:
    """What one clip's detection leaves on disk: `constraints`, the `patterns` that found them, `warnings` in words.

    `unit` is the unit of the positions, always "m". `truth` marks annotations known by construction.
    """

    clip: str
    fps: float
    frames: int
    constraints: Constraints
    patterns: tuple[NoisePattern, ...] = ()
    warnings: tuple[str, ...] = ()
    unit: str = "m"
    method: str = ""

    def at_rate(self, fps: float, frames: int) -> Annotations:
        """The same constraints in the frames of a clip of `fps` frames a second that has `frames` of them.

        A constraint covers the frames whose times lie in it, both ends included, or the nearest one where there are none.
        Patterns keep their control points, and templates their frames.
        """
        if not (np.isfinite(fps) and fps > 0 and self.fps > 0 and frames > 0):
            raise OptionError(f"{self.fps} frames a second cannot become {frames} frames at {fps}: both must be positive")
        ratio, last = fps / self.fps, frames - 1

        def moved(c: Constraint) -> Constraint:
            begin, end = int(np.ceil(c.begin * ratio - 1e-6)), int(np.floor(c.end * ratio + 1e-6))
            if begin > end:
                begin = end = round((c.begin + c.end) / 2 * ratio)
            return replace(c, begin=min(begin, last), end=min(end, last), fps=float(fps))

        return replace(self, fps=float(fps), frames=frames, constraints=Constraints(tuple(map(moved, self.constraints))))
