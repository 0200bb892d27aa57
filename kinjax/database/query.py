"""Questions in SQL: the tables of a store as views of DuckDB.

In: a store and a query. Out: an Arrow table. The views are clips, constraints, patterns and errors; `constraints` carries its
clip's subject and skeleton too. `overlap_s(begin_a, end_a, begin_b, end_b)` is the time in seconds that two spans share,
negative where they are apart. The connection reads the files of this store and nothing else, writes nothing, and loads
nothing from the network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import duckdb
import pyarrow as pa

from ..errors import OptionError
from .schema import TABLES
from .store import Store

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

OVERLAP = "least(end_a, end_b) - greatest(begin_a, begin_b)"


def connect(store: Store) -> DuckDBPyConnection:
    """A connection with the views of a store."""
    connection = duckdb.connect(
        ":memory:", config={"autoinstall_known_extensions": False, "autoload_known_extensions": False}
    )
    parts = store.parts()
    for table in TABLES:
        if parts:
            files = [str(store.file(table, p)) for p in parts]
            name = "constraint_rows" if table == "constraints" else table
            listed = ", ".join("'" + f.replace("'", "''") + "'" for f in files)
            connection.execute(f"CREATE VIEW {name} AS SELECT * FROM read_parquet([{listed}])")
        else:
            empty = TABLES[table].empty_table()
            name = "constraint_rows" if table == "constraints" else table
            connection.register(f"empty_{table}", empty)
            connection.execute(f"CREATE TABLE {name} AS SELECT * FROM empty_{table}")
            connection.unregister(f"empty_{table}")
    connection.execute(
        "CREATE VIEW constraints AS SELECT c.*, k.subject, k.skeleton, k.fps, k.path "
        "FROM constraint_rows c LEFT JOIN clips k USING (clip)"
    )
    connection.execute(f"CREATE MACRO overlap_s(begin_a, end_a, begin_b, end_b) AS {OVERLAP}")
    folder = str(store.path).replace("'", "''")
    connection.execute(f"SET allowed_directories=['{folder}']")
    connection.execute("SET enable_external_access=false")
    connection.execute("SET lock_configuration=true")
    return connection


def query(store: Store | str, sql: str, parameters: object = None) -> pa.Table:
    """The answer to one SQL statement about a store; `OptionError` with DuckDB's words where it is wrong."""
    house = store if isinstance(store, Store) else Store(store)
    with connect(house) as connection:
        try:
            found = connection.sql(sql, params=parameters)
            return pa.table({}) if found is None else found.to_arrow_table()
        except duckdb.Error as error:
            raise OptionError(f"the query is wrong: {error}") from error
