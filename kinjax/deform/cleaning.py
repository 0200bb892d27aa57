"""From detected constraints to a motion that keeps them: planted feet that stand still, hinges and pivots that stay.

In: annotations (found by detection, or written by a person) and the motion they are of. Out: constraints for `deform`, or
the cleaned motion. Nothing here detects: the two halves meet in `annotations`.

A space constraint becomes the place and the orientation of its joint, all six freedoms, held at one pose: the mean of the
input's poses over the constraint, the pose that is nearest to all of them. A line becomes two points of its axis on the
body, one body-length apart, a point one. Their places are means as well.

**A foot and its toes, both planted.** Twelve freedoms on two bodies that share a joint: the means would disagree by the noise,
and one constraint's easing would pull at the other while that still holds. So constraints of a joint and of its child that
meet in time are one standing thing: the joint between them is held at one place for as long as either stands, and each
body's orientation for its own time. Both then stand still whatever the other does.

**A foot that rolls on from its rest** must leave the pose that it was held at, and an axis held at the same time would be in
the way; two bodies that roll about one joint never agree to the millimetre either. So rests come first, with their easing, and
the longer constraint before the shorter: of a line or point, the frames are held that constraints of the same body and
its neighbours leave to it, and it is left out where those are fewer than `SHORTEST`. What a foot turns about while its toes still
stand is held already: it is the joint between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..annotations import Annotations, Constraint
from ..errors import OptionError, find_name
from ..motion import Motion
from ..quaternions import from_turns, turns
from .body import Body
from .constraints import Goal, Orientation, Position
from .pipeline import deform
from .results import Deformation
from .settings import Settings

EASE = 0.1
"""Seconds in which a joint is brought to its held place before a constraint, and let go after it."""

SHORTEST = 5
"""Frames of a line or point that must remain for it to be held."""

LENGTH = 0.1
"""Metres between the two points of an axis where the body has no length of its own."""


def clean(
    motion: Motion,
    annotations: Annotations | Iterable[Constraint],
    settings: Settings | None = None,
    *,
    relative_to: str | None = None,
    ease: float = EASE,
    progress: Callable[[int, int], None] | None = None,
) -> Deformation:
    """`motion` with every constraint in `annotations` kept exactly: see `constraints_from`, whose options these are."""
    goals = constraints_from(annotations, motion, relative_to=relative_to, ease=ease)
    return deform(motion, goals, settings, progress)


def constraints_from(
    annotations: Annotations | Iterable[Constraint],
    motion: Motion,
    *,
    relative_to: str | None = None,
    ease: float = EASE,
    priority: float = 1.0,
) -> list[Goal]:
    """The constraints that hold what `annotations` found in `motion`.

    relative_to: the joint that they were found relative to, if not the world. ease: seconds of easing at either end, less
    where constraints of the same joint, its parent or its children are nearer. priority: of all of them. Raises
    `OptionError` for annotations that are not of this motion.
    """
    if not np.isfinite(ease) or ease < 0:
        raise OptionError(f"ease={ease!r} is not a number of seconds from 0")
    held = _Held(motion, relative_to, int(np.ceil(ease * float(motion.rate) - 1e-9)))
    rests, rolls = held.sort(annotations)
    return held.rests(rests, priority) + held.rolls(rolls, rests, priority)


@dataclass
class _Rest:
    """A space constraint: its joint, frames and mean pose (the place is that of the segment's centre)."""

    joint: int
    begin: int
    end: int
    turn: Rotation
    place: np.ndarray


@dataclass
class _Pivot:
    """A joint's origin that is held because the bodies on both its sides rest: where, and for how long."""

    joint: int
    begin: int
    end: int
    place: np.ndarray


class _Held:
    """The motion in the frame of reference, and what is to be held in it."""

    def __init__(self, motion: Motion, relative_to: str | None, ease: int):
        body = Body(motion)
        self.top, self.frames, self.rate, self.ease = body.top, body.frames, body.rate, ease
        self.centers = motion.skeleton.segment_centers().astype(float)
        self.rotation, self.origin = body.rotation, body.position + body.origin
        self.name, self.reference = motion.name or "the motion", None
        if relative_to is not None:
            at = find_name(relative_to, self.top.names, "joint", motion.name)
            self.reference = self.top.names[at]
            finite = np.isfinite(body.rotation[:, at]).all(1)
            back = turns(body.rotation[:, at]).inv()
            self.origin = np.stack(
                [back.apply(self.origin[:, j] - self.origin[:, at]) for j in range(motion.joints)], axis=1
            )
            turned = [from_turns(back * turns(self.rotation[:, j])) for j in range(motion.joints)]
            self.rotation = np.stack(turned, axis=1)
            self.origin[~finite] = np.nan

    # ---- what is asked

    def sort(self, annotations: Annotations | Iterable[Constraint]) -> tuple[list[_Rest], list[Constraint]]:
        """Space constraints with their mean poses, and the lines and points, in order of time."""
        if isinstance(annotations, Annotations) and annotations.frames not in (0, self.frames):
            raise OptionError(
                f"the annotations are of a clip of {annotations.frames} frames, and {self.name} has {self.frames}"
            )
        found = list(annotations.constraints if isinstance(annotations, Annotations) else annotations)
        rests: list[_Rest] = []
        rolls: list[Constraint] = []
        for c in sorted(found, key=lambda c: (c.begin, c.end)):
            if not 0 <= c.begin <= c.end < self.frames:
                raise OptionError(
                    f"the {c.type} constraint of {c.object!r}, frames {c.begin}..{c.end}, is not inside the clip's "
                    f"0..{self.frames - 1}"
                )
            joint = find_name(c.object, self.top.names, "joint", self.name)
            if c.type != "space":
                rolls.append(replace(c, object=self.top.names[joint]))
                continue
            begin = max([c.begin, *(r.end + 1 for r in rests if r.joint == joint)])
            if begin <= c.end:
                rests.append(_Rest(joint, begin, c.end, *self.mean_pose(joint, begin, c.end)))
        return rests, rolls

    def seen(self, joint: int, begin: int, end: int) -> tuple[Rotation, np.ndarray]:
        """Rotations and origins of a joint in the finite frames of `begin..end`."""
        q, p = self.rotation[begin : end + 1, joint], self.origin[begin : end + 1, joint]
        known = np.isfinite(q).all(1) & np.isfinite(p).all(1)
        if not known.any():
            raise OptionError(f"{self.top.names[joint]} is nowhere finite in frames {begin}..{end}: nothing to hold")
        return turns(q[known]), p[known]

    def mean_pose(self, joint: int, begin: int, end: int) -> tuple[Rotation, np.ndarray]:
        """The mean rotation of a joint, and the mean place of its segment's centre."""
        turn, place = self.seen(joint, begin, end)
        return turn.mean(), (place + turn.apply(self.centers[joint])).mean(0)

    # ---- rests

    def rests(self, rests: Sequence[_Rest], priority: float) -> list[Goal]:
        """Places and orientations of everything that rests."""
        pivots = self._pivots(rests)
        places: list[tuple[int, int, int, np.ndarray, np.ndarray]] = [
            (p.joint, p.begin, p.end, np.zeros(3), p.place) for p in pivots
        ]
        for r in rests:
            if not any(self._holds(p, r) for p in pivots):
                places.append((r.joint, r.begin, r.end, self.centers[r.joint], r.place))
        goals: list[Goal] = []
        for i, (joint, begin, end, point, at) in enumerate(places):
            spans = [(b, e) for k, (j, b, e, *_) in enumerate(places) if k != i and self._near(j, joint)]
            eases = self._eases(begin, end, spans)
            goals.append(
                Position(
                    self.top.names[joint], at=_vector(at), point=_vector(point), begin=begin, end=end, priority=priority,
                    relative_to=self.reference, name=self._title(joint, "place", begin, end), **eases,
                )
            )  # fmt: skip
        for i, r in enumerate(rests):
            spans = [(s.begin, s.end) for k, s in enumerate(rests) if k != i and s.joint == r.joint]
            goals.append(
                Orientation(
                    self.top.names[r.joint], at=_vector(from_turns(r.turn)), begin=r.begin, end=r.end,
                    priority=priority, relative_to=self.reference, name=self._title(r.joint, "turn", r.begin, r.end),
                    **self._eases(r.begin, r.end, spans),
                )
            )  # fmt: skip
        return goals

    def _pivots(self, rests: Sequence[_Rest]) -> list[_Pivot]:
        """The joints between bodies that rest at one time, from the root outwards; each cluster of rests about a joint once."""
        out: list[_Pivot] = []
        for joint, parent in enumerate(self.top.parents):
            about = sorted((r for r in rests if r.joint in (joint, parent)), key=lambda r: r.begin)
            for cluster in _clusters(about, self.ease // 2):
                if {r.joint for r in cluster} != {joint, parent}:
                    continue
                begin, end = min(r.begin for r in cluster), max(r.end for r in cluster)
                place = self.seen(joint, begin, end)[1].mean(0)
                longest = max((r for r in cluster if r.joint == parent), key=lambda r: r.end - r.begin)
                above = next((p for p in out if p.joint == parent and self._holds(p, longest)), None)
                if above is not None:  # the body between two pivots keeps its length
                    place = above.place + longest.turn.apply(self._local(joint, parent))
                out.append(_Pivot(joint, begin, end, place))
        return out

    def _holds(self, p: _Pivot, r: _Rest) -> bool:
        """Whether a pivot is a point of a body that rests, for all of its rest."""
        return r.joint in (p.joint, self.top.parents[p.joint]) and p.begin <= r.begin and r.end <= p.end

    def _local(self, joint: int, body: int) -> np.ndarray:
        """The origin of a joint in its parent's frame, the mean over the clip: it may have channels of its own."""
        known = np.isfinite(self.origin[:, (joint, body)]).all((1, 2)) & np.isfinite(self.rotation[:, body]).all(1)
        turn, away = turns(self.rotation[known, body]), self.origin[known, joint] - self.origin[known, body]
        return turn.inv().apply(away).mean(0)

    # ---- lines and points

    def rolls(self, rolls: Sequence[Constraint], rests: Sequence[_Rest], priority: float) -> list[Goal]:
        """The points that lines and points hold, in the frames that rests and longer ones of the same and neighbouring bodies
        leave them."""
        taken = [(r.joint, r.begin - self.ease, r.end + self.ease) for r in rests]
        goals: list[Goal] = []
        for c in sorted(rolls, key=lambda c: (-c.frames, c.begin)):
            joint = self.top.index(c.object)
            busy = [(b, e) for j, b, e in taken if self._near(j, joint)]
            begin, end = _longest_free(c.begin, c.end, busy)
            if end - begin + 1 < min(SHORTEST, c.frames):
                continue
            ease = self._eases(begin, end, busy, shared=False)
            margin = (round(ease[k] * self.rate) for k in ("ease_in", "ease_out"))
            taken.append((joint, begin - next(margin), end + next(margin)))
            for k, point in enumerate(self._body_points(c, joint, begin, end)):
                turn, place = self.seen(joint, begin, end)
                what = f"{c.type} {k + 1}" if c.type == "line" else c.type
                goals.append(
                    Position(
                        c.object, at=_vector((place + turn.apply(point)).mean(0)), point=_vector(point), begin=begin,
                        end=end, priority=priority, relative_to=self.reference,
                        name=self._title(joint, what, begin, end), **ease,
                    )
                )  # fmt: skip
        return sorted(goals, key=lambda g: g.begin)

    def _body_points(self, c: Constraint, joint: int, begin: int, end: int) -> list[np.ndarray]:
        """Where on the body a point constraint has its point, and a line two points of its axis."""
        turn, place = self.seen(joint, begin, end)
        middle = turn.inv().apply(np.asarray(c.position, float) - place).mean(0)
        if c.type == "point" or c.axis is None:
            return [middle]
        along = turn.inv().apply(np.asarray(c.axis, float)).mean(0)
        length = 2 * float(np.linalg.norm(self.centers[joint])) or LENGTH
        half = 0.5 * length * along / max(float(np.linalg.norm(along)), 1e-9)
        return [middle - half, middle + half]

    # ---- eases and names

    def _near(self, a: int, b: int) -> bool:
        """Whether two joints are one, or one the other's parent: what holds one of them binds the other."""
        return a == b or self.top.parents[a] == b or self.top.parents[b] == a

    def _eases(self, begin: int, end: int, others: Iterable[tuple[int, int]], shared: bool = True) -> dict[str, Any]:
        """Seconds before and after: as asked, or up to the nearest of the `others`; half the way if that eases, too (`shared`)."""
        part = 2 if shared else 1
        frames_in = frames_out = self.ease
        for b, e in others:
            if e < begin:
                frames_in = min(frames_in, (begin - e - 1) // part)
            elif b > end:
                frames_out = min(frames_out, (b - end - 1) // part)
            else:
                frames_in, frames_out = (0 if b < begin else frames_in), (0 if e > end else frames_out)
        return {"ease_in": frames_in / self.rate, "ease_out": frames_out / self.rate}

    def _title(self, joint: int, what: str, begin: int, end: int) -> str:
        return f"{self.top.names[joint]} {what} {begin}..{end}"


def _clusters(rests: Sequence[_Rest], gap: int) -> list[list[_Rest]]:
    """Rests in order of time, parted where nothing rests for more than `gap` frames."""
    out: list[list[_Rest]] = []
    last = -1
    for r in rests:
        if not out or r.begin > last + gap + 1:
            out.append([])
        out[-1].append(r)
        last = max(last, r.end) if len(out[-1]) > 1 else r.end
    return out


def _longest_free(begin: int, end: int, busy: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """The longest run of frames in `begin..end` that is in none of the spans; (begin, begin - 1) when there is none."""
    free = np.ones(end - begin + 3, bool)
    free[[0, -1]] = False
    for b, e in busy:
        free[max(b - begin + 1, 0) : max(e - begin + 2, 0)] = False
    edges = np.flatnonzero(np.diff(free)).reshape(-1, 2)
    if not len(edges):
        return begin, begin - 1
    first, last = edges[(edges[:, 1] - edges[:, 0]).argmax()]
    return begin + int(first), begin + int(last) - 1


def _vector(v: np.ndarray) -> tuple[float, ...]:
    return tuple(float(x) for x in np.asarray(v))
