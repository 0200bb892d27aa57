"""The options of `kinjax evaluate`. Nothing here may import JAX, NumPy or rich: `--help` has to answer at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg


def _opt(*short: str, metavar: str | None = None, default: str = "") -> Any:
    """An option's short names, the name of its value, and the words that stand for an empty default."""
    return arg(aliases=list(short) or None, metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


@dataclass(frozen=True)
class Evaluate:
    """Compare the constraints in a store with labels: precision, recall, errors of begins and ends.

    Labels are a file or a folder (docs/evaluation.md): JSON, CSV, npz, or annotations of `kinjax detect`.
    """

    store: Positional[Annotated[Path | None, _opt(metavar="STORE")]] = None
    """A store that `kinjax annotate` wrote."""
    labels: Positional[Annotated[Path | None, _opt(metavar="LABELS")]] = None
    """Labels: a file, or a folder of files."""
    object: Annotated[tuple[str, ...], _opt(metavar="NAME [NAME ...]", default="all that are labelled")] = ()
    """Only labels of these joints or roles, in any case."""
    type: Annotated[tuple[Literal["space", "line", "point"], ...], _opt(metavar="{space,line,point}", default="all")] = ()
    """Only constraints of these types, and labels of these or without type."""
    core: Annotated[str, _opt(metavar="A:B", default="0.25:0.55")] = "0.25:0.55"
    """The part of an outer bound that recall is over, in parts of its length."""
    reach: Annotated[float, _opt(metavar="SECONDS", default="0.25")] = 0.25
    """How far around an outer bound precision is counted."""
    iou: Annotated[float, _opt(metavar="SHARE", default="0.5")] = 0.5
    """The overlap, of 0 to 1, that makes an exact label found."""
    weigh: Annotated[Literal["frames", "seconds"], _opt(metavar="{frames,seconds}", default="frames")] = "frames"
    """What counts alike: every frame, or every second of clips of different rates."""
    missed: Annotated[int, _opt(metavar="N", default="0")] = 0
    """Also list so many labels that were not found."""
    json: Annotated[Path | None, _opt(metavar="FILE", default="none")] = None
    """Also write everything, with the fate of each label; - is stdout, instead of the table."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print no table, only warnings and errors."""

    def run(self) -> int:
        """Do it."""
        from .evaluating import evaluate_command

        return evaluate_command(self)
