"""Folders of small clips for the tests of `kinjax.database`, and jobs in processes of their own that may be killed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from kinjax.database import Configuration
from kinjax.detect import Settings
from kinjax.formats import save
from kinjax.motion import Motion
from kinjax.synthetic import walking_biped

FEET = Configuration(objects=("feet",))
BROKEN = {
    "cut.bvh": lambda text: text[: len(text) // 2],
    "nan.bvh": lambda text: text.replace(text.split()[-5], "nan", 1),
    "huge.bvh": lambda text: text.replace("Frames: ", "Frames: 1000000000 #", 1),
    "empty.bvh": lambda text: "",
}


@lru_cache(maxsize=1)
def walk() -> Motion:
    """Two steps, 30 frames a second."""
    return walking_biped(rate=30, steps=2).motion


def folder_of_clips(folder: Path, count: int, broken: tuple[str, ...] = ()) -> Path:
    """`count` walks that differ by where they are, in folders of ten, and broken files among them."""
    for i in range(count):
        m = walk()
        shifted = replace(m, translations=m.translations + np.array([0.1 * i, 0.0, 0.0]))
        path = folder / f"s{i // 10:02d}" / f"{i // 10:02d}_{i:03d}.bvh"
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, shifted)
    text = (folder / "s00" / "00_000.bvh").read_text()
    for name in broken:
        (folder / name).write_text(BROKEN[name](text))
    return folder


def bytes_of(store: Path) -> dict[str, bytes]:
    """Every file of a store but what is aside, with its content."""
    files = (p for p in store.rglob("*") if p.is_file() and "aside" not in p.parts and p.name != "lock")
    return {p.relative_to(store).as_posix(): p.read_bytes() for p in files}


def job(clips: Path, store: Path, cache: Path, *more: str, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """`kinjax annotate` in a process of its own, in its own session, so that it can be killed with all that it started."""
    command = [sys.executable, "-m", "kinjax", "annotate", str(clips), "-o", str(store), "--object", "feet", *more]
    variables = {**os.environ, "KINJAX_CACHE": str(cache), "JAX_PLATFORMS": "cpu", **(env or {})}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=variables, start_new_session=True
    )


def finish(process: subprocess.Popen[str], code: int = 0, seconds: float = 300.0) -> str:
    """Wait for a job; what it printed."""
    told, _ = process.communicate(timeout=seconds)
    assert process.returncode == code, told
    return told


HARMFUL = '''
"""Files called kills*.bvh end the process that reads them; hangs*.bvh never end."""
import os, signal, sys, time

real = os.open

def opened(path, *args, **kwargs):
    if sys._getframe(1).f_code.co_name == "read_bytes":
        name = os.path.basename(os.fsdecode(path))
        if name.startswith("kills"):
            os.kill(os.getpid(), signal.SIGKILL)
        while name.startswith("hangs"):
            time.sleep(60)
    return real(path, *args, **kwargs)

os.open = opened
'''

COUNTING = '''
"""The N-th call that changes the disk, N from KINJAX_TEST_DIES_AT, is this process's last."""
import os, signal

left = int(os.environ.get("KINJAX_TEST_DIES_AT", "0"))

def counted(real):
    def call(*args, **kwargs):
        global left
        if "aside" in str(args[:1]) or "part-" in str(args[:2]) or "manifest" in str(args[:2]) or real is fsync:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return real(*args, **kwargs)
    return call

fsync = os.fsync
for name in ("replace", "rename", "unlink", "mkdir", "rmdir", "fsync"):
    setattr(os, name, counted(getattr(os, name)))
'''


def hooked(folder: Path, text: str, **variables: str) -> dict[str, str]:
    """The environment in which every Python process runs `text` first."""
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(text)
    return {"PYTHONPATH": str(folder), **variables}


__all__ = ["BROKEN", "COUNTING", "FEET", "HARMFUL", "Settings", "bytes_of", "finish", "folder_of_clips", "hooked", "job", "walk"]
