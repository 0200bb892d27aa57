"""Detection as a person calls it: `detect`, `calibrate`, and batches of clips.

In: motion or poses, templates or patterns, settings. Out: `Detection`, or `NoisePattern`s. It prepares, runs the jitted
engine once (again with more room if the clip held more constraints than planned), and turns its arrays into results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from ..annotations import NoisePattern, Template
from ..errors import OptionError
from ..motion import Motion, Poses
from ..numerics import bucket
from . import lmeds, noise
from .engine import Clip, Found, Joints, Plan, joint_poses, run_joints, run_poses
from .prepare import (
    PLAN_CAPACITY, Prepared, given_patterns, numbers, padded_clip, plan_of, prepared, template_spans,
)
from .results import Detection, Segments
from .settings import Settings

_STATUS = (
    (lmeds.FEW, "few_intervals"), (lmeds.EXACT, "exact_fit"), (lmeds.AMBIGUOUS, "ambiguous"),
    (noise.UNREPRESENTATIVE, "unrepresentative"), (noise.MOVING, "template_moving"),
)
_WORDS = {
    "few_intervals": "its template has fewer than ten displacements: the thresholds are loose",
    "exact_fit": "more than half of its template's values are equal: there is hardly any noise to learn from",
    "ambiguous": "its template holds two groups of values of about one size: part of it may be another motion",
    "unrepresentative": "it would label most of the clip: the template may not show a constraint",
    "template_moving": "its template moves faster than a body at rest: the thresholds were capped",
}


def detect(
    source: Motion | Poses,
    objects: Sequence[str] | None = None,
    *,
    templates: Sequence[Template] = (),
    patterns: Sequence[NoisePattern] = (),
    relative_to: str | None = None,
    settings: Settings | None = None,
    **changes: Any,
) -> Detection:
    """The kinematic constraints of one clip.

    objects: joints or objects to look at (any case; all when None). templates: example constraints; or `patterns` from
    `calibrate`; or neither, for the thresholds that follow from the data's own noise (robust and window methods) or from
    `thresholds` (paper). relative_to: look at motion relative to this object. settings, or single settings by name.

    Raises `KinjaxError`s for unknown names, unusable templates and settings. Missing frames are masked and counted.
    Source: Le Callennec and Boulic 2006, section 3.2.
    """
    settings = (settings or Settings()).but(**changes)
    clip = prepared(source, objects, relative_to, settings)
    plan, found = _run(clip, settings, templates, patterns)
    return _detection(clip, settings, plan, found, templates, patterns)


def detect_many(
    sources: Sequence[Motion | Poses], objects: Sequence[str] | None = None, *, settings: Settings | None = None,
    patterns: Sequence[NoisePattern] = (), **changes: Any,
) -> list[Detection]:
    """Detection in many clips: clips of one bucket and rate run as one batch, each object of each clip in a lane of its own.

    Results equal those of `detect` clip by clip; nothing of one clip reaches another.
    """
    settings = (settings or Settings()).but(**changes)
    clips = [prepared(s, objects, None, settings) for s in sources]
    groups: dict[tuple[int, float], list[int]] = {}
    for i, c in enumerate(clips):
        groups.setdefault((bucket(c.frames), c.rate), []).append(i)
    out: list[Detection | None] = [None] * len(clips)
    for members in groups.values():
        batch, cuts = _side_by_side([clips[i] for i in members])
        spread = [p.with_object(n) for p in patterns for n in batch.names if n.split("\0")[-1].casefold() == p.object.casefold()]
        plan, found = _run(batch, settings, (), spread)
        host = jax.device_get(found)
        for i, (begin, end) in zip(members, cuts, strict=True):
            out[i] = _detection(clips[i], settings, plan, _lanes(host, begin, end), (), patterns)
    return [d for d in out if d is not None]


def calibrate(
    source: Motion | Poses, templates: Sequence[Template], *, settings: Settings | None = None, relative_to: str | None = None,
    **changes: Any,
) -> tuple[NoisePattern, ...]:
    """The noise patterns that `templates` give (step 4), to be used with `detect(..., patterns=...)` on any clip.

    Further templates refine a pattern: calibrate again with all of them.
    """
    if not templates:
        raise OptionError("calibration needs at least one template")
    settings = (settings or Settings()).but(**changes)
    kinds = tuple(dict.fromkeys([*settings.types, *(t.type for t in templates)]))
    settings = settings.but(types=kinds)
    names = list(dict.fromkeys(t.object for t in templates))
    clip = prepared(source, names, relative_to, settings)
    plan, found = _run(clip, settings, templates, ())
    return _patterns(clip, settings, plan, jax.device_get(found), templates)


def _run(
    clip: Prepared, settings: Settings, templates: Sequence[Template], patterns: Sequence[NoisePattern]
) -> tuple[Plan, Found]:
    """Plan and run the engine; with more capacity if needed."""
    if templates and patterns:
        raise OptionError("give templates or patterns, not both; calibrate with all templates to refine a pattern")
    plan = plan_of(settings, clip.rate, 0, 0, bool(patterns), PLAN_CAPACITY)
    kinds = _kinds(plan)
    if settings.method == "paper" and not (templates or patterns or settings.thresholds):
        raise OptionError(
            'method="paper" needs a template, a pattern or thresholds=(sigma_max, eps_max); method="robust" needs none'
        )
    spans, slots, length = template_spans(templates, clip, settings, plan.span, kinds)
    given = given_patterns(patterns, clip, _unit(settings), kinds) if patterns else ()
    if clip.frames <= plan.span:
        raise OptionError(
            f"{clip.clip or 'clip'}: {clip.frames} frame{'s' * (clip.frames != 1)} cannot hold a displacement over {plan.span}: "
            "nothing to detect in so short a clip"
        )
    plan = replace(plan, templates=slots, template_frames=length)
    arguments = numbers(settings, clip.rate), clip.arrays, spans, given
    run = run_joints if isinstance(clip.arrays, Joints) else run_poses
    while True:
        found = run(plan, *arguments)
        needed = int(found.overflow)
        if needed <= plan.capacity:
            return plan, found
        plan = replace(plan, capacity=1 << (needed - 1).bit_length())


def _kinds(plan: Plan) -> tuple[str, ...]:
    """The pattern types of a plan, in the engine's order."""
    return ("space",) * plan.space + ("line",) * (plan.method == "paper" and plan.lines)


def _unit(settings: Settings) -> str:
    return "per_interval" if settings.method == "paper" else "per_second"


def _detection(
    clip: Prepared, settings: Settings, plan: Plan, found: Found, templates: Sequence[Template], patterns: Sequence[NoisePattern]
) -> Detection:
    """Padding removed, frames of the original clip, positions in the world."""
    host: Found = jax.device_get(found)
    objects = len(clip.names)
    n = clip.frames - plan.span
    cut = lambda x: x[:objects, :n].T  # noqa: E731
    slot, lane = np.nonzero(host.kind[:, :objects])
    scale = clip.original_rate / clip.rate
    frame = lambda x: np.minimum(np.floor(x * scale + 0.5).astype(int), clip.original_frames - 1)  # noqa: E731
    records = list(patterns) or list(_patterns(clip, settings, plan, host, templates))
    kind = host.kind[slot, lane]
    index = {(p.object.casefold(), p.type): i for i, p in reversed(list(enumerate(records)))}
    types = ("space", "line", "point")
    which = [
        index.get((clip.names[o].casefold(), types[k - 1]), index.get((clip.names[o].casefold(), "line"), 0))
        for o, k in zip(lane, kind, strict=True)
    ]
    segments = Segments(
        lane.astype(int), kind - 1, frame(host.begin[slot, lane]), frame(host.end[slot, lane]),
        host.position[:, slot, lane].T.astype(float) + clip.origin[lane], host.axis[:, slot, lane].T,
        host.residual[slot, lane], np.asarray(which, int),
    )
    kinds = _kinds(plan)
    middle = (np.arange(n) + (0.5 if settings.method == "paper" else plan.span / 2)) * scale
    template = np.zeros((n, objects), int)
    for m in host.marks:
        template = np.maximum(template, cut(m))
    missing = (~clip.valid).sum(1) + host.missing[:objects]
    return Detection(
        middle, cut(host.sigma_3), cut(host.eps_3), cut(host.sigma_1), cut(host.eps_1), cut(host.valid), cut(host.passed), template,
        {k: cut(v[0]) for k, v in zip(kinds, host.limits, strict=True)}, {k: cut(v[1]) for k, v in zip(kinds, host.limits, strict=True)},
        missing, segments, tuple(records), clip.original_rate, clip.names, clip.original_frames, clip.clip, _unit(settings), settings,
        tuple(_warnings(clip, records, missing)),
    )


def _patterns(
    clip: Prepared, settings: Settings, plan: Plan, host: Found, templates: Sequence[Template]
) -> tuple[NoisePattern, ...]:
    """The engine's patterns as records: one for each object and type."""
    out = []
    scale = clip.original_rate / clip.rate
    for kind, pattern, limit in zip(_kinds(plan), host.patterns, host.limits, strict=True):
        for lane, name in enumerate(clip.names):
            count = int(pattern.count[lane])
            mine = tuple(
                t for t in templates
                if t.object.casefold() == name.casefold() and ("space" if t.type == "space" else "line") == kind
            )
            asked = kind if kind == "space" or "line" in settings.types else "point"
            if count:
                used = slice(0, count)
                bits = int(np.bitwise_or.reduce(pattern.status[lane][: len(mine)], initial=0))
                if float((host.passed[lane, : clip.frames - plan.span] > 0).mean()) > 0.8:
                    bits |= noise.UNREPRESENTATIVE
                out.append(NoisePattern(
                    name, asked, tuple(map(float, pattern.sigma[lane][used])), tuple(map(float, pattern.eps[lane][used])),  # type: ignore[arg-type]
                    tuple(int(round(f * scale)) for f in pattern.frames[lane][used]), settings.alpha_max, settings.dist_max,
                    int(pattern.intervals[lane].sum()), int(pattern.kept[lane].sum()),
                    "+".join(w for b, w in _STATUS if bits & b) or "ok", mine, _unit(settings),  # type: ignore[arg-type]
                ))
            else:
                status = "given" if settings.thresholds else "automatic"
                out.append(NoisePattern(
                    name, asked, (float(limit[0][lane, 0]),), (float(limit[1][lane, 0]),), (), settings.alpha_max,  # type: ignore[arg-type]
                    settings.dist_max, status=status, unit=_unit(settings),  # type: ignore[arg-type]
                ))
    return tuple(out)


def _warnings(clip: Prepared, patterns: Sequence[NoisePattern], missing: np.ndarray) -> list[str]:
    """What a person should know, in words."""
    out = []
    for p in patterns:
        out += [f"{p.object} ({p.type}): {_WORDS[s]}" for s in p.status.split("+") if s in _WORDS]
    for name, lost in zip(clip.names, missing, strict=True):
        if lost:
            out.append(f"{name}: {int(lost)} of {clip.frames} frames missing or rejected as spikes")
    return out


_joint_poses = jax.jit(joint_poses)


def _side_by_side(clips: Sequence[Prepared]) -> tuple[Prepared, list[tuple[int, int]]]:
    """Clips of one bucket as one clip with the objects of all; which lanes belong to which."""
    names = tuple(f"{i}\0{n}" for i, c in enumerate(clips) for n in c.names)
    counts = [len(c.names) for c in clips]
    ends = np.cumsum(counts)
    poses = [c.arrays if isinstance(c.arrays, Clip) else jax.device_get(_joint_poses(c.arrays)) for c in clips]
    parts = [[x[..., :n, :] for x in p] for p, n in zip(poses, counts, strict=True)]
    arrays = padded_clip(*(np.concatenate(x, axis=-2) for x in zip(*parts, strict=True)))
    batch = replace(
        clips[0], arrays=arrays, valid=arrays.valid[: ends[-1]], origin=np.concatenate([c.origin for c in clips]),
        lanes=arrays.valid.shape[0], names=names, frames=max(c.frames for c in clips), clip="batch",
    )
    return batch, [(int(e - n), int(e)) for e, n in zip(ends, counts, strict=True)]


def _lanes(found: Found, begin: int, end: int) -> Found:
    """The part of a batch's result that belongs to some lanes; arrays by object have them first, constraints last."""
    by_lane = lambda x: x[begin:end]  # noqa: E731
    last = {"kind", "begin", "end", "position", "axis", "residual"}
    return Found(**{
        f: (v if f == "overflow" else v[..., begin:end] if f in last else jax.tree.map(by_lane, v))
        for f, v in found._asdict().items()
    })


