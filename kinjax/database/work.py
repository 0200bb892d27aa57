"""The work on one part: read its files, detect in batches, write its tables aside.

In: a `Task`. Out: a `Receipt` of a few bytes; the tables are on disk. This runs in whatever process an engine chose, one task
at a time. A file that is no good becomes a row of `errors` and does not touch the others; trouble with the output (a
full disk) is raised, and ends the job.
"""

from __future__ import annotations

import faulthandler
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, KinjaxError
from .catalogue import Entry, Part
from .configuration import Configuration

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


@dataclass(frozen=True)
class Learnt:
    """What a template taught, and where it holds. patterns: of the object whose role (or, without one, name) is `role`;
    scope and value: "skeleton" and its hash, "subject" and its name, or "all"; noise: of the template's own clip, metres and
    radians; source: the clip and frames, for people."""

    patterns: tuple[Any, ...]
    role: str
    scope: str
    value: str
    noise: tuple[float, float]
    source: str


@dataclass(frozen=True)
class Task:
    """One part to be worked on.

    key: of the configuration and what was learnt. aside: the folder to write in. refused: by clip, what is known to be wrong
    with it and after how many attempts; it is not touched again. limit: seconds for one file, or for the detection in one
    batch, after which this process is ended (0: none; only where another process looks after this one). cache: where
    compiled programs are kept.
    """

    part: Part
    configuration: Configuration
    key: str
    learnt: tuple[Learnt, ...]
    aside: str
    refused: Mapping[str, tuple[str, str, int]]
    limit: float = 0.0
    cache: str | None = None


@dataclass(frozen=True)
class Receipt:
    """What came of a part: where its tables were written, how many files were good and how many refused, and their size."""

    part: str
    written: str
    ok: int
    refused: int
    frames: int
    bytes: int


def one_thread() -> None:
    """XLA and Arrow in one thread each, for a process that has others beside it. XLA reads this once: before JAX is loaded."""
    import pyarrow as pa

    flags = os.environ.get("XLA_FLAGS", "")
    if "intra_op_parallelism_threads" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {ONE_THREAD}".strip()
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


class JobFailed(KinjaxError):
    """The job as a whole cannot go on: no file of it is to blame. What is in the store stays."""


COMPILING = 120.0
"""Seconds more that a detection may take than a file: its program may have to be compiled first."""


def annotate_part(task: Task, begun: Callable[[str, bool], object] | None = None) -> Receipt:
    """Work on one part. begun: told the name of each clip before it is read (False), and before it is looked at (True): each
    is then a batch of its own."""
    from .schema import Columns

    if task.cache is not None:
        keep_programs(task.cache)
    rows = Columns()
    results = _Results(task, rows)
    for entry in task.part.entries:
        known = task.refused.get(entry.clip)
        if known is not None:
            results.refuse(entry, known[0], known[1], attempts=known[2])
            continue
        if begun is not None:
            begun(entry.clip, False)
        with time_limit(task.limit):
            results.read(entry)
        if begun is not None:
            begun(entry.clip, True)
        results.detect(all=begun is not None)
    results.detect(all=True)
    folder = Path(task.aside) / f"{task.part.key}-{secrets.token_hex(4)}"
    folder.mkdir()
    try:
        from .store import write_tables

        write_tables(rows.tables(), folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return Receipt(task.part.key, str(folder), results.ok, results.bad, results.frames, task.part.bytes)


def keep_programs(folder: str) -> None:
    """Have JAX keep compiled programs in a folder, unless it was told another."""
    import jax

    if not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """End this whole process if the block takes longer: nothing less stops a loop in foreign code."""
    if seconds > 0:
        faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        if seconds > 0:
            faulthandler.cancel_dump_traceback_later()


@dataclass(frozen=True)
class _Read:
    """A clip that waits for its batch."""

    entry: Entry
    prepared: Any
    patterns: tuple[Any, ...]
    sources: Mapping[str, Learnt]
    roles: Mapping[str, str | None]
    facts: Mapping[str, Any]


class _Results:
    """Reads clips, gathers those of one shape into batches, and makes rows of what is found."""

    def __init__(self, task: Task, rows: Any):
        self.task, self.rows = task, rows
        self.waiting: dict[tuple[object, ...], list[_Read]] = {}
        self.ok = self.bad = self.frames = 0

    def read(self, entry: Entry) -> None:
        """Read a file, or refuse it."""
        from ..detect.batches import shape_of

        try:
            one = _prepare(entry, self.task)
        except FileFormatError as error:
            return self.refuse(entry, type(error).__name__, str(error), error.line, error.column)
        except KinjaxError as error:
            return self.refuse(entry, type(error).__name__, str(error))
        except OSError as error:
            return self.refuse(entry, "unreadable", f"{entry.path}: {error.strerror or error}")
        except MemoryError:
            return self.refuse(entry, "MemoryError", f"{entry.path}: there is not enough memory for it")
        except Exception as error:  # a fault of ours must not cost a night's work: it is a row like the others
            return self.refuse(entry, "fault", _fault(error))
        self.waiting.setdefault((*shape_of(one.prepared), bool(one.patterns)), []).append(one)

    def detect(self, all: bool) -> None:
        """Detect in batches that are full, or in all that wait."""
        from ..detect.batches import room_of

        limit = self.task.limit and self.task.limit + COMPILING
        for shape in [s for s, some in self.waiting.items() if all or len(some) >= room_of(some[0].prepared)]:
            with time_limit(limit):
                self._detect(self.waiting.pop(shape))

    def refuse(
        self,
        entry: Entry,
        kind: str,
        message: str,
        line: int | None = None,
        column: int | None = None,
        attempts: int = 1,
    ) -> None:
        """A row of `errors`."""
        self.bad += 1
        values = (
            entry.key(self.task.key), entry.path, entry.root, entry.format, entry.bytes, kind, message, line, column, attempts,
        )  # fmt: skip
        names = ("key", "path", "root", "format", "bytes", "kind", "message", "line", "column", "attempts")
        self.rows.add("errors", entry.clip, {n: [_plain(v)] for n, v in zip(names, values, strict=True)})

    def _detect(self, some: Sequence[_Read]) -> None:
        from ..detect.pipeline import detect_prepared

        settings = self.task.configuration.settings
        try:
            found = detect_prepared([r.prepared for r in some], settings, [r.patterns for r in some])
        except Exception as error:  # of one clip among several: each on its own tells which
            if len(some) == 1:
                known = isinstance(error, KinjaxError)
                kind, text = (type(error).__name__, str(error)) if known else ("fault", _fault(error))
                return self.refuse(some[0].entry, kind, text)
            for one in some:
                self._detect([one])
            return
        for one, d in zip(some, found, strict=True):
            self._add(one, d)

    def _add(self, one: _Read, found: Any) -> None:
        from .schema import constraint_rows, pattern_rows

        clip, rows = one.entry.clip, constraint_rows(found, one.roles)
        sources = {n: learnt.source for n, learnt in one.sources.items()}
        self.rows.add("constraints", clip, rows)
        self.rows.add("patterns", clip, pattern_rows(found, one.roles, sources))
        facts = dict(one.facts) | {
            "objects": list(found.objects),
            "constraints": len(rows["begin"]),
            "missing": int(found.missing.sum()),
            "warnings": [*found.warnings, *_noise_warnings(found, one.sources)],
        }
        self.rows.add("clips", clip, {k: [_plain(v)] for k, v in facts.items()})
        self.ok += 1
        self.frames += found.frames


def _prepare(entry: Entry, task: Task) -> _Read:
    """One clip read, its objects chosen, its patterns found."""
    from ..detect.prepare import prepared
    from ..joint_names import choose, role_of
    from ..lengths import octave
    from ..motion import Motion

    configuration = task.configuration
    source, notes = read_clip(entry.path, configuration)
    names = source.skeleton.names if isinstance(source, Motion) else source.names
    at = (
        choose(names, configuration.objects, entry.clip)
        if isinstance(source, Motion)
        else _objects(source, configuration)
    )
    objects = [names[j] for j in at]
    roles = {names[j]: role_of(names, j) for j in at}
    skeleton = skeleton_key(source)
    subject = configuration.subject_of(Path(entry.path).stem, Path(entry.path).parent.name)
    one = prepared(source, objects, None, configuration.settings, octave)
    patterns, sources = [], {}
    for name in objects:
        learnt = _teacher(task.learnt, name, roles[name], skeleton, subject)
        if learnt is not None:
            patterns += [p.with_object(name) for p in learnt.patterns]
            sources[name] = learnt
    facts = {
        "key": entry.key(task.key),
        "path": entry.path,
        "root": entry.root,
        "format": entry.format,
        "bytes": entry.bytes,
        "subject": subject,
        "skeleton": skeleton,
        "up": one.up,
        "joints": len(names),
        "frames": one.original_frames,
        "fps": one.original_rate,
        "duration_s": max(one.original_frames - 1, 0) / one.original_rate,
        "notes": list(notes),
    }
    return _Read(entry, replace(one, clip=entry.clip), tuple(patterns), sources, roles, facts)


def read_clip(path: str, configuration: Configuration) -> tuple[Any, Sequence[str]]:
    """The motion or poses in a file, and what is worth knowing; of a BVH only the joints that are looked at are made."""
    from .. import formats
    from ..joint_names import choose

    suffix = Path(path).suffix.lower()
    if suffix == ".bvh":
        up = configuration.up or "y"
        motion = formats.read_bvh(
            path, configuration.unit, up, joints=lambda names: choose(names, configuration.objects, path)
        )
        return motion, motion.notes
    if suffix == ".c3d":
        markers = formats.read_c3d_markers(path, up=configuration.up or "auto")
        poses, notes = formats.rigid_objects(markers, dict(configuration.clusters) or "auto", path)
        return poses, (*markers.notes, *notes)
    options: dict[str, Any] = {} if suffix == ".npz" or configuration.up is None else {"up": configuration.up}
    source = formats.load(path, **options)
    return source, getattr(source, "notes", ())


def _objects(poses: Any, configuration: Configuration) -> tuple[int, ...]:
    """Objects of a clip of poses: those that are asked for, or all where none of them has such a name (props)."""
    from ..errors import UnknownNameError
    from ..joint_names import choose

    try:
        return choose(poses.names, configuration.objects, poses.clip)
    except UnknownNameError:
        if configuration.objects != Configuration().objects:
            raise
        return tuple(range(len(poses.names)))


def skeleton_key(source: Any) -> str:
    """A hash of the joints' names and parents, or of the objects' names: which clips have one skeleton."""
    import hashlib

    top = getattr(getattr(source, "skeleton", None), "topology", None)
    text = repr((top.names, top.parents) if top is not None else source.names)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:12]


def _teacher(learnt: Sequence[Learnt], name: str, role: str | None, skeleton: str, subject: str) -> Learnt | None:
    """The template that holds for an object: the narrowest scope first, then the last given."""
    held = {"skeleton": skeleton, "subject": subject, "all": ""}
    for scope in ("subject", "skeleton", "all"):
        for one in reversed(learnt):
            if one.scope == scope and one.value == held[scope] and one.role in (role, name.casefold()):
                return one
    return None


NOISE_RATIO, LEAST_NOISE = 2.0, 2e-4


def _noise_warnings(found: Any, sources: Mapping[str, Learnt]) -> list[str]:
    """Where a clip's noise is not that of the clip that its template was shown in."""
    out = []
    for i, name in enumerate(found.objects):
        if name in sources:
            here, there = max(float(found.noise[i, 0]), LEAST_NOISE), max(sources[name].noise[0], LEAST_NOISE)
            if not 1 / NOISE_RATIO <= here / there <= NOISE_RATIO:
                out.append(
                    f"{name}: the noise here is {1e3 * here:.2g} mm, where its template was shown {1e3 * there:.2g} mm: "
                    "thresholds learnt there may not fit"
                )
    return out


def _fault(error: Exception) -> str:
    return f"a fault of kinjax itself, {type(error).__name__}: {error}"


def _plain(value: Any) -> Any:
    """Text that a table can hold: a file name in another encoding has bytes that are no characters."""
    if isinstance(value, str):
        from ..formats.files import clean_text

        return clean_text(value)
    return [_plain(v) for v in value] if isinstance(value, list) else value
