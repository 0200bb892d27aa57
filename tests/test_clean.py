"""Cleaning: what detection found is held exactly, the rest of the motion hardly changes; foot and toes do not fight."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kinjax.annotations import Annotations, Constraint, Constraints
from kinjax.deform import Orientation, Position, clean, constraints_from
from kinjax.detect import detect
from kinjax.errors import OptionError, UnknownNameError
from kinjax.formats import load, save
from kinjax.kinematics import object_poses
from kinjax.motion import Motion
from kinjax.synthetic import walking_biped

WALKS = {
    "02_01": ("lfoot", "rfoot", "ltoes", "rtoes"),
    "35_01": ("lfoot", "rfoot", "ltoes", "rtoes"),
    "cmu_12_01_walk": ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"),
}


def slides(motion: Motion, constraints: Constraints) -> np.ndarray:
    """How far each space constraint's body point is from its mean place at worst (metres), over the constraint's frames."""
    poses = object_poses(motion)
    out = []
    for c in constraints.of(type="space"):
        path = np.asarray(poses.position, float)[c.begin : c.end + 1, poses.index(c.object)]
        out.append(np.linalg.norm(path - path.mean(0), axis=1).max())
    return np.array(out)


@pytest.fixture(scope="module")
def walk() -> tuple[Motion, Annotations]:
    scene = walking_biped(rate=60, steps=2)
    return scene.motion, scene.annotations()


def rest(name: str, begin: int, end: int) -> Constraint:
    return Constraint(name, "space", begin, end, (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def recorded(data: Path) -> dict[str, tuple[Motion, Annotations]]:
    """Recorded walks and what is found of their feet and toes."""
    clips = {name: load(data / "bvh" / "cmu" / f"{name}.bvh") for name in WALKS}
    return {n: (m, detect(m, objects=list(WALKS[n])).annotations()) for n, m in clips.items()}


@pytest.mark.parametrize(
    ("name", "words"),
    [pytest.param("02_01", ("foot", "toe"), marks=pytest.mark.slow), ("35_01", ("foot", "toe")), ("cmu_12_01_walk", ("foot",))],
    ids=lambda x: x if isinstance(x, str) else " and ".join(x),
)
def test_planted_feet_stand_still_in_the_file_that_is_written(
    name: str, words: tuple[str, ...], recorded, tmp_path: Path
):
    motion, found = recorded[name]
    kept = [c for c in found.constraints if any(w in c.object.lower() for w in words)]
    found = replace(found, constraints=Constraints(tuple(kept)))
    done = clean(motion, found)
    save(tmp_path / "clean.bvh", done.motion)
    written = load(tmp_path / "clean.bvh")
    before, after = slides(motion, found.constraints), slides(written, found.constraints)
    change = np.degrees(done.report.rms_change())
    print(f"{len(before)} rests, slide {1e3 * before.max():.1f} -> {1e3 * after.max():.4f} mm, {change:.2f} deg RMS")
    assert len(before) >= 5 and before.max() > 5e-3
    assert after.max() < 5e-4
    assert change < 3 and done.report.root_change.max() < 0.1
    untouched = [j for j, n in enumerate(motion.skeleton.names) if "arm" in n.lower() or "head" in n.lower()]
    assert (written.rotations.shape == motion.rotations.shape) and done.report.change[:, untouched].max() == 0


def test_without_constraints_nothing_changes(walk):
    motion, found = walk
    done = clean(motion, replace(found, constraints=Constraints()))
    assert np.array_equal(done.motion.rotations, np.asarray(motion.rotations, float))
    assert np.array_equal(done.motion.translations, np.asarray(motion.translations, float))


def test_a_walk_that_needs_no_cleaning_is_hardly_changed(walk):
    """By construction its feet stand still: what is held is where they are."""
    motion, found = walk
    done = clean(motion, found.constraints.of(type="space"))
    assert np.degrees(done.report.rms_change()) < 0.3
    assert slides(done.motion, found.constraints).max() < 5e-4


def test_a_foot_alone_is_held_by_its_place_and_its_turn(walk):
    motion, _ = walk
    place, turn = constraints_from([rest("leftfoot", 10, 40)], motion)
    assert isinstance(place, Position) and isinstance(turn, Orientation)
    assert place.joint == turn.joint == "LeftFoot" and (place.begin, place.end) == (turn.begin, turn.end) == (10, 40)
    center = motion.skeleton.segment_centers()[motion.skeleton.topology.index("LeftFoot")]
    assert np.allclose(place.point, center)
    mean = np.asarray(object_poses(motion, ["LeftFoot"]).position, float)[10:41, 0].mean(0)
    assert np.allclose(place.at, mean, atol=1e-6)
    assert place.priority == turn.priority == 1 and place.ease_in == pytest.approx(0.1)


def test_a_foot_and_its_toes_share_one_place(walk):
    """The joint between them is held while either stands: six freedoms and the toes' three, not twelve."""
    motion, _ = walk
    goals = constraints_from([rest("LeftFoot", 10, 40), rest("LeftToeBase", 15, 50)], motion)
    places = [g for g in goals if isinstance(g, Position)]
    assert len(places) == 1 and len(goals) == 3
    assert places[0].joint == "LeftToeBase" and not any(places[0].point)
    assert (places[0].begin, places[0].end) == (10, 50)
    assert {(g.joint, g.begin, g.end) for g in goals if isinstance(g, Orientation)} == {
        ("LeftFoot", 10, 40),
        ("LeftToeBase", 15, 50),
    }


def test_toes_that_stand_at_another_time_have_their_own_place(walk):
    motion, _ = walk
    goals = constraints_from([rest("LeftFoot", 10, 30), rest("LeftToeBase", 60, 80)], motion)
    assert [g.joint for g in goals if isinstance(g, Position)] == ["LeftFoot", "LeftToeBase"]


def test_eases_never_reach_into_a_neighbour(walk):
    motion, _ = walk
    spans = [(10, 20), (24, 40), (42, 50), (51, 60)]
    goals = constraints_from([rest("LeftFoot", *s) for s in spans], motion)
    for kind in (Position, Orientation):
        own = sorted((g for g in goals if isinstance(g, kind)), key=lambda g: g.begin)
        assert [(g.begin, g.end) for g in own] == spans
        for a, b in pairwise(own):
            assert a.end + round(a.ease_out * 60) < b.begin - round(b.ease_in * 60)


def test_overlapping_constraints_of_one_joint_are_held_one_after_the_other(walk):
    motion, _ = walk
    goals = constraints_from([rest("LeftFoot", 10, 30), rest("LeftFoot", 30, 50), rest("LeftFoot", 40, 45)], motion)
    assert [(g.begin, g.end) for g in goals if isinstance(g, Position)] == [(10, 30), (31, 50)]


def test_a_line_is_two_points_of_its_axis_and_a_point_one(walk):
    motion, _ = walk
    hand = np.asarray(object_poses(motion, ["LeftHand"]).position, float)[20:60, 0].mean(0)
    line = Constraint("LeftHand", "line", 20, 59, tuple(hand), (0.0, 0.0, 1.0))
    point = Constraint("RightHand", "point", 20, 59, tuple(hand))
    goals = constraints_from([line, point], motion)
    assert [g.joint for g in goals] == ["LeftHand", "LeftHand", "RightHand"]
    center = motion.skeleton.segment_centers()[motion.skeleton.topology.index("LeftHand")]
    a, b = (np.asarray(g.point) for g in goals[:2])
    assert np.linalg.norm(a - b) == pytest.approx(2 * np.linalg.norm(center))
    across = np.asarray(goals[1].at) - np.asarray(goals[0].at)
    assert across[2] / np.linalg.norm(across) > 0.95
    assert np.linalg.norm((np.asarray(goals[0].at) + np.asarray(goals[1].at)) / 2 - hand) < 0.05


def test_a_roll_keeps_clear_of_the_rests_beside_it(walk):
    motion, _ = walk
    roll = Constraint("LeftFoot", "line", 35, 45, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert len(constraints_from([rest("LeftFoot", 10, 36), roll], motion)) == 2
    goals = constraints_from([rest("LeftToeBase", 10, 30), replace(roll, end=70)], motion)
    lines = [g for g in goals if "line" in g.name]
    assert len(lines) == 2 and all((g.begin, g.end) == (37, 70) for g in lines)  # the rest lets go for 6 frames


def test_constraints_relative_to_a_joint_stay_relative(walk):
    motion, _ = walk
    goals = constraints_from([rest("LeftHand", 20, 60)], motion, relative_to="hips")
    assert all(g.relative_to == "Hips" for g in goals)
    poses = object_poses(motion, ["LeftHand", "Hips"], origin="joint")
    away = np.asarray(poses.position, float)[:, 0] - np.asarray(poses.position, float)[:, 1]
    assert np.linalg.norm(goals[0].at) == pytest.approx(np.linalg.norm(away[20:61], axis=1).mean(), abs=0.15)


def test_annotations_of_another_clip_are_refused(walk):
    motion, found = walk
    with pytest.raises(OptionError, match="7 frames"):
        constraints_from(replace(found, frames=7), motion)
    with pytest.raises(OptionError, match="not inside the clip"):
        constraints_from([rest("LeftFoot", 10, 5000)], motion)
    with pytest.raises(UnknownNameError, match="LeftFoot"):
        constraints_from([rest("LeftFot", 10, 20)], motion)
    with pytest.raises(OptionError, match="ease"):
        constraints_from([rest("LeftFoot", 10, 20)], motion, ease=-1)


def test_lost_frames_do_not_count(walk):
    motion, _ = walk
    q = np.array(motion.rotations, float)
    q[12:14] = np.nan
    lost = replace(motion, rotations=q)
    place, turn = constraints_from([rest("LeftFoot", 10, 40)], lost)
    assert np.isfinite(place.at).all() and np.isfinite(turn.at).all()
    with pytest.raises(OptionError, match="nowhere finite"):
        constraints_from([rest("LeftFoot", 12, 13)], lost)
