"""The jitted pipeline: poses of all objects of a clip in, constraints out, as arrays of fixed shape.

In: `Clip` (components first, padded to a bucket), template spans, and `Numbers`; static: `Plan`. Out: `Found`. Steps 1 to
6 of the paper in order, for the three methods. Nothing here raises or depends on a length, an object's name or a
threshold's value, so a second clip of the same bucket compiles nothing. Clips of a batch are more objects: they share
nothing but `Numbers`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..kinematics import local_translations, world_transforms
from ..numerics import safe_sqrt
from ..rotations import cross, dot, normalize, rotate
from . import noise
from .displacements import Displacement, displacements, mean_pose, spikes
from .instantaneous import LINE, NONE, POINT, SPACE, instantaneous
from .merging import Elements, Spans, Tolerance, absorb_short_rests, elements, merge, runs
from .noise import Pattern
from .pivots import merged_pivots
from .refit import fit, span_moments
from .settling import settle
from .sigma_epsilon import SigmaEpsilon, project, project_by_svd
from .windows import Reward, best_segmentation, window_rewards


@dataclass(frozen=True)
class Plan:
    """What a compilation depends on. `types`: those asked for; `space`, `lines`: stages that they need. Widths in frames: `span` of a displacement, `mean` and `hampel` half widths, `pivot`
    and `rest` shortest and longest windows. `capacity`: elements that the merging scan can hold; `templates` by object and
    type, of at most `template_frames`; `given`: patterns come from outside."""

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
    pivot_noise: Float[Array, ""]
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
    `valid`; `at`: the joints that are objects (-1: padding), with the `centers` of their segments in their own frames."""

    rotations: Float[Array, "frames joints 4"]
    moving: Float[Array, "frames t 3"]
    valid: Bool[Array, " frames"]
    offsets: Float[Array, "joints 3"]
    parents: Int[Array, " joints"]
    translated: Int[Array, " t"]
    at: Int[Array, " objects"]
    centers: Float[Array, "objects 3"]


class Found(NamedTuple):
    """Signals by displacement (objects, n), patterns, and constraints by slot (slots, objects); frames both included.

    `overflow`: elements of the fullest object; where it exceeds `Plan.capacity` the run must be repeated with more.
    """

    sigma_3: Float[Array, "objects n"]
    eps_3: Float[Array, "objects n"]
    sigma_1: Float[Array, "objects n"]
    eps_1: Float[Array, "objects n"]
    valid: Bool[Array, "objects n"]
    passed: Int[Array, "objects n"]
    marks: tuple[Int[Array, "objects n"], ...]
    limits: tuple[tuple[Float[Array, "objects n"], Float[Array, "objects n"]], ...]
    patterns: tuple[Pattern, ...]
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]]
    missing: Int[Array, " objects"]
    kind: Int[Array, "slots objects"]
    begin: Int[Array, "slots objects"]
    end: Int[Array, "slots objects"]
    position: Float[Array, "3 slots objects"]
    axis: Float[Array, "3 slots objects"]
    residual: Float[Array, "slots objects"]
    overflow: Int[Array, ""]


TemplateSpans = tuple[noise.Spans, ...]
"""Template spans of space, then of line and point, each (objects, templates); only the types that the plan asks for."""


def run(plan: Plan, numbers: Numbers, clip: Clip, templates: TemplateSpans, given: tuple[Pattern, ...]) -> Found:
    """Steps 1 to 6."""
    paper = plan.method == "paper"
    q, t, seen = clip
    identity = jnp.zeros_like(q).at[0].set(1)
    q, t = jnp.where(seen, normalize(q), identity), jnp.where(seen, t, 0)
    valid = seen if paper else seen & ~spikes(q, t, seen, plan.hampel, numbers.spike)
    clip = Clip(q, t, valid)
    smooth = clip if paper else Clip(*mean_pose(q, t, valid, plan.mean), valid)
    nu = (jnp.zeros_like(t[0, :, 0]),) * 2 if paper else noise.data_noise(q, t, valid)
    x = displacements(*smooth, plan.span)
    if paper and plan.span > 1:  # interval i belongs to frames i and i + 1, however far the displacement reaches
        x = x._replace(valid=x.valid & valid[:, 1 : 1 - plan.span])
    points = _project(plan, numbers, x, smooth)
    patterns, marks, limits = _thresholds(plan, numbers, points, x.valid, nu, templates, given)
    passed = instantaneous(
        points.sigma_3, points.eps_3, points.sigma_1, points.eps_1, x.valid,
        limits[0] if plan.space else None, limits[-1] if paper and plan.lines else None, numbers.axis_min,
    )
    if plan.method == "window":
        items, spans = _rest_windows(plan, numbers, clip, nu, templates)
    else:
        items, spans = _merge(plan, numbers, passed, x.valid, points, smooth)
    if not paper:
        spans = settle(spans, clip, smooth, nu, 0 if plan.method == "window" else plan.span, plan.mean + (plan.span + 1) // 2)
    found, overflow = _refit(plan, numbers, spans, clip), items.total
    if plan.lines and not paper:
        long = (spans.last - spans.first) >= numbers.least
        space = jnp.where(long, spans.kind, NONE), spans.first, spans.last
        pivots, more = merged_pivots(
            *clip, space, jnp.maximum(numbers.pivot_noise, nu[0]), nu[1], plan.pivot, plan.free_pivots, plan.capacity,
            numbers.pivot_reach, jnp.sin(numbers.tolerance.alpha_max) ** 2, numbers.rate,
        )
        overflow = jnp.maximum(overflow, more)
        found = tuple(jnp.concatenate([a, b], axis=a.ndim - 2) for a, b in zip(found, pivots, strict=True))
    kind, begin, end, position, axis, residual = found
    asked = ((kind == SPACE) & plan.types[0]) | ((kind == LINE) & plan.types[1]) | ((kind == POINT) & plan.types[2])
    return Found(
        points.sigma_3, points.eps_3, points.sigma_1, points.eps_1, x.valid, passed, marks, limits, patterns, nu,
        jnp.sum(seen & ~valid, axis=-1, dtype=jnp.int32),
        jnp.where(asked & (end - begin >= numbers.least), kind, NONE), begin, end, position, axis, residual,
        jnp.max(overflow, initial=0),
    )


def _project(plan: Plan, numbers: Numbers, x: Displacement, poses: Clip) -> SigmaEpsilon:
    """Step 3, as rates for all but the paper's method. `point` is a world point, where lines are looked for."""
    first = poses.t[..., : -plan.span]
    if plan.formulation == "global":  # D = W_{i+k} W_i^-1 (eq. 10): the translation of the world's origin
        two = jnp.asarray(2.0, x.w.dtype)
        turned = two * cross(x.v, first)
        x = x._replace(d=x.d - (x.w * turned + cross(x.v, turned)))
    y = (project if plan.projection == "closed" else project_by_svd)(x)
    if plan.formulation == "local":
        y = y._replace(point=y.point + first)
    if plan.method == "paper":
        return y
    per_second = numbers.rate / plan.span
    return y._replace(sigma_3=y.sigma_3 * per_second, eps_3=y.eps_3 * per_second,
                      sigma_1=y.sigma_1 * per_second, eps_1=y.eps_1 * per_second)


def _thresholds(
    plan: Plan, numbers: Numbers, points: SigmaEpsilon, valid: Array, nu: tuple[Array, Array], templates: TemplateSpans,
    given: tuple[Pattern, ...],
) -> tuple[tuple[Pattern, ...], tuple[Array, ...], tuple[tuple[Array, Array], ...]]:
    """Step 4: pattern, template marks and thresholds of each type that has one (space first, then line and point)."""
    if plan.method == "paper":
        low = jnp.broadcast_to(noise.smallest_floor(numbers.rate.dtype), nu[0].shape)
        least, most, margin = (low, low), (jnp.full_like(low, jnp.inf),) * 2, jnp.ones_like(numbers.margin)
        floor = (jnp.maximum(low, numbers.sigma_floor), jnp.maximum(low, numbers.eps_floor))
    else:
        width = jnp.asarray(2.5 * (2 / (2 * plan.mean + 1)) ** 0.5, numbers.rate.dtype) * numbers.rate / plan.span
        jitter = width * nu[1], width * nu[0]
        floor = jnp.hypot(numbers.sigma_floor, jitter[0]), jnp.hypot(numbers.eps_floor, jitter[1])
        least, most, margin = floor, (numbers.sigma_cap + jitter[0], numbers.eps_cap + jitter[1]), numbers.margin
    middle = jnp.arange(valid.shape[-1], dtype=jnp.int32).astype(numbers.rate.dtype) + (0.5 if plan.method == "paper" else plan.span / 2)
    values = [(points.sigma_3, points.eps_3)] * plan.space
    if plan.method == "paper" and plan.lines:
        values.append((points.sigma_1, points.eps_1))
    patterns, marks, limits = [], [], []
    for i, (sigma, eps) in enumerate(values):
        if plan.given:
            pattern, mark = given[i], jnp.zeros(valid.shape, jnp.int32)
        elif plan.templates:
            pattern, mark = jax.vmap(
                lambda s, e, v, spans, lo, hi: noise.template_pattern(
                    s, e, v, spans, plan.span, plan.template_frames, plan.estimator, margin, lo, hi
                )
            )(sigma, eps, valid, templates[i], least, most)
        else:
            pattern, mark = noise.no_pattern(nu[0]), jnp.zeros(valid.shape, jnp.int32)
        curve = jax.vmap(lambda p, lo: noise.thresholds(p, middle, plan.interpolation, lo))
        limits.append(curve(pattern, floor))
        patterns.append(pattern)
        marks.append(mark)
    return tuple(patterns), tuple(marks), tuple(limits)


def _merge(
    plan: Plan, numbers: Numbers, kind: Array, valid: Array, points: SigmaEpsilon, poses: Clip
) -> tuple[Elements, Spans]:
    """Step 6 on displacements; the spans that come out are frames, both included."""
    n = kind.shape[-1]
    lines = plan.method == "paper" and plan.lines
    low, high = (0, 1) if plan.method == "paper" else (plan.span // 2, (plan.span + 1) // 2)
    start, stop = poses.t[..., :n], poses.t[..., plan.span : plan.span + n]
    if plan.method == "paper":
        stop = poses.t[..., 1 : n + 1]
    else:  # a displacement's ends were seen, its middle frames perhaps not
        start = stop = (start + stop) / 2
    missing = ~valid
    if lines:
        kind, absorbed = absorb_short_rests(kind, numbers.least)
        valid &= ~absorbed
        on_line = kind == LINE
        start, stop = jnp.where(on_line, points.point, start), jnp.where(on_line, points.point, stop)
    items = elements(kind, runs(kind), valid, missing, start, stop, points.axis if lines else None, plan.capacity)
    spans = merge(items, numbers.tolerance, lines)
    return items, Spans(spans.kind, spans.first + low, spans.last + high)


def _rest_windows(
    plan: Plan, numbers: Numbers, clip: Clip, nu: tuple[Array, Array], templates: TemplateSpans
) -> tuple[Elements, Spans]:
    """Space at interval level (method "window"): the best segmentation into windows at rest, neighbours merged by distance.

    Measured against the noise of the data (position, and rotation at 0.1 m), or the spread of the templates, whichever is
    larger.
    """
    dtype = clip.t.dtype
    beta = jnp.asarray(9.0, dtype)
    noise_level = jnp.maximum(numbers.pivot_noise, jnp.hypot(nu[0], jnp.asarray(0.1 * (2 / 3) ** 0.5, dtype) * nu[1]))
    if plan.templates:
        spread = jax.vmap(lambda q, t, v, s: noise.template_spread(q, t, v, s, plan.template_frames), in_axes=(1, 1, 0, 0))
        noise_level = jnp.maximum(noise_level, spread(*clip, templates[0]))
    reward = Reward(beta, noise_level, beta * jnp.asarray(0.06, dtype) * numbers.rate, numbers.pivot_reach, beta * 0)
    nothing = jnp.zeros_like(clip.valid)
    windows = best_segmentation(
        window_rewards(*clip, nothing, *plan.rest, reward, rest=True), plan.rest[0]
    )
    kind = jnp.where(windows.inside, SPACE, NONE)
    smooth = mean_pose(*clip, plan.mean)[1]
    items = elements(kind, (windows.is_first, windows.is_last), clip.valid, ~clip.valid, smooth, smooth, None, plan.capacity)
    return items, merge(items, numbers.tolerance, False)


def _refit(plan: Plan, numbers: Numbers, spans: Spans, clip: Clip) -> tuple[Array, ...]:
    """Constraints refitted on all their frames: kind, begin, end, position, axis, residual."""
    used = spans.kind != NONE
    moments, origin = span_moments(*clip, spans.first, spans.last, used)
    if plan.method == "paper" and plan.lines:
        alpha2 = jnp.sin(numbers.tolerance.alpha_max) ** 2
        y = fit(moments, alpha2, jnp.zeros_like(alpha2), jnp.inf)
        rest = spans.kind == SPACE
        kind = jnp.where(rest | ~used, spans.kind, jnp.where(y.is_line, LINE, POINT))
        position, residual = jnp.where(rest, y.center, y.point), jnp.where(rest, y.spread, y.residual)
        return kind, spans.first, spans.last, position + origin, y.axis, residual
    n = jnp.maximum(moments.n, 1)
    center = moments.t / n
    spread = jnp.maximum(moments.tt / n - dot(center, center), 0)
    return spans.kind, spans.first, spans.last, center + origin, jnp.zeros_like(center), safe_sqrt(spread)


@partial(jax.jit, static_argnames="plan")
def run_poses(plan: Plan, numbers: Numbers, clip: Clip, templates: TemplateSpans, given: tuple[Pattern, ...]) -> Found:
    """Detection from world poses."""
    return run(plan, numbers, clip, templates, given)


@partial(jax.jit, static_argnames="plan")
def run_joints(plan: Plan, numbers: Numbers, joints: Joints, templates: TemplateSpans, given: tuple[Pattern, ...]) -> Found:
    """Detection from joint rotations: forward kinematics first, in the same compiled function."""
    return run(plan, numbers, joint_poses(joints), templates, given)


def joint_poses(x: Joints) -> Clip:
    """World poses of the joints that are objects, origins at their segments' centres."""
    at = jnp.maximum(x.at, 0)
    world = world_transforms(
        jnp.moveaxis(x.rotations, 0, -1), local_translations(x.offsets, x.moving, x.translated), x.parents
    )[at]
    q, t = jnp.moveaxis(world[:, :4], 1, 0), jnp.moveaxis(world[:, 4:], 1, 0)
    t = t + rotate(q, jnp.broadcast_to(x.centers.T[:, :, None], t.shape))
    return Clip(q, t, x.valid & (x.at >= 0)[:, None])
