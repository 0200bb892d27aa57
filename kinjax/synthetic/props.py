"""Single bodies with known constraints: a door on its hinge, a ball joint, a foot that rolls from heel to toe.

In: rate and a few sizes. Out: a `Scene` with one object each. Durations and speeds are those of everyday things and of
walking; every motion starts impulsively at full speed, so that begin and end are sharp to a frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import OptionError
from .scene import RigidPath, Scene, box_markers, frame_count, make_scene
from .spatial import quat_exp, quat_mul, quat_rotate

ACROSS, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
HEEL, TOE = np.array([0.0, -0.04, -0.13]), np.array([0.0, -0.04, 0.13])  # of the rolling foot, metres from its centre
PIVOT_SPEED = 4.0  # rad/s about heel and toe


def hinge(rate: float = 100.0, reach: float = 0.15, axis: Sequence[float] = (0.0, 1.0, 0.0)) -> Scene:
    """A door, "door", opened and closed again: rest 0.4 s, line 0.6 s, pause 0.4 s, line 0.6 s back, rest 0.4 s.

    reach: metres from the hinge's axis to the door's centre, its origin; 0.15 keeps the pivot within the 0.2 m in which
    detection looks for one, a real door has 0.4. axis: direction of the hinge. The angular speed rises smoothly from
    2.9 rad/s to 4.9 and falls back; it never passes through zero, because the door pauses where it turns back.
    """
    if not reach > 0:
        raise OptionError(f"reach is {reach}: it must be positive (metres)")
    n = np.asarray(axis, float)
    if n.shape != (3,) or not np.linalg.norm(n) > 0:
        raise OptionError(f"axis is {axis}: it must be a direction of three numbers")
    upright = _shortest_turn(UP, n / np.linalg.norm(n))
    path = RigidPath("door", upright, np.array([0.0, 1.0, 0.0]))
    pivot = path.position - quat_rotate(upright, reach * ACROSS)
    still, swing, angle = frame_count(0.4, rate), frame_count(0.6, rate), 0.75 * np.pi
    path.rest(still)
    path.turn(pivot, n, angle, swing, ease=0.25)
    path.rest(still)
    path.turn(pivot, n, -angle, swing, ease=0.25)
    path.rest(still)
    return make_scene("hinge", rate, [path], {"door": box_markers((reach, 0.1, 0.02))})


def _shortest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The quaternion that takes the unit vector `a` to the unit vector `b`."""
    cross, dot = np.cross(a, b), float(np.dot(a, b))
    if np.linalg.norm(cross) < 1e-12:
        return quat_exp(np.zeros(3) if dot > 0 else np.pi * ACROSS)
    return quat_exp(cross / np.linalg.norm(cross) * np.arctan2(np.linalg.norm(cross), dot))


def ball_joint(rate: float = 100.0, reach: float = 0.12, seconds: float = 1.6) -> Scene:
    """A body, "ball", turning about a fixed point: rest 0.4 s, point `seconds`, rest 0.4 s.

    The turn is `exp(t A) exp(t B)` with constant `A` and `B` at right angles: the angular velocity `A + exp(t A) B`
    keeps its length, 8.5 rad/s, while its direction circles `A` at 45 degrees and 6 rad/s. Within 0.4 s, the longest
    window of detection, the body turns about all three directions; within 0.1 s it all but turns about one axis.
    reach: metres from the point to the body's origin.
    """
    if not (reach > 0 and seconds >= 0.2):
        raise OptionError(f"reach is {reach} m (must be positive), seconds is {seconds} (at least 0.2)")
    path = RigidPath("ball", quat_exp(np.array([0.2, -0.4, 0.3])), np.array([0.0, 1.0, 0.0]))
    pivot = path.position + reach * np.array([0.48, 0.8, -0.36])
    a, b = 6.0 * np.array([0.36, 0.48, 0.8]), 6.0 * np.array([0.8, -0.6, 0.0])
    n = frame_count(seconds, rate)
    t = np.arange(1, n + 1)[:, None] / rate
    path.rest(frame_count(0.4, rate))
    path.swivel(pivot, quat_mul(quat_exp(t * a), quat_exp(t * b)))
    path.rest(frame_count(0.4, rate))
    return make_scene("ball", rate, [path], {"ball": box_markers((0.08, 0.06, 0.07))})


def rolling_foot(rate: float = 100.0, steps: int = 3, speed: float = 2.4) -> Scene:
    """One foot, "foot", that walks along z: swing, heel rocker (line), stand (space), toe roll (line), and so on.

    The foot is rigid, 0.26 m from heel to the ball of the toes, origin at its centre, 4 cm above the sole. It turns
    at 4 rad/s about the heel for 0.10 to 0.14 s and about the ball of the toes for 0.20 to 0.24 s, stands 0.36 to
    0.46 s and swings 0.4 s, centre forward at `speed` (m/s) from the first to the last frame of a swing. Truth is
    silent in swings: there the foot's instantaneous axis is more than 0.4 m away from it. The clip begins and ends
    with a swing.
    """
    if steps < 1 or not speed > 0:
        raise OptionError(f"steps is {steps} (at least 1), speed is {speed} m/s (must be positive)")
    heel, stand, toe = (0.12, 0.14, 0.10), (0.40, 0.36, 0.46), (0.22, 0.24, 0.20)
    swing = frame_count(0.4, rate)
    before = frame_count(toe[-1], rate)
    path = RigidPath("foot", quat_exp(PIVOT_SPEED * before / rate * ACROSS), np.zeros(3))
    path = RigidPath("foot", path.rotation, -quat_rotate(path.rotation, TOE))  # toes on the ground, about to leave it
    for k in range(steps + 1):
        rocker = frame_count(heel[k % 3], rate)
        down = -PIVOT_SPEED * rocker / rate
        landing = path.position + speed * swing / rate * np.array([0.0, 0.0, 1.0])
        landing[1] = -quat_rotate(quat_exp(down * ACROSS), HEEL)[1]
        _swing(path, landing, down, swing)
        if k == steps:
            break
        path.turn(path.position + quat_rotate(path.rotation, HEEL), ACROSS, -down, rocker)
        path.rest(frame_count(stand[k % 3], rate))
        rise = frame_count(toe[k % 3], rate)
        path.turn(path.position + TOE, ACROSS, PIVOT_SPEED * rise / rate, rise)
    return make_scene("foot", rate, [path], {"foot": box_markers((0.04, 0.04, 0.13))})


def _swing(path: RigidPath, landing: np.ndarray, pitch: float, frames: int, lift: float = 0.06) -> None:
    """Fly from here to the centre `landing` and the `pitch` (rad, about x) in a parabola `lift` metres high."""
    start = 2 * np.arctan2(path.rotation[1], path.rotation[0])
    s = np.arange(1, frames + 1)[:, None] / frames
    position = path.position + s * (landing - path.position) + 4 * lift * s * (1 - s) * UP
    path.move(quat_exp((start + s * (pitch - start)) * ACROSS), position)
