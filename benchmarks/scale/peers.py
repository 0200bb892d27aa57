"""What the job is compared with, each in processes of its own: parsing number blocks, and a script of another package."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from pathlib import Path


def parse_blocks(paths: Sequence[str]) -> int:
    """Read files and parse what stands after the frame time as one column of numbers: nothing is checked or kept."""
    import pyarrow as pa

    from kinjax.formats.bvh_numbers import _parse

    pa.set_cpu_count(1)
    total = 0
    for path in paths:
        raw = Path(path).read_bytes()
        at = raw.find(b"\n", raw.find(b"Frame Time:"))
        _parse(raw[at:])
        total += len(raw)
    return total


def toe_speed_script(paths: Sequence[str]) -> int:
    """upc-pymotion's reader and forward kinematics, then toes under 0.15 m/s after a median filter."""
    import numpy as np
    from pymotion.io.bvh import BVH
    from pymotion.ops.skeleton import fk
    from scipy.signal import medfilt

    total = 0
    for path in paths:
        bvh = BVH()
        bvh.load(path)
        rotations, positions, parents, offsets, *_ = bvh.get_data()
        where, _ = fk(rotations, positions[:, 0], offsets, parents)
        toes = [list(bvh.data["names"]).index(n) for n in ("LeftToeBase", "RightToeBase")]
        for toe in toes:
            speed = np.linalg.norm(np.diff(0.01 * where[:, toe], axis=0), axis=1) / bvh.data["frame_time"]
            planted = medfilt(speed, 11) < 0.15
            assert planted.shape == speed.shape
        total += Path(path).stat().st_size
    return total


def timed(work: Callable[[Sequence[str]], int], paths: Sequence[str], processes: int) -> tuple[float, int]:
    """Seconds and bytes of `work` on all files in so many spawned processes, their start not counted."""
    shares = [list(paths[i::processes]) for i in range(processes)]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.map(work, [s[:1] for s in shares])
        start = time.perf_counter()
        done = sum(pool.map(work, shares, chunksize=1))
        return time.perf_counter() - start, done
