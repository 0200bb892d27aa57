"""Deformation from constraints to a motion: what is promised of priorities, edits, bad frames, batches and compilations."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from deform_cases import FIGURE, NAMES, OFFSETS, standing

from kinjax.deform import (
    STATUSES,
    CenterOfMass,
    LookAt,
    Orientation,
    Position,
    Settings,
    Through,
    deform,
    deform_many,
    least_squares,
    redeform,
    solving,
)
from kinjax.deform.body import Body
from kinjax.deform.filtering import bridged, low_pass, roughness, taps
from kinjax.deform.pipeline import smoothed
from kinjax.deform.plan import make_plan
from kinjax.errors import KinjaxError, OptionError, ShapeError, UnknownNameError
from kinjax.motion import Motion
from kinjax.skeleton import Skeleton, Topology

FRAMES = 80
FEET = (Position("LeftFoot", priority=3), Position("RightFoot", priority=3))


def status(report, name: str) -> np.ndarray:
    """Where a report says `name`, (F, B)."""
    return report.status == STATUSES.index(name)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return standing(FRAMES, sway=0.15)


def reach(where=(0.25, 0.3, 1.2), priority=1.0, **more) -> Position:
    return Position("LeftHand", at=where, begin=30, end=50, priority=priority, **more)


@pytest.fixture(scope="module")
def reached(motion):
    return deform(motion, [*FEET, reach()])


def world(motion: Motion, joint: str) -> np.ndarray:
    """World path of a joint by SciPy rotations alone."""
    from scipy.spatial.transform import Rotation

    top = motion.skeleton.topology
    chain = []
    j = top.names.index(joint)
    while j >= 0:
        chain.append(j)
        j = top.parents[j]
    place, turn = np.array(motion.translations[:, 0]), Rotation.identity(motion.frames)
    for j in reversed(chain):
        if top.parents[j] >= 0:
            place = place + turn.apply(OFFSETS[j])
        turn = turn * Rotation.from_quat(np.asarray(motion.rotations[:, j])[:, [1, 2, 3, 0]])
    return place


def test_constraints_hold_and_the_rest_stays(motion, reached):
    """The hand arrives, the feet stay on their trajectories, and outside the eases the input is given back."""
    hand, foot = world(reached.motion, "LeftHand"), world(reached.motion, "LeftFoot")
    assert np.abs(hand[30:51] - [0.25, 0.3, 1.2]).max() < 1e-5
    assert np.abs(foot - world(motion, "LeftFoot")).max() < 1e-5
    far = np.r_[0:8, 73:80]
    assert np.abs(reached.motion.rotations[far] - motion.rotations[far]).max() < 1e-3
    assert (reached.report.status[:, :2] == STATUSES.index("converged")).all()
    assert (reached.report.status[:12, 2] == STATUSES.index("free")).all()
    assert np.array_equal(
        reached.motion.rotations[:, NAMES.index("RightHand")], motion.rotations[:, NAMES.index("RightHand")]
    )


def test_what_holds_already_gives_back_the_input(motion):
    """Constraints on the original trajectories change nothing."""
    d = deform(motion, [*FEET, Position("LeftHand", priority=1)])
    assert np.abs(d.motion.rotations - motion.rotations).max() < 1e-9
    assert np.abs(d.motion.translations - motion.translations).max() < 1e-9


def test_no_constraints_change_no_bit(motion):
    d = deform(motion, [])
    assert np.array_equal(d.motion.rotations, motion.rotations) and np.array_equal(
        d.motion.translations, motion.translations
    )
    assert "largest change" in str(d.report)


def test_report_tells_what_the_motion_shows(reached):
    hand = world(reached.motion, "LeftHand")
    own = np.linalg.norm(hand[30:51] - [0.25, 0.3, 1.2], axis=1)
    np.testing.assert_allclose(reached.report.residual[30:51, 2], own, atol=1e-12)
    row = reached.report.rows()[2]
    assert row["layer"] == 2 and row["frames"] == int(reached.report.active[:, 2].sum())


@pytest.mark.parametrize("numbers", [(3, 3, 1), (15, 15, 2), (0.5, 0.5, -7)])
def test_only_the_order_of_priorities_counts(motion, reached, numbers):
    d = deform(motion, [replace(c, priority=p) for c, p in zip([*FEET, reach()], numbers, strict=True)])
    assert np.array_equal(d.motion.rotations, reached.motion.rotations)


def test_priorities_of_the_paper_give_the_same_bits(motion):
    """(10, 2, 15) and (2, 1, 3), section 6."""
    goals = [Position("LeftFoot"), reach(), Position("RightFoot")]
    a, b = (
        deform(motion, [replace(g, priority=p) for g, p in zip(goals, ps, strict=True)])
        for ps in ((10, 2, 15), (2, 1, 3))
    )
    assert np.array_equal(a.motion.rotations, b.motion.rotations)
    assert np.array_equal(a.motion.translations, b.motion.translations)


def test_weight_zero_is_absence(motion, reached):
    off = Position("RightHand", at=(0.3, -0.3, 1.5), begin=10, end=60, weight=0.0)
    d = deform(motion, [off, *FEET, reach()])
    assert np.array_equal(d.motion.rotations, reached.motion.rotations)
    assert d.report.layer[0] == -1 and not d.report.active[:, 0].any()


def test_weights_share_what_priorities_decide(motion):
    """Two goals for one hand: strict layers give it to one, weights put it between (figure 4)."""
    a, b = np.array([0.3, 0.3, 1.2]), np.array([0.3, 0.3, 1.4])
    goals = [reach(a, priority=2), reach(b, priority=1, weight=3.0)]
    strict = world(deform(motion, goals).motion, "LeftHand")[40]
    assert np.linalg.norm(strict - a) < 1e-5
    mixed = world(deform(motion, goals, Settings(strategy="weights", iterations=30)).motion, "LeftHand")[40]
    np.testing.assert_allclose(mixed, (a + 3 * b) / 4, atol=2e-3)


def test_out_of_reach_is_a_status_not_an_error(motion):
    d = deform(motion, [*FEET, reach((1.5, 0.5, 1.2), ease_in=0.4, ease_out=0.4)])
    assert np.nanmax(d.report.residual[:, :2]) < 1e-5
    held = d.report.status[30:51, 2]
    assert set(held) <= {STATUSES.index(s) for s in ("unreachable", "conflict", "stalled", "max_iter")}
    assert d.report.residual[30:51, 2].min() > 1e-3 and d.report.residual[30:51, 2].max() > 0.05
    turn = np.linalg.norm(np.diff(d.motion.rotations[25:56], 2, axis=0), axis=-1).max()
    assert turn < 0.1  # it strains, it does not shake


def test_conflict_and_unreachable_are_told_apart(motion):
    """A hand that the feet hold back is in conflict; one that its few recruited joints cannot bring there is not."""
    d = deform(motion, [*FEET, reach((1.6, 0.3, 1.2))], Settings(iterations=40))
    alone = deform(motion, [reach((1.6, 0.3, 1.2), recruit_to="LeftArm")], Settings(iterations=40))
    assert status(d.report, "conflict")[40, 2]
    assert status(alone.report, "unreachable")[40, 0]


def test_an_edit_reaches_no_earlier_frame(motion, reached):
    """Changing what happens from frame 50 on changes nothing before it, less ease-in and filter support."""
    settings = Settings()
    late = Position("RightHand", offset=(0.1, 0.0, 0.2), begin=60, end=65, priority=1)
    d = deform(motion, [*FEET, reach(), late])
    support = round(settings.filter_width * motion.rate)
    first = 60 - 18 - (support if d.report.passes > 1 or reached.report.passes > 1 else 0)
    assert np.array_equal(
        d.motion.rotations[:first, NAMES.index("RightArm")], motion.rotations[:first, NAMES.index("RightArm")]
    )
    assert np.abs(d.motion.rotations[:first] - reached.motion.rotations[:first]).max() < 1e-9


def counted(monkeypatch) -> list:
    """A list that grows with each call of the solver by the number of frames that it really solves."""
    calls = []
    whole = solving._solve
    monkeypatch.setattr(solving, "_solve", lambda *a, **k: (calls.append(int(a[-1])), whole(*a, **k))[1])
    return calls


def test_recompute_equals_a_full_run_and_does_less(monkeypatch):
    """One constraint of 400 frames is changed."""
    motion = standing(400, sway=0.15)
    before = [*FEET, reach(), Position("RightHand", offset=(0.0, 0.0, 0.2), begin=250, end=270)]
    after = [*FEET, reach(), Position("RightHand", offset=(0.0, 0.05, 0.25), begin=250, end=270)]
    first = deform(motion, before)
    full = deform(motion, after)
    calls = counted(monkeypatch)
    quick = redeform(first, motion, after)
    some = sum(calls)
    calls.clear()
    deform(motion, after)
    assert some <= 0.6 * sum(calls)
    for joint in ("LeftHand", "RightHand", "LeftFoot", "Head"):
        assert np.abs(world(quick.motion, joint) - world(full.motion, joint)).max() < 1e-6
    # a constraint less, and one more
    for goals in (before[:-1], [*before, Position("Head", offset=(0.02, 0.0, 0.0), begin=100, end=110)]):
        a, b = redeform(first, motion, goals), deform(motion, goals)
        assert np.abs(world(a.motion, "RightHand") - world(b.motion, "RightHand")).max() < 1e-6
        assert np.abs(world(a.motion, "Head") - world(b.motion, "Head")).max() < 1e-6


def test_a_bad_frame_touches_no_other(motion, reached):
    """Frames 20 to 22 are lost: they are flagged and given back as they are; the clip's other frames are solved as before."""
    q = np.array(motion.rotations)
    q[20:23, NAMES.index("LeftLeg")] = np.nan
    d = deform(replace(motion, rotations=q), [*FEET, reach()])
    assert status(d.report, "nonfinite")[20:23].any(1).all()
    others = np.r_[0:20, 23:80]
    assert not status(d.report, "nonfinite")[others].any()
    assert np.isfinite(d.motion.rotations[others]).all()
    assert np.abs(world(d.motion, "LeftHand")[30:51] - [0.25, 0.3, 1.2]).max() < 1e-5


@pytest.mark.parametrize("together", [None, True])
def test_clips_side_by_side(motion, reached, together):
    """Different lengths and places in one program: each as if alone; a clip of nothing but NaN spoils no other."""
    longer = standing(100, sway=0.1, at=(5.0, 0.0, 0.0))
    goals = [[*FEET, reach()], [*FEET, reach((5.25, 0.3, 1.2))], [*FEET, reach()]]
    lost = replace(motion, rotations=np.full_like(motion.rotations, np.nan))
    a, b, c = deform_many([motion, longer, lost], goals, together=together)
    assert np.abs(a.motion.rotations - reached.motion.rotations).max() < 1e-7
    assert np.abs(b.motion.rotations - deform(longer, goals[1]).motion.rotations).max() < 1e-7
    assert (c.report.status[c.report.active] == STATUSES.index("nonfinite")).all()


def test_a_kilometre_from_the_origin(motion, reached):
    away = replace(motion, translations=motion.translations + np.array([1000.0, -2000.0, 0.0]))
    goals = [*FEET, reach((1000.25, -1999.7, 1.2))]
    for precision, close in (("float64", 1e-7), ("float32", 2e-3)):
        d = deform(away, goals, Settings(precision=precision))
        here = deform(motion, [*FEET, reach()], Settings(precision=precision))
        assert np.abs(d.motion.rotations - here.motion.rotations).max() < close
    assert np.abs(world(d.motion, "LeftHand")[30:51] - [1000.25, -1999.7, 1.2]).max() < 2e-5


def test_second_clip_and_edit_compile_nothing(motion):
    """Another length, other numbers, another order of the same constraints: one program."""
    deform(motion, [*FEET, reach()])
    compiled = []
    with jax.log_compiles(True):
        import logging

        class Listener(logging.Handler):
            def emit(self, record):
                if "Compiling" in record.getMessage():
                    compiled.append(record.getMessage()[:80])

        loggers = [
            logging.getLogger(n) for n in ("jax._src.interpreters.pxla", "jax._src.dispatch", "jax._src.compiler")
        ]
        listener = Listener()
        for log in loggers:
            log.addHandler(listener)
        deform(
            standing(130, sway=0.2),
            [reach((0.2, 0.2, 1.3), priority=0), *FEET],
            Settings(iterations=7, filter_root=3.0),
        )
        for log in loggers:
            log.removeHandler(listener)
    assert compiled == []


def test_every_kind_together(motion):
    """Orientation, gaze, balance, relative position and a shape-constraint, in five layers."""
    goals = [
        Position("LeftFoot", priority=5),
        Orientation("LeftFoot", priority=5),
        Position("RightFoot", priority=5),
        CenterOfMass(priority=4, support=("LeftFoot", "RightFoot"), displacement=(0.02, 0.0, 0.0)),
        LookAt("Head", at=(2.0, 0.5, 1.5), begin=20, end=60, axis=(1, 0, 0), priority=3),
        Position(
            "LeftHand",
            through=(Through(30, (0.3, 0.3, 1.2), until=40), Through(50, (0.3, 0.2, 1.3))),
            begin=15,
            end=70,
            priority=2,
        ),
        Orientation("RightHand", offset=(0, 0, 0.4), begin=30, end=50, recruit_to="RightArm", priority=1),
    ]
    d = deform(motion, goals, Settings(iterations=15))
    assert status(d.report, "converged").sum(0)[:5].tolist() == d.report.active.sum(0)[:5].tolist()
    hand = world(d.motion, "LeftHand")
    assert np.abs(hand[30:41] - [0.3, 0.3, 1.2]).max() < 1e-4 and np.abs(hand[50] - [0.3, 0.2, 1.3]).max() < 1e-4
    assert np.nanmax(d.report.residual[:, 6]) < 1e-3


def test_relative_constraint_follows_its_frame(motion):
    """A hand held in the frame of the head, while the head is moved away."""
    goals = [Position("Head", offset=(0.1, 0.05, -0.05), begin=0, end=FRAMES - 1, priority=2),
             Position("LeftHand", relative_to="Head", recruit_to="LeftArm", priority=1)]  # fmt: skip
    d = deform(motion, goals)
    assert np.nanmax(d.report.residual) < 1e-5


def test_joint_limits_hold():
    """The elbow may not bend further than it is: the hand goes where the rest of the arm can bring it."""
    limits = np.tile([-7.0, 7.0], (len(NAMES), 3, 1))
    elbow = NAMES.index("LeftForeArm")
    limits[elbow] = [[-0.01, 0.01], [-0.01, 0.01], [-0.8, 0.0]]
    figure = replace(FIGURE, limits=limits)
    m = replace(standing(40), skeleton=figure)
    d = deform(m, [Position("LeftHand", offset=(-0.1, -0.25, 0.05), begin=10, end=30, recruit_to="LeftArm")])
    from scipy.spatial.transform import Rotation

    v = Rotation.from_quat(np.asarray(d.motion.rotations[:, elbow])[:, [1, 2, 3, 0]]).as_rotvec()
    assert (v >= limits[elbow, :, 0] - 1e-9).all() and (v <= limits[elbow, :, 1] + 1e-9).all()
    free = deform(
        standing(40), [Position("LeftHand", offset=(-0.1, -0.25, 0.05), begin=10, end=30, recruit_to="LeftArm")]
    )
    w = Rotation.from_quat(np.asarray(free.motion.rotations[:, elbow])[:, [1, 2, 3, 0]]).as_rotvec()
    assert (w < limits[elbow, :, 0]).any()  # without limits it would have bent further


def test_filter_smooths_what_jumps_and_constraints_hold_again(motion):
    """A path with a step in it: the root's displacement is smoothed, and the hand is where it was asked to be all the same."""
    path = world(motion, "LeftHand").copy()
    path[40:] += [0.06, 0.0, 0.04]
    goals = [*FEET, Position("LeftHand", path=path, priority=1)]
    raw = deform(motion, goals, Settings(filter_root=None))
    smooth = deform(motion, goals)
    assert raw.report.passes == 1 and smooth.report.passes > 1
    jerk = [
        np.abs(np.diff(d.motion.translations[:, 0] - motion.translations[:, 0], 2, axis=0)).max() for d in (raw, smooth)
    ]
    assert jerk[1] < 0.5 * jerk[0]
    assert np.nanmax(smooth.report.residual[:, :2]) < 2e-4 and np.nanmax(smooth.report.residual[:, 2]) < 1e-3


@pytest.mark.parametrize("lost", ["root", "rotation"])
def test_a_lost_frame_does_not_spread_through_the_filter(motion, lost):
    """What the filter sees of a lost frame is the displacement between its neighbours': they are as in the whole clip, up to the
    little that one frame tells, and the lost frame is as it was given."""
    path = world(motion, "LeftHand").copy()
    path[40:] += [0.06, 0.0, 0.04]
    goals = [*FEET, Position("LeftHand", path=path, priority=1)]
    settings = Settings(filter_joints=4.0)
    bad = replace(motion, rotations=motion.rotations.copy(), translations=motion.translations.copy())
    if lost == "root":
        bad.translations[36, 0] = np.nan
    else:
        bad.rotations[36, NAMES.index("Spine")] = np.nan
    whole, found = deform(motion, goals, settings), deform(bad, goals, settings)
    assert found.report.passes > 1 and whole.report.passes > 1
    others = np.arange(FRAMES) != 36
    for name in ("rotations", "translations"):
        given, out = (np.asarray(getattr(m, name)) for m in (bad, found.motion))
        np.testing.assert_array_equal(out[36], given[36])
        assert np.isfinite(out[others]).all()
        assert np.abs(out[others] - np.asarray(getattr(whole.motion, name))[others]).max() < 5e-3
    assert (status(found.report, "nonfinite").any(1) == ~others).all()


def test_the_filter_bridges_lost_frames_by_their_neighbours(motion):
    """The next pass starts at the filtered displacement, that of the lost frame interpolated."""
    from scipy.spatial.transform import Rotation

    bad = replace(motion, rotations=motion.rotations.copy())
    bad.rotations[36, NAMES.index("Spine")] = np.nan
    settings = Settings(filter_joints=4.0, rough=1e-9)
    plan = make_plan(bad, [reach()], settings)
    rng = np.random.default_rng(0)
    frames, n = plan.frames, plan.frames.rotations.shape[2]
    turns = Rotation.from_rotvec(rng.normal(size=(FRAMES, n, 3)).reshape(-1, 3) * 0.1)
    own = np.nan_to_num(np.moveaxis(frames.rotations, 1, 2), nan=0.5)
    turned = (turns * Rotation.from_quat(own.reshape(-1, 4)[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    root, rotations = frames.root + rng.normal(size=(FRAMES, 3)), np.moveaxis(turned.reshape(FRAMES, n, 4), 2, 1)
    root[36], rotations[36] = frames.root[36], frames.rotations[36]  # the frame loop gives back what it cannot solve
    solved = SimpleNamespace(root=root, rotations=rotations, sound=np.arange(FRAMES) != 36)
    got = smoothed(plan, solved, settings, float(motion.rate))
    np.testing.assert_array_equal(got.root[36], frames.root[36])
    np.testing.assert_array_equal(got.rotations[36], frames.rotations[36])
    fir, others = taps(4.0, settings.filter_width, float(motion.rate)), np.arange(FRAMES) != 36
    moved, turn = root - frames.root, turns.as_rotvec().reshape(FRAMES, n, 3).copy()
    moved[36], turn[36] = (moved[35] + moved[37]) / 2, (turn[35] + turn[37]) / 2
    np.testing.assert_allclose(got.root[others], (frames.root + low_pass(moved, fir))[others], atol=1e-12)
    expected = Rotation.from_rotvec(low_pass(turn, fir).reshape(-1, 3)) * Rotation.from_quat(own.reshape(-1, 4)[:, [1, 2, 3, 0]])
    given = np.moveaxis(got.rotations, 1, 2)[others].reshape(-1, 4)[:, [1, 2, 3, 0]]
    apart = Rotation.from_quat(given) * expected[np.repeat(others, n)].inv()
    assert apart.magnitude().max() < 1e-7


def test_bridges_are_straight_lines_between_known_frames():
    rng = np.random.default_rng(0)
    path, lost = rng.normal(size=(30, 2, 3)), rng.random(30) < 0.5
    lost[[0, 1, -1]] = True
    found, t = bridged(np.where(lost[:, None, None], np.nan, path), lost), np.arange(30)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(found[:, i, j], np.interp(t, t[~lost], path[~lost, i, j]), rtol=0, atol=1e-14)
    assert np.isnan(bridged(np.full((4, 3), np.nan), np.ones(4, bool))).all()
    assert bridged(path, np.zeros(30, bool)) is path


def test_fir_filter_keeps_what_is_slow():
    fir = taps(4.0, 0.25, 60.0)
    t = np.arange(200) / 60
    assert abs(fir.sum() - 1) < 1e-12 and np.allclose(fir, fir[::-1]) and len(fir) == 31
    slow, fast = np.sin(2 * np.pi * 0.5 * t), np.sin(2 * np.pi * 20 * t)
    assert np.abs(low_pass(slow, fir) - slow)[31:-31].max() < 0.01 and np.abs(low_pass(fast, fir))[31:-31].max() < 0.01
    assert roughness(slow[31:-31], fir) < 0.1 and roughness(fast, fir) > 0.5
    assert np.array_equal(low_pass(slow, taps(40.0, 0.25, 60.0)), slow)


@pytest.mark.parametrize("frames", [1, 2, 7, 200])
def test_fir_filter_leaves_a_straight_line_and_the_ends_where_they_are(frames):
    """Clips shorter than the filter, too: a map that still moves at the clip's end must not be slowed down there."""
    fir, rng = taps(4.0, 0.25, 60.0), np.random.default_rng(frames)
    line = np.arange(frames)[:, None] * [0.01, -0.02, 0.0] + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(low_pass(line, fir), line, atol=1e-12)
    path = rng.normal(size=(frames, 3))
    np.testing.assert_allclose(low_pass(path, fir)[[0, -1]], path[[0, -1]], atol=1e-12)


@pytest.mark.parametrize(
    "goal, error, words",
    [
        (Position("LeftHnad"), UnknownNameError, "LeftHand"),
        (Position("LeftHand", at=(1, 2)), ShapeError, "3 finite numbers"),
        (Position("LeftHand", at=(1, 2, np.nan)), ShapeError, "finite"),
        (Position("LeftHand", path=np.zeros((3, 3))), ShapeError, "(80, 3)"),
        (Position("LeftHand", begin=10, end=90), OptionError, "0..79"),
        (Position("LeftHand", begin=20, end=10), OptionError, "20..10"),
        (Position("LeftHand", begin=1.5), OptionError, "frame number"),
        (Position("LeftHand", at=(0, 0, 0), offset=(0, 0, 1)), OptionError, "at and offset"),
        (Position("LeftHand", axes="xx"), OptionError, "each once"),
        (Position("LeftHand", relative_to="Tail"), UnknownNameError, "Tail"),
        (Position("LeftHand", relative_to="LeftHand"), OptionError, "itself"),
        (Position("LeftHand", recruit_to="RightArm"), OptionError, "root"),
        (Position("LeftHand", recruits=()), OptionError, "empty"),
        (Position("LeftHand", weight=-1.0), OptionError, "negative"),
        (Position("LeftHand", priority=float("nan")), OptionError, "finite"),
        (Position("LeftHand", ease_in=0.1), OptionError, "ease"),
        (Position("LeftHand", through=(Through(90, (0, 0, 1)),)), OptionError, "outside"),
        (
            Position("LeftHand", through=(Through(10, (0, 0, 1), until=20), Through(15, (0, 0, 1)))),
            OptionError,
            "overlap",
        ),
        (Orientation("LeftHand", at=(2, 0, 0, 0)), ShapeError, "unit"),
        (LookAt("Head"), OptionError, "look at"),
        (LookAt("Head", at=(1, 1, 1), axis=(0, 0, 0)), ShapeError, "zero"),
        (CenterOfMass(recruit_to="Spine"), OptionError, "recruits"),
        (CenterOfMass(support=("LeftFoot",), at=(0, 0, 1)), OptionError, "support"),
        (CenterOfMass(support="LeftFoot"), OptionError, "one name"),
        (CenterOfMass(displacement=[]), OptionError, "displacement"),
        (CenterOfMass(displacement=0.1), OptionError, "displacement"),
        (Position("Head", path="abc"), ShapeError, "array"),
        (Position("Head", path=[[1, 2, 3], [1, 2]], begin=0, end=1), ShapeError, "array"),
        (Position("Head", through=Through(3, (0, 1, 0))), OptionError, "tuple of Through"),
        (Position("Head", at=(0, 0, 1), ease_in="x"), OptionError, "ease_in"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_errors_say_what_and_where(motion, goal, error, words):
    with pytest.raises(error) as caught:
        deform(motion, [replace(goal, name="my goal")])
    assert "my goal" in str(caught.value) and words in str(caught.value)


def test_what_is_no_list_of_constraints_is_refused(motion):
    with pytest.raises(OptionError, match="list"):
        deform(motion, Position("Head"))
    with pytest.raises(OptionError, match="a str is no constraint"):
        deform(motion, ["x"])
    deform(motion, [replace(FEET[0], priority=np.int64(2))])


def test_another_skeleton_is_solved_anew(motion, reached):
    """The same rotations on longer bones: nothing of the earlier run is taken over."""
    big = replace(motion, skeleton=replace(FIGURE, offsets=1.1 * OFFSETS))
    goals = [*FEET, reach()]
    assert np.abs(redeform(reached, big, goals).motion.rotations - deform(big, goals).motion.rotations).max() < 1e-9


def test_recruiting_rule_names_both_and_the_joints(motion):
    """Equation 2: a whole-chain hand below an arm-only one would move it behind its back."""
    goals = [
        Position("LeftHand", priority=2, recruit_to="LeftArm"),
        Position("LeftForeArm", offset=(0, 0, 0.1), priority=1),
    ]
    with pytest.raises(OptionError, match=r"2 position LeftForeArm .* Hips, Spine.* 1 position LeftHand"):
        deform(motion, goals)
    deform(motion, [goals[0], replace(goals[1], priority=2.0)])  # one layer: no rule
    apart = [replace(goals[0], begin=0, end=20), replace(goals[1], begin=60, end=70)]
    deform(motion, apart)  # never together: no rule


@pytest.mark.parametrize(
    "bad", [{"iterations": 0}, {"strategy": "best"}, {"clamp": -1.0}, {"held": float("nan")}, {"passes": 1.5}]
)
def test_settings_are_checked(bad):
    with pytest.raises(KinjaxError, match=next(iter(bad))):
        Settings(**bad)


def test_one_frame(motion):
    d = deform(
        motion.slice(5, 5), [*FEET, Position("LeftHand", at=(0.3, 0.3, 1.2), priority=1)], Settings(iterations=40)
    )
    assert d.motion.frames == 1 and np.nanmax(d.report.residual) < 1e-5


def test_batches_and_other_roots_are_refused(motion):
    with pytest.raises(ShapeError, match="deform_many"):
        deform(replace(motion, rotations=np.asarray(motion.rotations)[None]), [])
    with pytest.raises(OptionError, match="one list for each motion"):
        deform_many([motion], [])


def test_progress_counts_to_the_end(motion):
    seen = []
    deform(motion, [*FEET, reach()], progress=lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] and all(a <= b for a, b in seen)


def test_weighted_least_squares_agrees_where_all_can_be_had(motion, reached):
    """Optimistix on the same problem: the same places where nothing conflicts; where the hand is out of reach, it pulls at the
    feet, and the less the larger the weight between the layers."""
    d = least_squares(motion, [*FEET, reach()], Settings(iterations=30))
    assert np.abs(world(d.motion, "LeftHand")[30:51] - [0.25, 0.3, 1.2]).max() < 1e-4
    assert np.nanmax(d.report.residual[:, :2]) < 1e-4
    far = [*FEET, reach((1.5, 0.5, 1.2), ease_in=0.4, ease_out=0.4)]
    feet = [
        np.nanmax(least_squares(motion, far, Settings(iterations=40), ratio=r).report.residual[:, :2])
        for r in (1.0, 100.0)
    ]
    assert feet[0] > 5e-3 > 10 * feet[1]
    assert np.nanmax(deform(motion, far).report.residual[:, :2]) < 1e-5


def test_mass_in_another_tree_counts_and_is_moved_by_the_input_alone():
    """A heavy ball beside the figure is part of the centre of mass that is asked for, and flies as it did."""
    frames, ball = 40, len(NAMES)
    figure, t = standing(frames, sway=0.1), np.arange(frames) / 60
    top = Topology((*NAMES, "Ball"), (*FIGURE.topology.parents, -1), translated=(0, ball), up="z")
    masses = np.r_[np.ones(ball), 8.0]
    skeleton = Skeleton(np.concatenate([OFFSETS, np.zeros((1, 3))]), np.zeros((0, 3)), top, masses, np.full((ball + 1, 3), 0.02))
    flight = np.stack([0.5 + t, 0 * t, 1 + np.sin(5 * t)], 1)
    spin = np.stack([np.cos(3 * t), 0 * t, np.sin(3 * t), 0 * t], 1)
    both = Motion(
        np.concatenate([figure.translations, flight[:, None]], 1),
        np.concatenate([figure.rotations, spin[:, None]], 1),
        skeleton,
        60.0,
    )
    goal = CenterOfMass(offset=(0.02, 0.0, 0.01), begin=20, recruits=NAMES)
    done = deform(both, [goal, Position("LeftFoot", priority=2)])
    assert np.nanmax(done.report.residual) < 1e-4
    for one, other in ((done.motion.rotations, both.rotations), (done.motion.translations, both.translations)):
        np.testing.assert_array_equal(one[:, -1], other[:, -1])
    before, after = (Body(m, np.zeros(3)).center() for m in (both, done.motion))
    np.testing.assert_allclose((after - before)[20:], np.tile([0.02, 0, 0.01], (20, 1)), atol=1e-4)


def accelerations(motion: Motion) -> np.ndarray:
    """(F - 2,) changes of the joints' turns from frame to frame, all joints together, by SciPy alone; mrad."""
    from scipy.spatial.transform import Rotation

    total = np.zeros(motion.frames - 2)
    for q in np.moveaxis(motion.rotations, 1, 0):
        turn = Rotation.from_quat(q, scalar_first=True)
        total += (np.diff((turn[1:] * turn[:-1].inv()).as_rotvec(), axis=0) ** 2).sum(1)
    return 1e3 * np.sqrt(total)


def test_a_limb_out_of_reach_neither_trembles_nor_falls_short():
    """A hand is led away beyond its reach, and half of the way back. It keeps within 1 % of the nearest place that it can
    have, and moves there as smoothly as a stretched limb does: an attraction that bends what the hand stretches again has
    twice the accelerations."""
    motion = standing(160, sway=0.1)
    way = np.array([1, -0.5, 1]) / 1.5
    path = world(motion, "RightHand") + 1.2 * np.sin(0.6 * np.pi * np.linspace(0, 1, 160))[:, None] * way
    goals = [*FEET, Position("RightHand", path=path, priority=1)]
    d = deform(motion, goals, Settings(filter_root=None))
    nearest = deform(motion, goals, Settings(filter_root=None, drag=0.0, iterations=60))
    error, least = d.report.residual[:, 2], nearest.report.residual[:, 2]
    assert least.max() > 0.19
    assert error.max() <= 1.01 * least.max()
    assert d.report.residual[:, :2].max() < 1e-5
    beyond = accelerations(d.motion)[error[1:-1] > 0.1 * error.max()]
    assert len(beyond) > 80
    assert beyond.max() < 25
    assert np.sqrt((beyond**2).mean()) < 8


def test_the_filter_does_not_brake_at_the_clips_ends():
    """A hand that is on its way when the clip begins, and later beyond its reach, so that the map is filtered: at the clip's begin
    the body goes on as it went (a filter that holds the map beyond the ends gives it 1.3 mrad a frame there)."""
    motion = standing(120)
    path = world(motion, "RightHand") + np.linspace(0, 1.2, 120)[:, None] * [0.8, -0.4, 0.4]
    goals = [*FEET, Position("RightHand", path=path, priority=1)]
    plain, filtered = (deform(motion, goals, Settings(filter_root=f, rough=1e-4)) for f in (None, 4.0))
    assert filtered.report.passes > plain.report.passes == 1
    assert accelerations(plain.motion)[:3].max() < 0.1
    assert accelerations(filtered.motion)[:3].max() < 0.4
