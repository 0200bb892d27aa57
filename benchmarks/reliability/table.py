"""A measured figure beside its bar, and the table of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One line of the table. `bar`: greatest value allowed, or with `least` the smallest; None: reported, not promised."""

    id: str
    fed: str
    figure: str
    value: float
    bar: float | None = None
    least: bool = False

    @property
    def ok(self) -> bool:
        """Whether the bar is met (a NaN never meets one)."""
        return self.bar is None or bool(self.value >= self.bar if self.least else self.value <= self.bar)


def table(rows: Sequence[Row]) -> str:
    """The rows as text."""
    number = lambda x: f"{x:g}" if float(x).is_integer() and abs(x) < 1e6 else f"{x:.3g}"  # noqa: E731
    cells = [("row", "fed", "figure", "measured", "bar", "")]
    for r in rows:
        bar = "-" if r.bar is None else f"{'>=' if r.least else '<='} {number(r.bar)}"
        cells.append((r.id, r.fed, r.figure, number(r.value), bar, "" if r.bar is None else "ok" if r.ok else "MISS"))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)
