"""Labels of the usual marker sets find their body parts; nothing else does."""

import pytest

from kinjax.marker_sets import OBJECTS, body_parts, split_label

TEXT = (
    "LFHD RFHD LBHD RBHD C7 T10 CLAV STRN RBAK LSHO LUPA LELB LFRM LWRA LWRB LFIN RSHO RUPA RELB RFRM RWRA RWRB RFIN "
    "LASI RASI LPSI RPSI LTHI LKNE LTIB LANK LHEE LTOE RTHI RKNE RTIB RANK RHEE RTOE"
)
PLUG_IN_GAIT = TEXT.split()


def named(labels):
    """Body parts with their labels; the labels may be one text."""
    labels = labels.split() if isinstance(labels, str) else labels
    return {part: [labels[i] for i in at] for part, at in body_parts(labels).items()}


def whole(labels):
    """Body parts that have three markers or more."""
    return {part for part, at in named(labels).items() if len(at) >= 3}


def test_full_body_plug_in_gait():
    parts = named(PLUG_IN_GAIT)
    assert parts["left_foot"] == ["LHEE", "LTOE", "LANK"] and parts["right_foot"] == ["RHEE", "RTOE", "RANK"]
    assert parts["left_hand"] == ["LWRA", "LWRB", "LFIN"]
    assert parts["head"] == ["LFHD", "RFHD", "LBHD", "RBHD"]
    assert parts["pelvis"] == ["LASI", "RASI", "LPSI", "RPSI"]
    assert parts["thorax"] == ["C7", "T10", "CLAV", "STRN"]
    assert parts["right_shank"] == ["RKNE", "RTIB", "RANK"]
    assert parts["left_forearm"] == ["LELB", "LFRM", "LWRA", "LWRB"]
    assert parts["left_upper_arm"] == ["LSHO", "LUPA", "LELB"]
    assert parts["left_thigh"] == ["LTHI", "LKNE"]  # two: the caller says what is missing
    assert list(parts) == [o for o in OBJECTS if o in parts]


@pytest.mark.parametrize(
    "write",
    [
        str.lower,
        lambda n: f"Anna:{n}",
        lambda n: f"{n}_raw",
        lambda n: f"{n[0]}.{n[1:]}" if n[0] in "LR" else n,
        lambda n: f" {n[0]}_{n[1:].lower()}" if n[0] in "LR" else n,
        lambda n: f"{n[1:]}_{n[0]}" if n[0] in "LR" else n,
        lambda n: {"L": "left ", "R": "Right-"}[n[0]] + n[1:] if n[0] in "LR" else n,
    ],
)
def test_spellings(write):
    assert body_parts([write(n) for n in PLUG_IN_GAIT]) == body_parts(PLUG_IN_GAIT)


def test_joint_centres_under_the_markers_names_do_not_count():
    assert body_parts([*PLUG_IN_GAIT, "LKNE", "LANK", "RKNE", "RANK"]) == body_parts(PLUG_IN_GAIT)


def test_angles_and_virtual_points_are_no_markers():
    virtual = "LAnkleAngles LFOO LFOA LFOL LFOP HEDO HEDA HEDL HEDP LTOO LTOA LTOL LTOP PELO PELA LCLO LCLL LCLP *12 C_3 CentreOfMass"
    assert body_parts(virtual.split()) == {}


def test_helen_hayes_and_cleveland():
    labels = "V.Sacral R.ASIS L.ASIS R.Heel R.Toe R.Ankle R.Knee R.Thigh R.Shank R.Thigh.Upper R.Thigh.Front R.Thigh.Rear"
    parts = named(labels)
    assert parts["pelvis"] == ["L.ASIS", "R.ASIS", "V.Sacral"]
    assert parts["right_foot"] == ["R.Heel", "R.Toe", "R.Ankle"]
    assert parts["right_thigh"] == ["R.Thigh.Upper", "R.Thigh.Front", "R.Thigh.Rear"]
    assert parts["right_shank"] == ["R.Knee", "R.Shank", "R.Ankle"]


def test_cast_clusters_and_anatomical_landmarks():
    labels = (
        "L_IAS R_IAS L_IPS R_IPS R_TH1 R_TH2 R_TH3 R_TH4 R_FLE R_FME R_SK1 R_SK2 R_SK3 R_SK4 R_FAL R_TAM R_FCC R_FM1 R_FM2 R_FM5"
    )
    parts = named(labels)
    assert parts["pelvis"] == ["L_IAS", "R_IAS", "L_IPS", "R_IPS"]
    assert parts["right_thigh"] == ["R_TH1", "R_TH2", "R_TH3", "R_TH4"]
    assert parts["right_shank"] == ["R_SK1", "R_SK2", "R_SK3", "R_SK4"]
    assert parts["right_foot"] == ["R_FCC", "R_FM2", "R_FAL"]
    assert not any(p.startswith("left_") for p in parts)


def test_sets_of_animation_studios():
    labels = (
        "HeadL HeadTop HeadR HeadFront Chest SpineTop BackL BackR WaistLFront WaistRFront WaistLBack WaistRBack "
        "LHeelBack LForefootOut LForefootIn LAnkleOut LWristIn LWristOut LHandOut"
    )
    assert whole(labels) == {"head", "thorax", "pelvis", "left_foot", "left_hand"}
    parts = named(labels)
    assert parts["left_foot"] == ["LHeelBack", "LAnkleOut", "LForefootOut", "LForefootIn"]
    cmu = "LFHD RFHD LBHD RBHD LFWT RFWT LBWT RBWT LHEE LTOE LANK LMT5"
    assert whole(cmu) == {"head", "pelvis", "left_foot"} and named(cmu)["left_foot"] == ["LHEE", "LTOE", "LANK"]


def test_two_subjects_are_kept_apart():
    foot = ["LHEE", "LTOE", "LANK"]
    labels = [f"Anna:{n}" for n in foot] + [f"Bo:{n}" for n in foot] + ["ball1", "ball2"]
    parts = body_parts(labels)
    assert parts["Anna:left_foot"] == (0, 1, 2) and parts["Bo:left_foot"] == (3, 4, 5)
    for one in ([*labels[:3], "ball1"], [*labels[:3], "Bo:LHEE"]):  # no part of Bo is whole
        assert body_parts(one) == {"left_foot": (0, 1, 2), "left_shank": (2,)}


def test_a_label_is_split_at_its_last_colon():
    assert split_label("lab:Anna: LHEE") == ("lab:Anna", "LHEE") and split_label("LHEE") == ("", "LHEE")
    assert body_parts([]) == {} == body_parts(["", ":", "nothing"])
