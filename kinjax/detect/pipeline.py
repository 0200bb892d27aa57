"""Detection as a person calls it: `detect`, `calibrate`, and batches of clips.

In: motion or poses, templates or patterns, settings. Out: `Detection`, or `NoisePattern`s. It prepares, runs the jitted
engine once (again with more room if the clip held more constraints than planned), and turns its arrays into results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ..annotations import NoisePattern, Template
from ..errors import OptionError
from ..motion import Motion, Poses
from .batches import lane_name, lanes_of, room_of, shape_of, side_by_side
from .engine import run_clips, run_joints, run_poses
from .interface import Found, Joints, Plan
from .planning import capacity_of, given_patterns, numbers, pivot_patterns, plan_of, template_spans
from .prepare import Prepared, prepared
from .records import detection, kinds_of, pattern_records, unit_of
from .results import Detection
from .settings import Settings


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
    return detection(clip, settings, plan, found, templates, patterns)


def detect_many(
    sources: Sequence[Motion | Poses],
    objects: Sequence[str] | None = None,
    *,
    settings: Settings | None = None,
    patterns: Sequence[NoisePattern] = (),
    **changes: Any,
) -> list[Detection]:
    """Detection in many clips: clips of one bucket and rate run as one batch, each object of each clip in a lane of its own.

    Results equal those of `detect` clip by clip; nothing of one clip reaches another.
    """
    settings = (settings or Settings()).but(**changes)
    clips = [prepared(s, objects, None, settings) for s in sources]
    return detect_prepared(clips, settings, [patterns] * len(clips))


def detect_prepared(
    clips: Sequence[Prepared], settings: Settings, patterns: Sequence[Sequence[NoisePattern]]
) -> list[Detection]:
    """Detection in prepared clips, each with patterns of its own (or none), in batches of one shape.

    Each shape compiles once: batches have a fixed room, and clips with patterns run apart from those without.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, c in enumerate(clips):
        groups.setdefault((*shape_of(c), bool(patterns[i])), []).append(i)
    out: dict[int, Detection] = {}
    for members in groups.values():
        room = room_of(clips[members[0]])
        for k in range(0, len(members), room):
            some = members[k : k + room]
            batch, lanes = side_by_side([clips[i] for i in some], room)
            spread = [
                p.with_object(lane_name(n, name))
                for n, i in enumerate(some)
                for p in patterns[i]
                for name in clips[i].names
                if name.casefold() == p.object.casefold()
            ]
            plan, found = _run(batch, settings, (), spread)
            host = found.on_host()
            for i, (begin, end) in zip(some, lanes, strict=True):
                out[i] = detection(clips[i], settings, plan, lanes_of(host, begin, end), (), patterns[i])
    return [out[i] for i in range(len(clips))]


def calibrate(
    source: Motion | Poses,
    templates: Sequence[Template],
    *,
    settings: Settings | None = None,
    relative_to: str | None = None,
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
    return pattern_records(clip, settings, plan, found.on_host(), templates)


def _run(
    clip: Prepared, settings: Settings, templates: Sequence[Template], patterns: Sequence[NoisePattern]
) -> tuple[Plan, Found]:
    """Plan and run the engine; with more capacity if needed."""
    if templates and patterns:
        raise OptionError("give templates or patterns, not both; calibrate with all templates to refine a pattern")
    if settings.method == "window" and any(p.type == "space" for p in patterns):
        raise OptionError('method="window" learns rest from templates, not from patterns: give templates=')
    plan = plan_of(settings, clip.rate, 0, 0, bool(patterns), 0)
    plan = replace(plan, capacity=capacity_of(clip.frames, plan.lines and settings.method == "paper"))
    kinds = kinds_of(plan)
    if settings.method == "paper" and not (templates or patterns or settings.thresholds):
        raise OptionError(
            'method="paper" needs a template, a pattern or thresholds=(sigma_max, eps_max); method="robust" needs none'
        )
    spans, slots, length = template_spans(templates, clip, settings, plan.span, kinds)
    given = (
        given_patterns(patterns, clip, unit_of(settings), kinds[: 1 if settings.method != "paper" else None])
        if patterns
        else ()
    )
    if clip.frames <= plan.span:
        raise OptionError(
            f"{clip.clip or 'clip'}: {clip.frames} frame{'s' * (clip.frames != 1)} cannot hold a displacement over {plan.span}: "
            "nothing to detect in so short a clip"
        )
    plan = replace(plan, templates=slots, template_frames=length)
    pivots = pivot_patterns(patterns, clip)
    arguments = numbers(settings, clip.rate, pivots), clip.arrays, spans, given
    run = run_poses
    if isinstance(clip.arrays, Joints):
        run = run_joints if clip.arrays.rotations.ndim == 3 else run_clips
    while True:
        found = run(plan, *arguments)
        needed = int(found.overflow)
        if needed <= plan.capacity:
            return plan, found
        plan = replace(plan, capacity=1 << (needed - 1).bit_length())
