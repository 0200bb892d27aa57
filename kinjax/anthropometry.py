"""Where a body's mass is: the share and the centre of each joint's part, from a published table and the joints' names.

In: a `Skeleton`. Out: `SegmentMasses`, and the leg length that balance is normalised by. The table is that of de Leva 1996,
*Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters*, J. Biomechanics 29(9), 1223-1230, table 4: young adults
whose mass was found by gamma-ray scanning, centres relative to joint centres. Joints are known by name (Mixamo, 3ds Max
Biped, CMU's ASF and its conversions, SMPL, Blender, Poser, ...) and by their place in the tree. A skeleton without these
names gets mass by bone length, and a note that says so. Host NumPy, float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from .errors import OptionError, ShapeError
from .joint_names import find_body, path_between, words_of
from .skeleton import Skeleton

# Mass of one (a fraction of the body's), and its centre from the proximal end (a fraction of its length). Head and trunk
# meet at the cervicale (table 4's alternative endpoints), where exporters put the neck joint; the hand reaches to the tip
# of the middle finger; the foot's fraction is taken from the ankle, for skeletons have no heel.
_LIMBS = {
    "male": {
        "head": (0.0694, 1 - 0.5002),
        "upper arm": (0.0271, 0.5772),
        "forearm": (0.0162, 0.4574),
        "hand": (0.0061, 0.3624),
        "thigh": (0.1416, 0.4095),
        "shank": (0.0433, 0.4395),
        "foot": (0.0137, 0.4415),
    },
    "female": {
        "head": (0.0668, 1 - 0.4841),
        "upper arm": (0.0255, 0.5754),
        "forearm": (0.0138, 0.4559),
        "hand": (0.0056, 0.3427),
        "thigh": (0.1478, 0.3612),
        "shank": (0.0481, 0.4352),
        "foot": (0.0129, 0.4014),
    },
}
# Lower, middle and upper trunk, from the middle of the hips to the cervicale: mass, length in metres, centre from below.
_TRUNK = {
    "male": ((0.1117, 0.1457, 1 - 0.6115), (0.1633, 0.2155, 1 - 0.4502), (0.1596, 0.2421, 1 - 0.5066)),
    "female": ((0.1247, 0.1815, 1 - 0.4920), (0.1465, 0.2053, 1 - 0.4512), (0.1545, 0.2280, 1 - 0.5050)),
}
# a joint, and a stretch of its part in its own frame
_Piece = tuple[int, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class SegmentMasses:
    """How a body's mass is spread over the joints of its skeleton.

    fractions: (J,) of the whole, summing to 1. centers: (J, 3) metres in each joint's own frame. source: "skeleton", the
    table, or "bone length". notes: what was assumed.
    """

    fractions: Float[np.ndarray, " joints"]
    centers: Float[np.ndarray, "joints 3"]
    source: str
    notes: tuple[str, ...] = ()


def segment_masses(skeleton: Skeleton, table: str = "male") -> SegmentMasses:
    """Mass fraction and centre of the part that each joint carries.

    table: "male" or "female" (de Leva 1996). What the skeleton itself carries (`masses`, `mass_centers`) comes first. A
    part that spreads over several joints (the trunk, a thigh with a twist joint) has its mass spread evenly over the
    longest stretch that lies in it and has the published centre in its middle; each joint carries the share that lies on
    its bone. Clavicles and the like, which lie inside the trunk, carry none. Without names: mass by bone length.
    """
    if table not in _LIMBS:
        raise OptionError(f"table={table!r}: choose male or female")
    joints = len(skeleton.names)
    given, centers = _own(skeleton)
    if given is not None:
        if centers is not None:
            return SegmentMasses(given, centers, "skeleton")
        between = skeleton.segment_centers().astype(float)
        return SegmentMasses(given, between, "skeleton", ("mass centres: half-way along each joint's bones",))
    body = find_body(skeleton.topology)
    notes: tuple[str, ...]
    if body is None:
        fractions, found = _by_bone_length(skeleton)
        source = "bone length"
        notes = ("the joints' names do not tell a human body: mass by bone length",)
    else:
        parts, notes = _parts(skeleton, body, table)
        mass, moment = np.zeros(joints), np.zeros((joints, 3))
        for pieces, stretches in parts:
            _spread(pieces, stretches, mass, moment)
        fractions = mass / mass.sum()
        carries = mass > 0
        found = np.where(
            carries[:, None], moment / np.where(carries, mass, 1)[:, None], skeleton.segment_centers().astype(float)
        )
        source = f"de Leva 1996, {table}"
    return SegmentMasses(fractions, found if centers is None else centers, source, notes)


def leg_length(skeleton: Skeleton) -> float:
    """Hip to ankle along the bones, metres, the mean of both legs; `OptionError` if the names tell no legs."""
    body = find_body(skeleton.topology)
    if body is None:
        raise OptionError("the joints' names do not tell the legs: give the leg length")
    both = []
    for side in body["left"], body["right"]:
        pieces = _bones(skeleton, side["thigh"], side.get("foot", side["shank"]))
        if "foot" not in side:  # no joint at the ankle: down to the shank's end
            pieces += _tip(skeleton, side["shank"])
        both.append(_length(pieces))
    return float(np.mean(both))


def _own(skeleton: Skeleton) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Fractions and centres that the skeleton carries, checked."""
    joints = len(skeleton.names)
    fractions = centers = None
    if skeleton.masses is not None:
        masses = np.asarray(skeleton.masses, float)
        if masses.shape != (joints,):
            raise ShapeError(f"masses have shape {masses.shape}: one for each of {joints} joints is needed")
        if not (np.isfinite(masses).all() and (masses >= 0).all() and masses.sum() > 0):
            raise OptionError("the skeleton's masses must be finite, none negative, and not all zero")
        fractions = masses / masses.sum()
    if skeleton.mass_centers is not None:
        centers = np.asarray(skeleton.mass_centers, float)
        if centers.shape != (joints, 3):
            raise ShapeError(f"mass_centers have shape {centers.shape}: ({joints}, 3) is needed")
        if not np.isfinite(centers).all():
            raise OptionError("the skeleton's mass centres must be finite")
    return fractions, centers


def _parts(
    skeleton: Skeleton, body: dict[str, dict[str, int]], table: str
) -> tuple[list[tuple[list[_Piece], list[tuple[float, float, float]]]], tuple[str, ...]]:
    """Each part as the bones that it lies on and its stretches (mass, from, to; fractions of its length), and notes."""
    limbs, trunk, middle = _LIMBS[table], _TRUNK[table], body["middle"]
    parts: list[tuple[list[_Piece], list[tuple[float, float, float]]]] = []
    notes: list[str] = []
    neck = middle.get("neck", middle.get("head", -1))
    total, below, stretches = sum(length for _, length, _ in trunk), 0.0, []
    for mass, length, center in trunk:
        low, high = _stretch(center)
        stretches.append((mass, (below + low * length) / total, (below + high * length) / total))
        below += length
    parts.append(([*_below_pelvis(skeleton, body), *_bones(skeleton, middle["pelvis"], neck)], stretches))
    skull = middle.get("head", neck)
    mass, center = limbs["head"]
    parts.append(([*_bones(skeleton, neck, skull), *_tip(skeleton, skull, central=True)], [(mass, *_stretch(center))]))
    for side in ("left", "right"):
        found = body[side]
        for chain in (("thigh", "shank", "foot"), ("upper arm", "forearm", "hand")):
            for k, part in enumerate(chain):
                mass, center = limbs[part]
                if part not in found:  # it hangs at the end of what is there
                    joint, _, end = _tip(skeleton, found[chain[k - 1]])[-1]
                    parts.append(([(joint, end, end)], [(mass, 0.0, 1.0)]))
                    notes.append(f"no {side} {part} among the joints: its mass is at the end of the {chain[k - 1]}")
                    continue
                after = chain[k + 1] if k < 2 else ""
                pieces = _bones(skeleton, found[part], found[after]) if after in found else _tip(skeleton, found[part])
                parts.append((pieces, [(mass, *_stretch(center))]))
    return parts, tuple(notes)


def _stretch(center: float) -> tuple[float, float]:
    """The longest stretch of 0..1 with its middle at `center`."""
    return max(0.0, 2 * center - 1), min(1.0, 2 * center)


def _spread(
    pieces: list[_Piece], stretches: list[tuple[float, float, float]], mass: np.ndarray, moment: np.ndarray
) -> None:
    """Add stretches of a part (mass, from, to) to the joints on whose pieces they lie; a part without length is a point."""
    lengths = np.array([np.linalg.norm(b - a) for _, a, b in pieces])
    total = lengths.sum()
    if total <= 0:
        joint, at, _ = pieces[0]
        share = sum(m for m, _, _ in stretches)
        mass[joint] += share
        moment[joint] += share * at
        return
    ends = np.cumsum(lengths) / total
    starts = np.r_[0.0, ends[:-1]]
    for m, low, high in stretches:
        for (joint, a, b), start, end in zip(pieces, starts, ends, strict=True):
            first, last = max(low, start), min(high, end)
            if last > first:
                share = m * (last - first) / (high - low)
                mass[joint] += share
                moment[joint] += share * (a + ((first + last) / 2 - start) / (end - start) * (b - a))


def _bones(skeleton: Skeleton, top: int, bottom: int) -> list[_Piece]:
    """The bones from joint `top` down to joint `bottom`."""
    path, offsets = path_between(skeleton.topology.parents, top, bottom), np.asarray(skeleton.offsets, float)
    return [(a, np.zeros(3), offsets[b]) for a, b in pairwise(path)]


def _below_pelvis(skeleton: Skeleton, body: dict[str, dict[str, int]]) -> list[_Piece]:
    """From the middle of the hips up to the joint that carries the pelvis, at rest; nothing where offsets do not tell."""
    pelvis, offsets = body["middle"]["pelvis"], np.asarray(skeleton.offsets, float)
    hips = [
        offsets[path_between(skeleton.topology.parents, pelvis, body[s]["thigh"])[1:]].sum(0) for s in ("left", "right")
    ]
    # bones all drawn along one axis, as some exporters do, have turned frames at rest: the two hips then coincide
    if np.linalg.norm(hips[0] - hips[1]) < 0.5 * np.linalg.norm(hips[0]):
        return []
    return [(pelvis, (hips[0] + hips[1]) / 2, np.zeros(3))]


def _tip(skeleton: Skeleton, joint: int, central: bool = False) -> list[_Piece]:
    """The bones from a joint to the farthest tip below it; central: not through what has a side (eyes), or between them."""
    top = skeleton.topology
    offsets, ends = np.asarray(skeleton.offsets, float), np.asarray(skeleton.end_offsets, float)
    words = words_of(top.names)
    children = top.children(joint)
    best: list[_Piece] = []
    for end in (ends[e] for e, p in enumerate(top.end_parents) if p == joint):
        best = max(best, [(joint, np.zeros(3), end)], key=_length)
    for c in children:
        if not (central and words[c][0]):
            best = max(best, [(joint, np.zeros(3), offsets[c]), *_tip(skeleton, c, central)], key=_length)
    if not best and central and children:
        best = [(joint, np.zeros(3), offsets[list(children)].mean(0))]
    return best or [(joint, np.zeros(3), np.zeros(3))]


def _length(pieces: list[_Piece]) -> float:
    return float(sum(np.linalg.norm(b - a) for _, a, b in pieces))


def _by_bone_length(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Mass in proportion to the length of a joint's bones (to children and End Sites), centre half-way along them."""
    top = skeleton.topology
    offsets, ends = np.asarray(skeleton.offsets, float), np.asarray(skeleton.end_offsets, float).reshape(-1, 3)
    length, moment = np.zeros(len(offsets)), np.zeros((len(offsets), 3))
    for p, bone in [*zip(top.parents, offsets, strict=True), *zip(top.end_parents, ends, strict=True)]:
        if p >= 0:
            size = np.linalg.norm(bone)
            length[p] += size
            moment[p] += size * bone / 2
    if not length.sum() > 0:
        return np.ones(len(offsets)) / max(len(offsets), 1), np.zeros((len(offsets), 3))
    return length / length.sum(), moment / np.where(length > 0, length, 1)[:, None]
