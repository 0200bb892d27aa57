"""One frame: analytic Jacobians, and strict priority where the problem is not linear."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deform_cases import ENDS, FIGURE, NAMES, OFFSETS, PARENTS, Problems, chain, problems, quaternions, solve, standing

from kinjax.deform import CenterOfMass, LookAt, Orientation, Position, Settings
from kinjax.deform.chain import Pose, forward, matrices, moved, parent_rotations
from kinjax.deform.frame_solver import Solving
from kinjax.deform.plan import make_plan
from kinjax.deform.prioritized import solve as solve_linear
from kinjax.deform.tasks import jacobian, look, quaternion, residuals
from kinjax.motion import Motion


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_lower_layers_cost_higher_ones_nothing(x64, count):
    """`err_i(all) <= err_i(without the lower ones) + max(1e-6 m, 1e-3 err_i)` on problems of two to five layers, a third
    of whose targets are out of reach."""
    p = problems(count, np.random.default_rng(11))
    one = Problems(*(jnp.asarray(x) for x in p))
    run = jax.jit(jax.vmap(partial(solve, solving=Solving(iterations=12)), in_axes=(0, None)))
    errors = [np.asarray(run(one, depth).errors) for depth in range(1, 6)]
    whole = errors[-1]
    assert np.isfinite(whole).all()
    unreached = 0
    for i in range(4):
        below = p.layers > i + 1
        bound = errors[i][:, i] + np.maximum(1e-6, 1e-3 * whole[:, i])
        assert (whole[below, i] <= bound[below]).all(), (i, np.flatnonzero(below & (whole[:, i] > bound))[:5])
        unreached += int((whole[below, i] > 1e-3).sum())
    assert unreached > count / 10  # the bound was put to the test


def example(kind: str):
    """A plan of one constraint, out of its target by a little: (plan, index of the frame)."""
    motion = standing(3, sway=0.3, at=(3.0, -2.0, 0.5))
    goal = {
        "position": Position("LeftHand", offset=(0.02, -0.01, 0.015), point=(0.02, 0.1, 0.03)),
        "axes": Position("LeftHand", offset=(0.02, -0.01, 0.015), axes="xz"),
        "relative": Position("LeftHand", offset=(0.02, 0.0, 0.01), relative_to="Head"),
        "orientation": Orientation("RightHand", offset=(1e-4, -2e-4, 1e-4)),
        "relative orientation": Orientation("RightHand", offset=(1e-4, 1e-4, 0.0), relative_to="LeftArm"),
        "look": LookAt("Head", path=np.array([[4.0, -2.1, 2.3]] * 3), axis=(1, 0, 0), point=(0, 0, 0.1)),
        "center": CenterOfMass(offset=(0.02, 0.01, -0.01)),
        "balance": CenterOfMass(support=("LeftFoot", "RightFoot"), displacement=(0.02, 0.0, 0.0)),
        "relative center": CenterOfMass(offset=(0.01, 0.0, 0.0), relative_to="LeftFoot"),
    }[kind]
    return make_plan(motion, (goal,), Settings()), 1


@pytest.mark.parametrize(
    "kind",
    [
        "position",
        "axes",
        "relative",
        "orientation",
        "relative orientation",
        "look",
        "center",
        "balance",
        "relative center",
    ],
)
def test_jacobian_is_the_derivative(kind, x64):
    """Analytic rows against forward-mode derivatives and central differences of the residual along the solver's own step."""
    plan, f = example(kind)
    figure, tasks, frame = jax.tree.map(
        jnp.asarray, (plan.chain, plan.tasks, jax.tree.map(lambda x: x[f], plan.frames))
    )
    kinds = plan.kinds

    @jax.jit
    def linear(pose):
        world = forward(figure, pose, frame.offsets)
        seen = look(tasks, frame.goals, world)
        r = residuals(tasks, frame.goals, seen, kinds)[..., 0].reshape(-1)
        return jacobian(figure, tasks, frame.goals, world, seen, kinds), r, parent_rotations(figure, world)

    def residual(step, pose, parent):
        after = forward(figure, moved(figure, pose, parent, step[:, None]), frame.offsets)
        return residuals(tasks, frame.goals, look(tasks, frame.goals, after), kinds).reshape(-1)

    @jax.jit
    def derivatives(pose, parent):
        n = 3 + 3 * parent.shape[0]
        steps = 1e-6 * jnp.concatenate([jnp.eye(n), -jnp.eye(n)])
        r = jax.vmap(lambda s: residual(s, pose, parent))(steps)
        return -jax.jacfwd(residual)(jnp.zeros(n), pose, parent), ((r[n:] - r[:n]) / 2e-6).T

    pose = Pose(frame.rotations[..., None], frame.root[:, None])
    if kind == "look":  # exact where the residual is small: turn the head there first
        for _ in range(8):
            j, r, parent = linear(pose)
            step = solve_linear(j, r, jnp.zeros(len(r), jnp.int32), 1, jnp.full(len(r), 1e-6))
            pose = moved(figure, pose, parent, step[:, None])
        assert float(jnp.abs(linear(pose)[1]).max()) < 1e-9
    analytic, _, parent = linear(pose)
    analytic = np.asarray(analytic)
    forward_mode, central = (np.asarray(x) for x in derivatives(pose, parent))
    recruited = np.concatenate([np.ones(3), np.repeat(np.asarray(tasks.recruits).max(0), 3)]) > 0
    tolerance = 1e-9 if kind in ("position", "axes", "relative", "center", "balance", "relative center") else 2e-4
    rows = np.abs(analytic).max(1) > 0
    np.testing.assert_allclose(central[:, recruited], forward_mode[:, recruited], atol=1e-7)
    np.testing.assert_allclose(analytic[rows][:, recruited], forward_mode[rows][:, recruited], atol=tolerance)
    assert rows.any() and (analytic[:, ~recruited] == 0).all()


def test_point_jacobian_is_mujocos(x64):
    """Ball joints and a free root on the same figure, at a random pose: `mj_jac` of a hand's point and of the whole body."""
    mujoco = pytest.importorskip("mujoco", reason="the bench of MuJoCo is not installed")

    def body(j: int) -> str:
        inner = "".join(body(k) for k, q in enumerate(PARENTS) if q == j)
        x, y, z = OFFSETS[j]
        hinge = "<freejoint/>" if j == 0 else '<joint type="ball"/>'
        inertia = f'<inertial pos="0 0 0.05" mass="{1 + j}" diaginertia="1 1 1"/>'
        return f'<body name="{NAMES[j]}" pos="{x} {y} {z}">{hinge}{inertia}{inner}</body>'

    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body(0)}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    rng = np.random.default_rng(5)
    q = quaternions(rng.normal(size=(len(NAMES), 3)) * 0.7)
    root = np.array([1.0, 2.0, 3.0])
    data.qpos[:] = np.concatenate([root, q.reshape(-1)])
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    order = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in NAMES]

    figure = chain()
    pose = Pose(jnp.asarray(q.T)[..., None], jnp.asarray(root)[:, None])
    world = np.asarray(forward(figure, pose, jnp.asarray(OFFSETS)))[..., 0]
    np.testing.assert_allclose(world[:-1, :, 3], data.xpos[order], atol=1e-12)

    hand, local = NAMES.index("LeftHand"), np.array([0.02, 0.1, -0.03])
    point = world[hand, :, 3] + world[hand, :, :3] @ local
    jp, jr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jp, jr, point, order[hand])
    for kind, theirs in (("position", jp), ("orientation", jr)):
        motion = Motion(root[None, None], q[None], FIGURE, 60.0)
        goal = Position("LeftHand", point=local) if kind == "position" else Orientation("LeftHand")
        plan = make_plan(motion, (goal,), Settings())
        c, tasks, frame = jax.tree.map(jnp.asarray, (plan.chain, plan.tasks, jax.tree.map(lambda x: x[0], plan.frames)))
        w = forward(c, Pose(frame.rotations[..., None], frame.root[:, None]), frame.offsets)
        ours = np.asarray(jacobian(c, tasks, frame.goals, w, look(tasks, frame.goals, w), plan.kinds))
        ours = ours / (0.25 if kind == "orientation" else 1)
        assert_same_columns(ours, theirs, plan.kept, model, order, world)


def assert_same_columns(ours, theirs, kept, model, order, world):
    """Ours are along world axes; MuJoCo's ball joints turn about the body's own axes, its root moves along the world's."""
    np.testing.assert_allclose(ours[:, :3], theirs[:, :3], atol=1e-12)
    for i, j in enumerate(kept):
        at = model.jnt_dofadr[model.body_jntadr[order[j]]] + (3 if j == 0 else 0)
        columns = theirs[:, at : at + 3] @ world[j, :, :3].T
        np.testing.assert_allclose(ours[:, 3 + 3 * i : 6 + 3 * i], columns, atol=1e-12)


def test_ends_are_where_the_figure_ends():
    assert [NAMES[e] for e in ENDS] == ["LeftFoot", "RightFoot", "LeftHand", "RightHand", "Head"]


def test_matrices_and_quaternions_by_scipy(precision):
    """Turns of any size, by half a turn about each axis and across, and by next to nothing."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(8)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(60, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.array([0, 1e-9, 1e-4, 1, np.pi - 1e-4, np.pi - 1e-9, np.pi, 4])
    turn = Rotation.from_rotvec((angles[:, None, None] * axes).reshape(-1, 3))
    eps = 20 * np.finfo(precision).eps
    q, r = turn.as_quat(scalar_first=True), turn.as_matrix()
    made = matrices(jnp.asarray(q.T[:, None], precision))
    np.testing.assert_allclose(np.moveaxis(np.asarray(made[:, :, 0]), -1, 0), r, atol=eps)
    found = np.asarray(quaternion(jnp.asarray(np.moveaxis(r, 0, -1)[None], precision)))[:, 0].T
    assert found.dtype == precision
    sign = np.sign(np.sum(found * q, axis=1, keepdims=True))
    np.testing.assert_allclose(found * sign, q, atol=eps)
