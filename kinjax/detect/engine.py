"""The jitted pipeline: poses of all objects of a clip in, constraints out, as arrays of fixed shape.

In: `Clip` (components first, padded to a bucket) or `Joints`, template spans, and `Numbers`; static: `Plan`. Out: `Found`. Steps 1
to 6 of the paper in order, for the three methods: the first five by `observing`, a few objects at a time. Nothing here raises
or depends on a length, an object's name or a threshold's value, so a second clip of the same bucket compiles nothing.
Clips of a batch are more objects: they share nothing but `Numbers`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..bits import packed_bits
from ..components import Parts, rotate
from ..forward import world_transforms
from ..numerics import at_frames, computed_once
from ..rotations import dot
from . import noise
from .displacements import mean_pose
from .instantaneous import LINE, NONE, POINT, SPACE
from .interface import Clip, Found, Joints, Numbers, Plan, TemplateSpans
from .merging import Runs, Spans, Where, absorb_short_rests, elements, merge, runs
from .noise import Pattern
from .observing import Observed, observed, thresholds_of
from .pivots import merged_pivots, template_noise
from .refit import fit, span_moments, span_places
from .settling import Poses, settle
from .windows import Reward, best_segmentation, window_rewards

REST_NOISE = 0.003
"""Metres: the least noise that a rest is measured against (window method)."""

PosesOf = Callable[[Any, int], tuple[Parts, Parts, Array]]
"""World quaternions and positions, by component, and which are seen, of so many objects from one on."""

CACHED = 1 << 15
"""Numbers of an array for which that and its likes stay in a core's second cache."""


def _width(lanes: int, frames: int) -> int:
    """Objects to look at together: `lanes` is a power of two."""
    while lanes > 1 and lanes * frames > CACHED:
        lanes //= 2
    return lanes


def run(
    plan: Plan,
    numbers: Numbers,
    poses: PosesOf,
    shape: tuple[int, ...],
    templates: TemplateSpans,
    given: tuple[Pattern, ...],
) -> Found:
    """Steps 1 to 6; `shape`: objects and frames. Up to the fifth a few objects at a time, so that what one step leaves for the
    next is in cache."""
    paper, (lanes, frames) = plan.method == "paper", shape
    width = _width(lanes, frames)

    def some(first: Array) -> Observed:
        mine = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, width, 0), (templates, given))
        return observed(plan, numbers, *poses(first, width), *mine)

    firsts = jnp.arange(0, lanes, width, dtype=jnp.int32)
    o = jax.tree.map(lambda x: x.reshape(lanes, *x.shape[2:]), jax.lax.map(some, firsts))
    never, zero = numbers.rate < 0, jnp.zeros(lanes, o.t[0].dtype)
    nu = (zero, zero) if o.nu is None else o.nu
    taught = o.taught
    if taught is None:  # then they need no displacements
        taught = thresholds_of(plan, numbers, None, o.shown, nu, templates, given)
    patterns, marks, limits = taught
    clip = Clip(jnp.stack(o.q), jnp.stack(o.t), o.valid)
    smooth = clip if o.smooth is None else Clip(jnp.stack(o.smooth[0]), jnp.stack(o.smooth[1]), o.valid)
    if plan.method == "window":
        total, spans = _rest_windows(plan, numbers, clip, nu, templates)
    else:
        total, spans = _merge(plan, numbers, o.passed, o.shown, o.lines, smooth)
    if not paper:
        wide = 0 if plan.method == "window" else plan.span
        settled = settle(spans, Poses(*clip), Poses(*smooth), nu, wide, plan.mean + (plan.span + 1) // 2)
        spans = computed_once(settled, never)
    found, overflow = _refit(plan, numbers, spans, clip), total
    pivot_noise = jnp.maximum(numbers.pivot_noise, jnp.maximum(numbers.pivot_floor, nu[0]))
    if plan.lines and not paper:
        moving = numbers.pivot_noise
        if plan.templates:
            moving = jnp.maximum(moving, template_noise(*clip, *templates[1]))
        pivot_noise = jnp.maximum(pivot_noise, moving)
        long = (spans.last - spans.first) >= numbers.least
        space = jnp.where(long, spans.kind, NONE), spans.first, spans.last
        pivots, more = merged_pivots(
            *clip,
            space,
            moving,
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
    sigma_3, eps_3, sigma_1, eps_1 = o.values
    return Found(
        sigma_3,
        eps_3,
        sigma_1,
        eps_1,
        o.shown,
        o.passed,
        marks,
        limits,
        patterns,
        nu,
        pivot_noise,
        jnp.zeros(lanes, jnp.int32) if o.missing is None else o.missing,
        jnp.where(asked & (end - begin >= numbers.least), kind, NONE),
        begin,
        end,
        position,
        axis,
        residual,
        jnp.max(overflow, initial=0),
    )


def _merge(
    plan: Plan, numbers: Numbers, kind: Array, valid: Array, lines: tuple[Parts, Parts] | None, poses: Clip
) -> tuple[Array, Spans]:
    """How many elements each object has, and step 6 on displacements; the spans that come out are frames, both included."""
    low, high = (0, 1) if plan.method == "paper" else (plan.span // 2, (plan.span + 1) // 2)
    seen = countable = packed_bits(valid)
    if lines is not None:
        kind, absorbed = absorb_short_rests(kind, numbers.least)
        countable = seen & ~packed_bits(absorbed)

    def where(after: int) -> Where:
        """Where the constraints of displacements lie: lines where they were found, rests at the object's place."""

        def at(i: Array) -> tuple[Array, ...]:
            if plan.method != "paper":  # a displacement's ends were seen, its middle frames perhaps not
                return tuple((at_frames(x, i) + at_frames(x, i + plan.span)) / 2 for x in poses.t)
            place = tuple(at_frames(x, i + after) for x in poses.t)
            if lines is None:
                return place
            on_line = at_frames(kind, i) == LINE
            return tuple(jnp.where(on_line, at_frames(p, i), x) for p, x in zip(lines[0], place, strict=True))

        return at

    axis = (lambda i: tuple(at_frames(x, i) for x in lines[1])) if lines is not None else None
    find, total = elements(kind, runs(kind, lines is not None), countable, ~seen, where(0), where(1), axis)
    spans = merge(find, total, plan.capacity, numbers.tolerance, lines is not None)
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
    smooth, seen = mean_pose(*clip, plan.mean, numbers.rate < 0)[1], packed_bits(clip.valid)
    find, total = elements(
        kind,
        Runs(*map(packed_bits, (windows.inside, windows.is_first, windows.is_last))),
        seen,
        ~seen,
        *(lambda i: tuple(at_frames(x, i) for x in smooth),) * 2,
    )
    return total, merge(find, total, plan.capacity, numbers.tolerance, False)


def _refit(plan: Plan, numbers: Numbers, spans: Spans, clip: Clip) -> tuple[Array, ...]:
    """Constraints refitted on all their frames: kind, begin, end, position, axis, residual."""
    used = spans.kind != NONE
    if not (plan.method == "paper" and plan.lines):
        # spikes are no places
        t = clip.t if plan.method == "paper" else jnp.stack([jnp.where(clip.valid, x, 0) for x in clip.t])
        place = span_places(t, clip.valid, spans.first, spans.last, used)
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
    """Detection from world poses, whose quaternions are normalised."""
    never = numbers.rate < 0

    def unit(first: Array, width: int) -> tuple[Parts, Parts, Array]:
        q, t, seen = rows_of(clip)(first, width)
        # as `rotations.normalize`, but with one square root a quaternion: XLA would take it again for each component
        square = dot(q, q)
        good = seen & (square > 0) & (square < jnp.inf)
        scale = computed_once(1 / jnp.sqrt(jnp.where(good, square, 1)), never)
        return tuple(jnp.where(good, x * scale, 0 if i else 1) for i, x in enumerate(q)), t, seen

    return run(plan, numbers, unit, clip.valid.shape, templates, given)


@partial(jax.jit, static_argnames="plan")
def run_joints(
    plan: Plan, numbers: Numbers, joints: Joints, templates: TemplateSpans, given: tuple[Pattern, ...]
) -> Found:
    """Detection from joint rotations, which are unit as all of a motion's: forward kinematics first, in the same compiled function."""
    shape = joints.used.shape[0], joints.valid.shape[0]
    return run(plan, numbers, joint_poses(joints), shape, templates, given)


@partial(jax.jit, static_argnames="plan")
def run_clips(
    plan: Plan, numbers: Numbers, clips: Joints, templates: TemplateSpans, given: tuple[Pattern, ...]
) -> Found:
    """Detection in a batch of clips, whose `Joints` have one more axis in front; their objects come one after another."""

    def one(x: Joints) -> tuple[Parts, Parts, Array]:
        return joint_poses(x)(jnp.zeros((), jnp.int32), x.used.shape[0])

    # one by one: each has parents of its own
    world = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), jax.lax.map(one, clips))
    return run(plan, numbers, rows_of(Clip(*world)), world[-1].shape, templates, given)


def rows_of(world: Clip) -> PosesOf:
    """Some objects of world poses."""

    def some(first: Array, width: int) -> tuple[Parts, Parts, Array]:
        return jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(x, first, width, 0), (tuple(world.q), tuple(world.t), world.valid)
        )

    return some


def joint_poses(x: Joints) -> PosesOf:
    """World poses of the joints that are objects, origins at their segments' centres."""
    world = world_transforms(x.rotations, x.moving, x.offsets, x.parents, x.translated)

    def some(first: Array, width: int) -> tuple[Parts, Parts, Array]:
        def rows(y: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(y, first, width, 0)

        # rows that are in their order need no gather, which would take a third of what finding them did
        mine = tuple(rows(w) if x.at is None else w[rows(x.at)] for w in world)
        turned = rotate(mine[:4], rows(x.centers).T[:, :, None])
        return mine[:4], tuple(a + b for a, b in zip(mine[4:], turned, strict=True)), x.valid & rows(x.used)[:, None]

    return some
