"""Table 1: what detection costs, split as in the paper (section 8.5).

The engine is one compiled program, so its stages are timed as programs that stop earlier: the compiler drops what the
outputs asked for do not need. Displacements + projection: time until the sigma-epsilon values are there (for the robust
method with its filter and mean poses). Noise pattern: what it takes longer until the thresholds are there as well
(LMedS on the templates; for the robust method also the noise of the data). Constraint detection: what the whole program
(merging, refit) takes longer than that. Each is the least of several warm runs, the padded poses ready on the device.
The last column is a whole call of `detect` on the same poses, with its checks, transfers and records.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import jax

from kinjax.annotations import Template
from kinjax.detect import Detection, Settings, detect, pipeline
from kinjax.detect.engine import run_poses
from kinjax.motion import Poses


@dataclass(frozen=True)
class Cost:
    """Milliseconds by stage, of the `call` of `detect`, and the number of constraints that were found."""

    projection: float
    pattern: float
    detection: float
    call: float
    found: int

    @property
    def total(self) -> float:
        """Milliseconds of the three stages."""
        return self.projection + self.pattern + self.detection


@partial(jax.jit, static_argnames=("plan", "stop"))
def _until(plan: Any, stop: str, *arguments: Any) -> Any:
    found = run_poses(plan, *arguments)
    signals = found.sigma_3, found.eps_3
    return signals if stop == "projection" else (signals, found.limits)


def program(poses: Poses, templates: Sequence[Template], settings: Settings) -> tuple[Any, tuple[Any, ...], Detection]:
    """The plan and the arguments with which `detect` calls the compiled program, on the device; and what it finds."""
    calls = []

    def watched(plan: Any, *arguments: Any) -> Any:
        calls.append((plan, arguments))
        return run_poses(plan, *arguments)

    with mock.patch.object(pipeline, "run_poses", watched):
        found = detect(poses, templates=templates, settings=settings)
    plan, arguments = calls[-1]  # the last one had room for all constraints
    return plan, jax.device_put(arguments), found


def cost(poses: Poses, templates: Sequence[Template], settings: Settings, rounds: int = 30) -> Cost:
    """What the detection of space constraints of all objects of `poses` costs."""
    plan, arguments, found = program(poses, templates, settings)
    calls = [
        lambda: _until(plan, "projection", *arguments),
        lambda: _until(plan, "pattern", *arguments),
        lambda: run_poses(plan, *arguments),
    ]
    first, second, whole = least_times(calls, rounds)
    (call,) = least_times([lambda: detect(poses, templates=templates, settings=settings).constraints], rounds)
    return Cost(first, max(second - first, 0.0), max(whole - max(first, second), 0.0), call, len(found.constraints))


def least_times(calls: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """The least milliseconds of each call, taken in turn so that a busy moment of the machine meets all alike."""
    least = [float("inf")] * len(calls)
    for call in calls:
        jax.block_until_ready(call())
    for _ in range(rounds):
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            least[i] = min(least[i], 1e3 * (time.perf_counter() - begin))
    return least


def processor() -> str:
    """The name of what the engine runs on."""
    device = jax.devices()[0]
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{device.device_kind} ({names[0]}, {len(names)} threads)" if names else device.device_kind


HEAD = (
    "clip", "method", "frames", "objects", "templates", "found", "displacements + projection", "noise pattern",
    "constraint detection", "total", "call",
)  # fmt: skip


def row(clip: str, way: str, frames: int, poses: Poses, templates: Sequence[Template], c: Cost) -> list[Any]:
    """One line of Table 1."""
    stages = (c.projection, c.pattern, c.detection, c.total, c.call)
    objects = poses.names[0] if poses.objects == 1 else " ".join(poses.names)
    return [clip, way, frames, objects, len(templates), c.found, *(f"{x:.3f}" for x in stages)]
