"""All frames at once: against dense and independent solvers, smoothness, layers, lost frames, compilations and memory."""

import sys
from dataclasses import replace

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from deform_cases import NAMES, quaternions, standing
from scipy.linalg import solveh_banded
from scipy.optimize import least_squares as scipy_least_squares
from scipy.spatial.transform import Rotation

from kinjax.deform import (
    STATUSES,
    CenterOfMass,
    LookAt,
    Minimum,
    Orientation,
    Position,
    Settings,
    deform,
    least_squares,
    whole_clip,
)
from kinjax.deform.banded import Bands, factorize, solve, times
from kinjax.deform.clip_problem import Weights, left_jacobian
from kinjax.deform.clip_solver import minimise
from kinjax.deform.plan import make_plan
from kinjax.deform.tasks import Kinds
from kinjax.errors import OptionError, ShapeError
from kinjax.motion import Motion
from kinjax.skeleton import Skeleton, Topology

whole = sys.modules["kinjax.deform.whole_clip"]  # the package's own name is the function's

FEET = (Position("LeftFoot", priority=2), Position("RightFoot", priority=2))
REACH = (*FEET, Position("LeftHand", offset=(0.1, 0.05, 0.15), begin=12, end=24, ease_in=0.1, ease_out=0.1, priority=1))
FRAMES = 40


@pytest.fixture(scope="module")
def motion() -> Motion:
    return standing(FRAMES, sway=0.15)


@pytest.fixture(scope="module")
def reached(motion):
    return whole_clip(motion, REACH)


# ------------------------------------------------------------------------------------------------------------ linear algebra
def dense_case(frames: int, n: int, rng: np.random.Generator) -> tuple[np.ndarray, Bands]:
    """A positive definite matrix `L L'` with two blocks below the diagonal, and its bands, rubbish outside of the matrix."""
    lower = np.zeros((frames, n, frames, n))
    for t in range(frames):
        for k in range(min(t, 2) + 1):
            lower[t, :, t - k] = 0.4 * rng.normal(size=(n, n)) + (k == 0) * 3 * np.eye(n)
    lower = lower.reshape(frames * n, -1)
    matrix = lower @ lower.T
    blocks = matrix.reshape(frames, n, frames, n)
    bands = [np.full((frames, n, n), 7.0) for _ in range(3)]
    for k in range(3):
        for t in range(frames - k):
            bands[k][t] = blocks[t + k, :, t]
    return matrix, Bands(*bands)


@pytest.mark.parametrize("frames", [1, 2, 3, 7, 12])
def test_banded_against_dense(precision, frames):
    rng = np.random.default_rng(frames)
    matrix, bands = dense_case(frames, 4, rng)
    b = rng.normal(size=(frames, 4))
    cast = jax.tree.map(lambda x: jnp.asarray(x, precision), bands)
    factors = factorize(cast)
    x = np.asarray(solve(factors, jnp.asarray(b, precision)))
    close = 1e-10 if precision == "float64" else 1e-5
    assert bool(factors.sound) and x.dtype == precision
    assert np.abs(x.reshape(-1) - np.linalg.solve(matrix, b.reshape(-1))).max() < close
    assert (
        np.abs(np.asarray(times(cast, jnp.asarray(b, precision))).reshape(-1) - matrix @ b.reshape(-1)).max()
        < 10 * close
    )


def test_banded_against_scipy_with_blocks_of_one(x64):
    rng = np.random.default_rng(0)
    frames = 9
    bands = np.stack([10 + rng.random(frames), rng.normal(size=frames), rng.normal(size=frames)])
    b = rng.normal(size=frames)
    x = solve(factorize(Bands(*(jnp.asarray(x)[:, None, None] for x in bands))), jnp.asarray(b)[:, None])
    np.testing.assert_allclose(np.asarray(x)[:, 0], solveh_banded(bands, b, lower=True), atol=1e-12)


def test_banded_padding_and_batches(x64):
    """Frames of the identity change nothing before them; several systems at once are as each alone."""
    rng = np.random.default_rng(1)
    cases = [dense_case(5, 3, rng)[1] for _ in range(3)]
    b = rng.normal(size=(3, 5, 3))
    alone = [
        np.asarray(solve(factorize(jax.tree.map(jnp.asarray, c)), jnp.asarray(x)))
        for c, x in zip(cases, b, strict=True)
    ]

    def filled(c: Bands) -> Bands:
        first, second = c.first.copy(), c.second.copy()
        first[-1:], second[-2:] = 0, 0
        more = np.zeros((4, 3, 3))
        return Bands(*(np.concatenate(x) for x in ((c.diagonal, more + np.eye(3)), (first, more), (second, more))))

    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(filled(c) for c in cases))
    more = jnp.asarray(np.concatenate([b, np.ones((3, 4, 3))], axis=1))
    found = np.asarray(jax.vmap(lambda a, x: solve(factorize(a), x))(stacked, more))
    assert np.abs(found[:, :5] - np.stack(alone)).max() < 1e-13
    assert np.array_equal(found[:, 5:], np.ones((3, 4, 3)))


def test_banded_says_what_is_not_positive_definite(precision):
    _, bands = dense_case(5, 3, np.random.default_rng(2))
    bands.diagonal[2] -= 40 * np.eye(3)
    factors = factorize(jax.tree.map(lambda x: jnp.asarray(x, precision), bands))
    assert not bool(factors.sound)
    assert all(np.isfinite(x).all() for x in factors)


# --------------------------------------------------------------------------------------------------------------- derivatives
def test_left_jacobian_against_rotations(precision):
    """exp(v + d) exp(v)^-1 = J d, by SciPy, from angles where the series is used to nearly two turns."""
    rng = np.random.default_rng(3)
    v = rng.normal(size=(40, 3))
    v *= (np.geomspace(1e-6, 6.0, 40) / np.linalg.norm(v, axis=1))[:, None]
    got = np.asarray(left_jacobian(jnp.asarray(v, precision)))
    back = Rotation.from_rotvec(v).inv()
    for k, d in enumerate(1e-5 * np.eye(3)):
        turn = (Rotation.from_rotvec(v + d) * back).as_rotvec() - (Rotation.from_rotvec(v - d) * back).as_rotvec()
        assert np.abs(got[:, :, k] - turn / 2e-5).max() < (1e-9 if precision == "float64" else 2e-6)


EVERY = (
    Position("LeftFoot", point=(0.1, 0.02, 0.03), axes="xz"),
    Orientation("LeftFoot", offset=(0.5, 0.4, -0.3), axes="xz", weight=2.0),
    Orientation("RightHand", offset=(0.5, 1.4, -0.3)),
    CenterOfMass(support=("LeftFoot", "RightFoot"), displacement=(0.02, 0.0, 0.0)),
    LookAt("Head", at=(2.0, 0.5, 1.5), axis=(1, 0, 0), point=(0.1, 0, 0.05)),
    LookAt("Neck", at=(0.2, 0.5, 0.5), axis=(1, 0, 0), point=(0.1, 0, 0.05), relative_to="LeftArm"),
    Position("LeftHand", relative_to="Head", offset=(0.1, 0.1, 0.1)),
    Orientation("RightHand", relative_to="Neck", offset=(0.3, 0.0, 0.8), axes="xy"),
    CenterOfMass(relative_to="LeftHand"),
)


def laid_out(motion: Motion, goals, dtype: str, weights=(1e-3, 1e-2, 0.2)):
    """The problem as the solver gets it, and its kinds."""
    plan = make_plan(motion, tuple(goals), Settings())
    return whole._problem(plan, Weights(*weights), 10.0, np.dtype(dtype))[0], plan.kinds


def test_jacobian_is_exact_for_every_kind(precision):
    """The closed form through the kinematics against JAX's forward mode, far from the input, large residuals."""
    problem, kinds = laid_out(standing(3, sway=0.2), EVERY, precision)
    u = jnp.asarray(np.random.default_rng(4).normal(size=3 + 3 * problem.spread.shape[1]) * 0.5, precision)
    frame = jax.tree.map(lambda x: jnp.asarray(x[1]), problem.frames)
    problem = jax.tree.map(jnp.asarray, problem)
    jac, r = jax.jit(lambda u: problem.jacobian(kinds, frame, u))(u)
    want = jax.jit(jax.jacfwd(lambda u: problem.asked(kinds, frame, u).reshape(-1)))(u)
    assert kinds == Kinds(True, True, True) and np.abs(r).max() > 0.1 and np.abs(want).max() > 0.5
    np.testing.assert_allclose(jac, want, atol=1e-13 if precision == "float64" else 2e-5)


def test_matrix_and_gradient_are_those_of_the_terms(x64):
    """Gauss-Newton matrix, gradient and second derivatives against the dense ones of all terms, in a clip with a lost frame."""
    motion = standing(7, sway=0.2)
    motion.rotations[3, 1] = np.nan
    problem, kinds = laid_out(motion, EVERY[:3], "float64")
    problem = jax.tree.map(jnp.asarray, problem)
    problem = problem._replace(frames=jax.tree.map(lambda x: x[:9], problem.frames), valid=problem.valid[:9])
    u = jnp.asarray(np.random.default_rng(5).normal(size=(9, 3 + 3 * problem.spread.shape[1])) * 0.3)

    def terms(x):
        return jnp.concatenate([e.reshape(-1) for e in problem.errors(kinds, x.reshape(u.shape))])

    x = u.reshape(-1)
    jac, r = np.asarray(jax.jit(jax.jacfwd(terms))(x)), np.asarray(jax.jit(terms)(x))
    local = jax.jit(lambda u: problem.local(kinds, u))(u)

    def dense(bands: Bands):
        return jax.vmap(lambda x: times(bands, x.reshape(u.shape)).reshape(-1))(jnp.eye(u.size))

    gauss = dense(local.bands._replace(diagonal=local.bands.diagonal - local.turning))
    np.testing.assert_allclose(gauss, jac.T @ jac, atol=1e-10)
    np.testing.assert_allclose(np.asarray(local.gradient).reshape(-1), jac.T @ r, atol=1e-10)
    hessian = jax.jit(jax.hessian(lambda x: jnp.sum(terms(x) ** 2) / 2))(x)
    np.testing.assert_allclose(dense(local.bands), hessian, atol=1e-8)
    assert np.abs(local.turning).max() > 0.1


# ------------------------------------------------------------------------------------------- an arm, by SciPy and NumPy alone
ARM = Skeleton(
    np.array([[0, 0, 1.0], [0, 0.1, 0.2], [0, 0.3, 0], [0, 0.25, 0]]),
    np.zeros((0, 3)),
    Topology(("Base", "Upper", "Lower", "Tip"), (-1, 0, 1, 2), up="z"),
)
ARM_FRAMES, ARM_RATE = 9, 30.0
NUMBERS = {"ratio": 3.0, "velocity": 2e-3, "acceleration": 3e-4, "attraction": 0.03}
TIP, ELBOW = np.array([0.1, 0.45, 1.5]), np.array([0.2, 0.3, 1.1])


@pytest.fixture(scope="module")
def arm() -> Motion:
    phase = np.arange(ARM_FRAMES)[:, None, None] / 5 + np.arange(4)[:, None] + np.arange(3)
    return Motion(np.tile(ARM.offsets[:1], (ARM_FRAMES, 1, 1)), quaternions(0.3 * np.sin(phase)), ARM, ARM_RATE)


ARM_GOALS = (
    Position("Tip", at=TIP, begin=2, end=6, ease_in=0.0, ease_out=0.0, priority=2),
    Position("Lower", at=ELBOW, begin=4, end=8, ease_in=0.0, ease_out=0.0, priority=1, weight=0.5),
)


def arm_terms(x: np.ndarray, motion: Motion) -> np.ndarray:
    """All terms of the arm's problem, written out once more: displacements of the root, Base, Upper and Lower."""
    u = x.reshape(ARM_FRAMES, 12)
    input_turns = [Rotation.from_quat(motion.rotations[:, j, [1, 2, 3, 0]]) for j in range(3)]
    place, turn, places = motion.translations[:, 0] + u[:, :3], Rotation.identity(ARM_FRAMES), []
    for j in range(4):
        place = place if j == 0 else place + turn.apply(ARM.offsets[j])
        places.append(place)
        if j < 3:
            turn = turn * Rotation.from_rotvec(u[:, 3 + 3 * j : 6 + 3 * j]) * input_turns[j]
    tip, elbow = 3.0 * (TIP - places[3])[2:7], np.sqrt(0.5) * (ELBOW - places[2])[4:9]
    smooth = NUMBERS["velocity"] * ARM_RATE * np.diff(u, axis=0)
    bent = NUMBERS["acceleration"] * ARM_RATE**2 * np.diff(u, 2, axis=0)
    return np.concatenate([t.ravel() for t in (tip, elbow, NUMBERS["attraction"] * u, smooth, bent)])


@pytest.fixture(scope="module")
def bent_arm(arm):
    return whole_clip(arm, ARM_GOALS, tolerance=1e-9, **NUMBERS)


def test_the_minimum_is_scipys(arm, bent_arm):
    """Terms by NumPy, derivatives by differences, SciPy's optimiser, from the input."""
    found = scipy_least_squares(
        arm_terms,
        np.zeros(12 * ARM_FRAMES),
        jac="3-point",
        args=(arm,),
        xtol=1e-14,
        ftol=1e-15,
        gtol=1e-12,
        max_nfev=400,
    )
    ours = bent_arm.again.displacement[:, :12]
    assert bent_arm.again.converged and np.abs(ours).max() > 0.2
    assert bent_arm.again.cost == pytest.approx(found.cost, rel=1e-9)
    assert np.abs(ours - found.x.reshape(ours.shape)).max() < 1e-6


def test_gradient_is_zero_at_the_result(arm, bent_arm):
    """By central differences of the sum that NumPy writes out; at the input it is not."""
    x = bent_arm.again.displacement[:, :12].ravel()

    def slope(x: np.ndarray) -> float:
        steps = 1e-5 * np.eye(len(x))
        return max(abs((arm_terms(x + d, arm) ** 2).sum() - (arm_terms(x - d, arm) ** 2).sum()) / 4e-5 for d in steps)

    assert slope(x) < 1e-8 and slope(0 * x) > 1e-2
    assert bent_arm.again.gradient < 1e-8


# ------------------------------------------------------------------------------------------------------------------ the clip
@pytest.mark.slow
def test_without_smoothness_it_is_frame_by_frame(motion):
    """The same weights through the solver that knows one frame at a time."""
    short = motion.slice(0, 11)
    goals = [*FEET, Position("LeftHand", offset=(0.1, 0.05, 0.1), begin=0, priority=1)]
    each = least_squares(short, goals, Settings(iterations=200), pull=0.03)
    once = whole_clip(short, goals, velocity=0.0, acceleration=0.0, attraction=0.03, tolerance=1e-8)
    apart = np.abs(each.motion.rotations - once.motion.rotations)
    assert once.again.converged and apart.max() < 1e-5
    assert np.abs(each.motion.translations - once.motion.translations).max() < 1e-5
    assert np.abs(once.motion.rotations - short.rotations).max() > 0.03


def test_constraints_hold_and_the_map_eases(motion, reached):
    assert reached.again.converged and isinstance(reached.again, Minimum)
    assert np.nanmax(reached.report.residual[:, :2]) < 5e-5 and np.nanmax(reached.report.residual[:, 2]) < 2e-3
    u = reached.again.displacement
    assert np.abs(u[18]).max() > 0.1
    # it neither starts nor ends with the constraint: what is asked begins at frame 6
    arm = np.linalg.norm(u.reshape(FRAMES, -1, 3)[:, 1 + NAMES.index("LeftArm")], axis=1)
    assert (arm[:6] > 1e-3).all() and arm[0] < 0.2 * arm.max()


def test_what_no_constraint_recruits_stays(motion, reached):
    for name in ("RightArm", "RightForeArm", "RightHand", "Head", "LeftHand", "LeftFoot"):
        assert np.array_equal(reached.motion.rotations[:, NAMES.index(name)], motion.rotations[:, NAMES.index(name)])
    none = whole_clip(motion, [])
    assert np.array_equal(none.motion.rotations, motion.rotations)
    assert np.array_equal(none.motion.translations, motion.translations)
    kept = whole_clip(motion, FEET)
    assert np.abs(kept.motion.rotations - motion.rotations).max() < 1e-12


@pytest.mark.slow
def test_acceleration_falls_as_its_weight_grows(motion):
    """And the constraint gives way little by little: the bounds are metres, by weight."""
    worst, off = [], []
    for weight in (0.0, 3e-5, 1e-4, 1e-3):
        d = whole_clip(motion, REACH, acceleration=weight)
        worst.append(np.sqrt((np.diff(d.again.displacement, 2, axis=0) ** 2).sum()) * motion.rate**2)
        off.append(np.nanmax(d.report.residual[:, 2]))
    assert (np.diff(worst) < -0.05 * np.array(worst[:-1])).all() and worst[-1] < 0.5 * worst[0]
    assert (np.array(off) < [1e-4, 2e-3, 8e-3, 0.05]).all() and off[-1] > off[0]


@pytest.mark.parametrize("ratio", [pytest.param(3.0, marks=pytest.mark.slow), 10.0])
def test_a_higher_layer_holds_better(motion, ratio):
    """Two goals for one hand: the mean of both, weighted by the squares, as far as the weak terms let it."""
    a, b = np.array([0.3, 0.3, 1.2]), np.array([0.3, 0.3, 1.3])
    goals = [*(replace(f, priority=3) for f in FEET)]
    goals += [
        Position("LeftHand", at=x, begin=15, end=25, ease_in=0.1, ease_out=0.1, priority=p) for x, p in ((a, 2), (b, 1))
    ]
    d = whole_clip(motion, goals, ratio=ratio, acceleration=1e-5)
    high, low = d.report.residual[20, 2:]
    assert high == pytest.approx(0.1 / (1 + ratio**2), rel=0.03) and low == pytest.approx(0.1 - high, rel=0.01)
    assert np.nanmax(d.report.residual[:, :2]) < 0.1 * high


def test_a_lost_frame_parts_the_clip(motion):
    """Nothing couples across it: both sides are what they are alone; it stays as it was given and is flagged."""
    goals = [*FEET, Position("LeftHand", offset=(0.1, 0.05, 0.1), begin=0, priority=1)]
    q = np.array(motion.rotations)
    q[20:22, NAMES.index("LeftLeg")] = np.nan
    d = whole_clip(replace(motion, rotations=q), goals, tolerance=1e-8)
    np.testing.assert_array_equal(d.motion.rotations[20:22], q[20:22])
    assert (d.report.status[20:22] == STATUSES.index("nonfinite")).all()
    others = np.r_[0:20, 22:FRAMES]
    assert not (d.report.status[others] == STATUSES.index("nonfinite")).any()
    for part in (slice(0, 20), slice(22, FRAMES)):
        alone = whole_clip(motion.slice(part.start, part.stop - 1), goals, tolerance=1e-8)
        assert np.abs(alone.motion.rotations - d.motion.rotations[part]).max() < 1e-6
        assert np.abs(alone.motion.translations - d.motion.translations[part]).max() < 1e-6


def test_a_clip_of_nothing_but_lost_frames(motion):
    d = whole_clip(replace(motion, rotations=np.full_like(motion.rotations, np.nan)), FEET)
    assert (d.report.status == STATUSES.index("nonfinite")).all() and np.isnan(d.motion.rotations).all()


@pytest.mark.parametrize("frames", [1, 2])
def test_very_short_clips(frames):
    d = whole_clip(standing(frames, sway=0.1), [*FEET, Position("LeftHand", at=(0.25, 0.3, 1.2), priority=1)])
    assert d.again.converged and np.nanmax(d.report.residual) < 1e-4


def test_too_few_steps_are_said(motion):
    d = whole_clip(motion, REACH, steps=1)
    off = d.report.residual > 1e-4
    assert not d.again.converged and off.any() and (d.report.status[off] == STATUSES.index("max_iter")).all()
    assert "not a minimum" in d.report.notes[-1]


@pytest.mark.slow
def test_out_of_reach_stalls(motion):
    """The minimum is found all the same; the layers above give way by their weight."""
    far = Position("LeftHand", at=(2.5, 0.5, 1.2), begin=15, end=20, ease_in=0.2, ease_out=0.2, priority=1)
    d = whole_clip(motion, [*FEET, far], attraction=0.02)
    assert d.again.converged
    assert d.report.residual[17, 2] > 0.1 and np.nanmax(d.report.residual[:, :2]) < 0.1 * d.report.residual[17, 2]
    assert d.report.status[17, 2] == STATUSES.index("stalled")


@pytest.mark.slow
def test_it_starts_where_it_is_told(motion, reached):
    """From its own result nothing is left to do; the result of `deform` leads to a minimum no worse than the input does."""
    again = whole_clip(motion, REACH, start=reached.motion)
    assert again.again.steps <= 5 < reached.again.steps
    assert np.abs(again.motion.rotations - reached.motion.rotations).max() < 1e-4
    other = whole_clip(motion, REACH, start=deform(motion, REACH).motion)
    assert other.again.converged and other.again.cost < 1.01 * reached.again.cost


@pytest.mark.slow
def test_float32_is_near_float64(motion, reached):
    d = whole_clip(motion, REACH, Settings(precision="float32"))
    assert d.again.cost < 1.3 * reached.again.cost
    assert np.abs(d.report.residual - reached.report.residual)[np.isfinite(d.report.residual)].max() < 1e-3
    assert np.abs(d.again.displacement - reached.again.displacement).max() < 0.1


def test_a_kilometre_from_the_origin(motion, reached):
    away = replace(motion, translations=motion.translations + np.array([1000.0, -2000.0, 0.0]))
    d = whole_clip(away, REACH)
    assert np.abs(d.motion.rotations - reached.motion.rotations).max() < 1e-6
    d = whole_clip(away, REACH, Settings(precision="float32"))
    assert np.nanmax(d.report.residual[:, :2]) < 1e-4 and np.nanmax(d.report.residual[:, 2]) < 3e-3


@pytest.fixture
def compilations():
    """A list that grows by one with every XLA compilation."""
    seen = []

    def listen(name, seconds, **_):
        if name == "/jax/core/compile/backend_compile_duration":
            seen.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


def test_lengths_of_one_bucket_and_other_numbers_compile_nothing(motion, compilations):
    jax.clear_caches()
    whole_clip(motion, REACH)
    assert compilations  # the listener hears
    compilations.clear()
    whole_clip(
        standing(61, sway=0.1), REACH[::-1], ratio=5.0, velocity=0.0, acceleration=1e-3, attraction=1e-2, steps=7
    )
    assert not compilations


def sizes(jaxpr) -> list[int]:
    """Elements of every array that a program makes, in its loops and branches, too."""
    out = []
    for eqn in jaxpr.eqns:
        out += [int(np.prod(v.aval.shape)) for v in eqn.outvars]
        for inner in jax.extend.core.jaxprs_in_params(eqn.params):
            out += sizes(inner)
    return out


@pytest.mark.slow
def test_memory_grows_with_the_frames(x64):
    """The largest array of a program of twice the frames is twice as large, and far from the square of the unknowns."""
    largest, unknowns = [], []
    for frames in (128, 256):
        problem, kinds = laid_out(standing(frames), REACH, "float64")
        start = np.zeros((frames, 3 + 3 * problem.spread.shape[1]))
        with jax.numpy_dtype_promotion("standard"):
            made = jax.make_jaxpr(lambda p, s, k=kinds: minimise(p, k, s, jnp.int32(9), jnp.float64(1e-6)))(
                problem, start
            )
        largest.append(max(sizes(made.jaxpr)))
        unknowns.append(start.size)
    assert largest[1] <= 2 * largest[0] and largest[1] < unknowns[1] ** 2 / 50
    assert largest[1] >= unknowns[1] * start.shape[1]  # the walk sees the blocks


@pytest.mark.parametrize(
    "wrong",
    [
        {"ratio": 0.0},
        {"attraction": 0.0},
        {"velocity": -1.0},
        {"acceleration": float("nan")},
        {"steps": 0},
        {"tolerance": "1"},
    ],
    ids=str,
)
def test_numbers_that_make_no_sense(motion, wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        whole_clip(motion, FEET, **wrong)


def test_a_start_of_another_length(motion):
    with pytest.raises(ShapeError, match="start"):
        whole_clip(motion, FEET, start=motion.slice(0, 10))
