"""Derivatives through the deformation: against finite differences, against the iterations themselves, at the hard spots."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deform_cases import NAMES, standing

from kinjax.deform import Bend, CenterOfMass, LookAt, Orientation, Position, Settings, deform, implicit
from kinjax.deform import conditions as holds
from kinjax.errors import OptionError, ShapeError
from kinjax.kinematics import forward_kinematics

EXACT = Settings(iterations=100, tolerance=1e-12, passes=1, drag=0.0)
"""Goes on until nothing is left, so that finite differences of it mean something."""
FRAMES = 4
RNG = np.random.default_rng(3)
MOTION = standing(FRAMES, sway=0.1)
IN_THE_WORLD = [
    Position("LeftFoot", priority=4),
    Position("RightFoot", priority=4),
    Orientation("LeftFoot", priority=4),
    Position("LeftHand", offset=(0.1, 0.05, 0.1), axes="xz", priority=3),
    Position("LeftArm", offset=(0.0, 0.01, -0.02), weight=0.5, priority=3),
    CenterOfMass(offset=(0.01, -0.02, 0.0), priority=2),
    Position("RightHand", offset=(0.02, 0.01, 0.02), priority=1, recruit_to="RightArm"),
]
ON_THE_BODY = [
    Position("LeftFoot", priority=2),
    Position("LeftHand", relative_to="Spine", offset=(0.03, -0.06, 0.02), priority=1),
    LookAt("Head", axis=(1, 0, 0), at=(3.0, 0.5, 1.5), priority=1),
    Position("RightHand", offset=(0.03, 0.06, 0.02), priority=1),
    Position("RightHand", offset=(-0.01, 0.08, 0.0), weight=0.5, priority=1),  # both cannot be
]
ALL = ("place", "rotation", "weight", "offsets", "rotations", "translations", "masses")


def directions(bend: Bend) -> dict[str, np.ndarray]:
    """A direction for each variable; along quaternions one that leaves them of unit length."""
    out = {}
    for name in ALL:
        x = np.asarray(getattr(bend.variables, name))
        d = RNG.normal(size=x.shape)
        if name in ("rotation", "rotations"):
            d -= x * (d * x).sum(-1, keepdims=True)
        out[name] = d if name != "masses" else d * x
    return out


def scored(bend: Bend, weights: np.ndarray):
    """A loss that sees every joint of every frame."""

    def loss(v):
        motion = bend(v).motion
        skeleton = replace(motion.skeleton, offsets=v.offsets)
        return jnp.sum(forward_kinematics(replace(motion, skeleton=skeleton))[1] * weights)

    return loss


def slope(loss, bend: Bend, name: str, direction: np.ndarray, h: float) -> float:
    """Central difference; quaternions stay of unit length."""

    def at(e: float) -> float:
        x = np.asarray(getattr(bend.variables, name)) + e * direction
        if name in ("rotation", "rotations"):
            x /= np.linalg.norm(x, axis=-1, keepdims=True)
        return float(loss(replace(bend.variables, **{name: jnp.asarray(x)})))

    return (at(h) - at(-h)) / (2 * h)


@pytest.mark.parametrize(
    "goals", [IN_THE_WORLD, pytest.param(ON_THE_BODY, marks=pytest.mark.slow)], ids=["world", "body"]
)
def test_gradients_are_central_differences(x64, goals):
    bend = Bend(MOTION, goals, EXACT, settle=5)
    bent = bend(bend.variables)
    assert (bent.left < 1e-9).all() and bent.sound.all()
    before = deform(MOTION, goals, EXACT).motion
    assert 0 < np.abs(bent.motion.rotations - before.rotations).max() < 0.1
    weights = RNG.normal(size=(FRAMES, len(NAMES), 3))
    loss = scored(bend, weights)
    gradient = jax.grad(loss)(bend.variables)
    along = directions(bend)
    for name in ALL:
        by = float(jnp.vdot(getattr(gradient, name), jnp.asarray(along[name])))
        fd = slope(loss, bend, name, along[name], 1e-5)
        scale = max(abs(fd), 1e-3)
        assert abs(by - fd) < 1e-5 * scale, f"{name}: {by} {fd}"
    some = set(ALL) - (
        {"weight"} if goals is IN_THE_WORLD else {"masses", "rotation"}
    )  # what all can have, none is weighed for
    assert all(float(jnp.abs(getattr(gradient, n)).max()) > 1e-6 for n in some)
    if goals is IN_THE_WORLD:
        with pytest.raises(OptionError, match="first derivatives only"):
            jax.jvp(jax.grad(loss), (bend.variables,), (bend.variables,))


@pytest.mark.slow
def test_a_bad_frame_takes_no_part(x64):
    """Derivatives by it are 0, those by the others finite."""
    bend = Bend(MOTION, IN_THE_WORLD, EXACT, settle=5)
    v = bend.variables
    bad = replace(v, rotations=v.rotations.at[2, 3].set(jnp.nan))
    bent = bend(bad)
    assert not np.isfinite(bent.left[2]) and np.isfinite(bent.left[np.array([0, 1, 3])]).all()
    seen = np.array([0, 1, 3])

    def without(x):
        motion = bend(x).motion
        return jnp.sum(motion.rotations[seen] ** 3) + jnp.sum(motion.translations[seen] ** 2)

    g, clean = jax.grad(without)(bad), jax.grad(without)(v)
    for name in ALL:
        assert np.isfinite(getattr(g, name)).all(), name
    for name in ("place", "rotation", "rotations", "translations"):
        assert not np.asarray(getattr(g, name))[2].any(), name
        # frames before it know nothing of it
        np.testing.assert_array_equal(np.asarray(getattr(g, name))[:2], np.asarray(getattr(clean, name))[:2])
    lost = replace(v, place=v.place.at[1, 0].set(jnp.nan))
    g = jax.grad(without)(lost)
    assert all(np.isfinite(getattr(g, n)).all() for n in ALL) and not np.asarray(g.place)[1].any()


def arm(bend_by: float = 0.5, frames: int = 2):
    """Three links along y, elbow and wrist bent about x."""
    from kinjax.motion import Motion
    from kinjax.skeleton import Skeleton, Topology

    offsets = np.array([[0, 0, 0], [0, 0.3, 0], [0, 0.25, 0], [0, 0.1, 0]], float)
    top = Topology(("Base", "Elbow", "Wrist", "Tip"), (-1, 0, 1, 2), up="z")
    half = np.array([0.1, bend_by, bend_by, 0.0]) / 2
    q = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=-1)
    still = np.broadcast_to(q, (frames, 4, 4)).copy()
    return Motion(np.zeros((frames, 1, 3)), still, Skeleton(offsets, np.zeros((0, 3)), top), 60.0, name="arm")


def reach(offset, gradient: str = "implicit", bend_by: float = 0.5, frames: int = 2, **more) -> Bend:
    """The tip moved by `offset` with the root held, above the elbow moved sideways."""
    held = ("Base", "Elbow", "Wrist", "Tip")
    goals = [
        Position("Base", priority=3),
        Position("Tip", offset=offset, priority=2, recruits=held),
        Position("Elbow", offset=(0.02 * any(offset), 0, 0), axes="x", priority=1),
    ]
    return Bend(arm(bend_by, frames), goals, replace(EXACT, **more), gradient=gradient)


@pytest.mark.slow
def test_forward_is_reverse(x64):
    bend = reach((0.02, -0.05, 0.04))
    loss = scored(bend, np.ones((2, 4, 3)) * np.arange(3.0))
    gradient = jax.grad(loss)(bend.variables)
    along = jax.tree.map(lambda x: jnp.asarray(RNG.normal(size=x.shape)), bend.variables)
    pushed = jax.jit(lambda v: jax.jvp(loss, (v,), (along,))[1])(bend.variables)
    by = sum(float(jnp.vdot(a, b)) for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
    assert abs(float(pushed) - by) < 1e-9 * abs(by)


@pytest.mark.slow
def test_implicit_is_unrolled_where_it_has_converged(x64):
    """Through every iteration, in reverse, and by the conditions of the place where they end. One frame: the next would start where
    it ends, be there at once, and have no iterations to go back through."""
    gradients = {}
    for kind in ("implicit", "unrolled"):
        bend = reach((0.02, -0.05, 0.04), kind, frames=1)
        assert bend(bend.variables).converged.all()
        gradients[kind] = jax.grad(scored(bend, np.ones((1, 4, 3)) * np.arange(3.0)))(bend.variables)
    for name in ("place", "offsets", "rotations", "translations"):
        one, three = (np.asarray(getattr(gradients[k], name)) for k in gradients)
        scale = max(np.abs(three).max(), 1e-3)
        if name == "rotations":  # unrolled, a quaternion's length counts, too
            q = np.asarray(bend.variables.rotations)
            three = three - q * (three * q).sum(-1, keepdims=True)
        assert np.abs(one - three).max() < 1e-4 * scale, name


@pytest.mark.parametrize(
    ("offset", "bend_by"),
    [((0, 2.0, 0), 0.5), ((0, 0.05, 0), 0.0), ((0.3, -0.6, 0.1), 0.2), ((0, 0, 0), 0.0), ((0, 0, 0), 0.5)],
    ids=["unreachable", "straight", "conflict", "at-rest-straight", "at-rest"],
)
@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)], indirect=True)
def test_finite_and_bounded_where_nothing_is_well_conditioned(precision, offset, bend_by):
    bend = reach(offset, bend_by=bend_by, iterations=30, tolerance=1e-6, drag=0.3)
    bent = bend(bend.variables)
    gradient = jax.grad(scored(bend, np.ones((2, 4, 3), precision)))(bend.variables)
    for name in ALL:
        g = np.asarray(getattr(gradient, name))
        assert np.isfinite(g).all(), name
        assert np.abs(g).max() < 1e4, name
    assert bent.sound.all()
    if offset == (0, 0, 0):
        assert bent.converged.all()


@pytest.mark.slow
def test_starts_do_not_matter_where_all_is_attracted_to_the_input(x64):
    one, two = (
        jax.grad(scored(bend, np.ones((2, 4, 3)) * np.arange(3.0)))(bend.variables)
        for bend in (reach((0.02, -0.05, 0.04), kind) for kind in ("implicit", "implicit_local"))
    )
    for name in ALL:
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), atol=1e-9)


def test_what_has_not_converged_says_so(x64):
    bend = reach((0.15, -0.2, 0.1), iterations=1)
    bent = bend(bend.variables)
    same = deform(bend.motion, bend.constraints, bend.settings).motion
    np.testing.assert_allclose(bent.motion.rotations, same.rotations, atol=1e-12)
    np.testing.assert_allclose(bent.motion.translations, same.translations, atol=1e-12)
    assert not bent.converged.any() and (bent.left > 1e-4).all()


@pytest.mark.slow
def test_float32_gradients_are_those_of_float64():
    with jax.enable_x64(True):
        exact = reach((0.02, -0.05, 0.04))
        wide = jax.grad(scored(exact, np.ones((2, 4, 3))))(exact.variables)
    bend = reach((0.02, -0.05, 0.04), tolerance=1e-6)
    assert bend.variables.place.dtype == jnp.float32
    narrow = jax.grad(scored(bend, np.ones((2, 4, 3), np.float32)))(bend.variables)
    for name in ("place", "offsets", "rotations", "translations"):
        one, two = np.asarray(getattr(narrow, name)), np.asarray(getattr(wide, name))
        assert np.abs(one - two).max() < 1e-4 * max(np.abs(two).max(), 1.0), name


def test_a_bad_clip_of_a_batch_leaves_the_others(x64):
    bend = reach((0.02, -0.05, 0.04))
    loss = scored(bend, np.ones((2, 4, 3)))
    three = jax.tree.map(lambda x: jnp.stack([x, x * 1.0, x]), bend.variables)
    three = replace(three, place=three.place.at[2].add(0.01))
    bad = replace(three, rotations=three.rotations.at[1].set(jnp.nan))
    many = jax.jit(jax.vmap(jax.grad(loss)))
    good, beside = many(three), many(bad)
    for name in ALL:
        one, two = (np.asarray(getattr(g, name)) for g in (good, beside))
        np.testing.assert_array_equal(one[[0, 2]], two[[0, 2]])
        assert np.isfinite(one).all()
    alone = jax.grad(loss)(bend.variables)
    np.testing.assert_allclose(good.place[0], alone.place, atol=1e-10)


@pytest.mark.parametrize("attract", [(True, True), pytest.param((False, False), marks=pytest.mark.slow)])
def test_closed_form_is_the_derivative(x64, monkeypatch, attract):
    """Of the conditions by the pose, at poses that are not solved: against automatic differentiation."""
    seen = []

    def compared(system, frame, at, factors):
        one, two = (form(system, frame, at, factors) for form in (holds._in_closed_form, holds._by_jacfwd))
        size = jnp.max(jnp.abs(two + jnp.eye(two.shape[0])))
        jax.debug.callback(lambda *x: seen.append(x), jnp.max(jnp.abs(one - two)) / (1 + size), size)
        return jnp.zeros(two.shape[0])

    monkeypatch.setattr(implicit, "balance", compared)
    jax.clear_caches()
    settings = Settings(iterations=1, drag=0.5, singular=0.8, attract=attract[0], attract_root=attract[1])
    bend = Bend(MOTION, IN_THE_WORLD, settings)
    jax.block_until_ready(bend(bend.variables))
    jax.effects_barrier()
    jax.clear_caches()
    assert len(seen) >= FRAMES
    assert max(gap for gap, _ in seen) < 1e-8  # that of an orientation is exact where its residual is 0
    assert max(size for _, size in seen) > 0.1


def test_clips_of_many_lengths_share_a_program(x64):
    from kinjax.deform.bending import _bend

    jax.clear_caches()
    for frames in (2, 5, 9):
        motion = arm(0.5, frames)
        bend = Bend(motion, [Position("Tip", offset=(0.02, 0, 0), priority=1)])
        assert bend(bend.variables).motion.rotations.shape == (frames, 4, 4)
    assert _bend._cache_size() == 1


def test_what_cannot_be_meant(x64):
    with pytest.raises(OptionError, match="choose from implicit, implicit_local, unrolled"):
        Bend(arm(), [Position("Tip")], gradient="exact")  # type: ignore[arg-type]
    limited = arm()
    limits = np.tile([-1.0, 1.0], (4, 3, 1))
    limited = replace(limited, skeleton=replace(limited.skeleton, limits=limits))
    with pytest.raises(OptionError, match="unrolled"):
        Bend(limited, [Position("Tip")])
    bend = Bend(arm(), [Position("Tip")])
    with pytest.raises(ShapeError, match="place has shape"):
        bend(replace(bend.variables, place=jnp.zeros((3, 1, 3))))
