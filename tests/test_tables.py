"""The tables of the paper on CMU clips: the labels are consistent, and what is found agrees with them."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.tables import costs, scores
from benchmarks.tables.__main__ import main, table
from benchmarks.tables.labels import CASES, Labels, Span, Target, read_clip, read_labels
from kinjax.annotations import Constraint, Constraints
from kinjax.detect import Settings
from kinjax.errors import KinjaxError
from kinjax.kinematics import forward_kinematics, object_poses

LABELS = read_labels()
ROBUST = scores.WAYS[2]


def clip_of(data, name):
    try:
        return read_clip(data, name)
    except KinjaxError as error:
        pytest.skip(str(error))


def rest(begin, end):
    return Constraint("hand", "space", begin, end, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("labels", LABELS.values(), ids=list(LABELS))
def test_labels_are_inside_the_clip_and_share_no_frame(labels: Labels):
    assert labels.planted.keys() == labels.ambiguous.keys()
    for effector in labels.planted:
        held = labels.held_free.get(effector, ())
        spans = sorted((*labels.planted[effector], *labels.ambiguous[effector], *held), key=lambda s: s.begin)
        assert all(0 <= s.begin <= s.end < labels.frames and s.uncertainty >= 0 for s in spans)
        assert all(a.end < b.begin for a, b in pairwise(spans))
        assert all(2 * s.uncertainty < s.frames for s in (*labels.planted[effector], *held))


def test_cases_and_labels_name_the_same_clips_and_effectors():
    assert {c.clip for c in CASES} == set(LABELS)
    for case in CASES:
        assert set(case.effectors) <= set(LABELS[case.clip].planted)
        assert all(LABELS[case.clip].targets(e) for e in case.effectors)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.clip)
def test_labels_belong_to_the_files(data: Path, case):
    motion, labels = clip_of(data, case.clip), LABELS[case.clip]
    assert motion.frames == labels.frames
    assert motion.rate == pytest.approx(labels.fps, rel=1e-4)
    assert set(case.effectors) <= set(motion.skeleton.names)
    height = np.ptp(np.asarray(forward_kinematics(motion)[1])[..., 1], axis=1)  # joints only: no crown, no soles
    assert 1.2 < np.median(height) < 1.9


def test_a_score_counts_what_differs():
    target = Target("hand", "planted", (Span(10, 19, 2), Span(40, 49, 1)), (Span(20, 29),), 60)
    s = scores.score(target, Span(10, 19), Constraints((rest(9, 25), rest(55, 56))))
    assert (s.extra, s.missed, s.mislabelled) == (1 + 2, 10, 13)
    assert s.everywhere == 13 + 6  # frames 20..25 are ambiguous
    assert s.sure == 2 + 8  # 9 is within the uncertainty of the first begin, 40 and 49 within that of the second span
    assert s.covered == 1
    assert s.overlap == pytest.approx(10 / 23)
    exact = scores.score(target, Span(10, 19), Constraints((rest(10, 19), rest(40, 49))))
    assert (exact.mislabelled, exact.sure, exact.everywhere, exact.covered, exact.overlap) == (0, 0, 0, 2, 1.0)


def test_walk_any_labelled_plant_finds_all_plants(data: Path):
    motion, labels = clip_of(data, "02_01"), LABELS["02_01"]
    targets = [t for e in ("lfoot", "rfoot") for t in labels.targets(e)]
    for target, some in scores.scores(motion, targets, ROBUST).items():
        assert len(some) == len(target.spans)  # every plant is long enough to be a template
        for s in some:
            assert len(s.constraints) == s.covered == len(target.spans)
            assert s.mislabelled <= 0.08 * target.scored().sum()
            assert s.sure <= 2  # all but two frames of it are where the labeller was not sure either


def test_ladder_feet_are_found_with_one_template_each(data: Path):
    motion, labels = clip_of(data, "01_03"), LABELS["01_03"]
    targets = [t for e in ("lfoot", "rfoot") for t in labels.targets(e)]
    one = [replace(t, spans=(max(t.spans, key=lambda s: s.frames),)) for t in targets]
    for target, (found,) in zip(targets, scores.scores(motion, one, ROBUST).values(), strict=True):
        s = scores.score(target, found.template, found.constraints)
        assert s.covered == len(target.spans)
        assert s.overlap > 0.9
        assert s.mislabelled < 0.05 * target.scored().sum()
        assert s.missed < 0.02 * target.mask().sum()


def test_templates_that_are_too_short_are_left_out_and_counted(data: Path):
    motion = clip_of(data, "02_01")
    poses = object_poses(motion, ["lfoot"])
    target = Target("lfoot", "planted", (Span(15, 62), Span(149, 160)), (), motion.frames)
    assert scores.usable(poses, target, Settings(method="paper", rate=25.0)) == (Span(15, 62),)
    assert len(scores.usable(poses, target, Settings(method="paper"))) == 2


def test_costs_are_split_and_counted(data: Path, monkeypatch):
    labels = LABELS["02_01"]
    jobs = [(e, s) for e in ("lfoot", "rfoot") for s in labels.planted[e]]
    jobs.sort(key=lambda job: job[1].frames)  # as for the walk above: the program is compiled only once
    poses, templates = scores.in_lanes(object_poses(clip_of(data, "02_01"), ["lfoot", "rfoot"]), jobs)
    plan, arguments, found = costs.program(poses, templates, ROBUST.settings)
    assert len(found.constraints) == 3 * 3 + 2 * 2
    signals, limits = jax.eval_shape(lambda: costs._until(plan, "pattern", *arguments))
    assert jax.eval_shape(lambda: costs._until(plan, "projection", *arguments)) == signals
    assert [x.shape for pair in limits for x in pair] == [(signals[0].shape[0], 1)] * 2  # one template: one value an object
    monkeypatch.setattr(costs, "_until", lambda plan, stop, *rest: costs.run_poses(plan, *rest))  # nothing to compile
    c = costs.cost(poses, templates, ROBUST.settings, rounds=2)
    assert c.found == 13
    assert min(c.projection, c.call) > 0 and min(c.pattern, c.detection) >= 0
    assert c.total == pytest.approx(c.projection + c.pattern + c.detection)


def test_a_missing_clip_is_said(tmp_path: Path, capsys):
    assert main(["--data", str(tmp_path)]) == 2
    assert "02_01.bvh" in capsys.readouterr().err


def test_columns_line_up():
    assert table(["a", "bb"], [[10, "x"], ["", 2.5]]).splitlines() == ["a   bb", "10  x", "    2.5"]


def test_pictures_show_what_was_found(data: Path, tmp_path: Path):
    from benchmarks.tables.pictures import picture

    case, labels = CASES[0], LABELS["02_01"]
    found = Constraints((rest(15, 62),))
    some = {e: scores.score(labels.targets(e)[0], labels.planted[e][0], found) for e in case.effectors}
    picture(case, labels, {"robust": some}).savefig(tmp_path / "found.png")
    assert (tmp_path / "found.png").stat().st_size > 10_000
