"""Pictures of deformations: each is drawn without a warning, and what is drawn are the numbers of the deformation."""

import io
from dataclasses import replace

import numpy as np
import pytest

from kinjax.deform.results import CONFLICT, CONVERGED, FREE, Deformation, Report
from kinjax.errors import OptionError, ShapeError, UnknownNameError
from kinjax.motion import Motion
from kinjax.synthetic import walking_biped


def drawn(figure):
    """Draws the figure, which must warn of nothing and leave no blank sheet."""
    out = io.BytesIO()
    figure.savefig(out, format="rgba", dpi=30)
    assert len(set(out.getvalue())) > 20


def texts(figure):
    """All texts of a figure and its axes."""
    return [t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text"))]


@pytest.fixture(scope="module")
def plots():
    return pytest.importorskip("kinjax.plots")


@pytest.fixture(scope="module")
def walk():
    return walking_biped(rate=24.0).motion


def raised(motion: Motion, by: float) -> Motion:
    """The same, that much higher."""
    return replace(motion, translations=motion.translations + np.array([0.0, by, 0.0]))


def fake(motion: Motion, units=("m", "m", "rad")) -> Deformation:
    """A deformation in numbers: a constraint that holds, one that is not active for a while, one in conflict."""
    frames, count = motion.frames, len(units)
    residual = np.full((frames, count), 1e-6)
    status = np.full((frames, count), CONVERGED)
    residual[: frames // 2, 1], status[: frames // 2, 1] = np.nan, FREE
    residual[5:9, count - 1], status[5:9, count - 1] = 0.2, CONFLICT
    names = motion.skeleton.names
    report = Report(
        titles=tuple(f"goal {i}" for i in range(count)), unit=tuple(units), layer=tuple(range(count)), residual=residual,
        status=status, rank=np.ones((frames, count), int), iterations=np.ones(frames, int), joints=names,
        change=np.zeros((frames, len(names))), root_change=np.zeros(frames),
    )  # fmt: skip
    return Deformation(motion, report)


def bones(ax, count):
    """Segments (B, 2, 3) of the collections with a segment for each bone."""
    found = [np.asarray(c._segments3d) for c in ax.collections if hasattr(c, "_segments3d")]
    return [s for s in found if len(s) == count]


def test_side_by_side_draws_every_motion_and_the_reference_behind(plots, walk):
    from kinjax.plots.scene import skeleton_positions

    goal = [(0.3, 1.2, 1.0)]
    stairs = {"stairs": [(0, 0, 0), (0, 0, 1), (0, 0.3, 1), (0, 0.3, 2)]}
    figure = plots.side_by_side(
        {"bent": raised(walk, 0.2), "walk": walk},
        [20, 30],
        goals=goal,
        lines=stairs,
        trail=("LeftHand",),
        reference="walk",
    )
    assert len(figure.axes) == 4
    assert {"bent", "walk", "frame 20", "frame 30", "goal", "stairs", "path"} <= set(texts(figure))
    _, parents, position = skeleton_positions(walk)
    count = sum(p >= 0 for p in parents)
    both, alone = bones(figure.axes[0], count), bones(figure.axes[1], count)
    assert len(both) == 2 and len(alone) == 1
    child = next(i for i, p in enumerate(parents) if p >= 0)
    np.testing.assert_allclose(alone[0][0], position[20, [parents[child], child]][:, [2, 0, 1]], atol=1e-6)
    apart = np.ptp([b[..., 2].mean() for b in both])
    np.testing.assert_allclose(apart, 0.2, atol=1e-5)
    limits = [(a.get_xlim(), a.get_ylim(), a.get_zlim()) for a in figure.axes]
    assert limits[0] == limits[1] and limits[2] == limits[3]
    np.testing.assert_allclose(np.diff(limits[0]), np.diff(limits[2]))
    drawn(figure)


def test_more_frames_than_motions_are_columns(plots, walk):
    figure = plots.side_by_side({"walk": walk}, [5, 15, 25])
    left = [a.get_position().x0 for a in figure.axes]
    below = [a.get_position().y0 for a in figure.axes]
    assert (np.diff(left) > 0.1).all() and np.ptp(below) < 1e-9  # shares of the figure, to rounding
    assert figure.get_figwidth() > figure.get_figheight()
    drawn(figure)


def test_side_by_side_with_frames_that_are_not_finite(plots, walk):
    lost = replace(walk, rotations=np.array(walk.rotations))
    lost.rotations[10] = np.nan
    drawn(plots.side_by_side({"lost": lost, "walk": walk}, [10, 12], reference="lost", trail=("LeftFoot",)))
    drawn(plots.side_by_side({"lost": lost}, 10))


def test_side_by_side_refuses(plots, walk):
    other = replace(walk.skeleton.topology, names=tuple(n + "_" for n in walk.skeleton.names))
    stranger = replace(walk, skeleton=replace(walk.skeleton, topology=other))
    with pytest.raises(OptionError, match="no motion"):
        plots.side_by_side({}, 0)
    with pytest.raises(ShapeError, match="different skeletons"):
        plots.side_by_side({"a": walk, "b": stranger}, 0)
    with pytest.raises(OptionError, match="choose from a"):
        plots.side_by_side({"a": walk}, 0, reference="b")
    with pytest.raises(OptionError, match=r"inside the clips' 0\.\."):
        plots.side_by_side({"a": walk, "short": walk.slice(0, 5)}, 6)
    with pytest.raises(UnknownNameError, match="LeftFoot"):
        plots.side_by_side({"a": walk}, 0, trail=("LeftFoo",))


def test_residuals_are_drawn_in_their_units(plots, walk):
    d = fake(walk)
    figure = plots.residuals_over_time(d)
    far, turned = figure.axes[:2]
    assert far.get_ylabel() == "distance (mm)" and turned.get_ylabel() == "angle (deg)"
    first, _, second, _ = far.lines
    np.testing.assert_allclose(first.get_ydata(), 1e3 * d.report.residual[:, 0])
    assert np.isnan(second.get_ydata()[: walk.frames // 2]).all()
    _, thick = turned.lines
    assert np.flatnonzero(np.isfinite(thick.get_ydata())).tolist() == [5, 6, 7, 8]
    assert {"goal 0 (1)", "goal 1 (2)", "goal 2 (3)"} <= set(texts(figure))
    drawn(figure)


def test_residuals_of_one_unit_and_axes_of_ones_own(plots, walk):
    from matplotlib.figure import Figure

    one = fake(walk, ("m", "m"))
    assert len([a for a in plots.residuals_over_time(one).axes if a.get_ylabel()]) == 1
    figure = Figure()
    axes = figure.subplots(2, 1)
    assert plots.residuals_over_time(fake(walk), ax=axes) is figure
    drawn(figure)
    with pytest.raises(OptionError, match="2 kinds"):
        plots.residuals_over_time(fake(walk), ax=Figure().subplots())


def test_residuals_of_nothing(plots, walk):
    drawn(plots.residuals_over_time(fake(walk.slice(0, 0), ("m", "rad"))))
