"""Stores made by hand, random ones, and what `overlapping` must find in them, for the tests of questions and commands."""

from __future__ import annotations

import itertools
import math
import random
from pathlib import Path

import pyarrow as pa

from kinjax.database import Store, When
from kinjax.database.catalogue import part_name
from kinjax.database.schema import TABLES
from kinjax.database.store import write_tables

ROLES = {"LeftFoot": "left_foot", "RightFoot": "right_foot", "LeftHand": "left_hand", "mixamorig:RightHand": "right_hand", "door": None}
EMPTY = {"string": "", "int64": 0, "double": 0.0}


def filled(table: str, rows: list[dict]) -> pa.Table:
    """Rows of a table; what they do not say is empty."""
    base = {f.name: EMPTY.get(str(f.type), []) for f in TABLES[table]}
    return pa.Table.from_pylist([base | r for r in rows], schema=TABLES[table])


def store_of(path: Path, clips: dict[str, tuple[float, list[tuple]]], parts: int = 3, errors: tuple[dict, ...] = ()) -> Store:
    """A store of clips {name: (fps, [(object, type, begin, end), ...])}, in so many parts."""
    store = Store(path, create=True)
    shares = [list(clips)[i::parts] for i in range(parts)]
    for i, names in enumerate(shares):
        bad = [e for e in errors[i::parts]]
        if not names and not bad:
            continue
        rows = {"clips": [], "constraints": [], "patterns": [], "errors": bad}
        for clip in names:
            fps, found = clips[clip]
            objects = sorted({c[0] for c in found})
            rows["clips"].append(
                {"clip": clip, "key": clip, "path": f"/data/{clip}", "root": "/data", "subject": clip[:1], "skeleton": "k", "frames": 500,
                 "fps": fps, "objects": objects, "constraints": len(found)}
            )  # fmt: skip
            for o, kind, begin, end in found:
                rows["constraints"].append(
                    {"clip": clip, "object": o, "role": ROLES.get(o), "type": kind, "begin": begin, "end": end, "begin_s": begin / fps,
                     "end_s": end / fps, "duration_s": (end - begin) / fps}
                )  # fmt: skip
            rows["patterns"] += [{"clip": clip, "object": o, "role": ROLES.get(o), "sigma_max": [0.5, math.nan]} for o in objects]
        folder = store.aside(f"made-{i}")
        write_tables({t: filled(t, r) for t, r in rows.items()}, folder)
        store.commit(part_name([r["key"] for t in ("clips", "errors") for r in rows[t]]), folder)
    store.write_manifest({})
    return store


def random_clips(rng: random.Random, count: int) -> dict[str, tuple[float, list[tuple]]]:
    clips = {}
    for i in range(count):
        spans = []
        for _ in range(rng.randrange(12)):
            begin = rng.randrange(90)
            spans.append((rng.choice(list(ROLES)), rng.choice(("space", "line", "point")), begin, begin + rng.randrange(40)))
        clips[f"{'ab'[i % 2]}/{i:02d}.bvh"] = rng.choice((24.0, 29.97, 120.0)), sorted(spans, key=lambda s: s[2:])
    return clips


def random_stores(top: Path) -> list[tuple[Store, dict]]:
    """Random stores with what is in them."""
    made = []
    for seed in range(6):
        clips = random_clips(random.Random(seed), 9)
        made.append((store_of(top / f"s{seed}", clips, 1 + seed % 4), clips))
    return made


def by_hand(clips: dict, conditions: tuple[When, ...], least: float) -> list[tuple]:
    """What `overlapping` must give, by trying all combinations."""

    def fits(c: tuple, w: When, fps: float) -> bool:
        o, kind, begin, end = c
        names = {o.lower(), (ROLES.get(o) or o).lower()}
        length = (end - begin) / fps
        return (w.object is None or w.object.lower() in names) and w.type in (None, kind) and w.longer <= length <= w.shorter

    rows = []
    for clip, (fps, found) in clips.items():
        for some in itertools.product(*([c for c in found if fits(c, w, fps)] for w in conditions)):
            begin, end = max(c[2] for c in some), min(c[3] for c in some)
            if begin <= end and end / fps - begin / fps >= least:
                each = tuple(x for o, kind, b, e in some for x in (o, kind, b / fps, e / fps))
                rows.append((clip, f"/data/{clip}", fps, begin / fps, end / fps, begin, end, *each))
    return rows


def damaged(store: Store, table: str, which: int, how: str) -> None:
    path = store.file(table, store.parts()[which])
    content = path.read_bytes()
    if how == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif how == "spoilt":
        path.write_bytes(content[:4] + b"\xff" * 200 + content[204:])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        path.unlink()
