"""One clip, the ways in which it is carried off and spoilt, and its signals as the pipeline prepares them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from kinjax.detect.displacements import displacements
from kinjax.detect.instantaneous import instantaneous
from kinjax.detect.prepare import prepared
from kinjax.detect.settings import Settings
from kinjax.detect.sigma_epsilon import SigmaEpsilon, project
from kinjax.motion import Poses, make_poses
from kinjax.rotations import normalize
from kinjax.synthetic import rolling_foot, with_noise

from .screws import multiplied


@cache
def foot() -> Poses:
    """A rolling foot of 231 frames at 60 Hz with 0.5 mm of marker noise."""
    return with_noise(rolling_foot(rate=60.0), 0.0005).poses


LIMITS = (4e-3, 2e-3)
"""Thresholds of one interval that split that clip: radians, metres."""


@jax.jit
def signals_of(q: jax.Array, t: jax.Array, valid: jax.Array) -> tuple[SigmaEpsilon, jax.Array]:
    """Sigma-epsilon points and labels, (objects, frames - 1), of poses with components first."""
    x = displacements(normalize(q), t, valid, 1)
    y = project(x)
    limits = tuple(jnp.full_like(y.sigma_3, v) for v in LIMITS)
    return y, instantaneous(*y[:4], x.valid, limits, limits, jnp.asarray(1e-3, q.dtype))


def signals(poses: Poses, dtype: str = "float64") -> tuple[SigmaEpsilon, np.ndarray]:
    """Steps 1 to 3 and 5 of a clip as the pipeline prepares it: padded, positions taken from a place near the object."""
    with jax.enable_x64(dtype == "float64"):
        clip = prepared(poses, None, None, Settings())
        y, kind = signals_of(*map(jnp.asarray, clip.arrays))
    cut = slice(0, clip.frames - 1)
    return SigmaEpsilon(*(np.asarray(x)[..., cut] for x in y)), np.asarray(kind)[..., cut]


def moved(poses: Poses, shift: float, seed: int = 0) -> Poses:
    """The clip turned at random and carried `shift` metres away."""
    turn = Rotation.random(random_state=seed)
    way = Rotation.random(random_state=seed + 1).apply([shift, 0, 0])
    q, t = np.asarray(poses.rotation), np.asarray(poses.position)
    first = np.broadcast_to(turn.as_quat()[[3, 0, 1, 2]], (q.size // 4, 4))
    return replace(
        poses, rotation=multiplied(first, q.reshape(-1, 4)).reshape(q.shape),
        position=turn.apply(t.reshape(-1, 3)).reshape(t.shape) + way,
    )  # fmt: skip


def spoilt(poses: Poses, seed: int = 9) -> Poses:
    """Signs of quaternions at random, lengths off by up to 1e-3."""
    rng = np.random.default_rng(seed)
    shape = (poses.frames, poses.objects, 1)
    scale = rng.choice([-1.0, 1.0], shape) * (1 + rng.uniform(-9.9e-4, 9.9e-4, shape))
    return make_poses(poses.names, np.asarray(poses.rotation) * scale, poses.position, poses.rate)
