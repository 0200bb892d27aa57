"""Putting it all together (2004 paper, figure 7): a walk on the level becomes a climb over irregular stairs.

Four shape-constraints take ankles and toes from step to step, one holds the right elbow relative to the torso, one the
orientation of the right forearm (a tray), and the centre of mass keeps its place over the feet, wherever they climb, by the
legs. It and the body's height follow from legs that are drawn to the walk's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from kinjax.deform import CenterOfMass, Orientation, Position, Settings, Through
from kinjax.deform.targets import place_path, span_of
from kinjax.motion import Motion

from .clips import FEET, LEGS, RATE, distance, load_walk, places, poses, rests
from .scene import Finding, Outcome, Scene, Variant

RISES = (0.0, 0.16, 0.12, 0.18, 0.14, 0.15)
"""How much higher each stand is than the one before it, metres; the walk has five and a sixth foot on its way."""
CLEARANCE = 0.04
"""Metres that a foot passes over what it climbs, more than the walk's own."""
TRAY = (12, 64)
"""Frames in which the right arm carries."""


def build(data: Path) -> Scene:
    """The scene on the walk of 35_01."""
    motion = load_walk(data)
    feet = shapes(motion)
    elbow = Position(
        "rradius", relative_to="thorax", at=elbow_place(motion), begin=TRAY[0], end=TRAY[1], priority=3,
        recruits=("rhumerus", "rclavicle"), name="elbow beside the torso",
    )  # fmt: skip
    forearm = Orientation(
        "rradius", at=forearm_turn(motion), begin=TRAY[0], end=TRAY[1], priority=2,
        recruits=("rradius", "rhumerus", "rclavicle", "root"),
        name="forearm level",
    )  # fmt: skip
    legs = tuple({j: None for leg in LEGS.values() for j in leg})
    balance = CenterOfMass(support=FEET, axes="xz", priority=1, recruits=legs, name="centre of mass over the feet")
    # the root has to climb: drawn to the level walk's (which the paper does not do), it would sink under a raised body
    variants = {"climbing": Variant((*feet, elbow, forearm, balance), Settings(attract_root=False))}
    lines = {"stairs": profile(motion)}
    return Scene("stairs", motion, variants, (8, 20, 32, 44, 56, 66), tuple(variants), (), ("lfoot", "rfoot"), lines)


def shapes(motion: Motion) -> tuple[Position, ...]:
    """The feet's four shape-constraints; the toes' as paths, drawn to a bone's length from the ankle's.

    Between their passes two splines on one bone contradict each other by millimetres.
    """
    curve = {}
    for j in FEET:
        goal = Position(j, through=passes(motion, j), priority=4, recruits=LEGS[j], name=f"{j} on the stairs")
        span = span_of(goal, goal.name, motion.frames, RATE)
        curve[j] = goal, place_path(goal, goal.name, span, places(motion, j), RATE).goal
    out = []
    for ankle, toes in (FEET[:2], FEET[2:]):
        (above, at), (below, to) = curve[ankle], curve[toes]
        bone = np.linalg.norm(motion.skeleton.offsets[motion.skeleton.topology.index(toes)])
        way = (to - at) / np.linalg.norm(to - at, axis=1, keepdims=True) * bone
        out += [above, replace(below, through=(), path=at + way)]
    return tuple(out)


def stands(motion: Motion) -> list[tuple[str, int, int, float]]:
    """Side, first and last frame, and height of the step, of each stand in the order of time: ankle and toes both rest."""
    found = []
    for side in "lr":
        ankle, toe = (rests(places(motion, side + j), RATE) for j in ("foot", "toes"))
        found += [(side, max(a, c), min(b, d)) for a, b in ankle for c, d in toe if min(b, d) - max(a, c) >= 2]
    found.sort(key=lambda s: s[1])
    return [(*s, float(h)) for s, h in zip(found, np.cumsum(RISES)[:-1], strict=True)]


def place_of(motion: Motion, joint: str, begin: int, end: int, height: float) -> np.ndarray:
    """Where a joint of the foot stands: the ankle's mean place, and the toes' at a bone's length from it."""
    side = joint[0]
    ankle, toe = (places(motion, side + j)[begin : end + 1] for j in ("foot", "toes"))
    at = ankle.mean(0) + np.array([0, height, 0])
    if joint.endswith("foot"):
        return at
    way = toe.mean(0) - ankle.mean(0)
    return at + way / np.linalg.norm(way) * np.linalg.norm(toe[0] - ankle[0])


def passes(motion: Motion, joint: str) -> tuple[Through, ...]:
    """The shape-constraint of one joint: it rests on its steps, and swings as in the walk, raised from step to step."""
    side = joint[0]
    own, last = places(motion, joint), motion.frames - 1
    mine = [s for s in stands(motion) if s[0] == side]
    out: list[Through] = []
    before = (0, 0.0)
    for _, begin, end, height in mine:
        out += _swing(own, *before, begin, height)
        out.append(Through(begin, place_of(motion, joint, begin, end, height), end))
        before = (end, height)
    if before[0] < last:  # the clip ends as one foot comes down: so does the climb, on one step more
        height = before[1] if side == stands(motion)[-1][0] else sum(RISES)
        out += [*_swing(own, *before, last, height), Through(last, own[last] + [0, height, 0])]
    return tuple(out)


def _swing(own: np.ndarray, leave: int, low: float, arrive: int, high: float) -> list[Through]:
    """Passes every third frame between two stands; most of the rise comes first, so that the foot clears the edge."""
    out = []
    for f in range(leave + 2, arrive - 1, 3):
        u = (f - leave) / (arrive - leave)
        x = min(1.0, u / 0.6)
        rise = low + (high - low) * x * x * (3 - 2 * x) + CLEARANCE * np.sin(np.pi * u) * (high > low)
        out.append(Through(f, own[f] + [0, rise, 0]))
    return out


def elbow_place(motion: Motion) -> np.ndarray:
    """In the torso's frame: the elbow's mean place, at its bone's length from the mean shoulder."""
    rotation, position = poses(motion)
    index = motion.skeleton.topology.index
    torso, shoulder, elbow = (index(j) for j in ("thorax", "rhumerus", "rradius"))
    back = Rotation.from_quat(rotation[:, torso][:, [1, 2, 3, 0]]).inv()
    upper, lower = (back.apply(position[:, j] - position[:, torso]).mean(0) for j in (shoulder, elbow))
    bone = np.linalg.norm(position[0, elbow] - position[0, shoulder])
    return upper + (lower - upper) / np.linalg.norm(lower - upper) * bone


def forearm_turn(motion: Motion) -> np.ndarray:
    """The forearm's orientation in the middle of the clip, turned the shortest way until it points forward and level."""
    rotation, position = poses(motion)
    index = motion.skeleton.topology.index
    elbow, hand = index("rradius"), index("rwrist")
    middle = motion.frames // 2
    along = position[middle, hand] - position[middle, elbow]
    along /= np.linalg.norm(along)
    ahead = np.array([0.0, 0.0, 1.0])
    turn = Rotation.from_rotvec(
        np.cross(along, ahead) / np.linalg.norm(np.cross(along, ahead)) * np.arccos(np.clip(along @ ahead, -1, 1))
    )
    own = Rotation.from_quat(rotation[middle, elbow][[1, 2, 3, 0]])
    return (turn * own).as_quat()[[3, 0, 1, 2]]


def profile(motion: Motion) -> np.ndarray:
    """(N, 3) the stairs from the side, through the middle of the walk: treads and risers."""
    edges = treads(motion)
    x = float(places(motion, "root")[:, 0].mean())
    return np.array([(x, h, z) for a, b, h in edges for z in (a, b)])


def treads(motion: Motion) -> list[tuple[float, float, float]]:
    """Back, front and height of each step, along z; an edge lies half-way between the toes before it and the heel after."""
    rows = [
        (place_of(motion, s + "foot", a, b, h), place_of(motion, s + "toes", a, b, h), h)
        for s, a, b, h in stands(motion)
    ]
    last = [places(motion, {"l": "r", "r": "l"}[stands(motion)[-1][0]] + j)[-1] for j in ("foot", "toes")]
    rows.append((*last, sum(RISES)))
    cuts = [(rows[i][1][2] + 0.07 + rows[i + 1][0][2] - 0.05) / 2 for i in range(len(rows) - 1)]
    cuts = [rows[0][0][2] - 0.4, *cuts, rows[-1][1][2] + 0.4]
    return [(cuts[i], cuts[i + 1], row[2]) for i, row in enumerate(rows)]


def check(scene: Scene, results: dict[str, Outcome]) -> list[Finding]:
    """Feet on the steps, elbow and forearm held, nothing through the stairs, no jerk."""
    o, motion = results["climbing"], scene.motion
    report = o.deformation.report
    off = max(
        float(distance(places(o.motion, s + j)[a : b + 1], place_of(motion, s + j, a, b, h)).max())
        for s, a, b, h in stands(motion)
        for j in ("foot", "toes")
    )
    held = slice(TRAY[0], TRAY[1] + 1)
    rows = {t: report.residual[held, i] for i, t in enumerate(report.titles)}
    return [
        Finding("feet stand on their steps", 1e3 * off, below=1.0),
        Finding("the elbow stays beside the torso", 1e3 * float(rows["elbow beside the torso"].max()), below=1.0),
        Finding("the forearm stays level", float(np.degrees(rows["forearm level"].max())), below=0.1, unit="deg"),
        Finding("joints do not go through the stairs", 1e3 * sunk(scene, o.motion), below=10.0),
        Finding(
            "greatest acceleration of a joint, in the walk's",
            jerk(o.motion) / jerk(motion),
            below=2.0,
            unit="x",
        ),
        Finding("passes", float(report.passes), above=1.5, unit="passes"),
    ]


def sunk(scene: Scene, motion: Motion) -> float:
    """How far a joint of the feet is deeper over the stairs than it ever is over the level floor, metres."""
    floor = {j: places(scene.motion, j)[:, 1].min() for j in FEET}
    worst = 0.0
    for j in FEET:
        path, height = places(motion, j), np.zeros(motion.frames)
        for back, front, h in treads(scene.motion):
            height[(path[:, 2] >= back) & (path[:, 2] < front)] = h
        worst = max(worst, float((height + floor[j] - path[:, 1]).max()))
    return worst


def jerk(motion: Motion) -> float:
    """The greatest acceleration of any joint, m/s2."""
    return float(np.linalg.norm(np.diff(poses(motion)[1], n=2, axis=0), axis=-1).max() * RATE**2)
