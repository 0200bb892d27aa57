"""Constraints that hold at the same time: what a person asks of a database without SQL.

    overlapping(store, When("left_hand", "space", longer=1.0), When("right_foot", "line"))

is every stretch of time in which the left hand is planted, for over a second, while the right foot turns about an axis.
In: a store and two conditions or more. Out: an Arrow table, one row for each stretch. Source: the joins are interval joins of
DuckDB, on the times of the first and last frame of each constraint.
"""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from ..annotations import check_type
from ..errors import OptionError
from .sql import query
from .store import Store


@dataclass(frozen=True)
class When:
    """A condition: an object (its role, such as left_hand, or its name, in any case; None: any) is under a constraint of a type
    (None: any) that lasts at least `longer` and at most `shorter` seconds."""

    object: str | None = None
    type: str | None = None
    longer: float = 0.0
    shorter: float = float("inf")

    def sql(self, name: str) -> tuple[str, list[object]]:
        """The condition on the table called `name`, and its parameters."""
        if not (self.longer >= 0 and self.shorter >= 0):
            raise OptionError(f"longer={self.longer}, shorter={self.shorter}: give seconds, not negative")
        parts, values = [f"{name}.duration_s >= ?", f"{name}.duration_s <= ?"], [self.longer, self.shorter]
        found: list[object] = list(values)
        if self.object is not None:
            parts.append(f"(lower({name}.role) = lower(?) OR lower({name}.object) = lower(?))")
            found += [self.object, self.object]
        if self.type is not None:
            parts.append(f"{name}.type = ?")
            found.append(check_type(self.type))
        return " AND ".join(parts), found


def overlapping(store: Store | str, *conditions: When, least: float = 0.0) -> pa.Table:
    """The stretches of at least `least` seconds in which all conditions hold, by clip and time.

    Columns: clip, path, fps, begin_s, end_s, begin, end (frames), and for each condition i from 1: object_i, type_i, begin_s_i,
    end_s_i. One row for each combination of constraints.
    """
    if not conditions:
        raise OptionError("overlapping needs at least one condition")
    if not least >= 0:
        raise OptionError(f"least={least}: give seconds, not negative")
    names = [f"c{i}" for i in range(1, len(conditions) + 1)]
    tables, wheres, parameters = [], [], list[object]()
    for name, condition in zip(names, conditions, strict=True):
        where, values = condition.sql(name)
        tables.append(f"{name} AS (SELECT * FROM constraint_rows {name} WHERE {where})")
        parameters += values
    begin = f"greatest({', '.join(f'{n}.begin_s' for n in names)})"
    end = f"least({', '.join(f'{n}.end_s' for n in names)})"
    joins = f"FROM {names[0]}"
    for i, name in enumerate(names[1:], 1):
        each = " AND ".join(f"{name}.begin_s <= {o}.end_s AND {o}.begin_s <= {name}.end_s" for o in names[:i])
        joins += f" JOIN {name} ON {name}.clip = {names[0]}.clip AND {each}"
    frames = f"greatest({', '.join(f'{n}.begin' for n in names)}) AS begin, least({', '.join(f'{n}.end' for n in names)}) AS end"
    columns = ", ".join(
        f"{n}.object AS object_{i}, {n}.type AS type_{i}, {n}.begin_s AS begin_s_{i}, {n}.end_s AS end_s_{i}"
        for i, n in enumerate(names, 1)
    )
    wheres.append(f"{end} - {begin} >= ?")
    parameters.append(least)
    sql = (
        f"WITH {', '.join(tables)} SELECT {names[0]}.clip, k.path, k.fps, {begin} AS begin_s, {end} AS end_s, {frames}, "
        f"{columns} {joins} JOIN clips k ON k.clip = {names[0]}.clip WHERE {' AND '.join(wheres)} "
        f"ORDER BY {names[0]}.clip, begin_s, end_s, {', '.join(f'{n}.object, {n}.begin_s' for n in names)}"
    )
    return query(store, sql, parameters)
