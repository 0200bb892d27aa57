"""The NumPy baseline against cases worked by hand and closed forms: what checks the engine has to be right itself."""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import numpy_baseline as nb

EPS = np.finfo(np.float64).eps
LINE_ONLY = {"line": (0.0, 1e-9)}
SPACE_AND_LINE = {"space": (1e-9, 1e-9), "line": (0.0, 1e-9)}


def rotation(axis, angle):
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K


def hinge(angles, axis, through, lever):
    """An object whose origin sits at `lever` from a fixed axis and turns about it."""
    R = np.array([rotation(axis, angle) for angle in angles])
    return R, through + R @ np.asarray(lever, dtype=float)


def ball_joint(frames, centre, lever, seed=0, step=0.15):
    """An object that turns about a fixed point, each time about another axis."""
    rng = np.random.default_rng(seed)
    R = [np.eye(3)]
    for _ in range(frames - 1):
        R.append(rotation(rng.normal(size=3), step) @ R[-1])
    R = np.array(R)
    return R, centre + R @ np.asarray(lever, dtype=float)


def noisy_clip(frames=120, seed=1, bad_frames=()):
    """Rest, walk away, rest again; noise on every frame, bad frames thrown off."""
    rng = np.random.default_rng(seed)
    x = np.interp(np.arange(frames), [0, frames // 3, 2 * frames // 3, frames], [0.0, 0.0, 1.0, 1.0])
    t = np.stack([x, np.zeros(frames), np.zeros(frames)], axis=1) + 1e-4 * rng.normal(size=(frames, 3))
    angle = np.where((x > 0) & (x < 1), np.arange(frames) * 0.05, 0.0)
    R = np.array([rotation(rng.normal(size=3), 1e-3 * rng.normal()) @ rotation([0, 0, 1], a) for a in angle])
    for frame in bad_frames:
        t[frame] += 0.2
        R[frame] = R[frame] @ rotation([1, 0, 0], 0.3)
    return R, t


def same_line(axis, expected):
    return abs(axis @ np.asarray(expected, dtype=float)) / np.linalg.norm(expected)


# --- displacements ---------------------------------------------------------------------------------------------------


def test_displacement_by_hand():
    # A quarter turn about z, then one metre along the world's y: in the object's own coordinates that is its x.
    R = np.array([rotation([0, 0, 1], math.pi / 2)] * 2)
    t = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0]])
    local = nb.displacements_loop(R, t)
    np.testing.assert_allclose(local.R[0], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(local.t[0], [1.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(nb.displacements_loop(R, t, formulation="global").t[0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("formulation", ["local", "global"])
@pytest.mark.parametrize("stride", [1, 3])
def test_displacement_maps_one_frame_to_the_other(formulation, stride):
    R, t = noisy_clip(30)
    D = nb.displacements_loop(R, t, formulation=formulation, stride=stride)
    W = np.tile(np.eye(4), (30, 1, 1))
    W[:, :3, :3], W[:, :3, 3] = R, t
    for i in range(30 - stride):
        D_i = np.eye(4)
        D_i[:3, :3], D_i[:3, 3] = D.R[i], D.t[i]
        after = W[i] @ D_i if formulation == "local" else D_i @ W[i]
        np.testing.assert_allclose(after, W[i + stride], atol=1e-14)
    assert len(D.valid) == 29 and D.valid.sum() == 30 - stride and not D.valid[30 - stride :].any()


@pytest.mark.parametrize("formulation", ["local", "global"])
@pytest.mark.parametrize("stride", [1, 2, 40])
def test_displacements_loop_is_vectorised(formulation, stride):
    R, t = noisy_clip(30)
    t[7, 1] = np.nan
    R[20] = np.inf
    valid = np.arange(30) != 12
    loop = nb.displacements_loop(R, t, formulation=formulation, stride=stride, valid=valid)
    fast = nb.displacements_vectorised(R, t, formulation=formulation, stride=stride, valid=valid)
    np.testing.assert_array_equal(loop.valid, fast.valid)
    np.testing.assert_allclose(loop.R, fast.R, atol=1e-15)
    np.testing.assert_allclose(loop.t, fast.t, atol=1e-15)
    if stride == 1:
        np.testing.assert_array_equal(np.flatnonzero(~loop.valid), [6, 7, 11, 12, 19, 20])


# --- projection ------------------------------------------------------------------------------------------------------


def test_rest_and_translation():
    sigma3, eps3, sigma1, eps1, p, _ = nb.project_one(np.eye(3), np.zeros(3))
    assert (sigma3, eps3, sigma1, eps1) == (0.0, 0.0, 0.0, 0.0) and not p.any()
    sigma3, eps3, sigma1, eps1, p, _ = nb.project_one(np.eye(3), np.array([3.0, 0.0, 4.0]))
    assert (sigma3, eps3, sigma1, eps1) == (0.0, 5.0, 0.0, 5.0) and not p.any()


@pytest.mark.parametrize("theta", [1e-6, 1e-3, 0.3, 2.0, math.pi - 1e-6, math.pi])
def test_closed_form_of_a_screw(theta):
    a = np.array([2.0, -1.0, 2.0]) / 3.0
    R_D, t_D = rotation(a, theta), np.array([0.3, -0.2, 0.5])
    sigma3, eps3, sigma1, eps1, p, axis = nb.project_one(R_D, t_D)
    assert sigma3 == pytest.approx(2.0 * math.sin(theta / 2.0), rel=1e-9)
    assert sigma1 == 0.0
    assert eps3 == pytest.approx(np.linalg.norm(t_D), rel=1e-15)
    scale = EPS * (1.0 + np.linalg.norm(p))
    assert eps1 == pytest.approx(abs(a @ t_D), abs=100 * scale)
    assert same_line(axis, a) == pytest.approx(1.0, abs=1e-9)
    # p moves along the axis only, and no point of the axis is nearer the origin.
    np.testing.assert_allclose(R_D @ p + t_D - p, a * (a @ t_D), atol=100 * scale)
    assert abs(p @ axis) <= 100 * scale


def test_singular_values_at_the_floor_are_zero():
    assert nb.project_one(np.eye(3) * (1.0 + 16 * EPS), np.ones(3))[0] == 0.0
    assert nb.project_one(np.eye(3) * (1.0 + 64 * EPS), np.ones(3))[0] > 0.0


def test_a_scale_has_no_axis_and_equal_values_are_zeroed_together():
    # A = I: three equal singular values, so zeroing those equal to sigma_1 leaves none.
    sigma3, eps3, sigma1, eps1, p, _ = nb.project_one(2.0 * np.eye(3), np.array([0.0, 3.0, 4.0]))
    assert (sigma3, sigma1) == (1.0, 1.0) and eps3 == eps1 == 5.0 and not p.any()
    fast = nb.project_vectorised(2.0 * np.eye(3)[None], np.array([[0.0, 3.0, 4.0]]), np.array([True]))
    assert fast.eps1[0] == 5.0 and not fast.p.any()


def test_projection_loop_is_vectorised():
    R, t = noisy_clip(60)
    t[5] = np.nan
    D = nb.displacements_loop(R, t)
    loop = nb.project_loop(*D)
    fast = nb.project_vectorised(*D)
    for name in ("sigma3", "eps3", "sigma1"):
        np.testing.assert_allclose(getattr(loop, name), getattr(fast, name), rtol=1e-13, atol=1e-16)
    np.testing.assert_allclose(loop.eps1, fast.eps1, atol=1e-12)
    np.testing.assert_allclose(loop.p, fast.p, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(loop.axis * fast.axis, axis=1))[D.valid], 1.0)
    assert np.isnan(loop.sigma3[4:6]).all() and np.isnan(fast.p[4:6]).all()


def test_appendix_a():
    # A foot that rolls a little in place: the global residual grows with the distance from the origin, the local stays.
    R = np.array([rotation([0, 0, 1], 0.02 * i) for i in range(11)])
    eps = {"local": [], "global": []}
    for distance in (0.0, 17.0, 170.0):
        t = np.tile([distance, 0.0, 0.0], (11, 1))
        for formulation, found in eps.items():
            D = nb.displacements_loop(R, t, formulation=formulation)
            found.append(nb.project_loop(*D).eps3.max())
    assert eps["local"] == [0.0, 0.0, 0.0]
    expected = [distance * 2.0 * math.sin(0.01) for distance in (0.0, 17.0, 170.0)]  # |(I - R) t|
    np.testing.assert_allclose(eps["global"], expected, rtol=1e-9, atol=1e-13)


# --- LMedS -----------------------------------------------------------------------------------------------------------

both_lmeds = pytest.mark.parametrize("lmeds", [nb.lmeds_loop, nb.lmeds_vectorised])


@both_lmeds
def test_lmeds_by_hand(lmeds):
    # N = 4, so the third smallest deviation: 3, 2, 3, 20 (the mean of the middle two would give 1.5 for the 1).
    got = lmeds([0.0, 1.0, 3.0, 21.0])
    assert got.centre == 1.0
    assert got.scale == pytest.approx(1.4826 * (1.0 + 5.0 / 3.0) * 2.0, rel=1e-15)  # 7.907; 2.5 of it is 19.77
    assert got.kept.tolist() == [True, True, True, False] and got.largest == 3.0
    # N = 5, the third smallest: 2, 1, 1, 2, 96; among ties the smaller value is the centre.
    got = lmeds([4.0, 2.0, 100.0, 3.0, 1.0])
    assert got.centre == 2.0
    assert got.scale == pytest.approx(1.4826 * 2.25, rel=1e-15)
    assert got.kept.tolist() == [True, True, False, True, True] and got.largest == 4.0


@both_lmeds
def test_lmeds_with_ties(lmeds):
    got = lmeds([1.0, 5.0, 1.0, 1.0])  # over half are equal: the scale is the floor, not zero
    assert got.centre == 1.0 and got.scale == 4 * EPS * 5.0
    assert got.kept.tolist() == [True, False, True, True] and got.largest == 1.0
    got = lmeds([0.0, 0.0, 0.0])
    assert got.kept.all() and got.scale == 0.0 and got.largest == 0.0
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):  # two clusters: the smaller centre, in any order
        assert lmeds(np.array([0.0, 1.0, 10.0, 11.0])[order]).centre == 1.0


@both_lmeds
def test_lmeds_survives_forty_percent(lmeds):
    good = 0.01 + 0.0005 * np.arange(12)
    bad = np.linspace(1.0, 2.0, 8)
    values = np.random.default_rng(0).permutation(np.concatenate([good, bad]))
    got = lmeds(values)
    np.testing.assert_array_equal(got.kept, values < 0.5)
    assert got.largest == good.max()
    assert nb.naive(values).largest == 2.0
    majority = lmeds(np.concatenate([good[:7], bad]))  # 8 of 15 are bad: past the breakdown point
    assert majority.largest > 0.5


def test_lmeds_loop_is_vectorised():
    rng = np.random.default_rng(3)
    for n in range(2, 40):
        values = np.round(np.abs(rng.normal(size=n)), 1 + n % 3)  # rounded: plenty of ties
        loop, fast = nb.lmeds_loop(values), nb.lmeds_vectorised(values)
        assert (loop.centre, loop.scale, loop.largest) == (fast.centre, fast.scale, fast.largest)
        np.testing.assert_array_equal(loop.kept, fast.kept)


# --- patterns of templates -------------------------------------------------------------------------------------------


def projection_of(sigma, eps):
    sigma, eps = np.asarray(sigma, dtype=float), np.asarray(eps, dtype=float)
    zero, xyz = np.zeros(len(sigma)), np.zeros((len(sigma), 3))
    return nb.Projection(sigma, eps, zero, eps / 10.0, xyz, xyz)


def test_template_estimates_eps_on_what_sigma_kept():
    sigma = [9.0, 1.0, 1.1, 1.2, 1.3, 9.0, 1.1]
    eps = [1e-3, 2e-3, 2e-3, 2.1e-3, 0.9, 5.0, 2e-3]
    valid = np.array([True, True, True, True, True, True, False])
    got = nb.template_pattern(("space", 0, 7), projection_of(sigma, eps), valid)
    assert got.intervals.tolist() == [0, 1, 2, 3, 4, 5]
    assert got.kept.tolist() == [False, True, True, True, True, False]
    assert got.kept_eps.tolist() == [False, True, True, True, False, False]
    assert (got.sigma_max, got.eps_max) == (1.3, 2.1e-3)
    got = nb.template_pattern(("space", 0, 7), projection_of(sigma, eps), valid, nb.naive)
    assert (got.sigma_max, got.eps_max) == (9.0, 5.0)
    line = nb.template_pattern(("point", 1, 4), projection_of(sigma, eps), valid)
    # eps_1 is 2, 2 and 2.1: two of three are equal, so the third goes.
    assert line.sigma_max == nb.FLOOR and line.eps_max == pytest.approx(2.0e-4)


@pytest.mark.parametrize("template", [("space", 0, 2), ("space", 4, 4), ("space", 0, 9), ("plane", 0, 5)])
def test_template_refused(template):
    with pytest.raises(ValueError, match="template"):
        nb.template_pattern(template, projection_of(np.ones(6), np.ones(6)), np.ones(6, dtype=bool))


@pytest.mark.parametrize("interpolation", ["cubic", "monotone"])
def test_curve_hits_its_control_points(interpolation):
    frames, values = nb.control_points([(50, 60), (10, 20), (60, 80)], [3.0, 1.0, 2.0])  # given out of order
    assert frames.tolist() == [10, 20, 50, 60, 80] and values.tolist() == [1.0, 1.0, 3.0, 3.0, 2.0]
    np.testing.assert_allclose(nb.threshold_curve(frames, values, frames, interpolation), values, rtol=1e-14)
    outside = nb.threshold_curve(frames, values, [-5.0, 9.5, 80.5, 1000.0], interpolation)
    assert outside.tolist() == [1.0, 1.0, 2.0, 2.0]
    between = nb.threshold_curve(frames, values, np.arange(20.5, 50), interpolation)
    assert between.min() < 2.0 < between.max()
    bulge = np.abs(nb.threshold_curve(frames, values, [15.0], interpolation)[0] - 1.0)
    assert bulge == 0.0 if interpolation == "monotone" else bulge > 1e-3


def test_natural_cubic_by_hand():
    # Knots 0, 1, 2 with heights 0, 1, 0: second derivatives 0, -3, 0, so 1.5 x - 0.5 x^3 on the first piece.
    curve = nb.threshold_curve(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]), [0.5, 1.5])
    np.testing.assert_allclose(curve, 0.6875, rtol=1e-14)


def test_curve_of_one_template_is_constant_and_never_below_the_floor():
    one = nb.threshold_curve(*nb.control_points([(3, 9)], [0.1]), np.arange(-5.0, 20.0, 0.5))
    assert (one == 0.1).all()
    frames, values = nb.control_points([(0, 10), (20, 30)], [1e-9, 1.0])  # undershoots before the second
    curve = nb.threshold_curve(frames, values, np.arange(30) + 0.5)
    assert curve.min() == nb.FLOOR
    with pytest.raises(ValueError, match="overlaps"):
        nb.control_points([(0, 10), (9, 20)], [1.0, 1.0])


# --- frame tolerance -------------------------------------------------------------------------------------------------


def test_frame_tolerance_of_figure_10():
    distances = [0.0, 0.001, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.069, 0.071, 0.09, 0.1, np.nextafter(0.1, 1), 0.12]
    expected = [10, 9, 7, 6, 5, 3, 3, 2, 2, 1, 1, 1, 0, 0]
    assert [nb.frame_tolerance(d, 10, 0.1) for d in distances] == expected
    assert [nb.frame_tolerance(d, 1, 0.1) for d in (0.0, 0.05, 0.1, 0.11, math.nan)] == [1, 1, 1, 0, 0]
    assert [nb.frame_tolerance(d, 4, 0.0) for d in (0.0, 1e-9)] == [4, 0]


def test_durations_round_half_up():
    assert [nb.in_frames(0.1, rate) for rate in (25.0, 24.0, 100.0, 4.0)] == [3, 2, 10, 0]


# --- merging by hand -------------------------------------------------------------------------------------------------


def merged_lines(*lines):
    """Spans of one line an interval, each given as (point, axis)."""
    found = [
        nb.Instantaneous(
            i, nb.LINE, np.array(point, dtype=float), np.array(point, dtype=float), np.eye(3)["xyz".index(a)]
        )
        for i, (point, a) in enumerate(lines)
    ]
    n = len(lines)
    options = dict(alpha_max=math.radians(5.0), dist_max=0.01, f_max=10, d_max=0.05, max_missing=30)
    merged = nb.merge(found, np.full(n, nb.LINE), np.ones(n, dtype=bool), np.zeros(n, dtype=bool), **options)
    return [(first, last) for _, first, last in merged]


def test_a_point_stays_where_it_is():
    z, x = ([0, 0, 0], "z"), ([0, 0, 0], "x")
    assert merged_lines(z, x, ([0.009, 5, 0], "y")) == [(0, 2)]
    assert merged_lines(z, x, ([0.5, 5, 0], "y")) == [(0, 1), (2, 2)]  # crosses the second line, misses the point


def test_a_point_is_the_middle_of_the_shortest_segment():
    z, x = ([0, 0, 7], "z"), ([-3, 0.008, 0], "x")
    assert merged_lines(z, x, ([0, 0.0135, 0], "z")) == [(0, 2)]
    assert merged_lines(z, x, ([0, -0.0055, 0], "z")) == [(0, 2)]
    assert merged_lines(z, x, ([0, 0.0145, 0], "z")) == [(0, 1), (2, 2)]
    assert merged_lines(z, x, ([0, -0.0065, 0], "z")) == [(0, 1), (2, 2)]
    assert merged_lines(z, ([0, 0.011, 0], "x")) == [(0, 0), (1, 1)]


def test_a_line_takes_the_newest_as_its_own():
    assert merged_lines(*(([0.009 * i, 0, 100 * i], "z") for i in range(5))) == [(0, 4)]
    assert merged_lines(*(([0.011 * i, 0, 0], "z") for i in range(3))) == [(0, 0), (1, 1), (2, 2)]


def test_absorbed_runs():
    labels = np.array([1, 1, 2, 1, 1, 0, 1, 1, 0, 2, 1, 1, 1, 2, 1])
    expected = np.zeros(15, dtype=bool)
    expected[[0, 1, 3, 4, 14]] = True
    np.testing.assert_array_equal(nb.absorbed_intervals(labels, 3), expected)


# --- detection: space ------------------------------------------------------------------------------------------------


def stops_and_goes(*pieces):
    """Positions on the x axis: ('rest', n) holds still for n intervals, ('gone', n, dx) is away and back after n."""
    x = [0.0]
    for piece in pieces:
        n, to = piece[1], x[-1] + (piece[2] if len(piece) == 3 else 0.0)
        x += [x[-1]] * n if piece[0] == "rest" else [x[-1] + 7.0 + k for k in range(n - 1)] + [to]
    t = np.zeros((len(x), 3))
    t[:, 0] = x
    return np.tile(np.eye(3), (len(x), 1, 1)), t


def spans(result, kind=None):
    return [(c.begin, c.end) for c in result.constraints if kind in (None, c.type)]


def detect_space(R, t, **kw):
    return nb.detect(R, t, rate=100.0, types=("space",), thresholds={"space": (1e-9, 1e-9)}, **kw)


def test_rest_is_one_space_constraint():
    R, t = stops_and_goes(("rest", 20))
    result = detect_space(R, t + np.array([1.0, 2.0, 3.0]))
    assert spans(result) == [(0, 20)] and result.label.tolist() == [1] * 20
    (found,) = result.constraints
    assert found.type == "space" and found.residual == 0.0 and np.isnan(found.axis).all()
    np.testing.assert_array_equal(found.position, [1.0, 2.0, 3.0])


def test_pure_translation_is_nothing():
    t = np.arange(30)[:, None] * [0.01, 0.0, 0.0]
    R = np.tile(np.eye(3), (30, 1, 1))
    result = nb.detect(R, t, rate=100.0, types=("space", "line"), thresholds=SPACE_AND_LINE)
    assert not result.label.any() and result.constraints == []
    np.testing.assert_allclose(result.eps1, 0.01)


@pytest.mark.parametrize(
    ("gap", "away", "together"),
    [(10, 0.0, True), (11, 0.0, False), (3, 0.025, True), (4, 0.025, False), (1, 0.049, True), (1, 0.051, False)],
)
def test_gap_against_the_frame_tolerance(gap, away, together):
    R, t = stops_and_goes(("rest", 20), ("gone", gap, away), ("rest", 20))
    result = detect_space(R, t)
    assert spans(result) == ([(0, 40 + gap)] if together else [(0, 20), (20 + gap, 40 + gap)])


@pytest.mark.parametrize(("lost", "together"), [(1, True), (29, True), (30, False)])
def test_missing_frames_are_no_gap_up_to_0_3_s(lost, together):
    R, t = stops_and_goes(("rest", 80))
    t[25 : 25 + lost] = np.nan  # takes lost + 1 intervals with it
    result = detect_space(R, t)
    assert result.valid.sum() == 80 - lost - 1
    assert spans(result) == ([(0, 80)] if together else [(0, 24), (25 + lost, 80)])
    assert all(np.isfinite(c.position).all() for c in result.constraints)


@pytest.mark.parametrize(("moved", "expected"), [(0.049, [(0, 60)]), (0.051, [(0, 24), (30, 60)])])
def test_lost_from_sight_and_back_elsewhere(moved, expected):
    R, t = stops_and_goes(("rest", 60))
    t[28:, 1] = moved
    t[25:30] = np.nan
    assert spans(detect_space(R, t)) == expected


def test_missing_and_gap_are_counted_apart():
    R, t = stops_and_goes(("rest", 20), ("gone", 12), ("rest", 20))
    valid = np.ones(53, dtype=bool)
    valid[25:27] = False  # three of the twelve intervals of the gap
    assert spans(detect_space(R, t)) == [(0, 20), (32, 52)]
    assert spans(detect_space(R, t, valid=valid)) == [(0, 52)]


def test_a_slow_clip_still_bridges_one_interval():
    R, t = stops_and_goes(("rest", 5), ("gone", 1, 0.04), ("rest", 5), ("gone", 2), ("rest", 5))
    result = nb.detect(R, t, rate=2.0, types=("space",), thresholds={"space": (1e-9, 1e-9)})
    assert spans(result) == [(0, 11), (13, 18)]


def test_short_constraints_are_left_out():
    R, t = stops_and_goes(("rest", 7), ("gone", 12), ("rest", 8), ("gone", 12), ("rest", 1))
    assert spans(detect_space(R, t)) == [(19, 27)]
    assert spans(detect_space(R, t, min_duration=0.0)) == [(0, 7), (19, 27), (39, 40)]


def test_stride_has_no_displacement_at_the_end():
    R, t = stops_and_goes(("rest", 30))
    result = detect_space(R, t, stride=4)
    assert result.valid.tolist() == [True] * 27 + [False] * 3 and spans(result) == [(0, 27)]


def test_footplants_from_a_template_with_outliers():
    R, t = noisy_clip(150, bad_frames=(20, 33))
    lmeds = nb.detect(R, t, rate=100.0, types=("space",), templates=[("space", 5, 45)])
    naive = nb.detect(R, t, rate=100.0, types=("space",), templates=[("space", 5, 45)], estimator="naive")
    (pattern,) = lmeds.patterns
    assert pattern.intervals[~pattern.kept].tolist() == [19, 20, 32, 33]
    assert pattern.sigma_max < 0.02 and naive.patterns[0].sigma_max > 0.2
    first, last = lmeds.constraints
    assert first.begin <= 3 and 45 <= first.end <= 52 and 98 <= last.begin <= 106 and last.end >= 145
    assert np.linalg.norm(last.position - [1.0, 0.0, 0.0]) < 1e-3
    assert spans(naive) == [(0, 149)]  # both footplants in one, as in figure 4
    assert (lmeds.label[lmeds.sigma3 > lmeds.sigma_max["space"]] == 0).all()


def test_two_templates_make_the_pattern_dynamic():
    R, t = noisy_clip(120)
    result = nb.detect(R, t, rate=100.0, types=("space",), templates=[("space", 85, 115), ("space", 2, 35)])
    late, early = result.patterns
    sigma = result.sigma_max["space"]
    assert (sigma[:2] == early.sigma_max).all() and (sigma[115:] == late.sigma_max).all()
    frames, values = nb.control_points([(2, 35), (85, 115)], [early.sigma_max, late.sigma_max])
    at_middle = nb.threshold_curve(frames, values, np.arange(119) + 0.5)
    np.testing.assert_array_equal(sigma, at_middle)
    assert np.ptp(sigma) > 0.0


# --- detection: line and point ---------------------------------------------------------------------------------------


def test_hinge_is_one_line():
    axis, through = np.array([1.0, 2.0, -2.0]) / 3.0, np.array([0.5, -1.0, 4.0])
    R, t = hinge(np.linspace(0.0, 1.5, 60), axis, through, [0.1, 0.3, 0.2])
    R = R @ rotation([3, 1, 2], 1.1)  # the object's own axes are not the world's at the start
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds=LINE_ONLY)
    assert result.label.tolist() == [2] * 59
    (found,) = result.constraints
    assert (found.type, found.begin, found.end) == ("line", 0, 59)
    assert same_line(found.axis, axis) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(np.cross(found.position - through, axis)) < 1e-9  # on the axis
    assert abs((found.position - t.mean(axis=0)) @ axis) < 1e-9  # nearest the mean origin
    assert found.residual < 1e-7


def test_the_global_formulation_gives_the_same_hinge():
    axis, through = np.array([0.0, 0.6, 0.8]), np.array([2.0, -1.0, 4.0])
    R, t = hinge(np.linspace(0.0, 1.5, 60), axis, through, [0.1, 0.3, 0.2])
    for formulation in ("local", "global"):
        D = nb.displacements_loop(R, t, formulation=formulation)
        projection = nb.project_loop(*D)
        found = nb.instantaneous_constraints(R, t, projection, np.full(59, nb.LINE), formulation)
        for i, line in enumerate(found):
            assert np.linalg.norm(np.cross(line.begin - through, axis)) < 1e-9
            assert abs((line.begin - t[i]) @ axis) < 1e-9
            assert same_line(line.axis, axis) == pytest.approx(1.0, abs=1e-9)


def test_a_screw_is_no_line():
    R, t = hinge(np.linspace(0.0, 1.5, 60), [0, 0, 1], np.zeros(3), [0.1, 0.0, 0.0])
    t[:, 2] += 0.001 * np.arange(60)
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds=LINE_ONLY)
    assert not result.label.any()
    np.testing.assert_allclose(result.eps1, 0.001, rtol=1e-9)
    loose = nb.detect(R, t, rate=100.0, types=("line",), thresholds={"line": (0.0, 0.0011)})
    assert spans(loose) == [(0, 59)]


def test_too_small_a_rotation_has_no_axis():
    R, t = hinge(np.arange(40) * 0.9e-3, [0, 0, 1], np.zeros(3), [0.1, 0.0, 0.0])
    assert not nb.detect(R, t, rate=100.0, types=("line",), thresholds={"line": (0.0, 1e-6)}).label.any()
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds={"line": (0.0, 1e-6)}, axis_min=0.8e-3)
    assert result.label.all()


@pytest.mark.parametrize("types", [("point",), ("line", "point"), ("space", "point")])
def test_ball_joint_is_one_point(types):
    centre = np.array([1.0, 2.0, 3.0])
    R, t = ball_joint(80, centre, [0.2, 0.1, -0.3])
    thresholds = {"space": (1e-9, 1e-9), "point": (0.0, 1e-9)}
    result = nb.detect(R, t, rate=100.0, types=types, thresholds=thresholds)
    (found,) = result.constraints
    assert (found.type, found.begin, found.end) == ("point", 0, 79)
    np.testing.assert_allclose(found.position, centre, atol=1e-9)
    assert found.residual < 1e-7 and np.isnan(found.axis).all()


def test_a_point_that_is_not_asked_for_is_left_out():
    R, t = ball_joint(80, np.zeros(3), [0.2, 0.1, -0.3])
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds=LINE_ONLY)
    assert result.label.all() and result.constraints == []


def test_hinge_that_jumps_becomes_two_lines():
    angles = np.linspace(0.0, 1.0, 40)
    near, far = (hinge(angles, [0, 0, 1], np.array([x, 0.0, 0.0]), [0.1, 0.0, 0.0]) for x in (0.0, 0.5))
    R, t = (np.concatenate(pair) for pair in zip(near, far, strict=True))
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds=LINE_ONLY)
    # One interval joins the two hinges; it turns about no axis near either.
    assert spans(result) == [(0, 39), (40, 79)]
    np.testing.assert_allclose([c.position[0] for c in result.constraints], [0.0, 0.5], atol=1e-9)


def test_two_axes_that_cross_meet_in_a_point():
    angles = np.linspace(0.0, 1.0, 30)
    first = np.array([rotation([0, 0, 1], a) for a in angles])
    second = np.array([rotation([1, 0, 0], a) @ first[-1] for a in angles[1:]])
    R = np.concatenate([first, second])
    for offset, expected in ((0.0, ["point"]), (0.005, ["point"]), (0.02, ["line", "line"])):
        lever = np.array([0.1, 0.2, 0.0])
        t = R @ lever
        about = np.array([0.0, offset, 0.0])  # the second axis passes at this distance from the first
        t[30:] = (second @ first[-1].T) @ (t[29] - about) + about
        result = nb.detect(R, t, rate=100.0, types=("line", "point"), thresholds=LINE_ONLY)
        assert [c.type for c in result.constraints] == expected
    np.testing.assert_allclose([c.end for c in result.constraints], [29, 58])


@pytest.mark.parametrize(
    ("pause", "expected"),
    [(7, [("line", 0, 47)]), (8, [("line", 0, 20), ("space", 20, 28), ("line", 28, 48)])],
)
def test_a_short_rest_of_a_hinge_is_absorbed(pause, expected):
    turning = np.arange(21) * 0.03
    angles = np.concatenate([turning, np.full(pause, turning[-1]), turning[-1] + turning[1:]])
    R, t = hinge(angles, [0, 1, 0], np.zeros(3), [0.0, 0.0, 0.4])
    result = nb.detect(R, t, rate=100.0, types=("space", "line"), thresholds=SPACE_AND_LINE)
    assert result.label.tolist() == [2] * 20 + [1] * pause + [2] * 20
    assert [(c.type, c.begin, c.end) for c in result.constraints] == expected
    assert result.absorbed.sum() == (pause if pause < 8 else 0)


def test_an_absorbed_rest_is_no_gap():
    turning = np.arange(31) * 0.03
    angles = np.concatenate([turning, np.full(15, turning[-1]), turning[-1] + turning[1:]])
    R, t = hinge(angles, [0, 1, 0], np.zeros(3), [0.0, 0.0, 0.4])
    for types, expected in ((("space", "line"), [(0, 75)]), (("line",), [(0, 30), (45, 75)])):
        result = nb.detect(R, t, rate=100.0, types=types, thresholds=SPACE_AND_LINE, min_duration=0.2)
        assert spans(result) == expected


@pytest.mark.parametrize(
    ("gap", "shift", "together"), [(9, 0.0, True), (11, 0.0, False), (1, 0.008, True), (2, 0.008, False)]
)
def test_gap_between_lines(gap, shift, together):
    R, t = hinge(np.arange(41 + gap) * 0.03, [0, 0, 1], np.zeros(3), [0.1, 0.0, 0.0])
    t[21 : 20 + gap, 2] += 1.0 + np.arange(gap - 1)
    t[20 + gap :] += [0.0, shift, 0.0]
    t[20 + gap :, 2] += 0.5  # along the axis: still the same line
    result = nb.detect(R, t, rate=100.0, types=("line",), thresholds=LINE_ONLY, d_max=0.01)
    assert spans(result) == ([(0, 40 + gap)] if together else [(0, 20), (20 + gap, 40 + gap)])


def test_line_and_point_share_a_pattern_only_where_both_are_asked_for():
    R, t = ball_joint(40, np.zeros(3), [0.2, 0.1, -0.3])
    nb.detect(R, t, rate=100.0, types=("line", "point"), thresholds=LINE_ONLY)
    for types in (("point",), ("space", "line")):
        with pytest.raises(ValueError, match="neither template nor thresholds"):
            nb.detect(R, t, rate=100.0, types=types, thresholds=LINE_ONLY)


# --- refit -----------------------------------------------------------------------------------------------------------


def test_refit_residual_is_the_least_motion_of_any_body_point():
    R, t = ball_joint(60, np.array([3.0, -2.0, 5.0]), [0.2, 0.1, -0.3])
    t = t + 0.01 * np.random.default_rng(5).normal(size=t.shape)
    kind, position, axis, residual = nb.refit_rotation(R, t, math.radians(5.0))
    # The same by least squares over (p, x): R_i p - x = -t_i.
    A = np.concatenate([np.concatenate([R_i, -np.eye(3)], axis=1) for R_i in R])
    solution, total, _, _ = np.linalg.lstsq(A, -t.reshape(-1), rcond=None)
    assert kind == "point" and axis is None
    np.testing.assert_allclose(position, solution[3:], atol=1e-9)
    assert residual == pytest.approx(math.sqrt(total[0] / 60), rel=1e-9)


def test_refit_of_an_axis_that_wanders():
    rng = np.random.default_rng(6)
    spin = [rotation([0, 0, 1], a) for a in np.linspace(0.0, 6.0, 200)]
    for tilt, expected in ((math.radians(2.0), "line"), (math.radians(20.0), "point")):
        R = np.array([rotation([*rng.normal(size=2), 0.0], tilt * rng.normal()) @ S for S in spin])
        R, t = R[:90], R[:90] @ [0.1, 0.0, 0.2]
        kind, position, axis, _ = nb.refit_rotation(R, t, math.radians(5.0))
        assert kind == expected
        if kind == "line":
            assert same_line(axis, [0, 0, 1]) > math.cos(math.radians(1.0))
            assert abs((position - t.mean(axis=0)) @ axis) < 1e-12


def test_refit_space():
    position, residual = nb.refit_space(np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    assert position.tolist() == [2.0, 0.0, 0.0] and residual == 1.0


# --- the whole, twice ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["local", "global"])
@pytest.mark.parametrize("estimator", ["lmeds", "naive"])
def test_detect_loop_is_vectorised(formulation, estimator):
    R, t = noisy_clip(150, bad_frames=(20, 33))
    t[60:63] = np.nan
    setting = dict(
        rate=100.0,
        types=("space", "line", "point"),
        templates=[("space", 5, 45), ("line", 64, 90), ("space", 110, 140)],
        estimator=estimator,
        formulation=formulation,
        stride=2,
        interpolation="monotone",
    )
    loop, fast = nb.detect(R, t, **setting), nb.detect(R, t, vectorised=True, **setting)
    np.testing.assert_array_equal(loop.label, fast.label)
    np.testing.assert_array_equal(loop.valid, fast.valid)
    assert set(np.unique(loop.label)) == {0, 1, 2}
    for kind in ("space", "line", "point"):
        np.testing.assert_allclose(loop.sigma_max[kind], fast.sigma_max[kind], rtol=1e-12)
        np.testing.assert_allclose(loop.eps_max[kind], fast.eps_max[kind], rtol=1e-9)
    for a, b in zip(loop.patterns, fast.patterns, strict=True):
        np.testing.assert_array_equal(a.kept, b.kept)
        np.testing.assert_array_equal(a.kept_eps, b.kept_eps)
    assert spans(loop) == spans(fast) and len(spans(loop)) >= 2
    for a, b in zip(loop.constraints, fast.constraints, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        assert (a.type, a.residual) == (b.type, pytest.approx(b.residual))


@pytest.mark.parametrize("frames", [0, 1, 2])
@pytest.mark.parametrize("vectorised", [False, True])
def test_clips_of_almost_no_frames(frames, vectorised):
    R, t = np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3))
    result = detect_space(R, t, vectorised=vectorised, min_duration=0.0)
    assert len(result.label) == max(frames - 1, 0) and spans(result) == ([(0, 1)] if frames == 2 else [])


@pytest.mark.parametrize(
    "wrong", [dict(types=("plane",)), dict(estimator="mean"), dict(formulation="body"), dict(stride=0)]
)
def test_options_refused(wrong):
    R, t = stops_and_goes(("rest", 10))
    with pytest.raises(ValueError, match=str(next(iter(wrong)))):
        nb.detect(R, t, **{"rate": 100.0, "types": ("space",), "thresholds": {"space": (1e-9, 1e-9)}, **wrong})


def test_the_baseline_is_independent():
    for path in Path(nb.__file__).parent.glob("*.py"):
        text = path.read_text()
        assert "kinjax" not in text and "import jax" not in text, path.name
