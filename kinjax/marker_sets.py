"""Which markers make which body part: the labels of the usual marker sets, as one table of names.

In: the labels of a recording. Out: for each body part the labels that are on it. The sets are Plug-in Gait and the Vicon
full body set, Helen Hayes, Cleveland Clinic, CAST with its four-marker clusters, Rizzoli's foot, and the sets of animation
studios. Names only: what is seen, and whether it is rigid, is the reader's to judge.

A label is compared without case, blanks, dots, hyphens and underscores, without the subject before its last colon
("Anna:LHEE"), and, where nothing else matches, without what follows a separator ("LHEE_raw"). The side may stand before or
after the name, as a letter or a word. Of several markers with one label the first counts: programs append joint centres
under the names of markers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

_HEEL = "hee heel heelback calcaneus fcc ca"
_TOE = "toe toe2 mt2 2mt met2 fm2 smh"
_ANKLE = "ank ankle anklelat anklelateral lateralankle ankleout fal latmal lateralmalleolus"
_ANKLE_IN = "ankmed anklemed anklemedial medialankle tam medmal medialmalleolus"
_FOOT_OUT = "mt5 5mt met5 fm5 vmh toe5 forefootout toeout"
_FOOT_IN = "mt1 1mt met1 fm1 fmh toe1 forefootin toein"
_KNEE = "kne knee kneelat kneelateral lateralknee kneeout fle"
_KNEE_IN = "kneemed kneemedial medialknee kneein fme"
_ELBOW = "elb elbow elbowlat elbowlateral elbowout"
_ELBOW_IN = "elbmed elbowmed elbowmedial elbowin"
_WRIST_IN = "wra rs radialstyloid radialwrist wristin wristradius"
_WRIST_OUT = "wrb us ulnarstyloid ulnarwrist wristout wristulna"
_HAND = "fin finger hand handout hm2"
_FRONT, _BACK = "asi asis ias fwt waist%front", "psi psis ips bwt waist%back"
_SACRUM = "=sacr =sac =vsac =vsacral =sacrum =sacral"
_C7, _T10 = "=c7 =cv7", "=t10 =tv10"
_JUGULAR, _XIPHOID = "=clav =clavicle =ij =sjn =incisura", "=strn =ster =sternum =px =sxs =xiphoid"


def _numbered(*stems: str) -> tuple[str, ...]:
    """The slots of a four-marker cluster."""
    return tuple(" ".join(f"{stem}{n}" for stem in stems) for n in (1, 2, 3, 4))


def _sides(*names: str) -> tuple[str, ...]:
    """Both sides of slots on a body part in the middle: L and R written before each name of a slot."""
    return tuple(" ".join(f"{side}|{name}" for name in slot.split()) for slot in names for side in "lr")


_LIMBS: dict[str, tuple[tuple[str, ...], ...]] = {
    "foot": (
        (_HEEL, _TOE, _ANKLE),
        (_HEEL, _TOE, _ANKLE, _FOOT_OUT, _FOOT_IN, _ANKLE_IN, "toetip"),
    ),
    "shank": (
        _numbered("sk", "shank", "sha", "shk", "tib", "shankcluster"),
        ("shankupper", "shankfront", "shankrear"),
        (_KNEE, "tib sha shank shn shin", _ANKLE, "tiap", "tiad", "ttc tibialtuberosity", "fax"),
        (_KNEE, _KNEE_IN, "tib sha shank shn shin", _ANKLE, _ANKLE_IN, "ttc tibialtuberosity", "fax"),
    ),
    "thigh": (
        _numbered("th", "thi", "thigh", "thighcluster"),
        ("thighupper", "thighfront", "thighrear"),
        ("thi thigh", _KNEE, "thap", "thad", "ftc gtr troc greatertrochanter", _KNEE_IN),
    ),
    "hand": (
        (_WRIST_IN, _WRIST_OUT, _HAND),
        (_WRIST_IN, _WRIST_OUT, _HAND, "thm thmb thumb thu", "handin", "hm5"),
    ),
    "forearm": (
        _numbered("fa", "frm", "forearm", "forearmcluster"),
        (_ELBOW, "frm forearm", _WRIST_IN, _WRIST_OUT),
        (_ELBOW, _ELBOW_IN, "frm forearm", _WRIST_IN, _WRIST_OUT),
    ),
    "upper_arm": (
        _numbered("ua", "upa", "upperarm", "upperarmcluster"),
        ("sho shoulder shouldertop", "upa upperarm uarmhigh arm", _ELBOW),
        ("sho shoulder shouldertop", "upa upperarm uarmhigh arm", _ELBOW, _ELBOW_IN),
    ),
}
_MIDDLE: dict[str, tuple[tuple[str, ...], ...]] = {
    "head": (
        _sides("fhd", "bhd"),
        (
            *_sides("fhd", "bhd", "head"),
            "=headtop =tophead =topofhead =ariel",
            "=headfront =fronthead =frontofhead",
            "=headback =rearhead =headrear =backofhead",
            "=headside",
        ),
    ),
    "pelvis": ((*_sides(_FRONT, _BACK), _SACRUM),),
    "thorax": (
        (_C7, _T10, _JUGULAR, _XIPHOID),
        (_C7, _T10, _JUGULAR, _XIPHOID, "=t8 =tv8", "=t2 =tv2", *_sides("cla")),
        ("=chest", "=spinetop =backtop", *_sides("back")),
    ),
}
# For each body part its sets, the best first; a set is a row of slots, a slot the names of one place on the body:
# "=c7" in the middle, "l|fhd" on that side, "fhd" on the side of the limb; % is where the side stands inside a name.

_SIDES = {"l": "left", "r": "right"}
OBJECTS = (
    *(f"{side}_{part}" for part in ("foot", "hand") for side in _SIDES.values()),
    *_MIDDLE,
    *(f"{side}_{part}" for part in _LIMBS if part not in ("foot", "hand") for side in _SIDES.values()),
)
"""The body parts that labels are looked through for, in the order in which they are returned."""

ENOUGH = 3
"""Markers that a rigid object needs."""


def split_label(label: str) -> tuple[str, str]:
    """The subject and the marker of a label: ("Anna", "LHEE") of "Anna:LHEE", ("", "LHEE") of "LHEE"."""
    subject, _, marker = label.rpartition(":")
    return subject.strip(), marker.strip()


def body_parts(labels: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """The markers of each body part, as indices into `labels`, in the order of `OBJECTS`.

    The first set of a part counts of which `ENOUGH` labels are there; of a part that has none, the set with the most, so that
    the caller can say what is missing. Parts without a single label are left out. With several subjects that have parts, the
    parts are named "subject:part"; with one, "part".
    """
    subjects: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        subjects.setdefault(split_label(label)[0], []).append(i)
    found = {s: _of_subject({i: split_label(labels[i])[1] for i in at}) for s, at in subjects.items()}
    found = {s: parts for s, parts in found.items() if any(len(x) >= ENOUGH for x in parts.values())} or found
    several = sum(bool(parts) for parts in found.values()) > 1
    return {f"{s}:{part}" if several and s else part: at for s, parts in found.items() for part, at in parts.items()}


def _of_subject(markers: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """`body_parts` of one subject, by index."""
    whole: dict[str, int] = {}
    cut: dict[str, int] = {}
    for i, marker in markers.items():
        whole.setdefault(_plain(marker), i)
        for end in re.finditer(r"[ ._\-]", marker.strip()):
            cut.setdefault(_plain(marker[: end.start()]), i)
    out = {}
    for part in OBJECTS:
        side, _, limb = part.partition("_")
        sets = _MIDDLE.get(part) or _LIMBS[limb]
        rows = [_row(slots, side[0], whole, cut) for slots in sets]
        best = next((row for row in rows if len(row) >= ENOUGH), max(rows, key=len))
        if best:
            out[part] = best
    return out


def _row(slots: Sequence[str], side: str, whole: Mapping[str, int], cut: Mapping[str, int]) -> tuple[int, ...]:
    """The markers that fill the slots of one set, each once, in the order of the slots."""
    out: list[int] = []
    for slot in slots:
        keys = [k for name in slot.split() for k in _spellings(name, side)]
        at = next((whole[k] for k in keys if k in whole), next((cut[k] for k in keys if k in cut), None))
        if at is not None and at not in out:
            out.append(at)
    return tuple(out)


def _spellings(name: str, side: str) -> tuple[str, ...]:
    """All ways to write one name of a slot."""
    if name.startswith("="):
        return (name[1:],)
    if "|" in name:
        side, name = name.split("|")
    ways = (side, _SIDES[side])
    if "%" in name:
        return tuple(name.replace("%", way) for way in ways)
    return (*(way + name for way in ways), *(name + way for way in ways))


def _plain(marker: str) -> str:
    """A marker's name for comparing."""
    return re.sub(r"[\s._\-]", "", marker).casefold()
