"""`python -m benchmarks.forceplates --data DIR`: prints the table of detection against force plates."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from kinjax.formats.labels import write_labels

from .comparison import compare, comparison, stance_labels
from .table import evaluate, misses, report
from .trials import load_trials


def main(argv: Sequence[str] | None = None) -> int:
    """Load, evaluate, print; progress goes to stderr."""
    about = "Detection against force plates."
    parser = argparse.ArgumentParser(prog="python -m benchmarks.forceplates", description=about)
    where = "folder of trials (NAME.npz with NAME.json), or the data folder with c3d/forceplates"
    parser.add_argument("--data", required=True, metavar="DIR", help=where)
    parser.add_argument("--seeds", type=int, default=1, help="draws of each noise (default 1)")
    parser.add_argument("--markdown", action="store_true", help="print the tables in Markdown")
    parser.add_argument("--each", action="store_true", help="also list stances with precision or core recall under .98")
    parser.add_argument("--rules", action="store_true", help="compare with the rules of thumb, against stance by force")
    parser.add_argument("--labels", metavar="FILE", help="only write the stances as labels for `kinjax evaluate` (.json, .csv)")
    args = parser.parse_args(argv)
    try:
        trials = load_trials(args.data)
    except FileNotFoundError as error:
        parser.error(str(error))
    if args.labels:
        note = "stances of walking trials: outer bounds by force plates and events; unknown are those cut or short"
        print(write_labels(args.labels, stance_labels(trials), note))
        return 0
    if args.rules:
        progress = lambda line: print(line, file=sys.stderr, flush=True)  # noqa: E731
        print(comparison(compare(trials, seeds=args.seeds, progress=progress), args.markdown))
        return 0
    results = evaluate(trials, seeds=args.seeds, progress=lambda line: print(line, file=sys.stderr, flush=True))
    count = sum(len(t.stances) for t in trials)
    plates = sum(s.source == "plate" for t in trials for s in t.stances)
    print(f"{count} stances of {len(trials)} walking trials: {plates} from plates, {count - plates} from events")
    print(f"draws of each noise: {args.seeds}\n")
    print(report(results, args.markdown))
    if args.each:
        print("\n" + "\n".join(misses(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
