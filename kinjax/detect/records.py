"""From the engine's arrays to what a person reads: `Detection`, `NoisePattern`s, warnings in words.

In: `Found` with its padding, and what it was made from. Out: records without padding, frames of the original clip,
positions in the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..annotations import NoisePattern, Template
from . import lmeds, noise
from .interface import Found, Plan
from .prepare import Prepared
from .results import Detection, Segments
from .settings import Settings

_STATUS = (
    (lmeds.FEW, "few_intervals"),
    (lmeds.EXACT, "exact_fit"),
    (lmeds.AMBIGUOUS, "ambiguous"),
    (noise.UNREPRESENTATIVE, "unrepresentative"),
    (noise.MOVING, "template_moving"),
)
_WORDS = {
    "few_intervals": "its template has fewer than ten displacements: the thresholds are loose",
    "exact_fit": "more than half of its template's values are equal: there is hardly any noise to learn from",
    "ambiguous": "its template holds two groups of values of about one size: part of it may be another motion",
    "unrepresentative": "it would label most of the clip: the template may not show a constraint",
    "template_moving": "its template moves faster than a body at rest: the thresholds were capped",
}


def kinds_of(plan: Plan) -> tuple[str, ...]:
    """The template types of a plan, in the engine's order."""
    return ("space",) * plan.space + ("line",) * plan.lines


def unit_of(settings: Settings) -> str:
    return "per_interval" if settings.method == "paper" else "per_second"


def detection(
    clip: Prepared,
    settings: Settings,
    plan: Plan,
    found: Found,
    templates: Sequence[Template],
    patterns: Sequence[NoisePattern],
) -> Detection:
    """Padding removed, frames of the original clip, positions in the world."""
    host = found.on_host()
    objects = len(clip.names)
    n = clip.frames - plan.span
    cut = lambda x: x[:objects, :n].T  # noqa: E731
    slot, lane = np.nonzero(host.kind)  # padding finds nothing
    scale = clip.original_rate / clip.rate
    frame = lambda x: np.minimum(np.floor(x * scale + 0.5).astype(int), clip.original_frames - 1)  # noqa: E731
    records = list(patterns)
    given = {(p.object.casefold(), p.type == "space") for p in records}
    records += [
        p
        for p in pattern_records(clip, settings, plan, host, templates)
        if (p.object.casefold(), p.type == "space") not in given
    ]
    kind = host.kind[slot, lane]
    index: dict[tuple[str, str], int] = {
        (p.object.casefold(), p.type): i for i, p in reversed(list(enumerate(records)))
    }
    which = np.array(
        [
            [index.get((name, k), index.get((name, "line"), 0)) for k in ("space", "line", "point")]
            for name in map(str.casefold, clip.names)
        ]
    )
    segments = Segments(
        lane.astype(int),
        kind - 1,
        frame(host.begin[slot, lane]),
        frame(host.end[slot, lane]),
        host.position[:, slot, lane].T.astype(float) + clip.origin[lane],
        host.axis[:, slot, lane].T,
        host.residual[slot, lane],
        which[lane, kind - 1],
    )
    kinds: tuple[Any, ...] = kinds_of(plan)[: len(host.limits)]
    middle = (np.arange(n) + (0.5 if settings.method == "paper" else plan.span / 2)) * scale
    template = np.broadcast_to(np.zeros((), int), (n, objects))
    for m in host.marks if templates else ():
        template = np.maximum(template, cut(m))
    limits: list[dict[Any, np.ndarray]] = [
        {k: np.broadcast_to(cut(pair[i]), template.shape) for k, pair in zip(kinds, host.limits, strict=True)} for i in (0, 1)
    ]
    absent = clip.missing
    return Detection(
        middle,
        cut(host.sigma_3),
        cut(host.eps_3),
        np.broadcast_to(cut(host.sigma_1), template.shape),
        cut(host.eps_1),
        cut(host.valid),
        cut(host.passed),
        template,
        limits[0],  # type: ignore[arg-type]
        limits[1],  # type: ignore[arg-type]
        absent + host.missing[:objects],
        np.stack([x[:objects] for x in host.noise], axis=-1),
        segments,
        tuple(records),
        clip.original_rate,
        clip.names,
        clip.original_frames,
        clip.clip,
        unit_of(settings),
        settings,
        tuple(_warnings(clip, records, absent, np.asarray(host.missing)[:objects])),
    )


def pattern_records(
    clip: Prepared, settings: Settings, plan: Plan, host: Found, templates: Sequence[Template]
) -> tuple[NoisePattern, ...]:
    """The engine's patterns as records: one for each object and type."""
    out = []
    scale = clip.original_rate / clip.rate
    automatic = "given" if settings.thresholds else "automatic"
    for kind, pattern, limit in zip(kinds_of(plan)[: len(host.limits)], host.patterns, host.limits, strict=True):
        asked: Any = kind if kind == "space" or "line" in settings.types else "point"
        first = [x[:, 0].tolist() for x in limit]
        for lane, (name, count) in enumerate(zip(clip.names, pattern.size.tolist(), strict=False)):
            if count:
                used = slice(0, count)
                mine = tuple(
                    t
                    for t in templates
                    if t.object.casefold() == name.casefold() and ("space" if t.type == "space" else "line") == kind
                )
                bits = int(np.bitwise_or.reduce(pattern.status[lane][: len(mine)], initial=0))
                if float((host.passed[lane, : clip.frames - plan.span] > 0).mean()) > 0.8:
                    bits |= noise.UNREPRESENTATIVE
                out.append(
                    NoisePattern(
                        name,
                        asked,
                        tuple(map(float, pattern.sigma[lane][used])),
                        tuple(map(float, pattern.eps[lane][used])),  # type: ignore[arg-type]
                        tuple(round(float(f) * scale) for f in pattern.frames[lane][used]),
                        settings.alpha_max,
                        settings.dist_max,
                        int(pattern.intervals[lane].sum()),
                        int(pattern.kept[lane].sum()),
                        "+".join(w for b, w in _STATUS if bits & b) or "ok",
                        mine,
                        unit_of(settings),  # type: ignore[arg-type]
                    )
                )
            else:
                out.append(
                    NoisePattern(
                        name,
                        asked,
                        (first[0][lane],),
                        (first[1][lane],),
                        (),
                        settings.alpha_max,
                        settings.dist_max,
                        status=automatic,
                        unit=unit_of(settings),  # type: ignore[arg-type]
                    )
                )
    if plan.lines and plan.method != "paper":
        asked = "line" if "line" in settings.types else "point"
        for lane, name in enumerate(clip.names):
            mine = tuple(t for t in templates if t.object.casefold() == name.casefold() and t.type != "space")
            out.append(
                NoisePattern(
                    name,
                    asked,
                    (0.0,),
                    (float(host.pivot_noise[lane]),),
                    (),
                    settings.alpha_max,
                    settings.dist_max,
                    sum(t.end - t.begin for t in mine),
                    sum(t.end - t.begin for t in mine),
                    "ok" if mine else "automatic",
                    mine,
                    "per_window",
                )
            )
    return tuple(out)


def _warnings(clip: Prepared, patterns: Sequence[NoisePattern], absent: np.ndarray, spikes: np.ndarray) -> list[str]:
    """What a person should know, in words. A stray spike is no news; more than one frame in fifty is."""
    out = []
    for p in patterns:
        if p.status not in ("ok", "given", "automatic"):
            out += [f"{p.object} ({p.type}): {_WORDS[s]}" for s in p.status.split("+") if s in _WORDS]
    for name, unseen, spiky in zip(clip.names, absent.tolist(), spikes.tolist(), strict=True):
        if unseen:
            out.append(f"{name}: {unseen} of {clip.frames} frames are missing; they were masked")
        if spiky * 50 > clip.frames:
            out.append(f"{name}: {spiky} of {clip.frames} frames were rejected as spikes")
    return out
