"""A store of many constraints, made without detection: what questions are timed on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinjax.database.catalogue import part_name
from kinjax.database.schema import Columns
from kinjax.database.store import Store, write_tables

ROLES = ("left_foot", "right_foot", "left_hand", "right_hand")
EACH, PART = 30, 64


def make_store(path: Path, constraints: int, seed: int = 0) -> Path:
    """Clips of thirty constraints each, sixty-four clips a part."""
    rng, store = np.random.default_rng(seed), Store(path, create=True)
    clips = -(-constraints // EACH)
    for first in range(0, clips, PART):
        rows = Columns()
        names = [f"db/{i:06d}.bvh" for i in range(first, min(first + PART, clips))]
        for name in names:
            begin = np.sort(rng.integers(0, 6000, EACH))
            end = begin + rng.integers(10, 300, EACH)
            role = [ROLES[k] for k in rng.integers(0, 4, EACH)]
            kind = [("space", "space", "line", "point")[k] for k in rng.integers(0, 4, EACH)]
            place = rng.normal(size=(3, EACH))
            rows.add("constraints", name, {
                "object": role, "role": role, "type": kind, "begin": begin.tolist(), "end": end.tolist(),
                "begin_s": (begin / 120).tolist(), "end_s": (end / 120).tolist(), "duration_s": ((end - begin) / 120).tolist(),
                **{c: place[k].tolist() for k, c in enumerate("xyz")}, **{f"axis_{c}": [None] * EACH for c in "xyz"},
                "residual": [0.001] * EACH, "pattern": [0] * EACH,
            })  # fmt: skip
            rows.add("clips", name, {
                "key": [name], "path": ["/" + name], "root": ["/db"], "format": ["bvh"], "bytes": [1], "subject": [name[3:6]],
                "skeleton": ["s"], "up": ["y"], "joints": [31], "frames": [6400], "fps": [120.0], "duration_s": [53.3],
                "objects": [list(ROLES)], "constraints": [EACH], "missing": [0], "warnings": [[]], "notes": [[]],
            })  # fmt: skip
        folder = store.aside("made")
        write_tables(rows.tables(), folder)
        store.commit(part_name(names), folder)
    store.write_manifest({})
    return store.path
