"""A plan through the compiled program, piece by piece.

In: a plan and what every frame starts from. Out: `Run`, poses of the whole skeleton. The clip goes through one compiled
program in pieces of `PIECE` frames: one compilation serves clips of every length, and an edit runs only the pieces that it
can reach.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from .chain import Pose
from .frame_solver import Solving
from .plan import Plan
from .sequence import Carried, Frames, Solved, solve_sequence
from .settings import Settings
from .tasks import Kinds

PIECE = 32
"""Frames after which a run over an edited clip looks whether it has come back to the old one; those of a call for several clips."""

MOST = 256
"""Frames that one call of the compiled program can solve."""

SAME = 1e-9
"""Radians and metres within which two poses lead to the same next frames."""


@dataclass(frozen=True, eq=False)
class Run:
    """One pass over a clip: the frames that it started from, and `solved`, in the order of the plan's chain and constraints,
    padding included."""

    plan: Plan
    frames: Any
    solved: Any


@partial(jax.jit, static_argnames=("layers", "kinds", "attract"))
def _solve(*args: Any, layers: int, kinds: Kinds, attract: tuple[bool, bool]) -> Solved:
    chain, tasks, frames, first, solving, count = args
    return solve_sequence(chain, tasks, frames, first, solving, layers, kinds, attract, count=count)[1]


@partial(jax.jit, static_argnames=("layers", "kinds", "attract"))
def _solve_many(*args: Any, layers: int, kinds: Kinds, attract: tuple[bool, bool]) -> tuple[Carried, Solved]:
    def one(chain: Any, tasks: Any, frames: Any, first: Any, solving: Any) -> tuple[Carried, Solved]:
        return solve_sequence(chain, tasks, frames, first, solving, layers, kinds, attract)

    return jax.vmap(one, in_axes=(0, 0, 0, 0, None))(*args)


def solve(
    plan: Plan,
    frames: Frames,
    settings: Settings,
    tell: Callable[[int], None],
    old: Run | None = None,
    alike: np.ndarray | None = None,
) -> Run:
    """All frames of one clip. old: an earlier run over the same motion; pieces that would come out the same are its own. alike:
    (F,) the frames of which the same is asked as then."""
    dtype = np.dtype(settings.precision)
    chain, tasks, cast = (as_dtype(t, dtype) for t in (plan.chain, plan.tasks, frames))
    numbers = solver_numbers(settings, dtype)
    static = {"layers": plan.layers, "kinds": plan.kinds, "attract": (settings.attract, settings.attract_root)}
    count = len(frames.root)
    same = _unchanged(frames, alike, plan, old)
    pose = begin_pose(cast.rotations[0], cast.root[0], plan.layers)
    out: list[Any] = []
    linked = True  # the pose that enters this piece is the one that entered it in the old run
    begin = 0
    while begin < count:
        end = min(begin + PIECE, count)
        if old is not None and linked and same[begin:end].all():
            piece = _taken(old, plan, begin, end)
        else:
            # as much at once as there is to solve in any case
            while end < min(begin + MOST, count) and (old is None or not same[end : end + PIECE].all()):
                end = min(end + PIECE, count)
            some = np.asarray(end - begin, np.int32)
            piece = _solve(chain, tasks, piece_of(cast, begin, end, MOST), pose, numbers, some, **static)
            piece = jax.tree.map(lambda x, n=end - begin: np.asarray(x)[:n], piece)
        out.append(piece)
        if end < count:
            pose = _last(piece, cast, begin, pose)
            linked = old is not None and _close(pose, _last(_taken(old, plan, begin, end), cast, begin, pose))
        tell(end - begin)
        begin = end
    return Run(plan, frames, jax.tree.map(lambda *x: np.concatenate(x) if len(x) > 1 else x[0], *out))


def solve_many(plans: Sequence[Plan], settings: Settings, tell: Callable[[int], None]) -> list[Any]:
    """Several clips side by side; their plans have arrays of the same shapes (frames apart)."""
    dtype = np.dtype(settings.precision)
    static = {"layers": plans[0].layers, "kinds": plans[0].kinds, "attract": (settings.attract, settings.attract_root)}
    numbers = solver_numbers(settings, dtype)
    cast = [as_dtype(p.frames, dtype) for p in plans]
    chain, tasks = (
        _stack([as_dtype(t, dtype) for t in ts]) for ts in ([p.chain for p in plans], [p.tasks for p in plans])
    )
    counts = [len(p.frames.root) for p in plans]
    pose = _stack([begin_pose(f.rotations[0], f.root[0], plans[0].layers) for f in cast])
    out: list[Any] = []
    for begin in range(0, max(counts), PIECE):
        pieces = _stack(
            [piece_of(f, min(begin, n - 1), min(begin + PIECE, n), empty=begin >= n) for f, n in zip(cast, counts, strict=True)]
        )
        pose, piece = _solve_many(chain, tasks, pieces, pose, numbers, **static)
        out.append(jax.tree.map(np.asarray, piece))
        tell(sum(min(PIECE, max(n - begin, 0)) for n in counts))
    whole = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *out)
    return [jax.tree.map(lambda x, i=i, n=n: x[i, :n], whole) for i, n in enumerate(counts)]


def solver_numbers(settings: Settings, dtype: np.dtype) -> Solving:
    """The settings that are data of the compiled program."""
    values: Any = [np.asarray(getattr(settings, n), np.int32 if n == "iterations" else dtype) for n in Solving._fields]
    return Solving(*values)


def as_dtype(tree: Any, dtype: np.dtype) -> Any:
    """A tree of arrays with its floating-point ones in another precision."""
    return jax.tree.map(lambda x: x.astype(dtype, copy=False) if np.issubdtype(x.dtype, np.floating) else x, tree)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def begin_pose(rotations: np.ndarray, root: np.ndarray, layers: int) -> Any:
    """What the first frame starts from; parts of it that are not finite begin at rest."""
    q = np.where(np.isfinite(rotations).all(0), rotations, np.eye(4, 1, dtype=rotations.dtype))
    place: Any = np.where(np.isfinite(root), root, 0)[:, None]
    turn: Any = q[..., None]
    pose = Pose(turn, place)
    ones: Any = np.ones(layers + 1, root.dtype)
    return Carried(pose, pose, ones[1:], ones[0])


def piece_of(frames: Any, begin: int, end: int, size: int = PIECE, empty: bool = False) -> Any:
    """Frames `begin..end-1` filled up to `size` with copies of the last, of which nothing is asked (of none, if `empty`)."""
    piece = jax.tree.map(lambda x: x[begin:end], frames)
    more = size - (end - begin)
    if more:
        piece = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], more, axis=0)]), piece)
    if more or empty:
        active = piece.goals.active.copy()
        active[0 if empty else end - begin :] = 0
        piece = piece._replace(goals=piece.goals._replace(active=active))
    return piece


def _last(piece: Any, frames: Any, begin: int, before: Any) -> Any:
    """What the frame after a piece, whose first frame is `begin`, starts from: the last finite pose and its input, trust and pull."""
    known = np.isfinite(piece.rotations).all((1, 2)) & np.isfinite(piece.root).all(1)
    if not known.any():
        return before._replace(trust=piece.trust[-1], pull=piece.pull[-1])
    at = len(known) - 1 - int(known[::-1].argmax())
    pose, own = ((f.rotations[i][..., None], f.root[i][:, None]) for f, i in ((piece, at), (frames, begin + at)))
    return Carried(Pose(*pose), Pose(*own), piece.trust[-1], piece.pull[-1])


def _unchanged(frames: Any, alike: np.ndarray | None, plan: Plan, old: Run | None) -> np.ndarray:
    """(F,) the frames of which the same is asked as in the old run, from the same start."""
    if old is None or alike is None or len(alike) != len(old.frames.root):
        return np.zeros(len(frames.root), bool)
    same = alike.copy()
    ours, theirs = _shared(plan, old.plan)
    same &= (frames.rotations[:, :, ours] == old.frames.rotations[:, :, theirs]).all((1, 2))
    same &= (frames.offsets[:, ours] == old.frames.offsets[:, theirs]).all((1, 2))
    for name in ("root", "warm"):
        same &= (getattr(frames, name) == getattr(old.frames, name)).reshape(len(same), -1).all(1)
    return same & (frames.goals.root_free == old.frames.goals.root_free)


def _shared(a: Plan, b: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Places, in the chains of both plans, of the joints that both have."""
    return np.flatnonzero(np.isin(a.kept, b.kept)), np.flatnonzero(np.isin(b.kept, a.kept))


def _taken(old: Run, plan: Plan, begin: int, end: int) -> Any:
    """Frames `begin..end-1` of an old run in the order of this plan's chain and constraints.

    Joints that only this plan has are not controlled in these frames, and are the input's. The constraints that are active
    in a frame are the same in both plans, in the same order.
    """
    ours, theirs = _shared(plan, old.plan)
    s = jax.tree.map(lambda x: x[begin:end], old.solved)
    rotations = plan.frames.rotations[begin:end].astype(s.rotations.dtype)
    rotations[:, :, ours] = s.rotations[:, :, theirs]
    b, n = plan.frames.goals.active.shape[1], plan.layers
    solo = np.ones((end - begin, b), s.solo.dtype)
    own, rank = np.ones((end - begin, n), s.own.dtype), np.zeros((end - begin, n), s.rank.dtype)
    trust = s.trust if n == old.plan.layers else np.ones((end - begin, n), s.trust.dtype)
    for f in range(begin, end):
        new_on, old_on = np.flatnonzero(plan.frames.goals.active[f]), np.flatnonzero(old.plan.frames.goals.active[f])
        if len(new_on) == len(old_on):
            solo[f - begin, new_on] = s.solo[f - begin, old_on]
            to, of = plan.tasks.layer[new_on], old.plan.tasks.layer[old_on]
            own[f - begin, to], rank[f - begin, to] = s.own[f - begin, of], s.rank[f - begin, of]
    return s._replace(rotations=rotations, solo=solo, own=own, rank=rank, trust=trust)


def _close(a: Any, b: Any) -> bool:
    gaps = [np.abs(x - y).max(initial=0.0) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)]
    return bool(max(gaps) < SAME)
