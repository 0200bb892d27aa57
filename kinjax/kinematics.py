"""Where the body is: forward kinematics, and the world poses of joints and of marker clusters.

In: a `Motion` (joint rotations) or markers. Out: world rotations and positions, or `Poses`. The joints are walked by one
`lax.scan` whose parents are data: it compiles once for each number of joints, whatever the skeleton.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .errors import OptionError, ShapeError, find_name
from .motion import Motion, Poses
from .rotations import multiply, rotate


def world_transforms(
    rotations: Float[Array, "joints 4 n"], translations: Float[Array, "joints 3 n"], parents: Int[Array, " joints"]
) -> Float[Array, "joints 7 n"]:
    """World quaternion and position of every joint, components before frames: the kernel under everything here.

    rotations: local. translations: local, metres in the parent's frame. A root's parent is -1.
    """
    joints, _, n = rotations.shape
    identity = jnp.zeros((7, n), rotations.dtype).at[0].set(1)

    def step(world: Float[Array, "joints 7 n"], x: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
        j, parent, q, t = x
        above = jnp.where(parent < 0, identity, jax.lax.dynamic_index_in_dim(world, jnp.maximum(parent, 0), 0, keepdims=False))
        here = jnp.concatenate([multiply(above[:4], q), above[4:] + rotate(above[:4], t)])
        return jax.lax.dynamic_update_index_in_dim(world, here, j, 0), None

    start = jnp.zeros((joints, 7, n), rotations.dtype)
    return jax.lax.scan(step, start, (jnp.arange(joints, dtype=jnp.int32), parents, rotations, translations))[0]


def local_translations(
    offsets: Float[Array, "joints 3"], moving: Float[Array, "frames t 3"], translated: Int[Array, " t"]
) -> Float[Array, "joints 3 frames"]:
    """Local translation of every joint: its offset, or the moving translation where it has one."""
    full = jnp.broadcast_to(offsets[:, :, None], (*offsets.shape, moving.shape[0]))
    return full.at[translated].set(jnp.moveaxis(moving, 0, -1))


@jax.jit
def _forward(rotations: Array, moving: Array, offsets: Array, parents: Array, translated: Array) -> tuple[Array, Array]:
    world = world_transforms(
        jnp.moveaxis(rotations, 0, -1), local_translations(offsets, moving, translated), parents
    )
    world = jnp.moveaxis(world, -1, 0)
    return world[..., :4], world[..., 4:]


def forward_kinematics(motion: Motion) -> tuple[Float[Array, "frames joints 4"], Float[Array, "frames joints 3"]]:
    """World rotation (wxyz) and position (metres) of every joint at every frame.

    Shapes (frames, joints, 4) and (frames, joints, 3) of a motion without batch axes.
    """
    if motion.rotations.ndim != 3:
        raise ShapeError(f"rotations {motion.rotations.shape}: one clip is (frames, joints, 4); vmap for more")
    top = motion.skeleton.topology
    return _forward(
        jnp.asarray(motion.rotations), jnp.asarray(motion.translations), jnp.asarray(motion.skeleton.offsets),
        jnp.asarray(top.parents, jnp.int32), jnp.asarray(top.translated, jnp.int32),
    )


def object_poses(motion: Motion, names: Sequence[str] | None = None, origin: str = "segment") -> Poses:
    """World poses of the named joints (any case; all when None) as objects.

    origin: "segment" puts an object's origin at the centre of the joint's own segment, "joint" at the joint. It is where
    residuals are measured, so it should be in the middle of the body part.
    """
    top = motion.skeleton.topology
    if origin not in ("segment", "joint"):
        raise OptionError(f"origin={origin!r}: choose segment or joint")
    at = [find_name(n, top.names, "joint", motion.name) for n in names] if names is not None else list(range(len(top.names)))
    rotation, position = (np.asarray(x) for x in forward_kinematics(motion))
    rotation, position = rotation[:, at], position[:, at]
    if origin == "segment":
        center = motion.skeleton.segment_centers()[at].astype(position.dtype)
        q = np.moveaxis(rotation, -1, 0)
        position = position + _rotate_numpy(q, center)
    valid = np.isfinite(rotation).all(-1) & np.isfinite(position).all(-1)
    return Poses(rotation, position, valid, motion.rate, tuple(top.names[i] for i in at), motion.name, top.up)


def _rotate_numpy(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate (objects, 3) vectors by (4, frames, objects) quaternions, on the host."""
    u = np.moveaxis(q[1:], 0, -1)
    t = 2 * np.cross(u, np.broadcast_to(v, u.shape))
    return v + q[0][..., None] * t + np.cross(u, t)


def cluster_poses(
    markers: Mapping[str, Float[np.ndarray, "frames markers 3"]],
    rate: float,
    layouts: Mapping[str, Float[np.ndarray, "markers 3"]] | None = None,
    clip: str = "",
    up: str = "z",
) -> Poses:
    """World poses of rigid marker clusters by a batched Kabsch fit; frames with a missing (NaN) marker are masked.

    markers: by object, (frames, markers, 3) world metres, at least three markers not on a line. layouts: the markers in
    the object's own frame; default the frame in which the cluster's shape is nearest its median shape. The object's origin
    is the centroid of its layout.
    """
    rotations, positions, valids = [], [], []
    for name, points in markers.items():
        points = np.asarray(points, float)
        if points.ndim != 3 or points.shape[-1] != 3 or points.shape[1] < 3:
            raise ShapeError(f"markers of {name!r} have shape {points.shape}: (frames, at least 3 markers, 3) is needed")
        seen = np.isfinite(points).all((-1, -2))
        if not seen.any():
            raise ShapeError(f"no frame of {name!r} shows all its markers")
        given = None if layouts is None else layouts.get(name)
        layout = _typical_shape(points[seen]) if given is None else np.asarray(given, float)
        layout = layout - layout.mean(0)
        filled = np.where(seen[:, None, None], points, layout)
        center = filled.mean(1)
        u, s, vt = np.linalg.svd(np.einsum("fmi,mj->fij", filled - center[:, None], layout))
        if s[:, 1].max() < 1e-9:
            raise ShapeError(f"the markers of {name!r} lie on one line: their cluster has no orientation")
        flip = np.ones((len(u), 3))
        flip[:, 2] = np.sign(np.linalg.det(u @ vt))
        rotations.append(quaternions_of((u * flip[:, None]) @ vt))
        positions.append(center)
        valids.append(seen)
    return Poses(
        np.stack(rotations, 1), np.stack(positions, 1), np.stack(valids, 1), rate, tuple(markers), clip, up
    )


def _typical_shape(points: np.ndarray) -> np.ndarray:
    """The frame whose inter-marker distances are nearest their medians over the clip."""
    gaps = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    return points[np.abs(gaps - np.median(gaps, 0)).sum((1, 2)).argmin()]


def quaternions_of(matrices: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 4"]:
    """Unit quaternions (wxyz, w >= 0) of rotation matrices, on the host, by SciPy.

    Matrices that are nearly rotations are taken to the nearest one; mirrored ones, and ones whose `R^T R` is off the
    identity by more than 1e-3, are refused (`ShapeError`).
    """
    from scipy.spatial.transform import Rotation

    flat = np.asarray(matrices, float).reshape(-1, 3, 3)
    off = np.abs(flat.swapaxes(1, 2) @ flat - np.eye(3)).max((1, 2), initial=0.0)
    bad = ~((off <= 1e-3) & (np.linalg.det(flat) > 0))
    if bad.any():
        i = int(bad.argmax())
        raise ShapeError(f"matrix {i} is no rotation: R^T R is {off[i]:.3g} off the identity, its determinant is {np.linalg.det(flat[i]):.4g}")
    q = Rotation.from_matrix(flat).as_quat(canonical=True)
    return q[:, [3, 0, 1, 2]].reshape(*np.shape(matrices)[:-2], 4)
