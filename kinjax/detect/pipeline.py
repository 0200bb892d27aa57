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
from ..numerics import BLOCK, bucket
from .engine import joint_poses, run_joints, run_poses
from .interface import Clip, Found, Joints, Plan
from .planning import capacity_of, given_patterns, numbers, pivot_patterns, plan_of, template_spans
from .prepare import Prepared, padded_clip, prepared
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
    groups: dict[tuple[int, float], list[int]] = {}
    for i, c in enumerate(clips):
        groups.setdefault((bucket(c.frames + BLOCK), c.rate), []).append(i)
    out: list[Detection | None] = [None] * len(clips)
    for members in groups.values():
        batch, cuts = _side_by_side([clips[i] for i in members])
        spread = [
            p.with_object(n)
            for p in patterns
            for n in batch.names
            if n.split("\0")[-1].casefold() == p.object.casefold()
        ]
        plan, found = _run(batch, settings, (), spread)
        host = jax.device_get(found)
        for i, (begin, end) in zip(members, cuts, strict=True):
            out[i] = detection(clips[i], settings, plan, _lanes(host, begin, end), (), patterns)
    return [d for d in out if d is not None]


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
    return pattern_records(clip, settings, plan, jax.device_get(found), templates)


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
    run = run_joints if isinstance(clip.arrays, Joints) else run_poses
    while True:
        found = run(plan, *arguments)
        needed = int(found.overflow)
        if needed <= plan.capacity:
            return plan, found
        plan = replace(plan, capacity=1 << (needed - 1).bit_length())


_world = jax.jit(joint_poses)


def _side_by_side(clips: Sequence[Prepared]) -> tuple[Prepared, list[tuple[int, int]]]:
    """Clips of one bucket as one clip with the objects of all; which lanes belong to which."""
    names = tuple(f"{i}\0{n}" for i, c in enumerate(clips) for n in c.names)
    counts = [len(c.names) for c in clips]
    ends = np.cumsum(counts)
    longest = max(c.frames for c in clips)
    poses = [c.arrays if isinstance(c.arrays, Clip) else jax.device_get(_world(c.arrays)) for c in clips]
    parts = [[x[..., :n, :longest] for x in p] for p, n in zip(poses, counts, strict=True)]
    arrays = padded_clip(*(np.concatenate(x, axis=-2) for x in zip(*parts, strict=True)))
    batch = replace(
        clips[0],
        arrays=arrays,
        valid=np.asarray(arrays.valid)[: ends[-1], :longest],
        origin=np.concatenate([c.origin for c in clips]),
        lanes=arrays.valid.shape[0],
        names=names,
        frames=longest,
        clip="batch",
    )
    return batch, [(int(e - n), int(e)) for e, n in zip(ends, counts, strict=True)]


def _lanes(found: Found, begin: int, end: int) -> Found:
    """The part of a batch's result that belongs to some lanes; arrays by object have them first, constraints last."""
    by_lane = lambda x: x[begin:end]  # noqa: E731
    last = {"kind", "begin", "end", "position", "axis", "residual"}
    return Found(
        **{
            f: (v if f == "overflow" else v[..., begin:end] if f in last else jax.tree.map(by_lane, v))
            for f, v in found._asdict().items()
        }
    )
