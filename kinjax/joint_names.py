"""Which body part a joint is, by its name: the spellings of the usual exporters, and the roles that follow from them.

In: names of joints or objects, and their place in the tree where it is known. Out: `roles` ("left_foot", "right_hand", "head",
...), the joints that a wish such as "feet" or "*Toe*" chooses, and `find_body` for what needs a whole human body. Known
spellings: Mixamo, 3ds Max Biped, CMU's ASF and its conversions, SMPL, Blender, Poser and more; marker clusters are named by
their roles already.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import pairwise, takewhile
from types import MappingProxyType

from .errors import UnknownNameError
from .skeleton import Topology

# What a joint is called that carries a part, the surest names first: "leg" is the shank of who has a thigh, "shoulder"
# the upper arm of who has no other, the wrist is where the hand begins.
_NAMES = {
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip", "hipjoint", "leg"),
    "shank": ("lowleg", "lowerleg", "shin", "calf", "tibia", "shank", "knee", "kneejoint", "leg"),
    "foot": ("ankle", "anklejoint", "foot"),
    "upper arm": ("uparm", "upperarm", "humerus", "shldr", "arm", "shoulder", "shoulderjoint"),
    "forearm": ("forearm", "lowarm", "lowerarm", "radius", "ulna", "elbow", "elbowjoint"),
    "hand": ("wrist", "wristjoint", "hand"),
}
_NECK = ("neck", "lowerneck", "upperneck", "necklower", "neckbase", "neckupper")
_HEAD = ("head", "skull")
_SIDES = {"left": "left", "l": "left", "lft": "left", "right": "right", "r": "right", "rgt": "right"}
_NOISE = {
    "bip",
    "biped",
    "jnt",
    "jt",
    "fk",
    "ik",
    "bn",
    "bone",
    "def",
    "org",
    "mixamorig",
    "avg",
    "base",
    "cc",
    "rl",
    "m",
    "f",
    "b",
    "c",
    "j",
}
# Roles that no part of the mass table needs.
_MORE = {"toe": ("toe", "toes", "toebase", "toejoint", "ball", "balljoint", "forefoot")}
_KNOWN = {w for table in (_NAMES, _MORE) for ws in table.values() for w in ws}
_PELVIS = ("hips", "pelvis", "hip", "root")

GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "feet": ("left_foot", "right_foot"),
        "toes": ("left_toe", "right_toe"),
        "hands": ("left_hand", "right_hand"),
        "shanks": ("left_shank", "right_shank"),
        "thighs": ("left_thigh", "right_thigh"),
        "forearms": ("left_forearm", "right_forearm"),
        "upper_arms": ("left_upper_arm", "right_upper_arm"),
    }
)
"""Roles that are asked for together; "all" is every joint."""

_ROLES = frozenset(r for group in GROUPS.values() for r in group) | {"head", "neck", "pelvis"}

_Side = dict[str, int]


@lru_cache(maxsize=1024)
def roles(names: tuple[str, ...]) -> Mapping[str, int]:
    """Index of the joint that has each role, as far as the names tell.

    Roles: left_ and right_ of foot, toe, hand, thigh, shank, upper_arm, forearm; head, neck, pelvis. Where the file tells
    ankle and foot apart the ankle carries the foot, and the wrist the hand.
    """
    words = words_of(names)
    found: dict[str, int] = {}
    for side in ("left", "right"):
        parts = _side(words, side) | {k: v for k, v in _first(words, side, _MORE).items()}
        found |= {f"{side}_{part.replace(' ', '_')}": j for part, j in parts.items()}
    found |= _first(words, "", {"head": _HEAD, "neck": _NECK, "pelvis": _PELVIS})
    return MappingProxyType(found)


def role_of(names: tuple[str, ...], joint: int) -> str | None:
    """The role of a joint, if its name tells one."""
    return next((role for role, j in roles(names).items() if j == joint), None)


def choose(names: tuple[str, ...], wanted: Sequence[str], where: str = "") -> tuple[int, ...]:
    """The joints that `wanted` means, in the skeleton's order.

    Each wish, in any case, is a joint's name; a role, or a group of `GROUPS`; a pattern with * or ?; or "all". A foot that
    only has a toe joint is that. Raises `UnknownNameError` where a name that is no role is not among the joints, or where
    nothing at all is chosen.
    """
    known, folded = roles(names), [n.casefold() for n in names]
    chosen: set[int] = set()
    for wish in wanted:
        w = wish.strip().casefold()
        if w == "all":
            return tuple(range(len(names)))
        if w in folded:
            chosen |= {j for j, n in enumerate(folded) if n == w}
        elif w in GROUPS or w in _ROLES:
            for role in GROUPS.get(w, (w,)):
                j = known.get(role, known.get(role.replace("foot", "toe")))
                chosen |= set() if j is None else {j}
        elif any(c in w for c in "*?["):
            chosen |= {j for j, n in enumerate(folded) if fnmatchcase(n, w)}
        else:
            raise UnknownNameError(wish, names, "joint or role", where)
    if not chosen:
        raise UnknownNameError(" ".join(wanted), names, "joint or role", where)
    return tuple(sorted(chosen))


@lru_cache(maxsize=64)
def words_of(names: tuple[str, ...]) -> list[tuple[str, str]]:
    """Side ("left", "right" or "") and what is left of each name, in small letters without numbers and decoration."""
    names = tuple(n.split(":")[-1] for n in names)
    shared = _shared(names)
    out = []
    for name in names:
        words = [w for w in _split(name[shared:]) if w not in _NOISE]
        side = next((_SIDES[w] for w in words if w in _SIDES), "")
        key = "".join(w for w in words if w not in _SIDES)
        if not side:  # in one word: lfemur, rightfoot
            for mark in ("left", "right", "l", "r"):
                if key.startswith(mark) and key[len(mark) :] in _KNOWN:
                    side, key = _SIDES[mark], key[len(mark) :]
                    break
        out.append((side, key))
    return out


def _split(name: str) -> list[str]:
    return [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _shared(names: tuple[str, ...]) -> int:
    """How much stands before all names and tells nothing, such as "Bob_"; what tells a side or a part is no decoration."""
    if len(names) < 2:
        return 0
    same = "".join(c for c, _ in takewhile(lambda x: x[0] == x[1], zip(min(names), max(names), strict=False)))
    end = 0
    for some in re.finditer(r"[^\W_]*[\W_]+", same):
        if any(w in _SIDES or w in _KNOWN for w in _split(some[0])):
            break
        end = some.end()
    return end


def _first(words: Sequence[tuple[str, str]], side: str, table: Mapping[str, Sequence[str]]) -> _Side:
    """For each part the joint of a side with the surest of its names."""
    found: _Side = {}
    for part, names in table.items():
        hits = [(names.index(key), j) for j, (s, key) in enumerate(words) if s == side and key in names]
        if hits:
            found[part] = min(hits)[1]
    return found


def _side(words: Sequence[tuple[str, str]], side: str) -> _Side:
    """The limbs of one side."""
    found = _first(words, side, _NAMES)
    hand = next((j for j, w in enumerate(words) if w == (side, "hand")), None)
    if hand is not None and "forearm" in found and words[found["forearm"]][1] == "radius":
        found["hand"] = hand  # in ASF files the bone called wrist is the far half of the forearm
    return found


def find_body(top: Topology) -> dict[str, _Side] | None:
    """Where each part begins: {"left": {...}, "right": {...}, "middle": pelvis, neck, head}; None if it is no body."""
    parents = top.parents
    words = words_of(top.names)
    body: dict[str, _Side] = {}
    for side in ("left", "right"):
        found = _side(words, side)
        if not {"thigh", "shank", "upper arm", "forearm"} <= set(found):
            return None
        for chain in (("thigh", "shank", "foot"), ("upper arm", "forearm", "hand")):
            for a, b in pairwise(chain):
                if b not in found:
                    continue
                if found[a] == found[b] or not path_between(parents, found[a], found[b]):
                    if b in ("shank", "forearm"):
                        return None
                    del found[b]
        body[side] = found
    pelvis = nearest_common(parents, body["left"]["thigh"], body["right"]["thigh"])
    if pelvis < 0:
        return None
    middle = {"pelvis": pelvis}
    for part, names in (("neck", _NECK), ("head", _HEAD)):
        below = [j for j, (s, key) in enumerate(words) if not s and key in names and path_between(parents, pelvis, j)]
        if below:
            middle[part] = below[0]
    if len(middle) == 1:
        return None
    if len(middle) == 3 and not path_between(parents, middle["neck"], middle["head"]):
        del middle["neck"]
    return body | {"middle": middle}


def path_between(parents: tuple[int, ...], top: int, bottom: int) -> list[int]:
    """Joints from `top` down to `bottom`, both included; empty if `bottom` is not below `top`."""
    path = [bottom]
    while path[-1] > top:
        path.append(parents[path[-1]])
    return path[::-1] if path[-1] == top else []


def nearest_common(parents: tuple[int, ...], a: int, b: int) -> int:
    """The nearest joint above both; -1 if they belong to different trees."""
    while a != b:
        a, b = (parents[a], b) if a > b else (a, parents[b])
    return a
