"""Balance: the relation of section 4.3 in closed form, the displacement map, and real leg lengths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from kinjax.anthropometry import leg_length, segment_masses
from kinjax.deform.balance import balance_offsets, barycentre, displacement_path
from kinjax.errors import OptionError, ShapeError
from kinjax.synthetic import biped_skeleton

F = 40
RNG = np.random.default_rng(0)
CENTER, FEET = RNG.normal(size=(F, 3)), RNG.normal(size=(F, 4, 3))


def test_the_same_body_keeps_its_place_over_its_support():
    offsets = balance_offsets(CENTER, FEET, 0.8, 0.8)
    np.testing.assert_allclose(offsets, CENTER - FEET.mean(1), atol=1e-15)


@pytest.mark.parametrize("output", [0.4, 0.8, 1.3])
def test_the_relation_holds(output):
    """N1 (P' - mean A') = N2 (P - mean A), with lengths measured in legs."""
    offsets = balance_offsets(CENTER, FEET, 0.8, output)
    np.testing.assert_allclose(offsets / output, (CENTER - FEET.mean(1)) / 0.8, atol=1e-14)


def test_a_moved_and_scaled_copy_is_balanced_like_its_original():
    """A figure twice as large, elsewhere, that moves alike: its own centre of mass is the target."""
    shift = np.array([100.0, 0, -50])
    offsets = balance_offsets(CENTER, FEET, 0.8, 1.6)
    np.testing.assert_allclose(offsets + barycentre(2 * FEET + shift), 2 * CENTER + shift, atol=1e-12)


def test_legs_are_measured_on_skeletons():
    small = biped_skeleton()
    large = replace(small, offsets=1.5 * small.offsets, end_offsets=1.5 * small.end_offsets)
    assert leg_length(small) == pytest.approx(0.78)
    offsets = balance_offsets(CENTER, FEET, small, large)
    np.testing.assert_allclose(offsets, 1.5 * (CENTER - FEET.mean(1)), atol=1e-14)
    np.testing.assert_allclose(segment_masses(large).centers, 1.5 * segment_masses(small).centers, atol=1e-15)


def test_barycentre_or_points():
    np.testing.assert_array_equal(barycentre(FEET), FEET.mean(1))
    np.testing.assert_array_equal(balance_offsets(CENTER, FEET.mean(1), 1, 1), balance_offsets(CENTER, FEET, 1, 1))


def test_missing_frames_stay_missing_alone():
    lost = CENTER.copy()
    lost[7] = np.nan
    offsets = balance_offsets(lost, FEET, 1, 1)
    assert np.isnan(offsets[7]).all() and np.isfinite(np.delete(offsets, 7, 0)).all()


# ---- displacement map


def test_constant_and_whole_displacements():
    lean, sway = (0.0, 0.0, 0.1), RNG.normal(size=(F, 3))
    plain = balance_offsets(CENTER, FEET, 0.8, 1.6)
    np.testing.assert_allclose(balance_offsets(CENTER, FEET, 0.8, 1.6, lean), plain + lean, atol=1e-15)
    np.testing.assert_allclose(balance_offsets(CENTER, FEET, 0.8, 1.6, sway), plain + sway, atol=1e-15)
    np.testing.assert_array_equal(displacement_path(sway.tolist(), F), sway)


KEYS = [(0.5, (0.0, 0, 0)), (0.1, (1.0, 2, 3)), (1.2, np.array([0.0, 1, -1])), (0.8, [0.5, 0, 0])]


@pytest.mark.parametrize("interpolation", ["monotone", "cubic"])
def test_key_frames(interpolation):
    rate, frames = 50.0, 100
    found = displacement_path(KEYS, frames, rate, interpolation)
    times, vectors = np.array([0.1, 0.5, 0.8, 1.2]), np.array([[1.0, 2, 3], [0, 0, 0], [0.5, 0, 0], [0, 1, -1]])
    np.testing.assert_allclose(found[[5, 25, 40, 60]], vectors, atol=1e-14)
    np.testing.assert_allclose(found[:5], np.broadcast_to(vectors[0], (5, 3)), atol=1e-14)
    np.testing.assert_allclose(found[60:], np.broadcast_to(vectors[-1], (40, 3)), atol=1e-14)
    peer = {"monotone": PchipInterpolator(times, vectors), "cubic": CubicSpline(times, vectors, bc_type="natural")}
    np.testing.assert_allclose(found[5:61], peer[interpolation](np.arange(5, 61) / rate), atol=1e-13)
    if interpolation == "monotone":
        assert (found[:, 0] >= 0).all() and (found[:, 0] <= 1).all()


def test_one_and_two_key_frames():
    np.testing.assert_array_equal(displacement_path([(3.0, (1, 2, 3))], 4, 10.0), [[1, 2, 3]] * 4)
    two = displacement_path([(0.0, (0, 0, 0)), (0.4, (4.0, 0, 0))], 6, 10.0)
    np.testing.assert_allclose(two[:, 0], [0, 1, 2, 3, 4, 4], atol=1e-14)


def test_three_numbers_are_one_vector_even_in_three_frames():
    np.testing.assert_array_equal(displacement_path((1, 2, 3), 3), [[1, 2, 3]] * 3)
    np.testing.assert_array_equal(displacement_path(np.eye(3), 3), np.eye(3))


# ---- errors


@pytest.mark.parametrize(
    ("displacement", "rate", "error", "words"),
    [
        ((1.0, 2.0), 10, ShapeError, r"shape \(2,\)"),
        (np.zeros((F + 1, 3)), 10, ShapeError, r"shape \(41, 3\)"),
        ((0, np.nan, 0), 10, OptionError, "not finite"),
        ([(0.0, (1, 2, 3)), (np.nan, (1, 2, 3))], 10, OptionError, "not finite"),
        ([(0.5, (1, 2, 3)), (0.5, (1, 2, 4))], 10, OptionError, "at 0.5 s"),
        ([(0.5, (1, 2, 3))], None, OptionError, "frames a second"),
        ([(0.5, (1, 2, 3))], -1.0, OptionError, "frames a second"),
        ([(0.5, (1, 2))], 10, ShapeError, "neither"),
    ],
)
def test_impossible_displacements(displacement, rate, error, words):
    with pytest.raises(error, match=words):
        balance_offsets(CENTER, FEET, 1, 1, displacement, rate)


def test_impossible_rest():
    with pytest.raises(OptionError, match="choose monotone or cubic"):
        displacement_path([(0.5, (1, 2, 3))], 4, 10.0, "linear")
    with pytest.raises(OptionError, match="the input's leg length is 0"):
        balance_offsets(CENTER, FEET, 0.0, 1)
    with pytest.raises(OptionError, match="output's leg length"):
        balance_offsets(CENTER, FEET, 1, np.nan)
    with pytest.raises(ShapeError, match="support has 39 frames"):
        balance_offsets(CENTER, FEET[1:], 1, 1)
    with pytest.raises(ShapeError, match="center has shape"):
        balance_offsets(CENTER[0], FEET, 1, 1)
    with pytest.raises(ShapeError, match="support has shape"):
        balance_offsets(CENTER, np.zeros((F, 0, 3)), 1, 1)
