"""Questions to a store: against plain Python on random stores, what a question may not do, and what is wrong with one."""

import itertools
import math
import random
import shutil
from pathlib import Path

import duckdb
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from store_cases import by_hand, damaged, random_clips, random_stores, store_of

from kinjax.cli import main
from kinjax.database import Store, When, overlapping, query
from kinjax.database.schema import TABLES
from kinjax.database.upkeep import check, compact
from kinjax.errors import FileFormatError, OptionError


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> list[tuple[Store, dict]]:
    """Random stores with what is in them."""
    return random_stores(tmp_path_factory.mktemp("random"))


OBJECTS = [None, "left_foot", "LEFTFOOT", "leftfoot", "Right_Hand", "MIXAMORIG:righthand", "door", "right_foot", "head"]
WHENS = st.builds(
    When,
    st.sampled_from(OBJECTS),
    st.sampled_from([None, "space", "line", "point"]),
    st.sampled_from([0.0, 0.1, 0.25, 1.0]),
    st.sampled_from([math.inf, 0.5, 0.2]),
)


@given(st.integers(0, 5), st.lists(WHENS, min_size=1, max_size=3), st.sampled_from([0.0, 0.05, 0.3]))
@settings(max_examples=60, deadline=None)
def test_overlapping_against_all_combinations(stores, which, conditions, least):
    store, clips = stores[which]
    found = overlapping(store, *conditions, least=least)
    rows = [tuple(r.values()) for r in found.to_pylist()]
    expected = by_hand(clips, tuple(conditions), least)
    assert sorted(rows) == sorted(expected)
    at = {name: i for i, name in enumerate(found.schema.names)}
    order = ["clip", "begin_s", "end_s", *(f"{c}_{i + 1}" for i in range(len(conditions)) for c in ("object", "begin_s"))]
    assert rows == sorted(rows, key=lambda r: [r[at[c]] for c in order])


def test_three_conditions_at_once_are_found(stores):
    """Not only empty answers are compared."""
    three = (When("left_foot"), When("right_foot"), When(None, "line"))
    counts = [len(by_hand(clips, three, 0.0)) for _, clips in stores]
    assert sum(counts) > 5
    assert [overlapping(store, *three).num_rows for store, _ in stores] == counts


def test_spans_that_share_one_frame_or_none(tmp_path):
    clips = {"a": (100.0, [("LeftFoot", "space", 0, 10), ("RightFoot", "space", 10, 30), ("LeftHand", "line", 31, 40)])}
    store = store_of(tmp_path / "s", clips)
    (row,) = overlapping(store, When("left_foot"), When("right_foot")).to_pylist()
    assert (row["begin"], row["end"], row["begin_s"], row["end_s"]) == (10, 10, 0.1, 0.1)
    assert overlapping(store, When("left_foot"), When("right_foot"), least=0.001).num_rows == 0
    assert overlapping(store, When("right_foot"), When("left_hand")).num_rows == 0
    assert overlapping(store, When("left_foot"), When("left_foot")).num_rows == 1
    assert overlapping(str(store.path), When(longer=0.1, shorter=0.1)).num_rows == 1


@pytest.mark.parametrize(
    ("conditions", "least", "says"),
    [
        ((), 0.0, "at least one"),
        ((When("left_foot", "plane"),), 0.0, "plane"),
        ((When(longer=-1),), 0.0, "longer=-1"),
        ((When(longer=math.nan),), 0.0, "longer=nan"),
        ((When(shorter=math.nan),), 0.0, "shorter=nan"),
        ((When(),), math.nan, "least=nan"),
        ((When(),), -0.5, "least=-0.5"),
    ],
)
def test_conditions_that_cannot_be(conditions, least, says, stores):
    with pytest.raises(OptionError, match=says):
        overlapping(stores[0][0], *conditions, least=least)


def test_names_are_values_and_no_sql(stores):
    for name in ("' OR 1=1 --", '"', "left_foot'; DROP TABLE clips; --", "%", "_eft_foot"):
        assert overlapping(stores[1][0], When(name)).num_rows == 0


JOIN = """
SELECT a.clip, a.object, b.object, overlap_s(a.begin_s, a.end_s, b.begin_s, b.end_s) AS shared
FROM constraints a JOIN constraints b ON a.clip = b.clip AND a.object < b.object AND a.begin <= b."end" AND b.begin <= a."end"
WHERE a.type = ? AND a.fps > ?
ORDER BY ALL
"""


def test_an_interval_join_in_sql(stores):
    for store, clips in stores:
        expected = []
        for clip, (fps, found) in clips.items():
            for a, b in itertools.product(found, found):
                begin, end = max(a[2], b[2]), min(a[3], b[3])
                if a[1] == "line" and fps > 25 and a[0] < b[0] and begin <= end:
                    expected.append((clip, a[0], b[0], end / fps - begin / fps))
        found = query(store, JOIN, ["line", 25.0])
        assert found.schema.names == ["clip", "object", "object_1", "shared"]
        assert [tuple(r.values()) for r in found.to_pylist()] == sorted(expected)


def test_the_tables_are_those_of_all_parts(stores):
    for store, clips in stores:
        assert check(store) == []
        for table in TABLES:
            rows = query(store, f"SELECT clip FROM {table} ORDER BY clip")["clip"].to_pylist()
            assert rows == sorted(store.table(table)["clip"].to_pylist())
        counted = query(store, "SELECT subject, count(*) AS n FROM constraints GROUP BY subject").to_pylist()
        assert sum(r["n"] for r in counted) == sum(len(f) for _, f in clips.values())
        assert query(store, "FROM constraints SELECT any_value(skeleton), any_value(path)").to_pylist()[0]["any_value(skeleton)"] == "k"


def test_compaction_changes_no_answer(stores, tmp_path):
    store, clips = stores[3]
    shutil.copytree(store.path, tmp_path / "s")
    small = Store(tmp_path / "s")
    before = overlapping(small, When("left_foot"), When("right_foot"))
    assert compact(small)[1] == 1 and overlapping(small, When("left_foot"), When("right_foot")) == before
    assert sorted(before.to_pylist(), key=str) == sorted(overlapping(store, When("left_foot"), When("right_foot")).to_pylist(), key=str)
    assert len(before) == len(by_hand(clips, (When("left_foot"), When("right_foot")), 0.0))


def test_an_empty_store_answers(tmp_path):
    store = Store(tmp_path / "s", create=True)
    assert query(store, "SELECT count(*) AS n FROM constraints").to_pylist() == [{"n": 0}]
    for table in TABLES:
        expected = TABLES[table].names + (["subject", "skeleton", "fps", "path"] if table == "constraints" else [])
        assert query(store, f"FROM {table}").schema.names == expected
    assert overlapping(store, When("left_foot"), When("right_foot")).num_rows == 0
    assert main(["query", str(store.path), "--when", "anything"]) == 0


def test_overlap_s(stores):
    def shared(*spans):
        return query(stores[0][0], "SELECT overlap_s(?, ?, ?, ?) AS s", list(map(float, spans)))["s"][0].as_py()

    assert [shared(0, 2, 1, 3), shared(1, 3, 0, 2), shared(0, 4, 1, 2), shared(0, 1, 1, 2)] == [1, 1, 1, 0]
    assert shared(0, 1, 3, 4) == -2


def test_parameters(stores):
    store, clips = stores[2]
    n = sum(c[0] == "door" for _, found in clips.values() for c in found)
    assert query(store, "SELECT count(*) AS n FROM constraints WHERE object = ?", ["door"])["n"][0].as_py() == n
    assert query(store, "SELECT count(*) AS n FROM constraints WHERE object = $o", {"o": "door"})["n"][0].as_py() == n


def test_columns_of_one_name_are_told_apart(stores):
    found = query(stores[0][0], "SELECT 1 AS a, 2 AS a, 3 AS a_1, 4 AS A, 5 AS a")
    assert found.schema.names == ["a", "a_2", "a_1", "A", "a_3"] and list(found.to_pylist()[0].values()) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    "sql",
    ["SELEC", "SELECT nothing FROM clips", "SELECT * FROM nowhere", "SELECT 'a'::INT", "SELECT ?", "SELECT * FROM store", "SELECT 1 FROM",
     "SELECT error('no')", "SELECT getenv('HOME')", "FROM house", "FROM parameters"],
)  # fmt: skip
def test_what_is_wrong_in_sql_is_said(sql, stores):
    with pytest.raises(OptionError, match="the query is wrong"):
        query(stores[0][0], sql)


@pytest.mark.parametrize(
    "sql",
    ["SELECT 1", "FROM clips", "WITH a AS (FROM clips) FROM a", "VALUES (1)", "TABLE errors", "DESCRIBE clips", "SUMMARIZE constraints",
     "SHOW TABLES", "PIVOT constraints ON type USING count(*) GROUP BY role", "(SELECT 1) UNION (SELECT 2);",
     "-- first\nSELECT 1 -- last", "SELECT * FROM (PIVOT constraints ON role USING count(*))"],
)  # fmt: skip
def test_every_kind_of_question_is_answered(sql, stores):
    assert query(stores[0][0], sql).num_columns > 0


# what a question may not do


def harmful(store: Path, outside: Path) -> list[str]:
    inside, part = store / "new.parquet", next((store / "errors").iterdir())
    return [
        f"COPY (SELECT 1) TO '{outside}/new.csv'",
        f"COPY clips TO '{outside}/new.parquet'",
        f"COPY (SELECT 1) TO '{inside}'",
        f"COPY (SELECT 1) TO '{part}'",
        f"COPY (SELECT 1) TO '{part}' (FORMAT parquet, USE_TMP_FILE false)",
        f"COPY (PIVOT constraints ON type) TO '{part}' (FORMAT parquet, USE_TMP_FILE false)",
        f"/* /* */ SELECT */ COPY (PIVOT constraints ON type) TO '{part}' (FORMAT parquet, USE_TMP_FILE false)",
        f"EXPLAIN ANALYZE COPY (SELECT 1) TO '{part}' (FORMAT parquet, USE_TMP_FILE false)",
        f"SELECT 1; COPY (SELECT 1) TO '{inside}'",
        f"PREPARE p AS COPY (SELECT 1) TO '{inside}'",
        f"EXPORT DATABASE '{outside}/all'",
        f"ATTACH '{outside}/new.db'",
        f"ATTACH '{store}/new.db'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET enable_external_access = true",
        "SET lock_configuration = false",
        "RESET enable_external_access",
        "PRAGMA enable_profiling",
        "CREATE TABLE t AS SELECT 1",
        "DROP VIEW clips",
        "DELETE FROM clips",
        "CALL pragma_version()",
        "CHECKPOINT",
        "",
        "-- nothing",
    ]


def reading(store: Path, outside: Path) -> list[str]:
    return [
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM read_blob('/proc/self/environ')",
        f"SELECT * FROM '{outside}/secret.csv'",
        f"SELECT * FROM read_csv('{outside}/secret.csv')",
        f"SELECT * FROM read_text('{store}/manifest.json')",
        f"SELECT * FROM read_text('{store}/../{outside.name}/secret.csv')",
        f"SELECT * FROM glob('{outside}/*')",
        f"SELECT * FROM parquet_metadata('{outside}/other.parquet')",
        "SELECT * FROM read_csv('https://example.org/x.csv')",
        "SELECT * FROM read_parquet('s3://bucket/x.parquet')",
    ]


@pytest.fixture
def guarded(tmp_path, monkeypatch):
    """A store, a folder beside it, and an empty current directory."""
    store = store_of(tmp_path / "store", random_clips(random.Random(9), 4), 2)
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret.csv").write_text("a\n1\n")
    shutil.copy(next((store.path / "clips").iterdir()), outside / "other.parquet")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return store, outside


def all_bytes(*folders: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for f in folders for p in f.rglob("*") if p.is_file()}


def test_a_question_writes_nothing_and_reads_nothing_else(guarded, tmp_path):
    store, outside = guarded
    before = all_bytes(tmp_path)
    for sql in (*harmful(store.path, outside), *reading(store.path, outside)):
        with pytest.raises(OptionError):
            query(store, sql)
        assert all_bytes(tmp_path) == before, sql


def test_a_connection_opens_no_other_files(guarded, tmp_path):
    store, outside = guarded
    before = all_bytes(tmp_path)
    outer = [sql for sql in harmful(store.path, outside) if str(outside) in sql or "new" in sql or "httpfs" in sql or "SET" in sql]
    assert len(outer) > 10
    for sql in (*outer, *reading(store.path, outside)):
        with store.connect() as connection, pytest.raises(duckdb.Error):
            for statement in connection.extract_statements(sql):
                connection.execute(statement).fetchall()
            connection.execute("EXECUTE p")
        assert all_bytes(tmp_path) == before, sql


@pytest.mark.parametrize("name", ["it's", "a[1]b", "a[", "st*r", "w?y", "b{c}", 'say "x"', "back\\slash", "ü ö", "a;b", "$A", "%20", "-o"])
def test_any_name_of_a_store(name, tmp_path):
    clips = random_clips(random.Random(3), 6)
    for other in ("a1b", "stxr", "wxy", "its"):
        store_of(tmp_path / other, {"x": (1.0, [])}, 2)
    store = store_of(tmp_path / name, clips, 2)
    assert query(store, "SELECT count(*) AS n FROM clips")["n"][0].as_py() == 6
    assert overlapping(store, When("left_foot")).num_rows == len(by_hand(clips, (When("left_foot"),), 0.0))


@pytest.mark.parametrize("how", ["cut", "spoilt", "empty", "gone"])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("table", ["constraints", "errors", "clips"])
def test_a_store_that_is_damaged_is_said(table, which, how, tmp_path, capsys):
    errors = tuple({"clip": f"z/{i}.bvh", "key": str(i), "path": f"/data/{i}", "message": "no good"} for i in range(4))
    store = store_of(tmp_path / "s", random_clips(random.Random(1), 6), 2, errors)
    damaged(store, table, which, how)
    if (table, how) != ("clips", "gone"):  # a part without clips is no part: its rows are not there
        with pytest.raises(FileFormatError, match=r"store check"):
            query(store, f"SELECT * FROM {table}")
        assert main(["query", str(store.path), f"FROM {table}"]) == 2
    assert main(["store", "check", str(store.path)]) == 3
    told = capsys.readouterr()
    assert "Traceback" not in told.err and "complaint" in told.out and "kinjax: warning:" in told.err
