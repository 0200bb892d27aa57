"""What the tests of deformation share: a figure, random problems for one frame, and the solver over many of them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from kinjax.deform.chain import Chain, Pose, forward
from kinjax.deform.frame_solver import Reference, Solving, solve_frame
from kinjax.deform.tasks import Goals, Kinds, Tasks
from kinjax.motion import Motion
from kinjax.skeleton import Skeleton, Topology

# a figure of 16 joints, 1.7 m: hips, two legs, spine, head, two arms; z up
NAMES = (
    "Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot", "Spine", "Neck", "Head",
    "LeftArm", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm", "RightHand",
)  # fmt: skip
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 7, 10, 11, 7, 13, 14)
OFFSETS = np.array(
    [
        [0, 0, 0.92], [0, 0.09, -0.05], [0, 0, -0.42], [0, 0, -0.42], [0, -0.09, -0.05], [0, 0, -0.42], [0, 0, -0.42],
        [0, 0, 0.25], [0, 0, 0.25], [0, 0, 0.12], [0, 0.18, 0.2], [0, 0.28, 0], [0, 0.26, 0], [0, -0.18, 0.2],
        [0, -0.28, 0], [0, -0.26, 0],
    ]
)  # fmt: skip
ENDS = tuple(NAMES.index(n) for n in ("LeftFoot", "RightFoot", "LeftHand", "RightHand", "Head"))
FIGURE = Skeleton(OFFSETS, np.zeros((0, 3)), Topology(NAMES, PARENTS, up="z"))


def quaternions(v: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of rotation vectors (..., 3)."""
    a = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.cos(a / 2), np.sinc(a / 2 / np.pi) / 2 * v], axis=-1)


def standing(frames: int, rate: float = 60.0, at: tuple = (0, 0, 0), sway: float = 0.0) -> Motion:
    """The figure stands with knees and elbows bent; with `sway`, every joint moves smoothly by so many radians."""
    v = np.zeros((frames, len(NAMES), 3))
    for name, angle in {"UpLeg": -0.3, "Leg": 0.6, "Foot": -0.3}.items():
        for side in ("Left", "Right"):
            v[:, NAMES.index(side + name), 1] = angle
    for side, sign in (("Left", -1.0), ("Right", 1.0)):
        v[:, NAMES.index(side + "Arm"), 0] = sign
        v[:, NAMES.index(side + "ForeArm"), 2] = sign * 0.6
    phase = np.arange(frames)[:, None, None] / rate * 2 * np.pi * 0.5 + np.arange(len(NAMES))[:, None] + np.arange(3)
    v += sway * np.sin(phase)
    root = OFFSETS[0] + np.asarray(at, float) + sway * 0.1 * np.sin(phase[:, 0])
    return Motion(root[:, None], quaternions(v), FIGURE, rate, name="figure")


def chain() -> Chain:
    """The whole figure, unpruned."""
    p = len(PARENTS)
    above = np.zeros((p, p))
    for i in range(p):
        j = i
        while j >= 0:
            above[i, j] = 1
            j = PARENTS[j]
    return Chain(jnp.asarray(PARENTS, jnp.int32), jnp.asarray(above))


class Problems(NamedTuple):
    """Random reach problems, one a row: start pose, effectors, targets, layers, axes, whether the root may move, how many
    layers there are."""

    rotations: np.ndarray
    root: np.ndarray
    joint: np.ndarray
    target: np.ndarray
    layer: np.ndarray
    scale: np.ndarray
    free: np.ndarray
    layers: np.ndarray


def problems(count: int, rng: np.random.Generator, tasks: int = 5) -> Problems:
    """Poses and targets at random: targets of another pose, a third of them moved up to three times as far away."""
    p = len(PARENTS)
    start = np.moveaxis(quaternions(rng.normal(size=(count, p, 3)) * 0.4), 2, 1)
    other = np.moveaxis(quaternions(rng.normal(size=(count, p, 3)) * 0.4), 2, 1)
    root = np.tile(OFFSETS[0], (count, 1))
    away = root + rng.normal(size=(count, 3)) * 0.2
    place = jax.jit(
        jax.vmap(lambda q, r: forward(chain(), Pose(q[..., None], r[:, None]), jnp.asarray(OFFSETS))[:, :, 3, 0])
    )
    world = np.asarray(place(jnp.asarray(other), jnp.asarray(away)))
    joint = np.stack([rng.choice(ENDS, tasks, replace=rng.random() < 0.3) for _ in range(count)])
    target = np.take_along_axis(world, joint[..., None], axis=1)
    far = rng.random((count, tasks, 1)) < 0.3
    target = np.where(far, root[:, None] + (target - root[:, None]) * rng.uniform(1.3, 3, (count, tasks, 1)), target)
    layers = rng.integers(2, tasks + 1, count)
    layer = np.stack([np.sort(np.concatenate([np.arange(n), rng.integers(0, n, tasks - n)])) for n in layers])
    scale = np.where(rng.random((count, tasks, 1)) < 0.2, rng.random((count, tasks, 3)) < 0.5, True).astype(float)
    free = (rng.random(count) < 0.6).astype(float)
    return Problems(start, root, joint.astype(np.int32), target, layer.astype(np.int32), scale, free, layers)


def solve(one: Problems, depth, solving: Solving, layers: int = 5):
    """A problem of position constraints, of which the first `depth` layers are asked."""
    figure, b, p = chain(), one.joint.shape[0], len(PARENTS)
    dtype = one.target.dtype
    empty = jnp.zeros((0, p, 0), dtype)
    tasks = Tasks(
        jnp.zeros(b, jnp.int32), one.joint, jnp.full(b, p, jnp.int32), jnp.zeros((b, 3), dtype),
        jnp.tile(jnp.asarray([0, 0, 1], dtype), (b, 1)), one.scale, one.layer, jnp.ones((b, p), dtype),
        jnp.full(b, one.free), figure.above.astype(dtype)[one.joint], jnp.zeros((b, p), dtype),
        jnp.zeros(0, jnp.int32), jnp.zeros(0, jnp.int32), empty[:, 0], empty,
    )  # fmt: skip
    goals = Goals(
        one.target, jnp.tile(jnp.asarray([1, 0, 0, 0], dtype), (b, 1)), (one.layer < depth).astype(dtype),
        jnp.zeros((0, 3), dtype), jnp.ones((), dtype),
    )  # fmt: skip
    reference = Reference(one.rotations, one.root, jnp.ones(p, dtype), one.free)
    start = Pose(one.rotations[..., None], one.root[:, None])
    figure = Chain(figure.parents, figure.above.astype(dtype))
    return solve_frame(
        figure, tasks, goals, start, jnp.asarray(OFFSETS, dtype), reference, layers, solving, Kinds(),
        jnp.ones(layers, dtype), jnp.ones((), dtype),
    )  # fmt: skip
