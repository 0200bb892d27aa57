"""Every shape annotation is checked as the engines run: traced, not compiled, since shapes are known then."""

import subprocess
import sys

import pytest

COMMON = '''
import jax, jax.numpy as jnp, numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, install_import_hook, jaxtyped
import sys, types, typing
from functools import partial

checker = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, as in Python's own rules
sys.modules["annotation_checker"] = types.SimpleNamespace(checker=checker)
jax.config.update("jax_numpy_dtype_promotion", "strict")
'''

DETECT = '''
with install_import_hook("kinjax", "annotation_checker.checker"):
    from kinjax import kinematics
    from kinjax.annotations import Template
    from kinjax.detect import calibrate, detect, displacements, engine, pipeline, sigma_epsilon
    from kinjax.detect.lmeds import lmeds
    from kinjax.motion import Motion, make_poses
    from kinjax.skeleton import Skeleton, Topology

# the hook sees a fault: the shapes of q and v do not fit
try:
    displacements.displacements(jnp.zeros((4, 1, 9)), jnp.zeros((3, 1, 8)), jnp.ones((1, 9), bool), 1)
except TypeCheckError:
    print("SEEN")


def fields(record):
    """Checks the fields of a named tuple against each other; returns it."""
    hints = typing.get_type_hints(type(record))
    source = f"def check({', '.join(hints)}): pass"
    space = {}
    exec(source, space)
    check = space["check"]
    check.__annotations__ = hints
    jaxtyped(check, typechecker=checker)(*record)
    return record


def traced(run):
    def call(plan, *arguments):
        shapes = jax.eval_shape(partial(run, plan), *arguments)
        return jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), shapes)

    return call


steps = engine.run
engine.run = lambda *arguments: fields(steps(*arguments))
pipeline.run_poses, pipeline.run_joints = traced(pipeline.run_poses), traced(pipeline.run_joints)
forward = kinematics._forward


def identities(*arguments):
    return tuple(jnp.broadcast_to(jnp.eye(1, s.shape[-1])[0], s.shape) for s in jax.eval_shape(forward, *arguments))


kinematics._forward = identities

frames, every = 70, ("space", "line", "point")
q = np.tile(np.array([1.0, 0, 0, 0]), (frames, 3, 1))
poses = make_poses("abc", q, np.zeros((frames, 3, 3)), 60.0)
spans = [Template("a", 0, 20), Template("a", 30, 50), Template("b", 5, 30), Template("b", 5, 30, "line")]
for options in (
    {"types": every, "relative_to": "c", "rate": 30.0},
    {"types": every, "method": "window", "templates": spans[:2]},
    {"types": every, "method": "paper", "templates": spans, "projection": "svd"},
    {"types": every, "method": "paper", "thresholds": (1e-3, 1e-3), "stride": 2, "formulation": "global"},
    {"method": "paper", "templates": spans[:2], "interpolation": "monotone", "estimator": "naive"},
):
    detect(poses, **options)
pipeline.detect_many([poses, poses], patterns=calibrate(poses, spans[:3]))

topology = Topology(("root", "arm", "prop"), (-1, 0, -1), translated=(0, 2))
motion = Motion(np.zeros((frames, 2, 3)), q, Skeleton(np.ones((3, 3)), np.zeros((0, 3)), topology), 60.0)
detect(motion, ["arm"])
kinematics.object_poses(motion)
kinematics.cluster_poses({"box": np.random.default_rng(0).normal(size=(5, 4, 3))}, 60.0)
apart = lambda: fields(displacements.displacements(jnp.zeros((4, 2, 9)), jnp.zeros((3, 2, 9)), jnp.ones((2, 9), bool), 2))
for build in (apart, lambda: sigma_epsilon.project(apart()), lambda: lmeds(jnp.ones(9), jnp.ones(9, bool))):
    jax.eval_shape(lambda build=build: fields(build()))
print("CHECKED")
'''

SOFT = '''
soft_rooms = ["body", "core", "instantaneous", "lmeds", "merging", "parts", "quantile", "settling", "steps"]  # not `task`: NumPy, too
checked = ["kinjax.components", "kinjax.forward", "kinjax.rotations", *(f"kinjax.soft.{n}" for n in soft_rooms)]
with install_import_hook(checked, "annotation_checker.checker"):
    from kinjax import soft
    from kinjax.annotations import Template
    from kinjax.motion import Motion, make_poses
    from kinjax.skeleton import Skeleton, Topology
    from kinjax.soft.settling import soft_settle

one = jnp.ones(())
try:  # the hook sees a fault: a place for every begin, but not for every end
    soft_settle(jnp.ones(9), jnp.ones(8), (), (), (one, one), 2, 4, one)
except TypeCheckError:
    print("SEEN")

frames = 70
q = np.tile(np.array([1.0, 0, 0, 0]), (frames, 3, 1))
poses = make_poses("abc", q, np.zeros((frames, 3, 3)), 60.0)
topology = Topology(("root", "arm", "prop"), (-1, 0, -1), translated=(0, 2))
motion = Motion(np.zeros((frames, 2, 3)), q, Skeleton(np.ones((3, 3)), np.zeros((0, 3)), topology), 60.0)
spans = [Template("a", 0, 20), Template("b", 5, 30)]
for method in ("robust", "paper"):
    task = soft.prepare(poses, templates=spans, method=method)
    loss = lambda x: soft.detect(task.with_poses(position=x), temperature=0.2).labels.sum()
    jax.eval_shape(jax.value_and_grad(loss), jnp.zeros((frames, 3, 3)))
    jointed = soft.prepare(motion, ["arm"], method=method)
    loss = lambda x, y: soft.detect(jointed.with_motion(offsets=x), (y, y), temperature=0.2).labels.sum()
    jax.eval_shape(jax.value_and_grad(loss, (0, 1)), jnp.ones((3, 3)), jnp.ones(1))
print("CHECKED")
'''

DEFORM = '''
deform_rooms = [
    "balance", "banded", "bending", "chain", "clip_problem", "clip_solver", "conditions", "frame_solver", "implicit", "loops",
    "prioritized", "sequence", "tasks",
]  # not records that hold NumPy's arrays as well as JAX's
checked = ["kinjax.components", "kinjax.rotations", *(f"kinjax.deform.{n}" for n in deform_rooms)]
with install_import_hook(checked, "annotation_checker.checker"):
    from kinjax.deform import Bend, CenterOfMass, LookAt, Orientation, Position, Settings, prioritized
    from kinjax.deform import conditions, whole_clip as all_frames
    from kinjax.motion import Motion
    from kinjax.skeleton import Skeleton, Topology
whole = sys.modules["kinjax.deform.whole_clip"]

try:  # the hook sees a fault: a matrix that is not square
    prioritized.inverse(jnp.ones((2, 3)))
except TypeCheckError:
    print("SEEN")

names = ("root", "arm", "hand", "ball")
topology = Topology(names, (-1, 0, 1, -1), translated=(0, 3))
skeleton = Skeleton(np.ones((4, 3)), np.zeros((0, 3)), topology, np.ones(4), np.zeros((4, 3)))
q = np.tile(np.array([1.0, 0, 0, 0]), (5, 4, 1))
motion = Motion(np.zeros((5, 2, 3)), q, skeleton, 60.0)
world = [
    Position("hand", offset=(0.1, 0, 0), priority=2),
    Orientation("arm", priority=1),
    CenterOfMass(offset=(0.1, 0, 0), recruits=names[:3]),
]
body = [Position("hand", offset=(0.1, 0, 0), relative_to="root"), LookAt("hand", at=(3.0, 0, 0), axis=(1, 0, 0))]
for goals in (world, body):
    bend = Bend(motion, goals, Settings(iterations=3), settle=2)
    loss = lambda v: bend(v).motion.rotations.sum()
    jax.eval_shape(jax.value_and_grad(loss), bend.variables)

run = whole._run


def traced(*arguments):
    shapes = jax.eval_shape(partial(run, kinds=arguments[-1]), *arguments[:-1])
    return jax.tree.map(lambda s: np.ones(s.shape, s.dtype), shapes)


whole._run = traced
for goals in (world, body):
    all_frames(motion, goals)
print("CHECKED")
'''


@pytest.mark.parametrize(
    "engine", [DETECT, SOFT, pytest.param(DEFORM, marks=pytest.mark.slow)], ids=["detect", "soft", "deform"]
)
def test_shape_annotations_hold_as_the_engine_runs(engine):
    done = subprocess.run([sys.executable, "-c", COMMON + engine], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.split() == ["SEEN", "CHECKED"]
