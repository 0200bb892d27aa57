"""What the commands print: tables, trees, notes, and progress on anything over two seconds.

In: records. Out: text, with rich where stdout is a terminal, plain and unwrapped where it is a pipe. A reader that goes
away (`| head`) stops the printing, not the work.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn
from rich.table import Table
from rich.text import Text

from ..annotations import Annotations, Constraint

WIDE = 240  # columns of a line that goes into a pipe: nothing is cut or wrapped


class Screen:
    """Where a command prints. quiet: no tables, no notes. messages: they go to stderr, because stdout holds data."""

    def __init__(self, quiet: bool = False, messages: bool = False):
        self.quiet = quiet
        self.file = sys.stderr if messages else sys.stdout
        self.live = self.file.isatty()

    def print(self, what: RenderableType = "") -> None:
        """A table, a tree or a line, unless quiet; markup in it is shown as it is."""
        if self.quiet:
            return
        if isinstance(what, str):
            what = Text(what)
        try:
            if self.live:
                Console(file=self.file, highlight=False).print(what, soft_wrap=isinstance(what, Text))
                return
            console = Console(file=self.file, highlight=False, width=WIDE, color_system=None)
            with console.capture() as told:
                console.print(what, soft_wrap=isinstance(what, Text))
            print("\n".join(line.rstrip() for line in told.get().splitlines()), file=self.file, flush=True)
        except BrokenPipeError:
            from . import _drop_stdout

            _drop_stdout()
            self.quiet = True

    def warn(self, text: str) -> None:
        """A warning on stderr, also when quiet."""
        print("kinjax: warning:", " ".join(text.split()), file=sys.stderr)

    @contextmanager
    def busy(self, total: int = 1) -> Iterator[Busy]:
        """Shows progress on a terminal's stderr once the block has taken two seconds."""
        busy = Busy(total, sys.stderr.isatty() and not self.quiet)
        try:
            yield busy
        finally:
            busy.stop()


class Busy:
    """A progress line that appears after `AFTER` seconds; `step` names what is being done."""

    AFTER = 2.0

    def __init__(self, total: int, shown: bool):
        columns = [SpinnerColumn(), TextColumn("{task.description}", markup=False)]
        columns += [BarColumn(), MofNCompleteColumn()] if total > 1 else []
        self._progress = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task = self._progress.add_task("working", total=total)
        self._lock, self._over = threading.Lock(), False
        self._timer = threading.Timer(self.AFTER, self._start)
        self._timer.daemon = True
        if shown:
            self._timer.start()

    def step(self, text: str, done: int = 0) -> None:
        """Now doing `text`, with `done` of the total behind."""
        self._progress.update(self._task, description=text, completed=done)

    def stop(self) -> None:
        """Take the line away."""
        self._timer.cancel()
        with self._lock:
            self._over = True
            if self._progress.live.is_started:  # to stop one that is not would print an empty line
                self._progress.stop()

    def _start(self) -> None:
        with self._lock:
            if not self._over:
                self._progress.start()


def table(head: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", numbers: Sequence[int] = ()) -> Table:
    """A table with few lines on a terminal, and none in a pipe; columns in `numbers` are set to the right."""
    frame = box.SIMPLE_HEAD if sys.stdout.isatty() else None
    out = Table(title=Text(title) if title else None, title_justify="left", box=frame, pad_edge=False)
    for i, name in enumerate(head):
        out.add_column(name, justify="right" if i in numbers else "left", no_wrap=True)
    for row in rows:
        out.add_row(*(Text(cell) for cell in row))
    return out


def constraints_table(items: Sequence[Constraint], title: str = "") -> Table:
    """Constraints, one a row."""
    rows: list[tuple[str, ...]] = []
    for c in items:
        place = " ".join(f"{round(x, 3) + 0.0:.3f}" for x in c.position)  # + 0.0: no minus zero
        axis = " ".join(f"{round(x, 2) + 0.0:.2f}" for x in c.axis) if c.axis is not None else ""
        rows.append(
            (
                c.object,
                c.type,
                str(c.begin),
                str(c.end),
                f"{c.begin_s:.3f}",
                f"{c.end_s:.3f}",
                place,
                axis,
                f"{1e3 * c.residual:.1f}",
            )
        )
    head: tuple[str, ...] = ("object", "type", "begin", "end", "begin s", "end s", "place m", "axis", "moves mm")
    if not any(row[7] for row in rows):
        head, rows = head[:7] + head[8:], [row[:7] + row[8:] for row in rows]
    return table(head, rows, title, range(2, len(head)))


def summary(found: Annotations) -> str:
    """One line: how much was found in how much motion."""
    kinds = [(t, len(found.constraints.of(type=t))) for t in ("space", "line", "point")]
    count = ", ".join(f"{n} {t}" for t, n in kinds if n) or "no"
    plural = "constraint" if len(found.constraints) == 1 else "constraints"
    return f"{count} {plural} in {found.frames} frames at {found.fps:g} a second ({(found.frames - 1) / found.fps:.2f} s)"
