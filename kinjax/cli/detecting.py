"""`kinjax detect` and `kinjax report`: one clip into a table and a file, or many into a directory.

In: options. Out: files, tables, an exit code. A clip that fails does not stop the others.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..detect import Detection, detect
from ..errors import KinjaxError, OptionError
from ..motion import Motion
from .cache import use_cache
from .options import Detect, Plot, Report
from .request import SUFFIXES, Clip, check_file, load_clip, request
from .show import Screen, constraints_table, summary, table

STDOUT = Path("-")
MOST_WARNINGS = 20  # of a job of several clips that are printed
Options = Detect | Report | Plot


@dataclass(frozen=True)
class Job:
    """One clip, and where its annotations and its report go."""

    clip: Path
    output: Path | None = None
    report: Path | None = None


def detect_command(options: Detect) -> int:
    """`kinjax detect`."""
    clips = _given(options.clips, options)
    if options.output == STDOUT and len(clips) > 1:
        raise OptionError("-o - writes one clip's JSON: for several clips give a directory")
    single = options.output != STDOUT and len(clips) == 1 and options.output is not None and not _is_folder(options.output)
    if single and options.output is not None and options.output.suffix.lower() not in SUFFIXES:
        raise OptionError(f"{options.output}: the suffix chooses the format, one of {', '.join(SUFFIXES)}")
    outputs = _places(clips, options.output, f".{options.format}")
    reports = _places(clips, options.report, ".html")
    screen = Screen(options.quiet, messages=options.output == STDOUT)
    return run([Job(*job) for job in zip(clips, outputs, reports, strict=True)], options, screen)


def report_command(options: Report) -> int:
    """`kinjax report`."""
    clips = _given(options.clips, options)
    if options.output is None:
        reports: Sequence[Path | None] = [c.with_suffix(".html") for c in clips]
        if len(set(reports)) < len(clips):
            raise OptionError("these clips' reports would have one name: give a directory with -o DIR")
    else:
        reports = _places(clips, options.output, ".html")
    return run([Job(c, None, r) for c, r in zip(clips, reports, strict=True)], options, Screen(options.quiet))


def run(jobs: Sequence[Job], options: Options, screen: Screen) -> int:
    """Do every job; gives the exit code."""
    use_cache()
    if len(jobs) == 1:
        with screen.busy() as busy:
            found, note = do(jobs[0], options, busy.step)
        _show(jobs[0], found, note, screen)
        return 0
    rows: list[tuple[str, ...]] = []
    notes: dict[str, None] = {}
    warnings: list[str] = []
    failed = 0
    with screen.busy(len(jobs)) as busy:
        for done, job in enumerate(jobs):
            busy.step(job.clip.name, done)
            try:
                found, note = do(job, options)
            except Exception as error:  # one clip never stops the others, whatever it is
                failed += 1
                print("kinjax: error:", _named(job.clip, error), file=sys.stderr)
                rows.append((job.clip.name, "", "", "", "", "failed"))
                continue
            notes[note] = None
            warnings += [f"{job.clip.name}: {w}" for w in found.warnings]
            counts = [str(len(found.constraints.of(type=t))) for t in ("space", "line", "point")]
            seconds = f"{(found.frames - 1) / float(found.rate):.2f}"
            rows.append((job.clip.name, seconds, *counts, str(job.output or job.report or "")))
    for warning in warnings[:MOST_WARNINGS]:
        screen.warn(warning)
    if len(warnings) > MOST_WARNINGS:
        screen.warn(f"{len(warnings) - MOST_WARNINGS} more warnings are in the annotations and reports")
    for note in [n for n in notes if n][:5]:
        screen.print(note)
    screen.print(table(("clip", "seconds", "space", "line", "point", "written"), rows, numbers=(1, 2, 3, 4)))
    if failed:
        print(f"kinjax: error: {failed} of {len(jobs)} clips failed, each said above", file=sys.stderr)
    return 0 if not failed else 2 if failed == len(jobs) else 1


def do(job: Job, options: Options, step: Any = lambda text: None) -> tuple[Detection, str]:
    """Detect in one clip and write what is asked for; gives the detection and a note on the objects."""
    step(f"reading {job.clip.name}")
    clip = load_clip(job.clip, options)
    step(f"detecting in {job.clip.name} (the first clip of a length takes longest)")
    found, note = detect_in(clip, options, job.clip.name)
    if job.output == STDOUT:
        _to_stdout(found)
    elif job.output is not None:
        job.output.parent.mkdir(parents=True, exist_ok=True)
        save_annotations(job.output, found)
    if job.report is not None:
        step(f"drawing the report on {job.clip.name}")
        write_html(job.report, found, clip)
    return found, note


def save_annotations(path: Path, found: Detection) -> None:
    """Write the annotations; labels of frames have a column for each object that was looked at, found or not."""
    from ..formats import write_annotations

    write_annotations(path, found.annotations(), found.objects if path.suffix.lower() == ".npz" else None)


def detect_in(clip: Clip, options: Options, name: str) -> tuple[Detection, str]:
    """What the options ask for, done on a loaded clip."""
    asked = request(options, clip, name)
    found = detect(
        clip,
        objects=list(asked.objects),
        templates=list(asked.templates),
        relative_to=asked.relative_to,
        settings=asked.settings,
    )
    return found, asked.note


def write_html(path: Path, found: Detection, clip: Clip, truth: Any = None) -> Path:
    """The report on one clip."""
    from ..report import write_report

    path.parent.mkdir(parents=True, exist_ok=True)
    moved = {"motion": clip} if isinstance(clip, Motion) else {"poses": clip}
    write_report(path, found, truth=truth, **moved)
    return path


def _show(job: Job, found: Detection, note: str, screen: Screen) -> None:
    screen.print(f"{job.clip.name}: {summary(found.annotations())}")
    if note:
        screen.print(note)
    if len(found.constraints):
        screen.print(constraints_table(found.constraints))
    for warning in found.warnings:
        screen.warn(warning)
    for what, path in (("annotations", job.output), ("report", job.report)):
        if path is not None and path != STDOUT:
            screen.print(f"{what}: {path}")


def _to_stdout(found: Detection) -> None:
    """The annotations as JSON on stdout."""
    with tempfile.TemporaryDirectory() as folder:
        text = found.save(Path(folder) / "annotations.json").read_text(encoding="utf-8")
    print(text.rstrip("\n"), flush=True)


def _given(clips: Sequence[Path], options: Options) -> list[Path]:
    """The clips, at least one; with one clip, a missing file is said before anything is loaded."""
    if not clips:
        swallowed = [n for group in options.object for n in group if Path(n).suffix and Path(n).exists()]
        hint = f": {swallowed[0]} was read as an --object, clips come before options" if swallowed else ""
        raise OptionError(f"no clip is given{hint}")
    if len(clips) == 1:
        check_file(clips[0])
    return list(clips)


def _is_folder(path: Path) -> bool:
    return path.is_dir() or (not path.suffix and not path.is_file())


def _places(clips: Sequence[Path], given: Path | None, suffix: str) -> list[Path | None]:
    """Where each clip's file goes: `given` for one clip, else names in that directory that do not collide."""
    if given is None:
        return [None] * len(clips)
    if len(clips) == 1 and (given == STDOUT or not _is_folder(given)):
        return [given]
    if given.suffix.lower() in (*SUFFIXES, ".html") and not given.is_dir():
        raise OptionError(f"{given} is one file, and there are {len(clips)} clips: give a directory")
    if given.is_file():
        raise OptionError(f"{given} is a file, and a directory is needed")
    top = Path(os.path.commonpath([c.resolve().parent for c in clips]))
    for name in (lambda c: Path(c.stem), lambda c: Path(c.name), lambda c: c.resolve().relative_to(top)):
        names = [name(c) for c in clips]
        if len(set(names)) == len(names):
            return [given / n.parent / (n.name + suffix) for n in names]
    repeated = next(c for i, c in enumerate(clips) if c.resolve() in {d.resolve() for d in clips[:i]})
    raise OptionError(f"{repeated} is given twice")


def _named(clip: Path, error: Exception) -> str:
    """The error in one line that names the clip."""
    text = " ".join(str(error).split())
    if not isinstance(error, KinjaxError | OSError):
        text = f"{clip}: a fault of kinjax itself, {type(error).__name__}: {text}"
    return text if clip.name in text else f"{clip}: {text}"
