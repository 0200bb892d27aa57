"""Detection and the rules of thumb, side by side: the stances as labels, and the table of all methods under all conditions.

In: trials. Out: labels that `kinjax.evaluation` and `kinjax evaluate` take; an `Evaluation` by method and condition, and text. A
stance is an outer bound: precision counts within 0.25 s of it, recall its core, and begin and end are those of contact by
force, which neither a foot at rest nor a toe at rest reaches at both ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from kinjax.evaluation import Evaluation, Label, evaluate

from .conditions import disturbed
from .methods import COMPARED, labels_of
from .trials import Stance, Trial

ROLES = {"L": "left_foot", "R": "right_foot"}
SHOWN = ("clean", "1 mm white", "3 mm white", "2 % spikes", "10 % lost")
HEAD = ("method", "condition", "P", "core R", "stance R", "F1", "begin ms [quartiles]", "end ms [quartiles]")


def stance_labels(trials: Iterable[Trial], objects: Mapping[str, str] = ROLES, suffix: str = ".c3d") -> tuple[Label, ...]:
    """The stances of all trials: outer bounds, and what was left out as unknown.

    objects: what the feet are called. suffix: that of the clips' files, whose names are those of the trials.
    """
    return tuple(
        _label(f"{t.name}{suffix}", objects[s.foot], s, kind)
        for t in trials
        for kind, group in (("outer", t.stances), ("unknown", t.left_out))
        for s in group
    )


def compare(
    trials: Iterable[Trial],
    methods: Sequence[str] | None = None,
    conditions: Sequence[str] = SHOWN,
    seeds: int = 1,
    progress: Callable[[str], object] = lambda line: None,
) -> dict[tuple[str, str], Evaluation]:
    """An evaluation by method and condition (all of `COMPARED` when None).

    A template is from another stance, so each stance has a detection of its own: it is a clip of its own here, in which the other
    contacts of its foot are unknown. seeds: draws of each noise.
    """
    names = tuple(methods or COMPARED)
    clips: dict[str, list] = {"clip": [], "frames": [], "fps": []}
    labels: list[Label] = []
    found: dict[tuple[str, str], dict[str, list]] = {
        (m, c): {k: [] for k in ("clip", "object", "type", "begin", "end")} for m in names for c in conditions
    }
    for trial in trials:
        for seed in range(seeds):
            ids = [f"{trial.name}/{seed}/{n}" for n in range(len(trial.stances))]
            for clip, stance in zip(ids, trial.stances, strict=True):
                for key, value in (("clip", clip), ("frames", trial.frames), ("fps", trial.rate)):
                    clips[key].append(value)
                labels.append(_label(clip, stance.foot, stance, "outer"))
                others = [s for s in (*trial.stances, *trial.left_out) if s.foot == stance.foot and s is not stance]
                labels += [_label(clip, s.foot, s, "unknown") for s in others]
            for condition in conditions:
                markers = disturbed(trial.markers, trial.rate, condition, trial.name, seed)
                for method in names:
                    rows = found[method, condition]
                    for clip, stance, said in zip(ids, trial.stances, labels_of(method, trial, markers), strict=True):
                        for begin, end in said.spans:
                            for key, value in zip(rows, (clip, stance.foot, "space", begin, end), strict=True):
                                rows[key].append(value)
        progress(f"{trial.name}: {len(trial.stances)} stances")
    return {key: evaluate(rows, labels, clips) for key, rows in found.items()}


def comparison(results: Mapping[tuple[str, str], Evaluation], markdown: bool = False) -> str:
    """The table as text, one row a method and condition, pooled over all stances."""
    table = [HEAD, *((method, condition, *_cells(e)) for (method, condition), e in results.items())]
    widths = [max(len(row[i]) for row in table) for i in range(len(HEAD))]
    lines = [" | ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in table]
    lines.insert(1, "-|-".join("-" * w for w in widths))
    return "\n".join(f"| {line} |" if markdown else line for line in lines)


def _cells(e: Evaluation) -> tuple[str, ...]:
    t = e.total
    ratios = tuple("-" if x != x else f"{x:.3f}" for x in (t.precision, t.recall, t.whole_recall, t.f1))
    errors = (f"{s.median:+.0f} [{s.low:+.0f}, {s.high:+.0f}]" if s.count else "-" for s in (t.begin, t.end))
    return (*ratios, *errors)


def _label(clip: str, name: str, stance: Stance, kind: str) -> Label:
    return Label(clip, name, stance.begin, stance.end - 1, kind=kind)  # type: ignore[arg-type]


