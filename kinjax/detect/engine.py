"""The jitted pipeline: poses of all objects of a clip in, constraints out, as arrays of fixed shape.

In: `Clip` (components first, padded to a bucket), template spans, and `Numbers`; static: `Plan`. Out: `Found`. Steps 1 to
6 of the paper in order, for the three methods. Nothing here raises or depends on a length, an object's name or a
threshold's value, so a second clip of the same bucket compiles nothing. Clips of a batch are more objects: they share
nothing but `Numbers`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..bits import packed_bits
from ..forward import world_transforms
from ..lengths import BLOCK
from ..numerics import computed_once
from ..rotations import cross, normalize, rotate
from . import noise
from .bounds import bounds
from .displacements import Displacement, displacements, mean_pose, spikes
from .instantaneous import LINE, NONE, POINT, SPACE, instantaneous
from .interface import Clip, Found, Joints, Numbers, Plan, TemplateSpans
from .merging import Spans, absorb_short_rests, elements, merge, runs
from .noise import Pattern
from .pivots import merged_pivots, template_noise
from .refit import fit, span_moments, span_places
from .settling import Poses, settle
from .sigma_epsilon import SigmaEpsilon, project, project_by_svd
from .windows import Reward, best_segmentation, window_rewards

REST_NOISE = 0.003
"""Metres: the least noise that a rest is measured against (window method)."""


def run(plan: Plan, numbers: Numbers, clip: Clip, templates: TemplateSpans, given: tuple[Pattern, ...]) -> Found:
    """Steps 1 to 6."""
    paper = plan.method == "paper"
    q, t, seen = clip
    # component by component, here and in what follows: XLA does not vectorise a loop over a stack of them
    turned = [jnp.where(seen, x, 0 if i else 1) for i, x in enumerate(normalize(q))]
    moved = [jnp.where(seen, x, 0) for x in t]
    never = numbers.rate < 0
    turned, moved, seen = computed_once((turned, moved, seen), never)
    q, t = jnp.stack(turned), jnp.stack(moved)
    valid = seen if paper else computed_once(seen & ~spikes(q, t, seen, plan.hampel, numbers.spike, never), never)
    clip = Clip(q, t, valid)
    smooth = clip if paper else Clip(*mean_pose(q, t, valid, plan.mean, never), valid)
    real = t.shape[-1] - BLOCK + 3  # without padding, and three frames more: as many third differences as there are in whole blocks
    nu = (jnp.zeros_like(t[0, :, 0]),) * 2 if paper else noise.data_noise(*(x[..., :real] for x in (q, t, valid)))
    x = displacements(*smooth, plan.span)
    if paper and plan.span > 1:  # interval i belongs to frames i and i + 1, however far the displacement reaches
        x = x._replace(valid=x.valid & valid[:, 1 : 1 - plan.span])
    n = (x.w.shape[-1] // BLOCK) * BLOCK  # `prepare` pads by a block, so what is cut off is padding
    x = Displacement(*(a[..., :n] for a in x))
    points = _project(plan, numbers, x, smooth)
    patterns, marks, limits = _thresholds(plan, numbers, points, x.valid, nu, templates, given)
    passed = instantaneous(
        points.sigma_3,
        points.eps_3,
        points.sigma_1,
        points.eps_1,
        x.valid,
        limits[0] if plan.space else None,
        limits[-1] if paper and plan.lines else None,
        numbers.axis_min,
    )
    points, passed = computed_once((points, passed), never)
    if plan.method == "window":
        total, spans = _rest_windows(plan, numbers, clip, nu, templates)
    else:
        total, spans = _merge(plan, numbers, passed, x.valid, points, smooth)
    if not paper:
        wide = 0 if plan.method == "window" else plan.span
        settled = settle(spans, Poses(*clip), Poses(*smooth), nu, wide, plan.mean + (plan.span + 1) // 2)
        spans = computed_once(settled, never)
    found, overflow = _refit(plan, numbers, spans, clip), total
    pivot_noise = jnp.maximum(numbers.pivot_noise, jnp.maximum(numbers.pivot_floor, nu[0]))
    if plan.lines and not paper:
        taught = numbers.pivot_noise
        if plan.templates:
            taught = jnp.maximum(taught, template_noise(*clip, *templates[1]))
        pivot_noise = jnp.maximum(pivot_noise, taught)
        long = (spans.last - spans.first) >= numbers.least
        space = jnp.where(long, spans.kind, NONE), spans.first, spans.last
        pivots, more = merged_pivots(
            *clip,
            space,
            taught,
            numbers.pivot_floor,
            nu,
            plan.pivot,
            plan.free_pivots,
            plan.capacity,
            numbers.pivot_reach,
            jnp.sin(numbers.tolerance.alpha_max) ** 2,
            numbers.rate,
        )
        overflow = jnp.maximum(overflow, more)
        found = tuple(jnp.concatenate([a, b], axis=a.ndim - 2) for a, b in zip(found, pivots, strict=True))
    kind, begin, end, position, axis, residual = found
    asked = ((kind == SPACE) & plan.types[0]) | ((kind == LINE) & plan.types[1]) | ((kind == POINT) & plan.types[2])
    return Found(
        points.sigma_3,
        points.eps_3,
        points.sigma_1,
        points.eps_1,
        x.valid,
        passed,
        marks,
        limits,
        patterns,
        nu,
        pivot_noise,
        jnp.zeros(seen.shape[:1], jnp.int32) if paper else jnp.sum(seen & ~valid, axis=-1, dtype=jnp.int32),
        jnp.where(asked & (end - begin >= numbers.least), kind, NONE),
        begin,
        end,
        position,
        axis,
        residual,
        jnp.max(overflow, initial=0),
    )


def _project(plan: Plan, numbers: Numbers, x: Displacement, poses: Clip) -> SigmaEpsilon:
    """Step 3, as rates for all but the paper's method. `point` is a world point, where lines are looked for."""
    first = poses.t[..., : x.w.shape[-1]]
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
    return y._replace(
        sigma_3=y.sigma_3 * per_second,
        eps_3=y.eps_3 * per_second,
        sigma_1=y.sigma_1 * per_second,
        eps_1=y.eps_1 * per_second,
    )


def _thresholds(
    plan: Plan,
    numbers: Numbers,
    points: SigmaEpsilon,
    valid: Array,
    nu: tuple[Array, Array],
    templates: TemplateSpans,
    given: tuple[Pattern, ...],
) -> tuple[tuple[Pattern, ...], tuple[Array, ...], tuple[tuple[Array, Array], ...]]:
    """Step 4: pattern, template marks and thresholds of each type that has one (space first, then line and point)."""
    least, floor, most, margin = bounds(plan.method, plan.span, plan.mean, numbers, nu)
    middle = jnp.arange(valid.shape[-1], dtype=jnp.int32).astype(numbers.rate.dtype) + (
        0.5 if plan.method == "paper" else plan.span / 2
    )
    unmarked = jnp.zeros((valid.shape[0], 1), jnp.int32)
    values = [(points.sigma_3, points.eps_3)] * plan.space
    if plan.method == "paper" and plan.lines:
        values.append((points.sigma_1, points.eps_1))
    patterns, marks, limits = [], [], []
    for i, (sigma, eps) in enumerate(values):
        if plan.given:
            pattern, mark = given[i], unmarked
        elif plan.templates:
            pattern, mark = jax.vmap(
                lambda s, e, v, spans, lo, hi: noise.template_pattern(
                    s, e, v, spans, plan.span, plan.template_frames, plan.estimator, margin, lo, hi
                )
            )(sigma, eps, valid, templates[i], least, most)
        else:
            pattern, mark = noise.no_pattern(nu[0]), unmarked
        times = middle[:1] if noise.is_constant(pattern) else middle
        curve = jax.vmap(lambda p, lo, at=times: noise.thresholds(p, at, plan.interpolation, lo))
        limits.append(curve(pattern, floor))
        patterns.append(pattern)
        marks.append(mark)
    return tuple(patterns), tuple(marks), tuple(limits)


def _merge(
    plan: Plan, numbers: Numbers, kind: Array, valid: Array, points: SigmaEpsilon, poses: Clip
) -> tuple[Array, Spans]:
    """How many elements each object has, and step 6 on displacements; the spans that come out are frames, both included."""
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
    find, total = elements(kind, runs(kind), valid, missing, start, stop, points.axis if lines else None)
    spans = merge(find, total, plan.capacity, numbers.tolerance, lines)
    return total, Spans(spans.kind, spans.first + low, spans.last + high)


def _rest_windows(
    plan: Plan, numbers: Numbers, clip: Clip, nu: tuple[Array, Array], templates: TemplateSpans
) -> tuple[Array, Spans]:
    """How many windows each object has, and space at interval level (method "window"): the best segmentation into windows
    at rest, neighbours merged by distance.

    Measured against the noise of the data (position, and rotation at 0.1 m), or the spread of the templates, whichever is
    larger.
    """
    dtype = clip.t.dtype
    beta = jnp.asarray(9.0, dtype)
    least = jnp.maximum(numbers.pivot_noise, jnp.asarray(REST_NOISE, dtype))
    noise_level = jnp.maximum(least, jnp.hypot(nu[0], jnp.asarray(0.1 * (2 / 3) ** 0.5, dtype) * nu[1]))
    if plan.templates:
        spread = jax.vmap(
            lambda q, t, v, s: noise.template_spread(q, t, v, s, plan.template_frames), in_axes=(1, 1, 0, 0)
        )
        # a template that creeps must not pass for noise: no more than twice the least, as the robust method's cap
        taught = jnp.minimum(spread(*clip, templates[0]), least + least)
        noise_level = jnp.maximum(noise_level, taught)
    opening, none = beta * jnp.asarray(0.06, dtype) * numbers.rate, noise_level * 0
    reward = Reward(beta, noise_level, opening, numbers.pivot_reach, beta * 0, none, none)
    nothing = jnp.zeros_like(clip.valid)
    windows = best_segmentation(window_rewards(*clip, nothing, *plan.rest, reward, rest=True), plan.rest[0])
    kind = jnp.where(windows.inside, SPACE, NONE)
    smooth = mean_pose(*clip, plan.mean, numbers.rate < 0)[1]
    find, total = elements(
        kind,
        (packed_bits(windows.is_first), packed_bits(windows.is_last)),
        clip.valid,
        ~clip.valid,
        smooth,
        smooth,
        None,
    )
    return total, merge(find, total, plan.capacity, numbers.tolerance, False)


def _refit(plan: Plan, numbers: Numbers, spans: Spans, clip: Clip) -> tuple[Array, ...]:
    """Constraints refitted on all their frames: kind, begin, end, position, axis, residual."""
    used = spans.kind != NONE
    if not (plan.method == "paper" and plan.lines):
        place = span_places(clip.t, clip.valid, spans.first, spans.last, used)
        return *spans, place.center, jnp.zeros_like(place.center), place.spread
    moments, origin = span_moments(*clip, spans.first, spans.last, used)
    alpha2 = jnp.sin(numbers.tolerance.alpha_max) ** 2
    y = fit(moments, alpha2, jnp.zeros_like(alpha2), jnp.inf)
    rest = spans.kind == SPACE
    kind = jnp.where(rest | ~used, spans.kind, jnp.where(y.is_line, LINE, POINT))
    position, residual = jnp.where(rest, y.center, y.point), jnp.where(rest, y.spread, y.residual)
    return kind, spans.first, spans.last, position + origin, y.axis, residual


@partial(jax.jit, static_argnames="plan")
def run_poses(plan: Plan, numbers: Numbers, clip: Clip, templates: TemplateSpans, given: tuple[Pattern, ...]) -> Found:
    """Detection from world poses."""
    return run(plan, numbers, clip, templates, given)


@partial(jax.jit, static_argnames="plan")
def run_joints(
    plan: Plan, numbers: Numbers, joints: Joints, templates: TemplateSpans, given: tuple[Pattern, ...]
) -> Found:
    """Detection from joint rotations: forward kinematics first, in the same compiled function."""
    return run(plan, numbers, joint_poses(joints), templates, given)


@partial(jax.jit, static_argnames="plan")
def run_clips(
    plan: Plan, numbers: Numbers, clips: Joints, templates: TemplateSpans, given: tuple[Pattern, ...]
) -> Found:
    """Detection in a batch of clips, whose `Joints` have one more axis in front; their objects come one after another."""
    q, t, seen = jax.lax.map(joint_poses, clips)  # one by one: each has parents of its own
    world = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (jnp.moveaxis(q, 1, 0), jnp.moveaxis(t, 1, 0), seen))
    return run(plan, numbers, Clip(*world), templates, given)


def joint_poses(x: Joints) -> Clip:
    """World poses of the joints that are objects, origins at their segments' centres."""
    world = world_transforms(x.rotations, x.moving, x.offsets, x.parents, x.translated)
    q, t = (jnp.stack(x.objects(part)) for part in (world[:4], world[4:]))
    t = jnp.stack([a + b for a, b in zip(t, rotate(q, x.centers.T[:, :, None]), strict=True)])
    return Clip(q, t, x.valid & x.used[:, None])
