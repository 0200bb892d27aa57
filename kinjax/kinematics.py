"""Where the body is: forward kinematics, and the world poses of joints and of marker clusters.

In: a `Motion` (joint rotations) or markers. Out: world rotations and positions, or `Poses`. The kernel is `forward`'s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import quaternions
from .errors import OptionError, ShapeError, find_name
from .forward import world_transforms
from .lengths import bucket
from .motion import Motion, Poses


@jax.jit
def _forward(rotations: Array, moving: Array, offsets: Array, parents: Array, translated: Array) -> tuple[Array, Array]:
    rotations, moving = (jnp.moveaxis(x, 0, -1) for x in (rotations, moving))
    world = [x[:-1].T for x in world_transforms(rotations, moving, offsets, parents, translated)]
    return jnp.stack(world[:4], axis=-1), jnp.stack(world[4:], axis=-1)


def forward_kinematics(motion: Motion) -> tuple[Float[Array, "frames joints 4"], Float[Array, "frames joints 3"]]:
    """World rotation (wxyz) and position (metres) of every joint at every frame.

    Shapes (frames, joints, 4) and (frames, joints, 3) of a motion without batch axes. Compiles once for each length: pad
    with `lengths.bucket` where lengths vary. Differentiable to any order, along unit quaternions: the gradient by a
    rotation has no part along the quaternion itself.
    """
    if motion.rotations.ndim != 3:
        raise ShapeError(f"rotations {motion.rotations.shape}: one clip is (frames, joints, 4); vmap for more")
    top = motion.skeleton.topology
    return _forward(
        jnp.asarray(motion.rotations),
        jnp.asarray(motion.translations),
        jnp.asarray(motion.skeleton.offsets),
        jnp.asarray(top.parents, jnp.int32),
        jnp.asarray(top.translated, jnp.int32),
    )


def object_poses(motion: Motion, names: Sequence[str] | None = None, origin: str = "segment") -> Poses:
    """World poses of the named joints (any case; all when None) as objects.

    origin: "segment" puts an object's origin at the centre of the joint's own segment, "joint" at the joint. It is where
    residuals are measured, so it should be in the middle of the body part.
    """
    top = motion.skeleton.topology
    if origin not in ("segment", "joint"):
        raise OptionError(f"origin={origin!r}: choose segment or joint")
    at = (
        [find_name(n, top.names, "joint", motion.name) for n in names]
        if names is not None
        else list(range(len(top.names)))
    )
    rotation, position = _forward_padded(motion)
    rotation, position = rotation[:, at], position[:, at]
    if origin == "segment":
        center = motion.skeleton.segment_centers()[at].astype(position.dtype)
        position = position + quaternions.rotate(rotation, center)
    valid = np.isfinite(rotation).all(-1) & np.isfinite(position).all(-1)
    return Poses(rotation, position, valid, motion.rate, tuple(top.names[i] for i in at), motion.name, top.up)


def _forward_padded(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """`forward_kinematics` on the host: padded to a bucket, and taken from the roots' first place, so that float32 is as
    good far from the origin; positions come back in float64."""
    top, frames = motion.skeleton.topology, motion.frames
    q, t = np.asarray(motion.rotations), np.array(motion.translations, float)
    roots = [k for k, j in enumerate(top.translated) if top.parents[j] < 0]
    finite = np.isfinite(t).all((1, 2))
    away = t[finite.argmax(), roots[0]].copy() if roots and finite.any() else np.zeros(3)
    t[:, roots] -= away
    more = bucket(frames) - frames
    padded = replace(
        motion,
        rotations=np.concatenate([q, np.broadcast_to([1.0, 0, 0, 0], (more, *q.shape[1:]))]),
        translations=np.concatenate([t, np.zeros((more, *t.shape[1:]))]),
    )
    rotation, position = forward_kinematics(padded)
    # each root carries its own tree; a root without a moving translation was not shifted
    tree = [j if p < 0 else -1 for j, p in enumerate(top.parents)]
    for j, p in enumerate(top.parents):
        tree[j] = j if p < 0 else tree[p]
    shifted = {top.translated[k] for k in roots}
    back = np.array([[1.0 if r in shifted else 0.0] for r in tree]) * away
    return np.asarray(rotation)[:frames], np.asarray(position, float)[:frames] + back


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
            raise ShapeError(
                f"markers of {name!r} have shape {points.shape}: (frames, at least 3 markers, 3) is needed"
            )
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
    return Poses(np.stack(rotations, 1), np.stack(positions, 1), np.stack(valids, 1), rate, tuple(markers), clip, up)


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
    near = off <= 1e-3
    good = near & (np.linalg.det(np.where(near[:, None, None], flat, np.eye(3))) > 0)
    if not good.all():
        i = int(good.argmin())
        why = "it mirrors" if near[i] else f"R^T R is {off[i]:.3g} off the identity"
        raise ShapeError(f"matrix {i} is no rotation: {why}")
    q = Rotation.from_matrix(flat).as_quat(canonical=True)
    return q[:, [3, 0, 1, 2]].reshape(*np.shape(matrices)[:-2], 4)
