"""Synthetic clips with known truth: every constraint found, none invented, in time and in place.

Bars: begin and end within 20 ms clean and 40 ms at 1 and 3 mm marker noise; positions within 1 mm and axes within 0.5
degrees clean, and at 1 mm noise no worse than the window laws allow.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinjax import synthetic
from kinjax.detect import detect

SCENES = {
    "dice": synthetic.rolling_dice,
    "hinge": synthetic.hinge,
    "ball": synthetic.ball_joint,
    "foot": synthetic.rolling_foot,
}
ALL = ("space", "line", "point")


@pytest.fixture(scope="module", params=list(SCENES))
def scene(request):
    return SCENES[request.param]()


def pairs(truth, found):
    """Each true constraint with the found one of its object and type that overlaps it most; and what is left over."""
    left, out = list(found), []
    for c in truth:
        same = [
            f for f in left if f.object == c.object and f.type == c.type and min(c.end, f.end) > max(c.begin, f.begin)
        ]
        assert same, f"missed: {c}"
        best = max(same, key=lambda f: min(c.end, f.end) - max(c.begin, f.begin))
        left.remove(best)
        out.append((c, best))
    assert not left, f"invented: {left}"
    return out


def place_error(c, f):
    """Distance in metres of the found place from the true point or axis, and angle in degrees between the axes."""
    apart = np.subtract(f.position, c.position)
    if c.type != "line":
        return np.linalg.norm(apart), 0.0
    axis = np.array(c.axis)
    angle = np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(axis, f.axis)))))
    return np.linalg.norm(apart - axis * (axis @ apart)), angle


def robust(scene, poses, **options):
    return detect(poses, types=ALL, free_pivots=scene.name != "foot", **options)


def test_robust_clean(scene):
    for c, f in pairs(scene.truth, robust(scene, scene.poses).constraints):
        assert abs(f.begin - c.begin) / scene.rate <= 0.020 and abs(f.end - c.end) / scene.rate <= 0.020, (c, f)
        metres, degrees = place_error(c, f)
        assert metres < 1e-3 and degrees < 0.5, (c, f)


@pytest.mark.parametrize("sigma", [0.001, 0.003])
def test_robust_with_noise(scene, sigma):
    for seed in range(3):
        poses = synthetic.with_noise(scene, sigma, seed).poses
        for c, f in pairs(scene.truth, robust(scene, poses).constraints):
            assert abs(f.begin - c.begin) / scene.rate <= 0.040 and abs(f.end - c.end) / scene.rate <= 0.040, (
                seed,
                c,
                f,
            )


def test_window_laws_at_one_millimetre(scene):
    """An axis from a window of `n` frames that turns by `phi_rms` about its mean errs by `1.18 nu_r / (phi_rms sqrt n)` in
    the median (nu_r: rotational noise); three in a hundred errors of that law exceed 2.2 medians. A pivot on a lever
    `rho` moves by as much times `rho`, besides the position noise over `sqrt n`."""
    errors = []
    for seed in range(4):
        noisy = synthetic.with_noise(scene, 0.001, seed)
        found = robust(scene, noisy.poses)
        for c, f in pairs(scene.truth, found.constraints):
            o = scene.poses.index(c.object)
            layout = scene.marker_layout[c.object]
            nu_r = np.sqrt(np.trace(synthetic.rotation_noise(layout, 0.001)))
            nu_t = 0.001 * np.sqrt(3 / len(layout))
            n = f.end - f.begin + 1
            metres, degrees = place_error(c, f)
            if c.type == "space":
                assert metres < 4 * nu_t / np.sqrt(n), (c, f)
                continue
            q = scene.poses.rotation[f.begin : f.end + 1, o]
            mean = q[len(q) // 2]
            turn = 2 * np.arccos(np.clip(np.abs(q @ mean), 0, 1)) * np.sign(np.arange(n) - n // 2)
            phi = np.std(turn)
            lever = np.linalg.norm(scene.poses.position[f.begin : f.end + 1, o] - np.array(c.position), axis=-1).max()
            law = 1.18 * nu_r / (phi * np.sqrt(n))
            if c.type == "line":
                errors.append(np.radians(degrees) / law)
                assert errors[-1] < 4, (seed, c, f, errors[-1])
            # a missing or extra frame of a rest at either end adds its share of the motion
            assert metres < 4 * (lever * law + nu_t / (phi * np.sqrt(n))) + 2e-4, (seed, c, f, metres)
    assert not errors or np.median(errors) < 1.5


def test_heel_and_toe_of_the_rolling_foot_are_lines():
    scene = synthetic.rolling_foot()
    found = robust(scene, scene.poses).constraints
    kinds = [c.type for c in found]
    assert kinds == ["line", "space", "line"] * 3  # heel, flat, toe
    for i in range(0, 9, 3):
        heel, toe = np.array(found[i].position), np.array(found[i + 2].position)
        assert np.linalg.norm(toe - heel) > 0.1


def test_paper_clean_with_minimal_thresholds(scene):
    found = detect(scene.poses, method="paper", types=ALL, thresholds=(1e-3, 1e-4))
    for c, f in pairs(scene.truth, found.constraints):
        assert abs(f.begin - c.begin) / scene.rate <= 0.020 and abs(f.end - c.end) / scene.rate <= 0.020, (c, f)
        metres, degrees = place_error(c, f)
        assert metres < 1e-3 and degrees < 0.5, (c, f)


def test_paper_fails_with_noise_as_known(scene):
    """Known failure: one interval at 60 to 100 fps is mostly noise, so minimal thresholds find nothing at 1 mm."""
    poses = synthetic.with_noise(scene, 0.001, 0).poses
    found = detect(poses, method="paper", types=ALL, thresholds=(1e-3, 1e-4))
    covered = sum(c.frames for c in found.constraints) / sum(c.frames for c in scene.truth)
    assert covered < 0.2


def test_paper_with_a_clean_template_misses_noisier_stances():
    """Known failure: a template on the quietest part of a stance gives thresholds that the rest of it does not keep."""
    scene = synthetic.rolling_foot()
    noisy = synthetic.with_noise(scene, 0.003, 1).poses
    from kinjax.annotations import Template

    stance = scene.truth.of("foot", "space")[0]
    found = detect(noisy, method="paper", templates=[Template("foot", stance.begin + 12, stance.begin + 17)])
    mask = found.constraints.mask(scene.frames, "foot", "space")
    truth = scene.truth.mask(scene.frames, "foot", "space")
    assert (mask & truth).sum() / truth.sum() < 0.9


@pytest.mark.parametrize("bad", [0.1, 0.25, 0.4])
def test_isolated_bad_template_intervals_do_not_raise_sigma_max(bad):
    """Up to 40 % isolated bad intervals: never above the largest good one, and within 5 % of it in 19 of 20 templates where
    the estimator itself does not cut the good tail (it does so at 10 %, where its scale is the smallest)."""
    from kinjax.detect.lmeds import lmeds

    run = jax.jit(jax.vmap(lambda v: lmeds(v, jnp.ones(v.shape, bool))))
    rng = np.random.default_rng(0)
    values = np.sqrt((rng.normal(size=(300, 20, 3)) ** 2).sum(-1)) * 0.01  # the law of sigma_3 under isotropic noise
    at = np.argsort(rng.random(values.shape), axis=1)[:, : int(bad * 20)]
    spoilt = values.copy()
    np.put_along_axis(spoilt, at, 0.1 + rng.random(at.shape), axis=1)
    good = values.copy()
    np.put_along_axis(good, at, 0.0, axis=1)
    ratio = np.asarray(run(jnp.float32(spoilt)).largest) / good.max(1)
    before = np.asarray(run(jnp.float32(values)).largest)
    assert ratio.max() < 1.0001
    assert np.median(np.abs(np.asarray(run(jnp.float32(spoilt)).largest) / before - 1)) < 0.05
    assert np.quantile(ratio, 0.05) > (0.95 if bad > 0.1 else 0.6)


@pytest.mark.parametrize("make", [lambda: synthetic.hinge(rate=100.0), synthetic.rolling_foot, synthetic.ball_joint])
@pytest.mark.parametrize("seed", [0, 1])
def test_bad_intervals_in_any_template_do_not_change_the_default_pattern(make, seed):
    """40 % bad intervals in each rest of the scenes at 1 mm: by the default method both thresholds stay within 5 % for every
    template (by the paper's alone they do for the median one: what its estimator keeps depends on which values are there)."""
    import dataclasses

    from scipy.spatial.transform import Rotation

    from kinjax.annotations import Template
    from kinjax.detect import calibrate

    scene = make()
    poses = synthetic.with_noise(scene, 0.001, seed).poses
    rests = [c for c in scene.truth if c.type == "space" and c.end - c.begin >= 20]
    assert rests
    for c in rests:
        template, lane = [Template(c.object, c.begin, c.end)], poses.names.index(c.object)
        t, q = np.array(poses.position, float), np.array(poses.rotation, float)
        for f in range(c.begin + 2, c.end - 1, 5):  # a bad frame spoils two intervals
            t[f, lane, 0] += 0.05
            turned = Rotation.from_quat(q[f, lane], scalar_first=True) * Rotation.from_rotvec([0.3, 0, 0])
            q[f, lane] = turned.as_quat(scalar_first=True)
        clean = calibrate(poses, template)[0]
        spoilt = calibrate(dataclasses.replace(poses, position=t, rotation=q), template)[0]
        np.testing.assert_allclose(spoilt.sigma_max, clean.sigma_max, rtol=0.05)
        np.testing.assert_allclose(spoilt.eps_max, clean.eps_max, rtol=0.05)


def test_isolated_bad_frames_in_a_template_hardly_change_the_pattern():
    """The same through the whole of `calibrate`: a spike damages two intervals, so 20 % bad frames are 40 % bad intervals."""
    from kinjax.annotations import Template
    from kinjax.detect import calibrate

    scene = synthetic.hinge(rate=100.0)
    noisy = synthetic.with_noise(scene, 0.001, 5)
    template = [Template("door", 0, 40)]
    clean = calibrate(noisy.poses, template, method="paper")[0]
    t = np.array(noisy.poses.position)
    t[[4, 9, 14, 19, 24, 29, 34, 38], 0] += 0.05
    q = np.array(noisy.poses.rotation)
    from scipy.spatial.transform import Rotation

    for f in (4, 9, 14, 19, 24, 29, 34, 38):
        r = Rotation.from_quat(q[f, 0][[1, 2, 3, 0]]) * Rotation.from_rotvec([0.3, 0, 0])
        q[f, 0] = r.as_quat()[[3, 0, 1, 2]]
    import dataclasses

    spoilt = calibrate(dataclasses.replace(noisy.poses, position=t, rotation=q), template, method="paper")[0]
    naive = calibrate(
        dataclasses.replace(noisy.poses, position=t, rotation=q), template, method="paper", estimator="naive"
    )[0]
    assert abs(spoilt.sigma_max[0] / clean.sigma_max[0] - 1) < 0.05
    assert naive.sigma_max[0] > 5 * clean.sigma_max[0]
