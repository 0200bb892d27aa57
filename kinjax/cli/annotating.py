"""`kinjax annotate`: a whole database into a store.

In: options. Out: the store, a summary, and an exit code: 0 all well, 3 some files refused, 1 the job failed.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from ..annotations import check_type
from ..database.configuration import Configuration, TemplateRule, read_configuration
from ..database.engines import make_engine
from ..database.job import Progress, Report, annotate
from ..database.work import JobFailed
from ..errors import KinjaxError, OptionError
from ..formats import motion_suffixes
from ..memory import keep_memory
from .assignments import changed_settings
from .cache import cache_folder
from .database_options import Annotate
from .show import Screen, table

FAILED = 1
SUFFIXES = "|".join(map(re.escape, motion_suffixes()))


def annotate_command(options: Annotate) -> int:
    """`kinjax annotate`."""
    if not options.folders:
        raise OptionError("no folder is given: kinjax annotate FOLDER -o STORE")
    if options.output is None:
        raise OptionError("-o STORE says where the annotations go")
    configuration = _configuration(options)
    keep_memory()
    engine = make_engine(options.engine, options.workers, options.scheduler, options.threads, options.patience)
    screen = Screen(options.quiet)
    began = time.monotonic()
    try:
        with _shown(options.quiet) as progress:
            report = annotate(
                options.folders,
                options.output,
                configuration,
                engine=engine,
                timeout=options.timeout,
                attempts=options.attempts,
                part_clips=options.part_clips,
                retry=options.retry,
                cache=cache_folder(),
                progress=progress,
            )
    except JobFailed as error:
        return _failed(error)
    except OSError as error:
        return _failed(f"{error.filename or options.output}: {error.strerror or error}")
    _summary(report, options, screen, time.monotonic() - began)
    return report.exit_code


def _failed(error: object) -> int:
    print("kinjax: error: the job failed:", " ".join(str(error).split()), file=sys.stderr)
    print("kinjax: what is in the store stays; the same command goes on from there", file=sys.stderr)
    return FAILED


def _configuration(options: Annotate) -> Configuration:
    """That of the file, with what the options change."""
    base = Configuration() if options.config is None else read_configuration(options.config)
    changes: dict[str, Any] = {}
    objects = tuple(n for group in options.object for n in group)
    if objects:
        changes["objects"] = objects
    rules = tuple(_template(text, options.carry) for group in options.template for text in group)
    if rules:
        changes["templates"] = (*base.templates, *rules)
    settings: dict[str, Any] = {"method": options.method, "types": options.type or None}
    settings = {k: v for k, v in settings.items() if v is not None}
    given = base.settings.but(**(settings | changed_settings(options.set)))
    kinds = {r.type for r in changes.get("templates", base.templates)}
    if not options.type and not kinds <= set(given.types):
        given = given.but(types=(*given.types, *sorted(kinds - set(given.types))))
    changes["settings"] = given
    for name in ("unit", "up"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    return replace(base, **changes)


def _template(text: str, carry: Any) -> TemplateRule:
    """A template of `CLIP:NAME=BEGIN:END[:TYPE]`; the clip's path may hold colons, and the name of a joint too."""
    found = re.fullmatch(r"(.+)=(\d+):(\d+)(?::(\w+))?", text)
    named = None if found is None else re.fullmatch(rf"(.+?(?:{SUFFIXES})):(.+)|(.+):([^:]+)", found[1], re.IGNORECASE)
    if found is None or named is None:
        raise OptionError(f"--template {text!r}: write CLIP:NAME=BEGIN:END or CLIP:NAME=BEGIN:END:TYPE, frames from 0")
    clip, name = (part for part in named.groups() if part is not None)
    _, begin, end, kind = found.groups()
    return TemplateRule(clip, name, int(begin), int(end), check_type(kind or "space"), carry)


@contextmanager
def _shown(quiet: bool) -> Iterator[Any]:
    """Progress on a terminal's stderr: files, frames a second, refused, time left."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"), TextColumn("{task.fields[refused]} refused"), TimeRemainingColumn(),
    )  # fmt: skip
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("looking for files", total=None, speed="", refused=0)
        first: list[float] = []

        def tell(p: Progress) -> None:
            if p.frames and not first:
                first.append(time.monotonic())
            spent = time.monotonic() - first[0] if first else 0.0
            speed = f"{p.frames / spent:,.0f} frames/s" if spent > 1 else ""
            bar.update(
                task, description=p.doing, completed=p.done, total=p.total or None, speed=speed, refused=p.refused
            )

        yield tell


def _summary(report: Report, options: Annotate, screen: Screen, seconds: float) -> None:
    """Counts that add up, and what was refused."""
    rows = [
        ("found", f"{report.found:,}"),
        ("annotated", f"{report.ok:,}"),
        ("refused", f"{report.refused:,}"),
        (
            "done before",
            f"{report.skipped:,}" + (f", of which {report.skipped_refused:,} refused" * bool(report.skipped_refused)),
        ),
    ]
    if report.removed:
        rows.append(("gone from the folders", f"{report.removed:,}"))
    if report.frames:
        rows.append(("frames", f"{report.frames:,} in {seconds:.1f} s, {report.bytes / 1e6:,.0f} MB of files"))
    screen.print(table(("files", ""), rows, numbers=()))
    if report.reasons:
        told = ", ".join(f"{kind} {n}" for kind, n in sorted(report.reasons.items()))
        screen.print(f'refused: {told}; why: kinjax query {options.output} "SELECT clip, message FROM errors"')
    screen.print(f"store: {options.output}")


__all__ = ["KinjaxError", "annotate_command"]
