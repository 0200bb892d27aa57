"""`kinjax deform` and `kinjax clean`: what they write, what they print, and what they say when the input is wrong."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kinjax.cli import main
from kinjax.cli.cache import EXTRA, FAST_LOOPS, plain_fusions, use_deform_flags
from kinjax.formats import load, save, write_annotations
from kinjax.formats.bvh_like import write_bvh_like
from kinjax.synthetic import walking_biped

EDIT = """unit = "cm"

[[position]]
joint = "RightHand"
name = "raise"
offset = [0, 35, 15]
begin = "0.9 s"
end = "1.2 s"
recruit_to = "Spine"
"""
BEGIN, END, EASE = 54, 72, 18  # frames of that edit, at 60 a second


@pytest.fixture(autouse=True)
def untouched(monkeypatch: pytest.MonkeyPatch):
    """No test touches the user's cache of compiled programs, or XLA's flags of other tests."""
    monkeypatch.setenv("KINJAX_CACHE", "off")
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """walk.bvh, its truth, edits, poses."""
    from kinjax.formats import write_poses_npz
    from kinjax.synthetic import hinge

    top = tmp_path_factory.mktemp("clips")
    scene = walking_biped(rate=60, steps=2)
    save(top / "walk.bvh", scene.motion)
    write_annotations(top / "truth.json", scene.annotations())
    write_poses_npz(top / "door.npz", hinge().poses)
    (top / "raise.toml").write_text(EDIT)
    (top / "nothing.toml").write_text("# no constraints\n")
    (top / "blanks.toml").write_text(" \n\t\n")
    (top / "bad.toml").write_text("[[position]]\njoint = 'RightHnad'\n")
    (top / "wrong.toml").write_text("[[position]]\njonit = 'RightHand'\n")
    (top / "far.toml").write_text("[[position]]\njoint = 'RightHand'\nend = 100000\n")
    return top


@pytest.fixture(scope="module")
def bent(folder: Path) -> Path:
    """out.bvh and report.json of the edit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KINJAX_CACHE", "off")
        args = ["-o", str(folder / "out.bvh"), "--report", str(folder / "report.json"), "--quiet"]
        assert main(["deform", str(folder / "walk.bvh"), str(folder / "raise.toml"), *args]) == 0
    return folder


def numbers(path: Path) -> tuple[str, np.ndarray]:
    """A BVH file's hierarchy, and its numbers as they stand."""
    head, motion = path.read_text().split("Frame Time:")
    return head, np.array([line.split() for line in motion.splitlines()[1:] if line], float)


def fails(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """Runs a command that must fail with one line; gives the line."""
    capsys.readouterr()
    assert main([str(a) for a in args]) == 2
    told = capsys.readouterr()
    assert told.out == "" and len(told.err.splitlines()) == 1 and told.err.startswith("kinjax: error: "), told.err
    return told.err


@pytest.mark.parametrize("command", ["deform", "clean"])
def test_help(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    out = capsys.readouterr().out
    assert stop.value.code == 0 and f"kinjax {command}" in out and "--iterations" in out and "None" not in out


@pytest.mark.parametrize("command", ["deform", "clean"])
def test_help_is_light(command: str):
    code = (
        f"import contextlib, sys\nfrom kinjax.cli import main\nwith contextlib.suppress(SystemExit):\n    main([{command!r}, '--help'])\n"
        "assert not {'jax', 'numpy', 'rich', 'scipy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)


def test_the_edit_is_done_and_what_it_leaves_alone_stays(bent: Path):
    before, after = load(bent / "walk.bvh"), load(bent / "out.bvh")
    (head0, n0), (head1, n1) = numbers(bent / "walk.bvh"), numbers(bent / "out.bvh")
    assert head0 == head1 and n0.shape == n1.shape and before.rate == after.rate
    still = np.ones(len(n0), bool)
    still[BEGIN - EASE : END + EASE + 1] = False
    assert np.array_equal(n0[still], n1[still])
    top = before.skeleton.topology
    arm = [j for j, n in enumerate(top.names) if n.startswith("Right") and "Arm" in n]
    changed = np.abs(np.asarray(before.rotations) - np.asarray(after.rotations)).max((0, 2)) > 1e-6
    assert changed[arm].all() and not changed[[top.index(n) for n in ("Hips", "LeftFoot", "RightHand", "Head")]].any()
    assert np.abs(np.diff(n1[:, 3:], axis=0)).max() < 60  # no angle jumps by a turn


def test_the_hand_is_where_it_was_sent(bent: Path):
    from kinjax.kinematics import object_poses

    a, b = (object_poses(load(bent / n), ["RightHand"], origin="joint").position[:, 0] for n in ("walk.bvh", "out.bvh"))
    assert np.allclose(np.asarray(b - a)[BEGIN : END + 1], (0, 0.35, 0.15), atol=2e-4)


def test_the_report_tells_every_frame(bent: Path):
    found = json.loads((bent / "report.json").read_text())
    assert found["schema"] == "kinjax-deformation/1" and found["clip"] == "walk.bvh"
    (row,) = found["constraints"]
    frames = list(range(BEGIN - EASE, END + EASE + 1))
    assert (row["name"], row["unit"], row["layer"], row["frames_active"]) == ("raise", "m", 1, frames)
    assert len(row["residuals"]) == len(row["statuses"]) == len(frames)
    assert row["largest"] == max(row["residuals"]) < 1e-4 and row["status"] == {"converged": len(frames)}
    assert found["change"]["joints"][found["change"]["joint"]] == found["change"]["largest"] > 0.1
    assert found["change"]["root"] == 0


@pytest.mark.parametrize("name", ["nothing", "blanks"])
def test_no_constraints_give_the_same_numbers(name: str, folder: Path, capsys: pytest.CaptureFixture[str]):
    nothing = str(folder / f"{name}.toml")
    assert main(["deform", str(folder / "walk.bvh"), nothing, "-o", str(folder / "same.bvh")]) == 0
    assert (folder / "same.bvh").read_bytes() == (folder / "walk.bvh").read_bytes()
    out = capsys.readouterr().out
    assert "constraint " in out and "same.bvh" in out


@pytest.mark.parametrize("name", ["cmu/01_01", "cmu/02_01", "exporters/cgspeed_01_01", "exporters/test_mocapbank"])
def test_angles_are_those_of_the_file_up_to_whole_turns(name: str, data: Path, tmp_path: Path):
    """Also where the file uses the other triple, or passes through a locked gimbal."""
    source = data / "bvh" / f"{name}.bvh"
    write_bvh_like(tmp_path / "a.bvh", load(source), source)
    (_, theirs), (_, own) = numbers(source), numbers(tmp_path / "a.bvh")
    turns = (own - theirs) / 360
    assert np.abs(turns - np.round(turns)).max() * 360 < 2e-6


def test_angles_follow_another_files_own_where_they_fit_no_more(folder: Path, tmp_path: Path):
    short = load(folder / "walk.bvh").slice(0, 9)
    write_bvh_like(tmp_path / "a.bvh", short, folder / "walk.bvh")  # another number of frames
    save(tmp_path / "b.bvh", short)
    assert (tmp_path / "a.bvh").read_bytes() == (tmp_path / "b.bvh").read_bytes()


def test_npz_goes_out_too(folder: Path, tmp_path: Path):
    out = tmp_path / "new" / "out.npz"
    assert main(["deform", str(folder / "walk.bvh"), str(folder / "nothing.toml"), "-o", str(out), "-q"]) == 0
    assert np.array_equal(load(out).rotations, load(folder / "walk.bvh").rotations)


def test_clean_keeps_what_was_found_earlier(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    args = [
        "--annotations",
        str(folder / "truth.json"),
        "--object",
        "leftfoot",
        "--type",
        "space",
        "-o",
        str(tmp_path / "c.bvh"),
    ]
    assert main(["clean", str(folder / "walk.bvh"), *args]) == 0
    out = capsys.readouterr().out
    assert "LeftFoot place" in out and "LeftFoot turn" in out and "RightFoot" not in out.split("largest change")[0]
    assert load(tmp_path / "c.bvh").frames == load(folder / "walk.bvh").frames


def test_clean_finds_planted_feet(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert (
        main(["clean", str(folder / "walk.bvh"), "-o", str(tmp_path / "c.bvh"), "--report", str(tmp_path / "r.json")])
        == 0
    )
    out = capsys.readouterr().out
    assert "looking at LeftFoot, RightFoot (feet, by name)" in out
    rows = json.loads((tmp_path / "r.json").read_text())["constraints"]
    assert len(rows) >= 6 and max(r["largest"] for r in rows) < 1e-3


@pytest.mark.parametrize("earlier", [False, True], ids=["found now", "found earlier"])
def test_clean_finds_at_another_rate_and_holds_at_the_clips(earlier: bool, folder: Path, tmp_path: Path):
    """What is found in a clip that was resampled is held in the frames of the clip."""
    walk, rate = str(folder / "walk.bvh"), ["--rate", "25"]
    if earlier:
        assert main(["detect", walk, *rate, "--object", "LeftFoot", "-o", str(tmp_path / "slow.csv"), "-q"]) == 0
        rate = ["--annotations", str(tmp_path / "slow.csv")]
    args = [*rate, "--object", "LeftFoot", "-o", str(tmp_path / "c.bvh"), "--report", str(tmp_path / "r.json"), "-q"]
    assert main(["clean", walk, *args]) == 0
    rows = json.loads((tmp_path / "r.json").read_text())["constraints"]
    truth = [c for c in json.loads((folder / "truth.json").read_text())["constraints"] if c["object"] == "LeftFoot"]
    spans = [(c["begin"] - 6, c["end"] + 6) for c in truth]  # the easing is 6 frames
    assert rows and max(r["largest"] for r in rows) < 1e-3
    for r in rows:
        first, last = r["frames_active"][0], r["frames_active"][-1]
        assert any(b - 3 <= first and last <= e + 3 for b, e in spans), (first, last, spans)


def test_annotations_of_another_duration_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    found = json.loads((folder / "truth.json").read_text())
    (tmp_path / "other.json").write_text(json.dumps({**found, "fps": 30.0, "frames": found["frames"] - 20}))
    args = ["--annotations", tmp_path / "other.json", "-o", tmp_path / "c.bvh"]
    assert "frames" in fails(capsys, "clean", folder / "walk.bvh", *args)


def test_clean_without_anything_to_hold_says_so(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    args = ["--annotations", str(folder / "truth.json"), "--object", "Head", "-o", str(tmp_path / "c.bvh")]
    assert main(["clean", str(folder / "walk.bvh"), *args]) == 0
    assert "nothing to hold" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["deform"], "no clip"),
        (["deform", "walk.bvh", "-o", "x.bvh"], "no edit"),
        (["deform", "walk.bvh", "raise.toml"], "-o FILE"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.fbx"], ".npz"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.bvh", "--report", "x.csv"], ".json"),
        (["deform", "walk.bvh", "raise.toml", "-o", "walk.bvh"], "written over"),
        (["deform", "missing.bvh", "raise.toml", "-o", "x.bvh"], "missing.bvh"),
        (["deform", "walk.bvh", "missing.toml", "-o", "x.bvh"], "missing.toml"),
        (
            ["deform", "walk.bvh", "wrong.toml", "-o", "x.bvh"],
            "wrong.toml:2: [[position]] 1 has no key 'jonit' (nearest: joint)",
        ),
        (
            ["deform", "walk.bvh", "bad.toml", "-o", "x.bvh"],
            "bad.toml:1: no joint named 'RightHnad' (nearest: RightHand",
        ),
        (["deform", "walk.bvh", "far.toml", "-o", "x.bvh"], "0..198"),
        (["deform", "door.npz", "raise.toml", "-o", "x.bvh"], "skeleton"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.bvh", "--iterations", "0"], "iterations"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.bvh", "--solver", "clmap=1"], "clamp"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.bvh", "--solver", "clamp"], "NAME=VALUE"),
        (["deform", "walk.bvh", "raise.toml", "-o", "x.bvh", "--solver", "clamp=wide"], "clamp"),
        (["clean"], "no clip"),
        (["clean", "walk.bvh"], "-o FILE"),
        (["clean", "walk.bvh", "-o", "x.bvh", "--object", "LeftFot"], "LeftFoot"),
        (["clean", "walk.bvh", "-o", "x.bvh", "--annotations", "raise.toml"], ".toml"),
        (["clean", "walk.bvh", "-o", "x.bvh", "--annotations", "truth.json", "--template", "1:9"], "--template"),
        (["clean", "walk.bvh", "-o", "x.bvh", "--annotations", "truth.json", "--ease", "-1"], "ease"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_wrong_input_is_one_line(
    args: list[str], says: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(folder)
    assert says in fails(capsys, *args)
    assert not (folder / "x.bvh").exists()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", f"{EXTRA}{FAST_LOOPS} {plain_fusions()}".strip()),
        ("--xla_dump_to=/x", f"--xla_dump_to=/x {EXTRA}{FAST_LOOPS} {plain_fusions()}".strip()),
        (f"{EXTRA}a=1", f"{EXTRA}a=1,{FAST_LOOPS} {plain_fusions()}".strip()),
        (f"{EXTRA}{FAST_LOOPS}0,a=1", f"{EXTRA}{FAST_LOOPS}0,a=1 {plain_fusions()}".strip()),
        ("--xla_cpu_use_fusion_emitters=true", f"--xla_cpu_use_fusion_emitters=true {EXTRA}{FAST_LOOPS}"),
    ],
)
def test_flags_for_deforming_are_set_unless_the_user_has_said_otherwise(
    before: str, after: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XLA_FLAGS", before)
    use_deform_flags()
    assert os.environ["XLA_FLAGS"] == after


def test_the_flag_is_set_before_jax_is_there(folder: Path):
    code = (
        "import sys\nimport kinjax.cli.cache as cache\nreal = cache.use_deform_flags\n"
        "def seen():\n    assert 'jax' not in sys.modules\n    real()\n"
        "cache.use_deform_flags = seen\nfrom kinjax.cli import main\nraise SystemExit(main(sys.argv[1:]))"
    )
    args = ["deform", str(folder / "walk.bvh"), str(folder / "nothing.toml"), "-o", str(folder / "flag.bvh")]
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
