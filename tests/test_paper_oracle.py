"""`method="paper"` against the NumPy baseline: two implementations of one page, asked for the same labels."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import numpy_baseline as nb
from kinjax.annotations import Template
from kinjax.detect import detect
from kinjax.motion import make_poses

THRESHOLDS = (2e-3, 1e-3)


def clip(seed: int, frames: int = 240, noise: float = 2e-4, lost: float = 0.0):
    """A body that rests, turns about axes, tumbles about a point and drifts, with noise and lost frames."""
    rng = np.random.default_rng(seed)
    turn, place = Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=3)
    rotations, positions = [], []
    while len(rotations) < frames:
        kind, n = rng.integers(4), int(rng.integers(6, 40))
        pivot, axis = rng.normal(size=3) * 0.2, rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        center = turn.apply(pivot) + place
        for _ in range(n):
            if kind == 1:
                step = Rotation.from_rotvec(axis * 0.06)
            elif kind == 2:
                axis = Rotation.from_rotvec(rng.normal(size=3) * 0.3).apply(axis)
                step = Rotation.from_rotvec(axis * 0.08)
            elif kind == 3:
                step, center = Rotation.from_rotvec(rng.normal(size=3) * 0.05), center + rng.normal(size=3) * 0.02
            else:
                step = Rotation.identity()
            turn = step * turn
            place = center - turn.apply(pivot)
            rotations.append(turn)
            positions.append(place.copy())
    matrices = Rotation.concatenate(rotations[:frames])
    jitter = Rotation.from_rotvec(rng.normal(size=(frames, 3)) * noise)
    t = np.array(positions[:frames]) + rng.normal(size=(frames, 3)) * noise
    valid = rng.random(frames) >= lost
    return (jitter * matrices), t, valid


def poses_of(rotation, t, valid, rate=50.0):
    q = rotation.as_quat()[:, [3, 0, 1, 2]]
    q = np.where(valid[:, None], q, np.nan)
    return make_poses(["body"], q[:, None], t[:, None], rate)


def same(found, expected, labels):
    """Labels equal; constraints equal in type and frames, and where they are."""
    np.testing.assert_array_equal(np.asarray(found.passed[:, 0]), labels)
    mine = [(c.type, c.begin, c.end) for c in found.constraints]
    theirs = sorted([(c.type, c.begin, c.end) for c in expected], key=lambda c: (c[1], c[2]))
    assert mine == theirs
    for a, b in zip(found.constraints, sorted(expected, key=lambda c: (c.begin, c.end)), strict=True):
        assert abs(a.residual - b.residual) < 1e-7
        if b.type == "point" and b.end - b.begin < 4:
            continue  # a pivot seen for three frames is hardly determined
        np.testing.assert_allclose(a.position, b.position, atol=1e-6)
        if b.type == "line":
            assert abs(abs(np.dot(a.axis, b.axis)) - 1) < 1e-9


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("types", [("space",), ("space", "line", "point"), ("line",)], ids="+".join)
def test_same_labels_with_thresholds(x64, seed, types):
    rotation, t, valid = clip(seed, lost=0.05 if seed % 3 == 0 else 0.0)
    poses = poses_of(rotation, t, valid)
    found = detect(poses, method="paper", types=types, thresholds=THRESHOLDS)
    expected = nb.detect(
        rotation.as_matrix(),
        t,
        rate=50.0,
        types=types,
        valid=valid,
        vectorised=True,
        thresholds={k: THRESHOLDS for k in types},
    )
    labels = np.where(expected.valid, expected.label, 0)
    same(found, expected.constraints, labels)


@pytest.mark.parametrize(
    ("seed", "count", "estimator", "interpolation"),
    [
        (0, 1, "lmeds", "cubic"), (1, 1, "lmeds", "cubic"), (2, 1, "naive", "cubic"), (3, 4, "lmeds", "monotone"),
        (4, 4, "lmeds", "cubic"), (5, 3, "lmeds", "cubic"), (6, 2, "naive", "cubic"),
    ],
)  # fmt: skip
def test_same_labels_with_templates(x64, seed, count, estimator, interpolation):
    rotation, t, valid = clip(seed + 100, noise=5e-4)
    poses = poses_of(rotation, t, valid)
    spans = [(5, 30), (30, 50), (90, 121), (180, 200)][:count]
    found = detect(
        poses,
        method="paper",
        estimator=estimator,
        interpolation=interpolation,
        templates=[Template("body", b, e) for b, e in reversed(spans)],
    )
    expected = nb.detect(
        rotation.as_matrix(),
        t,
        rate=50.0,
        types=("space",),
        templates=[("space", b, e) for b, e in spans],
        estimator=estimator,
        interpolation=interpolation,
        vectorised=True,
    )
    np.testing.assert_allclose(found.sigma_max["space"][:, 0], expected.sigma_max["space"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.eps_max["space"][:, 0], expected.eps_max["space"], rtol=1e-9, atol=1e-12)
    near = np.abs(expected.sigma3 - expected.sigma_max["space"]) < 1e-9 * expected.sigma3
    near |= np.abs(expected.eps3 - expected.eps_max["space"]) < 1e-9 * expected.eps3
    differ = np.asarray(found.passed[:, 0]) != expected.label
    assert not (differ & ~near).any()  # an interval may sit on its own threshold to the last bit
    if not differ.any():
        same(found, expected.constraints, expected.label)


@pytest.mark.parametrize(
    ("formulation", "projection", "stride"),
    [("local", "svd", 1), ("global", "closed", 1), ("global", "svd", 3), ("local", "closed", 3)],
)
def test_projection_routes_and_formulations_agree(x64, formulation, projection, stride):
    rotation, t, valid = clip(7)
    found = detect(
        poses_of(rotation, t, valid),
        method="paper",
        thresholds=THRESHOLDS,
        types=("space", "line", "point"),
        formulation=formulation,
        projection=projection,
        stride=stride,
    )
    expected = nb.detect(
        rotation.as_matrix(),
        t,
        rate=50.0,
        types=("space", "line", "point"),
        formulation=formulation,
        stride=stride,
        thresholds={k: THRESHOLDS for k in ("space", "line", "point")},
        vectorised=True,
    )
    n = len(found.middle)
    for mine, theirs in (("sigma_3", "sigma3"), ("eps_3", "eps3"), ("eps_1", "eps1")):
        np.testing.assert_allclose(getattr(found, mine)[:, 0], getattr(expected, theirs)[:n], atol=1e-10, err_msg=mine)
    np.testing.assert_array_equal(found.passed[:, 0], expected.label[:n])


def test_minimal_thresholds_in_float32():
    rotation, t, valid = clip(3, noise=0.0)
    found = detect(poses_of(rotation, t, valid), method="paper", thresholds=(1e-4, 1e-4))
    expected = nb.detect(
        rotation.as_matrix(), t, rate=50.0, types=("space",), thresholds={"space": (1e-4, 1e-4)}, vectorised=True
    )
    assert [(c.begin, c.end) for c in found.constraints] == [(c.begin, c.end) for c in expected.constraints]
    assert found.sigma_3.dtype == np.float32 and not jax.config.jax_enable_x64
