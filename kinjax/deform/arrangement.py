"""What a deformation is asked for, made of `Variables` inside JAX: the arrays that the solver runs on, as `layout` makes them in
NumPy, as a function that can be differentiated.

In: a `Plan` with the motion it was made for, once, on the host; then variables, as often as wanted. Out: the solver's `Tasks`
and `Frames`. With the variables that `arranged` gives back they are the plan's own, to within rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..motion import Motion
from ..rotations import multiply, normalize, rotate
from .body import Body
from .constraints import CenterOfMass, Goal
from .plan import Plan
from .recruiting import chain_of
from .sequence import Frames
from .tasks import ORIENTATION, Tasks


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Variables:
    """What the poses follow from, for C constraints, F frames, J joints and T moving translations.

    place: (F, C, 3) metres: where each constrained point belongs (of a look-at: what it looks at), in the world, or in the frame of
    what the constraint is relative to; of a centre of mass with supports, from the middle of these. rotation: (F, C, 4)
    where each constrained orientation belongs, unit quaternions; of the other kinds the identity. weight: (C,). offsets:
    (J, 3) metres, rotations (F, J, 4), translations (F, T, 3): the input, as in `Motion`. masses: (J,) of the body parts, in
    shares of the whole.
    """

    place: Float[Array, "f c 3"]
    rotation: Float[Array, "f c 4"]
    weight: Float[Array, " c"]
    offsets: Float[Array, "j 3"]
    rotations: Float[Array, "f j 4"]
    translations: Float[Array, "f t 3"]
    masses: Float[Array, " j"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Arrangement:
    """The constant part: arrays of a plan, and where variables go in it.

    owner: (F, B) the constraint that each task serves, -1 for none. first: (C,) weights that the plan was made with. world:
    (C,) 1 where a place counts from the world's origin, which the solver counts from `origin`. centers: (J, 3) of the body parts.
    supports: (D, M) the part of the mass points' weights that no mass makes. at_mass: (J,) the mass point that a joint's mass is in,
    -1 for none. place_in: (J,) where a joint is in the chain, -1 for the others. parents: (J,). path_of: (J,) a joint's row of
    translations, -1 for none. kept: the chain's joints. moving: of those that move in their parents, (place in the chain, row of
    translations). root_path: the root's row, -1 where it does not move.
    """

    chain: Any
    tasks: Any
    frames: Any
    owner: Int[Array, "f b"]
    first: Float[Array, " c"]
    world: Float[Array, " c"]
    origin: Float[Array, " 3"]
    centers: Float[Array, "j 3"]
    supports: Float[Array, "d m"]
    at_mass: Int[Array, " j"]
    place_in: Int[Array, " j"]
    parents: Int[Array, " j"]
    path_of: Int[Array, " j"]
    kept: tuple[int, ...] = field(metadata={"static": True})
    moving: tuple[tuple[int, int], ...] = field(metadata={"static": True})
    root_path: int = field(metadata={"static": True})


def arranged(motion: Motion, goals: tuple[Goal, ...], plan: Plan) -> tuple[Arrangement, Variables]:
    """What is constant, and the variables that the plan was made from; NumPy arrays, float64."""
    body = Body(motion, plan.origin)
    top, f, c = body.top, body.frames, len(goals)
    b = plan.tasks.kind.shape[0]
    owner = np.full((f, b), -1, np.int32)
    place, rotation = np.zeros((f, c, 3)), np.tile([1.0, 0, 0, 0], (f, c, 1))
    world = np.zeros(c)
    for k, (i, slot) in enumerate(zip(plan.order, plan.slot, strict=True)):
        on = plan.active[:, k]
        owner[on, slot] = i
        if plan.tasks.kind[slot] == ORIENTATION:
            rotation[on, i] = plan.frames.goals.rotation[on, slot]
            continue
        goal = goals[i]
        supported = isinstance(goal, CenterOfMass) and bool(goal.support)
        world[i] = float(goal.relative_to is None and not supported)
        place[on, i] = plan.frames.goals.place[on, slot] + world[i] * plan.origin
    kept = [int(j) for j in plan.kept]
    new = {j: i for i, j in enumerate(kept)}
    masses, centers = np.zeros(len(top.names)), np.zeros((len(top.names), 3))
    at_mass = np.full(len(top.names), -1, np.int32)
    supports = np.zeros_like(plan.tasks.weights)
    if plan.tasks.centers.size:
        masses, centers = np.asarray(body.masses.fractions, float), np.asarray(body.masses.centers, float)
        at_mass = _mass_rows(plan, masses, top)
        total = np.zeros(plan.tasks.weights.shape[1])
        np.add.at(total, at_mass[at_mass >= 0], masses[at_mass >= 0])
        supports = plan.tasks.weights - total
    paths = {j: k for k, j in enumerate(top.translated)}
    root_path = paths.get(kept[0], -1)
    constant: Any = (
        plan.chain,
        plan.tasks,
        plan.frames,
        owner,
        np.array([g.weight if g.weight > 0 else 1.0 for g in goals]),
        world,
        plan.origin,
        centers,
        supports,
        at_mass,
        np.array([new.get(j, -1) for j in range(len(top.names))], np.int32),
        np.array(top.parents, np.int32),
        np.array([paths.get(j, -1) for j in range(len(top.names))], np.int32),
        tuple(kept),
        tuple((new[j], k) for j, k in paths.items() if j in new and top.parents[j] >= 0),
        root_path,
    )
    variables: Any = (
        place, rotation, np.array([float(g.weight) for g in goals]), np.asarray(motion.skeleton.offsets, float),
        np.asarray(motion.rotations, float), np.asarray(motion.translations, float), masses,
    )  # fmt: skip
    return Arrangement(*constant), Variables(*variables)


def _mass_rows(plan: Plan, masses: np.ndarray, top: Any) -> np.ndarray:
    """(J,) the mass point that each joint's own mass is part of, -1 for a joint without mass."""
    new = {int(j): i for i, j in enumerate(plan.kept)}
    out = np.full(len(top.names), -1, np.int32)
    world = len(plan.chain.parents)
    outside = np.flatnonzero(plan.tasks.mass_joint == world)
    for j, mass in enumerate(masses):
        if mass > 0:
            holder = next((k for k in chain_of(top, j) if k in new), None)
            out[j] = new[holder] if holder is not None else int(outside[0])
    return out


def frames_of(a: Arrangement, v: Variables) -> tuple[Tasks, Frames]:
    """The solver's arrays from variables."""
    frames, dtype = a.frames, v.rotations.dtype
    n = len(a.kept)
    kept = np.array(a.kept, np.int32)
    turns = jnp.moveaxis(v.rotations[:, kept], 2, 0)
    turns = jnp.where(
        jnp.isfinite(turns).all(0), normalize(turns), turns
    )  # a derivative along a quaternion means nothing
    rotations = jnp.asarray(frames.rotations).at[:, :, :n].set(jnp.moveaxis(turns, 0, 1))
    offsets = jnp.asarray(frames.offsets).at[:, :n].set(v.offsets[kept])
    for row, k in a.moving:
        offsets = offsets.at[:, row].set(v.translations[:, k])
    root = v.translations[:, a.root_path] - a.origin if a.root_path >= 0 else jnp.asarray(frames.root)
    served = a.owner >= 0
    mine = jnp.maximum(a.owner, 0)
    places = v.place - a.world[:, None] * a.origin
    place, rotation = (
        jnp.where(served[..., None], jnp.take_along_axis(x, mine[..., None], axis=1), empty)
        for x, empty in ((places, jnp.zeros(3, dtype)), (v.rotation, jnp.asarray(np.eye(4)[0], dtype)))
    )
    ratio = v.weight / a.first
    share = jnp.where(ratio > 0, jnp.sqrt(jnp.where(ratio > 0, ratio, 1)), 0)
    goals = frames.goals._replace(place=place, rotation=rotation, active=jnp.where(served, share[mine], 0))
    tasks = a.tasks
    if a.tasks.centers.shape[0]:
        tasks, mass_point = _masses(a, v)
        goals = goals._replace(mass_point=mass_point)
    return tasks, frames._replace(rotations=rotations, root=root, offsets=offsets, goals=goals)


def _masses(a: Arrangement, v: Variables) -> tuple[Tasks, Float[Array, "f m 3"]]:
    """Tasks with the masses, and where the mass points are in the frames of their joints: a joint that is not in the chain hangs
    on the next above it that is, as the input has it."""
    f, joints = v.rotations.shape[:2]
    q0 = jnp.zeros((joints + 1, 4, f), v.rotations.dtype).at[:, 0].set(1)
    t0 = jnp.zeros((joints + 1, 3, f), v.rotations.dtype)
    local = jnp.moveaxis(v.rotations, 0, -1)
    paths = jnp.moveaxis(v.translations, 0, -1)
    xs = (
        jnp.arange(joints, dtype=jnp.int32),
        jnp.where(a.parents < 0, jnp.asarray(joints, jnp.int32), a.parents),
        a.place_in >= 0,
        a.path_of,
        local,
        v.offsets,
        jnp.where(a.parents < 0, 1, 0).astype(v.rotations.dtype),
    )

    def step(state: Any, x: Any) -> tuple[Any, None]:
        q, t = state
        j, parent, inside, path, own, offset, is_root = x
        moving = paths[jnp.maximum(path, 0)] - is_root * a.origin[:, None]
        place = jnp.where(path >= 0, moving, jnp.broadcast_to(offset[:, None], moving.shape))
        turn = multiply(q[parent], own)
        at = t[parent] + rotate(q[parent], place)
        identity = jnp.zeros_like(turn).at[0].set(1)
        return (
            q.at[j].set(jnp.where(inside, identity, turn)),
            t.at[j].set(jnp.where(inside, jnp.zeros_like(at), at)),
        ), None

    (q, t), _ = jax.lax.scan(step, (q0, t0), xs)
    turned = jnp.moveaxis(q[:-1], 1, 0)  # (4, J, F)
    centers = jnp.broadcast_to(a.centers.T[:, :, None], (3, joints, f))
    points = jnp.moveaxis(t[:-1], 1, 0) + rotate(turned, centers)  # (3, J, F)
    count = a.tasks.weights.shape[1]
    carried = a.at_mass >= 0
    row = jnp.where(carried, a.at_mass, count)
    mass = jnp.where(carried, v.masses, 0)
    total = jnp.zeros(count + 1, mass.dtype).at[row].add(mass)[:count]
    moment = jnp.zeros((count + 1, 3, f), mass.dtype).at[row].add(jnp.moveaxis(mass[:, None] * points, 1, 0))[:count]
    some = total > 0
    place = jnp.where(some[:, None, None], moment / jnp.where(some, total, 1)[:, None, None], 0)
    weights = a.supports + total
    joints_of = jnp.concatenate([a.chain.above, jnp.zeros_like(a.chain.above[:1])])[a.tasks.mass_joint]
    moved = weights[:, None, :] * joints_of.T[None]
    return a.tasks._replace(weights=weights, carried=moved), jnp.transpose(place, (2, 0, 1))
