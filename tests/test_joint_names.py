"""Roles by the names of the usual exporters, and what a wish such as "feet" or "*Toe*" chooses."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinjax.errors import UnknownNameError
from kinjax.formats import read_bvh
from kinjax.joint_names import GROUPS, choose, role_of, roles
from kinjax.marker_sets import OBJECTS

LIMBS = ("thigh", "shank", "foot", "toe", "upper_arm", "forearm", "hand")
# Exporter: middle joints (pelvis, neck, head; "-" for none), the limbs of the left side in the order of LIMBS, and others. {L}
# and {Left} are the side.
EXPORTERS = {
    "cmu asf": (
        "root lowerneck head",
        "{l}femur {l}tibia {l}foot {l}toes {l}humerus {l}radius {l}hand",
        "{l}hipjoint lowerback upperback thorax upperneck {l}clavicle {l}wrist {l}fingers {l}thumb",
    ),
    "cmu in motionbuilder's names": (
        "Hips Neck Head",
        "{Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase {Left}Arm {Left}ForeArm {Left}Hand",
        "{L}HipJoint LowerBack Spine Spine1 Neck1 {Left}Shoulder {Left}FingerBase {Left}HandIndex1 {L}Thumb",
    ),
    "mixamo": (
        "mixamorig:Hips mixamorig:Neck mixamorig:Head",
        "mixamorig:{Left}UpLeg mixamorig:{Left}Leg mixamorig:{Left}Foot mixamorig:{Left}ToeBase mixamorig:{Left}Arm "
        "mixamorig:{Left}ForeArm mixamorig:{Left}Hand",
        "mixamorig:Spine mixamorig:Spine1 mixamorig:HeadTop_End mixamorig:{Left}Shoulder mixamorig:{Left}HandThumb1 "
        "mixamorig:{Left}Toe_End",
    ),
    "mixamo, numbered": (
        "mixamorig1:Hips mixamorig1:Neck mixamorig1:Head",
        "mixamorig1:{Left}UpLeg mixamorig1:{Left}Leg mixamorig1:{Left}Foot mixamorig1:{Left}ToeBase mixamorig1:{Left}Arm "
        "mixamorig1:{Left}ForeArm mixamorig1:{Left}Hand",
        "mixamorig1:Spine",
    ),
    "3ds max biped": (
        "Bip01|Pelvis Bip01|Neck Bip01|Head",
        "Bip01|{L}|Thigh Bip01|{L}|Calf Bip01|{L}|Foot Bip01|{L}|Toe0 Bip01|{L}|UpperArm Bip01|{L}|Forearm Bip01|{L}|Hand",
        "Bip01 Bip01|Spine Bip01|Footsteps Bip01|{L}|Clavicle Bip01|{L}|Finger0 Bip01|{L}|HorseLink",
    ),
    "3ds max biped, underscores": (
        "Bip001_Pelvis Bip001_Neck Bip001_Head",
        "Bip001_{L}_Thigh Bip001_{L}_Calf Bip001_{L}_Foot Bip001_{L}_Toe0 Bip001_{L}_UpperArm Bip001_{L}_Forearm Bip001_{L}_Hand",
        "Bip001_Spine Bip001_{L}_Clavicle",
    ),
    "smpl": (
        "Pelvis Neck Head",
        "{L}_Hip {L}_Knee {L}_Ankle - {L}_Shoulder {L}_Elbow {L}_Wrist",
        "Spine1 Spine2 Spine3 {L}_Foot {L}_Collar {L}_Hand",
    ),
    "smpl-x": (
        "pelvis neck head",
        "{left}_hip {left}_knee {left}_ankle - {left}_shoulder {left}_elbow {left}_wrist",
        "spine1 {left}_foot {left}_collar jaw {left}_eye_smplhf {left}_index1",
    ),
    "rigify": (
        "- neck head",
        "thigh.{L} shin.{L} foot.{L} toe.{L} upper_arm.{L} forearm.{L} hand.{L}",
        "spine spine.001 shoulder.{L} heel.02.{L} f_index.01.{L} palm.01.{L}",
    ),
    "rigify's deforming bones": (
        "- - -",
        "DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} DEF-toe.{L} DEF-upper_arm.{L} DEF-forearm.{L} DEF-hand.{L}",
        "DEF-spine DEF-spine.001 DEF-thigh.{L}.001 DEF-shin.{L}.001 DEF-upper_arm.{L}.001 DEF-f_index.01.{L}",
    ),
    "unreal": (
        "pelvis neck_01 head",
        "thigh_{l} calf_{l} foot_{l} ball_{l} upperarm_{l} lowerarm_{l} hand_{l}",
        "root spine_01 thigh_twist_01_{l} clavicle_{l} index_01_{l} ik_foot_{l} ik_hand_{l}",
    ),
    "unity": (
        "Hips Neck Head",
        "{Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toes {Left}UpperArm {Left}LowerArm {Left}Hand",
        "Spine Chest {Left}Shoulder {Left}ThumbProximal",
    ),
    "vrm": (
        "J_Bip_C_Hips J_Bip_C_Neck J_Bip_C_Head",
        "J_Bip_{L}_UpperLeg J_Bip_{L}_LowerLeg J_Bip_{L}_Foot J_Bip_{L}_ToeBase J_Bip_{L}_UpperArm J_Bip_{L}_LowerArm J_Bip_{L}_Hand",
        "J_Bip_C_Spine J_Bip_{L}_Shoulder J_Bip_{L}_Index1",
    ),
    "character creator": (
        "CC_Base_Pelvis - CC_Base_Head",
        "CC_Base_{L}_Thigh CC_Base_{L}_Calf CC_Base_{L}_Foot CC_Base_{L}_ToeBase CC_Base_{L}_Upperarm CC_Base_{L}_Forearm "
        "CC_Base_{L}_Hand",
        "CC_Base_Hip CC_Base_NeckTwist01 CC_Base_{L}_Clavicle CC_Base_{L}_ThighTwist01",
    ),
    "joints named by their places": (
        "Hips Neck Head",
        "{Left}Hip {Left}Knee {Left}Ankle {Left}Toe {Left}Shoulder {Left}Elbow {Left}Wrist",
        "Chest Chest2 {Left}Collar",
    ),
    "poser": (
        "hip neck head",
        "{l}Thigh {l}Shin {l}Foot {l}Toe {l}Shldr {l}ForeArm {l}Hand",
        "abdomen chest {l}Buttock {l}Collar {l}Thumb1 {left}Eye",
    ),
    "capitals": (
        "HIPS NECK HEAD",
        "{LEFT}_THIGH {LEFT}_SHIN {LEFT}_FOOT {LEFT}_TOE {LEFT}_UPPER_ARM {LEFT}_FOREARM {LEFT}_HAND",
        "SPINE",
    ),
    "a depth camera": (
        "- Neck Head",
        "Hip{Left} Knee{Left} Ankle{Left} - Shoulder{Left} Elbow{Left} Wrist{Left}",
        "SpineBase SpineMid Hand{Left} Foot{Left}",
    ),
    "of a person": (
        "Anna_B_Hips Anna_B_Neck Anna_B_Head",
        "Anna_B_{Left}UpLeg Anna_B_{Left}Leg Anna_B_{Left}Foot Anna_B_{Left}ToeBase Anna_B_{Left}Arm Anna_B_{Left}ForeArm "
        "Anna_B_{Left}Hand",
        "Anna_B_Spine",
    ),
}  # fmt: skip


def sided(text: str, side: str) -> list[str]:
    marks = {"left": side, "Left": side.title(), "LEFT": side.upper(), "l": side[0], "L": side[0].upper()}
    return [n.replace("|", " ") for n in text.format(**marks).split()]


def skeleton(exporter: str) -> tuple[tuple[str, ...], dict[str, str]]:
    """All names of an exporter, and the name of each role."""
    middle, limbs, others = EXPORTERS[exporter]
    expected = dict(zip(("pelvis", "neck", "head"), middle.split(), strict=True))
    names = list(expected.values())
    for side in ("left", "right"):
        one = dict(zip((f"{side}_{part}" for part in LIMBS), sided(limbs, side), strict=True))
        expected |= one
        names += [*one.values(), *sided(others, side)]
    return tuple(dict.fromkeys(n for n in names if n != "-")), {r: n for r, n in expected.items() if n != "-"}


def named(names: tuple[str, ...]) -> dict[str, str]:
    return {role: names[j] for role, j in roles(names).items()}


@pytest.mark.parametrize("exporter", EXPORTERS)
def test_the_roles_of_an_exporter(exporter):
    names, expected = skeleton(exporter)
    found = named(names)
    if expected.get("pelvis") is None:  # a joint called root may carry it
        found.pop("pelvis", None)
    assert found == expected
    for role, name in expected.items():
        assert role_of(names, names.index(name)) == role


@pytest.mark.parametrize("exporter", EXPORTERS)
def test_roles_do_not_depend_on_other_joints(exporter):
    """A BVH of which only the feet are read has the same feet, and so has one side alone."""
    _, expected = skeleton(exporter)
    wanted = [n for r, n in expected.items() if r.endswith(("foot", "hand"))]
    assert {expected[r] for r in roles(tuple(wanted))} == set(wanted)
    for side in ("left", "right"):
        few = tuple(n for r, n in expected.items() if r.startswith(side))
        assert named(few) == {r: n for r, n in expected.items() if r.startswith(side)}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("foot_L", "foot_R"), ["left_foot", "right_foot"]),
        (("left_foot", "left_hand"), ["left_foot", "left_hand"]),
        (("LeftFoot",), ["left_foot"]),
        (("Foot.L", "Foot.R", "Hand.L"), ["left_foot", "right_foot", "left_hand"]),
        (("l_ball", "r_ball"), ["left_toe", "right_toe"]),
        (("lefttoe", "righttoe"), ["left_toe", "right_toe"]),
        (("Anna:left_foot", "Ben:left_foot"), ["left_foot", None]),
        (("left-foot", "right-foot", "door"), ["left_foot", "right_foot", None]),
        (("die", "wheel"), [None, None]),
        (("lollipop", "rail", "lhasa"), [None, None, None]),
        (("Football", "Handle", "Headlight"), [None, None, None]),
        (("LeftFootIK_end", "LeftFingers"), [None, None]),
        (("",), [None]),
        (("12", "_", "ÄÖ:"), [None, None, None]),
        ((), []),
    ],
)
def test_few_names(names, expected):
    assert [role_of(names, j) for j in range(len(names))] == expected


def test_marker_clusters_are_named_by_their_roles():
    found = named(OBJECTS)
    assert all(role == name for role, name in found.items())
    assert set(OBJECTS) - set(found) == {"thorax"}


@given(st.lists(st.text(max_size=12), max_size=8, unique=True))
@settings(max_examples=200, deadline=None)
def test_any_names_at_all(names):
    found = roles(tuple(names))
    assert all(0 <= j < len(names) for j in found.values())
    assert roles(tuple(n.upper() for n in names)) is not None
    for n in names:
        if n.strip() == n and n:
            picked = choose(tuple(names), [n])
            assert picked and (n.casefold() == "all" or names.index(n) in picked or n.casefold() in GROUPS or n in found)


# choosing


def chosen(names, *wanted: str) -> list[str]:
    return [names[j] for j in choose(tuple(names), wanted)]


MIXAMO, _ = skeleton("mixamo")
CMU, _ = skeleton("cmu asf")


@pytest.mark.parametrize("exporter", EXPORTERS)
def test_groups_are_their_roles(exporter):
    names, expected = skeleton(exporter)
    for group, members in GROUPS.items():
        there = {expected[m] for m in members if m in expected}
        if there:
            assert set(chosen(names, group)) == there
        else:
            with pytest.raises(UnknownNameError):
                chosen(names, group)
    assert len(chosen(names, "feet", "hands")) == 4


def test_wishes_of_every_kind():
    assert chosen(CMU, "feet") == ["lfoot", "rfoot"]
    assert chosen(CMU, "Left_Foot", " HEAD ") == ["head", "lfoot"]  # in the skeleton's order, whatever was asked first
    assert chosen(CMU, "lfoot", "left_foot", "feet", "LFOOT") == ["lfoot", "rfoot"]  # once each
    assert chosen(CMU, "*toe*") == ["ltoes", "rtoes"] == chosen(CMU, "toes") == chosen(CMU, "?TOES")
    assert chosen(CMU, "[lr]thumb") == ["lthumb", "rthumb"]
    assert chosen(MIXAMO, "*:leftfoot") == ["mixamorig:LeftFoot"] == chosen(MIXAMO, "MIXAMORIG:leftfoot")
    assert chosen(MIXAMO, "feet", "*Toe*") == [n for n in MIXAMO if "Foot" in n or "Toe" in n]
    assert chosen(CMU, "feet", "all") == list(CMU)
    assert chosen(("feet", "LeftFoot"), "feet") == ["feet"]  # a joint's own name comes before a group's


def test_what_one_skeleton_lacks_is_no_error_while_something_is_found():
    names = ("Hips", "LeftFoot", "LeftHand")
    assert chosen(names, "feet", "hands", "head") == ["LeftFoot", "LeftHand"]
    assert chosen(names, "feet", "*wing*") == ["LeftFoot"]


def test_toes_are_taken_for_feet_that_are_not_there():
    assert chosen(("Hips", "LeftToeBase", "RightToeBase"), "feet") == ["LeftToeBase", "RightToeBase"]
    assert chosen(("Hips", "LeftFoot", "LeftToe", "RightToe"), "feet") == ["LeftFoot", "RightToe"]
    assert chosen(("Hips", "l_ball"), "left_foot") == ["l_ball"]
    with pytest.raises(UnknownNameError):  # but not the other way round
        chosen(("Hips", "LeftFoot"), "toes")


@pytest.mark.parametrize("wish", ["LeftFot", "left_wing", "", "foot", "feets"])
def test_a_name_that_is_not_there_lists_the_nearest(wish):
    with pytest.raises(UnknownNameError, match=re.escape(f"clip.bvh: no joint or role named {wish!r}")):
        choose(("Hips", "LeftFoot", "RightFoot"), ["feet", wish], "clip.bvh")
    if wish == "LeftFot":
        with pytest.raises(UnknownNameError, match="LeftFoot"):
            choose(("Hips", "LeftFoot"), [wish])


def test_nothing_chosen_at_all():
    with pytest.raises(UnknownNameError, match="feet hands"):
        choose(("Hips", "Spine"), ["feet", "hands"])
    with pytest.raises(UnknownNameError):
        choose(("Hips",), ["*Foot*"])
    with pytest.raises(UnknownNameError):
        choose((), ["head"])
    assert choose((), ["all"]) == ()


# recorded files


def test_recorded_skeletons_have_their_limbs(data):
    files = sorted(data.glob("bvh/*/*.bvh"))
    assert len(files) > 25
    for path in files:
        names = read_bvh(path).skeleton.names
        found = roles(names)
        assert {f"{s}_{part}" for s in ("left", "right") for part in LIMBS if part != "toe"} <= set(found), path.name
        assert "head" in found and len(set(found.values())) == len(found), path.name
        for role, j in found.items():
            side = role.partition("_")[0]
            other = {"left": "right", "right": "left"}.get(side)
            assert other is None or other not in names[j].casefold(), path.name
        if any("toe" in n.casefold() for n in names):
            assert {"left_toe", "right_toe"} <= set(found), path.name


def test_a_file_of_which_few_joints_are_read_has_the_same_roles(data):
    for path in sorted(data.glob("bvh/exporters/*.bvh")):
        whole = read_bvh(path)
        part = read_bvh(path, joints=lambda names: choose(names, ["feet", "hands"]))
        wanted = {whole.skeleton.names[j] for j in choose(whole.skeleton.names, ["feet", "hands"])}
        assert {part.skeleton.names[j] for j in choose(part.skeleton.names, ["feet", "hands"])} == wanted, path.name
        for name in wanted:
            roles_of = [role_of(m.skeleton.names, m.skeleton.names.index(name)) for m in (whole, part)]
            assert roles_of[0] == roles_of[1] is not None, (path.name, name)
