"""`./run`: with stand-ins for Python and uv, so that nothing is installed; what it does, says and hands on."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("sh", "dirname", "cksum", "cat", "mkdir", "ls", "readlink", "cp", "chmod", "rm")
pytestmark = pytest.mark.skipif(
    os.name != "posix" or any(shutil.which(t) is None for t in TOOLS), reason="needs a POSIX shell and its tools"
)

# Writes down how it was called. `-m venv DIR` copies it to DIR/bin/python; `-m pip install` fails if FAKE_PIP says so.
PYTHON = """#!/bin/sh
{ printf '%s' "$(basename "$0")"; printf ' <%s>' "$@"; printf '\\n'; } >>"$FAKE_LOG"
case "$1 ${2-} ${3-}" in
  "-c import sys;"*) exit "${FAKE_OLD:-0}" ;;
  "-c import ensurepip, venv"*) exit "${FAKE_NO_VENV:-0}" ;;
  "-m venv "*)
    for last; do :; done
    mkdir -p "$last/bin"
    cp "$0" "$last/bin/python"
    : >"$last/pyvenv.cfg" ;;
  "-m pip install") echo "pip talks a lot"; exit "${FAKE_PIP:-0}" ;;
  "-m ruff "*) exit "${FAKE_RUFF:-0}" ;;
  "-m pytest "*) echo "pytest's own summary"; exit "${FAKE_PYTEST:-0}" ;;
  "-P -m kinjax"*) exit "${FAKE_KINJAX:-0}" ;;
esac
exit 0
"""


class House:
    """A copy of the script in a folder with a space, and a PATH that holds nothing but stand-ins and shell tools."""

    def __init__(self, top: Path):
        self.repo, self.bin, self.log = top / "a house" / "kinjax", top / "bin", top / "log"
        self.repo.mkdir(parents=True)
        self.bin.mkdir()
        shutil.copy(ROOT / "run", self.repo / "run")
        (self.repo / "pyproject.toml").write_text("[project]\n")
        for tool in (*TOOLS, "basename"):
            (self.bin / tool).symlink_to(shutil.which(tool))

    def python(self, name: str = "python3.11") -> None:
        path = self.bin / name
        path.write_text(PYTHON)
        path.chmod(0o755)

    def run(self, *args: str, script: Path | None = None, cwd: Path | None = None, **fake: object):
        """Calls the script; its calls to Python are then in `calls`."""
        self.log.write_text("")
        env = {"PATH": str(self.bin), "FAKE_LOG": str(self.log)} | {k: str(v) for k, v in fake.items()}
        done = subprocess.run(
            [str(script or self.repo / "run"), *args],
            cwd=cwd or self.repo,
            env=env,
            capture_output=True,
            text=True,
            timeout=60,
            stdin=subprocess.DEVNULL,
        )
        self.calls = [line for line in self.log.read_text().splitlines() if "<-c>" not in line]
        return done


@pytest.fixture
def house(tmp_path: Path) -> House:
    return House(tmp_path)


def installs(house: House) -> list[str]:
    return [c for c in house.calls if "<install>" in c]


@pytest.mark.parametrize("shell", ["sh", "dash", "bash"])
def test_the_script_parses(shell: str):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    subprocess.run([shell, "-n", str(ROOT / "run")], check=True)
    assert os.access(ROOT / "run", os.X_OK) and os.access(ROOT / ".ci" / "run", os.X_OK)


def test_first_run_makes_the_environment_and_says_so_in_one_line(house: House):
    house.python()
    done = house.run()
    assert done.returncode == 0 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "installing into" in done.stderr and "pip talks" not in done.stderr
    assert house.calls[0].startswith("python3.11 <-m> <venv>") and house.calls[-1] == "python <-P> <-m> <kinjax>"
    assert installs(house) and installs(house)[0].endswith("<-e> <.>")


def test_arguments_reach_the_program_exactly(house: House):
    house.python()
    house.run()
    args = ("detect", "my walk.bvh", "", "--object", "a*b", "$HOME", "it's", 'say "x"', "back\\slash", "-o", "-")
    house.run(*args)
    assert house.calls == ["python <-P> <-m> <kinjax> " + " ".join(f"<{a}>" for a in args)]


def test_installs_again_only_when_pyproject_changes(house: House):
    house.python()
    assert house.run().returncode == 0 and installs(house)
    quiet = house.run("--help")
    assert not installs(house) and quiet.stderr == ""
    (house.repo / "pyproject.toml").write_text("[project]\nname = 'changed'\n")
    house.run("--help")
    assert len(installs(house)) == 1 and not any("<venv>" in c for c in house.calls)
    house.run("--help")
    assert not installs(house)


def test_a_moved_folder_installs_again(house: House, tmp_path: Path):
    house.python()
    house.run()
    house.repo = house.repo.rename(tmp_path / "elsewhere")
    house.run()
    assert installs(house)


def test_works_from_any_directory_and_through_a_link(house: House, tmp_path: Path):
    house.python()
    link, cwd = tmp_path / "link", tmp_path / "some where"
    link.symlink_to(house.repo / "run")
    cwd.mkdir()
    assert house.run("info", script=link, cwd=cwd).returncode == 0
    assert (house.repo / ".venv" / "bin" / "python").exists() and not any(cwd.iterdir())


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_exit_code_is_the_programs(house: House, code: int):
    house.python()
    assert house.run("x", FAKE_KINJAX=code).returncode == code


def test_pip_is_heard_only_when_it_fails_and_is_tried_again(house: House):
    house.python()
    failed = house.run(FAKE_PIP=7)
    assert failed.returncode != 0 and "pip talks a lot" in failed.stderr and "this step failed" in failed.stderr
    assert not any("<kinjax>" in c for c in house.calls)
    assert house.run().returncode == 0 and installs(house)


def test_no_python_is_one_clear_line(house: House):
    done = house.run()
    assert done.returncode == 1 and "Python 3.11 or newer is needed" in done.stderr.splitlines()[-1]
    house.python("python3")
    done = house.run(FAKE_OLD=1)
    assert done.returncode == 1 and "Python 3.11 or newer is needed" in done.stderr
    done = house.run(FAKE_NO_VENV=1)
    assert done.returncode == 1 and "python3-venv" in done.stderr


def test_takes_the_python_that_is_named_or_there(house: House):
    for name in ("python3.12", "python3", "mine"):
        house.python(name)
    house.run()
    assert house.calls[0].startswith("python3.12 ")
    shutil.rmtree(house.repo / ".venv")
    house.run(PYTHON=house.bin / "mine")
    assert house.calls[0].startswith("mine ")


def test_uv_is_used_where_it_is_and_pip_where_it_fails(house: House):
    house.python()
    (house.bin / "uv").write_text('#!/bin/sh\necho "uv $*" >>"$FAKE_LOG"\n[ "$1" = venv ] && exit 1\nexit "${FAKE_UV:-0}"\n')
    (house.bin / "uv").chmod(0o755)
    assert house.run().returncode == 0
    assert any(c.startswith("uv pip install") for c in house.calls) and not installs(house)
    (house.repo / "pyproject.toml").write_text("#\n")
    assert house.run(FAKE_UV=1).returncode == 0
    assert installs(house)


def test_a_folder_that_is_no_environment_is_left_alone(house: House, tmp_path: Path):
    house.python()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    done = house.run(KINJAX_VENV=tmp_path / "mine")
    assert done.returncode == 1 and "no Python environment" in done.stderr and (tmp_path / "mine" / "thesis.txt").exists()


def test_test_runs_pytest_last_and_remembers_the_linter(house: House):
    house.python()
    done = house.run("test")
    assert done.returncode == 0 and done.stdout.endswith("pytest's own summary\n")
    assert installs(house)[0].endswith("<.[test]>")
    assert [c.split()[2] for c in house.calls[-3:]] == ["<ruff>", "<mypy>", "<pytest>"]
    done = house.run("test", FAKE_RUFF=1)
    assert done.returncode == 1 and done.stdout.endswith("pytest's own summary\n") and "ruff found faults" in done.stderr
    assert house.run("test", FAKE_PYTEST=5).returncode == 5
    house.run("info")
    assert not installs(house)
    house.run("test", "-k", "a or b")
    assert house.calls == ["python <-m> <pytest> <-k> <a or b>"]
