"""Screw displacements with known sigma-epsilon values, and the engine's answers to them, in one call each.

In: a number of axes. Out: NumPy arrays. The truth is in closed form and shares nothing with the package: quaternion
products, matrices and Rodrigues' formula are written out here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from kinjax.detect.displacements import Displacement, displacements
from kinjax.detect.sigma_epsilon import SigmaEpsilon, project, project_by_svd
from kinjax.kinematics import quaternions_of
from kinjax.rotations import normalize

ANGLES = np.array([1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi])


@dataclass(frozen=True)
class Screws:
    """Screw displacements (n of them) about axes `lever` away from the object's origin, and what is true of them.

    `q0, q1` (n, 4) world rotations before and after, `t0, t1` (n, 3) world positions 1 m from the world's origin, `d` the
    exact translation.
    """

    angle: np.ndarray
    axis: np.ndarray
    slide: np.ndarray
    lever: np.ndarray
    q0: np.ndarray
    q1: np.ndarray
    t0: np.ndarray
    t1: np.ndarray

    @property
    def sigma_3(self) -> np.ndarray:
        """`2 sin(theta/2)`."""
        return 2 * np.sin(self.angle / 2)

    @property
    def d(self) -> np.ndarray:
        """Translation of the object's origin: `(I - R) lever + slide axis`, by Rodrigues' formula, without cancellation."""
        s, c = np.sin(self.angle)[:, None], 2 * np.sin(self.angle / 2)[:, None] ** 2
        return -s * np.cross(self.axis, self.lever) + c * self.lever + self.slide[:, None] * self.axis

    @property
    def quaternion(self) -> np.ndarray:
        """The displacement's own quaternion (n, 4)."""
        return np.concatenate([np.cos(self.angle / 2)[:, None], np.sin(self.angle / 2)[:, None] * self.axis], 1)


def screws(axes: int, seed: int = 0, angles: np.ndarray = ANGLES, slide: float = 0.05, lever: float = 0.3) -> Screws:
    """`axes` random axes at each angle; levers across the axis, slides within `+-slide`."""
    rng = np.random.default_rng(seed)
    n = axes * len(angles)
    axis = unit(rng.normal(size=(n, 3)))
    r = lever * unit(np.cross(axis, rng.normal(size=(n, 3))))
    t0, q0 = unit(rng.normal(size=(n, 3))), unit(rng.normal(size=(n, 4)))
    s = Screws(np.repeat(angles, axes), axis, rng.uniform(-slide, slide, n), r, q0, q0, t0, t0)
    return replace(s, q1=multiplied(s.quaternion, q0), t1=t0 + s.d)


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton products of (n, 4) quaternions, in NumPy."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdims=True)
    return np.concatenate([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])], 1)


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4), in NumPy."""
    w, v = q[:, 0], q[:, 1:]
    hat = np.zeros((len(q), 3, 3))
    hat[:, 2, 1], hat[:, 0, 2], hat[:, 1, 0] = v.T
    hat -= hat.transpose(0, 2, 1)
    return np.eye(3) + 2 * w[:, None, None] * hat + 2 * hat @ hat


@cache
def _jitted(by: str) -> Callable[[Displacement], SigmaEpsilon]:
    return jax.jit({"closed": project, "svd": project_by_svd}[by])


@jax.jit
def _from_poses(q0: jax.Array, t0: jax.Array, q1: jax.Array, t1: jax.Array) -> SigmaEpsilon:
    q, t = jnp.stack([normalize(q0), normalize(q1)], -1), jnp.stack([t0, t1], -1)
    y = project(displacements(q, t, jnp.ones(t.shape[1:], bool), 1))
    return SigmaEpsilon(*(x[..., 0] for x in y))


def projected(q: np.ndarray, d: np.ndarray, by: str = "closed", dtype: str = "float64") -> SigmaEpsilon:
    """Displacements given directly: quaternions (n, 4) and translations (n, 3). Components of the result come first."""
    with jax.enable_x64(dtype == "float64"):
        x = jnp.asarray(_filled(q, d, 2048).T, dtype)
        y = _jitted(by)(Displacement(x[1:4], x[0], x[4:], jnp.ones(x.shape[1:], bool)))
        return SigmaEpsilon(*(np.asarray(v)[..., : len(q)] for v in y))


def projected_from_poses(s: Screws, dtype: str = "float64", by_matrix: bool = False) -> SigmaEpsilon:
    """The same from world poses rounded to `dtype`, through `displacements`; `by_matrix`: rotations come as matrices."""
    turn = lambda q: quaternions_of(matrices(q).astype(dtype)) if by_matrix else q  # noqa: E731
    with jax.enable_x64(dtype == "float64"):
        return SigmaEpsilon(*map(np.asarray, _from_poses(*(jnp.asarray(x.T, dtype) for x in (turn(s.q0), s.t0, turn(s.q1), s.t1)))))


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle of two sets of unit vectors (n, 3), up to sign, exact for small ones."""
    return np.arcsin(np.minimum(np.linalg.norm(np.cross(a, b), axis=-1), 1))


def gradients(q: np.ndarray, d: np.ndarray, dtype: str = "float64") -> np.ndarray:
    """Derivatives (n, 9, 7) of `sigma_3, eps_3, eps_1, point, axis` by quaternion and translation, in reverse mode."""
    with jax.enable_x64(dtype == "float64"):
        return np.asarray(_jacobian(jnp.asarray(_filled(q, d, 64), dtype)))[: len(q)]


def _filled(q: np.ndarray, d: np.ndarray, block: int) -> np.ndarray:
    """Quaternions and translations side by side (m, 7), rest added up to a whole number of blocks: few shapes to compile."""
    rest = np.zeros((-len(q) % block, 7))
    rest[:, 0] = 1
    return np.concatenate([np.concatenate([q, d], 1), rest])


def nine(x: jax.Array) -> jax.Array:
    """`sigma_3, eps_3, eps_1, point, axis` (9,) of one displacement, quaternion and translation (7,)."""
    y = project(Displacement(x[1:4], x[0], x[4:], jnp.ones((), bool)))
    return jnp.concatenate([jnp.stack([y.sigma_3, y.eps_3, y.eps_1]), y.point, y.axis])


_jacobian = jax.jit(jax.vmap(jax.jacrev(nine)))
