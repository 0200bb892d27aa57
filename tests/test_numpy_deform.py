"""The NumPy baseline of prioritized inverse kinematics: its derivatives, its recursion, its guarantees, and a short reach."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.numpy_baseline import deform as nd
from benchmarks.numpy_baseline.deform.rotations import conjugate, exp, log, matrices, multiply, normalized

EPS = np.finfo(float).eps
# two arms on a trunk; the second arm's tip carries a mass off its joint
PARENTS = np.array([-1, 0, 1, 2, 1, 4, 0])


def body(seed=0):
    rng = np.random.default_rng(seed)
    return nd.Body(PARENTS, rng.normal(size=(7, 3)), rng.uniform(0.0, 2.0, size=7), rng.normal(size=(7, 3)))


def layers(rng, frames=2):
    far = 2 * rng.normal(size=(frames, 3))
    turn = normalized(rng.normal(size=(frames, 4)))
    return [
        [nd.Constraint("com", far, axes=(True, True, False))],
        [nd.Constraint("position", far, 3), nd.Constraint("position", far, 5, np.array([0.3, -0.2, 0.1]))],
        [nd.Constraint("orientation", turn, 5, axes=(True, False, True))],
    ]


def test_rotations():
    rng = np.random.default_rng(0)
    v = rng.normal(size=(50, 3))
    v[0], v[1] = 0.0, 1e-9
    q = exp(v)
    scipys = Rotation.from_rotvec(v)
    np.testing.assert_allclose(matrices(q), scipys.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(log(q), scipys.as_rotvec(), atol=1e-14)
    np.testing.assert_allclose(log(-q), log(q), atol=1e-14)
    np.testing.assert_allclose(matrices(multiply(q, q[::-1])), matrices(q) @ matrices(q[::-1]), atol=1e-14)
    np.testing.assert_allclose(multiply(q, conjugate(q)), np.tile([1.0, 0, 0, 0], (50, 1)), atol=1e-14)


def test_pointer_jumping_is_the_walk_over_joints():
    rng = np.random.default_rng(1)
    figure, root, q = body(), rng.normal(size=(4, 3)), normalized(rng.normal(size=(4, 7, 4)))
    tree = nd.Tree(figure, range(7))
    np.testing.assert_allclose(tree.world(root, q)[:, :-1, :3, 3], nd.positions(figure, root, q), atol=1e-13)
    np.testing.assert_array_equal(tree.world(root, q)[:, -1], np.tile(np.eye(4), (4, 1, 1)))


def test_jacobian_is_the_derivative_of_the_errors():
    rng = np.random.default_rng(2)
    figure, root, q = body(), rng.normal(size=3), normalized(rng.normal(size=(7, 4)))
    task = nd.Task(figure, layers(rng))
    assert task.spans == [(0, 2), (2, 8), (8, 10)]
    q = q[task.tree.joints]
    world = task.tree.world(root, q)
    ways = 1e-6 * np.eye(task.columns)
    ways = np.concatenate([ways, -ways])
    both = task.tree.world(*task.tree.moved(root, q, world, ways))
    # an orientation's error is linear in the step only where it is small: goals that the state nearly has
    goal = task.goal(0)
    at = world[task.turns, :3, :3]
    near = (goal[0], matrices(exp(1e-6 * rng.normal(size=(len(at), 3)))) @ at, goal[2])
    errors = task.errors(both, near)
    found = -(errors[: task.columns] - errors[task.columns :]).T / 2e-6
    np.testing.assert_allclose(task.jacobian(world), found, atol=2e-6)


def test_recruiting():
    figure, rng = body(), np.random.default_rng(5)
    goal = rng.normal(size=(1, 3))
    for kind, joint in (("position", 3), ("com", 0)):
        task = nd.Task(figure, [[nd.Constraint(kind, goal, joint, recruits=(1, 2))]])
        whole = nd.Task(figure, [[nd.Constraint(kind, goal, joint)]])
        world = task.tree.world(np.zeros(3), normalized(rng.normal(size=(len(task.tree.joints), 4))))
        allowed = np.repeat([False] + [j in (1, 2) for j in task.tree.joints], 3)
        np.testing.assert_array_equal(task.jacobian(world), whole.jacobian(world) * allowed)
        assert task.turned.sum() == 2


def test_every_kind_of_constraint_is_met_and_free_joints_follow_the_input():
    rng = np.random.default_rng(6)
    figure, root, q = body(), rng.normal(size=3), normalized(rng.normal(size=(7, 4)))
    reference = normalized(multiply(exp(0.02 * np.arange(8)[:, None, None] * rng.normal(size=(7, 3))), q))
    # goals that some pose meets: those of a pose nearby
    tree = nd.Tree(figure, range(7))
    turned = normalized(multiply(exp(0.02 * np.arange(8)[:, None, None] * rng.normal(size=(7, 3))), q))
    world = tree.world(root + 0.01 * np.arange(8)[:, None], turned)[:, :-1]
    places = (world @ np.concatenate([figure.centers, np.ones((7, 1))], 1)[..., None])[..., :3, 0]
    com = np.einsum("j,fjk->fk", figure.masses, places) / figure.masses.sum()
    facing = np.array([Rotation.from_matrix(m).as_quat()[[3, 0, 1, 2]] for m in world[:, 5, :3, :3]])
    stack = [
        [nd.Constraint("position", world[:, 3, :3, 3], 3)],
        [nd.Constraint("orientation", facing, 5)],
        [nd.Constraint("com", com, axes=(True, True, False))],
    ]
    track = nd.Solver(figure, stack).solve(root, q, reference)
    assert track.errors.max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(track.rotations, axis=-1), 1.0, atol=1e-14)
    arm = nd.Solver(figure, stack[:1]).solve(root, q, reference)
    assert arm.errors.max() < 1e-6
    np.testing.assert_array_equal(arm.rotations[:, [4, 5, 6]], reference[:, [4, 5, 6]])


def random_stack(rng, kind):
    """Jacobians of three or four layers: independent rows, or one of the ways in which layers depend on each other."""
    n = int(rng.integers(12, 31))
    J = [rng.normal(size=(int(rng.integers(1, 4)), n)) for _ in range(int(rng.integers(3, 5)))]
    if kind == "same":
        J[1] = J[0].copy()
    elif kind == "span":
        J[2] = rng.normal(size=(3, len(J[0]) + len(J[1]))) @ np.concatenate(J[:2])
    elif kind == "nearly":
        J[1] = J[0] + 10.0 ** rng.uniform(-10, -2) * rng.normal(size=J[0].shape)
    elif kind == "zero":
        J[0][0] = 0.0
        J[2] *= 0.0
    elif kind == "scaled":
        J = [10.0 ** rng.uniform(-3, 3) * x for x in J]
    elif kind == "low":
        J = [rng.normal(size=(3, 1)) @ x[:1] for x in J]
    elif kind == "crowded":
        J = [x[:, :5] for x in J] + [rng.normal(size=(3, 5))]
    elif kind == "one":
        J = [x[:, :1] for x in J]
    return J


def spans_of(J):
    ends = np.cumsum([len(x) for x in J])
    return [(int(e - len(x)), int(e)) for e, x in zip(ends, J, strict=True)]


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_recursion_is_the_linear_step(damping):
    rng = np.random.default_rng(3)
    for kind in ["free"] * 40 + (["same", "span", "zero"] * 20 if damping else []):
        J = random_stack(rng, kind)
        dx, lam, z = [rng.normal(size=len(x)) for x in J], [damping] * len(J), rng.normal(size=J[0].shape[1])
        step = nd.linear_step(np.concatenate(J), np.concatenate(dx), spans_of(J), lam, z)
        expected = nd.recursion(J, dx, lam, z)[-1]
        np.testing.assert_allclose(step, expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


HARD = ["free", "same", "span", "nearly", "zero", "scaled", "low", "crowded", "one"]


@pytest.mark.parametrize("kind", HARD)
def test_lower_layers_leave_higher_ones_alone(kind):
    rng = np.random.default_rng(HARD.index(kind))
    for _ in range(60):
        J = random_stack(rng, kind)
        dx, z, spans = [rng.normal(size=len(x)) for x in J], rng.normal(size=J[0].shape[1]), spans_of(J)
        lam = [max(rng.choice([0.0, 1e-3, 0.3]), 1e-6 * np.linalg.norm(x)) for x in J]
        limits = {"clamp": 0.5, "budget": 1.0} if rng.random() < 0.5 else {}
        step = nd.linear_step(np.concatenate(J), np.concatenate(dx), spans, lam, z, **limits)
        for i, Ji in enumerate(J):
            upto = slice(0, i + 1)
            alone = nd.linear_step(np.concatenate(J[upto]), np.concatenate(dx[upto]), spans[upto], lam[upto], **limits)
            leak = np.linalg.norm(Ji @ (step - alone))
            scale = np.linalg.norm(Ji) * (np.linalg.norm(step) + np.linalg.norm(alone))
            assert leak <= 20 * EPS * scale, (kind, i, leak / max(EPS * scale, 1e-300))
        # the solver's candidates share one basis: what lies below is a mask
        L, Q = nd.row_basis(np.concatenate(J))
        y = nd.sweep(L, spans, nd.gains(L, spans, lam), np.concatenate(dx), **limits)
        free = nd.posture_step(Q, y, z, limits.get("budget", np.inf))
        for (_, end), Ji in zip(spans, J, strict=True):
            below = y[end:] @ Q[end:] + free
            assert np.linalg.norm(Ji @ below) <= 20 * EPS * np.linalg.norm(Ji) * np.linalg.norm(y @ Q + free)
        if limits:
            assert np.linalg.norm(step) <= 1.0 + 1e-9


def test_row_bases_agree_and_a_dependent_row_spends_nothing():
    rng = np.random.default_rng(4)
    for kind in HARD:
        J = np.concatenate(random_stack(rng, kind))
        L, Q = nd.row_basis(J)
        np.testing.assert_allclose(L @ Q, J, atol=1e-13 * max(1.0, np.abs(J).max()))
        np.testing.assert_allclose(Q @ Q.T, np.diag(np.any(Q, axis=1).astype(float)), atol=1e-13)
    rows = rng.normal(size=(3, 8))
    assert (~np.any(nd.row_basis(np.concatenate([rows, rows[::-1]]))[1], axis=1)).sum() == 3


def test_the_first_in_order():
    share = {"slack": 1e-6, "share": 1e-3}
    assert nd.first_in_order([[1.0, 0.0], [0.5, 9.0]], **share) == 1
    assert nd.first_in_order([[0.5004, 3.0], [0.5, 2.0], [0.5, 2.0]], **share) == 1
    assert nd.first_in_order([[9e-7, 2.0], [0.0, 2.001]], **share) == 0


def test_a_short_reach(data):
    from benchmarks.reach.numpy_solver import layers_of, run
    from benchmarks.reach.protocol import figure, score
    from benchmarks.reach.scene import read_scene

    scene = read_scene(data)
    assert len(scene.names) == 25 and sum(map(len, scene.hinges)) == 72
    short = scene.shortened(20)
    got = score(short, "RH", run(short, "RH", 3))
    assert got.feet_max < 1e-3 and got.hand_max < 1e-3
    # every seventh frame of FAR from where it leaves the start: the hand may not cost the feet
    late = replace(scene, targets={k: v[-134::7] for k, v in scene.targets.items()})
    got = score(late, "FAR", run(late, "FAR", 10))
    assert got.hand_last < 142.0 and got.feet_max < 0.05
    # a layer for each axis of the hand: the optimum is 270.69 mm (`python -m benchmarks.reach.optimum`), all of it along z;
    # a solver that refuses whole steps of a layer for ever stays near 700
    solver = nd.Solver(figure(late), layers_of(late, "FAR", ("LF", "RF", "x", "y", "z")), nd.Settings(iterations=20))
    last = solver.solve(late.root, late.rotations).errors[-1]
    assert (last[:4] < 2e-5).all() and 0.2705 < last[4] < 0.272


def test_the_baseline_is_independent():
    for path in Path(nd.__file__).parent.glob("*.py"):
        text = path.read_text()
        assert "kinjax" not in text and "import jax" not in text, path.name
