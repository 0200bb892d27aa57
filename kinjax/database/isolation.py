"""Which file kills its process: the clips of one part, one after another, in a process that may die.

In: a `Task` whose worker was lost. Out: by clip, what is wrong with it and after how many attempts. The process says which
clip it begins; if it dies, or says nothing for too long, that clip has one strike, and another process goes on from there.
A clip is refused after as many strikes as `attempts`; a process that was killed from outside costs its clip one, no more.
"""

from __future__ import annotations

import multiprocessing
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from .work import Receipt, Task, annotate_part, one_thread

STARTING = 120.0
"""Seconds that a process may take before it says anything: it loads and compiles first."""


def find_poison(task: Task, attempts: int, limit: float) -> dict[str, tuple[str, str, int]]:
    """The clips of a part that end their process or take longer than `limit` seconds, `attempts` times each."""
    context = multiprocessing.get_context("spawn")
    strikes: Counter[str] = Counter()
    refused = dict(task.refused)
    for _ in range(attempts * len(task.part.entries) + 1):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=_examine, args=(replace(task, refused=dict(refused), limit=0.0), theirs), daemon=True
        )
        process.start()
        theirs.close()
        at, why = "", ""
        while True:
            if not ours.poll(limit if at else max(limit, STARTING)):
                why = f"took longer than {limit:g} s"
                break
            try:
                said = ours.recv()
            except (EOFError, OSError):
                break
            if said == "":
                process.join()
                return refused
            at = said
        process.kill()
        process.join()
        ours.close()
        if not at:  # it died before it touched a file: nothing to blame
            strikes[""] += 1
            if strikes[""] >= attempts:
                raise RuntimeError(
                    f"a process for single files ended {attempts} times before its first file: {process.exitcode}"
                )
            continue
        strikes[at] += 1
        if strikes[at] >= attempts:
            kind = "timeout" if why else "killed"
            refused[at] = kind, why or f"ended its process ({_how(process.exitcode)})", strikes[at]
    raise RuntimeError(f"part {task.part.key} ends every process that works on it")


def _examine(task: Task, pipe: Any) -> None:
    """In the other process: work on the part, clip by clip, and say which one begins; "" when all are done."""
    one_thread()
    receipt: Receipt = annotate_part(task, begun=pipe.send)
    shutil.rmtree(Path(receipt.written), ignore_errors=True)
    pipe.send("")


def _how(code: int | None) -> str:
    """An exit code in words."""
    import signal

    if code is not None and code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:
            return f"signal {-code}"
    return f"exit code {code}"
