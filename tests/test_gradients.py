"""The contract of docs/gradients.md for kinematics and detection: derivatives forward and reverse, first and second order, and what they
are at rest, at half a turn, where frames are missing. Deformation: test_bend; soft detection: test_soft."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from kinjax.detect.displacements import displacements, mean_pose
from kinjax.detect.refit import Moments, fit
from kinjax.detect.sigma_epsilon import project
from kinjax.forward import world_transforms
from kinjax.rotations import apply_transposed, dot, exp, log, matrix, multiply, normalize
from kinjax.splines import monotone_cubic, natural_cubic

RNG = np.random.default_rng(5)


def poses(turns: np.ndarray, places: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """(4, 1, F), (3, 1, F) from rotation vectors and places (F, 3)."""
    return exp(jnp.asarray(turns.T))[:, None], jnp.asarray(places.T)[:, None]


def signals(q, t):
    """sigma_3, eps_3, eps_1 and where the axis is, of all displacements."""
    seen = jnp.ones(t.shape[1:], bool)
    y = project(displacements(normalize(q), t, seen, 1))
    return jnp.stack([y.sigma_3, y.eps_3, y.eps_1]), y.point, y.axis


def test_sigma_epsilon_to_second_order_both_ways(x64):
    q, t = poses(RNG.normal(size=(5, 3)), RNG.normal(size=(5, 3)))
    check_grads(jax.jit(signals), (q, t), order=2, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)
    along = jnp.asarray(RNG.normal(size=q.shape)), jnp.asarray(RNG.normal(size=t.shape))
    h = 1e-5
    exact = jax.jvp(signals, (q, t), along)[1]

    def central(k):
        beside = (signals(q + s * h * along[0], t + s * h * along[1]) for s in (k, -k))
        return jax.tree.map(lambda a, b: (a - b) / (2 * k * h), *beside)

    apart = [central(k) for k in (1, 2)]
    for e, one, two in zip(exact, *apart, strict=True):  # Richardson: fourth order
        np.testing.assert_allclose(e, (4 * one - two) / 3, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-7, np.pi - 1e-9, np.pi, np.pi + 1e-9])
@pytest.mark.parametrize("slide", [0.0, 0.1])
def test_sigma_epsilon_is_finite_at_rest_and_at_half_a_turn(precision, turn, slide):
    axis = np.array([0.0, 0.6, 0.8])
    turns, places = np.stack([0 * axis, turn * axis, turn * axis]), np.array([[0, 0, 0], [slide, 0, 0], [slide, 0, 0]])
    q, t = poses(turns.astype(precision), places.astype(precision))
    loss = lambda q, t: sum(jnp.sum(x) for x in signals(q, t))  # noqa: E731
    for g in (*jax.grad(loss, (0, 1))(q, t), *jax.jacfwd(loss, (0, 1))(q, t)):
        assert np.isfinite(g).all()
    at_rest = jax.grad(lambda t: jnp.sum(signals(q, t)[0][:2, :, 1]))(t)  # nothing moves in the second interval
    assert not np.asarray(at_rest).any()


def moments(turns, places):
    """`Moments` of one span from rotation vectors and places (F, 3)."""
    q, t = exp(turns.T), places.T
    r = matrix(q)
    total = [jnp.sum(x, axis=-1)[..., None] for x in (r, t, apply_transposed(r, t), dot(t, t))]
    return Moments(jnp.full(1, float(len(turns)), t.dtype), *total)


def refitted(turns, places, line):
    """Point, residual, spread and (squared, since its sign is free) axis of a span."""
    y = fit(moments(turns, places), jnp.full(1, 1e-2 if line else 0.0), jnp.zeros(1), jnp.inf)
    axis = y.axis[:, None] * y.axis[None]
    return jnp.concatenate([y.point.ravel(), y.residual, y.spread, y.center.ravel(), axis.ravel() if line else y.point.ravel()])


@pytest.mark.parametrize("line", [True, False], ids=["line", "point"])
def test_refit_is_differentiable(x64, line):
    spread = np.array([1.0, 0.05, 0.03]) if line else np.ones(3)
    turns, lever = RNG.normal(size=(9, 3)) * 0.4 * spread, np.array([0.1, -0.2, 0.3])
    from scipy.spatial.transform import Rotation

    places = jnp.asarray(Rotation.from_rotvec(turns).apply(lever) + RNG.normal(size=(9, 3)) * 0.05)
    turns = jnp.asarray(turns)
    along = jnp.asarray(RNG.normal(size=turns.shape)), jnp.asarray(RNG.normal(size=turns.shape))
    f = lambda a, b: refitted(a, b, line)  # noqa: E731
    exact, h = jax.jvp(f, (turns, places), along)[1], 1e-3

    def central(k):
        after, before = (f(turns + s * h * along[0], places + s * h * along[1]) for s in (k, -k))
        return (after - before) / (2 * k * h)

    np.testing.assert_allclose(exact, (15 * central(1) - 6 * central(2) + central(3)) / 10, rtol=1e-9, atol=1e-9)
    back = jax.grad(lambda a, b: jnp.sum(f(a, b)), (0, 1))(turns, places)
    by = sum(float(jnp.vdot(g, d)) for g, d in zip(back, along, strict=True))
    assert abs(by - float(jnp.sum(exact))) < 1e-10 * max(abs(by), 1)


@pytest.mark.parametrize("line", [True, False], ids=["line", "point"])
def test_refit_is_finite_at_rest(precision, line):
    turns, places = jnp.zeros((6, 3), precision), jnp.ones((6, 3), precision)
    g = jax.grad(lambda a, b: jnp.sum(refitted(a, b, line)), (0, 1))(turns, places)
    assert all(np.isfinite(x).all() for x in g)


def test_kinematics_to_second_order_under_jit_and_vmap(x64):
    parents, frames = jnp.array([-1, 0, 1, 1], jnp.int32), 3
    q = jnp.asarray(RNG.normal(size=(4, 4, frames)))
    moving, offsets = jnp.asarray(RNG.normal(size=(1, 3, frames))), jnp.asarray(RNG.normal(size=(4, 3)))

    def where(q, moving, offsets):
        unit = q / jnp.sqrt(jnp.sum(q * q, axis=1, keepdims=True))
        return jnp.stack(world_transforms(unit, moving, offsets, parents, jnp.zeros(1, jnp.int32)))

    check_grads(jax.jit(where), (q, moving, offsets), order=2, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)
    longer = jax.jvp(lambda q: world_transforms(q, moving, offsets, parents, jnp.zeros(1, jnp.int32)), (q,), (q,))[1]
    np.testing.assert_allclose(jnp.stack(longer), 0, atol=1e-12)  # what changes a quaternion's length alone
    many = jax.vmap(jax.grad(lambda x: jnp.sum(where(x, moving, offsets) ** 2)))(jnp.stack([q, 2 * q]))
    np.testing.assert_allclose(many[0], 2 * many[1], atol=1e-12)


def test_gimbal_positions_are_like_any_other(x64):
    """Two axes of an Euler triple fall together there; quaternions do not know."""
    from scipy.spatial.transform import Rotation

    parents, none = jnp.array([-1, 0, 1], jnp.int32), jnp.zeros(0, jnp.int32)
    angles = RNG.uniform(-180, 180, size=(3, 6, 3))
    angles[:, :, 1] = np.where(np.arange(6) % 2, 90.0, -90.0)
    q = Rotation.from_euler("ZXY", angles.reshape(-1, 3), degrees=True).as_quat(scalar_first=True)
    q = jnp.asarray(np.moveaxis(q.reshape(3, 6, 4), 1, 2))
    moving, offsets = jnp.zeros((0, 3, 6)), jnp.asarray(RNG.normal(size=(3, 3)))
    along, h = jnp.asarray(RNG.normal(size=(3, 3, 6))), 1e-5

    @jax.jit
    def where(v):
        turned = jnp.swapaxes(multiply(jnp.swapaxes(q, 0, 1), exp(jnp.swapaxes(v, 0, 1))), 0, 1)
        return jnp.stack(world_transforms(turned, moving, offsets, parents, none))

    slope = jax.jvp(where, (0 * along,), (along,))[1]
    np.testing.assert_allclose(slope, (where(h * along) - where(-h * along)) / (2 * h), atol=1e-8)
    assert np.isfinite(jax.grad(lambda v: jnp.sum(where(v) ** 3))(0 * along)).all()


def test_rotation_vectors_are_smooth_through_zero(x64):
    for v in (np.zeros(3), np.full(3, 1e-9), np.array([0.3, -0.2, 0.1]), np.array([0.0, 0, 3.1])):
        check_grads(lambda x: log(exp(x)), (jnp.asarray(v),), order=2, modes=("fwd", "rev"), atol=1e-4, rtol=1e-4)


def test_a_missing_frame_does_not_leak_through_the_mean_pose(x64):
    q, t = poses(RNG.normal(size=(12, 3)) * 0.1, RNG.normal(size=(12, 3)))
    seen = jnp.ones((1, 12), bool).at[0, 5].set(False)

    def mean(t):
        return jnp.sum(mean_pose(q, t, seen, 2)[1][:, :, :5] ** 2) + jnp.sum(mean_pose(q, t, seen, 2)[1][:, :, 6:] ** 2)

    g = jax.grad(mean)(t)
    assert not np.asarray(g[:, :, 5]).any() and np.asarray(jnp.abs(g).sum((0, 1)) > 0).sum() == 11


@pytest.mark.parametrize("curve", [natural_cubic, monotone_cubic])
def test_thresholds_over_time_are_differentiable(x64, curve):
    at, knots = jnp.linspace(-1, 12, 14), jnp.array([0.0, 3, 7, 10])
    values = jnp.array([1.0, 1.4, 1.1, 2.0])
    check_grads(lambda v: curve(at, knots, v, jnp.int32(4)), (values,), order=1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)
