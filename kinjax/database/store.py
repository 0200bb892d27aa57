"""A store: a folder of Parquet tables in immutable parts, a manifest, and how parts come into it and leave it.

    STORE/manifest.json                        what was asked for, which parts there are (for people and for checks)
    STORE/{clips,constraints,patterns,errors}/part-HASH.parquet
    STORE/aside/                               what is being written; nothing in it counts
    STORE/lock                                 one job at a time

In: parts that a worker has written aside. Out: tables that DuckDB, pandas and polars open as they are. A part is put into
place by renaming, its clips last: a part counts when its file in `clips/` is there. Its name is the hash of what is in it,
so to write it again changes nothing. Names of files come from hashes alone, never from the names of clips.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ..errors import FileFormatError, OptionError
from ..formats.files import TEMPORARY, read_bytes, write_atomically
from .catalogue import part_name
from .schema import TABLES, VERSION

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

_T = TypeVar("_T")
SETTLED = ("clips", "errors")
"""The tables that say which files are done with."""


class Store:
    """The tables of an annotated database. `Store(path)` opens what is there; `create=True` makes an empty one.

    Raises `OptionError` for a folder that is no store (nothing in a folder of other things is ever touched).
    """

    def __init__(self, path: str | Path, create: bool = False):
        self.path = Path(os.path.abspath(path))
        self.manifest_path = self.path / "manifest.json"
        if not self.manifest_path.is_file():
            empty = not self.path.exists() or (self.path.is_dir() and all(map(_just_begun, self.path.iterdir())))
            if not create or not empty:
                remedy = "annotate FOLDER -o STORE makes one" if empty else "it holds other things: name another folder"
                raise OptionError(f"{path} is no store of annotations ({remedy})")
        if create:
            self.path.mkdir(parents=True, exist_ok=True)
            for name in (*TABLES, "aside"):
                (self.path / name).mkdir(exist_ok=True)
            if not self.manifest_path.is_file():
                self.write_manifest({})
        self.manifest()  # a store of another version is refused at once

    # reading

    def parts(self) -> list[str]:
        """Names of the parts that count, sorted."""
        return sorted(p.stem.removeprefix("part-") for p in (self.path / "clips").glob("part-*.parquet"))

    def file(self, table: str, part: str) -> Path:
        """Where a part of a table is."""
        return self.path / table / f"part-{part}.parquet"

    def table(self, name: str, columns: Iterable[str] | None = None) -> pa.Table:
        """A whole table (clips, constraints, patterns, errors) in memory."""
        if name not in TABLES:
            raise OptionError(f"no table {name!r}: choose from {', '.join(sorted(TABLES))}")
        wanted = None if columns is None else list(columns)
        schema = TABLES[name] if wanted is None else pa.schema([TABLES[name].field(c) for c in wanted])
        return pa.concat_tables([schema.empty_table(), *(self.part(name, p, wanted) for p in self.parts())])

    def part(self, table: str, part: str, columns: list[str] | None = None) -> pa.Table:
        """One part of a table."""
        path = self.file(table, part)
        try:
            with pq.ParquetFile(path, memory_map=False, page_checksum_verification=True) as f:
                return f.read(columns=columns)
        except (pa.ArrowException, OSError) as error:
            remedy = "`kinjax store check` tells what is wrong; annotating again makes the part anew"
            raise FileFormatError(f"this part cannot be read: {error}", path=path, remedy=remedy) from error

    def manifest(self) -> dict[str, Any]:
        """The manifest; `FileFormatError` where it is broken or of another version."""
        try:
            document = msgspec.json.decode(read_bytes(self.manifest_path))
        except msgspec.DecodeError as error:
            raise FileFormatError(
                f"the manifest is broken: {error}", path=self.manifest_path, remedy="restore it"
            ) from error
        found = document.get("schema") if isinstance(document, dict) else None
        if found != VERSION:
            raise FileFormatError(
                f"this is a store of version {found!r}, and {VERSION!r} is read",
                path=self.manifest_path,
                remedy="annotate into another folder",
            )
        return document

    def connect(self) -> DuckDBPyConnection:
        """A DuckDB connection with the four tables as views, which can read this store and nothing else."""
        from .sql import connect

        return connect(self)

    # writing: under the lock only

    @contextmanager
    def locked(self) -> Iterator[None]:
        """One writer at a time; `OptionError` at once where there is another."""
        from filelock import FileLock, Timeout

        lock = FileLock(self.path / "lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise OptionError(
                f"{self.path}: another job is writing to this store; wait for it, or name another"
            ) from None
        try:
            yield
        finally:
            lock.release()

    def aside(self, name: str) -> Path:
        """A folder for what is being written."""
        folder = self.path / "aside" / name
        folder.mkdir(parents=True)
        return folder

    def sweep(self) -> None:
        """Remove what an interrupted job has left: things aside, and files of parts that do not count."""
        for left in (self.path / "aside").iterdir():
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
        for folder in (self.path, self.path / "aside"):
            for half in folder.glob(TEMPORARY):
                half.unlink(missing_ok=True)
        parts = set(self.parts())
        for table in TABLES:
            for path in (self.path / table).glob("part-*.parquet"):
                if path.stem.removeprefix("part-") not in parts:
                    path.unlink(missing_ok=True)

    def mark(self, part: str, deaths: int, what: _T) -> _T:
        """Leave a note that this process has a part in hand: a run that dies suddenly leaves it behind. Gives `what`."""
        write_atomically(self._note, msgspec.json.encode([part, deaths]))
        return what

    def unmark(self) -> None:
        """Nothing is in hand."""
        self._note.unlink(missing_ok=True)

    def suspects(self) -> dict[str, int]:
        """The part that the last run died with, and how many runs in a row have."""
        try:
            part, deaths = msgspec.json.decode(self._note.read_bytes(), type=tuple[str, int])
        except (FileNotFoundError, msgspec.DecodeError):
            return {}
        return {part: deaths + 1}

    @property
    def _note(self) -> Path:
        return self.path / "aside" / "in-hand.json"

    def settled(self) -> dict[str, tuple[str, str]]:
        """Every file that is done with: clip -> (key, part). A part that cannot be read is taken out: it will be made anew."""
        out: dict[str, tuple[str, str]] = {}
        for part in self.parts():
            try:
                tables = [self.part(t, part, ["clip", "key"]) for t in SETTLED]
                for t in TABLES:
                    self.part(t, part)
            except FileFormatError:
                self.remove([part])
                continue
            for t in tables:
                for clip, key in zip(t["clip"].to_pylist(), t["key"].to_pylist(), strict=True):
                    out[clip] = key, part
        return out

    def commit(self, part: str, written: Path, again: bool = False) -> None:
        """Put the files of a part, written aside, into place; the clips come last. again: some may be there already."""
        for table in TABLES:
            source = written / f"{table}.parquet"
            if not again or source.exists():
                os.replace(source, self.file(table, part))
        shutil.rmtree(written, ignore_errors=True)

    def remove(self, parts: Iterable[str]) -> None:
        """Take parts out: first they stop to count, then they go."""
        for part in parts:
            for table in reversed(list(TABLES)):
                self.file(table, part).unlink(missing_ok=True)

    def without(self, part: str, clips: set[str], written: Path) -> str | None:
        """What is left of a part without some clips, written aside; its name, or None where nothing is left."""
        tables = {t: self.part(t, part) for t in TABLES}
        gone = pa.array(sorted(clips), pa.string())
        rest = {n: t.filter(pc.invert(pc.is_in(t["clip"], value_set=gone))) for n, t in tables.items()}
        keys = [k for t in SETTLED for k in rest[t]["key"].to_pylist()]
        if not keys:
            return None
        write_tables(rest, written)
        return part_name(keys)

    def write_manifest(self, more: Mapping[str, Any]) -> None:
        """Write the manifest: what is given, and the parts that there are. It holds no times, so equal stores are equal."""
        document = {"schema": VERSION, **more, "parts": self.parts()}
        data = msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n"
        if not (self.manifest_path.is_file() and self.manifest_path.read_bytes() == data):
            write_atomically(self.manifest_path, data)


def _just_begun(path: Path) -> bool:
    """What a job may leave in a new store that it was killed in before there was a manifest."""
    if path.is_dir():
        return path.name in (*TABLES, "aside") and not any(path.iterdir())
    return path.name == "lock" or path.match(TEMPORARY)


def write_tables(tables: Mapping[str, pa.Table], folder: Path) -> None:
    """The four tables as files in a folder, on disk when this returns; equal tables give equal bytes."""
    for name, schema in TABLES.items():
        with open(folder / f"{name}.parquet", "xb") as f:
            pq.write_table(tables[name].cast(schema), f, compression="zstd", write_page_checksum=True)
            f.flush()
            os.fsync(f.fileno())
