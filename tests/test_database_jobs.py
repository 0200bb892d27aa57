"""Jobs that are killed, workers that die, files that kill: the store is that of an undisturbed run."""

import contextlib
import os
import random
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import database_cases as cases
import pytest
from database_cases import bytes_of, finish, folder_of_clips, hooked, job

from kinjax.database import Store, annotate
from kinjax.database.engines import DaskWorkers, NoWorkers
from kinjax.database.upkeep import check

KILLS = int(os.environ.get("KINJAX_KILLS", "20"))


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """Compiled programs, kept for all jobs of these tests."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    return folder_of_clips(tmp_path_factory.mktemp("many") / "clips", 60, ("nan.bvh", "cut.bvh"))


@pytest.fixture(scope="module")
def undisturbed(clips, cache, tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("whole") / "s"
    finish(job(clips, store, cache, "--part-clips", "2"), 3)
    assert check(Store(store)) == [] and len(Store(store).parts()) > 20
    return store


def wait_for(store: Path, parts: int, process, seconds: float = 120.0) -> None:
    """Until a store has so many parts, or the process has ended."""
    end = time.monotonic() + seconds
    while parts_of(store) < parts and process.poll() is None and time.monotonic() < end:
        time.sleep(0.002)


def parts_of(store: Path) -> int:
    return len(list((store / "clips").glob("part-*.parquet"))) if (store / "clips").is_dir() else 0


def test_the_job_is_killed_at_random_times(clips, cache, undisturbed, tmp_path):
    rng, store = random.Random(4), tmp_path / "s"
    killed = 0
    while killed < KILLS:
        process = job(clips, store, cache, "--part-clips", "2")
        target = parts_of(store) + rng.choice((0, 1, 1, 2))
        wait_for(store, target, process)
        time.sleep(rng.uniform(0, 0.05))
        if process.poll() is not None:  # it came to its end before: once more from nothing
            finish(process, 3)
            assert bytes_of(store) == bytes_of(undisturbed)
            store = tmp_path / f"s{killed}"
            continue
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        killed += 1
    finish(job(clips, store, cache, "--part-clips", "2"), 3)
    assert bytes_of(store) == bytes_of(undisturbed)
    assert check(Store(store)) == [] and not list((store / "aside").iterdir())


def test_the_job_dies_at_every_change_of_the_disk(cache, tmp_path):
    clips = folder_of_clips(tmp_path / "clips", 3, ("nan.bvh",))
    whole = tmp_path / "whole"
    finish(job(clips, whole, cache, "--part-clips", "1"), 3)
    env = hooked(tmp_path / "hook", cases.COUNTING)
    points = range(1, 60, 7) if "KINJAX_KILLS" not in os.environ else range(1, 60)
    died = 0
    for at in points:
        store = tmp_path / f"s{at}"
        process = job(clips, store, cache, "--part-clips", "1", env={**env, "KINJAX_TEST_DIES_AT": str(at)})
        process.communicate(timeout=300)
        died += process.returncode == -signal.SIGKILL
        annotate([clips], store, cases.FEET, part_clips=1)
        assert bytes_of(store).keys() == bytes_of(whole).keys() and check(Store(store)) == [], at
        for name, content in bytes_of(whole).items():
            if not name.startswith("patterns"):  # measured noise differs in the last bits with the number of threads
                assert bytes_of(store)[name] == content, (at, name)
    assert died > len(points) // 2


def test_a_file_that_kills_and_one_that_hangs_end_in_errors(clips, cache, tmp_path):
    folder = folder_of_clips(tmp_path / "clips", 12)
    for name in ("kills.bvh", "hangs.bvh"):
        (folder / "s00" / name).write_bytes((folder / "s00" / "00_000.bvh").read_bytes())
    env = hooked(tmp_path / "hook", cases.HARMFUL)
    more = ("--engine", "dask", "--workers", "2", "--part-clips", "4", "--timeout", "5", "--attempts", "2")
    told = finish(job(folder, tmp_path / "s", cache, *more, env=env), 3)
    rows = {Path(r["clip"]).name: r for r in Store(tmp_path / "s").table("errors").to_pylist()}
    assert {n: (r["kind"], r["attempts"]) for n, r in rows.items()} == {"kills.bvh": ("killed", 2), "hangs.bvh": ("timeout", 2)}, told
    assert "SIGKILL" in rows["kills.bvh"]["message"] and "5 s" in rows["hangs.bvh"]["message"]
    assert Store(tmp_path / "s").table("clips").num_rows == 12 and check(Store(tmp_path / "s")) == []


def test_a_file_that_kills_the_job_itself_is_found_by_the_next_ones(cache, tmp_path):
    folder = folder_of_clips(tmp_path / "clips", 4)
    (folder / "s00" / "kills.bvh").write_bytes((folder / "s00" / "00_000.bvh").read_bytes())
    env = hooked(tmp_path / "hook", cases.HARMFUL)
    for _ in range(2):
        finish(job(folder, tmp_path / "s", cache, "--attempts", "2", env=env), -signal.SIGKILL)
    finish(job(folder, tmp_path / "s", cache, "--attempts", "2", env=env), 3)
    store = Store(tmp_path / "s")
    assert store.table("clips").num_rows == 4 and [r["kind"] for r in store.table("errors").to_pylist()] == ["killed"]


def children(pid: int) -> list[int]:
    """Processes below one that run Dask workers."""
    import psutil

    try:
        return [p.pid for p in psutil.Process(pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    except psutil.NoSuchProcess:
        return []


def test_workers_are_killed_at_random_times(clips, cache, undisturbed, tmp_path):
    rng, store = random.Random(1), tmp_path / "s"
    more = ("--engine", "dask", "--workers", "2", "--part-clips", "2")
    process = job(clips, store, cache, *more)
    for target in (1, 6, 12):
        wait_for(store, target, process)
        time.sleep(rng.uniform(0, 0.1))
        workers = children(process.pid)
        if workers:
            os.kill(rng.choice(workers), signal.SIGKILL)
    finish(process, 3)
    same(store, undisturbed)


def same(store: Path, other: Path) -> None:
    """Two stores hold the same rows; noise may differ in its last bits with the number of threads."""
    import numpy as np

    one, two = Store(store), Store(other)
    assert check(one) == [] and one.parts() == two.parts()
    for table in ("clips", "constraints", "errors"):
        a, b = one.table(table), two.table(table)
        for name in a.schema.names:
            x, y = a[name].to_pylist(), b[name].to_pylist()
            if a.schema.field(name).type == "double":
                np.testing.assert_allclose(np.array(x, float), np.array(y, float), atol=1e-5)
            else:
                assert x == y, (table, name)
    assert one.table("patterns")["status"].equals(two.table("patterns")["status"])


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two nannies with a worker each, as on several machines."""
    import subprocess
    import sys

    address = f"tcp://127.0.0.1:{random.randint(20000, 60000)}"
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    scheduler = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", address.rsplit(":", 1)[1],
         "--no-dashboard", "--no-show"], **common,
    )  # fmt: skip
    started = [scheduler]

    def nanny() -> subprocess.Popen:
        made = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nworkers", "1", "--nthreads", "1", "--host",
             "127.0.0.1", "--local-directory", str(tmp_path / "dask"), "--no-dashboard", "--memory-limit", "0"], **common,
        )  # fmt: skip
        started.append(made)
        return made

    yield address, nanny
    for p in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(p.pid, signal.SIGKILL)
        p.wait()


def test_a_nanny_is_killed_and_then_all(clips, cache, undisturbed, cluster, tmp_path):
    address, nanny = cluster
    nannies = [nanny(), nanny()]
    store = tmp_path / "s"
    more = ("--engine", "dask", "--scheduler", address, "--part-clips", "2")
    process = job(clips, store, cache, *more, "--patience", "3")
    wait_for(store, 2, process)
    os.kill(nannies[0].pid, signal.SIGKILL)
    wait_for(store, 6, process)
    os.kill(nannies[1].pid, signal.SIGKILL)
    told, _ = process.communicate(timeout=200)
    assert process.returncode in (1, 3), told  # it may have been at its end
    assert process.returncode == 3 or "no Dask worker" in told or "scheduler" in told, told
    nanny()
    finish(job(clips, store, cache, *more), 3)
    same(store, undisturbed)


def test_a_receipt_whose_worker_is_gone_is_not_waited_for_for_good():
    """Dask would do the task again, but there is no worker left that could."""

    def result(timeout: float) -> None:
        raise TimeoutError

    engine = DaskWorkers(1, patience=2)
    engine.client = SimpleNamespace(status="running", scheduler_info=lambda: {"workers": {}})
    with pytest.raises(NoWorkers, match="no Dask worker for 2 s"):
        engine._outcome(SimpleNamespace(status="finished", result=result))
