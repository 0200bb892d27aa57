"""`python -m benchmarks.tables --data DIR [-o OUTDIR]`: both tables, as text, and a picture of each clip."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinjax.annotations import Template
from kinjax.errors import KinjaxError
from kinjax.kinematics import object_poses
from kinjax.motion import Motion

from . import costs, scores
from .labels import CASES, Case, Labels, Target, read_clip, read_labels
from .pictures import picture

PAPER_1 = """The paper's (2006, Pentium 4 3.2 GHz, one template and one object):
  8.2 walk    400 frames  2 templates  27 found  13.1 + 18.1 + 2.8 = 34   ms
  8.3 ladder  300 frames  4 templates  23 found   9.6 + 13.7 + 2.2 = 25.5 ms
  8.4 dance   380 frames  2 templates  19 found  12.4 + 25.7 + 2.9 = 41   ms"""
PAPER_2 = """The paper's (2006, other clips, 25 fps):
  8.2 left toe   13 constraints  186 of 400 frames   9/87 mislabelled  2.3/21.8 %
  8.3 left toe    6 constraints  182 of 300 frames   5/95 mislabelled  1.7/31.7 %
  8.4 left hand   9 constraints   96 of 380 frames  20/44 mislabelled  5.3/11.6 %"""
WORDS_2 = """scored: frames outside ambiguous spans. templates: labelled constraints long enough to be one, of all.
least, median, most: mislabelled frames over the templates, in frames of the file; least %, most %: of the scored.
sure: least/most, without frames nearer to a labelled begin or end than its uncertainty. everywhere: least/most over all
frames, ambiguous ones counted as not constrained. covered: least/most labelled constraints of which half was found.
extra+missed: of the least and the most, with the template.
truth "at rest": planted, or held still in the air. In 49_20 no hand touches anything: what is found there is hands as
stationary as the template (the paper's remark in 8.4), and against contacts alone every frame of it would be extra."""


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Columns as wide as their longest entry."""
    lines = [[str(x) for x in line] for line in (head, *rows)]
    wide = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(x.ljust(w) for x, w in zip(line, wide, strict=True)).rstrip() for line in lines)


def second(case: Case, labels: Labels, motion: Motion, out: Path | None) -> list[list[Any]]:
    """The lines of Table 2 of one clip; its picture, with the longest template of each effector."""
    targets = [t for e in case.effectors for t in labels.targets(e)]
    lines: dict[Target, list[list[Any]]] = {t: [] for t in targets}
    shown = {}
    for way in scores.WAYS:
        result = scores.scores(motion, targets, way)
        if way.templates:
            shown[way.name] = {t.effector: scores.typical(result[t]) for t in reversed(targets)}
        for t in targets:
            lines[t].append(scores.row(case.clip, t, way, result[t]))
    if out is not None:
        picture(case, labels, shown).savefig(out / f"found_{case.clip}.png", dpi=110)
    return [line for t in targets for line in lines[t]]


def first(case: Case, labels: Labels, motion: Motion, rounds: int) -> list[list[Any]]:
    """The lines of Table 1 of one clip: the first effector alone, then all, with the longest template of each."""
    lines = []
    for way in scores.WAYS[:3]:
        for effectors in (case.effectors[:1], case.effectors):
            poses = object_poses(motion, effectors)
            templates = []
            for e in effectors:
                longest = max(labels.targets(e)[0].spans, key=lambda s: s.frames)
                templates.append(Template(e, longest.begin, longest.end))
            rate = way.settings.rate or motion.rate
            frames = int((motion.frames - 1) / motion.rate * rate + 1e-6) + 1
            found = costs.cost(poses, templates, way.settings, rounds)
            lines.append(costs.row(case.clip, way.name, frames, poses, templates, found))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; write them, and the pictures, where a folder is given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tables", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds 02_01.bvh, 01_03.bvh and 49_20.bvh")
    parser.add_argument("-o", "--out", type=Path, help="folder for the tables as text and the pictures")
    parser.add_argument("--table", type=int, choices=(1, 2), help="only this table (default: both)")
    parser.add_argument("--clip", choices=[c.clip for c in CASES], help="only this clip (default: all)")
    parser.add_argument("--rounds", type=int, default=30, help="warm runs of which the fastest counts (default: 30)")
    options = parser.parse_args(arguments)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    labels, text = read_labels(), []
    cases = [c for c in CASES if options.clip in (None, c.clip)]
    try:
        motions = {c.clip: read_clip(options.data, c.clip) for c in cases}
    except KinjaxError as error:
        print(error, file=sys.stderr)
        return 2
    notes = {c: "; ".join(motions[c.clip].notes) for c in cases}
    text.append("\n".join(f"{c.clip} {c.title} (section {c.section}): {notes[c]}" for c in cases))
    if options.table != 2:
        lines = [line for c in cases for line in first(c, labels[c.clip], motions[c.clip], options.rounds)]
        text.append(f"Table 1: costs in ms, warm, best of {options.rounds}, on {costs.processor()}\n")
        text[-1] += table(costs.HEAD, lines) + "\n" + PAPER_1
    if options.table != 1:
        lines = [line for c in cases for line in second(c, labels[c.clip], motions[c.clip], options.out)]
        text.append("Table 2: mislabelled frames, every labelled constraint used as the template in turn\n")
        text[-1] += table(scores.HEAD, lines) + "\n" + WORDS_2 + "\n" + PAPER_2
    whole = "\n\n".join(text)
    print(whole)
    if options.out is not None:
        name = "tables.txt" if options.table is None else f"table_{options.table}.txt"
        (options.out / name).write_text(whole + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
