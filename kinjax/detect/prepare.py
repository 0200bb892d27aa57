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
from .engine import Clip, Joints, Numbers, Plan
from .merging import Tolerance
from .noise import Pattern, Spans
from .settings import Settings

PLAN_CAPACITY = 64
"""Elements that the merging scan holds at first; a clip with more is run again with enough."""


@dataclass(frozen=True)
class Prepared:
    """One clip, ready to run: what the engine takes (NumPy arrays), `valid` (objects, frames) without padding, and the
    `origin` (objects, 3) to be added to the positions that come out."""

    arrays: Clip | Joints
    valid: np.ndarray
    origin: np.ndarray
    lanes: int
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
    known = source.skeleton.names if isinstance(source, Motion) else getattr(source, "names", ())
    names = None if objects is None else list(dict.fromkeys(known[find_name(n, known, "object")] for n in objects))
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
    """Arrays padded to a bucket: objects to a power of two, frames to `numerics.bucket`."""
    near = settings.formulation == "local"  # the comparison of appendix A is about the world's own origin
    if isinstance(source, Motion) and source.rotations.ndim == 3 and relative_to is None and settings.rate in (None, source.rate):
        return _prepared_joints(source, objects, near)
    poses = as_poses(source, objects, relative_to)
    original = float(poses.rate), poses.frames
    check_rate(original[0])
    poses = resampled(poses, settings.rate)
    if poses.objects == 0:
        raise OptionError("no object to look at")
    valid = np.asarray(poses.valid).T
    t = np.asarray(poses.position, float)
    first = np.argmax(valid, axis=1)
    origin = np.where(valid.any(1)[:, None] & near, t[first, np.arange(poses.objects)], 0.0)
    seen = valid.T[..., None]
    q = np.where(seen, np.asarray(poses.rotation), [1, 0, 0, 0]).transpose(2, 1, 0)
    clip = padded_clip(q, np.where(seen, t - origin, 0.0).transpose(2, 1, 0), valid)
    return Prepared(
        clip, valid, origin, clip.q.shape[1], poses.names, poses.frames, float(poses.rate), poses.clip, poses.up, *original
    )


def check_rate(rate: float) -> None:
    """`OptionError` unless it is a positive number of frames a second."""
    if not (np.isfinite(rate) and rate > 0):
        raise OptionError(f"rate is {rate}: it must be a positive number of frames a second")


def padded_clip(q: np.ndarray, t: np.ndarray, valid: np.ndarray) -> Clip:
    """Components-first poses (4 and 3, objects, frames) in the working precision, padded with unseen identity poses."""
    objects, frames = valid.shape
    lanes, length, dtype = 1 << (objects - 1).bit_length(), bucket(frames), working_dtype()
    out = Clip(np.zeros((4, lanes, length), dtype), np.zeros((3, lanes, length), dtype), np.zeros((lanes, length), bool))
    out.q[0] = 1
    for whole, part in zip(out, (q, t, valid), strict=True):
        whole[..., :objects, :frames] = part
    return out


def _prepared_joints(motion: Motion, objects: Sequence[str] | None, near: bool) -> Prepared:
    """A motion as the engine takes it: only the objects and their ancestors, so that one hand costs one arm."""
    check_rate(float(motion.rate))
    top = motion.skeleton.topology
    names = top.names if objects is None else objects
    at = list(dict.fromkeys(find_name(n, top.names, "joint", motion.name) for n in names))
    if not at:
        raise OptionError("no object to look at")
    needed = set()
    for j in at:
        while j >= 0 and j not in needed:
            needed.add(j)
            j = top.parents[j]
    joints = sorted(needed)
    new = {old: i for i, old in enumerate(joints)}
    moving = [(k, j) for k, j in enumerate(top.translated) if j in new]
    dtype, frames = working_dtype(), motion.frames
    length, room = bucket(frames), 8 * -(-len(joints) // 8)
    q, t = np.asarray(motion.rotations), np.asarray(motion.translations)
    if len(joints) < q.shape[1]:
        q = q[:, joints]
    t = np.asarray(t[:, [k for k, _ in moving]], float)
    valid = np.isfinite(q).all((1, 2)) & np.isfinite(t).all((1, 2))
    root = np.array([top.parents[j] < 0 for _, j in moving])
    origin = t[np.argmax(valid), int(np.argmax(root))] if near and valid.any() and root.any() else np.zeros(3)
    t = t - root[:, None] * origin
    if not valid.all():
        q, t = np.where(valid[:, None, None], q, [1, 0, 0, 0]), np.where(valid[:, None, None], t, 0)
    rotations = np.zeros((length, room, 4), dtype)
    rotations[:frames, : len(joints)] = q
    rotations[frames:, :, 0] = rotations[:, len(joints) :, 0] = 1
    translations = np.zeros((length, len(moving), 3), dtype)
    translations[:frames] = t
    mask = np.zeros(length, bool)
    mask[:frames] = valid
    offsets = np.zeros((room, 3), dtype)
    offsets[: len(joints)] = np.asarray(motion.skeleton.offsets)[joints]
    parents = np.full(room, -1, np.int32)
    parents[: len(joints)] = [new.get(top.parents[j], -1) for j in joints]
    lanes = 1 << (len(at) - 1).bit_length()
    centers, index = np.zeros((lanes, 3), dtype), np.full(lanes, -1, np.int32)
    centers[: len(at)] = motion.skeleton.segment_centers()[at]
    index[: len(at)] = [new[j] for j in at]
    arrays = Joints(
        rotations, translations, mask, offsets, parents, np.array([new[j] for _, j in moving], np.int32), index, centers
    )
    rate = float(motion.rate)
    return Prepared(
        arrays, np.broadcast_to(valid, (len(at), frames)), np.broadcast_to(origin, (len(at), 3)), lanes,
        tuple(top.names[j] for j in at), frames, rate, motion.name, top.up, rate, frames,
    )


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
    lanes = clip.lanes
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
    lanes = clip.lanes
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
