"""What the numerics and the robust statistics are measured to do, against their bars: the table and the tests share it."""

from .numerics import n1, n2, n3, n4, n5, n6, n7, n8, n9, n11
from .statistics import r1, r3, r5, r6, r7, r8, r9, r10, r11
from .table import Row, table

MEASURES = {
    "N1": n1, "N2": n2, "N3": n3, "N4": n4, "N5": n5, "N6": n6, "N7": n7, "N8": n8, "N9": n9, "N11": n11,
    "R1": r1, "R3": r3, "R5": r5, "R6": r6, "R7": r7, "R8": r8, "R9": r9, "R10": r10, "R11": r11,
}  # fmt: skip
"""By row: a function of `full` that yields its figures."""

__all__ = ["MEASURES", "Row", "table"]
