"""Which files there are, and in what parts they are worked on.

In: folders. Out: `Entry` by file, and `Part`s: lists of clips of one kind (format, topology, length bucket, rate), cut
where the hash of a name says so. A part depends on nothing but its own clips, so that it is the same whichever run makes it,
and a new file changes one part and not those after it. What a header claims here is a hint, for sorting: whether a file
is good is found out when it is read, by its reader.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

from ..errors import OptionError
from ..formats import motion_suffixes
from ..formats.files import clean_text
from ..lengths import BLOCK, octave

_HEAD = 1 << 16  # bytes of a file that are looked at for hints
_FRAMES = re.compile(rb"frames?[ \t]*:?\s*(\d{1,9})\s+frame[ \t]*time[ \t]*:?\s*(\S{1,40})", re.IGNORECASE)
_NODE = re.compile(rb"(?:ROOT|JOINT)[ \t]+(\S+)|CHANNELS[ \t]+(\d+)", re.IGNORECASE)
_MOST_BYTES = 128 << 20  # of one part: a worker that is lost loses no more


@dataclass(frozen=True)
class Entry:
    """One file. clip: its name in the store, FOLDER/path below it; root: that folder, absolute. stamp: what is known of it
    without reading it whole (sizes and times of the file and of those it needs); kind: what files of one part share."""

    clip: str
    path: str
    root: str
    bytes: int
    stamp: str
    format: str
    kind: tuple[str, ...] = ()

    def key(self, configuration: str) -> str:
        """Names the annotation of this file, as it is now, under a configuration."""
        text = "\0".join((self.clip, self.path, self.stamp, configuration))
        return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:20]


@dataclass(frozen=True)
class Part:
    """Clips that are worked on together and stand in one file of each table."""

    key: str
    entries: tuple[Entry, ...]

    @property
    def bytes(self) -> int:
        """Of all its files."""
        return sum(e.bytes for e in self.entries)


def find_clips(
    folders: Sequence[str | Path],
    include: Sequence[str] = (),
    exclude: Sequence[str] = (),
    without: Path | None = None,
    progress: Callable[[int], object] | None = None,
) -> list[Entry]:
    """The motion files in folders (or files given by name), by clip name; hidden ones and `without` are left out.

    Links to folders are not followed, links to files are. Raises `OptionError` for a folder that is not there, and for two
    folders of one name, whose clips could not be told apart.
    """
    roots: dict[str, Path] = {}
    entries: dict[str, Entry] = {}
    suffixes = motion_suffixes()
    for given in folders:
        top = Path(os.path.abspath(given))
        if not top.exists():
            raise OptionError(f"no such folder: {given}")
        root = top if top.is_dir() else top.parent
        name = clean_text(root.name or "root")
        if roots.setdefault(name, root) != root:
            raise OptionError(
                f"{roots[name]} and {root} have one name, and their clips would too: give the folder that holds both"
            )
        for path in _walk(top, without) if top.is_dir() else [top]:
            below = path.relative_to(root).as_posix()
            if path.suffix.lower() not in suffixes or (include and not any(fnmatch(below, p) for p in include)):
                continue
            if any(fnmatch(below, p) for p in exclude):
                continue
            clip = f"{name}/{clean_text(below)}"
            while clip in entries and entries[clip].path != str(path):  # two names that no encoding holds
                clip += "_"
            entries[clip] = _entry(clip, path, root)
            if progress is not None:
                progress(len(entries))
    return [entries[c] for c in sorted(entries)]


def _walk(folder: Path, without: Path | None) -> Iterator[Path]:
    """Files below a folder, sorted, without recursion: a path may be deeper than Python's stack."""
    left = [folder]
    while left:
        here = left.pop()
        try:
            with os.scandir(here) as found:
                inside = sorted(found, key=lambda e: e.name, reverse=True)
        except PermissionError:
            continue
        files = []
        for item in inside:
            if item.name.startswith("."):
                continue
            if item.is_dir(follow_symlinks=False):
                if without is None or Path(item.path) != without:
                    left.append(Path(item.path))
            elif not (item.is_symlink() and os.path.isdir(item.path)):
                files.append(Path(item.path))
        yield from reversed(files)


def _entry(clip: str, path: Path, root: Path) -> Entry:
    """A file with its stamp and the hints of its header."""
    suffix = path.suffix.lower()
    size, stamp = _stamp(path)
    kind: tuple[str, ...] = (suffix,)
    if suffix == ".amc":
        skeletons = sorted(p for p in path.parent.glob("*") if p.suffix.lower() == ".asf")
        stamp = "+".join([stamp, *(f"{p.name}:{_stamp(p)[1]}" for p in skeletons)])
        kind = (suffix, path.stem.partition("_")[0], _octave(size))
    elif suffix == ".bvh":
        kind = (suffix, *_bvh_hints(path))
    elif size >= 0:
        kind = (suffix, _octave(size))
    return Entry(clip, str(path), str(root), max(size, 0), stamp, suffix[1:], kind)


def _stamp(path: Path) -> tuple[int, str]:
    """Size and what changes with the content, as far as the file system says; -1 for what is no readable file."""
    try:
        status = path.stat()
    except OSError as error:
        return -1, f"error:{error.errno}"
    except ValueError:
        return -1, "error:name"
    if not stat.S_ISREG(status.st_mode):
        return -1, f"kind:{stat.S_IFMT(status.st_mode):o}"
    return status.st_size, f"{status.st_size}:{status.st_mtime_ns}"


def _octave(size: int) -> str:
    return str(max(size, 1).bit_length())


def _bvh_hints(path: Path) -> tuple[str, ...]:
    """Joints and channels (hashed), length bucket and frame time, as the beginning of the file has them."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with open(handle, "rb") as f:
            head = f.read(_HEAD)
    except (OSError, ValueError):
        return ("unreadable",)
    found = _FRAMES.search(head)
    if found is None:
        return ("no header",)
    nodes = b" ".join(a or b for a, b in _NODE.findall(head, 0, found.start()))
    frames = min(int(found[1]), 1 << 24)
    return hashlib.sha256(nodes).hexdigest()[:12], str(octave(frames + BLOCK)), found[2].decode("latin-1")


def in_parts(entries: Iterable[Entry], configuration: str, clips: int = 64) -> list[Part]:
    """Parts of about `clips` clips each: clips of one kind in the order of their names, cut behind a clip whose hash says so.

    The first part of every kind comes first, then the second of each: workers that begin together compile different programs,
    and find each other's when they come to them.
    """
    kinds: dict[tuple[str, ...], list[Entry]] = {}
    for e in sorted(entries, key=lambda e: e.clip):
        kinds.setdefault((e.root, *e.kind), []).append(e)
    rounds: dict[int, list[Part]] = {}
    for kind in sorted(kinds):
        parts: list[Part] = []
        some: list[Entry] = []
        for e in kinds[kind]:
            some.append(e)
            digest = int.from_bytes(hashlib.sha256(e.clip.encode()).digest()[:4], "big")
            if digest % clips == 0 or len(some) >= 4 * clips or sum(x.bytes for x in some) >= _MOST_BYTES:
                parts.append(_part(some, configuration))
                some = []
        if some:
            parts.append(_part(some, configuration))
        for i, part in enumerate(parts):
            rounds.setdefault(i, []).append(part)
    return [part for i in sorted(rounds) for part in rounds[i]]


def _part(entries: Sequence[Entry], configuration: str) -> Part:
    return Part(part_name([e.key(configuration) for e in entries]), tuple(replace(e, kind=()) for e in entries))


def part_name(keys: Sequence[str]) -> str:
    """The name of a part with these clips: it says nothing else, so equal parts have one name."""
    return hashlib.sha256("\0".join(sorted(keys)).encode()).hexdigest()[:24]
