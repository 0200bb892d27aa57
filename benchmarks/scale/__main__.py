"""`python -m benchmarks.scale [--clips N] [--pool N] [--engine dask] [--kills N] [--query ROWS]`: measure, and print."""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.scale.clips import LONGEST, make_folder
from benchmarks.scale.peers import parse_blocks, timed, toe_speed_script


def command(folder: Path, store: Path, options: argparse.Namespace) -> list[str]:
    """The job as a user runs it."""
    more = ["--workers", str(options.workers)] if options.engine == "dask" else []
    return [
        sys.executable, "-m", "kinjax", "annotate", str(folder), "-o", str(store), "--object", options.object,
        "--engine", options.engine, *more,
    ]  # fmt: skip


def memory_of(process: subprocess.Popen[str]) -> list[int]:
    """MiB of a process and of each that it started, largest first."""
    import psutil

    try:
        tree = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        return sorted((p.memory_info().rss >> 20 for p in tree), reverse=True)
    except psutil.NoSuchProcess:
        return []


def run_job(folder: Path, store: Path, options: argparse.Namespace, cache: Path) -> tuple[float, list[int]]:
    """Seconds of the job, and the MiB of its largest process, every second."""
    env = {**os.environ, "KINJAX_CACHE": str(cache)}
    start, curve = time.perf_counter(), []
    process = subprocess.Popen(command(folder, store, options), env=env, stdout=subprocess.PIPE, text=True)
    while process.poll() is None:
        time.sleep(1.0)
        curve.append(next(iter(memory_of(process)), 0))
    told = process.stdout.read() if process.stdout else ""
    seconds = time.perf_counter() - start
    if process.returncode not in (0, 3):
        raise SystemExit(told)
    print(told.rstrip())
    return seconds, curve


def speed(options: argparse.Namespace, top: Path) -> None:
    """Rates of the job, of parsing, and of the peer; memory; what was refused."""
    folder, store = top / "clips", top / "store"
    sound, total = make_folder(folder, options.clips, options.pool, longest=options.longest)
    bad = options.clips - len(sound)
    print(f"{options.clips:,} files, {bad} of them broken, {total / 1e6:,.0f} MB, 60 to {options.longest:,} frames", flush=True)
    cache = top / "programs"
    if options.warm:
        shutil.rmtree(store, ignore_errors=True)
        run_job(folder, store, options, cache)
        shutil.rmtree(store)
    sample = [str(p) for p in sound[: options.sample]]
    before, size = timed(parse_blocks, sample, options.workers)
    seconds, curve = run_job(folder, store, options, cache)
    after, _ = timed(parse_blocks, sample, options.workers)
    parse = 2 * size / (before + after) / 1e6
    job = total / seconds / 1e6
    programs = len(list(cache.glob("*run_clips*-cache"))) if cache.is_dir() else 0
    print(f"job, read to store: {seconds:.1f} s, {options.clips / seconds:.1f} clips/s, {job:.1f} MB/s; compiled {programs} programs")
    print(f"number blocks alone, {options.workers} processes: {parse:.1f} MB/s; the job runs at {job / parse:.2f} of that")
    if len(curve) > 10:
        third = len(curve) // 3
        parts = [max(curve[i * third : (i + 1) * third]) for i in range(3)]
        print(f"largest memory of a process: {parts[0]}, {parts[1]}, {parts[2]} MiB in the three thirds of the time")
    try:
        few = sample[: max(options.workers, min(len(sample), 40))]
        took, read = timed(toe_speed_script, few, options.workers)
        rate = read / took / 1e6
        print(f"upc-pymotion and the toe-speed rule: {rate:.2f} MB/s; the job is {job / rate:.1f} times as fast")
    except ImportError as error:
        print(f"upc-pymotion is not installed: {error}")
    start = time.perf_counter()
    env = {**os.environ, "KINJAX_CACHE": str(cache)}
    again = subprocess.run(command(folder, store, options), env=env, stdout=subprocess.DEVNULL)
    print(f"a second run: {time.perf_counter() - start:.1f} s, exit code {again.returncode}")


def kills(options: argparse.Namespace, top: Path) -> None:
    """The job killed at random times, resumed each time; its store against an undisturbed one's."""
    folder, rng = top / "clips", random.Random(0)
    make_folder(folder, options.clips, options.pool, longest=400)
    cache = top / "programs"
    run_job(folder, top / "whole", options, cache)
    done, stores = 0, 0
    while done < options.kills:
        store, stores = top / f"store-{stores}", stores + 1
        while done < options.kills:
            process = subprocess.Popen(
                command(folder, store, options), env={**os.environ, "KINJAX_CACHE": str(cache)},
                stdout=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
            try:
                process.wait(rng.uniform(0.5, 6.0))
                break
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                done += 1
        else:
            run_job(folder, store, options, cache)
        same = contents(store) == contents(top / "whole")
        print(f"{done} kills; store {stores} equals the undisturbed one: {same}")
        if not same:
            raise SystemExit(1)
        shutil.rmtree(store)


def contents(store: Path) -> dict[str, bytes]:
    """Every table's files."""
    return {p.relative_to(store).as_posix(): p.read_bytes() for p in sorted(store.glob("*/part-*.parquet"))}


def questions(options: argparse.Namespace, top: Path) -> None:
    """Questions to a store of many constraints, in this process and as a command."""
    from benchmarks.scale.rows import make_store
    from kinjax.database import Store, When, overlapping, query

    store = Store(make_store(top / "store", options.query))
    asked = {
        "by role": "SELECT role, type, count(*), sum(duration_s) FROM constraints GROUP BY ALL",
        "clips where the left hand is planted for over a second while the right foot turns about an axis":
            "SELECT DISTINCT h.clip FROM constraints h JOIN constraints f ON f.clip = h.clip AND f.begin_s <= h.end_s "
            "AND h.begin_s <= f.end_s WHERE h.role = 'left_hand' AND h.type = 'space' AND h.duration_s > 1 "
            "AND f.role = 'right_foot' AND f.type = 'line'",
    }  # fmt: skip
    for name, sql in asked.items():
        start = time.perf_counter()
        found = query(store, sql)
        print(f"{time.perf_counter() - start:.3f} s, {found.num_rows:,} rows: {name}")
    start = time.perf_counter()
    found = overlapping(store, When("left_hand", "space", longer=1.0), When("right_foot", "line"))
    print(f"{time.perf_counter() - start:.3f} s, {found.num_rows:,} rows: the same by `overlapping`")
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "kinjax", "query", str(store.path), asked["by role"]], stdout=subprocess.DEVNULL, check=True)
    print(f"{time.perf_counter() - start:.3f} s: the first as a command, with the start of Python")


def main() -> int:
    """Parse the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--clips", type=int, default=400, help="files in the folder (default 400)")
    parser.add_argument("--pool", type=int, default=80, help="distinct files among them (default 80)")
    parser.add_argument("--longest", type=int, default=LONGEST, help="frames of the longest clip (default 20,000)")
    parser.add_argument("--sample", type=int, default=200, help="files that are parsed for comparison (default 200)")
    parser.add_argument("--engine", choices=("inline", "dask"), default="dask")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--object", default="feet")
    parser.add_argument("--warm", action="store_true", help="run the job once before it is timed: programs are compiled then")
    parser.add_argument("--kills", type=int, default=0, help="instead: kill the job so often")
    parser.add_argument("--query", type=int, default=0, help="instead: ask a store of so many constraints")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="kinjax-scale-") as folder:
        top = Path(folder)
        if options.query:
            questions(options, top)
        elif options.kills:
            kills(options, top)
        else:
            speed(options, top)
    return 0


if __name__ == "__main__":
    sys.exit(main())
