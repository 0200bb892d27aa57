"""From settings, templates and patterns to the engine's `Plan`, `Numbers` and template arrays.

In: `Settings`, `Template`s or `NoisePattern`s, a prepared clip. Out: what shapes the compilation and what does not. Errors
of templates and patterns are raised here, before any `jit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..annotations import NoisePattern, Template, check_type
from ..errors import OptionError, TemplateError, TemplateTooShort, find_name
from ..lengths import bucket
from .interface import Numbers, Plan
from .merging import Tolerance
from .noise import Pattern, Spans
from .prepare import Prepared, working_dtype
from .settings import Settings


def capacity_of(frames: int, every_line: bool) -> int:
    """Elements that the merging scan holds at first; a clip with more is run again with enough.

    every_line: each line displacement is an element of its own (the paper's method).
    """
    return 512 if every_line else 64 if frames <= 1024 else 256


def widths(settings: Settings, rate: float) -> dict[str, int | tuple[int, int]]:
    """Settings in seconds as whole frames at `rate` (halves round up)."""
    frames = lambda s: int(np.floor(s * rate + 0.5))  # noqa: E731
    short, long = (max(2, frames(s)) for s in settings.pivot_window)
    if settings.method == "paper":
        return {"span": settings.stride, "mean": 0, "hampel": 0, "pivot": (2, 2), "rest": (2, 2)}
    return {
        "span": max(1, frames(settings.span)),
        "mean": max(1, frames(settings.smooth)),
        "hampel": max(1, frames(settings.hampel)),
        "pivot": (max(3, short), max(3, long)),
        "rest": (max(3, frames(settings.min_duration)), max(3, frames(1.2))) if settings.method == "window" else (2, 2),
    }


def numbers(settings: Settings, rate: float, pivot_noise: np.ndarray) -> Numbers:
    """Settings that are data, as arrays; `pivot_noise` (lanes,) is what patterns say, metres by object."""
    dtype = working_dtype()
    f: Any = lambda x: np.asarray(x, dtype)  # noqa: E731  (NumPy: eighteen small transfers cost more than they hold)
    count: Any = lambda s, least=0: np.asarray(max(least, int(np.floor(s * rate + 0.5))), np.int32)  # noqa: E731
    low = (settings.thresholds or (0.0, 0.0)) if settings.method == "paper" else (settings.still[1], settings.still[0])
    return Numbers(
        f(rate),
        f(low[0]),
        f(low[1]),
        f(settings.cap[1]),
        f(settings.cap[0]),
        f(settings.margin),
        f(settings.axis_min),
        f(settings.spike),
        f(pivot_noise),
        f(settings.pivot_noise),
        f(settings.pivot_reach),
        count(settings.min_duration, 1),
        Tolerance(
            count(settings.max_gap, 1),
            f(settings.max_jump),
            count(settings.max_missing),
            f(settings.alpha_max),
            f(settings.dist_max),
        ),
    )


def template_spans(
    templates: Sequence[Template], clip: Prepared, settings: Settings, span: int, kinds: Sequence[str]
) -> tuple[tuple[Spans, ...], int, int]:
    """Template spans of each kind ("space", "line") as arrays, the number of slots, and the length that holds the longest.

    Frames are those of the original clip. Raises `TemplateError` for spans outside the clip, reversed or overlapping, and
    `TemplateTooShort` for fewer than three usable intervals.
    """
    where = clip.clip or "clip"
    by: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for t in templates:
        lane = find_name(t.object, clip.names, "object", where)
        kind = "space" if check_type(t.type) == "space" else "line"
        label = f"template {t.object} {t.begin}:{t.end}"
        if not t.begin >= 0 or not t.end < clip.original_frames:
            raise TemplateError(f"{where}: {label} is outside the clip, whose frames are 0..{clip.original_frames - 1}")
        if t.end <= t.begin:
            raise TemplateError(f"{where}: {label} ends before it begins; give BEGIN:END, both included")
        scale = clip.rate / clip.original_rate
        begin, end = int(np.ceil(t.begin * scale - 1e-9)), int(np.floor(t.end * scale + 1e-9))
        if end - begin < 3 + (span - 1):
            need = int(np.ceil((3 + span - 1) / scale))
            raise TemplateTooShort(
                f"{where}: {label} is too short: it needs at least {need + 1} frames ({3} displacements)"
            )
        seen = clip.valid[lane, begin : end + 1]
        if (seen[:-span] & seen[span:]).sum() < 3:
            raise TemplateTooShort(
                f"{where}: {label} has fewer than 3 displacements in which the object is seen (the rest is NaN or masked)"
            )
        if kind not in kinds:
            raise TemplateError(
                f"{where}: {label} is a {t.type} template, but only {', '.join(settings.types)} is asked for"
            )
        by.setdefault((kind, lane), []).append((begin, end))
    slots, longest = 0, 0
    for (kind, lane), spans in by.items():
        spans.sort()
        for one, two in pairwise(spans):
            if two[0] < one[1]:
                raise TemplateError(
                    f"{where}: two {kind} templates of {clip.names[lane]} overlap: {one[0]}:{one[1]} and {two[0]}:{two[1]}"
                )
        slots, longest = max(slots, len(spans)), max(longest, *(e - b for b, e in spans))
    if not slots:
        return (), 0, 0
    slots = 1 << (slots - 1).bit_length()
    lanes = clip.lanes
    out = []
    for kind in kinds:
        table = np.zeros((3, lanes, slots), np.int32)
        for (k, at), placed in by.items():
            if k == kind:
                for i, (b, e) in enumerate(placed):
                    table[:, at, i] = b, e, 1
        arrays: Any = table[0], table[1], table[2] > 0
        out.append(Spans(*arrays))
    return tuple(out), slots, bucket(longest)


def pivot_patterns(patterns: Sequence[NoisePattern], clip: Prepared) -> np.ndarray:
    """Noise in metres that each lane's pivots are measured against, as far as patterns say it (else 0)."""
    out = np.zeros(clip.lanes)
    for p in patterns:
        if p.unit == "per_window" and p.object.casefold() in (n.casefold() for n in clip.names):
            lane = find_name(p.object, clip.names, "object", clip.clip or "clip")
            out[lane] = max(out[lane], *p.eps_max)
    return out


def given_patterns(
    patterns: Sequence[NoisePattern], clip: Prepared, unit: str, kinds: Sequence[str]
) -> tuple[Pattern, ...]:
    """Patterns from `calibrate`, or from a file, as the engine's control points; objects without one keep the floor."""
    where = clip.clip or "clip"
    lanes = clip.lanes
    mine: dict[tuple[str, int], NoisePattern] = {}
    for p in patterns:
        if p.unit == "per_window" and unit == "per_second":
            continue  # `pivot_patterns` takes these
        if p.unit != unit:
            raise OptionError(
                f"the pattern of {p.object!r} is {p.unit}, this method needs one {unit}: calibrate with the same method"
            )
        if p.object.casefold() in (n.casefold() for n in clip.names):
            mine["space" if p.type == "space" else "line", find_name(p.object, clip.names, "object", where)] = p
    size = max([2, *(2 * ((len(p.sigma_max) + 1) // 2) for p in mine.values())])
    size = 2 << (max(1, size // 2) - 1).bit_length()
    dtype, out = working_dtype(), []
    scale = clip.rate / clip.original_rate
    for kind in kinds:
        frames, sigma, eps = (np.zeros((lanes, size), dtype) for _ in range(3))
        count = np.zeros(lanes, np.int32)
        for (k, lane), p in mine.items():
            if k == kind and p.status not in ("automatic",):
                n = len(p.sigma_max)
                at = np.asarray(p.frames or (0,), float) * scale
                frames[lane, :n], sigma[lane, :n], eps[lane, :n], count[lane] = at, p.sigma_max, p.eps_max, n
                frames[lane, n:], sigma[lane, n:], eps[lane, n:] = at[-1], p.sigma_max[-1], p.eps_max[-1]
        none = jnp.zeros((lanes, size // 2), jnp.int32)
        out.append(
            Pattern(jnp.asarray(frames), jnp.asarray(sigma), jnp.asarray(eps), jnp.asarray(count), none, none, none)
        )
    return tuple(out)


def plan_of(settings: Settings, rate: float, slots: int, length: int, given: bool, capacity: int) -> Plan:
    """The static plan of a run."""
    types = "space" in settings.types, "line" in settings.types, "point" in settings.types
    lines = types[1] or types[2]
    return Plan(
        settings.method,
        settings.projection,
        settings.formulation,
        settings.estimator,
        settings.interpolation,
        types,
        types[0] or settings.method != "paper",
        lines,
        settings.free_pivots,
        given,  # type: ignore[arg-type]
        capacity=capacity,
        templates=slots,
        template_frames=length,
        **widths(settings, rate),  # type: ignore[arg-type]
    )
