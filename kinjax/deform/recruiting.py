"""Which joints a constraint may use, and the rule that keeps priorities enforceable (2004 paper, section 4.1, eq. 2).

In: constraints and the skeleton's topology. Out: sets of joint indices, or `OptionError` that names both constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..errors import OptionError
from ..skeleton import Topology
from .constraints import CenterOfMass, Goal, Position


def chain_of(top: Topology, joint: int) -> list[int]:
    """A joint and its ancestors, upwards."""
    out = []
    while joint >= 0:
        out.append(joint)
        joint = top.parents[joint]
    return out


def recruited(goal: Goal, top: Topology, title: str) -> frozenset[int]:
    """Indices of the joints that a constraint recruits; see `constraints` for the defaults."""
    if goal.recruits is not None and goal.recruit_to is not None:
        raise OptionError(f"{title}: recruits lists the joints and recruit_to ends the chain: give one of them")
    if goal.recruits is not None:
        if not goal.recruits:
            raise OptionError(f"{title}: recruits is empty: name at least one joint, or leave it out")
        return frozenset(top.index(n) for n in goal.recruits)
    if isinstance(goal, CenterOfMass):
        if goal.recruit_to is not None:
            raise OptionError(f"{title}: a centre of mass has no chain: list its joints in recruits")
        return frozenset(range(len(top.names)))
    joint = top.index(goal.joint)
    chain = chain_of(top, joint)
    if goal.recruit_to is not None:
        last = top.index(goal.recruit_to)
        if last not in chain:
            raise OptionError(
                f"{title}: recruit_to={goal.recruit_to!r} is not between {top.names[joint]} and the root "
                f"({', '.join(top.names[j] for j in chain)})"
            )
        chain = chain[: chain.index(last) + 1]
    if isinstance(goal, Position) and not np.any(np.asarray(goal.point, float)) and len(chain) > 1:
        chain = chain[1:]  # a joint's turn does not move its own origin
    return frozenset(chain)


def check_rule(
    titles: Sequence[str],
    priorities: Sequence[float],
    sets: Sequence[frozenset[int]],
    moves: Sequence[frozenset[int]],
    active: np.ndarray,
    top: Topology,
) -> None:
    """The recruiting rule (eq. 2): where two constraints share joints at one time, the more important one must recruit all that
    the other recruits; else the other moves it behind its back.

    Asked only of the joints that can move the more important constraint (`moves`): the arms that a centre of mass recruits
    cannot disturb a foot above it. active: (F, B).
    """
    for a, b in combinations(range(len(titles)), 2):
        if priorities[a] == priorities[b]:
            continue
        if priorities[a] < priorities[b]:
            a, b = b, a
        missing = (sets[b] - sets[a]) & moves[a]
        if missing and (active[:, a] & active[:, b]).any():
            raise OptionError(
                f"recruiting rule: {titles[b]} (priority {priorities[b]:g}) recruits {_some(missing, top)}, which "
                f"{titles[a]} (priority {priorities[a]:g}) depends on but does not recruit; give {titles[a]} these joints too "
                f"(recruits), end the chain of {titles[b]} earlier (recruit_to), or give both one priority"
            )


def _some(joints: frozenset[int], top: Topology) -> str:
    names = [top.names[j] for j in sorted(joints)]
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
