"""From what a person gives to what the engine takes: checked, named, padded to a bucket, and planned.

In: a `Motion` or `Poses`, object names, templates or patterns, `Settings`. Out: arrays for the engine with its `Plan` and
`Numbers`. Every structural error of detection is raised here, before any `jit`. Positions are taken from a place near each
object (float64 on the host), so that float32 is as good 1 km from the origin as at it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ..annotations import NoisePattern, Template, check_type
from ..errors import OptionError, ShapeError, TemplateError, TemplateTooShort, find_name
from ..kinematics import object_poses
from ..motion import Motion, Poses
from ..numerics import bucket
from .engine import Clip, Numbers, Plan
from .merging import Tolerance
from .noise import Pattern, Spans
from .settings import Settings

PLAN_CAPACITY = 64
"""Elements that the merging scan holds at first; a clip with more is run again with enough."""


@dataclass(frozen=True)
class Prepared:
    """One clip, ready to run: `arrays` of the engine's `Clip` (host), `origin` (objects, 3) to be added to positions."""

    q: np.ndarray
    t: np.ndarray
    valid: np.ndarray
    origin: np.ndarray
    names: tuple[str, ...]
    frames: int
    rate: float
    clip: str
    up: str
    original_rate: float
    original_frames: int


def working_dtype() -> np.dtype:
    """float64 where JAX has it enabled, else float32."""
    return np.dtype(np.float64 if jax.config.jax_enable_x64 else np.float32)


def as_poses(source: Motion | Poses, objects: Sequence[str] | None, relative_to: str | None) -> Poses:
    """The poses of the objects asked for, in the frame of another object where `relative_to` names one."""
    names = None if objects is None else list(dict.fromkeys(objects))
    wanted = None if names is None or relative_to is None else [*names, relative_to]
    if isinstance(source, Motion):
        poses = object_poses(source, wanted or names)
    elif isinstance(source, Poses):
        poses = source.select(wanted or names) if names is not None else source
    else:
        raise ShapeError(f"detection takes a Motion or Poses, not {type(source).__name__}; read files with kinjax.load")
    if poses.position.ndim != 3:
        raise ShapeError(f"poses of shape {poses.position.shape}: one clip is (frames, objects, 3); give a list of clips for a batch")
    if relative_to is None:
        return poses
    reference = poses.index(relative_to)
    others = [i for i in range(poses.objects) if i != reference]
    if not others:
        raise OptionError(f"relative_to={relative_to!r} leaves no object to look at")
    q, t = np.asarray(poses.rotation, float), np.asarray(poses.position, float)
    inverse = q[:, reference] * np.array([1.0, -1, -1, -1])
    from scipy.spatial.transform import Rotation

    seen = np.asarray(poses.valid)[:, reference]
    turn = Rotation.from_quat(np.where(seen[:, None], inverse, [1.0, 0, 0, 0])[:, [1, 2, 3, 0]])
    rotation, position = np.empty((len(q), len(others), 4)), np.empty((len(q), len(others), 3))
    for k, i in enumerate(others):
        ok = np.asarray(poses.valid)[:, i]
        own = Rotation.from_quat(np.where(ok[:, None], q[:, i], [1.0, 0, 0, 0])[:, [1, 2, 3, 0]])
        rotation[:, k] = (turn * own).as_quat()[:, [3, 0, 1, 2]]
        position[:, k] = turn.apply(np.where((ok & seen)[:, None], t[:, i] - t[:, reference], 0))
    return replace(
        poses, rotation=rotation, position=position, valid=np.asarray(poses.valid)[:, others] & seen[:, None],
        names=tuple(poses.names[i] for i in others),
    )


def resampled(poses: Poses, rate: float | None) -> Poses:
    """The clip at another rate: positions interpolated linearly, rotations by slerp; times outside valid pairs are masked."""
    if rate is None or rate == poses.rate or poses.frames < 2:
        return poses
    q, t, valid = (np.asarray(x) for x in (poses.rotation, poses.position, poses.valid))
    at = np.arange(int(np.floor((poses.frames - 1) / poses.rate * rate + 1e-9)) + 1) * (poses.rate / rate)
    i = np.minimum(at.astype(int), poses.frames - 2)
    u = (at - i)[:, None, None]
    a, b = q[i], q[i + 1]
    b = np.where((a * b).sum(-1, keepdims=True) < 0, -b, b)
    half = np.arccos(np.clip((a * b).sum(-1, keepdims=True), -1, 1))
    small = half < 1e-6
    s = np.where(small, 1, np.sin(half))
    mixed = np.where(small, (1 - u) * a + u * b, (np.sin((1 - u) * half) * a + np.sin(u * half) * b) / s)
    exact = u[..., 0] < 1e-9
    ok = valid[i] & (valid[i + 1] | exact)
    return replace(poses, rotation=mixed, position=np.where(u < 1e-9, t[i], (1 - u) * t[i] + u * t[i + 1]), valid=ok, rate=rate)


def prepared(source: Motion | Poses, objects: Sequence[str] | None, relative_to: str | None, settings: Settings) -> Prepared:
    """Poses as padded arrays, components first: objects to a power of two, frames to `numerics.bucket`."""
    poses = as_poses(source, objects, relative_to)
    original = float(poses.rate), poses.frames
    if not (np.isfinite(original[0]) and original[0] > 0):
        raise OptionError(f"rate is {original[0]}: it must be a positive number of frames a second")
    poses = resampled(poses, settings.rate)
    if poses.objects == 0:
        raise OptionError("no object to look at")
    dtype = working_dtype()
    valid = np.asarray(poses.valid).T
    t = np.asarray(poses.position, float)
    seen = valid.T[..., None]
    first = np.argmax(valid, axis=1)
    origin = np.where(valid.any(1)[:, None], t[first, np.arange(poses.objects)], 0.0)
    if settings.formulation == "global":  # the comparison of appendix A is about the world's own origin
        origin = np.zeros_like(origin)
    lanes, frames = 1 << (poses.objects - 1).bit_length(), bucket(poses.frames)
    q4 = np.zeros((4, lanes, frames), dtype)
    q4[0] = 1
    t3 = np.zeros((3, lanes, frames), dtype)
    mask = np.zeros((lanes, frames), bool)
    o, f = poses.objects, poses.frames
    q4[:, :o, :f] = np.where(seen, np.asarray(poses.rotation), [1, 0, 0, 0]).transpose(2, 1, 0)
    t3[:, :o, :f] = np.where(seen, t - origin, 0.0).transpose(2, 1, 0)
    mask[:o, :f] = valid
    return Prepared(q4, t3, mask, origin, poses.names, f, float(poses.rate), poses.clip, poses.up, *original)


def widths(settings: Settings, rate: float) -> dict[str, int | tuple[int, int]]:
    """Settings in seconds as whole frames at `rate` (halves round up)."""
    frames = lambda s: int(np.floor(s * rate + 0.5))  # noqa: E731
    short, long = (max(2, frames(s)) for s in settings.pivot_window)
    if settings.method == "paper":
        return {"span": settings.stride, "mean": 0, "hampel": 0, "pivot": (2, 2), "rest": (2, 2)}
    return {
        "span": max(1, frames(settings.span)), "mean": max(1, frames(settings.smooth)), "hampel": max(1, frames(settings.hampel)),
        "pivot": (max(3, short), max(3, long)), "rest": (max(3, frames(settings.min_duration)), max(3, frames(1.2))),
    }


def numbers(settings: Settings, rate: float) -> Numbers:
    """Settings that are data, as arrays."""
    dtype = working_dtype()
    f = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    count = lambda s, least=0: jnp.asarray(max(least, int(np.floor(s * rate + 0.5))), jnp.int32)  # noqa: E731
    low = (settings.thresholds or (0.0, 0.0)) if settings.method == "paper" else (settings.still[1], settings.still[0])
    return Numbers(
        f(rate), f(low[0]), f(low[1]), f(settings.cap[1]), f(settings.cap[0]), f(settings.margin), f(settings.axis_min),
        f(settings.spike), f(settings.pivot_noise), f(settings.pivot_reach), count(settings.min_duration, 1),
        Tolerance(
            count(settings.max_gap, 1), f(settings.max_jump), count(settings.max_missing), f(settings.alpha_max), f(settings.dist_max)
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
        if not 0 <= t.begin or not t.end < clip.original_frames:
            raise TemplateError(f"{where}: {label} is outside the clip, whose frames are 0..{clip.original_frames - 1}")
        if t.end <= t.begin:
            raise TemplateError(f"{where}: {label} ends before it begins; give BEGIN:END, both included")
        scale = clip.rate / clip.original_rate
        begin, end = int(np.ceil(t.begin * scale - 1e-9)), int(np.floor(t.end * scale + 1e-9))
        if end - begin < 3 + (span - 1):
            need = int(np.ceil((3 + span - 1) / scale))
            raise TemplateTooShort(f"{where}: {label} is too short: it needs at least {need + 1} frames ({3} displacements)")
        seen = clip.valid[lane, begin : end + 1]
        if (seen[:-span] & seen[span:]).sum() < 3:
            raise TemplateTooShort(f"{where}: {label} has fewer than 3 displacements in which the object is seen (the rest is NaN or masked)")
        if kind in kinds:
            by.setdefault((kind, lane), []).append((begin, end))
    slots, longest = 0, 0
    for (kind, lane), spans in by.items():
        spans.sort()
        for a, b in zip(spans, spans[1:], strict=False):
            if b[0] < a[1]:
                raise TemplateError(f"{where}: two {kind} templates of {clip.names[lane]} overlap: {a[0]}:{a[1]} and {b[0]}:{b[1]}")
        slots, longest = max(slots, len(spans)), max(longest, *(e - b for b, e in spans))
    if not slots:
        return (), 0, 0
    slots = 1 << (slots - 1).bit_length()
    lanes = clip.q.shape[1]
    out = []
    for kind in kinds:
        begin, end, used = np.zeros((lanes, slots), np.int32), np.zeros((lanes, slots), np.int32), np.zeros((lanes, slots), bool)
        for (k, lane), spans in by.items():
            if k == kind:
                for i, (b, e) in enumerate(spans):
                    begin[lane, i], end[lane, i], used[lane, i] = b, e, True
        out.append(Spans(jnp.asarray(begin), jnp.asarray(end), jnp.asarray(used)))
    return tuple(out), slots, bucket(longest)


def given_patterns(patterns: Sequence[NoisePattern], clip: Prepared, unit: str, kinds: Sequence[str]) -> tuple[Pattern, ...]:
    """Patterns from `calibrate`, or from a file, as the engine's control points; objects without one keep the floor."""
    where = clip.clip or "clip"
    lanes = clip.q.shape[1]
    mine: dict[tuple[str, int], NoisePattern] = {}
    for p in patterns:
        if p.unit != unit:
            raise OptionError(f"the pattern of {p.object!r} is {p.unit}, this method needs one {unit}: calibrate with the same method")
        if p.object.casefold() in (n.casefold() for n in clip.names):
            mine[("space" if p.type == "space" else "line", find_name(p.object, clip.names, "object", where))] = p
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
        out.append(Pattern(jnp.asarray(frames), jnp.asarray(sigma), jnp.asarray(eps), jnp.asarray(count), none, none, none))
    return tuple(out)


def plan_of(settings: Settings, rate: float, slots: int, length: int, given: bool, capacity: int) -> Plan:
    """The static plan of a run."""
    types = tuple(t in settings.types for t in ("space", "line", "point"))
    lines = types[1] or types[2]
    return Plan(
        settings.method, settings.projection, settings.formulation, settings.estimator, settings.interpolation,
        types, types[0] or settings.method != "paper", lines, settings.free_pivots, given,  # type: ignore[arg-type]
        capacity=capacity, templates=slots, template_frames=length, **widths(settings, rate),  # type: ignore[arg-type]
    )


def engine_clip(clip: Prepared) -> Clip:
    """The arrays that the engine takes."""
    return Clip(jnp.asarray(clip.q), jnp.asarray(clip.t), jnp.asarray(clip.valid))
