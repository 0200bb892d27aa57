"""What the jitted engine takes and gives: its static `Plan`, its `Numbers`, clips as arrays, and what it `Found`.

In and out: nothing runs here. Everything that shapes a compilation is in `Plan`; everything else is an array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..components import Parts
from .merging import Tolerance
from .noise import Pattern, Spans


@dataclass(frozen=True)
class Plan:
    """What a compilation depends on.

    `types`: those asked for; `space`, `lines`: the stages that they need. Widths in frames: `span` of a displacement,
    `mean` and `hampel` half widths, `pivot` and `rest` shortest and longest windows. `capacity`: elements that the merging
    scan can hold; `templates` by object and type, of at most `template_frames`; `given`: patterns come from outside.
    """

    method: str
    projection: str
    formulation: str
    estimator: str
    interpolation: str
    types: tuple[bool, bool, bool]
    space: bool
    lines: bool
    free_pivots: bool
    given: bool
    span: int
    mean: int
    hampel: int
    pivot: tuple[int, int]
    rest: tuple[int, int]
    capacity: int
    templates: int
    template_frames: int


class Numbers(NamedTuple):
    """Settings that are data: changing one compiles nothing. Metres, radians, seconds; counts of displacements."""

    rate: Float[Array, ""]
    sigma_floor: Float[Array, ""]
    eps_floor: Float[Array, ""]
    sigma_cap: Float[Array, ""]
    eps_cap: Float[Array, ""]
    margin: Float[Array, ""]
    axis_min: Float[Array, ""]
    spike: Float[Array, ""]
    pivot_noise: Float[Array, " objects"]
    pivot_floor: Float[Array, ""]
    pivot_reach: Float[Array, ""]
    least: Int[Array, ""]
    tolerance: Tolerance


class Clip(NamedTuple):
    """World poses, components first: `q` (4, objects, frames), `t` (3, objects, frames), `valid` (objects, frames)."""

    q: Float[Array, "4 objects frames"]
    t: Float[Array, "3 objects frames"]
    valid: Bool[Array, "objects frames"]


class Joints(NamedTuple):
    """A skeleton's motion, padded: local `rotations`, `moving` translations of the `translated` joints, which frames are
    `valid`; `at`: the joints that are objects (-1: padding; None: they are all, in their order), with the `centers` of their segments in
    their own frames; which objects are `used` (the others are padding)."""

    rotations: Float[Array, "joints 4 frames"]
    moving: Float[Array, "t 3 frames"]
    valid: Bool[Array, " frames"]
    offsets: Float[Array, "joints 3"]
    parents: Int[Array, " joints"]
    translated: Int[Array, " t"]
    at: Int[Array, " objects"] | None
    centers: Float[Array, "objects 3"]
    used: Bool[Array, " objects"]

    def objects(self, world: Parts) -> Parts:
        """The rows of the objects, of world transforms by joint (`forward.world_transforms`)."""
        # rows that are in their order need no gather, which would take a third of what finding them did
        return tuple(w[: self.used.shape[-1]] if self.at is None else w[self.at] for w in world)


class Found(NamedTuple):
    """Signals by displacement (objects, n), patterns, and constraints by slot (slots, objects); frames both included. `marks` of
    templates and `limits` are one a displacement, or one for all where they are the same.

    `overflow`: elements of the fullest object; where it exceeds `Plan.capacity` the run must be repeated with more.
    """

    sigma_3: Float[Array, "objects n"]
    eps_3: Float[Array, "objects n"]
    sigma_1: Float[Array, "objects #n"]
    eps_1: Float[Array, "objects n"]
    valid: Bool[Array, "objects n"]
    passed: Int[Array, "objects n"]
    marks: tuple[Int[Array, "objects #n"], ...]
    limits: tuple[tuple[Float[Array, "objects #n"], Float[Array, "objects #n"]], ...]
    patterns: tuple[Pattern, ...]
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]]
    pivot_noise: Float[Array, " objects"]
    missing: Int[Array, " objects"]
    kind: Int[Array, "slots objects"]
    begin: Int[Array, "slots objects"]
    end: Int[Array, "slots objects"]
    position: Float[Array, "3 slots objects"]
    axis: Float[Array, "3 slots objects"]
    residual: Float[Array, "slots objects"]
    overflow: Int[Array, ""]

    def on_host(self) -> Found:
        """The same as NumPy arrays; `jax.device_get` takes four times as long for what need not be copied."""
        return jax.tree.map(np.asarray, self)


TemplateSpans = tuple[Spans, ...]
"""Template spans of space, then of line and point, each (objects, templates); only the types that the plan asks for."""
