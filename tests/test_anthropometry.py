"""Where the mass is: the published table, the names of many exporters, and what is done without names."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from kinjax.anthropometry import leg_length, segment_masses
from kinjax.errors import OptionError, ShapeError
from kinjax.formats.bvh import read_bvh
from kinjax.kinematics import forward_kinematics
from kinjax.skeleton import Skeleton, Topology
from kinjax.synthetic import biped_skeleton

# ---- skeletons under many names: the same bones each time

TREE = (  # part, parent part, offset of the left side in metres
    ("pelvis", None, (0, 0, 0)), ("waist", "pelvis", (0, 0.12, 0)), ("chest", "waist", (0, 0.2, 0)),
    ("neck", "chest", (0, 0.22, 0)), ("head", "neck", (0, 0.1, 0)),
    ("collar", "chest", (0.03, 0.18, 0)), ("upper arm", "collar", (0.15, 0, 0)), ("forearm", "upper arm", (0.28, 0, 0)),
    ("hand", "forearm", (0.26, 0, 0)), ("finger", "hand", (0.1, 0, 0)),
    ("thigh", "pelvis", (0.09, -0.06, 0)), ("shank", "thigh", (0, -0.42, 0)), ("foot", "shank", (0, -0.42, 0)),
    ("toe", "foot", (0, -0.06, 0.14)),
)  # fmt: skip
CENTRAL = {"pelvis", "waist", "chest", "neck", "head"}
ENDS = {"head": (0, 0.16, 0), "finger": (0.09, 0, 0), "toe": (0, 0, 0.07)}

BODY = "pelvis waist chest neck head collar upper_arm forearm hand finger thigh shank foot toe"
CONVENTIONS = {
    "mixamo":
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Neck mixamorig:Head "
        "mixamorig:{Left}Shoulder mixamorig:{Left}Arm mixamorig:{Left}ForeArm mixamorig:{Left}Hand "
        "mixamorig:{Left}HandMiddle1 mixamorig:{Left}UpLeg mixamorig:{Left}Leg mixamorig:{Left}Foot "
        "mixamorig:{Left}ToeBase",
    "motion builder":
        "Hips Spine Spine1 Neck Head {Left}Shoulder {Left}Arm {Left}ForeArm {Left}Hand {Left}HandIndex1 "
        "{Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase",
    "biped":
        "Bip01|Pelvis Bip01|Spine Bip01|Spine1 Bip01|Neck Bip01|Head Bip01|{L}|Clavicle Bip01|{L}|UpperArm "
        "Bip01|{L}|Forearm Bip01|{L}|Hand Bip01|{L}|Finger0 Bip01|{L}|Thigh Bip01|{L}|Calf Bip01|{L}|Foot "
        "Bip01|{L}|Toe0",
    "collar":
        "Hips Chest Chest2 Neck Head {Left}Collar {Left}Shoulder {Left}Elbow {Left}Wrist {Left}Finger0 "
        "{Left}Hip {Left}Knee {Left}Ankle {Left}Toe",
    "short":
        "Hips Spine Spine1 Neck Head {L}Shoulder {L}Arm {L}ForeArm {L}Hand {L}Fingers {L}UpLeg {L}Leg {L}Foot "
        "{L}Toe",
    "smpl":
        "pelvis spine1 spine2 neck head {left}_collar {left}_shoulder {left}_elbow {left}_wrist {left}_hand "
        "{left}_hip {left}_knee {left}_ankle {left}_foot",
    "smpl fbx":
        "m_avg_Pelvis m_avg_Spine1 m_avg_Spine2 m_avg_Neck m_avg_Head m_avg_{L}_Collar m_avg_{L}_Shoulder "
        "m_avg_{L}_Elbow m_avg_{L}_Wrist m_avg_{L}_Hand m_avg_{L}_Hip m_avg_{L}_Knee m_avg_{L}_Ankle "
        "m_avg_{L}_Foot",
    "poser":
        "hip abdomen chest neck head {l}Collar {l}Shldr {l}ForeArm {l}Hand {l}Mid1 {l}Thigh {l}Shin {l}Foot "
        "{l}Toe",
    "unreal":
        "pelvis spine_01 spine_02 neck_01 head clavicle_{l} upperarm_{l} lowerarm_{l} hand_{l} middle_01_{l} "
        "thigh_{l} calf_{l} foot_{l} ball_{l}",
    "blender":
        "spine spine.001 spine.003 neck head shoulder.{L} upper_arm.{L} forearm.{L} hand.{L} f_middle.01.{L} "
        "thigh.{L} shin.{L} foot.{L} toe.{L}",
    "unity":
        "Hips Spine Chest Neck Head {Left}Shoulder {Left}UpperArm {Left}LowerArm {Left}Hand {Left}Middle1 "
        "{Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toes",
    "a person's name":
        "Bob_Hips Bob_Spine Bob_Spine1 Bob_Neck Bob_Head Bob_{Left}Shoulder Bob_{Left}Arm Bob_{Left}ForeArm "
        "Bob_{Left}Hand Bob_{Left}Middle Bob_{Left}UpLeg Bob_{Left}Leg Bob_{Left}Foot Bob_{Left}ToeBase",
    "acclaim":
        "root lowerback thorax lowerneck head {l}clavicle {l}humerus {l}radius {l}hand {l}fingers {l}femur "
        "{l}tibia {l}foot {l}toes",
    "robot":
        "torso waist chest neck head {left}_clavicle {left}_shoulder_joint {left}_elbow_joint "
        "{left}_wrist_joint {left}_finger {left}_hip_joint {left}_knee_joint {left}_ankle_joint {left}_toe",
}  # fmt: skip


def person(names: str) -> tuple[Skeleton, dict[str, int]]:
    """The skeleton under the names of one convention, and where each part is ("left thigh", "head")."""
    where, out, parents, offsets, ends = {}, [], [], [], []
    for (part, parent, offset), pattern in zip(TREE, names.split(), strict=True):
        for side in ("",) if part in CENTRAL else ("left", "right"):
            marks = {"Left": side.title(), "left": side, "L": side[:1].upper(), "l": side[:1]}
            above = where.get(f"{side} {parent}" if parent not in CENTRAL else parent, -1) if parent else -1
            where[part if part in CENTRAL else f"{side} {part}"] = len(out)
            out.append(pattern.format(**marks).replace("|", " "))
            parents.append(above)
            flip = np.array([-1 if side == "right" else 1, 1, 1])
            offsets.append(flip * offset)
            if part in ENDS:
                ends.append((len(out) - 1, flip * ENDS[part]))
    topology = Topology(tuple(out), tuple(parents), end_parents=tuple(j for j, _ in ends), end_names=("",) * len(ends))
    return Skeleton(np.array(offsets, float), np.array([e for _, e in ends], float), topology), where


@pytest.mark.parametrize("names", CONVENTIONS.values(), ids=CONVENTIONS)
def test_every_convention_is_understood(names):
    skeleton, where = person(names)
    reference, _ = person(CONVENTIONS["motion builder"])
    found, same = segment_masses(skeleton), segment_masses(reference)
    assert found.source == "de Leva 1996, male" and found.notes == ()
    np.testing.assert_allclose(found.fractions, same.fractions, atol=1e-15)
    np.testing.assert_allclose(found.centers, same.centers, atol=1e-15)
    assert leg_length(skeleton) == pytest.approx(0.84)
    for part in ("left upper arm", "right thigh", "left shank"):
        share = {"upper arm": 0.0271, "thigh": 0.1416, "shank": 0.0433}[part.split(" ", 1)[1]]
        assert found.fractions[where[part]] == pytest.approx(share)


# ---- the table


@pytest.mark.parametrize(
    ("table", "trunk", "head", "limbs", "trunk_center"),
    [
        ("male", 0.4346, 0.0694, (0.0271, 0.0162, 0.0061, 0.1416, 0.0433, 0.0137), 0.5138),
        ("female", 0.4257, 0.0668, (0.0255, 0.0138, 0.0056, 0.1478, 0.0481, 0.0129), 0.4964),
    ],
)
def test_against_the_published_table(table, trunk, head, limbs, trunk_center):
    skeleton, where = person(CONVENTIONS["motion builder"])
    found = segment_masses(skeleton, table)
    f, c = found.fractions, found.centers
    assert f.sum() == pytest.approx(1, abs=1e-15)
    whole = trunk + head + 2 * sum(limbs)
    assert whole == pytest.approx(1, abs=2e-4)  # the table's own rounding
    groups = (("upper arm",), ("forearm",), ("hand", "finger"), ("thigh",), ("shank",), ("foot", "toe"))
    for side in ("left", "right"):
        for parts, share in zip(groups, limbs, strict=True):
            assert sum(f[where[f"{side} {p}"]] for p in parts) == pytest.approx(share / whole)
    assert f[[where[p] for p in ("pelvis", "waist", "chest")]].sum() == pytest.approx(trunk / whole)
    assert f[[where[p] for p in ("neck", "head")]].sum() == pytest.approx(head / whole)
    # centres, from the proximal end
    thigh, upper_arm, shank = ({"male": (0.4095, 0.5772, 0.4395), "female": (0.3612, 0.5754, 0.4352)})[table]
    np.testing.assert_allclose(c[where["left thigh"]], [0, -0.42 * thigh, 0])
    np.testing.assert_allclose(c[where["right upper arm"]], [-0.28 * upper_arm, 0, 0])
    np.testing.assert_allclose(c[where["left shank"]], [0, -0.42 * shank, 0])
    # the trunk's three parts together have the centre that the table gives for the whole (CERV-MIDH)
    rest = {"pelvis": 0.0, "waist": 0.12, "chest": 0.32}
    height = sum(f[where[p]] * (rest[p] + c[where[p]][1]) for p in rest) / (trunk / whole)
    from_above = (0.54 - height) / 0.60
    assert from_above == pytest.approx(trunk_center, abs=6e-3)
    # clavicles are inside the trunk
    assert f[where["left collar"]] == 0


def test_a_twist_joint_shares_the_thigh():
    skeleton, where = person(CONVENTIONS["motion builder"])
    top = skeleton.topology
    knee = where["left shank"]
    names = (*top.names, "LeftUpLegRoll")
    # the roll joint hangs on the thigh, half-way; the shank hangs on it: parents must come first, so move it to the front
    order = [*range(knee), len(top.names), *range(knee, len(top.names))]
    new = {old: i for i, old in enumerate(order)}
    parents = [*top.parents, where["left thigh"]]
    parents[knee] = len(top.names)
    offsets = np.vstack([skeleton.offsets, [0, -0.21, 0]])
    offsets[knee] = [0, -0.21, 0]
    moved = Skeleton(
        offsets[order],
        skeleton.end_offsets,
        Topology(
            tuple(names[j] for j in order),
            tuple(-1 if parents[j] < 0 else new[parents[j]] for j in order),
            end_parents=tuple(new[p] for p in top.end_parents),
            end_names=top.end_names,
        ),
    )
    found, plain = segment_masses(moved), segment_masses(skeleton)
    thigh, roll = new[where["left thigh"]], new[len(top.names)]
    assert found.fractions[[thigh, roll]].sum() == pytest.approx(plain.fractions[where["left thigh"]])
    both = found.fractions[thigh] * found.centers[thigh] + found.fractions[roll] * (found.centers[roll] + [0, -0.21, 0])
    np.testing.assert_allclose(both / found.fractions[[thigh, roll]].sum(), [0, -0.42 * 0.4095, 0])
    assert leg_length(moved) == pytest.approx(0.84)


def test_missing_hands_and_feet_hang_at_the_end():
    names = CONVENTIONS["motion builder"].split()
    names = " ".join(n.replace("Hand", "Mitten").replace("Foot", "Boot") for n in names)
    skeleton, _ = person(names)
    found = segment_masses(skeleton)
    assert len(found.notes) == 4 and "no left foot among the joints" in " ".join(found.notes)
    assert found.fractions.sum() == pytest.approx(1)
    assert leg_length(skeleton) > 0.84


# ---- recorded skeletons


def center_of_mass(motion, table="male"):
    found = segment_masses(motion.skeleton, table)
    q, p = (np.asarray(x, float) for x in forward_kinematics(motion))
    t = 2 * np.cross(q[..., 1:], found.centers)
    world = p + found.centers + q[..., :1] * t + np.cross(q[..., 1:], t)
    return np.einsum("j,fjc->fc", found.fractions, world), q, p


def test_recorded_skeletons_are_all_named(data):
    files = sorted(data.glob("bvh/*/*.bvh"))
    assert len(files) > 25
    for path in files:
        skeleton = read_bvh(path).skeleton
        found = segment_masses(skeleton)
        assert found.source == "de Leva 1996, male", path.name
        assert found.notes == (), path.name
        np.testing.assert_allclose(found.fractions.sum(), 1, atol=1e-14)
        assert np.isfinite(found.centers).all()
        assert 0.7 < leg_length(skeleton) < 0.95, path.name


@pytest.mark.parametrize("clip", ["cmu/02_01", "cmu/35_01", "cmu/cmu_12_01_walk", "exporters/test_freebvh"])
def test_the_centre_of_mass_of_who_stands_or_walks(data, clip):
    motion = read_bvh(data / f"bvh/{clip}.bvh")
    motion = motion.slice(0, min(motion.frames - 1, 199))
    com, q, p = center_of_mass(motion)
    top = motion.skeleton.topology
    tips = np.array(top.end_parents)
    ends = motion.skeleton.end_offsets
    t = 2 * np.cross(q[:, tips, 1:], ends)
    points = np.concatenate([p, p[:, tips] + ends + q[:, tips, :1] * t + np.cross(q[:, tips, 1:], t)], 1)[..., 1]
    height = np.median((com[:, 1] - points.min(1)) / (points.max(1) - points.min(1)))
    assert 0.53 < height < 0.58


# ---- without names


def prop(count=3):
    names = tuple(f"bone{i}x" for i in range(count))
    offsets = np.array([[0, 0, 0], [0, 2.0, 0], [1.0, 0, 0]])[:count]
    return Skeleton(offsets, np.array([[0, 0, 1.0]]), Topology(names, (-1, 0, 1)[:count], end_parents=(count - 1,)))


def test_bone_length_where_names_tell_nothing():
    found = segment_masses(prop())
    assert found.source == "bone length" and "bone length" in found.notes[0]
    np.testing.assert_allclose(found.fractions, [0.5, 0.25, 0.25])
    np.testing.assert_allclose(found.centers, [[0, 1, 0], [0.5, 0, 0], [0, 0, 0.5]])
    with pytest.raises(OptionError, match="give the leg length"):
        leg_length(prop())


def test_a_skeleton_without_size():
    point = Skeleton(np.zeros((2, 3)), np.zeros((0, 3)), Topology(("a", "b"), (-1, 0)))
    np.testing.assert_array_equal(segment_masses(point).fractions, [0.5, 0.5])
    np.testing.assert_array_equal(segment_masses(point).centers, 0)


def test_legs_of_two_trees_are_no_body():
    skeleton, where = person(CONVENTIONS["motion builder"])
    parents = list(skeleton.topology.parents)
    parents[where["right thigh"]] = -1
    apart = replace(skeleton, topology=replace(skeleton.topology, parents=tuple(parents)))
    assert segment_masses(apart).source == "bone length"


def test_a_knee_that_is_not_below_its_hip_is_no_body():
    skeleton, where = person(CONVENTIONS["motion builder"])
    parents = list(skeleton.topology.parents)
    parents[where["right shank"]] = where["pelvis"]
    assert (
        segment_masses(replace(skeleton, topology=replace(skeleton.topology, parents=tuple(parents)))).source
        == "bone length"
    )


# ---- a skeleton that brings its own


def test_own_masses_come_first():
    skeleton = replace(biped_skeleton(), masses=np.arange(21.0), mass_centers=np.ones((21, 3)))
    found = segment_masses(skeleton)
    assert found.source == "skeleton" and found.notes == ()
    np.testing.assert_allclose(found.fractions, np.arange(21) / 210)
    np.testing.assert_array_equal(found.centers, 1)
    bare = segment_masses(replace(skeleton, mass_centers=None))
    assert "half-way" in bare.notes[0]
    np.testing.assert_allclose(bare.centers, skeleton.segment_centers())
    centred = segment_masses(replace(skeleton, masses=None))
    np.testing.assert_array_equal(centred.fractions, segment_masses(biped_skeleton()).fractions)
    np.testing.assert_array_equal(centred.centers, 1)


def test_the_new_fields_are_leaves():
    plain = biped_skeleton()
    assert plain.masses is None and plain.mass_centers is None and plain.limits is None
    assert len(jax.tree.leaves(plain)) == 2
    full = replace(plain, masses=np.ones(21), mass_centers=np.ones((21, 3)), limits=np.zeros((21, 3, 2)))
    assert len(jax.tree.leaves(full)) == 5
    assert jax.tree.map(lambda x: 2 * x, full).masses[0] == 2


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"masses": np.ones(3)}, ShapeError, "one for each of 21 joints"),
        ({"masses": -np.ones(21)}, OptionError, "none negative"),
        ({"masses": np.zeros(21)}, OptionError, "not all zero"),
        ({"masses": np.full(21, np.nan)}, OptionError, "finite"),
        ({"mass_centers": np.ones((21, 2))}, ShapeError, r"\(21, 3\)"),
        ({"mass_centers": np.full((21, 3), np.inf)}, OptionError, "finite"),
    ],
)
def test_wrong_masses(change, error, words):
    with pytest.raises(error, match=words):
        segment_masses(replace(biped_skeleton(), **change))


def test_unknown_table():
    with pytest.raises(OptionError, match="choose male or female"):
        segment_masses(biped_skeleton(), "alien")
