"""Evaluation: counting by hand and by brute force, matching, labels of every kind, what is left out, the rules of thumb."""

import itertools
import json
import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinjax.annotations import Annotations, Constraint, Constraints
from kinjax.errors import OptionError, ShapeError, UnknownNameError
from kinjax.evaluation import Label, evaluate, from_annotations, labels_of
from kinjax.evaluation.counting import against_bounds
from kinjax.evaluation.rules import RULES, intervals, speed_and_height, toe_displacement, toe_speed
from kinjax.evaluation.spans import core, frames_in, matched, merged, runs
from kinjax.evaluation.tables import clip_indices

FPS = 100.0
CLIPS = {"clip": ["data/a/walk.bvh", "data/b/run.bvh"], "frames": [200, 100], "fps": [FPS, 50.0]}
WALK, RUN = CLIPS["clip"]


def found(*rows):
    """Columns of rows (clip, object, type, begin, end[, role])."""
    names = ("clip", "object", "type", "begin", "end", "role")
    filled = [(*r, None)[:6] for r in rows]
    return {n: [r[i] for r in filled] for i, n in enumerate(names)}


def walk(*spans, object="foot", type="space"):
    """Found constraints of one object in the walk."""
    return found(*((WALK, object, type, b, e) for b, e in spans))


def labelled(*spans, kind="exact", type="space", object="foot"):
    """Labels of one object in the walk."""
    return [Label(WALK, object, b, e, type=type, kind=kind) for b, e in spans]


def same(a, b):
    """Equal, or both NaN."""
    return (math.isnan(a) and math.isnan(b)) or a == pytest.approx(b)


# exact labels ---------------------------------------------------------------------------------------------------------


def test_counted_by_hand():
    """Labels 10..19 and 50..69; found 12..21, 50..54 and 100..104."""
    t = evaluate(walk((12, 21), (50, 54), (100, 104)), labelled((10, 19), (50, 69)), CLIPS).total
    assert (t.found, t.right, t.wanted, t.hit) == (20, 8 + 5, 30, 13)
    assert (t.precision, t.recall, t.f1) == pytest.approx((13 / 20, 13 / 30, 2 * 13 / 50))
    # the first overlaps by 8 of 12 frames, the second by 5 of 20: one match at 0.5, two at 0.25
    assert (t.labels, t.labels_hit, t.intervals, t.intervals_right) == (2, 1, 3, 1)
    assert (t.begin.median, t.end.median, t.begin.count) == pytest.approx((20, 20, 1))  # late by two frames
    t = evaluate(walk((12, 21), (50, 54), (100, 104)), labelled((10, 19), (50, 69)), CLIPS, iou=0.25).total
    assert (t.labels_hit, t.intervals_right, t.begin.median) == (2, 2, pytest.approx(10))
    assert t.end_errors == pytest.approx((20, -150)) and (t.end.low, t.end.high) == pytest.approx((-107.5, -22.5))


def test_one_frame():
    t = evaluate(walk((7, 7), (9, 9)), labelled((7, 7)), CLIPS).total
    assert (t.found, t.right, t.wanted, t.labels_hit, t.intervals) == (2, 1, 1, 1, 2)
    assert (t.begin.median, t.end.median) == (0, 0)


def test_touching_intervals_of_a_type_stay_two():
    labels = labelled((10, 19), (20, 39))
    t = evaluate(walk((10, 19), (20, 39)), labels, CLIPS).total
    assert (t.labels, t.labels_hit, t.intervals_right, t.f1, t.interval_f1) == (2, 2, 2, 1, 1)
    one = evaluate(walk((10, 39)), labels, CLIPS).total  # one found interval is one label's at most
    assert (one.f1, one.labels_hit, one.intervals_right) == (1, 1, 1)


def test_labels_without_type_are_contact_of_any_type():
    """A line, a rest and a point that touch, or nearly, are one contact."""
    rows = found((WALK, "foot", "line", 10, 14), (WALK, "foot", "space", 15, 29), (WALK, "foot", "point", 33, 39))
    labels = labelled((10, 39), type="")
    t = evaluate(rows, labels, CLIPS).total
    assert (t.found, t.hit, t.wanted) == (27, 27, 30)  # gaps are no frames that were found
    assert (t.intervals, t.intervals_right, t.begin.median, t.end.median) == (1, 1, 0, 0)
    assert evaluate(rows, labels, CLIPS, join=0.02).total.intervals == 2
    apart = evaluate(rows, labelled((10, 29), (33, 39), type=""), CLIPS).total
    assert (apart.f1, apart.labels, apart.interval_f1) == (1, 1, 1)  # labels are joined in the same way
    only = evaluate(rows, labels, CLIPS, types=["space"]).total
    assert (only.found, only.hit) == (15, 15)


def test_types_are_scored_apart():
    rows = found((WALK, "foot", "line", 10, 14), (WALK, "foot", "space", 15, 29), (WALK, "foot", "point", 40, 44))
    labels = [*labelled((15, 29)), *labelled((10, 19), type="line")]
    e = evaluate(rows, labels, CLIPS)
    assert (e.of("foot", "space").f1, e.of("FOOT", "line").recall) == (1, 0.5)
    assert e.left.constraints == 1  # points have no label in this clip: nothing is known of them
    assert (e.total.found, e.total.wanted, e.of(type="line").labels, e.of("foot").labels) == (20, 25, 1, 2)
    with pytest.raises(OptionError, match="no score of hand all; there are foot line"):
        e.of("hand")


@given(st.lists(st.tuples(st.integers(0, 190), st.integers(0, 30)), max_size=6), st.sampled_from(["", "space"]))
def test_what_is_found_as_labelled_is_all_right(spans, kind):
    spans = [(b, min(b + n, 199)) for b, n in spans]
    e = evaluate(walk(*spans), labelled(*spans, type=kind), CLIPS)
    ratios = [e.total.precision, e.total.recall, e.total.f1, e.total.interval_precision, e.total.interval_recall]
    assert ratios == [1.0] * 5 if spans else all(map(math.isnan, ratios))
    assert set(e.total.begin_errors) | set(e.total.end_errors) <= {0.0} and not e.missed()


# outer bounds ---------------------------------------------------------------------------------------------------------


def test_a_stance_counted_by_hand():
    """Stance 50..149 at 100 a second: core 75..104, reach 25..174."""
    t = evaluate(walk((0, 29), (40, 160), (190, 199)), labelled((50, 149), kind="outer", type=""), CLIPS).total
    assert (t.found, t.right) == (5 + 121, 100)
    assert (t.wanted, t.hit, t.whole, t.whole_hit) == (30, 30, 100, 100)
    assert (t.begin.median, t.end.median) == pytest.approx((-100, 110))
    # the first interval has five of thirty frames within reach: it is not held against the method as an interval
    assert (t.labels_hit, t.intervals, t.intervals_right) == (1, 1, 1)


def test_what_is_farther_away_counts_in_nothing():
    t = evaluate(walk((0, 20), (180, 199)), labelled((50, 149), kind="outer"), CLIPS).total
    assert (t.found, t.intervals, t.labels_hit, t.recall) == (0, 0, 0, 0) and math.isnan(t.precision) and t.f1 == 0
    assert evaluate(walk((0, 20)), labelled((50, 149), kind="outer"), CLIPS, reach=0.4).total.found == 11
    assert evaluate(walk((40, 60)), labelled((50, 149), kind="outer"), CLIPS, reach=0).total.precision == 1


def test_the_core_is_an_option():
    spans, labels = walk((50, 99)), labelled((50, 149), kind="outer")
    assert evaluate(spans, labels, CLIPS).total.recall == pytest.approx(25 / 30)
    whole = evaluate(spans, labels, CLIPS, core=(0, 1)).total
    assert whole.recall == whole.whole_recall == 0.5
    for bad in ((0.5, 0.5), (-0.1, 0.5), (0.5, 1.1), (math.nan, 0.5)):
        with pytest.raises(OptionError, match="core"):
            evaluate(spans, labels, CLIPS, core=bad)


def test_a_short_stance_may_have_no_core():
    t = evaluate(walk((50, 50)), labelled((50, 50), kind="outer"), CLIPS).total
    assert (t.wanted, t.whole, t.precision) == (0, 1, 1) and math.isnan(t.recall) and math.isnan(t.f1)


def test_unknown_frames_count_in_nothing():
    labels = [*labelled((50, 149), kind="outer"), *labelled((160, 199), kind="unknown")]
    t = evaluate(walk((50, 199)), labels, CLIPS).total
    assert (t.found, t.right) == (110, 100)
    labels = [*labelled((50, 149)), *labelled((100, 199), kind="unknown")]
    t = evaluate(walk((50, 79), (150, 180)), labels, CLIPS).total
    assert (t.found, t.right, t.wanted, t.intervals) == (30, 30, 50, 1)


def test_two_stances_that_one_constraint_covers():
    t = evaluate(walk((20, 110)), labelled((10, 49), (70, 119), kind="outer"), CLIPS)
    assert [x.matched for x in t.labels] == [False, True]  # it is the one's that it has most of
    assert t.total.begin_errors == pytest.approx((100, -500)) and (t.total.intervals, t.total.intervals_right) == (1, 1)


# nothing must be found, nothing was found -----------------------------------------------------------------------------


def test_where_nothing_must_be_found():
    for kind, word in itertools.product(("exact", "outer"), ("none", "empty")):
        t = evaluate(walk((10, 19), (100, 104)), [Label(WALK, "foot", 0, 49, type=word, kind=kind)], CLIPS).total
        assert (t.found, t.right, t.precision, t.f1, t.intervals) == (10, 0, 0, 0, 1) and math.isnan(t.recall)


def test_nothing_must_be_found_beside_a_stance():
    labels = [*labelled((50, 99), kind="outer"), Label(WALK, "foot", 110, 199, type="none")]
    t = evaluate(walk((50, 99), (105, 130), (150, 150)), labels, CLIPS).total
    # within reach to 124, and from there because nothing must be found
    assert (t.found, t.right, t.intervals, t.intervals_right) == (50 + 26 + 1, 50, 3, 1)


def test_nothing_must_be_found_of_types_without_a_label_either():
    rows = found((WALK, "foot", "space", 10, 19), (WALK, "foot", "line", 60, 64), (WALK, "foot", "line", 90, 94))
    e = evaluate(rows, [*labelled((10, 19)), Label(WALK, "foot", 50, 69, type="none")], CLIPS)
    assert (e.of("foot", "space").precision, e.of("foot", "any").found, e.total.found) == (1, 5, 15)


def test_empties():
    nothing = found()
    e = evaluate(nothing, labelled((10, 19)), CLIPS)
    assert (e.total.recall, e.total.f1, e.total.labels, e.clips) == (0, 0, 1, 1) and math.isnan(e.total.precision)
    assert e.left.unnamed == ("foot",) and len(e.missed()) == 1
    e = evaluate(walk((10, 19)), [], CLIPS)
    assert (e.clips, e.left.clips, e.total.found) == (0, 2, 0) and math.isnan(e.total.f1)
    e = evaluate(nothing, {"clip": [], "object": []}, {"clip": [], "frames": [], "fps": []})
    assert (e.clips, e.total.labels) == (0, 0) and "0 clips" in str(e) and json.loads(e.to_json())["scores"][-1]["f1"] is None


# frames by brute force ------------------------------------------------------------------------------------------------

SPANS = st.lists(st.tuples(st.integers(0, 59), st.integers(0, 15)), max_size=5).map(
    lambda s: [(b, min(b + n, 59)) for b, n in s]
)
SMALL = {"clip": [WALK], "frames": [60], "fps": [20.0]}


@settings(max_examples=300)
@given(SPANS, SPANS, SPANS)
def test_exact_frames_by_brute_force(spans, wanted, unknown):
    e = evaluate(walk(*spans), [*labelled(*wanted), *labelled(*unknown, kind="unknown")], SMALL)
    tally = {"found": 0, "right": 0, "wanted": 0, "hit": 0}
    for f in range(60 if wanted else 0):
        inside = [any(b <= f <= e for b, e in group) for group in (spans, wanted, unknown)]
        if inside[2]:
            continue
        for name, counts in zip(tally, (inside[0], all(inside[:2]), inside[1], all(inside[:2])), strict=True):
            tally[name] += counts
    assert {n: getattr(e.total, n) for n in tally} == tally
    assert same(e.total.f1, 2 * tally["hit"] / (tally["found"] + tally["wanted"]) if sum(tally.values()) else math.nan)


@settings(max_examples=300)
@given(SPANS, SPANS, SPANS, st.sampled_from([0.0, 0.1, 0.25]), st.sampled_from([(0.25, 0.55), (0, 1), (0.5, 0.6)]))
def test_outer_frames_by_brute_force(spans, bounds, unknown, reach, part):
    labels = [*labelled(*bounds, kind="outer"), *labelled(*unknown, kind="unknown")]
    total = evaluate(walk(*spans), labels, SMALL, reach=reach, core=part).total
    on = [any(b <= f <= e for b, e in spans) for f in range(60)]
    known = [not any(b <= f <= e for b, e in unknown) for f in range(60)]
    stances = [(int(b), int(e)) for b, e in merged(np.array(bounds))]
    contact = [any(b <= f <= e for b, e in stances) for f in range(60)]
    tally = dict.fromkeys(("found", "right", "wanted", "hit", "whole", "whole_hit"), 0)
    for b, e in stances:
        for f in range(60):
            if not known[f]:
                continue
            if b - round(reach * 20) <= f <= e + round(reach * 20):
                tally["found"] += on[f]
                tally["right"] += on[f] and contact[f]
            if b <= f <= e:
                tally["whole"] += 1
                tally["whole_hit"] += on[f]
                if part[0] - 1e-9 <= (f - b) / (e - b + 1) < part[1] - 1e-9:
                    tally["wanted"] += 1
                    tally["hit"] += on[f]
    assert {n: getattr(total, n) for n in tally} == tally


DISJOINT = st.lists(st.tuples(st.integers(0, 5), st.integers(1, 9)), max_size=5)


def chained(pieces):
    """Disjoint spans from gaps and lengths."""
    out, at = [], 0
    for gap, length in pieces:
        out.append((at + gap, at + gap + length - 1))
        at += gap + length
    return np.array(out, int).reshape(-1, 2)


@settings(max_examples=300)
@given(DISJOINT, DISJOINT, st.sampled_from([0.0, 0.2, 0.5, 0.9]))
def test_matching_is_the_best_of_all(first, second, iou):
    a, b = chained(first), chained(second)

    def share(i, j):
        x, y = (set(range(s[0], s[1] + 1)) for s in (a[i], b[j]))
        return len(x & y) / len(x | y)

    good = {(i, j): share(i, j) for i in range(len(a)) for j in range(len(b)) if share(i, j) > 0 and share(i, j) >= iou - 1e-9}
    best = (0, 0.0)
    for picks in itertools.product([None, *range(len(b))], repeat=len(a)):
        pairs = [(i, j) for i, j in enumerate(picks) if j is not None]
        if len({j for _, j in pairs}) == len(pairs) and all(p in good for p in pairs):
            best = max(best, (len(pairs), sum(good[p] for p in pairs)))
    found_pairs = matched(a, b, iou)
    assert (len(found_pairs), sum(good[p] for p in found_pairs)) == (best[0], pytest.approx(best[1]))
    assert len({i for i, _ in found_pairs}) == len({j for _, j in found_pairs}) == len(found_pairs)


@given(SPANS, st.sampled_from([-1, 0, 3]))
def test_merged_spans_cover_the_same_frames(spans, gap):
    out = merged(np.array(spans), gap)
    assert (out[1:, 0] - out[:-1, 1] - 1 > gap).all() and (out[:, 0] <= out[:, 1]).all()
    if gap <= 0:
        assert np.array_equal(frames_in(out, 60), frames_in(np.array(spans), 60))
        assert gap < 0 or np.array_equal(runs(frames_in(out, 60)), out)


def test_core_of_a_span():
    assert core(50, 149, (0.25, 0.55)) == (75, 105) and core(0, 57, (0.25, 0.55)) == (15, 32)
    assert core(5, 5, (0.25, 0.55)) == (6, 6) and core(5, 14, (0, 1)) == (5, 15)


def test_frames_of_another_stance_are_right_within_reach():
    known = np.zeros(100, int)
    known[20:40] = known[45:60] = 1
    one = against_bounds(known > 0, 20, 39, known, 100.0, reach=0.1)
    assert (one.found, one.right) == (20 + 5, 25)


# names, times, clips --------------------------------------------------------------------------------------------------


def test_seconds_become_the_clips_own_frames():
    """0.2 s to 0.38 s: frames 20..38 at 100 a second, 10..19 at 50."""
    labels = [Label(c, "foot", begin_s=0.2, end_s=0.38, type="space") for c in ("walk.bvh", "run.bvh")]
    e = evaluate(found((WALK, "foot", "space", 20, 38), (RUN, "foot", "space", 10, 19)), labels, CLIPS)
    assert [(x.clip, x.begin, x.end) for x in e.labels] == [(WALK, 20, 38), (RUN, 10, 19)]
    assert (e.total.f1, e.total.clips, e.total.wanted) == (1, 2, 29)
    assert evaluate(walk((20, 38)), labels, CLIPS, weigh="seconds").total.wanted == pytest.approx(0.19 + 0.20)
    assert Label("a", "b", begin_s=0.025, end_s=0.0349).span(100.0) == (3, 3)  # half-way: the later frame
    assert Label("a", "b", 5, 9, begin_s=1.0, end_s=2.0).span(10.0) == (10, 20)


def test_errors_of_different_rates_are_milliseconds():
    labels = [Label("walk.bvh", "foot", 20, 39), Label("run.bvh", "foot", 20, 39)]
    e = evaluate(found((WALK, "foot", "space", 21, 38), (RUN, "foot", "space", 21, 38)), labels, CLIPS)
    assert e.total.begin_errors == pytest.approx((10, 20)) and e.total.end_errors == pytest.approx((-10, -20))


def test_a_label_may_name_a_role_or_a_joint():
    rows = found((WALK, "LeftFoot", "space", 10, 19, "left_foot"), (RUN, "lfoot", "space", 10, 19, "left_foot"))
    labels = [Label("walk", "leftfoot", 10, 19), Label("run", "left_foot", 10, 19)]
    assert evaluate(rows, labels, CLIPS).total.f1 == 1
    both = [Label("walk", "LeftFoot", 10, 19), Label("walk", "left_foot", 40, 49)]
    with pytest.raises(OptionError, match="one object as 'LeftFoot' and 'left_foot'"):
        evaluate(rows, both, CLIPS)
    e = evaluate(rows, [Label("walk", "LeftFoot", 10, 19), Label("walk", "LeftFott", 10, 19)], CLIPS)
    assert e.left.unnamed == ("LeftFott",) and "LeftFott" in str(e)


def test_objects_are_chosen_by_the_labels_names():
    rows = found((WALK, "foot", "space", 10, 19), (WALK, "hand", "space", 0, 99))
    labels = [*labelled((10, 19)), *labelled((150, 159), object="hand")]
    e = evaluate(rows, labels, CLIPS, objects=["FOOT"])
    assert (e.total.f1, e.left.constraints) == (1, 1)
    with pytest.raises(UnknownNameError, match="nearest: foot"):
        evaluate(rows, labels, CLIPS, objects=["foo"])


def test_clips_by_id_path_file_name_and_stem():
    ids = ["data/a/walk.bvh", "data/b/walk.bvh", "data/b/run.v2.bvh", "run.bvh"]
    names = ["data/a/walk.bvh", "b/walk.bvh", "run.v2", "run", "run.bvh", "b/run.v2", "none"]
    assert list(clip_indices(iter(names), ids).values()) == [0, 1, 2, 3, 3, 2, None]
    for name in ("walk.bvh", "walk"):
        with pytest.raises(OptionError, match=r"any of 2: data/a/walk\.bvh, data/b/walk\.bvh"):
            clip_indices([name], ids)
    with pytest.raises(OptionError, match="twice"):
        clip_indices([], ["a", "b", "a"])


def test_what_is_left_out_is_told():
    rows = found((WALK, "foot", "space", 10, 19), (WALK, "hand", "space", 10, 19), (RUN, "foot", "space", 10, 19))
    labels = [
        *labelled((10, 19), (190, 300), (400, 500)), Label("jump.bvh", "foot", 1, 2), Label("jump.bvh", "foot", 4, 5),
    ]  # fmt: skip
    e = evaluate(rows, labels, CLIPS)
    left = e.left
    assert (left.clips, left.labels, left.constraints, left.cut, left.outside) == (1, (("jump.bvh", 2),), 1, 1, 1)
    assert [(x.begin, x.end) for x in e.labels] == [(10, 19), (190, 199)]
    text = str(e)
    for words in ("1 clip without labels", "2 labels of 1 clip that", "jump.bvh", "1 label cut", "1 label wholly outside"):
        assert words in text
    record = json.loads(e.to_json(labels=True))
    assert record["left_out"]["labels"] == [["jump.bvh", 2]] and len(record["labels"]) == 2
    assert record["schema"] == "kinjax-evaluation/1" and record["labels"][1]["begin_ms"] is None


def test_tables_of_arrow_numpy_and_lists_are_the_same():
    rows = found((WALK, "LeftFoot", "space", 10, 19, "left_foot"), (WALK, "hand", "line", 5, 8))
    labels = {
        "clip": [WALK] * 2, "object": ["left_foot", "hand"], "type": ["", None], "begin": [10, math.nan], "end": [25, None],
        "begin_s": [None, 0.05], "end_s": [math.nan, 0.08], "comment": ["ignored", "too"],
    }  # fmt: skip
    first = evaluate(rows, labels, CLIPS)
    assert (first.of("left_foot").recall, first.of("hand").f1) == (10 / 16, 1)
    arrow = evaluate(pa.table(rows), pa.table({k: pa.array(v, from_pandas=True) for k, v in labels.items()}), pa.table(CLIPS))
    arrays = {k: np.array(v, object if k == "role" else None) for k, v in rows.items()}
    assert arrow == first == evaluate(arrays, labels_of(labels), {k: np.array(v) for k, v in CLIPS.items()})


def test_annotations_can_be_evaluated_without_a_store():
    made = Annotations("walk.bvh", FPS, 200, Constraints((Constraint("foot", "space", 10, 19, (0, 0, 0), fps=FPS),)))
    other = Annotations("empty.bvh", FPS, 50, Constraints())
    rows, clips = from_annotations([made, other])
    e = evaluate(rows, [Label("walk", "foot", 10, 29), Label("empty", "foot", 10, 19)], clips)
    assert (e.total.precision, e.total.recall) == (1, 10 / 30)
    assert from_annotations([])[1]["clip"] == []


def test_the_table_has_a_row_a_score():
    rows = found((WALK, "foot", "space", 10, 19), (WALK, "foot", "line", 30, 39), (WALK, "hand", "space", 5, 8))
    labels = [*labelled((10, 19)), *labelled((30, 34), type="line"), *labelled((5, 8), object="hand")]
    e = evaluate(rows, labels, CLIPS)
    names = [(r["object"], r["type"]) for r in e.table()]
    assert names == [
        ("foot", "line"), ("foot", "space"), ("hand", "space"), ("foot", "all"), ("hand", "all"), ("all", "line"),
        ("all", "space"), ("all", "all"),
    ]  # fmt: skip
    lines = str(e).splitlines()
    # hand has one type and line one object: their totals are rows that are there already
    assert [line.split()[:2] for line in lines[2:-1]] == [
        ["foot", "line"], ["foot", "space"], ["hand", "space"], ["foot", "all"], ["all", "space"], ["all", "all"],
    ]  # fmt: skip
    assert "0.500" in lines[2] and "+0 [+0, +0]" in lines[3]
    one = str(evaluate(walk((10, 19)), labelled((10, 19)), CLIPS)).splitlines()
    assert len(one) == 2 + 1 + 1 and "1 clip without labels" in one[-1]  # a total would only say it again


# what cannot be -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"begin": 5}, "needs begin and end"),
        ({"begin": 5, "end": 9, "begin_s": 0.1}, "needs begin and end"),
        ({}, "needs begin and end"),
        ({"begin": 9, "end": 5}, "ends at 5"),
        ({"begin_s": 0.5, "end_s": 0.4}, "ends at 0.4"),
        ({"begin": 1.5, "end": 5}, "whole number"),
        ({"begin": math.nan, "end": 5}, "nan"),
        ({"begin_s": 0.0, "end_s": math.inf}, "inf"),
        ({"begin": True, "end": 5}, "True"),
        ({"begin": "1", "end": 5}, "must be a number"),
        ({"begin": 1, "end": 5, "type": "plane"}, "no type 'plane'"),
        ({"begin": 1, "end": 5, "kind": "inner"}, "no kind 'inner'"),
        ({"begin": 1, "end": 5, "object": " "}, "without object"),
        ({"begin": 1, "end": 5, "clip": None}, "without clip"),
    ],
)
def test_labels_that_cannot_be(values, words):
    with pytest.raises(OptionError, match=words):
        Label(**{"clip": "a", "object": "b", **values})


def test_labels_in_columns_are_numbered():
    with pytest.raises(OptionError, match="label 1: a label ends at 2"):
        labels_of({"clip": ["a", "a"], "object": ["b", "b"], "begin": [1, 5], "end": [1, 2]})
    with pytest.raises(OptionError, match="no column object"):
        labels_of({"clip": ["a"]})
    with pytest.raises(OptionError, match="sequence of Label"):
        labels_of(["walk"])
    with pytest.raises(ShapeError, match="clip 1, object 2"):
        labels_of({"clip": ["a"], "object": ["b", "c"]})
    assert labels_of(Label("a", "b", 1, 2)) == (Label("a", "b", 1, 2),)


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ([*labelled((1, 2)), *labelled((5, 9), kind="outer")], "exact labels and outer bounds"),
        ([*labelled((1, 2)), *labelled((5, 9), type="")], "with and without type"),
        ([*labelled((1, 5)), *labelled((5, 9), type="none")], "nothing must be found where"),
    ],
)
def test_labels_that_contradict_each_other(labels, words):
    with pytest.raises(OptionError, match=f"data/a/walk.bvh, foot: .*{words}"):
        evaluate(walk((1, 2)), labels, CLIPS)


@pytest.mark.parametrize("span", [(-1, 5), (5, 200), (9, 5), (1.5, 5), (math.nan, 5), (None, 5), ("a", 5)])
def test_constraints_that_cannot_be(span):
    with pytest.raises(OptionError, match="constraint"):
        evaluate(walk(span), labelled((1, 2)), CLIPS)


def test_tables_that_do_not_fit():
    with pytest.raises(OptionError, match=r"not in the table of clips: other\.bvh"):
        evaluate(found(("other.bvh", "foot", "space", 1, 2)), [], CLIPS)
    with pytest.raises(OptionError, match="no column end"):
        evaluate({"clip": [], "object": [], "type": [], "begin": []}, [], CLIPS)
    with pytest.raises(OptionError, match="no constraint type 'contact'"):
        evaluate(walk((1, 2), type="contact"), [], CLIPS)
    for frames, fps in ((0, 30.0), (10, 0.0), (10, math.nan), (None, 30.0)):
        with pytest.raises(OptionError, match="both must be positive"):
            evaluate(found(), [Label("a", "b", 1, 2)], {"clip": ["a"], "frames": [frames], "fps": [fps]})
    with pytest.raises(OptionError, match="no table"):
        evaluate(5, [], CLIPS)
    for bad in ({"reach": -1.0}, {"reach": math.inf}, {"join": math.nan}, {"iou": 1.5}, {"weigh": "clips"}):
        with pytest.raises(OptionError, match=next(iter(bad))):
            evaluate(found(), [], CLIPS, **bad)


# rules of thumb -------------------------------------------------------------------------------------------------------


def toe(*rests, frames=200, speed=1.5, rate=FPS):
    """A path that rests in the frames `begin <= f < end`, on the ground, and is 10 cm up elsewhere."""
    moving = np.ones(frames)
    for begin, end in rests:
        moving[begin:end] = 0
    return np.stack([np.cumsum(moving) * speed / rate, np.zeros(frames), 0.1 * moving], 1)


@pytest.mark.parametrize("name", RULES)
def test_rules_find_a_rest(name):
    (span,) = intervals(RULES[name](toe((50, 150)), FPS), FPS)
    assert abs(span[0] - 50) <= 1 and abs(span[1] - 149) <= 1


@pytest.mark.parametrize("name", RULES)
def test_rules_and_frames_that_are_not_seen(name):
    rule = RULES[name]
    assert not rule(np.full((30, 3), np.nan), FPS).any()
    path = toe((50, 150))
    path[90:120] = np.nan
    mask = rule(path, FPS)
    assert not mask[96:114].any() and mask[60:84].all() and mask[126:145].all()
    assert rule(np.zeros((1, 3)), FPS).shape == (1,) and not rule(np.zeros((1, 3)), FPS).any()
    assert rule(np.zeros((0, 3)), FPS).shape == (0,) and rule(np.zeros((5, 3)), FPS).all()
    with pytest.raises(ShapeError, match=r"\(frames, 3\)"):
        rule(np.zeros((5, 2)), FPS)
    with pytest.raises(OptionError, match="rate"):
        rule(np.zeros((5, 3)), 0.0)


def test_displacement_is_one_a_frame():
    """0.02 square centimetres: 1.414 mm a frame, whatever the rate, unless it is said what rate the limit was made for."""
    path = np.arange(100)[:, None] * np.array([0.0014, 0, 0])
    assert toe_displacement(path, 30.0).all() and not toe_displacement(path * 1.02, 30.0).any()
    assert toe_displacement(path, 60.0, made_for=60.0).all() and not toe_displacement(path, 120.0, made_for=60.0).any()


def test_the_vote_is_a_median_filter():
    from scipy.ndimage import median_filter

    rng = np.random.default_rng(0)
    for width in (1, 2, 5, 6):
        steps = np.where(rng.random((80, 1)) < 0.5, 0.05, 0.0001) * np.array([1, 0, 0])
        path = np.cumsum(steps, 0)
        slow = np.linalg.norm(np.diff(path, axis=0), axis=1) * FPS < 0.15
        slow = np.append(slow, slow[-1])
        expected = median_filter(slow.astype(np.uint8), size=width, mode="nearest") > 0
        assert np.array_equal(toe_speed(path, FPS, window=width / FPS), expected), width


def test_height_is_over_the_ground():
    path = toe((50, 150))
    raised = path + np.array([0, 0, 2.0])
    assert np.array_equal(speed_and_height(raised, FPS), speed_and_height(path, FPS))
    assert not speed_and_height(raised, FPS, ground=0.0).any()
    turned = raised[:, [0, 2, 1]]
    assert np.array_equal(speed_and_height(turned, FPS, up="y"), speed_and_height(path, FPS))
    still = np.zeros((100, 3))
    still[50:, 2] = 0.05  # stands a step higher: at rest, but not on the ground
    assert np.array_equal(np.flatnonzero(~speed_and_height(still, FPS)), np.arange(49, 100))
    with pytest.raises(OptionError, match="up"):
        speed_and_height(path, FPS, up="w")


@settings(max_examples=200)
@given(st.lists(st.booleans(), max_size=40), st.integers(0, 4), st.integers(0, 5))
def test_intervals_by_brute_force(values, fill, least):
    filled = list(values)
    for a in range(len(values)):
        for b in range(a + 1, len(values)):
            if values[a] and values[b] and b - a - 1 <= fill:
                filled[a:b] = [True] * (b - a)
    groups = []
    for key, group in itertools.groupby(enumerate(filled), key=lambda x: x[1]):
        frames = [f for f, _ in group]
        if key and len(frames) >= least:
            groups.append([frames[0], frames[-1]])
    assert intervals(np.array(values, bool), 10.0, least / 10, fill / 10).tolist() == groups


def test_intervals_refuse_what_makes_no_sense():
    for bad in ({"rate": 0.0}, {"rate": 10.0, "fill": -1.0}, {"rate": 10.0, "min_duration": math.nan}):
        with pytest.raises(OptionError):
            intervals(np.ones(3, bool), **bad)
