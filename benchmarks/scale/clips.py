"""The folder: walks of 60 to 20,000 frames, and one file in twenty broken in a way that files are broken in.

A pool of distinct files stands for all: others are hard links to them, so that 20,000 clips fit on a disk. Lengths are
spread evenly over octaves, as clips of a database are.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinjax.formats import save
from kinjax.motion import Motion
from kinjax.synthetic import noisy_motion, walking_biped

SHORTEST, LONGEST, BROKEN_SHARE = 60, 20_000, 0.05


def broken(text: bytes, kind: int) -> bytes:
    """The file, broken: claims, cuts, numbers that are none, nesting, other bytes."""
    head, mark, rows = text.partition(b"Frame Time:")
    claim = head.rfind(b"Frames:")
    middle = len(rows) // 2
    ways = (
        head[:claim] + b"Frames: 1000000000\n" + mark + rows,
        text[: len(text) * 2 // 3],
        head + mark + rows[:middle] + b" nan " + rows[middle:],
        head + mark + rows[:middle].replace(b".", b",") + rows[middle:],
        head + b"Frame Time: 0\n" + rows.partition(b"\n")[2],
        b"",
        bytes(range(256)) * 64,
        head.replace(b"CHANNELS 3", b"CHANNELS 4", 1) + mark + rows,
        b"HIERARCHY\nROOT a\n{\n" + b"JOINT b\n{\n" * 5000,
        head + mark + rows.rstrip()[:-3].rpartition(b"\n")[0] + b"\n1 2 3\n",
    )
    return ways[kind % len(ways)]


def walk(frames: int, seed: int) -> Motion:
    """A noisy walk of so many frames at 120 a second: the same steps again where it is longer than a pass."""
    scene = walking_biped(rate=120, steps=6).motion
    at = np.arange(frames) % scene.frames
    long = replace(scene, rotations=scene.rotations[at], translations=scene.translations[at])
    return noisy_motion(long, 0.001, seed)


def make_folder(folder: Path, count: int, pool: int, seed: int = 0, longest: int = LONGEST) -> tuple[list[Path], int]:
    """`count` files in folders of 500; those that are not broken, and the bytes of all (links counted)."""
    rng = np.random.default_rng(seed)
    lengths = np.exp(rng.uniform(np.log(SHORTEST), np.log(longest), pool)).astype(int)
    source = folder / ".pool"
    source.mkdir(parents=True, exist_ok=True)
    good, bad = [], []
    for i, frames in enumerate(lengths):
        path = save(source / f"{i}.bvh", walk(int(frames), i), digits=4)
        good.append(path)
        if i < 20:
            bad.append(source / f"broken-{i}.bvh")
            bad[-1].write_bytes(broken(path.read_bytes(), i))
    sound, total = [], 0
    for i in range(count):
        is_broken = rng.random() < BROKEN_SHARE
        original = bad[i % len(bad)] if is_broken else good[i % len(good)]
        target = folder / f"{i // 500:03d}" / f"{i % 97:02d}_{i:05d}.bvh"
        target.parent.mkdir(exist_ok=True)
        os.link(original, target)
        total += original.stat().st_size
        if not is_broken:
            sound.append(target)
    return sound, total
