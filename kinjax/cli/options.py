"""Commands and their options, as dataclasses that tyro reads; a command's `run()` does it and gives the exit code.

In: nothing. Out: `Command`. Nothing here may import JAX, NumPy or rich: `--help` has to answer at once. Field docstrings
are the help texts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg, subcommand

from .database_options import NAMES as DATABASE_NAMES
from .database_options import DatabaseCommand

Kind = Literal["space", "line", "point"]


def _opt(*short: str, metavar: str | None = None, default: str = "") -> Any:
    """An option's short names, the name of its value, and the words that stand for an empty default."""
    return arg(aliases=list(short) or None, metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


@dataclass(frozen=True)
class Reading:
    """How motion files are read."""

    unit: Annotated[str, _opt(metavar="UNIT", default="auto: from the skeleton's height")] = "auto"
    """Unit of the file's lengths: m, cm, mm, inch, cmu, or metres per unit."""
    up: Annotated[Literal["x", "y", "z"] | None, _opt(metavar="{x,y,z}", default="the file's, y for BVH")] = None
    """The world's up axis."""


@dataclass(frozen=True)
class Detecting:
    """What to look for, and how."""

    object: Annotated[
        UseAppendAction[tuple[tuple[str, ...], ...]], _opt(metavar="NAME [NAME ...]", default="feet and hands, by name")
    ] = ()
    """Joints or objects to look at, in any case; an unknown one lists the nearest."""
    type: Annotated[tuple[Kind, ...], _opt(metavar="{space,line,point}", default="space, and the templates' types")] = ()
    """Types of constraint to look for, one or more."""
    template: Annotated[UseAppendAction[tuple[tuple[str, ...], ...]], _opt(metavar="[NAME=]BEGIN:END[:TYPE]", default="none")] = ()
    """Example constraints: first and last frame, 0-based, both included; of every --object, or of the one named."""
    method: Annotated[Literal["robust", "paper", "window"], _opt(default="robust")] = "robust"
    """robust needs no template; paper is the 2006 paper to the letter; window decides in millimetres over windows."""
    thresholds: Annotated[tuple[float, float] | None, _opt(metavar="SIGMA EPS", default="from the templates")] = None
    """Noise pattern of one interval given by hand, radians and metres (--method paper)."""
    estimator: Annotated[Literal["lmeds", "naive"], _opt(default="lmeds")] = "lmeds"
    """How a template becomes thresholds: least median of squares, or the largest value seen."""
    rate: Annotated[float | None, _opt(metavar="FPS", default="the clip's")] = None
    """Resample to so many frames a second first."""
    stride: Annotated[int, _opt(metavar="FRAMES", default="1")] = 1
    """Frames that one displacement spans (--method paper)."""
    relative_to: Annotated[str | None, _opt(metavar="NAME", default="the world")] = None
    """Look for constraints relative to this joint or object."""
    min_duration: Annotated[float | None, _opt(metavar="SECONDS", default="0.08")] = None
    """Leave out shorter constraints."""
    free_pivots: bool = False
    """Keep line and point constraints that touch no space constraint (hinges, doors, dice)."""
    set: Annotated[UseAppendAction[tuple[str, ...]], _opt(metavar="NAME=VALUE", default="none")] = ()
    """Any other setting of kinjax.Settings, as still=0.2,2.0 or projection=svd; repeatable."""


@dataclass(frozen=True)
class Detect(Reading, Detecting):
    """Find the constraints of motion clips, and write them.

    Clips come before options. One clip is shown in a table; several are written into a directory.
    """

    clips: Positional[Annotated[tuple[Path, ...], _opt(metavar="CLIP [CLIP ...]")]] = ()
    """Motion files."""
    output: Annotated[Path | None, _opt("-o", metavar="FILE", default="none: only the table")] = None
    """Where to: .json, .csv, .parquet or .npz (labels of each frame); - is JSON to stdout. Several clips: a folder."""
    format: Annotated[Literal["json", "csv", "parquet", "npz"], _opt(default="json")] = "json"
    """Format of the files in a directory."""
    report: Annotated[Path | None, _opt(metavar="FILE", default="none")] = None
    """Also write a report with pictures (HTML); several clips: a directory."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print no tables, only warnings and errors."""

    def run(self) -> int:
        """Do it."""
        from .detecting import detect_command

        return detect_command(self)


@dataclass(frozen=True)
class Report(Reading, Detecting):
    """Write a report with pictures (HTML) of what is found in motion clips."""

    clips: Positional[Annotated[tuple[Path, ...], _opt(metavar="CLIP [CLIP ...]")]] = ()
    """Motion files."""
    output: Annotated[Path | None, _opt("-o", metavar="FILE", default="CLIP's name with .html")] = None
    """The report; several clips: a directory."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print only warnings and errors."""

    def run(self) -> int:
        """Do it."""
        from .detecting import report_command

        return report_command(self)


@dataclass(frozen=True)
class Plot(Reading, Detecting):
    """Draw a clip's constraints, or annotations from a file, as PNG pictures; opens no window."""

    source: Positional[Annotated[Path | None, _opt(metavar="CLIP|ANNOTATIONS")]] = None
    """A motion file, or annotations (.json, .csv, .parquet, .npz)."""
    output: Annotated[Path, _opt("-o", metavar="DIR", default="kinjax-out")] = Path("kinjax-out")
    """Directory of the pictures."""
    frames: Annotated[str | None, _opt(metavar="BEGIN:END", default="all")] = None
    """Draw only these frames of a clip, 0-based, both included; its constraints are those of the whole clip."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print only warnings and errors."""

    def run(self) -> int:
        """Do it."""
        from .pictures import plot_command

        return plot_command(self)


@dataclass(frozen=True)
class Deforming:
    """How a motion is bent, and what is written."""

    output: Annotated[Path | None, _opt("-o", metavar="FILE")] = None
    """Where the motion goes: .bvh (the hierarchy and channels of a BVH clip are kept) or .npz."""
    report: Annotated[Path | None, _opt(metavar="FILE", default="none")] = None
    """Also write the report on every constraint and frame (JSON)."""
    iterations: Annotated[int | None, _opt(metavar="N", default="the edit's, or the solver's own")] = None
    """Iterations of the solver a frame, at most."""
    precision: Annotated[Literal["float64", "float32"] | None, _opt(metavar="{float64,float32}", default="float64")] = None
    """Precision of the solver."""
    solver: Annotated[UseAppendAction[tuple[str, ...]], _opt(metavar="NAME=VALUE", default="none")] = ()
    """Any other setting of kinjax.deform.Settings, as filter_root=6 or strategy=weights; repeatable."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print no tables, only warnings and errors."""


@dataclass(frozen=True)
class Deform(Reading, Deforming):
    """Bend a motion to the constraints of an edit file (docs/edit-files.md)."""

    clip: Positional[Annotated[Path | None, _opt(metavar="CLIP")]] = None
    """A motion file."""
    edit: Positional[Annotated[Path | None, _opt(metavar="EDIT.toml")]] = None
    """The constraints, and settings if it likes; options here come before those."""

    def run(self) -> int:
        """Do it."""
        from .cache import use_deform_flags

        use_deform_flags()  # before anything imports JAX
        from .deforming import deform_command

        return deform_command(self)


@dataclass(frozen=True)
class Clean(Reading, Deforming, Detecting):
    """Make planted feet stand still: find the constraints of a motion, and keep them."""

    clip: Positional[Annotated[Path | None, _opt(metavar="CLIP")]] = None
    """A motion file."""
    object: Annotated[UseAppendAction[tuple[tuple[str, ...], ...]], _opt(metavar="NAME [NAME ...]", default="feet, by name")] = ()
    """Joints whose constraints are kept, in any case; an unknown one lists the nearest."""
    annotations: Annotated[Path | None, _opt(metavar="FILE", default="none: they are detected")] = None
    """Keep the constraints that were found earlier (.json, .csv, .parquet, .npz); --object and --type choose among them."""
    ease: Annotated[float, _opt(metavar="SECONDS", default="0.1")] = 0.1
    """How long a foot takes to its held place, and back to its own path."""

    def run(self) -> int:
        """Do it."""
        from .cache import use_deform_flags

        use_deform_flags()  # before anything imports JAX
        from .deforming import clean_command

        return clean_command(self)


@dataclass(frozen=True)
class Info(Reading):
    """Show a clip's frames, rate, duration, unit, and its joints as a tree."""

    clip: Positional[Annotated[Path | None, _opt(metavar="CLIP")]] = None
    """A motion file."""

    def run(self) -> int:
        """Do it."""
        from .commands import info_command

        return info_command(self)


@dataclass(frozen=True)
class Export:
    """Turn annotations into what other programs read."""

    annotations: Positional[Annotated[Path | None, _opt(metavar="ANNOTATIONS")]] = None
    """Annotations (.json, .csv, .parquet, .npz)."""
    to: Annotated[Literal["vtt", "blender", "events"] | None, _opt(metavar="{vtt,blender,events}")] = None
    """Subtitles (WebVTT), a Blender script that sets markers, or a table of begin and end events."""
    output: Annotated[Path | None, _opt("-o", metavar="FILE", default="ANNOTATIONS with another suffix")] = None
    """The file to write; - is stdout."""

    def run(self) -> int:
        """Do it."""
        from .commands import export_command

        return export_command(self)


@dataclass(frozen=True)
class Samples:
    """Write the sample clips, made by calculation, with the constraints that are true of them by construction."""

    output: Annotated[Path, _opt("-o", metavar="DIR", default="kinjax-samples")] = Path("kinjax-samples")
    """Directory to write into."""

    def run(self) -> int:
        """Do it."""
        from .demo import samples_command

        return samples_command(self)


@dataclass(frozen=True)
class Demo:
    """Detect constraints in the sample clips, beside the truth; what `kinjax` alone does."""

    output: Annotated[Path, _opt("-o", metavar="DIR", default="kinjax-out")] = Path("kinjax-out")
    """Directory of the annotations and reports."""

    def run(self) -> int:
        """Do it."""
        from .demo import demo_command

        return demo_command(self)


Command = (
    Annotated[Detect, subcommand("detect")]
    | Annotated[Deform, subcommand("deform")]
    | Annotated[Clean, subcommand("clean")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Plot, subcommand("plot")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Samples, subcommand("samples")]
    | Annotated[Demo, subcommand("demo")]
    | DatabaseCommand
)
NAMES = ("detect", "deform", "clean", "info", "plot", "report", "export", *DATABASE_NAMES, "samples", "demo")
