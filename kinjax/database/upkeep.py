"""Upkeep of a store: is it whole, and fewer, larger files.

In: a store. Out: complaints in words, or the numbers of parts before and after. Compacting changes no row: what a job would
skip before, it skips after. It is safe to kill at any point: the next job, check or compact brings it to its end.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import pyarrow as pa

from ..errors import KinjaxError
from ..formats.files import write_atomically
from .catalogue import part_name
from .schema import TABLES
from .store import SETTLED, Store, write_tables

ROWS = 200_000  # of constraints in one compacted part, about


def check(store: Store) -> list[str]:
    """What is wrong with a store, in words; nothing where it is whole."""
    told: list[str] = []
    parts = store.parts()
    listed = set(store.manifest().get("parts", []))
    told += [f"part {p} is in the manifest and not in the store: annotate again" for p in sorted(listed - set(parts))]
    told += [
        f"part {p} is not in the manifest: the last job did not end; annotate again"
        for p in sorted(set(parts) - listed)
    ]
    for table in TABLES:
        for path in sorted((store.path / table).glob("*")):
            if path.stem.removeprefix("part-") not in parts:
                told.append(f"{path}: belongs to no part; the next job takes it away")
    seen: dict[str, str] = {}
    for part in parts:
        try:
            tables = {t: store.part(t, part) for t in TABLES}
        except (KinjaxError, pa.ArrowException, OSError) as error:
            told.append(str(error) if isinstance(error, KinjaxError) else f"part {part} cannot be read: {error}")
            continue
        for name, t in tables.items():
            if not t.schema.equals(TABLES[name]):
                told.append(f"part {part}: the columns of {name} are not those of this version")
        keys = [k for t in SETTLED for k in tables[t]["key"].to_pylist()]
        if part_name(keys) != part:
            told.append(f"part {part}: its name is not that of its clips")
        names = [c for t in SETTLED for c in tables[t]["clip"].to_pylist()]
        for clip in names:
            if clip in seen:
                told.append(f"{clip} is in part {seen[clip]} and in part {part}")
            seen[clip] = part
        good = dict(zip(tables["clips"]["clip"].to_pylist(), tables["clips"]["constraints"].to_pylist(), strict=True))
        counted = dict.fromkeys(good, 0)
        for clip in tables["constraints"]["clip"].to_pylist():
            if clip not in counted:
                told.append(f"part {part}: constraints of {clip}, which is not among its clips")
                break
            counted[clip] += 1
        told += [
            f"{c}: {good[c]} constraints are counted, {counted[c]} are there" for c in good if good[c] != counted[c]
        ]
    return told


def compact(store: Store, rows: int = ROWS) -> tuple[int, int]:
    """Bring parts together until each has about `rows` constraints; how many parts there were, and are."""
    with store.locked():
        finish_compaction(store)
        store.sweep()
        before = store.parts()
        groups: list[list[str]] = [[]]
        held = 0
        for part in before:
            size = store.part("constraints", part, []).num_rows
            if groups[-1] and held + size > rows:
                groups.append([])
                held = 0
            groups[-1].append(part)
            held += size
        for group in groups:
            if len(group) > 1:
                _merge(store, group)
        document = store.manifest()
        store.write_manifest({k: v for k, v in document.items() if k not in ("schema", "parts")})
        return len(before), len(store.parts())


def _merge(store: Store, parts: list[str]) -> None:
    """Several parts as one, under a note of what is being done: from there on it can only be finished."""
    tables = {t: pa.concat_tables([store.part(t, p) for p in parts]).sort_by("clip") for t in TABLES}
    name = part_name([k for t in SETTLED for k in tables[t]["key"].to_pylist()])
    folder = store.aside(f"compact-{name}")
    write_tables(tables, folder)
    write_atomically(_note(store), msgspec.json.encode([name, parts]))
    finish_compaction(store)


def finish_compaction(store: Store) -> None:
    """Bring an interrupted compaction to its end: the old parts go, the new one comes."""
    try:
        name, parts = msgspec.json.decode(_note(store).read_bytes(), type=tuple[str, list[str]])
    except (FileNotFoundError, msgspec.DecodeError):
        return
    folder = store.path / "aside" / f"compact-{name}"
    store.remove([p for p in parts if p != name])
    store.commit(name, folder, again=True)
    _note(store).unlink(missing_ok=True)


def _note(store: Store) -> Path:
    return store.path / "aside" / "compact.json"
