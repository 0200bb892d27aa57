"""Two dice that roll on a carpet: rest, rolls over an edge, spins on a corner (2006 paper, section 8.1).

In: rate, length, seed. Out: a `Scene` with space, line and point constraints on both. The dice are large and of foam:
an edge of 0.2 m keeps every pivot within 0.2 m of the centre, and rolls over an edge near `sqrt(g / edge)` = 7 rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import numpy as np

from ..errors import OptionError
from .scene import RigidPath, Scene, box_markers, frame_count, make_scene
from .spatial import quat_exp, quat_from_matrix, quat_inv, quat_mul, quat_rotate

UP = np.array([0.0, 1.0, 0.0])
_ENDS = np.array([0.0, 0.5 * np.pi])
_BULGE = 1.6  # how far a spin on a corner leans away from the plain roll over an edge
_RANGE = 3.0  # a die stays within so many of its own edges of where it began
_HOMES = ((-0.9, 0.0), (0.9, 0.1))
_PROGRAMMES = (  # seconds of rest before each move; the moves and their seconds; "edges": two quarter turns in one go
    (0.2, (("edge", 0.25), ("corner", 0.4))),
    (0.25, (("corner", 0.4), ("edges", 0.5))),
)


def rolling_dice(rate: float = 60.0, frames: int = 141, seed: int = 0, edge: float = 0.2) -> Scene:
    """Two dice, "die_a" and "die_b", on a carpet at y = 0: every frame of both is under a constraint.

    rate: frames a second. frames: length of the clip; the programme of spans repeats until it is filled, and ends in
    a rest. seed: directions and spins. edge: metres. Spans last 0.2 s or more; while moving the angular speed is
    constant, 6 to 9 rad/s. A spin on a corner turns about ever-changing axes and lands on another face. `die_b` also
    rolls over two opposite edges of one face in one go: two line constraints 0.2 m apart that share a frame.
    """
    if not edge > 0:
        raise OptionError(f"edge is {edge}: it must be positive (metres)")
    paths = []
    for k, (name, home, (pause, moves)) in enumerate(zip(("die_a", "die_b"), _HOMES, _PROGRAMMES, strict=True)):
        rng = np.random.default_rng([seed, k])
        centre = np.array([home[0] * edge / 0.2, 0.5 * edge, home[1] * edge / 0.2])
        path = RigidPath(name, quat_exp(rng.uniform(0, 2 * np.pi) * UP), centre)
        rest = frame_count(pause, rate)
        need = 2 * rest + frame_count(moves[0][1], rate) + 1
        if frames < need:
            raise OptionError(f"{frames} frames at {rate:g} fps hold no roll between two rests: at least {need} do")
        for kind, seconds in cycle(moves):
            n = frame_count(seconds, rate)
            if frames - 1 - path.end < rest + n + rest:
                path.rest(frames - 1 - path.end)
                break
            path.rest(rest)
            if kind == "corner":
                _spin(path, n, edge, centre, rng)
            else:
                _roll(path, n, 1 + (kind == "edges"), edge, centre, rng)
        paths.append(path)
    layout = box_markers((0.5 * edge,) * 3)
    return make_scene("dice", rate, paths, {p.name: layout for p in paths})


def _face(path: RigidPath, edge: float) -> np.ndarray:
    """Local coordinates (4, 3) of the corners on the carpet."""
    corners = box_markers((0.5 * edge,) * 3)
    return corners[np.argsort(quat_rotate(path.rotation, corners) @ UP)[:4]]


def _roll(path: RigidPath, frames: int, times: int, edge: float, home: np.ndarray, rng: np.random.Generator) -> None:
    """A quarter turn over an edge of the face below, `times` in the same direction, staying near home."""
    corners = quat_rotate(path.rotation, _face(path, edge))
    ways = [0.5 * (a + b) for i, a in enumerate(corners) for b in corners[:i] if np.linalg.norm(a - b) < 1.2 * edge]
    ways = [w - (w @ UP) * UP for w in ways]  # from the centre of the face to the middle of an edge
    good = [w for w in ways if np.linalg.norm(path.position + 2 * times * w - home) < _RANGE * edge]
    way = good[rng.integers(len(good))]
    ends = np.linspace(0, frames, times + 1).round().astype(int)
    for n in np.diff(ends):
        pivot = path.position + way - 0.5 * edge * UP
        path.turn(pivot, np.cross(UP, way), 0.5 * np.pi, int(n))


def _spin(path: RigidPath, frames: int, edge: float, home: np.ndarray, rng: np.random.Generator) -> None:
    """A spin on one corner, from the face below to a neighbouring one, never touching the carpet elsewhere.

    In the die's own axes, pointing from the corner along its three edges, the world's up is a unit vector with no
    negative component as long as the die is above the carpet. It travels from the present face's normal to the next
    one's as `(cos a, sin a, bulge sin 2a)`, normalised, `a` from 0 to a right angle, while the die also turns about
    the vertical, in the sense that makes the axes differ most. The path is covered at constant angular speed.
    """
    options, spin = [], rng.uniform(0.6, 1.0)
    first = int(np.argmax(np.abs(quat_rotate(quat_inv(path.rotation), UP))))
    for corner in _face(path, edge):
        pivot = path.position + quat_rotate(path.rotation, corner)
        for second in (i for i in range(3) if i != first):
            way = _Way(-np.sign(corner), (first, second, 3 - first - second), spin)
            landing = pivot + quat_rotate(way.turns(path.rotation, _ENDS)[1], path.position - pivot)
            if np.linalg.norm(landing - home) < _RANGE * edge:
                options.append((pivot, way))
    pivot, way = options[rng.integers(len(options))]
    path.swivel(pivot, way.turns(path.rotation, way.even(frames))[1:])


@dataclass(frozen=True)
class _Way:
    """How a die goes over a corner.

    inward (3,): signs of the die's axes that point away from the corner. order: the axis that is up first, the one that
    is up last, and the third. spin: turns about the vertical per radian of `a`, counted in the sense that helps.
    """

    inward: np.ndarray
    order: tuple[int, int, int]
    spin: float

    def pose(self, a: np.ndarray) -> np.ndarray:
        """Rotations (n, 4) of the die at `a` (n,), up to one heading for all."""
        up, rate = np.zeros((len(a), 3)), np.zeros((len(a), 3))
        up[:, self.order] = np.stack([np.cos(a), np.sin(a), _BULGE * np.sin(2 * a)], -1)
        rate[:, self.order] = np.stack([-np.sin(a), np.cos(a), 2 * _BULGE * np.cos(2 * a)], -1)
        up, rate = up * self.inward, rate * self.inward
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        rate -= up * np.sum(up * rate, -1, keepdims=True)
        rate /= np.linalg.norm(rate, axis=-1, keepdims=True)
        rows = np.stack([rate, up, np.cross(rate, up)], -2)  # body axes that become world x, y, z
        hand = -np.linalg.det(np.eye(3)[list(self.order)]) * self.inward.prod()
        return quat_mul(quat_exp(hand * self.spin * a[:, None] * UP), quat_from_matrix(rows))

    def turns(self, start: np.ndarray, a: np.ndarray) -> np.ndarray:
        """World rotations (n, 4) since `a[0]`, where the die's rotation is `start`."""
        q = self.pose(a)
        return quat_mul(quat_mul(quat_mul(start, quat_inv(q[0])), q), quat_inv(start))

    def even(self, frames: int) -> np.ndarray:
        """`frames + 1` values of `a` from 0 to a right angle, equal angles of rotation apart."""
        fine = np.linspace(0.0, 0.5 * np.pi, 2001)
        q = self.pose(fine)
        step = 2 * np.arcsin(np.linalg.norm(quat_mul(quat_inv(q[:-1]), q[1:])[:, 1:], axis=-1))
        length = np.concatenate([[0.0], np.cumsum(step)])
        a = np.interp(np.linspace(0, length[-1], frames + 1), length, fine)
        a[[0, -1]] = _ENDS
        return a
