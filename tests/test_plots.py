"""Pictures: each is drawn without a warning, and what is drawn are the numbers of the detection."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest

from kinjax.annotations import TYPES, Annotations, Constraint, Constraints, NoisePattern, Template
from kinjax.detect.results import Detection, Segments
from kinjax.detect.settings import Settings


def fake_detection(
    objects=("LeftFoot", "RightFoot"), frames=240, rate=60.0, templates=True, types=("space",), gaps=True, seed=0
):
    """A walk's feet in numbers: half a second of stance, half of swing, each object half a second after another."""
    rng = np.random.default_rng(seed)
    names, count = tuple(objects), max(frames - 1, 0)
    middle = np.arange(count) + 0.5
    shape = (count, len(names))
    phase = (middle[:, None] / rate + 0.5 * np.arange(len(names))) % 1.0
    rests = phase < 0.5
    swing = np.sin(np.pi * np.clip((phase - 0.5) / 0.5, 0, 1))
    sigma_3 = np.abs(0.4 * rng.standard_normal(shape)) + 7 * swing
    eps_3 = np.abs(0.04 * rng.standard_normal(shape)) + 2.5 * swing
    eps_1 = 0.3 * eps_3 * rng.random(shape)
    valid = np.ones(shape, bool)
    if gaps and count > 40:
        valid[30:38] = False
        sigma_3[30:38] = eps_3[30:38] = eps_1[30:38] = np.nan
    template, patterns = np.zeros(shape, int), []
    sigma_max = {t: np.full(shape, 1.5) for t in types}
    eps_max = {t: np.full(shape, 0.15) for t in types}
    for k, name in enumerate(names):
        for t in types:
            given = (Template(name, 60, 95, t), Template(name, 180, 199, t)) if templates and frames > 200 else ()
            cuts = (60, 95, 180, 199) if given else ()
            sigmas = (1.5, 1.6, 2.2, 2.1) if given else (1.5,)
            epses = (0.15, 0.16, 0.24, 0.22) if given else (0.15,)
            if given:
                sigma_max[t][:, k] = np.interp(middle, cuts, sigmas)
                eps_max[t][:, k] = np.interp(middle, cuts, epses)
                for g in given:
                    inside = (middle > g.begin) & (middle < g.end)
                    template[inside, k] = np.where(sigma_3[inside, k] > 2.5, 2, 1)
            status = "ok" if given else "automatic"
            counts = (54, 52) if given else (0, 0)
            patterns.append(
                NoisePattern(name, t, sigmas, epses, cuts, 0.09, 0.01, *counts, status, given, "per_second")
            )
    first = types[0]
    passed = np.where(rests & valid & (sigma_3 <= sigma_max[first]) & (eps_3 <= eps_max[first]), 1, 0)
    rows = {"object": [], "type": [], "begin": [], "end": []}
    for k in range(len(names)):
        edges = np.flatnonzero(np.diff(np.r_[False, rests[:, k], False].astype(int))).reshape(-1, 2)
        for n, (a, b) in enumerate(edges):
            if b - a > 4:
                for key, value in zip(rows, (k, TYPES.index(types[n % len(types)]), a, b), strict=True):
                    rows[key].append(value)
    found = len(rows["object"])
    across, along = 0.2 * np.array(rows["object"], float), 0.02 * np.array(rows["begin"], float)
    position = np.stack([across, np.full(found, 0.05), along], axis=-1)
    axis = np.tile([1.0, 0.0, 0.0], (found, 1))
    columns = {k: np.array(v, int) for k, v in rows.items()}
    places = {"position": position.reshape(found, 3), "axis": axis.reshape(found, 3)}
    segments = Segments(**columns, **places, residual=np.full(found, 0.0021), pattern=np.zeros(found, int))
    return Detection(
        middle=middle, sigma_3=sigma_3, eps_3=eps_3, sigma_1=np.zeros(shape), eps_1=eps_1, valid=valid, passed=passed,
        template=template, sigma_max=sigma_max, eps_max=eps_max, missing=(~valid).sum(0),
        noise=np.full((len(names), 2), 1e-3), segments=segments,
        patterns=tuple(patterns), rate=rate, objects=names, frames=frames, clip="walk.bvh", unit="per_second",
        settings=Settings(types=types),
    )  # fmt: skip


def fake_walk(frames=240, rate=60.0):
    """Names, parents and positions (F, J, 3), y up, of a stick figure that walks along z."""
    names = ["Hips", "Spine", "Neck", "Head", "LeftHip", "LeftKnee", "LeftFoot", "RightHip", "RightKnee", "RightFoot",
             "LeftArm", "LeftHand", "RightArm", "RightHand"]  # fmt: skip
    parents = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 2, 10, 2, 12]
    rest = np.array([
        (0, 0.95, 0), (0, 1.2, 0), (0, 1.5, 0), (0, 1.7, 0.03), (0.1, 0.9, 0), (0.1, 0.5, 0), (0.1, 0.08, 0),
        (-0.1, 0.9, 0), (-0.1, 0.5, 0), (-0.1, 0.08, 0), (0.2, 1.45, 0), (0.3, 0.9, 0.1),
        (-0.2, 1.45, 0), (-0.3, 0.9, 0.1),
    ])  # fmt: skip
    t = np.arange(frames) / rate
    position = np.tile(rest, (frames, 1, 1))
    position[:, :, 2] += 1.2 * t[:, None]
    for j, side in ((5, 0.0), (6, 0.0), (8, np.pi), (9, np.pi), (13, 0.0), (11, np.pi)):
        position[:, j, 2] += (0.3 if j in (6, 9) else 0.15) * np.sin(2 * np.pi * t + side)
        position[:, j, 1] += 0.06 * np.maximum(0, np.cos(2 * np.pi * t + side))
    return tuple(names), tuple(parents), position


def drawn(figure):
    """Draws the figure, which must warn of nothing and leave no blank sheet."""
    out = io.BytesIO()
    figure.savefig(out, format="rgba", dpi=30)
    assert len(set(out.getvalue())) > 20


def texts(figure):
    """All texts of a figure and its axes."""
    return [t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text"))]


def by_label(ax):
    """Artists of the legend by the label's first word(s), without the count in brackets."""
    handles, labels = ax.get_legend_handles_labels()
    return {text.split(" (")[0]: h for text, h in zip(labels, handles, strict=True)}


@pytest.fixture(scope="module")
def plots():
    return pytest.importorskip("kinjax.plots")


def test_no_global_state(plots):
    import matplotlib

    def figures():
        """Those that pyplot holds, if it was ever asked for."""
        return sys.modules["matplotlib.pyplot"].get_fignums() if "matplotlib.pyplot" in sys.modules else []

    before = dict(matplotlib.rcParams), figures()
    drawn(plots.timeline(fake_detection()))
    assert (dict(matplotlib.rcParams), figures()) == before


def test_sigma_epsilon_draws_each_displacement_once_in_its_class(plots):
    d = fake_detection()
    figure = plots.sigma_epsilon(d, "leftfoot")
    overview, close_up = figure.axes
    for ax in (overview, close_up):
        parts = by_label(ax)
        points = {
            k: np.asarray(parts[k].get_offsets()) for k in ("none", "detected", "template, kept", "template, rejected")
        }
        assert sum(len(p) for p in points.values()) == d.valid[:, 0].sum()
        assert len(points["template, kept"]) == (d.template[:, 0] == 1).sum()
        rejected = d.template[:, 0] == 2
        assert rejected.any()
        np.testing.assert_allclose(
            points["template, rejected"], np.stack([d.sigma_3[rejected, 0], d.eps_3[rejected, 0]], axis=-1)
        )
    assert overview.get_xlabel().endswith("(rad/s)") and overview.get_ylabel().endswith("(m/s)")
    assert close_up.get_xlim()[1] == pytest.approx(2 * d.sigma_max["space"][:, 0].max())
    drawn(figure)


def test_threshold_lines_lie_at_the_thresholds(plots):
    constant = fake_detection(templates=False)
    for ax in plots.sigma_epsilon(constant, "LeftFoot").axes:
        upright = [x[0] for line in ax.lines if len(set(x := list(line.get_xdata()))) == 1]
        level = [y[0] for line in ax.lines if len(set(y := list(line.get_ydata()))) == 1]
        assert upright == [1.5] and level == [0.15]
    moving = fake_detection()
    ax = plots.sigma_epsilon(moving, "LeftFoot").axes[0]
    upright = [x[0] for line in ax.lines if len(set(x := list(line.get_xdata()))) == 1]
    assert upright == pytest.approx([moving.sigma_max["space"][:, 0].min(), moving.sigma_max["space"][:, 0].max()])


def test_units_follow_the_detection(plots):
    d = replace(fake_detection(), unit="per_interval")
    assert plots.sigma_epsilon(d, "LeftFoot").axes[0].get_xlabel() == "rotation σ₃ (rad)"
    assert plots.noise_pattern(d, "LeftFoot").axes[1].get_ylabel() == "residual ε₃ (m)"


def test_line_of_a_rigid_object_shows_rotation_not_rounding_noise(plots):
    d = fake_detection(types=("space", "line"))
    figure = plots.sigma_epsilon(d, "LeftFoot", "line")
    ax = figure.axes[0]
    assert ax.get_xlabel() == "rotation σ₃ (rad/s)" and ax.get_ylabel() == "residual ε₁ (m/s)"
    assert not [line for line in ax.lines if len(set(line.get_xdata())) == 1]  # no threshold on what does not decide
    scaled = replace(d, sigma_1=np.full_like(d.sigma_3, 0.2))
    assert plots.sigma_epsilon(scaled, "LeftFoot", "line").axes[0].get_xlabel() == "singular value σ₁ (rad/s)"
    drawn(figure)


def test_noise_pattern_draws_values_curves_templates_and_constraints(plots):
    d = fake_detection()
    figure = plots.noise_pattern(d, "LeftFoot")
    time = d.middle / d.rate
    for ax, values, limit in zip(figure.axes, (d.sigma_3, d.eps_3), (d.sigma_max, d.eps_max), strict=False):
        parts = by_label(ax)
        np.testing.assert_array_equal(
            parts["all displacements"].get_ydata(), values[:, 0]
        )  # NaN where nothing was seen
        curve = next(v for k, v in parts.items() if k.startswith("threshold"))
        np.testing.assert_array_equal(curve.get_xdata(), time)
        np.testing.assert_array_equal(curve.get_ydata(), limit["space"][:, 0])
        shaded = [p for p in ax.patches if p.get_height() == 1]
        spans = [(p.get_x() * d.rate, (p.get_x() + p.get_width()) * d.rate) for p in shaded]
        assert np.round(spans).astype(int).tolist() == [[60, 95], [180, 199]]
        assert len(parts["detected"].get_xdata()) == (d.passed[:, 0] == 1).sum()
        assert len(parts["control point"].get_xdata()) == 4
        bars = parts["space constraint"]
        assert len(bars.get_paths()) == len(d.constraints.of("LeftFoot", "space"))
    drawn(figure)


def test_templates_are_read_from_the_marks_where_no_pattern_names_them(plots):
    d = fake_detection()
    bare = replace(d, patterns=tuple(replace(p, templates=()) for p in d.patterns))
    ax = plots.noise_pattern(bare, "LeftFoot").axes[0]
    spans = [(p.get_x() * d.rate, (p.get_x() + p.get_width()) * d.rate) for p in ax.patches if p.get_height() == 1]
    assert np.round(spans).astype(int).tolist() == [[60, 95], [180, 199]]


@pytest.mark.parametrize("with_truth", [False, True])
def test_timeline_has_a_bar_a_constraint(plots, with_truth):
    d = fake_detection(("LeftFoot", "RightFoot", "Door"), types=TYPES)
    truth = fake_detection().constraints if with_truth else None
    figure = plots.timeline(d, truth)
    ax = figure.axes[0]
    bars = sum(len(c.get_paths()) for c in ax.collections)
    assert bars == len(d.constraints) + (len(truth) if with_truth else 0)
    assert [t.get_text() for t in ax.get_yticklabels()] == ["LeftFoot", "RightFoot", "Door"]
    first = next(c for c in d.constraints if c.object == "LeftFoot")
    corners = ax.collections[0].get_paths()[0].vertices
    assert corners[:, 0].min() * d.rate == pytest.approx(first.begin - 0.5)
    assert corners[:, 0].max() * d.rate == pytest.approx(first.end + 0.5)
    assert f"truth ({len(truth)})" in texts(figure) if with_truth else "space (6)" in texts(figure)
    drawn(figure)


def test_timeline_takes_annotations(plots):
    d = fake_detection()
    same = plots.timeline(Annotations(d.clip, d.rate, d.frames, d.constraints))
    assert sum(len(c.get_paths()) for c in same.axes[0].collections) == len(d.constraints)
    drawn(plots.timeline(Annotations("no rate", 0.0, 50, Constraints((Constraint("a", "space", 3, 9, (0, 0, 0)),)))))


def test_names_that_differ_in_case_keep_their_own_bars(plots):
    found = Constraints((Constraint("foot", "space", 3, 9, (0, 0, 0)), Constraint("FOOT", "space", 20, 30, (0, 0, 0))))
    ax = plots.timeline(Annotations("c", 30.0, 50, found)).axes[0]
    assert [len(c.get_paths()) for c in ax.collections] == [1, 1]


def test_local_against_global(plots):
    time = np.arange(50) / 25
    eps = np.abs(0.03 * np.sin(3 * time))
    figure = plots.local_against_global(time, eps, eps, 5 * eps + 0.1, 2 * eps, (-17.0, 0.0, 0.0))
    left, right = figure.axes
    assert "moved by 17 m" in texts(figure)
    np.testing.assert_array_equal(by_label(left)["where it was recorded"].get_ydata(), 5 * eps + 0.1)
    np.testing.assert_array_equal(by_label(right)["moved by 17 m"].get_ydata(), eps)
    assert left.get_ylim() == right.get_ylim() and right.get_title(loc="left").endswith("up to 0 m")
    drawn(figure)


def line_points(ax, colour):
    """Vertices of the collections of one colour in three-dimensional axes."""
    from matplotlib.colors import to_rgb

    edges = [(c, c.get_edgecolor()) for c in ax.collections]
    return [c for c, e in edges if len(e) and np.allclose(e[0][:3], to_rgb(colour), atol=1e-3)]


def test_skeleton_shows_active_constraints_in_green_and_up_axis_up(plots):
    from kinjax.plots.style import FOUND, INK, KEPT

    names, parents, position = fake_walk()
    d = fake_detection(types=("space", "line", "point"))
    figure = plots.skeleton_3d((names, parents, position), d, 70, trail=("LeftFoot",))
    (ax,) = figure.axes
    assert ax.get_zlabel() == "y (m)" and ax.get_xlabel() == "z (m)"
    (bones,) = [c for c in line_points(ax, INK) if len(getattr(c, "_segments3d", ())) == len(names) - 1]
    segments = np.asarray(bones._segments3d)
    np.testing.assert_allclose(segments[0], position[70, [0, 1]][:, [2, 0, 1]])
    active = [c for c in d.constraints if c.begin <= 70 <= c.end]
    assert [c.type for c in active] == ["line"] and line_points(ax, KEPT) and line_points(ax, FOUND)
    along = np.asarray(line_points(ax, KEPT)[0]._segments3d)[0]
    np.testing.assert_allclose(along.mean(0), np.array(active[0].position)[[2, 0, 1]])
    np.testing.assert_allclose(
        np.abs((along[1] - along[0]) / np.linalg.norm(along[1] - along[0])), [0, 1, 0], atol=1e-9
    )
    assert active[0].object in texts(figure)
    lengths = np.diff([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).ravel()
    scale = ax._box_aspect / lengths
    np.testing.assert_allclose(scale, scale[0])
    drawn(figure)


def test_skeleton_strip_and_resampled_constraints(plots):
    names, parents, position = fake_walk()
    figure = plots.skeleton_3d((names, parents, position), fake_detection(), [10, 60, 110], rate=60.0)
    assert len(figure.axes) == 3 and "frame 60, 1.00 s" in texts(figure)
    twice = Constraints((Constraint("LeftFoot", "space", 200, 240, tuple(position[110, 6]), fps=120.0),))
    assert "LeftFoot" in texts(plots.skeleton_3d((names, parents, position), twice, 110, rate=60.0))
    assert "LeftFoot" not in texts(plots.skeleton_3d((names, parents, position), twice, 210, rate=60.0))
    drawn(figure)


def test_many_active_constraints_name_eight(plots):
    names, parents, position = fake_walk()
    items = Constraints(tuple(Constraint(f"J{i}", "space", 0, 99, tuple(position[50, i % 14])) for i in range(31)))
    figure = plots.skeleton_3d((names, parents, position), items, 50)
    assert sum(t.startswith("J") for t in texts(figure)) == 8 and any("and 23 more" in t for t in texts(figure))
    drawn(figure)


def test_skeleton_of_a_motion_has_its_end_sites(plots):
    from kinjax import synthetic

    walk = synthetic.walking_biped()
    from kinjax.plots.scene import skeleton_positions

    names, parents, position = skeleton_positions(walk.motion)
    top = walk.motion.skeleton.topology
    assert len(names) == len(top.names) + len(top.end_parents) == len(parents)
    assert position.shape == (walk.frames, len(names), 3)
    reach = np.linalg.norm(position[:, len(top.names) :] - position[:, list(top.end_parents)], axis=-1)
    length = np.linalg.norm(walk.motion.skeleton.end_offsets, axis=-1)
    np.testing.assert_allclose(reach, np.broadcast_to(length, reach.shape), atol=1e-5)
    drawn(plots.skeleton_3d(walk.motion, walk.truth, 60))


def test_objects_are_boxes_of_their_own_rotation(plots):
    from kinjax.motion import make_poses
    from kinjax.plots.style import INK

    turn = np.radians(30)
    rotation = np.tile([np.cos(turn / 2), 0, np.sin(turn / 2), 0], (9, 2, 1))
    position = np.zeros((9, 2, 3))
    position[:, 1, 0] = np.linspace(0.5, 1, 9)
    position[4, 1] = np.nan
    poses = make_poses(("die a", "die b"), rotation, position, 30.0)
    figure = plots.objects_3d(poses, [Constraint("die a", "point", 0, 8, (0, -0.1, 0))], 2, edge=0.2)
    boxes = [np.asarray(c._segments3d) for c in line_points(figure.axes[0], INK)]
    assert len(boxes) == 2 and all(len(b) == 14 for b in boxes)
    corner = 0.1 * np.array([np.cos(turn) + np.sin(turn), 1.0, np.cos(turn) - np.sin(turn)])  # of (0.1, 0.1, 0.1)
    assert np.abs(boxes[0].reshape(-1, 3) - corner[[2, 0, 1]]).sum(-1).min() < 1e-9
    one = plots.objects_3d(poses, (), 4)
    assert len(line_points(one.axes[0], INK)) == 1  # the other was not seen
    for f in (figure, one, plots.objects_3d(poses, None)):
        drawn(f)


@pytest.mark.parametrize("frames", [1, 2])
def test_clips_with_next_to_nothing(plots, frames):
    d = fake_detection(("A",), frames=frames)
    for figure in (plots.timeline(d), plots.sigma_epsilon(d, "A"), plots.noise_pattern(d, "A")):
        drawn(figure)
    names, parents, position = fake_walk(frames)
    drawn(plots.skeleton_3d((names, parents, position), d))


def test_unseen_objects_and_bodies(plots):
    d = fake_detection()
    blind = replace(d, valid=np.zeros_like(d.valid), template=np.zeros_like(d.template))
    for draw in (plots.sigma_epsilon, plots.noise_pattern):
        figure = draw(blind, "LeftFoot")
        assert "no displacement was seen" in texts(figure)
        drawn(figure)
    names, parents, position = fake_walk()
    drawn(plots.skeleton_3d((names, parents, np.full_like(position, np.nan)), d, [1, 2]))
    partly = position.copy()
    partly[:, 3] = np.nan
    drawn(plots.skeleton_3d((names, parents, partly), d, 7, trail=("Head",)))


def test_motion_without_noise_and_all_at_rest(plots):
    d = fake_detection(gaps=False)
    still = replace(d, sigma_3=np.zeros_like(d.sigma_3), eps_3=np.zeros_like(d.eps_3), sigma_max={}, eps_max={})
    for draw in (plots.sigma_epsilon, plots.noise_pattern):
        drawn(draw(still, "LeftFoot"))


@pytest.mark.parametrize("name", [r"$\frac$ _a$b$", "x" * 300, "<足首>\n\udc80", ""])
def test_any_name_can_be_drawn(plots, name):
    d = fake_detection((name, "other"))
    names, parents, position = fake_walk()
    found = [Constraint(name, "space", 0, 50, tuple(position[9, 6]))]
    drawn(plots.timeline(d))
    drawn(plots.sigma_epsilon(d, name))
    drawn(plots.noise_pattern(d, name))
    drawn(plots.skeleton_3d((names, parents, position), found, 9))


def test_thirty_one_objects_and_more_than_forty(plots):
    many = fake_detection(tuple(f"Joint{i}" for i in range(31)))
    assert len(plots.timeline(many).axes[0].get_yticks()) == 31
    found = Constraints((Constraint("Joint3", "space", 3, 9, (0, 0, 0)),))
    crowd = Annotations(
        "c", 30.0, 50, found, tuple(NoisePattern(f"Joint{i}", "space", (1.0,), (1.0,)) for i in range(60))
    )
    figure = plots.timeline(crowd)
    assert len(figure.axes[0].get_yticks()) == 1 and "59 objects without constraints are not shown" in texts(figure)
    drawn(figure)


def test_axes_of_ones_own(plots):
    from matplotlib.figure import Figure

    d, figure = fake_detection(), Figure()
    axes = figure.subplots(2, 2).ravel()
    assert plots.sigma_epsilon(d, "LeftFoot", ax=axes[0]) is figure
    assert plots.noise_pattern(d, "LeftFoot", ax=axes[1:3]) is figure
    assert plots.timeline(d, ax=axes[3]) is figure
    drawn(figure)
    scene = Figure()
    ax = scene.add_subplot(projection="3d")
    assert plots.skeleton_3d(fake_walk(), d, 5, ax=ax) is scene
    drawn(scene)


def test_what_cannot_be_drawn_says_so(plots):
    from matplotlib.figure import Figure

    from kinjax.errors import OptionError, ShapeError, UnknownNameError

    d, (names, parents, position) = fake_detection(), fake_walk()
    with pytest.raises(UnknownNameError, match="LeftFoot"):
        plots.sigma_epsilon(d, "LeftFoo")
    with pytest.raises(OptionError, match="space, line, point"):
        plots.noise_pattern(d, "LeftFoot", "plane")
    with pytest.raises(OptionError, match=r"0\.\.239"):
        plots.skeleton_3d((names, parents, position), d, 240)
    with pytest.raises(ShapeError, match="14 names"):
        plots.skeleton_3d((names, parents, position[0]), d)
    with pytest.raises(OptionError, match="x, y, z"):
        plots.skeleton_3d((names, parents, position), d, up="w")
    with pytest.raises(OptionError, match="3 axes"):
        plots.sigma_epsilon(d, "LeftFoot", ax=Figure().subplots(3))
