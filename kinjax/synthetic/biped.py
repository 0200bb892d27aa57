"""A person who stands, walks a few steps on flat ground, and stands again, feet exactly where they should be.

In: rate, number and length of steps. Out: a `Scene` with a `Motion` of 21 joints and the truth of both feet and toes.
The feet are written first (rest, toe roll, swing, heel rocker), the hips follow from them, the legs are solved in
closed form (two bones, knee forward), trunk and arms swing against the legs. Axes: x left, y up, z forward, metres.
"""

from __future__ import annotations

import numpy as np

from ..errors import OptionError
from ..motion import Motion
from ..skeleton import Skeleton, Topology
from .scene import RigidPath, Scene, box_markers, frame_count, make_scene
from .spatial import quat_exp, quat_from_matrix, quat_inv, quat_mul, quat_rotate, unroll

X, Y, Z = np.eye(3)
THIGH, SHANK, ANKLE = 0.40, 0.38, 0.08
HEEL, TOE, TOE_END = np.array([0, -ANKLE, -0.05]), np.array([0, -0.06, 0.11]), np.array([0, -0.02, 0.07])  # local
TOE_OUT = 0.1  # rad, each foot turned outwards
HEEL_PITCH, TOE_PITCH = 0.42, 0.80  # rad turned about the heel and about the ball of the toes
SWING, ROCKER, ROLL, STEP, STILL = 0.42, 0.12, 0.22, 0.55, 1.0  # s; a foot is flat for 2 STEP less the first three

_TRUNK = ("Hips", "Spine", "Spine1", "Neck", "Head")
_LIMB = (("Shoulder", "Spine1", (0.04, 0.18, 0.0)), ("Arm", "Shoulder", (0.13, 0, 0)), ("ForeArm", "Arm", (0.27, 0, 0)),
         ("Hand", "ForeArm", (0.25, 0, 0)))  # fmt: skip
_LEG = (("UpLeg", "Hips", (0.09, -0.03, 0)), ("Leg", "UpLeg", (0, -THIGH, 0)), ("Foot", "Leg", (0, -SHANK, 0)),
        ("ToeBase", "Foot", tuple(TOE)))  # fmt: skip


def biped_skeleton() -> Skeleton:
    """A person of 1.66 m in T-pose: 21 joints, five End Sites, channels as in a BVH (root 6, others Z X Y turns)."""
    names, parents = ["Hips"], [-1]
    offsets: list[tuple[float, ...]] = [(0.0, 0.0, 0.0)]

    def add(name: str, parent: str, offset: tuple[float, ...]) -> None:
        names.append(name)
        parents.append(names.index(parent))
        offsets.append(offset)

    for parent, name, y in zip(_TRUNK, _TRUNK[1:], (0.10, 0.17, 0.22, 0.09), strict=False):
        add(name, parent, (0.0, y, 0.0))
    for chain in (_LIMB, _LEG):
        for side, sign in (("Left", 1), ("Right", -1)):
            for name, parent, (x, y, z) in chain:
                add(side + name, parent if parent in names else side + parent, (sign * x, y, z))
    ends = {"Head": (0, 0.19, 0), "LeftHand": (0.16, 0, 0), "RightHand": (-0.16, 0, 0)}
    ends |= {"LeftToeBase": tuple(TOE_END), "RightToeBase": tuple(TOE_END)}
    turns = ("Zrotation", "Xrotation", "Yrotation")
    topology = Topology(
        names=tuple(names),
        parents=tuple(parents),
        channels=(("Xposition", "Yposition", "Zposition", *turns), *((turns,) * (len(names) - 1))),
        end_parents=tuple(names.index(n) for n in ends),
        end_names=("",) * len(ends),
    )
    return Skeleton(np.array(offsets, float), np.array(list(ends.values()), float), topology)


def walking_biped(rate: float = 120.0, steps: int = 6, step_length: float = 0.55) -> Scene:
    """A walk along z: rest 1 s, `steps` steps of 0.55 s (the last brings the feet together), rest 1 s.

    step_length: metres from one foot's plant to the other's; the walk has 1 m/s. Poses and truth are those of
    "LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase", origin at the segment's centre
    (`Skeleton.segment_centers`). Each step of a foot: swing (no truth), heel rocker 0.12 s (line, foot and toes as
    one), flat (space), toe roll 0.22 s (foot: line through the toe joint; toes: still space). Angular speeds are
    constant, 3.5 rad/s about the heel, 3.6 about the toes.
    """
    if steps < 2 or not step_length > 0:
        raise OptionError(f"steps is {steps} (at least 2), step_length is {step_length} m (must be positive)")
    skeleton = biped_skeleton()
    left, right = (_foot_paths(side, skeleton, rate, steps, step_length) for side in ("Left", "Right"))
    paths = [left[0], right[0], left[1], right[1]]
    motion = _body(skeleton, rate, {p.name: p.poses() for p in paths})
    layouts = {p.name: box_markers((0.05, 0.04, 0.08) if "Foot" in p.name else (0.06, 0.01, 0.06)) for p in paths}
    return make_scene("walk", rate, paths, layouts, motion)


def _foot_paths(side: str, skeleton: Skeleton, rate: float, steps: int, length: float) -> tuple[RigidPath, RigidPath]:
    """The paths of foot and toes of one side, written at their segments' centres. The right foot takes step 0."""
    sign = 1.0 if side == "Left" else -1.0
    centres = skeleton.segment_centers()
    c_foot, c_toe = (centres[skeleton.topology.index(side + n)] for n in ("Foot", "ToeBase"))
    heading = quat_exp(sign * TOE_OUT * Y)
    across = quat_rotate(heading, X)
    swing, rocker, roll, step, still = (frame_count(t, rate) for t in (SWING, ROCKER, ROLL, STEP, STILL))
    if 2 * step <= swing + rocker + roll:
        raise OptionError(f"rate is {rate:g} fps: too low for a walk (25 or more)")

    ankle = np.array([sign * 0.09, ANKLE, 0.0])
    foot = RigidPath(side + "Foot", heading, ankle + quat_rotate(heading, c_foot))
    toes = RigidPath(side + "ToeBase", heading, ankle + quat_rotate(heading, TOE + c_toe))
    z, down = 0.0, quat_mul(heading, quat_exp(-HEEL_PITCH * X))
    for k in range(0 if side == "Right" else 1, steps, 2):
        wait = still + k * step - foot.end
        foot.rest(wait)
        toes.rest(wait + roll)
        foot.turn(foot.position + quat_rotate(heading, TOE - c_foot), across, TOE_PITCH, roll)

        z = (k + 1 if k < steps - 1 else k) * length
        start = foot.position - quat_rotate(foot.rotation, c_foot)
        strike = np.array([ankle[0], 0.0, z]) + quat_rotate(heading, HEEL + ANKLE * Y) - quat_rotate(down, HEEL)
        s = np.arange(1, swing + 1)[:, None] / swing
        path = start + _advance(s) * (strike - start) + 4 * 0.05 * s * (1 - s) * Y
        pitch, bend = TOE_PITCH - s * (TOE_PITCH + HEEL_PITCH), -TOE_PITCH * (1 - s)
        r_foot, r_toe = quat_mul(heading, quat_exp(pitch * X)), quat_mul(heading, quat_exp((pitch + bend) * X))
        foot.move(r_foot, path + quat_rotate(r_foot, c_foot))
        toes.move(r_toe, path + quat_rotate(r_foot, TOE) + quat_rotate(r_toe, c_toe))

        heel = strike + quat_rotate(down, HEEL)
        foot.turn(heel, across, HEEL_PITCH, rocker)
        toes.turn(heel, across, HEEL_PITCH, rocker)
    last = still + (steps - 1) * step + roll + swing + rocker + still
    foot.rest(last - foot.end)
    toes.rest(last - toes.end)
    return foot, toes


def _advance(s: np.ndarray, ease: float = 0.25) -> np.ndarray:
    """How far a swing has come, 0 to 1: between even and eased speed, so that the foot leaves the ground at speed."""
    return (1 - ease) * s + ease * s * s * (3 - 2 * s)


def _smooth(x: np.ndarray, half: int) -> np.ndarray:
    """Weighted running mean over `2 half + 1` frames (Hann window), ends held."""
    w = np.hanning(2 * half + 3)[1:-1]
    padded = np.concatenate([np.repeat(x[:1], half), x, np.repeat(x[-1:], half)])
    return np.convolve(padded, w / w.sum(), "valid")


def _body(skeleton: Skeleton, rate: float, feet: dict[str, tuple[np.ndarray, np.ndarray]]) -> Motion:
    """The whole body's motion, given the world rotations and positions of feet and toes at their segments' centres."""
    index, offsets = skeleton.topology.index, np.asarray(skeleton.offsets)
    centres, half, brief = skeleton.segment_centers(), frame_count(0.35, rate), frame_count(0.2, rate)
    ankles = {}
    for side in ("Left", "Right"):
        rotation, position = feet[side + "Foot"]
        ankles[side] = position - quat_rotate(rotation, centres[index(side + "Foot")])
    n = len(ankles["Left"])
    apart = _smooth(ankles["Left"][:, 2] - ankles["Right"][:, 2], half)  # left foot ahead, metres
    lift = _smooth(ankles["Right"][:, 1] - ankles["Left"][:, 1], half)

    world = np.tile(np.array([1.0, 0, 0, 0]), (n, len(skeleton.names), 1))
    yaw, lean = -0.22 * apart, 0.04 * _smooth(np.abs(apart), brief)
    hips = quat_mul(quat_exp(yaw[:, None] * Y), quat_exp(0.6 * lift[:, None] * Z))
    world[:, 0] = hips
    trunk = quat_mul(quat_exp(-0.5 * yaw[:, None] * Y), quat_exp(lean[:, None] * X))
    world[:, index("Spine")] = quat_mul(quat_exp(0.3 * yaw[:, None] * Y), quat_exp(0.5 * lean[:, None] * X))
    for name in ("Spine1", "LeftShoulder", "RightShoulder"):
        world[:, index(name)] = trunk
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        swing = 0.45 * sign * apart[:, None]  # positive: arm back, while the leg of its side is ahead
        arm = quat_mul(quat_mul(trunk, quat_exp(swing * X)), quat_exp(np.array([0, 0, -1.35 * sign])))
        flex = -sign * (0.3 - 0.5 * swing)
        world[:, index(side + "Arm")] = arm
        world[:, index(side + "ForeArm")] = world[:, index(side + "Hand")] = quat_mul(arm, quat_exp(flex * Y))

    root = np.zeros((n, 3))
    root[:, 0] = 0.3 * lift
    root[:, 2] = 0.04 + _smooth(0.5 * (ankles["Left"] + ankles["Right"])[:, 2], half)
    sockets = {s: quat_rotate(hips, offsets[index(s + "UpLeg")]) for s in ankles}
    reach = 0.985 * (THIGH + SHANK)
    height = np.full(n, np.inf)
    for side, ankle in ankles.items():
        d = ankle - root - sockets[side]
        flat = reach**2 - d[:, 0] ** 2 - d[:, 2] ** 2
        if (flat < 0.25 * reach**2).any():
            raise OptionError("step_length is longer than the legs can reach (0.7 m is)")
        height = np.minimum(height, d[:, 1] + np.sqrt(flat))
    lowest = np.lib.stride_tricks.sliding_window_view(np.pad(height, brief, mode="edge"), 2 * brief + 1).min(-1)
    root[:, 1] = _smooth(lowest, brief)  # never above `height`: as high as both legs allow, and smooth

    for side, ankle in ankles.items():
        foot, toes = feet[side + "Foot"][0], feet[side + "ToeBase"][0]
        thigh, shank = _two_bones(root + sockets[side], ankle, quat_rotate(foot, X))
        for name, q in (("UpLeg", thigh), ("Leg", shank), ("Foot", foot), ("ToeBase", toes)):
            world[:, index(side + name)] = q
    local = local_rotations(world, skeleton.topology.parents)
    return Motion(root[:, None], local, skeleton, float(rate), name="walk", notes=("synthetic",))


def _two_bones(hip: np.ndarray, ankle: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (frames, 4) of thigh and shank, bones along -y, so that they end at `ankle`; knee bent forward.

    The knee's axis is `across` (frames, 3) made perpendicular to the line from hip to ankle; lengths by the law of
    cosines.
    """
    d = ankle - hip
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    u = d / length
    axis = across - u * np.sum(u * across, -1, keepdims=True)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    front = np.cross(u, axis)
    cos = (THIGH**2 + length**2 - SHANK**2) / (2 * THIGH * length)
    knee = THIGH * (cos * u + np.sqrt(1 - cos**2) * front)

    def along(bone: np.ndarray) -> np.ndarray:
        y = -bone / np.linalg.norm(bone, axis=-1, keepdims=True)
        return quat_from_matrix(np.stack([axis, y, np.cross(axis, y)], -1))

    return along(knee), along(d - knee)


def local_rotations(world: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Rotations relative to the parent joint, continuous in sign, of world rotations (frames, joints, 4)."""
    local = world.copy()
    for j, p in enumerate(parents):
        if p >= 0:
            local[:, j] = quat_mul(quat_inv(world[:, p]), world[:, j])
    return unroll(local / np.linalg.norm(local, axis=-1, keepdims=True))
