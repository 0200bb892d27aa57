"""Questions in SQL: the tables of a store as views of DuckDB.

In: a store and a query. Out: an Arrow table. The views are clips, constraints, patterns and errors; `constraints` carries its
clip's subject and skeleton too. `overlap_s(begin_a, end_a, begin_b, end_b)` is the time in seconds that two spans share,
negative where they are apart. The connection reads the files of this store's parts and nothing else, and loads nothing from the
network; `query` answers questions only, so it writes nothing either.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

import duckdb
import pyarrow as pa

from ..errors import FileFormatError, KinjaxError, OptionError
from .schema import TABLES
from .store import Store

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

OVERLAP = "least(end_a, end_b) - greatest(begin_a, begin_b)"
_QUESTIONS = ("select", "from", "with", "pivot", "unpivot", "table", "values")


def connect(store: Store) -> DuckDBPyConnection:
    """A connection with the views of a store, which can open the files of its parts and no others."""
    connection = duckdb.connect(
        ":memory:", config={"autoinstall_known_extensions": False, "autoload_known_extensions": False}
    )
    parts = store.parts()
    files = {table: [str(store.file(table, p)) for p in parts] for table in TABLES}
    for table in TABLES:
        name = "constraint_rows" if table == "constraints" else table
        if parts:
            listed = _listed(map(_literal, files[table]))
            connection.execute(f"CREATE VIEW {name} AS SELECT * FROM read_parquet({listed})")
        else:
            connection.register(f"empty_{table}", TABLES[table].empty_table())
            connection.execute(f"CREATE TABLE {name} AS SELECT * FROM empty_{table}")
            connection.unregister(f"empty_{table}")
    connection.execute(
        "CREATE VIEW constraints AS SELECT c.*, k.subject, k.skeleton, k.fps, k.path "
        "FROM constraint_rows c LEFT JOIN clips k USING (clip)"
    )
    connection.execute(f"CREATE MACRO overlap_s(begin_a, end_a, begin_b, end_b) AS {OVERLAP}")
    ours = {name for some in files.values() for f in some for name in (f, _literal(f))}
    connection.execute(f"SET allowed_paths={_listed(sorted(ours))}")
    connection.execute("SET python_enable_replacements=false")
    connection.execute("SET enable_external_access=false")
    connection.execute("SET lock_configuration=true")
    return connection


def _literal(path: str) -> str:
    """A path as a pattern that matches it and nothing else."""
    return re.sub(r"[*?\[]", lambda found: f"[{found[0]}]", path)


def _listed(texts: Iterable[str]) -> str:
    """Texts as a list in SQL."""
    return "[" + ", ".join("'" + t.replace("'", "''") + "'" for t in texts) + "]"


def query(store: Store | str, sql: str, parameters: object = None) -> pa.Table:
    """The answer to one question in SQL about a store; columns of one name are told apart by _1, _2, ...

    Raises `OptionError` with DuckDB's words where the SQL is wrong, and for statements that do anything but answer;
    `FileFormatError` where the store's files cannot be read.
    """
    house = store if isinstance(store, Store) else Store(store)
    try:
        with connect(house) as connection:
            _check(connection, sql)
            found = connection.sql(sql, params=parameters).to_arrow_table()
            return found.rename_columns(_distinct(found.schema.names))
    except duckdb.Error as error:
        raise _told(error, house) from error


def _check(connection: DuckDBPyConnection, sql: str) -> None:
    """One statement, and one that can change nothing. A PIVOT is several to DuckDB; that it is no COPY of one shows in its
    first word, where no comment may stand before it."""
    statements = connection.extract_statements(sql)
    if len(statements) != 1:
        raise OptionError(f"one statement of SQL is answered, and here are {len(statements)}")
    kind = statements[0].type
    several = kind == duckdb.StatementType.MULTI and re.match(r"[\s(]*(\w*)", sql)
    if kind != duckdb.StatementType.SELECT and not (several and several[1].lower() in _QUESTIONS):
        raise OptionError(
            f"{kind.name} is no question: SELECT, FROM, WITH, PIVOT, DESCRIBE, SUMMARIZE and SHOW are answered"
        )


def _told(error: duckdb.Error, store: Store) -> KinjaxError:
    """What went wrong: the query, or the files."""
    of_files = isinstance(error, duckdb.IOException | duckdb.InvalidInputException) and str(store.path) in str(error)
    if type(error) is duckdb.Error or of_files:
        remedy = "ask again if a job is writing to it; else `kinjax store check` tells what is wrong"
        return FileFormatError(f"this store cannot be read: {error}", path=store.path, remedy=remedy)
    return OptionError(f"the query is wrong: {error}")


def _distinct(names: Iterable[str]) -> list[str]:
    """Names of columns, each once."""
    given, out = list(names), list[str]()
    for name in given:
        new, n = name, 0
        while new in out or (n and new in given):
            n += 1
            new = f"{name}_{n}"
        out.append(new)
    return out
