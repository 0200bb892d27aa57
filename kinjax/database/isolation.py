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

from .work import COMPILING, JobFailed, Receipt, Task, annotate_part, one_thread


def find_poison(task: Task, attempts: int, limit: float) -> dict[str, tuple[str, str, int]]:
    """The clips of a part that end their process, or take longer than `limit` seconds to be read, `attempts` times each."""
    strikes: Counter[str] = Counter()
    refused = dict(task.refused)
    for _ in range(attempts * (len(task.part.entries) + 1)):
        clip, kind, why = _one_process(replace(task, refused=dict(refused), limit=0.0), limit)
        if kind == "":
            return refused
        strikes[clip] += 1
        if strikes[clip] >= attempts:
            if clip == "":  # it ends before it touches a file: nothing to blame
                raise JobFailed(f"a process for single files {why} {attempts} times before its first file")
            refused[clip] = kind, why, strikes[clip]
    raise JobFailed(f"part {task.part.key} ends every process that works on it")


def _one_process(task: Task, limit: float) -> tuple[str, str, str]:
    """The clip that a process came to its end with ("": none yet), and how: kind and words, empty if it did all."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_examine, args=(task, theirs), daemon=True)
    process.start()
    theirs.close()
    clip, reading = "", False
    try:
        while True:
            if not ours.poll(limit if reading else limit + COMPILING):  # it loads and compiles at first
                return clip, "timeout", f"took longer than {limit:g} s"
            clip, reading = ours.recv()
            if clip == "":
                return "", "", ""
    except (EOFError, OSError):
        process.join()
        return clip, "killed", f"ended its process ({_how(process.exitcode)})"
    finally:
        process.kill()
        process.join()
        ours.close()


def _examine(task: Task, pipe: Any) -> None:
    """In the other process: work on the part, clip by clip, and say which one begins and whether it is being read."""
    one_thread()
    receipt: Receipt = annotate_part(task, begun=lambda clip, read: pipe.send((clip, not read)))
    shutil.rmtree(Path(receipt.written), ignore_errors=True)
    pipe.send(("", False))


def _how(code: int | None) -> str:
    """An exit code in words."""
    import signal

    if code is not None and code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:
            return f"signal {-code}"
    return f"exit code {code}"
