"""Rows N: rounding, degenerate displacements, and what must not change an answer.

In: `full` or fewer cases. Out: rows. Metres and radians; `full` adds the figures that compile the whole engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from kinjax.detect import detect
from kinjax.detect.instantaneous import instantaneous
from kinjax.detect.pipeline import detect_many
from kinjax.detect.prepare import prepared
from kinjax.detect.settings import Settings
from kinjax.errors import ShapeError
from kinjax.formats.euler import euler_to_quaternion, quaternion_to_euler, rotation_between
from kinjax.kinematics import quaternions_of
from kinjax.motion import make_poses

from .clips import LIMITS, foot, moved, signals, signals_of, spoilt
from .lmeds_sets import kept
from .screws import angle_between, gradients, matrices, projected, projected_from_poses, screws, unit
from .table import Row

EPS64, EPS32 = float(np.finfo(np.float64).eps), float(np.finfo(np.float32).eps)
WHOLE = Settings(method="paper", thresholds=LIMITS, types=("space", "line"))
"""The detection that the figures of the whole engine run."""


def _many(full: bool) -> int:
    """Axes at each angle."""
    return 2000 if full else 100


def n1(full: bool = True) -> Iterator[Row]:
    """Singular values of displacements given directly."""
    s = screws(_many(full))
    fed = f"{len(s.angle)} screws, angle 1e-7..pi, given directly"
    for by in ("closed", "svd"):
        y = projected(s.quaternion, s.d, by)
        yield Row("N1", fed, f"sigma_3 ({by}), error / eps64", np.abs(y.sigma_3 - s.sigma_3).max() / EPS64, 32)
        yield Row("N1", fed, f"sigma_1 ({by}) / eps64", np.abs(y.sigma_1).max() / EPS64, 32)
    small = s.angle == 1e-7
    relative = np.abs(projected(s.quaternion[small], s.d[small]).sigma_3 / s.sigma_3[small] - 1)
    yield Row("N1", "angle 1e-7", "sigma_3 (closed), relative error / eps64", relative.max() / EPS64, 8)


def n2(full: bool = True) -> Iterator[Row]:
    """Singular values from world poses in float32."""
    s = screws(_many(full), 1)
    for by_matrix, what in ((True, "matrices"), (False, "quaternions")):
        error = np.abs(projected_from_poses(s, "float32", by_matrix).sigma_3 - s.sigma_3).max()
        yield Row("N2", f"{len(s.angle)} screws, float32 world {what}", "sigma_3, error / eps32", error / EPS32, 8)


def n3(full: bool = True) -> Iterator[Row]:
    """Residuals, slide known, 1 m from the world's origin."""
    s = screws(_many(full), 2)
    fed = "slide to 5 cm, lever 30 cm, 1 m from the origin"
    for dtype, bar, least in (("float64", 1e-14, 1e-5), ("float32", 1e-6, 1e-4)):
        y = projected_from_poses(s, dtype)
        yield Row("N3", f"{fed}, {dtype}", "eps_3, error in m", np.abs(y.eps_3 - np.linalg.norm(s.d, axis=1)).max(), bar)
        error = np.abs(y.eps_1 - np.abs(s.slide))[s.angle >= least]
        yield Row("N3", f"the same, angle >= {least:g}", "eps_1, error in m", error.max(), bar)
    error = np.abs(projected(s.quaternion, s.d, dtype="float32").eps_1 - np.abs(s.slide))[s.angle >= 1e-5]
    yield Row("N3", "the same given directly, float32, angle >= 1e-5", "eps_1, error in m", error.max(), 1e-6)


def n4(full: bool = True) -> Iterator[Row]:
    """The fixed point, 30 cm away: its error grows as 1 / angle; below `axis_min` no line is read."""
    s = screws(_many(full), 3, slide=0.0)
    for dtype, bar, least in (("float64", 1e-11, 0), ("float32", 5e-6, 1e-4)):
        y = projected_from_poses(s, dtype)
        error = (np.linalg.norm(y.point.T - s.lever, axis=1) * s.angle)[s.angle >= least]
        yield Row("N4", f"point 30 cm away, {dtype}, angle >= {least:g}", "error times angle, m rad", error.max(), bar)
    y = projected_from_poses(s, "float32")
    wide, narrow = (np.full_like(y.sigma_3, v) for v in (1.0, 1e-7))
    yes = np.ones(s.angle.shape, bool)
    arrays = [jnp.asarray(x) for x in (*y[:4], yes, narrow, wide, np.float32(Settings().axis_min))]
    line = np.asarray(instantaneous(*arrays[:5], None, (arrays[5], arrays[6]), arrays[7])) > 0
    yield Row("N4", "the same, angle <= 1e-4, eps ignored", "lines read, ill-conditioned", line[s.angle <= 1e-4].sum(), 0)
    yield Row("N4", "the same, angle >= 1e-2", "lines read, share", line[(s.angle >= 1e-2) & (s.angle < np.pi)].mean(), 1, True)


def n5(full: bool = True) -> Iterator[Row]:
    """Half turns: basis axes, random axes (all symmetric rotation matrices)."""
    rng = np.random.default_rng(5)
    axes = np.concatenate([np.eye(3), -np.eye(3), unit(rng.normal(size=(_many(full), 3)))])
    lever = 0.3 * unit(np.cross(axes, rng.normal(size=axes.shape)))
    for name, off in (("pi", 0.0), ("pi - 1e-7", -1e-7), ("pi + 1e-7", 1e-7)):
        q = np.concatenate([np.full((len(axes), 1), -np.sin(off / 2)), np.cos(off / 2) * axes], 1)
        r = matrices(q) if off else 2 * axes[:, :, None] * axes[:, None] - np.eye(3)  # symmetric to the bit
        d = np.sin(off) * np.cross(axes, lever) + 2 * np.cos(off / 2) ** 2 * lever
        for by in ("closed", "svd"):
            y = projected(quaternions_of(r), d, by)
            fed = f"{len(axes)} axes, angle {name}, from matrices, {by}"
            yield Row("N5", fed, "axis, error in degrees", np.degrees(angle_between(y.axis.T, axes)).max(), 1e-12)
            yield Row("N5", fed, "point, error in m", np.linalg.norm(y.point.T - lever, axis=1).max(), 1e-12)


def n6(full: bool = True) -> Iterator[Row]:
    """No rotation at all, with and without translation; angles that underflow. Values and gradients."""
    del full
    for dtype, tiny in (("float64", (0.0, 1e-300, 1e-160, 1e-17)), ("float32", (0.0, 1e-40, 1e-25, 1e-9))):
        half = np.array([[1.0, x, 0, 0] for x in tiny for _ in range(2)])
        d = np.array([[0.0, 0, 0], [0.3, -0.2, 0.1]] * len(tiny))
        length = np.linalg.norm(d, axis=1)
        fed = f"rotation 0 and {tiny[1]:g}..{tiny[-1]:g}, {dtype}"
        for by in ("closed", "svd"):
            y = projected(half, d, by, dtype)
            yield Row("N6", f"{fed}, {by}", "non-finite values", sum(np.sum(~np.isfinite(x)) for x in y), 0)
            wrong = max(np.abs(y.eps_3 - length).max(), np.abs(y.eps_1 - length).max()) / np.finfo(dtype).eps
            yield Row("N6", f"{fed}, {by}", "eps_3, eps_1 less |t|, / eps", wrong, 8)
            yield Row("N6", f"{fed}, {by}", "point and axis (both 0)", np.abs(y.point).max() + np.abs(y.axis).max(), 0)
        g = gradients(half, d, dtype)
        yield Row("N6", fed, "non-finite gradients", np.sum(~np.isfinite(g)), 0)


def n7(full: bool = True) -> Iterator[Row]:
    """Rotations that are none: off by a little (projected), by more than 1e-3 or mirrored (refused)."""
    s = screws(200 if full else 40, 7)
    r, bend = matrices(s.quaternion), np.random.default_rng(7).normal(size=(len(s.angle), 3, 3))
    bend /= np.linalg.norm(bend, ord=2, axis=(1, 2), keepdims=True)
    for defect in (1e-12, 1e-6, 1e-4):
        q = quaternions_of(r + defect * bend)
        fed = f"{len(r)} matrices off by {defect:g}"
        yield Row("N7", fed, "length of the quaternion less 1, / eps64", np.abs(np.linalg.norm(q, axis=1) - 1).max() / EPS64, 4)
        yield Row("N7", fed, "sigma_3, error / defect", np.abs(projected(q, s.d).sigma_3 - s.sigma_3).max() / defect, 2)
    wrong = (r * 1.001, r + 1e-2 * bend, -r, r * [1, 1, -1], r * 0)
    taken = sum(_accepted(lambda m=m[i : i + 1]: quaternions_of(m)) for m in wrong for i in range(0, len(r), 40))
    yield Row("N7", "scale 1.001, off by 1e-2, mirrored, zero", "matrices accepted", taken, 0)
    clip = lambda scale: make_poses(["a"], scale * s.q0[:, None], s.t0[:, None], 60.0)  # noqa: E731
    for lengths, expected in (((0, 0.99, 1.002, 1.01), 0), ((0.9995, 1, 1.0005), 3)):
        taken = sum(_accepted(lambda k=k: clip(k)) for k in lengths)
        fed = f"quaternion lengths {', '.join(f'{k:g}' for k in lengths)}"
        yield Row("N7", fed, "clips accepted", taken, expected, expected > 0)


def _accepted(call: Callable[[], object]) -> bool:
    """False where `call` refuses with a `ShapeError`; any other error goes through."""
    try:
        call()
    except ShapeError:
        return False
    return True


def n8(full: bool = True) -> Iterator[Row]:
    """A clip moved far away and turned (2006 paper, appendix A)."""
    for dtype, bar, exact in (("float64", 1e-9, 0), ("float32", None, None)):
        here, labels = signals(foot(), dtype)
        for shift in (10.0, 1e4):
            there, kind = signals(moved(foot(), shift), dtype)
            change = max(np.abs(a - b).max() / np.abs(a).max() for a, b in zip(here[:4], there[:4], strict=True) if a.any())
            fed = f"clip turned, {shift:g} m away, {dtype}"
            yield Row("N8", fed, "change of sigma, eps / their largest", change, bar)
            yield Row("N8", fed, "labels that changed", np.sum(labels != kind), exact)
    if full:
        differ = _differ(foot(), moved(foot(), 1e4))
        yield Row("N8", "whole detection, 10 km away, float64", "labels and spans that changed", differ, 0)


def _differ(*clips: object) -> int:
    """Labels and spans of constraints by which two clips' detections differ, in float64."""
    with jax.enable_x64(True):
        a, b = (detect(c, settings=WHOLE) for c in clips)
    spans = [[(c.type, c.begin, c.end) for c in d.constraints] for d in (a, b)]
    return int((np.asarray(a.passed) != np.asarray(b.passed)).sum()) + (spans[0] != spans[1])


def n9(full: bool = True) -> Iterator[Row]:
    """Signs and lengths of quaternions; Euler angles at the gimbal."""
    here, labels = signals(foot())
    there, kind = signals(spoilt(foot()))
    fed = "quaternion signs at random, lengths off by 1e-3"
    yield Row("N9", fed, "labels that changed", np.sum(labels != kind), 0)
    yield Row("N9", fed, "change of sigma_3 / eps64", np.abs(here.sigma_3 - there.sigma_3).max() / EPS64, 16)
    near = 90.0 - np.array([0, 1e-14, 1e-12, 1e-8, 1e-6, 1e-3])
    middle = np.repeat(np.concatenate([near, -near])[:, None], 50, 1)
    rng = np.random.default_rng(9)
    degrees = np.stack([rng.uniform(-180, 180, middle.shape), middle, rng.uniform(-180, 180, middle.shape)], -1)
    bad, read, back = 0, 0.0, 0.0
    for order in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx"):
        q = euler_to_quaternion(degrees, order)
        reference = Rotation.from_euler(order.upper(), degrees.reshape(-1, 3), degrees=True).as_quat()[:, [3, 0, 1, 2]]
        again = quaternion_to_euler(q * (1 + 2e-16), order)
        bad += int((~np.isfinite(q)).sum() + (~np.isfinite(again)).sum())
        read = max(read, rotation_between(q, reference.reshape(q.shape)).max())
        back = max(back, rotation_between(q, euler_to_quaternion(again, order)).max())
    fed = "Euler angles at and near +-90 degrees, 6 orders"
    yield Row("N9", fed, "NaN", bad, 0)
    yield Row("N9", fed, "rotation read, error in rad", read, 1e-14)
    yield Row("N9", fed, "written (6 digits) and read, error in rad", back, 3e-7)
    if full:
        differ = _differ(foot(), spoilt(foot()))
        yield Row("N9", "whole detection, signs and lengths as above", "labels and spans that changed", differ, 0)


def n11(full: bool = True) -> Iterator[Row]:
    """The same answer however it is computed: alone or in a batch, padded or not, jitted or not."""
    n = foot().frames - 1
    with jax.enable_x64(True):
        padded = [jnp.asarray(x) for x in prepared(foot(), None, None, Settings()).arrays]
        exact, back = [x[..., : n + 1] for x in padded], [x[..., ::-1] for x in padded]
        alone, labels = signals_of(*exact)
        batch = signals_of(*(jnp.concatenate([x, y, x], -2) for x, y in zip(padded, back, strict=True)))
        ways = {"padded": signals_of(*padded), "in a batch": jax.tree.map(lambda x: x[..., 2:, :], batch)}
        if full:
            ways["without jit"] = signals_of.__wrapped__(*exact)
    for name, (y, kind) in ways.items():
        parts = [(np.asarray(a), np.asarray(b)[..., :n]) for a, b in zip(alone[:4], y[:4], strict=True)]
        one, eps_3 = np.ones(n), parts[1][0]
        worst = max(ulps(a, b, s) for (a, b), s in zip(parts, (one, eps_3, one, eps_3), strict=True))
        yield Row("N11", f"{name}, against alone", "difference in ulp (sigma: of 1; eps: of eps_3)", worst, 4)
        yield Row("N11", f"{name}, against alone", "difference of sigma_3 in its own ulp", ulps(*parts[0], parts[0][0]))
        yield Row("N11", f"{name}, against alone", "values equal to the bit, share", np.mean([np.mean(a == b) for a, b in parts]))
        yield Row("N11", f"{name}, against alone", "labels that differ", np.sum(np.asarray(labels) != np.asarray(kind)[..., :n]), 0)
    rng = np.random.default_rng(11)
    v, mask = rng.normal(10, 1, (32, 60)), rng.random((32, 60)) < 0.8
    short, long = kept(v, mask, width=60), kept(v, mask)
    same = all(np.array_equal(a, b) for a, b in zip(short, long, strict=True))
    yield Row("N11", "least median of squares, padded against not", "answers that differ", not same, 0)
    if full:
        clips = [foot(), spoilt(foot()), moved(foot(), 1.0)]
        with jax.enable_x64(True):
            one, many = [detect(c, settings=WHOLE) for c in clips], detect_many(clips, settings=WHOLE)
        differ = sum(
            np.sum(np.asarray(a.passed) != np.asarray(b.passed)) + (str(a.constraints) != str(b.constraints))
            for a, b in zip(one, many, strict=True)
        )
        yield Row("N11", "whole detection, three clips in a batch", "labels and constraints that differ", differ, 0)


def ulps(a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> float:
    """Largest difference in units of the last place of `scale`."""
    return float(np.max(np.abs(a - b) / np.spacing(np.maximum(np.abs(scale), np.finfo(a.dtype).tiny)), initial=0))
