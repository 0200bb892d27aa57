"""The soft pipeline, pure and jittable: poses of all objects of a clip in, labels in [0, 1] out.

In: `Clip` or `Joints` (components first, padded), `Numbers`, templates or `Limits`, a temperature; static: `SoftPlan`. Out:
`SoftDetection`. The steps are those of `detect.engine.run`, for space constraints of the robust and the paper's method. Which
frames are valid (given masks, and the Hampel filter's) is piecewise constant and declared so; everything else is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..components import Parts, conjugate, matrix, vector_of_product
from ..detect.bounds import bounds
from ..detect.displacements import spikes
from ..detect.interface import Clip, Joints, Numbers
from ..lengths import BLOCK
from ..numerics import safe_sqrt, shifted
from ..rotations import dot
from .body import joint_poses
from .instantaneous import Limits, soft_instantaneous
from .lmeds import soft_lmeds
from .merging import frames_and_edges, soft_merge, soft_opening
from .parts import held, mean_pose, normalize
from .quantile import smooth_quantile
from .settling import soft_settle
from .steps import smooth_maximum, smooth_minimum


@dataclass(frozen=True)
class SoftPlan:
    """What a compilation depends on: the method, and widths in frames. `settle`: whether the ends of rests are looked for."""

    method: str
    span: int
    mean: int
    hampel: int
    max_gap: int
    max_missing: int
    least: int
    settle: bool


class Membership(NamedTuple):
    """Templates: how much each frame belongs to its object's, in [0, 1]; `at`: the displacements that are looked at, by first
    frame (as many as the array has, -1 for none); `some`: whether the object has a template."""

    frames: Float[Array, "objects frames"]
    at: Int[Array, "objects capacity"]
    some: Bool[Array, " objects"]


class SoftDetection(NamedTuple):
    """Labels and what led to them, by object.

    labels (objects, frames): how much a frame is in a space constraint. passed (objects, n): how much a displacement is an
    instantaneous constraint; merged (objects, n): how much a constraint covers it, before ends are looked for and short ones
    left out. sigma, eps (objects, n): the displacements, `valid` (objects, n) where both ends were seen. limits: thresholds.
    noise: the data's own, metres and radians (0 for the paper's method). Units as `Limits` has them.
    """

    labels: Float[Array, "objects frames"]
    passed: Float[Array, "objects n"]
    merged: Float[Array, "objects n"]
    sigma: Float[Array, "objects n"]
    eps: Float[Array, "objects n"]
    valid: Bool[Array, "objects n"]
    limits: Limits
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]]


def run(
    plan: SoftPlan,
    numbers: Numbers,
    source: Clip | Joints,
    templates: Membership | None,
    given: Limits | None,
    temperature: Float[Array, ""],
) -> SoftDetection:
    """Steps 1 to 6, softly, on padded arrays. `given` thresholds take the place of templates."""
    paper = plan.method == "paper"
    q, t, valid = joint_poses(source) if isinstance(source, Joints) else _seen(source)
    never = jax.lax.stop_gradient(q[0][0, 0]) > 2  # a component of a unit quaternion; the compiler does not know
    q, t = held((q, t), never)
    if not paper:
        fixed = jax.lax.stop_gradient((jnp.stack(q), jnp.stack(t)))
        valid = valid & ~spikes(*fixed, valid, plan.hampel, numbers.spike, never)
    zero = jnp.zeros_like(t[0][:, 0])
    noise = (zero, zero) if paper else data_noise(q, t, valid, temperature)
    mean = (q, t) if paper else held(mean_pose(q, t, valid, plan.mean), never)
    k, n = plan.span, (valid.shape[-1] - plan.span) // BLOCK * BLOCK  # what is cut off is padding
    first, second = ([tuple(x[:, i : i + n] for x in y) for y in mean] for i in (0, k))
    seen = valid[:, :n] & valid[:, k : k + n]
    if paper and k > 1:  # interval i belongs to frames i and i + 1, however far the displacement reaches
        seen = seen & valid[:, 1 : n + 1]
    turn = vector_of_product(second[0], conjugate(first[0]))
    shift = tuple(b - a for a, b in zip(first[1], second[1], strict=True))
    sigma, eps = (
        2 * safe_sqrt(dot(turn, turn)),
        safe_sqrt(dot(shift, shift)),
    )  # sigma_3 and eps_3 of a rigid displacement
    if not paper:
        sigma, eps = sigma * (numbers.rate / k), eps * (numbers.rate / k)
    limits = thresholds(plan, numbers, sigma, eps, seen, noise, templates, given, temperature)
    wide = Limits(*(y if y.ndim == 2 else y[:, None] for y in limits))
    passed = soft_instantaneous(sigma, eps, seen, *wide, temperature)
    start, stop = first[1], tuple(x[:, 1 : n + 1] for x in mean[1])
    if not paper:  # a displacement's ends were seen, its middle frames perhaps not
        start = stop = tuple((a + b) / 2 for a, b in zip(first[1], second[1], strict=True))
    low, high = (0, 1) if paper else (k // 2, (k + 1) // 2)

    # one object at a time: its rows stay in cache, and what the loops over gaps would keep for the gradient is computed again
    @jax.checkpoint
    def one(y: Any) -> tuple[Array, Array]:
        passed, seen, start, stop, raw, mean, noise = y
        merged = soft_merge(
            passed, seen, start, stop, plan.max_gap, numbers.tolerance.max_jump, plan.max_missing, temperature
        )
        inside, edges = frames_and_edges(merged, low, high)
        if plan.settle:
            after, before = soft_settle(merged.begins, merged.ends, raw, mean, noise, k, plan.mean + high, temperature)
            inside = 1 - (1 - inside) * after * before
            edges = 1 - (1 - edges) * shifted(after, 1, 1.0) * before
        return soft_opening(inside, edges, plan.least), merged.covered

    around = ((q, t, valid), mean, noise) if plan.settle else ((), (), ())
    labels, merged = jax.lax.map(one, (passed, seen, start, stop, *around))
    labels = jnp.concatenate([labels, jnp.zeros((labels.shape[0], valid.shape[1] - n), labels.dtype)], axis=-1)
    return SoftDetection(labels, passed, merged, sigma, eps, seen, limits, noise)


def _seen(clip: Clip) -> tuple[Parts, Parts, Bool[Array, "objects frames"]]:
    """Unit rotations, and the identity at the origin where nothing was seen, whatever stood there."""
    q, t = ([p[0] for p in jnp.split(jnp.asarray(x), x.shape[0])] for x in clip[:2])  # the gradient: one concatenation
    turned = normalize(tuple(jnp.where(clip.valid, x, 0 if i else 1) for i, x in enumerate(q)))
    return turned, tuple(jnp.where(clip.valid, x, 0) for x in t), jnp.asarray(clip.valid)


def data_noise(
    q: Parts, t: Parts, valid: Bool[Array, "objects frames"], temperature: Float[Array, ""]
) -> tuple[Float[Array, " objects"], Float[Array, " objects"]]:
    """`detect.noise.data_noise` with a smooth median: metres and radians, from the third differences of 3 + 9 elements."""
    four = valid & shifted(valid, 1, False) & shifted(valid, 2, False) & shifted(valid, 3, False)
    count = jnp.sum(four, axis=-1, dtype=jnp.int32)
    level = ((count - 1) // 2).astype(t[0].dtype) + 0.5
    zero = jnp.zeros((), t[0].dtype)

    def variance(x: Float[Array, "objects frames"]) -> Float[Array, " objects"]:
        third = jnp.abs(shifted(x, 3) - 3 * shifted(x, 2) + 3 * shifted(x, 1) - x)
        return (jnp.asarray(1.4826, x.dtype) * smooth_quantile(third, four, level, zero, temperature)) ** 2 / 20

    # one row at a time, of a loop: together they would leave the cache, and the slowest search would hold up all
    nu_t = safe_sqrt(jnp.sum(jax.lax.map(variance, jnp.stack(t)), axis=0))
    nu_r = safe_sqrt(jnp.sum(jax.lax.map(variance, jnp.stack(matrix(q))), axis=0) / 2)
    return nu_t, nu_r


def thresholds(
    plan: SoftPlan,
    numbers: Numbers,
    sigma: Float[Array, "objects n"],
    eps: Float[Array, "objects n"],
    valid: Bool[Array, "objects n"],
    noise: tuple[Float[Array, " objects"], Float[Array, " objects"]],
    templates: Membership | None,
    given: Limits | None,
    temperature: Float[Array, ""],
) -> Limits:
    """Step 4: `given`, or what the templates teach, or neither, and above the floor (smoothly: it never stops a gradient)."""
    _, floor, cap, margin = bounds(plan.method, plan.span, plan.mean, numbers, noise)
    if given is not None:
        bottom = [f if y.ndim == 1 else f[:, None] for f, y in zip(floor, given, strict=True)]
        return Limits(*(smooth_maximum(y, f, temperature * f) for y, f in zip(given, bottom, strict=True)))
    if templates is None:
        return Limits(*floor)
    belongs = templates.frames * shifted(templates.frames, plan.span)
    usable = valid & templates.some[:, None]

    def one(sigma: Array, eps: Array, usable: Array, belongs: Array, at: Array) -> tuple[Array, Array]:
        safe = jnp.clip(at, 0, sigma.shape[0] - 1)
        weights = jnp.where(usable[safe] & (at >= 0), belongs[safe], 0)
        by_sigma = soft_lmeds(sigma[safe], weights, temperature)
        by_eps = soft_lmeds(eps[safe], by_sigma.weights, temperature)
        return margin * by_sigma.largest, margin * by_eps.largest

    taught = jax.vmap(one)(sigma, eps, usable, belongs, templates.at)
    out = []
    for i, (y, f) in enumerate(zip(taught, floor, strict=True)):
        if plan.method != "paper":
            y = smooth_minimum(y, cap[i], temperature * cap[i])
        out.append(jnp.where(templates.some, smooth_maximum(y, f, temperature * f), f))
    return Limits(*out)


run_compiled = partial(jax.jit, static_argnames="plan")(run)
