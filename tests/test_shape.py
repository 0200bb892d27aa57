"""Shape-constraints: the splines against the `splines` package, the timing, and the spots where they could break."""

import numpy as np
import pytest
import splines
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from splines.quaternion import KochanekBartels as RotationSpline
from splines.quaternion import UnitQuaternion

from kinjax.deform import kochanek_bartels as kb
from kinjax.deform.shape import Pass, orientation_curve, shape_curve
from kinjax.errors import OptionError, ShapeError

FAST = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
FRAME = 1 / 120


def quaternion(rotvec):
    return Rotation.from_rotvec(rotvec).as_quat()[..., [3, 0, 1, 2]]


def difference(curve, t, step=1e-6):
    return (curve(t + step) - curve(t - step)) / (2 * step)


def spin(curve, t, step=1e-5):
    """World angular velocity by central differences."""
    a, b = (Rotation.from_quat(curve.orientation(t + s)[:, [1, 2, 3, 0]]) for s in (-step, step))
    return (b * a.inv()).as_rotvec() / (2 * step)


# ---- against the package


@pytest.mark.parametrize("seed", range(12))
def test_scalar_spline_against_the_package(seed):
    rng = np.random.default_rng(seed)
    k = int(rng.integers(2, 8))
    knots = np.cumsum(rng.uniform(0.02, 2.0, k))
    points, tcb = rng.normal(size=(k, 3)), rng.uniform(-1, 1, (k, 3))
    tcb[[0, -1]] = 0
    incoming, outgoing = kb.tangent_weights(knots, tcb)
    u = np.r_[rng.uniform(knots[0], knots[-1], 200), knots]
    ends = rng.normal(size=(2, 3))
    if k > 2:
        peer = splines.KochanekBartels(points, knots, tcb=tcb[1:-1], endconditions=ends.tolist())
    else:  # the package's spline through two points is a line
        peer = splines.CubicHermite(points, ends, knots)
    for derivative in (0, 1):
        mine = kb.curve_weights(u, knots, incoming, outgoing, derivative) @ np.r_[points, ends]
        np.testing.assert_allclose(mine, peer.evaluate(u, derivative), rtol=1e-10, atol=1e-9)


def test_scalar_spline_with_natural_ends():
    """End tangents chosen as the package's natural ends give its curve: the interior does not depend on them."""
    rng = np.random.default_rng(3)
    knots, points, tcb = np.array([0.0, 0.4, 1.5, 1.6, 3.0]), rng.normal(size=(5, 1)), rng.uniform(-0.8, 0.8, (5, 3))
    peer = splines.KochanekBartels(points, knots, tcb=tcb[1:-1])
    tcb[[0, -1]] = 0
    ends = np.array([peer.evaluate(knots[0], 1), peer.evaluate(knots[-1], 1)])
    u = np.linspace(0, 3, 301)
    mine = kb.curve_weights(u, knots, *kb.tangent_weights(knots, tcb)) @ np.r_[points, ends]
    np.testing.assert_allclose(mine, peer.evaluate(u), atol=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_rotation_spline_against_the_package(seed):
    rng = np.random.default_rng(seed)
    k = int(rng.integers(3, 7))
    knots = np.cumsum(rng.uniform(0.3, 1.2, k))
    q = Rotation.random(k, random_state=seed).as_quat()
    tcb = rng.uniform(-0.5, 0.5, (k, 3))
    tcb[[0, -1]] = 0
    peer = RotationSpline([UnitQuaternion.from_unit_xyzw(x) for x in q], knots, tcb=tcb[1:-1])
    ends = np.array([peer.evaluate(knots[0], 1), peer.evaluate(knots[-1], 1)])
    quaternions = kb.one_hemisphere(q[:, [3, 0, 1, 2]])
    legs = kb.rotation_legs(quaternions, knots, tcb, ends)
    u = np.r_[rng.uniform(knots[0], knots[-1], 100), knots]
    mine, speed = kb.rotation_curve(u, knots, quaternions, legs)
    theirs = np.array([peer.evaluate(float(x)).wxyz for x in u])
    np.testing.assert_allclose(np.abs(np.sum(mine * theirs, -1)), 1, atol=1e-12)
    # its angular velocity, the last leg's, holds where segments meet; ours everywhere
    np.testing.assert_allclose(speed[-k:], [peer.evaluate(float(x), 1) for x in knots], atol=1e-7)


# ---- timing


START, FINISH = np.array([0.0, 1.0, 0.2]), np.array([0.9, 1.1, -0.3])
BEFORE, AFTER = np.array([1.0, 0.2, 0.0]), np.array([-0.3, 0.0, 0.8])
ENDS = (START, FINISH, BEFORE, AFTER)


def test_pure_ease_is_the_cubic_of_the_inputs_ends():
    curve = shape_curve(1.0, 3.0, *ENDS)
    t = np.linspace(1, 3, 50)
    peer = splines.CubicHermite([START, FINISH], [BEFORE, AFTER], [1, 3])
    np.testing.assert_allclose(curve.position(t), peer.evaluate(t), atol=1e-14)
    np.testing.assert_allclose(curve.velocity(t), peer.evaluate(t, 1), atol=1e-13)


def test_without_rests_the_curve_is_smooth_in_time():
    passes = [Pass(1.7, 1.7, (0.4, 1.6, 0.0), bias=0.3), Pass(1.2, 1.2, (0.1, 1.3, 0.3), tension=-0.2)]
    curve = shape_curve(1.0, 3.0, *ENDS, passes)
    t = np.linspace(1.001, 2.999, 400)
    np.testing.assert_allclose(curve.time(t), t - 1, atol=1e-15)
    np.testing.assert_allclose(curve.velocity(t), difference(curve.position, t), atol=1e-6)
    for knot in (1.2, 1.7):
        a, b = curve.velocity(np.array([knot - 1e-9, knot + 1e-9]))
        np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_allclose(curve.velocity(np.array([1.0, 3.0])), [BEFORE, AFTER], atol=1e-14)


def test_passes_and_rests_are_met_exactly():
    passes = [Pass(1.5, 1.9, (0.4, 1.6, 0.1)), Pass(1.2, 1.2, (0.1, 1.3, 0.3)), Pass(2.0, 2.6, (0.7, 1.2, 0.4))]
    curve = shape_curve(1.0, 3.0, *ENDS, passes)
    for p in passes:
        t = np.linspace(p.first, p.last, 33)
        np.testing.assert_array_equal(curve.position(t), np.broadcast_to(p.point, (33, 3)))
        if p.last > p.first:
            np.testing.assert_array_equal(curve.velocity(t), 0)
            # no jump of the velocity either: the tangents are zero on both sides
            sides = curve.velocity(np.array([p.first - 1e-7, p.last + 1e-7]))
            np.testing.assert_allclose(sides, 0, atol=5e-4)
    t = np.linspace(1, 3, 2001)
    slope = np.diff(curve.time(t)) / np.diff(t)
    assert (slope > -1e-12).all() and (np.minimum(abs(slope), abs(slope - 1)) < 1e-9).mean() > 0.99
    assert curve.knots[-1] == pytest.approx(2.0 - 0.4 - 0.6)
    np.testing.assert_array_equal(curve.position(np.array([0.0, 9.0])), [START, FINISH])
    np.testing.assert_array_equal(curve.velocity(np.array([0.0, 9.0])), 0)


def test_continuity_breaks_the_velocity_on_request():
    broken = Pass(2.0, 2.0, (0.4, 1.6, 0.1), continuity=-1)
    curve = shape_curve(1.0, 3.0, *ENDS, [broken])
    a, b = curve.velocity(np.array([2.0 - 1e-9, 2.0]))
    assert np.linalg.norm(a - b) > 0.5


@pytest.mark.parametrize("last", [1.0, 1.4, 3.0])
def test_a_pass_at_begin_replaces_the_inputs_place(last):
    point = (5.0, 5.0, 5.0)
    curve = shape_curve(1.0, 3.0, *ENDS, [Pass(1.0, last, point)])
    np.testing.assert_array_equal(curve.position(np.linspace(1.0, last, 5)), np.broadcast_to(point, (5, 3)))
    np.testing.assert_array_equal(curve.velocity(np.array([1.0])), [BEFORE if last == 1 else np.zeros(3)])
    expected = FINISH if last < 3 else point
    np.testing.assert_array_equal(curve.position(np.array([3.0])), [expected])
    assert curve.weights(np.array([1.0, 2.0])).shape == (2, len(curve.points) + 2)
    rests = orientation_curve(1.0, 3.0, [1, 0, 0, 0], [0, 1, 0, 0], BEFORE, AFTER, [Pass(1.0, last, (0, 0, 1, 0))])
    np.testing.assert_array_equal(abs(rests.orientation(np.linspace(1.0, last, 5))[:, 2]), 1)


def test_a_rest_at_the_end():
    curve = shape_curve(1.0, 3.0, *ENDS, [Pass(2.5, 3.0, (1.0, 1, 1))])
    np.testing.assert_array_equal(curve.position(np.array([2.5, 2.8, 3.0])), 1)
    np.testing.assert_array_equal(curve.velocity(np.array([2.5, 3.0])), 0)
    np.testing.assert_allclose(curve.velocity(np.array([1.0])), [BEFORE])


def test_times_off_by_rounding_are_the_same_instant():
    curve = shape_curve(0.1, 0.1 + 0.2, *ENDS, [Pass(0.1 - 1e-12, 0.1, (1.0, 1, 1)), Pass(0.3, 0.3, (2.0, 2, 2))])
    assert len(curve.points) == 2
    np.testing.assert_array_equal(curve.position(np.array([0.1, 0.30000000000000004])), [[1] * 3, [2] * 3])


# ---- weights


def test_position_is_linear_in_points_and_end_tangents():
    rng = np.random.default_rng(0)
    spans = [(1.2, 1.2), (1.5, 1.9), (2.5, 2.5)]
    t = np.linspace(0.9, 3.1, 40)

    def made(ends, points):
        return shape_curve(1.0, 3.0, *ends, [Pass(*s, p, continuity=0.3) for s, p in zip(spans, points, strict=True)])

    a, b = ((rng.normal(size=(4, 3)), rng.normal(size=(3, 3))) for _ in range(2))
    x, y, z = made(*a), made(*b), made(2 * a[0] - 3 * b[0], 2 * a[1] - 3 * b[1])
    np.testing.assert_allclose(z.position(t), 2 * x.position(t) - 3 * y.position(t), atol=1e-12)
    np.testing.assert_array_equal(x.weights(t), y.weights(t))
    w = x.weights(t)
    assert w.shape == (40, 7)
    np.testing.assert_allclose(w[:, :5].sum(1), 1, atol=1e-14)  # moving all points moves the curve
    np.testing.assert_array_equal(w @ x.controls, x.position(t))
    np.testing.assert_array_equal(x.controls, np.r_[a[0][:1], a[1], a[0][1:2], a[0][2:]])


def test_a_curve_cannot_be_changed():
    curve = shape_curve(1.0, 3.0, *ENDS)
    with pytest.raises(ValueError, match="read-only"):
        curve.points[0] = 0


# ---- the hard spots

coordinate = st.floats(-2, 2).map(lambda x: round(x, 6))
vector = st.tuples(coordinate, coordinate, coordinate)
gap = st.sampled_from([0, 1, 1, 2, 3, 30])  # frames before a pass (at least one after another pass)
rest = st.sampled_from([0, 0, 1, 2, 40])
ask = st.lists(st.tuples(gap, rest, vector), min_size=0, max_size=5)


def timeline(asked, tail):
    """Passes from gaps and rests in frames, and the end of the span; neighbours one frame apart at least."""
    at, out = 0, []
    for i, (wait, stay, point) in enumerate(asked):
        at += wait if i == 0 else max(wait, 1)
        out.append((at, at + stay, point))
        at += stay
    return out, max(at + tail, 1)


@FAST
@given(ask, st.sampled_from([0, 1, 20]), vector, vector, st.sampled_from([0.0, 1000.0]))
def test_any_timeline(asked, tail, velocity, place, away):
    frames, end = timeline(asked, tail)
    passes = [Pass(a * FRAME, b * FRAME, np.array(p) + away) for a, b, p in frames]
    start = np.array(place) + away
    curve = shape_curve(0.0, end * FRAME, start, start + 1, velocity, velocity, passes)
    t = np.arange(end + 1) * FRAME
    found = curve.position(t)
    assert np.isfinite(found).all()
    for (a, b, _), p in zip(frames, passes, strict=True):
        np.testing.assert_array_equal(found[a : b + 1], np.broadcast_to(p.point, (b - a + 1, 3)))
        if b > a:
            np.testing.assert_array_equal(curve.velocity(t[a : b + 1]), 0)
    if not frames or frames[0][0] > 0:
        np.testing.assert_array_equal(found[0], start)
    free = not frames or frames[0][1] == 0 or frames[0][0] > 0
    # the sums cancel to 1 km times rounding, over the shortest segment
    tolerance = 1e-12 * (1 + away) / FRAME + 1e-12
    np.testing.assert_allclose(curve.velocity(t[:1])[0], velocity if free else np.zeros(3), atol=tolerance)
    # far from the origin is the same curve
    near = shape_curve(0.0, end * FRAME, start - away, start - away + 1, velocity, velocity,
                       [Pass(p.first, p.last, p.point - away) for p in passes])  # fmt: skip
    size = 1 + np.abs(found - away).max()
    np.testing.assert_allclose(found - away, near.position(t), atol=1e-13 * size * (1 + 10 * away))


angle = st.sampled_from([0.0, 1e-9, 0.5, 1.5, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi])
turned = st.tuples(angle, st.sampled_from([(1.0, 0, 0), (0, 0, -1.0), (0.6, 0.8, 0.0)]), st.sampled_from([1.0, -1.0]))


@FAST
@given(st.lists(st.tuples(gap, rest, turned), max_size=4), st.sampled_from([0, 1, 20]), vector, turned)
def test_any_timeline_of_rotations(asked, tail, spinning, place):
    def q(x):
        return x[2] * np.r_[np.cos(x[0] / 2), np.sin(x[0] / 2) * np.array(x[1])]

    frames, end = timeline(asked, tail)
    passes = [Pass(a * FRAME, b * FRAME, q(p)) for a, b, p in frames]
    curve = orientation_curve(0.0, end * FRAME, q(place), -q(place), spinning, spinning, passes)
    t = np.arange(end + 1) * FRAME
    found, speed = curve.orientation(t), curve.angular_velocity(t)
    assert np.isfinite(found).all() and np.isfinite(speed).all()
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-14)
    for (a, b, _), p in zip(frames, passes, strict=True):
        np.testing.assert_allclose(abs(found[a : b + 1] @ p.point), 1, atol=1e-14)
        if b > a:
            np.testing.assert_array_equal(speed[a : b + 1], 0)
    fine = np.linspace(0, end * FRAME, 4001)
    path = curve.orientation(fine)
    most = 1e-9 + np.linalg.norm(curve.angular_velocity(fine), axis=-1).max() * (fine[1] - fine[0])
    jump = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    assert (2 * jump <= 1.5 * most + 0.01).all()  # no change of sign, no other jump


def test_rotations_in_time():
    q = quaternion([[0.1, 0.2, 0.3], [1.5, -0.3, 0.2], [0.2, 2.4, -1.0], [-0.4, 0.1, 0.9]])
    passes = [Pass(1.3, 1.3, -q[1]), Pass(2.0, 2.4, q[2])]
    curve = orientation_curve(1.0, 3.0, q[0], q[3], BEFORE, AFTER, passes)
    np.testing.assert_allclose(curve.angular_velocity(np.array([1.0, 3.0])), [BEFORE, AFTER], atol=1e-12)
    np.testing.assert_allclose(spin(curve, np.array([1.0 + 2e-5, 3.0 - 2e-5])), [BEFORE, AFTER], atol=1e-2)
    t = np.r_[np.linspace(1.01, 1.99, 97), np.linspace(2.41, 2.99, 50)]
    np.testing.assert_allclose(curve.angular_velocity(t), spin(curve, t), atol=1e-5)
    a, b = curve.angular_velocity(np.array([1.3 - 1e-9, 1.3]))
    np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_allclose(curve.angular_velocity(np.array([2 - 1e-7, 2.4 + 1e-7])), 0, atol=1e-4)


@pytest.mark.parametrize("speed", [0.5, 5.0, 25.0])
def test_fast_spins_keep_their_end_velocity(speed):
    """More than half a turn in a third of the segment: the legs are continued, not taken the short way round."""
    ends = np.array([[speed, 0, 0], [0, speed, 0]])
    curve = orientation_curve(0.0, 0.6, [1, 0, 0, 0], quaternion([0.3, 0, 1.0]), *ends)
    np.testing.assert_allclose(curve.angular_velocity(np.array([0.0, 0.6])), ends, atol=1e-9)
    t = np.linspace(0.01, 0.59, 200)
    np.testing.assert_allclose(curve.angular_velocity(t), spin(curve, t), atol=1e-4 * (1 + speed**2))


def test_too_fast_a_spin_is_shortened():
    curve = orientation_curve(0.0, 1.0, [1, 0, 0, 0], [1, 0, 0, 0], [100.0, 0, 0], [0, 0, 0])
    np.testing.assert_allclose(curve.angular_velocity(np.array([0.0])), [[5.4 * np.pi, 0, 0]], atol=1e-9)


# ---- errors


@pytest.mark.parametrize(
    ("passes", "words"),
    [
        ([Pass(1.2, 1.6, START), Pass(1.5, 1.8, START)], "from 1.5 s to 1.8 s overlaps the pass from 1.2 s to 1.6 s"),
        ([Pass(1.5, 1.5, START), Pass(1.2, 1.5, START)], "at 1.5 s overlaps the pass from 1.2 s to 1.5 s"),
        ([Pass(0.9, 1.2, START)], "from 0.9 s to 1.2 s is outside the shape constraint's 1 s to 3 s"),
        ([Pass(2.9, 3.1, START)], "outside"),
        ([Pass(1.4, 1.2, START)], "ends before it begins"),
        ([Pass(np.nan, 1.2, START)], "finite"),
        ([Pass(1.2, np.inf, START)], "finite"),
        ([Pass(1.2, 1.2, START, tension=np.nan)], "finite"),
        ([Pass(1.2, 1.2, (0, np.nan, 0))], "the point of the pass at 1.2 s"),
    ],
)
def test_impossible_passes(passes, words):
    with pytest.raises(OptionError, match=words.replace("(", r"\(")):
        shape_curve(1.0, 3.0, *ENDS, passes)


@pytest.mark.parametrize("span", [(3.0, 1.0), (1.0, 1.0), (np.nan, 1.0), (0.0, np.inf)])
def test_impossible_spans(span):
    with pytest.raises(OptionError, match="must begin before it ends"):
        shape_curve(*span, *ENDS)


def test_wrong_shapes_and_rotations():
    with pytest.raises(ShapeError, match=r"start_velocity has shape \(2,\)"):
        shape_curve(1.0, 3.0, START, FINISH, [0, 0], AFTER)
    with pytest.raises(ShapeError, match="a quaternion"):
        orientation_curve(1.0, 3.0, START, [1, 0, 0, 0], BEFORE, AFTER)
    with pytest.raises(OptionError, match="a rotation is needed"):
        orientation_curve(1.0, 3.0, [0, 0, 0, 0], [1, 0, 0, 0], BEFORE, AFTER)
    curve = shape_curve(1.0, 3.0, *ENDS)
    with pytest.raises(OptionError, match="not finite"):
        curve.position(np.array([np.nan]))
    with pytest.raises(ShapeError, match="one axis"):
        curve.position(1.0)
