"""The order of the house: a file imports only from files above it, and importing the package loads nothing heavy."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import kinjax

PACKAGE = Path(kinjax.__file__).parent
HEAVY = ("jax", "jaxlib", "numpy", "scipy", "matplotlib", "pyarrow", "duckdb", "msgspec", "jinja2", "rich", "tyro")

# From the foundations to what touches disk, argv and browsers. A name is a module, or a folder and all in it.
ORDER = (
    "errors", "marker_sets", "lengths", "memory", "numerics", "bits", "components", "rotations", "quaternions", "forward", "splines",
    "annotations", "skeleton", "joint_names", "anthropometry", "motion", "kinematics",
    "synthetic", "detect", "deform", "soft", "evaluation", "formats", "database", "plots", "report", "studio", "cli",
)  # fmt: skip
# Inside detect/, deform/ and cli/, the same; in detect/ a file that is not named here gathers the others.
DETECT = (
    "settings", "results", "displacements", "sigma_epsilon", "lmeds", "noise", "instantaneous", "refit", "windows",
    "merging",
)  # fmt: skip
DEFORM = (
    "constraints", "settings", "results", "prioritized", "chain", "tasks", "loops", "frame_solver", "sequence", "kochanek_bartels",
    "shape", "recruiting", "filtering", "targets", "balance", "body", "resolving", "layout", "plan", "reuse", "solving",
    "reporting", "pipeline", "comparison", "banded", "clip_problem", "clip_solver", "whole_clip", "cleaning",
    "conditions", "implicit", "arrangement", "bending",
)  # fmt: skip
STRANGERS = ({"detect", "deform"}, {"studio", "cli"}, {"plots", "database"})
CLI = (
    "cache", "evaluating_options", "database_options", "options", "parse", "show", "assignments", "request", "detecting", "deforming",
    "pictures", "annotating", "querying", "evaluating", "commands", "demo",
)  # fmt: skip

FILES = sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> tuple[str, ...]:
    """("detect", "noise") of kinjax/detect/noise.py; () of the package itself; a folder's own file is the folder."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def top_level_imports(path: Path, package: Path = PACKAGE) -> list[tuple[tuple[str, ...], int]]:
    """(module inside kinjax, line) of each import that runs when the file is imported; type-checking ones do not."""
    here = path.relative_to(package).parts[:-1]
    found = []

    def visit(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.ImportFrom):
                base: tuple[str, ...] = tuple(node.module.split(".")) if node.module else ()
                if node.level:
                    base = (*here[: len(here) - (node.level - 1)], *base)
                elif base[:1] == ("kinjax",):
                    base = base[1:]
                else:
                    continue
                for alias in node.names:
                    inner = (*base, alias.name)
                    is_module = package.joinpath(*inner).is_dir() or package.joinpath(*inner).with_suffix(".py").is_file()
                    found.append((inner if is_module else base, node.lineno))
            elif isinstance(node, ast.Import):
                found.extend((tuple(a.name.split(".")[1:]), node.lineno) for a in node.names if a.name.split(".")[0] == "kinjax")
            elif isinstance(node, ast.If):
                if "TYPE_CHECKING" not in ast.unparse(node.test):
                    visit(node.body)
                visit(node.orelse)
            elif isinstance(node, ast.Try):
                visit([*node.body, *node.orelse, *node.finalbody, *(s for h in node.handlers for s in h.body)])
            elif isinstance(node, ast.With | ast.ClassDef | ast.For):
                visit(node.body)

    visit(ast.parse(path.read_text(encoding="utf-8")).body)
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_every_file_has_a_place(path: Path):
    module = module_of(path)
    assert module[:1] in ((), ("__main__",)) or module[0] in ORDER, f"{module[0]} has no place in ORDER"
    assert module[:1] != ("deform",) or module[1:] in ((), *((m,) for m in DEFORM)), f"{module[1]} has no place in DEFORM"


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_a_file_imports_only_from_above(path: Path):
    module = module_of(path)
    for other, line in top_level_imports(path):
        where = f"{path.relative_to(PACKAGE)}:{line}: imports kinjax.{'.'.join(other)}"
        if module == ("__main__",):
            assert other == ("cli",), where
        elif not module:
            raise AssertionError(f"{where}: importing kinjax must import nothing of it")
        elif not other:
            assert module[0] == "cli", f"{where}: only the command line may ask the package itself (its version)"
        elif module[0] == other[0]:
            inside(module, other, where)
        else:
            assert ORDER.index(other[0]) < ORDER.index(module[0]), f"{where}, which comes after {module[0]}"
            assert {module[0], other[0]} not in STRANGERS, where


def inside(module: tuple[str, ...], other: tuple[str, ...], where: str) -> None:
    """The order within one folder, where there is one."""
    order = {"detect": DETECT, "deform": DEFORM, "cli": CLI}.get(module[0], ())
    own, theirs = module[1:2], other[1:2]
    if own == theirs or not own:
        return  # a folder's own file gathers what is in it
    assert theirs or module[0] not in ("detect", "deform"), f"{where}: files of a folder do not import the folder"
    if theirs and theirs[0] in order and own[0] in order:
        assert order.index(theirs[0]) < order.index(own[0]), f"{where}, which comes after {own[0]}"
    elif order and own[0] in order and theirs:
        raise AssertionError(f"{where}, which gathers the others")


BAD = """
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from ..report import unseen
from .. import plots
from ..plots.style import y
import kinjax.cli
from kinjax.formats import z
from . import noise
try:
    from ..studio import w
except ImportError:
    pass

def f():
    from ..formats import unseen
"""


def test_the_order_is_kept_by_a_file_that_would_break_it(tmp_path: Path):
    """The test of the test: relative, absolute and conditional imports are all seen, those in functions are not."""
    (tmp_path / "detect").mkdir()
    (tmp_path / "plots").mkdir()
    bad = tmp_path / "detect" / "bad.py"
    bad.write_text(BAD)
    seen = [m for m, _ in top_level_imports(bad, tmp_path)]
    assert seen == [("plots",), ("plots", "style"), ("cli",), ("formats",), ("detect",), ("studio",)]


def loaded_by(code: str) -> set[str]:
    """The heavy libraries that a fresh interpreter has loaded after `code`."""
    tail = f"\nimport sys\nprint('LOADED', *sorted(set({HEAVY!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code + tail], capture_output=True, text=True, check=True, timeout=120)
    return set(done.stdout.split("LOADED", 1)[1].split())


def test_importing_the_package_loads_nothing():
    assert loaded_by("import kinjax") == set()


def test_importing_the_command_line_loads_nothing():
    assert loaded_by("import kinjax.cli, kinjax.errors") == set()


@pytest.mark.parametrize(
    "args",
    [["--help"], *([c, "--help"] for c in ("detect", "deform", "clean")), ["--version"], ["detect", "--no-such-option"]],
    ids=" ".join,
)
def test_help_loads_only_the_parser(args: list[str]):
    code = f"import contextlib\nfrom kinjax.cli import main\nwith contextlib.suppress(SystemExit):\n    main({args!r})"
    assert loaded_by(code) <= {"tyro"}


@pytest.mark.parametrize("name", kinjax.__all__)
def test_public_names_resolve(name: str):
    assert getattr(kinjax, name) is not None


def test_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = kinjax.nothing_like_it
