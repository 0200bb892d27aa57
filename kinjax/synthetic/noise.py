"""What recordings do to a clean scene: marker noise, spikes, gaps. The truth stays what it was.

In: a `Scene`. Out: another one, deterministic by seed; objects draw from streams of their own. Noise enters where it
enters in reality, at the markers, and the poses are fitted anew. Calls may follow each other in any order, each with
its own seed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..errors import OptionError
from ..motion import Motion
from .biped import local_rotations
from .scene import Scene, box_markers
from .spatial import kabsch, quat_exp, quat_mul, unroll

_CLUSTER = box_markers((0.1, 0.1, 0.1))  # that a joint of a noisy motion is thought to carry
_ISOLATED = 3  # frames from one spike to the next, at least


def with_noise(scene: Scene, sigma: float = 0.001, seed: int = 0) -> Scene:
    """White Gaussian noise of `sigma` metres on every marker coordinate; poses refitted by `kabsch`.

    With `n` markers, centroid at the origin, positions then err by `sigma / sqrt(n)` a coordinate and rotations by
    `rotation_noise(layout, sigma)`. A motion, where there is one, gets noise of its own: see `noisy_motion`.
    """
    _check(sigma >= 0, f"sigma is {sigma}: it must be zero or more (metres)")
    markers = {}
    for i, (name, clean) in enumerate(scene.markers.items()):
        markers[name] = clean + np.random.default_rng([seed, i, 1]).normal(0.0, 1.0, clean.shape) * sigma
    motion = None if scene.motion is None else noisy_motion(scene.motion, sigma, seed)
    return replace(_refit(scene, markers), motion=motion)


def rotation_noise(layout: np.ndarray, sigma: float) -> np.ndarray:
    """Covariance (3, 3), rad^2, of the error of a pose's rotation about the body's axes, to first order.

    layout: marker coordinates (markers, 3), metres. It is `sigma^2` times the inverse of `sum(|x|^2 I - x x^T)` about
    the centroid: for a box with half edges `a` and eight markers, a deviation of `sigma / (4 a)` about each axis.
    """
    x = layout - layout.mean(0)
    return sigma**2 * np.linalg.inv(np.sum(x**2) * np.eye(3) - x.T @ x)


def noisy_motion(motion: Motion, sigma: float = 0.001, seed: int = 0) -> Motion:
    """A motion as solved from noisy markers: each joint's world rotation and the roots' translations err.

    Each joint errs as if it carried eight markers at the corners of a box of 0.2 m: `sigma / 0.4 m` radians about
    each axis, `sigma / sqrt(8)` for translations. Bones keep their lengths, so a foot errs by all the joints above
    it, and more than the `poses` of `with_noise`, which a cluster of its own carries.
    """
    _check(sigma >= 0, f"sigma is {sigma}: it must be zero or more (metres)")
    rng = np.random.default_rng([seed, 0, 2])
    parents, world = motion.skeleton.topology.parents, np.array(motion.rotations, float)
    for j, p in enumerate(parents):
        if p >= 0:
            world[..., j, :] = quat_mul(world[..., p, :], world[..., j, :])
    turn = float(np.sqrt(rotation_noise(_CLUSTER, sigma)[0, 0]))
    world = quat_mul(world, quat_exp(rng.normal(0.0, 1.0, (*world.shape[:-1], 3)) * turn))
    shift = rng.normal(0.0, 1.0, np.shape(motion.translations)) * sigma / np.sqrt(len(_CLUSTER))
    local = local_rotations(world, parents)
    return replace(motion, translations=np.asarray(motion.translations) + shift, rotations=local)


def with_outliers(scene: Scene, fraction: float = 0.02, size: float = 0.03, seed: int = 0) -> Scene:
    """Spikes: isolated frames of each object, `fraction` of them, moved by `size` metres in a random direction.

    Spikes are at least three frames apart. Markers and poses move together; a motion stays as it was.
    """
    _check(0 <= fraction <= 0.1, f"fraction is {fraction}: it must lie between 0 and 0.1, for spikes to be isolated")
    markers = {}
    for i, (name, clean) in enumerate(scene.markers.items()):
        rng = np.random.default_rng([seed, i, 3])
        free, hit = np.ones(len(clean), bool), list[int]()
        for frame in rng.permutation(len(clean)):
            if len(hit) >= round(fraction * len(clean)):
                break
            if free[frame]:
                hit.append(int(frame))
                free[max(0, frame - _ISOLATED + 1) : frame + _ISOLATED] = False
        way = rng.normal(size=(len(hit), 3))
        markers[name] = clean.copy()
        markers[name][hit] += size * (way / np.linalg.norm(way, axis=-1, keepdims=True))[:, None]
    moved = {n: (markers[n] - scene.markers[n])[:, 0] for n in markers}
    position = np.array(scene.poses.position, float)
    for n, shift in moved.items():
        position[:, scene.poses.index(n)] += np.where(np.isfinite(shift), shift, 0.0)
    return replace(scene, markers=markers, poses=replace(scene.poses, position=position))


def with_gaps(
    scene: Scene,
    fraction: float = 0.1,
    seconds: float = 0.1,
    seed: int = 0,
    spans: Iterable[tuple[str, int, int]] | None = None,
) -> Scene:
    """Lost frames: NaN in poses and markers, False in `poses.valid`; a motion stays as it was.

    spans: (object, first frame, last frame), both included. Without it, each object loses gaps of `seconds` at random
    places until `fraction` of its frames are gone.
    """
    _check(0 <= fraction <= 0.9, f"fraction is {fraction}: it must lie between 0 and 0.9")
    lost = np.zeros((scene.frames, scene.poses.objects), bool)
    if spans is not None:
        for name, begin, end in spans:
            inside = 0 <= begin <= end < scene.frames
            _check(inside, f"frames {begin}..{end} are not inside the clip's 0..{scene.frames - 1}")
            lost[begin : end + 1, scene.poses.index(name)] = True
    else:
        length = min(scene.frames, max(1, round(seconds * scene.rate)))
        for i in range(scene.poses.objects):
            rng = np.random.default_rng([seed, i, 4])
            while (left := round(fraction * scene.frames) - int(lost[:, i].sum())) > 0:
                begin = int(rng.integers(0, scene.frames - min(length, left) + 1))
                lost[begin : begin + min(length, left), i] = True
    poses = scene.poses
    gone = lost[..., None]
    poses = replace(
        poses,
        rotation=np.where(gone, np.nan, poses.rotation),
        position=np.where(gone, np.nan, poses.position),
        valid=np.asarray(poses.valid) & ~lost,
    )
    markers = {n: np.where(lost[:, poses.index(n), None, None], np.nan, x) for n, x in scene.markers.items()}
    return replace(scene, poses=poses, markers=markers)


def _refit(scene: Scene, markers: dict[str, np.ndarray]) -> Scene:
    """The scene with these markers and the poses that fit them."""
    fits = [kabsch(scene.marker_layout[n], markers[n]) for n in scene.poses.names]
    rotation, position = (np.stack(x, 1) for x in zip(*fits, strict=True))
    valid = np.asarray(scene.poses.valid) & np.isfinite(position).all(-1)
    poses = replace(scene.poses, rotation=unroll(rotation), position=position, valid=valid)
    return replace(scene, markers=markers, poses=poses)


def _check(ok: bool, message: str) -> None:
    if not ok:
        raise OptionError(message)
