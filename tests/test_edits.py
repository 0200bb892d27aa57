"""Edit files: every key means what docs/edit-files.md says, wrong ones are refused with file and line, writing is read back."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinjax.deform import CenterOfMass, LookAt, Orientation, Position, Settings, Through
from kinjax.errors import FileFormatError, KinjaxError, UnknownNameError
from kinjax.formats.edits import parse_edit, read_edit, write_edit

EXAMPLE = """# an edit
clip = "walk.bvh"
unit = "cm"

[settings]
iterations = 20
filter_root = false
strategy = "weights"

[[position]]
joint = "LeftHand"
at = [10, 150, 20]
begin = 40
end = "1.5 s"
ease_in = 0.25
ease_out = "200 ms"
priority = 3
recruit_to = "Spine"

[[orientation]]
joint = "Head"
euler = [30, 0, 90]
order = "ZXY"

[[position]]
joint = "RightHand"
through = [{frame = 40, at = [1, 2, 3], until = "1 s"}, {frame = 130, at = [3, 2, 1], tension = 0.5}]
begin = 20
end = 180
name = "wave"

[[look_at]]
joint = "Head"
at = [0, 100, 200]
axis = [0, 0, 1]

[[center_of_mass]]
support = ["LeftFoot", "RightFoot"]
displacement = [{frame = 0, by = [0, 0, 0]}, {frame = "0.5 s", by = [5, 0, 0]}]
leg_length = 90
"""


def same(a: object, b: object) -> bool:
    """Equality of constraints that may hold arrays."""
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple | list | np.ndarray) and isinstance(b, tuple | list | np.ndarray):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b or bool(np.isscalar(a) and np.isclose(a, b, rtol=1e-15, atol=0))  # type: ignore[call-overload]


def test_an_example_means_what_it_says():
    edit = parse_edit(EXAMPLE)
    assert edit.clip == "walk.bvh"
    assert edit.settings == Settings(iterations=20, filter_root=None, strategy="weights")
    hand, head, wave, look, mass = edit.constraints(120)
    assert isinstance(hand, Position) and np.allclose(hand.at, (0.1, 1.5, 0.2))
    assert (hand.begin, hand.end, hand.ease_in, hand.ease_out) == (40, 180, 0.25, 0.2)
    assert (hand.priority, hand.recruit_to) == (3, "Spine")
    turn = Rotation.from_rotvec([0, 0, np.pi / 6]) * Rotation.from_rotvec([0, np.pi / 2, 0])  # Rz Rx Ry
    assert isinstance(head, Orientation) and np.allclose(head.at, np.roll(turn.as_quat(), 1))
    assert isinstance(wave, Position) and wave.name == "wave"
    assert [(p.frame, p.until, p.tension) for p in wave.through] == [(40, 120, None), (130, None, 0.5)]
    assert np.allclose(wave.through[0].at, (0.01, 0.02, 0.03))
    assert isinstance(look, LookAt) and np.allclose(look.at, (0, 1, 2)) and look.axis == (0, 0, 1)
    assert isinstance(mass, CenterOfMass) and mass.support == ("LeftFoot", "RightFoot")
    assert np.isclose(mass.leg_length, 0.9) and [k for k, _ in mass.displacement] == [0, 60]


@pytest.mark.parametrize(
    ("time", "rate", "frame"), [(1.5, 120, 180), (0.49, 10, 5), (0.25, 10, 3), (0.0, 30, 0), (1.2, 29.97, 36)]
)
def test_a_time_means_the_nearest_frame(time: float, rate: float, frame: int):
    edit = parse_edit(f'[[position]]\njoint = "Hips"\nbegin = "{time} s"')
    assert edit.constraints(rate)[0].begin == frame


@pytest.mark.parametrize("order", ["XYZ", "ZXY", "xyz", "yzx"])
def test_orders_are_those_of_scipy(order: str):
    edit = parse_edit(f'[[orientation]]\njoint = "a"\neuler = [10, 20, 30]\norder = "{order}"')
    at = edit.constraints(30)[0].at
    q = Rotation.from_euler(order, [10, 20, 30], degrees=True).as_quat()
    assert np.allclose(at, np.roll(q, 1))


def test_offsets_of_orientations_are_degrees():
    goal = parse_edit('unit = "cm"\n[[orientation]]\njoint = "a"\noffset_degrees = [90, 0, 0]').constraints(30)[0]
    assert np.allclose(goal.offset, (np.pi / 2, 0, 0))


def test_constraints_keep_the_order_of_the_file():
    text = (
        '[[look_at]]\njoint = "a"\nat = [0, 0, 0]\n[[position]]\njoint = "b"\n[[look_at]]\njoint = "c"\nat = [0, 0, 0]'
    )
    assert [g.joint for g in parse_edit(text).constraints(30)] == ["a", "b", "c"]


def test_no_constraints_are_an_edit():
    edit = parse_edit("")
    assert edit.constraints(30) == () and edit.settings == Settings() and edit.clip is None


HEAD = '# one\n[[position]]\njoint = "a"\n'  # the next line is 4


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ('[[position]]\njonit = "a"', 2, "nearest: joint"),
        ("[[position]]\nat = [0, 0, 0]", 1, "no joint"),
        (HEAD + "[[position]]\nat = [0, 0, 0]", 4, "[[position]] 2 has no joint"),
        (HEAD + "at = [0, 0]", 4, "3 numbers"),
        (HEAD + "at = [0, 0, true]", 4, "a number"),
        (HEAD + "at = [0, 0, nan]", 4, "a number"),
        (HEAD + "# at\nbegin = -1", 5, "whole number"),
        (HEAD + "begin = 1.5", 4, "whole number"),
        (HEAD + 'end = "soon"', 4, "1.5 s"),
        (HEAD + "ease_in = -1", 4, "from 0"),
        (HEAD + 'ease_in = "1 minute"', 4, "seconds"),
        (HEAD + "recruits = [1]", 4, "names"),
        (HEAD + "priority = true", 4, "number"),
        (HEAD + "offset_degrees = [0, 0, 0]", 4, "nearest: offset"),
        (HEAD + "through = [{fram = 1, at = [0, 0, 0]}]", 4, "nearest: frame"),
        (HEAD + "through = [{frame = 1}]", 4, "no at"),
        (HEAD + "through = [1]", 4, "tables"),
        (HEAD + "path = []", 4, "rows"),
        ('[[orientation]]\njoint = "a"\nat = [1, 1, 0, 0]', 3, "1.414"),
        ('[[orientation]]\njoint = "a"\nat = [1, 0, 0, 0]\neuler = [0, 0, 0]', 4, "both"),
        ('[[orientation]]\njoint = "a"\norder = "XYZ"', 3, "no euler"),
        ('[[orientation]]\njoint = "a"\neuler = [0, 0, 0]\norder = "XxZ"', 3, "order"),
        ("[position]\njoint = 'a'", 1, "write [[position]]"),
        ("[[positions]]\njoint = 'a'", 1, "nearest: position"),
        ('\nunit = "ell"', 2, "no unit"),
        ('unit = "auto"', 1, "infer"),
        ("[settings]\n\niteration = 3", 3, "nearest: iterations"),
        ("[settings]\niterations = 0", 2, "whole number"),
        ('[settings]\nstrategy = "luck"', 2, "priority, weights"),
        ("[settings]\nattract = 1", 2, "true or false"),
        ("[settings]\nclamp = true", 2, "no true or false"),
        ('[settings]\nclamp = "a"', 2, "positive"),
        ("settings = 3", 1, "[settings]"),
        ("a = 1\nb = = 2", 2, "no TOML"),
        ("a = [1", 1, "no TOML"),
        ("[[center_of_mass]]\ndisplacement = [{frame = 0}]", 2, "key frame"),
    ],
)
def test_what_is_wrong_is_refused_with_its_line(text: str, line: int, says: str, tmp_path: Path):
    path = tmp_path / "edit.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as error:
        read_edit(path)
    assert error.value.line == line and says in str(error.value), str(error.value)
    assert str(error.value).startswith(f"{path}:{line}")


def test_a_syntax_error_has_its_column():
    with pytest.raises(FileFormatError) as error:
        parse_edit("a = 1\nb = = 2")
    assert (error.value.line, error.value.column) == (2, 5)


def test_no_file_and_no_text(tmp_path: Path):
    with pytest.raises(FileFormatError, match="no such file"):
        read_edit(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"a = 1\nb = '\xff'")
    with pytest.raises(FileFormatError, match=r"binary.toml:2: .*UTF-8"):
        read_edit(tmp_path / "binary.toml")


def test_joints_are_checked_with_their_line(tmp_path: Path):
    path = tmp_path / "edit.toml"
    path.write_text('[[position]]\njoint = "Hips"\n\n[[look_at]]\njoint = "Hips"\nat = [0, 0, 1]\nrecruit_to = "Hipps"')
    edit = read_edit(path)
    assert len(edit.constraints(30)) == 2
    with pytest.raises(UnknownNameError, match=rf"{re.escape(str(path))}:4: no joint named 'Hipps' \(nearest: Hips\)"):
        edit.constraints(30, ["Hips", "Spine"])


@pytest.mark.parametrize("rate", [0, float("nan"), -1])
def test_a_rate_is_needed(rate: float):
    with pytest.raises(KinjaxError, match="rate"):
        parse_edit("").constraints(rate)


def test_nothing_that_an_edit_names_is_read(tmp_path: Path):
    assert parse_edit(f'clip = "{tmp_path}/missing.bvh"').clip == f"{tmp_path}/missing.bvh"


GOALS = (
    Position("Left \"Hand\"\n\\ü", at=(0.1, 1 / 3, -2e-7), begin=3, end=9, priority=2, weight=0.5, ease_in=0.0, ease_out=1.25),
    Position("a", through=(Through(4, (0, 1, 2)), Through(8, (1, 1, 1), 12, tension=0.5, bias=-0.1)), begin=2, end=20),
    Position("a", path=np.arange(9.0).reshape(3, 3) / 7, begin=2, end=4, axes="xz", point=np.array([0.1, 0, 0])),
    Position("a", offset=(0, 0.1, 0), recruits=("a", "b"), relative_to="c", name="tic"),
    Position("a"),
    Orientation("a", at=(0.6, 0.8, 0, 0), recruit_to="b"),
    Orientation("a", through=(Through(4, (0, 1, 0, 0), continuity=0.3),), begin=1, end=9),
    Orientation("a", offset=(0.1, -0.2, 1 / 3), axes="y"),
    LookAt("a", at=(1, 2, 3), axis=(0, 1, 0), point=(0, 0, 0.1)),
    CenterOfMass(support=("a", "b"), displacement=((0, (0.0, 0.0, 0.1)), (5, (0.1, 0.0, 0.0))), leg_length=0.9),
    CenterOfMass(displacement=(0.1, 0, 0)),
    CenterOfMass(offset=(0, -0.1, 0), weight=0),
)  # fmt: skip


@pytest.mark.parametrize("goals", [(g,) for g in GOALS] + [GOALS], ids=lambda g: str(len(g)))
def test_what_is_written_is_read_back(goals: tuple):
    settings = Settings(iterations=3, filter_root=None, filter_joints=8, precision="float32", attract=False)
    edit = parse_edit(write_edit(goals, settings, clip="w.bvh"))
    assert edit.settings == settings and edit.clip == "w.bvh"
    back = edit.constraints(30)
    assert len(back) == len(goals) and all(same(a, b) for a, b in zip(goals, back, strict=True))


def test_defaults_are_left_out():
    assert write_edit([Position("a")]) == '[[position]]\njoint = "a"\n'
    assert write_edit([]) == "\n"


def test_numbers_that_no_file_holds_are_refused():
    with pytest.raises(KinjaxError, match="finite"):
        write_edit([Position("a", at=(0, float("nan"), 0))])


def test_the_documented_example_is_an_edit():
    """docs/edit-files.md and README.md: their TOML is read, and every key is documented."""
    from kinjax.formats.edit_values import KINDS

    top = Path(__file__).parents[1]
    for name in ("docs/edit-files.md", "README.md"):
        blocks = re.findall(r"```toml\n(.*?)```", (top / name).read_text(encoding="utf-8"), re.S)
        assert blocks
        for block in blocks:
            assert parse_edit(block).constraints(120)
    text = (top / "docs/edit-files.md").read_text(encoding="utf-8")
    keys = {k for _, readers in KINDS.values() for k in readers} | {f.name for f in dataclasses.fields(Settings)}
    assert [k for k in sorted(keys) if f"`{k}`" not in text] == []
