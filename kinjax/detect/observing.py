"""Steps 1 to 5 of the engine, object by object: displacements, their sigma-epsilon points, thresholds, and what passes them.

In: world poses of some objects, components first, their templates or patterns, and `Numbers`; static: `Plan`. Out: `Observed`.
Nothing of one object reaches another, so the engine takes as many at a time as fit the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..components import Parts
from ..lengths import BLOCK
from ..numerics import computed_once
from ..rotations import cross
from . import noise
from .bounds import bounds
from .displacements import Displacement, displacements, mean_pose, spikes
from .instantaneous import instantaneous
from .interface import Clip, Numbers, Plan, TemplateSpans
from .noise import Pattern
from .sigma_epsilon import SigmaEpsilon, project, project_by_svd

Taught = tuple[tuple[Pattern, ...], tuple[Array, ...], tuple[tuple[Array, Array], ...]]
"""Patterns, the marks of templates and thresholds, each by type."""


class Observed(NamedTuple):
    """Steps 1 to 5 of some objects, which are the first axis of everything; vectors as tuples of components.

    The engine's own poses, with what is not `valid` at rest in the origin; `smooth` ones (None: the same);
    sigma_3, eps_3, sigma_1, eps_1 of all displacements (`values`; one for all where they are the same), which of them are `shown` by
    valid frames and have `passed`, and, where lines are merged, their points and axes; where it is looked for, the noise `nu` and how
    many frames are `missing` as spikes; what templates have `taught`.
    """

    q: Parts
    t: Parts
    valid: Array
    smooth: tuple[Parts, Parts] | None
    values: tuple[Array, Array, Array, Array]
    shown: Array
    passed: Array
    lines: tuple[Parts, Parts] | None
    nu: tuple[Array, Array] | None
    missing: Array | None
    taught: Taught | None


def observed(
    plan: Plan, numbers: Numbers, q: Parts, t: Parts, seen: Array, templates: TemplateSpans, given: tuple[Pattern, ...]
) -> Observed:
    """Steps 1 to 5, object by object: nothing of one reaches another. Quaternions are unit where `seen`."""
    paper = plan.method == "paper"
    # component by component, here and in what follows: XLA does not vectorise a loop over a stack of them
    never = numbers.rate < 0
    turned = [jnp.where(seen, x, 0 if i else 1) for i, x in enumerate(q)]
    moved = [jnp.where(seen, x, 0) for x in t]
    turned, moved, seen = computed_once((turned, moved, seen), never)
    clip = Clip(jnp.stack(turned), jnp.stack(moved), seen)
    if not paper:
        spiky = spikes(*clip, plan.hampel, numbers.spike, never)
        clip = clip._replace(valid=computed_once(seen & ~spiky, never))
    smooth = clip if paper else Clip(*mean_pose(*clip, plan.mean, never), clip.valid)
    real = seen.shape[-1] - BLOCK + 3  # without padding, and three frames more: as many third differences as there are in whole blocks
    nu = (jnp.zeros_like(clip.t[0, :, 0]),) * 2 if paper else noise.data_noise(*(x[..., :real] for x in clip))
    x = displacements(*smooth, plan.span)
    if paper and plan.span > 1:  # interval i belongs to frames i and i + 1, however far the displacement reaches
        x = x._replace(valid=x.valid & clip.valid[:, 1 : 1 - plan.span])
    n = (x.w.shape[-1] // BLOCK) * BLOCK  # `prepare` pads by a block, so what is cut off is padding
    x = Displacement(*(a[..., :n] for a in x))
    points = _project(plan, numbers, x, smooth)
    taught = thresholds_of(plan, numbers, points, x.valid, nu, templates, given)
    limits = taught[2]
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
    # in closed form sigma_1 is 0 throughout
    sigma_1 = points.sigma_1[:, :1] if plan.projection == "closed" else points.sigma_1
    values = points.sigma_3, points.eps_3, sigma_1, points.eps_1
    lines = (tuple(points.point), tuple(points.axis)) if paper and plan.lines else None
    values, passed, lines = computed_once((values, passed, lines), never)
    return Observed(
        tuple(turned),
        tuple(moved),
        clip.valid,
        None if paper else (tuple(smooth.q), tuple(smooth.t)),
        values,
        x.valid,
        passed,
        lines,
        None if paper else nu,
        None if paper else jnp.sum(seen & ~clip.valid, axis=-1, dtype=jnp.int32),
        taught if plan.templates else None,
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


def thresholds_of(
    plan: Plan,
    numbers: Numbers,
    points: SigmaEpsilon | None,
    valid: Array,
    nu: tuple[Array, Array],
    templates: TemplateSpans,
    given: tuple[Pattern, ...],
) -> Taught:
    """Step 4, for each type that has a pattern of its own (space first, then line and point). Without templates nothing asks for
    `points`."""
    least, floor, most, margin = bounds(plan.method, plan.span, plan.mean, numbers, nu)
    middle = jnp.arange(valid.shape[-1], dtype=jnp.int32).astype(numbers.rate.dtype) + (
        0.5 if plan.method == "paper" else plan.span / 2
    )
    unmarked = jnp.zeros((valid.shape[0], 1), jnp.int32)
    kinds = ["3"] * plan.space + ["1"] * (plan.method == "paper" and plan.lines)
    patterns, marks, limits = [], [], []
    for i, kind in enumerate(kinds):
        if plan.given:
            pattern, mark = given[i], unmarked
        elif plan.templates:
            pattern, mark = jax.vmap(
                lambda s, e, v, spans, lo, hi: noise.template_pattern(
                    s, e, v, spans, plan.span, plan.template_frames, plan.estimator, margin, lo, hi
                )
            )(getattr(points, "sigma_" + kind), getattr(points, "eps_" + kind), valid, templates[i], least, most)
        else:
            pattern, mark = noise.no_pattern(nu[0]), unmarked
        times = middle[:1] if noise.is_constant(pattern) else middle
        curve = jax.vmap(lambda p, lo, at=times: noise.thresholds(p, at, plan.interpolation, lo))
        limits.append(curve(pattern, floor))
        patterns.append(pattern)
        marks.append(mark)
    return tuple(patterns), tuple(marks), tuple(limits)
