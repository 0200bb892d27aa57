"""One annotation job: from folders to a store that holds each of their files once, annotated or refused.

In: folders, a `Configuration`, a store's path, an engine. Out: a `Report` with its counts. The job makes parts from what is in
the folders, leaves out what the store has already under the same key, has an engine work on the rest, and puts each part into
place when it is done; it is the only one that writes to the store. A job that was killed at any point is taken up by
running it again, and ends with the same store.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from ..annotations import Template
from ..errors import KinjaxError, OptionError
from .catalogue import Entry, Part, find_clips, in_parts
from .configuration import Configuration, TemplateRule, code_version
from .engines import Engine, Lost, make_engine
from .isolation import find_poison
from .store import Store
from .upkeep import finish_compaction
from .work import JobFailed, Learnt, Receipt, Task, read_clip, skeleton_key


@dataclass(frozen=True)
class Report:
    """What a job did: files found = ok + refused + skipped (done before). reasons: of this run's refusals, by kind."""

    found: int
    ok: int
    refused: int
    skipped: int
    skipped_refused: int
    frames: int
    bytes: int
    parts: int
    removed: int
    reasons: dict[str, int]

    @property
    def exit_code(self) -> int:
        """0: every file is annotated, now or before; 3: some are refused."""
        return 3 if self.refused or self.skipped_refused else 0


@dataclass(frozen=True)
class Progress:
    """How far a job is: files, frames and bytes of this run."""

    done: int
    total: int
    frames: int
    refused: int
    doing: str


def annotate(
    folders: Sequence[str | Path],
    store: str | Path,
    configuration: Configuration | None = None,
    *,
    engine: str | Callable[[], Engine] = "inline",
    timeout: float = 300.0,
    attempts: int = 3,
    part_clips: int = 64,
    retry: bool = False,
    cache: str | Path | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Report:
    """Annotate all motion files in folders into a store; run again, it goes on where it was, or finds nothing to do.

    engine: "inline", "dask", or what makes an `Engine`. timeout: seconds for one file (not inline). attempts: how often a file
    may end its worker before it is refused. part_clips: about how many clips share a file of the store. retry: files
    that were refused before are tried again, changed or not. cache: a folder in which compiled programs are kept.

    What changed, or was annotated under another configuration, is annotated anew, and what is no longer in the folders goes
    from the store; other folders in it stay.

    Raises `KinjaxError`s for what makes the whole job impossible, and `OSError` where the store cannot be written.
    """
    if timeout <= 0 or attempts < 1 or part_clips < 1:
        raise OptionError("timeout must be positive, attempts and part_clips at least one")
    configuration = configuration or Configuration()
    if configuration.settings.method == "paper" and not (configuration.templates or configuration.settings.thresholds):
        raise OptionError('method="paper" needs templates, or thresholds=(sigma_max, eps_max)')
    say = progress or (lambda p: None)
    start = make_engine(engine) if isinstance(engine, str) else engine
    target = Path(os.path.abspath(store))
    say(Progress(0, 0, 0, 0, "looking for files"))
    entries = find_clips(
        folders,
        configuration.include,
        configuration.exclude,
        target,
        lambda n: say(Progress(0, n, 0, 0, "looking for files")) if n % 256 == 0 else None,
    )
    if not entries:
        raise OptionError(f"no motion files in {', '.join(map(str, folders))}")
    say(Progress(0, len(entries), 0, 0, "templates"))
    learnt = teach(configuration, entries)
    key = _whole_key(configuration, learnt)
    house = Store(target, create=True)
    with house.locked():
        job = _Job(house, configuration, key, learnt, timeout, attempts, None if cache is None else str(cache), say)
        return job.run(entries, in_parts(entries, key, part_clips), start, retry)


class _Job:
    """The state of one run, under the store's lock."""

    def __init__(
        self,
        store: Store,
        configuration: Configuration,
        key: str,
        learnt: tuple[Learnt, ...],
        timeout: float,
        attempts: int,
        cache: str | None,
        say: Callable[[Progress], object],
    ):
        self.store, self.configuration, self.key, self.learnt = store, configuration, key, learnt
        self.timeout, self.attempts, self.cache, self.say = timeout, attempts, cache, say
        self.receipts: list[Receipt] = []
        self.held: dict[str, tuple[str, str]] = {}
        self.removed = 0

    def run(self, entries: Sequence[Entry], parts: Sequence[Part], start: Callable[[], Engine], retry: bool) -> Report:
        suspects = self.store.suspects()
        finish_compaction(self.store)
        self.store.sweep()
        self.held = self.store.settled()
        bad = set(self.store.table("errors", ["clip"])["clip"].to_pylist())
        again = bad if retry else set()
        done = {e.clip for e in entries if self.held.get(e.clip, ("",))[0] == e.key(self.key) and e.clip not in again}
        todo = [p for p in parts if any(e.clip not in done for e in p.entries)]
        self._forget({e.root for e in entries}, {e.clip for e in entries})
        redone = {e.clip for p in todo for e in p.entries}
        self.total = len(redone)
        if todo:
            self.store.write_manifest(self._document())
            try:
                with start() as engine:
                    self._all(engine, [self._task(p) for p in todo], suspects)
            finally:  # an exception is no sudden death
                self.store.unmark()
        self.store.write_manifest(self._document())
        skipped = {e.clip for e in entries} - redone
        errors = self.store.table("errors", ["clip", "kind"]).to_pylist()
        reasons: dict[str, int] = {}
        for row in errors:
            if row["clip"] in redone:
                reasons[row["kind"]] = reasons.get(row["kind"], 0) + 1
        return Report(
            len(entries),
            sum(r.ok for r in self.receipts),
            sum(r.refused for r in self.receipts),
            len(skipped),
            sum(row["clip"] in skipped for row in errors),
            sum(r.frames for r in self.receipts),
            sum(r.bytes for r in self.receipts),
            len(self.receipts),
            self.removed,
            reasons,
        )

    def _task(self, part: Part) -> Task:
        aside = str(self.store.path / "aside")
        return Task(part, self.configuration, self.key, self.learnt, aside, {}, self.timeout, self.cache)

    def _all(self, engine: Engine, tasks: Sequence[Task], suspects: dict[str, int]) -> None:
        """Every task to its end: those whose worker was lost go on without the files that did it."""
        ready = []
        for task in tasks:
            if suspects.get(task.part.key, 0) >= 2:  # two runs ended with it in hand: no chance any more
                task = self._without_poison(task)
            ready.append(task)
        rounds = 0
        while ready:
            lost = []
            in_hand = (self.store.mark(t.part.key, suspects.get(t.part.key, 0), t) for t in ready)
            for task, outcome in engine.run(ready if engine.outlives else in_hand):
                if isinstance(outcome, Lost):
                    lost.append(task)
                else:
                    self._commit(task, outcome)
            rounds += 1
            if rounds > self.attempts and lost:
                raise JobFailed(f"part {lost[0].part.key} was lost {rounds} times, with no file of it to blame")
            ready = [self._without_poison(t) for t in lost]

    def _without_poison(self, task: Task) -> Task:
        self._tell("looking for the file that ended a worker")
        return replace(task, refused=find_poison(task, self.attempts, self.timeout))

    def _commit(self, task: Task, receipt: Receipt) -> None:
        """A part into place; the rows that it replaces go first, so that no clip is ever there twice."""
        clips = {e.clip for e in task.part.entries}
        written = Path(receipt.written)
        old: dict[str, set[str]] = {}
        for clip in clips:
            if clip in self.held:
                old.setdefault(self.held[clip][1], set()).add(clip)
        for part, theirs in old.items():
            if part != receipt.part:
                self._take_out(part, theirs)
        self.store.commit(receipt.part, written)
        for e in task.part.entries:
            self.held[e.clip] = e.key(self.key), receipt.part
        self.receipts.append(receipt)
        self._tell("annotating")

    def _take_out(self, part: str, clips: set[str]) -> None:
        """Rows of some clips out of a part; the rest of it stays, under another name."""
        rest = {c for c, (_, p) in self.held.items() if p == part} - clips
        if rest:
            folder = self.store.aside(f"rest-{part}")
            name = self.store.without(part, clips, folder)
            self.store.remove([part])
            if name is not None:
                self.store.commit(name, folder)
                self.held |= {c: (self.held[c][0], name) for c in rest}
        else:
            self.store.remove([part])
        for c in clips:
            self.held.pop(c, None)

    def _forget(self, roots: set[str], clips: set[str]) -> None:
        """Take out clips of these folders that are no longer in them."""
        gone: dict[str, set[str]] = {}
        for table in ("clips", "errors"):
            rows = self.store.table(table, ["clip", "root"])
            for clip, root in zip(rows["clip"].to_pylist(), rows["root"].to_pylist(), strict=True):
                if root in roots and clip not in clips:
                    gone.setdefault(self.held[clip][1], set()).add(clip)
        for part, theirs in gone.items():
            self._take_out(part, theirs)
            self.removed += len(theirs)

    def _tell(self, doing: str) -> None:
        done = sum(r.ok + r.refused for r in self.receipts)
        refused, frames = sum(r.refused for r in self.receipts), sum(r.frames for r in self.receipts)
        self.say(Progress(done, self.total, frames, refused, doing))

    def _document(self) -> dict[str, object]:
        return {"code": code_version(), "key": self.key, "configuration": self.configuration.document()}


def teach(configuration: Configuration, entries: Sequence[Entry]) -> tuple[Learnt, ...]:
    """What the templates teach: each is calibrated in its own clip, and says where it holds."""
    by_clip: dict[str, list[TemplateRule]] = {}
    for rule in configuration.templates:
        by_clip.setdefault(rule.clip, []).append(rule)
    out: list[Learnt] = []
    for clip, rules in by_clip.items():
        path = _path_of(clip, entries)
        try:
            out += _lessons(path, rules, configuration)
        except KinjaxError as error:
            raise OptionError(f"template in {clip}: {error}") from error
    return tuple(out)


def _lessons(path: str, rules: Sequence[TemplateRule], configuration: Configuration) -> list[Learnt]:
    from ..detect import calibrate, detect
    from ..joint_names import choose, role_of
    from ..motion import Motion

    names_of = tuple(dict.fromkeys(r.object for r in rules))
    source, _ = read_clip(path, replace(configuration, objects=names_of))
    names = source.skeleton.names if isinstance(source, Motion) else source.names
    skeleton, subject = skeleton_key(source), configuration.subject_of(Path(path).stem, Path(path).parent.name)
    templates: dict[str, list[tuple[Template, TemplateRule]]] = {}
    for rule in rules:
        for j in choose(names, [rule.object], path):
            templates.setdefault(names[j], []).append((Template(names[j], rule.begin, rule.end, rule.type), rule))
    noise = detect(source, list(templates), settings=configuration.settings.but(method="robust", thresholds=None))
    out = []
    for i, name in enumerate(noise.objects):
        given = templates[name]
        patterns = calibrate(source, [t for t, _ in given], settings=configuration.settings)
        role = role_of(names, names.index(name)) or name.casefold()
        spans = ", ".join(f"{t.begin}:{t.end}" for t, _ in given)
        scope = given[-1][1].scope
        value = {"skeleton": skeleton, "subject": subject, "all": ""}[scope]
        levels = float(noise.noise[i, 0]), float(noise.noise[i, 1])
        out.append(Learnt(tuple(patterns), role, scope, value, levels, f"{Path(path).name} {name} {spans}"))
    return out


def _path_of(clip: str, entries: Sequence[Entry]) -> str:
    """The file that a template's clip means: a name in the store, or a path, or a file name that occurs once."""
    for e in entries:
        if e.clip == clip:
            return e.path
    if Path(clip).is_file():
        return os.path.abspath(clip)
    same = [e.path for e in entries if Path(e.path).name == clip]
    if len(same) == 1:
        return same[0]
    many = f"{len(same)} files are called so: give FOLDER/PATH" if same else "give its path"
    raise OptionError(f"no clip {clip!r} for a template ({many})")


def _whole_key(configuration: Configuration, learnt: Sequence[Learnt]) -> str:
    text = msgspec.json.encode([configuration.key(), [msgspec.to_builtins(one) for one in learnt]])
    return hashlib.sha256(text).hexdigest()[:20]
