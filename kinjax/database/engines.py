"""Where parts are worked on: in this process, or by Dask workers here or elsewhere.

In: tasks. Out: each task with its `Receipt`, or with `Lost` where its worker died of it. An engine knows nothing of stores;
what it gives back may come in any order, and a task that was run twice has harmed nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import Any, Protocol

from ..errors import OptionError
from ..memory import OPTIONS
from .work import JobFailed, Receipt, Task, annotate_part, one_thread

KEEP_MEMORY = {f"MALLOC_{name}_": str(size) for name, (_, size) in OPTIONS.items()}
"""A clip's arrays have the size of the last one's: memory that goes back to the system in between costs a fault a page (Dask gives
all of it back by default)."""

AHEAD = 3  # tasks that each worker has or waits with: enough to be busy, few enough to stop soon


@dataclass(frozen=True)
class Lost:
    """A task whose worker ended before it did."""

    why: str


class Engine(Protocol):
    """Works on tasks. Used as a context: what it needs is there inside, and gone after. outlives: a file that ends the process
    that works on it does not end this one."""

    outlives: bool

    def __enter__(self) -> Engine: ...
    def __exit__(self, *args: object) -> object: ...
    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt | Lost]]:
        """The outcome of every task, as they come."""
        ...


class NoWorkers(JobFailed):
    """All workers are gone, or none came."""


class Inline(AbstractContextManager["Inline"]):
    """One task after another in this process: no start-up, nothing to install. A file that ends the process ends the job, whose
    next run finds out which it was; there is no time limit."""

    outlives = False

    def __exit__(self, *args: object) -> None:
        return None

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt | Lost]]:
        for task in tasks:
            yield task, annotate_part(replace(task, limit=0.0))


class DaskWorkers(AbstractContextManager["DaskWorkers"]):
    """Dask distributed: `workers` processes of this machine, or those of the scheduler at an address.

    Local workers are spawned with one thread each for XLA (`threads` for more), and started again when they die. A
    task whose worker dies twice is `Lost`; `patience`: seconds without any worker after which the job fails.
    """

    outlives = True

    def __init__(
        self,
        workers: int | None = None,
        address: str | None = None,
        threads: int = 1,
        deaths: int = 2,
        patience: float = 60.0,
    ):
        if threads < 1 or (workers is not None and workers < 1):
            raise OptionError("workers and threads must be at least one")
        self.workers = workers or max(1, _cores() // threads)
        self.address, self.threads, self.deaths, self.patience = address, threads, deaths, patience
        self.client: Any = None
        self.cluster: Any = None

    def __enter__(self) -> DaskWorkers:
        try:
            import dask
            from distributed import Client, LocalCluster
        except ImportError as error:
            raise OptionError('Dask is not installed: pip install "kinjax[cluster]"') from error
        dask.config.set(
            {
                "distributed.worker.multiprocessing-method": "spawn",
                "distributed.scheduler.allowed-failures": self.deaths - 1,
                "distributed.worker.daemon": True,
                "distributed.nanny.pre-spawn-environ": KEEP_MEMORY,
                "distributed.comm.timeouts.connect": "30s",
                "distributed.admin.log-length": 100,
                "logging": {"distributed": "critical", "asyncio": "critical"},
            }
        )
        if self.address is None:
            self.cluster = LocalCluster(
                n_workers=self.workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                memory_limit=0,
                silence_logs=50,
            )
        try:
            self.client = Client(self.cluster or self.address, timeout=30, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise OptionError(f"no Dask scheduler answers at {self.address}: {error}") from error
        return self

    def __exit__(self, *args: object) -> None:
        for part in (self.client, self.cluster):
            if part is not None:
                part.close(timeout=10)
        self.client = self.cluster = None

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt | Lost]]:
        left = iter(tasks)
        running: dict[Any, Task] = {}
        done: SimpleQueue[Any] = SimpleQueue()

        def send() -> None:
            task = next(left, None)
            if task is not None:
                future = self.client.submit(_in_worker, task, self.threads, pure=False, retries=0)
                running[future] = task
                future.add_done_callback(done.put)

        for _ in range(AHEAD * max(1, len(self.client.scheduler_info()["workers"]) or self.workers)):
            send()
        while running:
            future = self._next(done)
            task = running.pop(future)
            outcome = self._outcome(future)
            future.release()
            send()
            yield task, outcome

    def _next(self, done: SimpleQueue[Any]) -> Any:
        """The next future that is done."""
        return self._patiently(lambda seconds: done.get(timeout=seconds), Empty)

    def _outcome(self, future: Any) -> Receipt | Lost:
        """The receipt of a future, or why there is none; what the task itself raised is raised here.

        A receipt is with the worker that made it: where that is gone, Dask does the task again, if it finds another worker.
        """
        from distributed import KilledWorker

        if future.status == "cancelled":
            raise NoWorkers("the Dask scheduler is gone")
        if future.status == "error":
            error = future.exception()
            if isinstance(error, KilledWorker):
                return Lost("its worker ended")
            raise error
        try:
            result: Receipt = self._patiently(lambda seconds: future.result(timeout=seconds), TimeoutError)
        except KilledWorker:
            return Lost("its worker ended")
        return result

    def _patiently(self, ask: Callable[[float], Any], not_yet: type[Exception]) -> Any:
        """What `ask(seconds)` gives, asked again each time that it raises `not_yet`; `NoWorkers` after `patience` seconds in which
        there was no worker."""
        without = 0.0
        while True:
            try:
                return ask(1.0)
            except not_yet:
                alive = self.client.status == "running" and self.client.scheduler_info()["workers"]
                without = 0.0 if alive else without + 1.0
                if without >= self.patience:
                    raise NoWorkers(f"there has been no Dask worker for {self.patience:g} s") from None


def _in_worker(task: Task, threads: int) -> Receipt:
    """What runs in a Dask worker."""
    if threads == 1:
        one_thread()
    return annotate_part(task)


def _cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_engine(
    name: str, workers: int | None = None, scheduler: str | None = None, threads: int = 1, patience: float = 60.0
) -> Callable[[], Engine]:
    """The engine called inline or dask; it starts when what is given here is called."""
    if name not in ("inline", "dask"):
        raise OptionError(f"no engine {name!r}: choose from inline, dask")
    if name == "inline":
        if workers not in (None, 1) or scheduler is not None:
            raise OptionError("--workers and --scheduler go with --engine dask")
        return Inline
    return lambda: DaskWorkers(workers, scheduler, threads, patience=patience)
