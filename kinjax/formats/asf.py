"""The skeleton of Acclaim motion: `read_asf` makes one of an ASF file, with what an AMC file needs besides.

In: a path. Out: an `AsfSkeleton`: a `Skeleton` whose first joint is `root`, and each further one a bone, with the bone's
name, at the bone's start, as conversions of CMU's data to BVH have it. All frames are the world's at rest, so that the
offset of a child is its parent bone's length times direction, and a bone without children has an End Site at its end.

The convention (Acclaim, column vectors): a bone with the axes C, degrees of freedom R and t, and its parent's end at b, has
the transform `T(b) C T(t) R C^-1` relative to its parent. The first listed degree of freedom turns first, about fixed axes:
`rx ry rz` is `R = Rz Ry Rx`, and C likewise goes by the letters behind `axis`, its three angles being about x, y and z.
The root's position and orientation are a transform in front of all motion.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import get_args

import jax
import numpy as np

from ..errors import OptionError
from ..skeleton import Axis, Skeleton, Topology
from .asf_keywords import ROTATIONS, TRANSLATIONS, Bone, Sections
from .asf_sections import read_sections
from .asf_text import decoded
from .bvh_header import MAX_DEPTH, shown
from .bvh_units import rest_extent, scale_of, unit_note
from .euler import euler_to_quaternion
from .files import read_bytes

_BIGGEST = 1 << 20  # bytes; a skeleton has some thousand
_UNIT_LENGTH = 1e-3  # how far a direction's length may be from 1, before it is normalised


@dataclass(frozen=True)
class Node:
    """What an AMC file says of a joint: `key` begins its line, `dof` are its numbers, as in the ASF but in small letters.
    `axes`: quaternion `wxyz` of C; of the root, of the orientation that stands in front of its motion."""

    key: bytes
    dof: tuple[str, ...]
    axes: tuple[float, float, float, float]


@dataclass(frozen=True)
class Reading:
    """How the numbers of an AMC file become motion: the nodes in the order of the joints, metres in one file unit, the ASF's
    angle unit; the file's name, and what is said about it in `Motion.notes`."""

    nodes: tuple[Node, ...]
    scale: float
    degrees: bool
    name: str
    notes: tuple[str, ...]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AsfSkeleton(Skeleton):
    """A `Skeleton` that knows what an AMC file's numbers mean; `plain` is it without that, as motions carry it."""

    reading: Reading = field(kw_only=True, metadata={"static": True})

    def plain(self) -> Skeleton:
        """The same measures and topology as a `Skeleton`."""
        given = (getattr(self, f.name) for f in fields(Skeleton))
        return Skeleton(*given)


def read_asf(path: str | Path, up: Axis = "y", *, unit: str | float = "asf") -> AsfSkeleton:
    """Read the skeleton of an ASF file.

    up: the file's up axis ("x", "y", "z"); it is kept, nothing is turned.
    unit: "asf" goes by the file's `:units`: lengths are inches multiplied by `length`, as CMU documents, so that one file unit
    is 0.0254 / length metres (0.0564 with CMU's 0.45). Or a unit as `read_bvh` takes it, for files that mean another.
    Returns an `AsfSkeleton`: offsets (joints, 3) and end_offsets (ends, 3) in metres, the root's offset its position; three
    rotation channels a joint and positions where the ASF has them. masses and mass_centers where every bone has `bodymass`
    and `cofmass`. limits are None: the file's are bounds of single angles, which is not what `Skeleton.limits` are.
    Raises `FileFormatError` with file, line, column, what was found and the remedy.
    """
    return parse_asf(read_bytes(path, _BIGGEST), up, unit=unit, path=path)


def parse_asf(raw: bytes, up: Axis = "y", *, unit: str | float = "asf", path: str | Path | None = None) -> AsfSkeleton:
    """As `read_asf`, from the bytes of a file; `path` is used in messages."""
    if up not in get_args(Axis):
        raise OptionError(f"up is {up!r}: choose from {', '.join(get_args(Axis))}")
    given = None if unit == "asf" else scale_of(unit)
    file = read_sections(raw, path)
    bones, parents = _ordered(file)
    names, about_names = decoded([b.name for b in bones])
    if given is None:
        scale, unit_text = _scale(file.length)
    else:
        scale, unit_text = given[0], unit_note(*given, "given")
    ends = [_end(file, b) for b in bones]
    leaves = sorted(set(range(1, len(bones))).difference(parents))
    with np.errstate(over="ignore"):
        offsets = np.array([ends[0], *(ends[p] if p else (0.0, 0.0, 0.0) for p in parents[1:])]) * scale
        end_offsets = np.array([ends[j] for j in leaves]).reshape(-1, 3) * scale
    if not (np.isfinite(offsets).all() and np.isfinite(end_offsets).all()):
        raise OptionError(f"with a unit of {scale:g} m the skeleton has no finite size")
    topology = Topology(
        names=tuple(names),
        parents=tuple(parents),
        channels=tuple(_channels(b, j == 0) for j, b in enumerate(bones)),
        translated=tuple(j for j, b in enumerate(bones) if j == 0 or set(b.dof) & set(TRANSLATIONS)),
        end_parents=tuple(leaves),
        end_names=("",) * len(leaves),
        up=up,
    )
    masses, centers, about_masses = _masses(bones, ends, scale)
    notes = [unit_text, *file.notes, *about_names, *about_masses, *_notes(bones, names)]
    tall = rest_extent(offsets, parents, end_offsets, leaves)
    if not 0.5 <= tall <= 3:
        notes.append(
            f"the skeleton is {tall:.3g} m tall at rest, which no person is: give unit= if another unit is meant"
        )
    nodes = tuple(Node(b.name, b.dof, _axes(file, b)) for b in bones)
    name = "the skeleton" if path is None else Path(path).name
    reading = Reading(nodes, scale, file.degrees, name, tuple(notes))
    return AsfSkeleton(offsets, end_offsets, topology, masses=masses, mass_centers=centers, reading=reading)


def _ordered(file: Sections) -> tuple[list[Bone], list[int]]:
    """The bones, each after its parent and followed by its descendants, and their parents (-1 of the root)."""
    known: dict[bytes, Bone] = {}
    for bone in file.bones:
        if bone.name in known:
            file.fail(bone.at, f"a second bone {shown(bone.name)}", "rename one of them, in the AMC too")
        known[bone.name] = bone
    children: dict[bytes, list[bytes]] = {name: [] for name in known}
    parent_of: dict[bytes, bytes] = {}
    for parent, child in file.links:
        for word in (parent, child):
            if word.group() not in known:
                near = difflib.get_close_matches(shown(word.group())[1:-1], decoded(list(known))[0], n=3)
                hint = f"nearest: {', '.join(near)}" if near else "add it there, or delete it here"
                file.fail(word.start(), f"there is no bone {shown(word.group())} in :bonedata", hint)
        if child.group() == b"root":
            file.fail(child.start(), "the root is a child of a bone", "it has no parent: delete it here")
        if child.group() in parent_of:
            found = (
                f"{shown(child.group())} has two parents, {shown(parent_of[child.group()])} and {shown(parent.group())}"
            )
            file.fail(child.start(), found, "keep one of them")
        parent_of[child.group()] = parent.group()
        children[parent.group()].append(child.group())
    order: list[bytes] = []
    stack = [(b"root", 1)]
    while stack:
        name, depth = stack.pop()
        if depth > MAX_DEPTH:
            file.fail(
                known[name].at, f"bones are nested more than {MAX_DEPTH} deep", "no skeleton is: check the hierarchy"
            )
        order.append(name)
        stack += [(child, depth + 1) for child in reversed(children[name])]
    if len(order) < len(known):
        reached = set(order)
        lost = next(b for b in file.bones if b.name not in reached)
        found = f"no chain of parents leads from {shown(lost.name)} to the root"
        file.fail(lost.at, found, "name its parent in :hierarchy, and see that no bone is above itself")
    place = {name: j for j, name in enumerate(order)}
    return [known[name] for name in order], [-1, *(place[parent_of[name]] for name in order[1:])]


def _end(file: Sections, bone: Bone) -> tuple[float, float, float]:
    """From a bone's start to its end in file units; the root's position."""
    if bone is file.bones[0]:
        return bone.direction
    x, y, z = bone.direction
    size = float(np.linalg.norm(bone.direction))
    if bone.length and not size > 1e-9:
        file.fail(bone.at, f"{shown(bone.name)} has a length of {bone.length:g} and no direction", "give it one")
    if abs(size - 1) > _UNIT_LENGTH and bone.length:
        file.notes.append(f"the direction of {shown(bone.name)} has a length of {size:.4g}: it was normalised")
        x, y, z = x / size, y / size, z / size
    return x * bone.length, y * bone.length, z * bone.length


def _channels(bone: Bone, root: bool) -> tuple[str, ...]:
    """Channels of a BVH file: `R = Rz Ry Rx` is written Z Y X. All three turns, for a joint that does not turn now may later."""
    turns = [d[1] for d in bone.dof if d in ROTATIONS]
    order = turns if len(turns) == 3 else bone.order
    moves = ("Xposition", "Yposition", "Zposition") if root or set(bone.dof) & set(TRANSLATIONS) else ()
    return (*moves, *(f"{axis.upper()}rotation" for axis in reversed(order)))


def _axes(file: Sections, bone: Bone) -> tuple[float, float, float, float]:
    angles = [bone.axis["xyz".index(axis)] for axis in bone.order[::-1]]
    turn = 1.0 if file.degrees else 180.0 / np.pi
    w, x, y, z = euler_to_quaternion(np.array(angles) * turn, bone.order[::-1]).tolist()
    return w, x, y, z


def _scale(length: float) -> tuple[float, str]:
    scale = 0.0254 / length
    name = scale_of(scale)[1]
    return scale, unit_note(scale, "inch / length" if name == "given" else name, f"from 'length {length:g}' in the ASF")


def _masses(
    bones: list[Bone], ends: list[tuple[float, float, float]], scale: float
) -> tuple[np.ndarray | None, np.ndarray | None, list[str]]:
    """Masses (joints,) and their centres (joints, 3), metres, where every bone has them; and a note where only some have."""
    mass = [b.mass for b in bones[1:] if b.mass is not None]
    center = [b.center for b in bones[1:] if b.center is not None]
    notes, masses, centers = [], None, None
    if mass and len(mass) == len(bones) - 1 and sum(mass) > 0:
        masses = np.array([0.0, *mass])
    elif mass:
        notes.append("bodymass does not stand at every bone, or is zero: it is not used")
    lengths = [b.length for b in bones[1:]]
    if masses is not None and len(center) == len(lengths) and all(np.less_equal(center, lengths)):
        shares = [0.0, *(c / length if length else 0.0 for c, length in zip(center, lengths, strict=True))]
        centers = np.array(ends) * np.array(shares)[:, None] * scale
    elif center:
        notes.append(
            "cofmass does not stand at every bone with a bodymass, or lies beyond a bone's end: it is not used"
        )
    return masses, centers, notes


def _notes(bones: list[Bone], names: list[str]) -> list[str]:
    """What a reader of the motion should know of the skeleton's file."""
    notes = []
    root = bones[0]
    if any(b.limits for b in bones):
        notes.append("the skeleton's joint limits are not used: they bound single angles about the bones' axes")
    if any(root.axis) or any(root.direction):
        notes.append(
            "the root's position and orientation in the ASF stand in front of all motion: it is moved and turned by them"
        )
    pairs = list(zip(names, bones, strict=True))
    other = [
        n
        for n, b in pairs[1:]
        if [d for d in b.dof if d in ROTATIONS] != [f"r{a}" for a in b.order if f"r{a}" in b.dof]
    ]
    if other:
        notes.append(
            f"the turns follow the order of dof, not the letters behind axis, in {', '.join(map(repr, other[:8]))}"
        )
    turned = [n for n, b in pairs if b.order != "xyz" and any(b.axis)]
    if turned:
        notes.append(
            f"the angles of axis are taken as about x, y, z, whatever its letters, in {', '.join(map(repr, turned[:8]))}"
        )
    return notes
