"""`python -m benchmarks.reliability`: one table (row, what was fed, figure, measured, bar, ok or MISS); exit code 1 on a MISS."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import jax

from . import MEASURES, Row, table


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, say whether a bar was missed."""
    about = "Numerics and robust statistics against their bars."
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability", description=about)
    parser.add_argument("rows", nargs="*", choices=[[], *MEASURES], metavar="ROW", help=f"only these of {', '.join(MEASURES)}")
    parser.add_argument("--quick", action="store_true", help="fewer cases, and nothing that compiles the whole engine")
    args = parser.parse_args(argv)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    rows: list[Row] = []
    for name in args.rows or MEASURES:
        start = time.perf_counter()
        rows += MEASURES[name](not args.quick)
        print(f"{name}: {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)
    print(table(rows))
    missed = sum(not r.ok for r in rows)
    print(f"\n{len(rows)} figures, {missed} missed")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
