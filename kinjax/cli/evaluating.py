"""`kinjax evaluate`: the constraints in a store against labels.

In: options. Out: a table, a JSON file, an exit code.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import OptionError
from ..evaluation import Evaluation, Label, LabelScore, evaluate
from ..evaluation.text import HEAD, cells, shown
from ..formats.files import write_atomically
from ..formats.labels import read_labels
from .evaluating_options import Evaluate
from .show import Screen, table

STDOUT = Path("-")


def evaluate_command(options: Evaluate) -> int:
    """`kinjax evaluate`."""
    if options.store is None or options.labels is None:
        raise OptionError("give a store and labels: kinjax evaluate STORE LABELS")
    if options.missed < 0:
        raise OptionError(f"--missed {options.missed}: a number of labels, not negative")
    labels = read_labels(options.labels)
    core = parse_core(options.core)
    found, clips = _tables(options.store)
    told = judged(found, labels, clips, options, core)
    if not told.clips:
        names = ", ".join(name for name, _ in told.left.labels[:3])
        remedy = "labels name a clip by its id in the store, or by its file's name"
        raise OptionError(f"{options.labels}: none of its clips is in {options.store} ({names or 'it holds no labels'}); {remedy}")
    screen = Screen(options.quiet, messages=options.json == STDOUT)
    if options.json == STDOUT:
        print(told.to_json(labels=True), end="")
    else:
        _show(told, options, screen)
    for line in told.left.lines():
        screen.warn(line)
    if options.json is not None and options.json != STDOUT:
        screen.print(f"written: {write_atomically(options.json, told.to_json(labels=True).encode())}")
    return 0


def judged(found: Any, labels: tuple[Label, ...], clips: Any, options: Evaluate, core: tuple[float, float]) -> Evaluation:
    """The evaluation that the options ask for, of tables that are at hand."""
    return evaluate(
        found,
        labels,
        clips,
        objects=options.object,
        types=options.type,
        core=core,
        reach=options.reach,
        iou=options.iou,
        weigh=options.weigh,
    )


def parse_core(text: str) -> tuple[float, float]:
    """(0.25, 0.55) of "0.25:0.55"."""
    parts = text.split(":")
    try:
        first, second = map(float, parts)
    except ValueError:
        raise OptionError(f"--core {text!r}: write A:B, two parts of a label's length, as 0.25:0.55") from None
    return first, second


def _tables(path: Path) -> tuple[Any, Any]:
    """The tables of constraints and of clips in a store."""
    from ..database import Store

    store = Store(path)
    constraints = store.table("constraints", ("clip", "object", "role", "type", "begin", "end"))
    return constraints, store.table("clips", ("clip", "frames", "fps"))


def _show(told: Evaluation, options: Evaluate, screen: Screen) -> None:
    title = f"{told.clips} clips with labels of {options.labels}"
    screen.print(table(HEAD, [cells(s) for s in shown(told)], title, range(2, len(HEAD))))
    missed = told.missed()
    if missed[: options.missed]:
        head = ("clip", "object", "type", "kind", "begin", "end", "found")
        rows = [_missed_row(x) for x in missed[: options.missed]]
        screen.print(table(head, rows, f"{len(missed)} of {len(told.labels)} labels were not found", (4, 5, 6)))


def _missed_row(x: LabelScore) -> tuple[str, ...]:
    part = "-" if x.recall != x.recall else f"{100 * x.recall:.0f} %"
    return (x.clip, x.object, x.type or "any", x.kind, str(x.begin), str(x.end), part)


