"""What detection gives back: a pytree of arrays with a table view.

In: the arrays of one run of the pipeline, padding removed. Out: `Detection`; its `constraints` are the records of
`kinjax.annotations`, its arrays are what the pictures draw.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..annotations import TYPES, Annotations, Constraint, Constraints, ConstraintType, NoisePattern
from .settings import Settings

Array = jax.Array | np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Segments:
    """Merged constraints as columns; type is an index into `annotations.TYPES`, object an index into `Detection.objects`."""

    object: Int[Array, " found"]
    type: Int[Array, " found"]
    begin: Int[Array, " found"]
    end: Int[Array, " found"]
    position: Float[Array, "found 3"]
    axis: Float[Array, "found 3"]
    residual: Float[Array, " found"]
    pattern: Int[Array, " found"]


def _triple(x: np.ndarray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Detection:
    """The constraints of one clip, and everything that led to them.

    Arrays run over displacements (N of them) and objects (O). `middle` is the frame coordinate of a displacement's middle.
    `sigma_3, eps_3, sigma_1, eps_1`: the sigma-epsilon space (paper section 5), per interval or per second as `unit` says
    (rad, m or rad/s, m/s). `valid`: both ends were seen. `passed`: instantaneous constraint, 0 none, 1 space, 2 line.
    `template`: 0 no template here, 1 kept by the estimator, 2 rejected by it. `sigma_max`, `eps_max`: thresholds by
    type. `missing` (O,): frames masked, by object. `noise` (O, 2): what the data's own noise was measured to be, metres and
    radians (the root of the summed variances of three components; zero for the paper's method, which measures none).
    `segments`: the constraints as columns; `constraints` as records.
    """

    middle: Float[Array, " n"]
    sigma_3: Float[Array, "n objects"]
    eps_3: Float[Array, "n objects"]
    sigma_1: Float[Array, "n objects"]
    eps_1: Float[Array, "n objects"]
    valid: Bool[Array, "n objects"]
    passed: Int[Array, "n objects"]
    template: Int[Array, "n objects"]
    sigma_max: dict[ConstraintType, Float[Array, "n objects"]]
    eps_max: dict[ConstraintType, Float[Array, "n objects"]]
    missing: Int[Array, " objects"]
    noise: Float[Array, "objects 2"]
    segments: Segments
    patterns: tuple[NoisePattern, ...]
    rate: float
    objects: tuple[str, ...] = field(metadata={"static": True})
    frames: int = field(metadata={"static": True})
    clip: str = field(metadata={"static": True})
    unit: str = field(metadata={"static": True})
    settings: Settings = field(metadata={"static": True})
    warnings: tuple[str, ...] = field(default=(), metadata={"static": True})

    @cached_property
    def constraints(self) -> Constraints:
        """The constraints, in time order."""
        s = jax.tree.map(np.asarray, self.segments)
        rate = float(self.rate)
        return Constraints.sorted(
            Constraint(
                object=self.objects[int(s.object[i])],
                type=(kind := TYPES[int(s.type[i])]),
                begin=int(s.begin[i]),
                end=int(s.end[i]),
                position=_triple(s.position[i]),
                axis=_triple(s.axis[i]) if kind == "line" else None,
                residual=float(s.residual[i]),
                pattern=int(s.pattern[i]),
                fps=rate,
            )
            for i in range(len(s.begin))
        )

    def annotations(self) -> Annotations:
        """What of this goes into a file."""
        return Annotations(
            self.clip,
            float(self.rate),
            self.frames,
            self.constraints,
            self.patterns,
            self.warnings,
            "m",
            self.settings.method,
        )

    def save(self, path: str | Path) -> Path:
        """Write the annotations; the suffix chooses the format: .json, .csv, .parquet, or .npz (per frame)."""
        from ..formats import write_annotations

        columns = self.objects if Path(path).suffix.lower() == ".npz" else None
        return write_annotations(path, self.annotations(), objects=columns)

    def __str__(self) -> str:
        head = f"{self.clip or 'clip'}: {self.frames} frames at {float(self.rate):g} fps, method {self.settings.method}"
        return "\n".join([head, str(self.constraints), *(f"warning: {w}" for w in self.warnings)])


for _record, _data in (
    (NoisePattern, ("sigma_max", "eps_max")),
    (Constraint, ("position", "axis", "residual")),
    (Constraints, ("items",)),
):
    _names = [f for f in _record.__dataclass_fields__]
    jax.tree_util.register_dataclass(
        _record, data_fields=list(_data), meta_fields=[n for n in _names if n not in _data]
    )
