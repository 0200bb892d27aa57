"""Commands on whole databases, and their options; like `options`, nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg, subcommand

from .evaluating_options import Evaluate

Kind = Literal["space", "line", "point"]


def _opt(*short: str, metavar: str | None = None, default: str = "") -> Any:
    """An option's short names, the name of its value, and the words that stand for an empty default."""
    return arg(
        aliases=list(short) or None, metavar=metavar, help_behavior_hint=f"(default: {default})" if default else ""
    )


@dataclass(frozen=True)
class Annotate:
    """Annotate all motion files in folders into a store of tables; run again, it goes on where it was.

    Exit codes: 0 all files are annotated, 3 some were refused (kinjax query STORE "FROM errors"), 1 the job failed.
    """

    folders: Positional[Annotated[tuple[Path, ...], _opt(metavar="FOLDER [FOLDER ...]")]] = ()
    """Folders of BVH, ASF/AMC, C3D and npz files, with all that is below them."""
    output: Annotated[Path | None, _opt("-o", metavar="STORE")] = None
    """The store: a folder, new or of an earlier run."""
    config: Annotated[Path | None, _opt("-c", metavar="FILE.toml", default="none")] = None
    """What to look for, with templates by skeleton or subject (docs/annotation.md); options here come before it."""
    object: Annotated[
        UseAppendAction[tuple[tuple[str, ...], ...]], _opt(metavar="NAME [NAME ...]", default="feet hands")
    ] = ()
    """Roles (left_foot, head, ...), groups (feet, hands, ...), names, patterns such as "*Toe*", or all."""
    type: Annotated[tuple[Kind, ...], _opt(metavar="{space,line,point}", default="space")] = ()
    """Types of constraint to look for, one or more."""
    template: Annotated[
        UseAppendAction[tuple[tuple[str, ...], ...]], _opt(metavar="CLIP:NAME=BEGIN:END[:TYPE]", default="none")
    ] = ()
    """An example in one clip, for every clip of the same skeleton (or as --carry says); repeatable."""
    carry: Annotated[Literal["skeleton", "subject", "all"], _opt(default="skeleton")] = "skeleton"
    """What a --template holds for."""
    method: Annotated[
        Literal["robust", "paper", "window"] | None, _opt(metavar="{robust,paper,window}", default="robust")
    ] = None
    """As for detect; paper needs templates."""
    set: Annotated[UseAppendAction[tuple[str, ...]], _opt(metavar="NAME=VALUE", default="none")] = ()
    """Any other setting of kinjax.Settings; repeatable."""
    unit: Annotated[str | None, _opt(metavar="UNIT", default="auto: from the skeleton's height")] = None
    """Unit of lengths in BVH files."""
    up: Annotated[Literal["x", "y", "z"] | None, _opt(metavar="{x,y,z}", default="the file's, y for BVH")] = None
    """The world's up axis."""
    engine: Annotated[Literal["inline", "dask"], _opt(default="inline")] = "inline"
    """inline: in this process; dask: by worker processes, which survive files that end or hang a process."""
    workers: Annotated[int | None, _opt(metavar="N", default="one a core")] = None
    """Dask workers on this machine."""
    scheduler: Annotated[str | None, _opt(metavar="ADDRESS", default="none: a cluster of this machine")] = None
    """A Dask scheduler that runs already, as tcp://host:8786; its workers must see the same folders."""
    threads: Annotated[int, _opt(metavar="N", default="1")] = 1
    """Threads of XLA in each worker."""
    patience: Annotated[float, _opt(metavar="SECONDS", default="60")] = 60.0
    """How long to wait without any Dask worker before the job fails."""
    timeout: Annotated[float, _opt(metavar="SECONDS", default="300")] = 300.0
    """How long one file may take (--engine dask)."""
    attempts: Annotated[int, _opt(metavar="N", default="3")] = 3
    """How often a file may end its worker before it is refused."""
    part_clips: Annotated[int, _opt(metavar="N", default="64")] = 64
    """About how many clips stand in one file of a table."""
    retry: bool = False
    """Try files again that were refused before."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print no summary, only warnings and errors."""

    def run(self) -> int:
        """Do it."""
        from .annotating import annotate_command

        return annotate_command(self)


@dataclass(frozen=True)
class Query:
    """Ask a store in SQL, or for constraints that hold at the same time.

    Tables: clips, constraints, patterns, errors (docs/annotation.md lists their columns).
    """

    store: Positional[Annotated[Path | None, _opt(metavar="STORE")]] = None
    """What `kinjax annotate` wrote."""
    sql: Positional[Annotated[str | None, _opt(metavar="SQL")]] = None
    """One statement of DuckDB's SQL, as "SELECT role, count(*) FROM constraints GROUP BY role"."""
    when: Annotated[UseAppendAction[tuple[str, ...]], _opt(metavar="OBJECT[:TYPE][:SECONDS]", default="none")] = ()
    """Instead of SQL: stretches in which this holds (for so many seconds at least); repeat it for what holds at once."""
    least: Annotated[float, _opt(metavar="SECONDS", default="0")] = 0.0
    """With --when: the shortest stretch."""
    format: Annotated[Literal["table", "csv", "json"], _opt(default="table")] = "table"
    """How rows are printed."""
    limit: Annotated[int, _opt(metavar="ROWS", default="40")] = 40
    """Rows of a table that are shown, at most; 0: all. CSV and JSON always hold all."""
    play: bool = False
    """For each row with a clip, print the command that draws that clip there."""

    def run(self) -> int:
        """Do it."""
        from .querying import query_command

        return query_command(self)


@dataclass(frozen=True)
class StoreCommand:
    """Look after a store: check it, or bring its many files together."""

    action: Positional[Annotated[Literal["check", "compact"], _opt(metavar="{check,compact}")]]
    """check: is every part whole, and do the tables agree; compact: few large files instead of many small ones."""
    store: Positional[Annotated[Path, _opt(metavar="STORE")]]
    """What `kinjax annotate` wrote."""
    quiet: Annotated[bool, _opt("-q")] = False
    """Print only what is wrong."""

    def run(self) -> int:
        """Do it."""
        from .querying import store_command

        return store_command(self)


DatabaseCommand = (
    Annotated[Annotate, subcommand("annotate")]
    | Annotated[Query, subcommand("query")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[StoreCommand, subcommand("store")]
)
NAMES = ("annotate", "query", "evaluate", "store")
