"""Soft detection as a person calls it.

In: a `Task` (or what one is prepared from), thresholds or none, a temperature. Out: `SoftDetection`, padding removed.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..detect.interface import Joints
from ..errors import OptionError, ShapeError
from ..lengths import BLOCK
from ..motion import Motion, Poses
from .core import SoftDetection, run_compiled
from .instantaneous import Limits
from .task import Task, prepare


def detect(
    source: Task | Motion | Poses,
    limits: Limits | tuple[Any, Any] | None = None,
    *,
    temperature: float | Float[Array, ""] = 0.1,
    **options: Any,
) -> SoftDetection:
    """Labels in [0, 1] of every frame of every object, differentiable with respect to everything in the task and to `limits`.

    source: a `Task`, inside or outside `jit`, `grad` and `vmap`; or a clip, which is prepared first with `options` (as
    `soft.prepare`: objects, templates, settings). limits: `(sigma_max, eps_max)`, each (objects,) or (objects, displacements),
    in place of templates; without either the floor that follows from the data's own noise. As in hard detection,
    they count only above that floor. temperature: in (0, 1); as it goes to 0 labels tend to those of `kinjax.detect`.

    Raises `OptionError` and `ShapeError` for arguments that make no sense.
    """
    task = source if isinstance(source, Task) else prepare(source, **options)
    if isinstance(source, Task) and options:
        raise OptionError(f"{', '.join(options)}: options go to soft.prepare; this task is prepared already")
    if not isinstance(temperature, jax.Array) and not 0 < float(temperature) < 1:
        raise OptionError(f"temperature={temperature}: it must lie between 0 and 1")
    dtype = task.numbers.rate.dtype
    if limits is None and task.templates is None and task.settings.method == "paper" and not task.settings.thresholds:
        raise OptionError('method="paper" needs templates, limits or thresholds=(sigma_max, eps_max)')
    given = None if limits is None else _padded(limits, task, dtype)
    templates = task.templates if limits is None else None
    out = run_compiled(task.plan, task.numbers, task.clip, templates, given, jnp.asarray(temperature, dtype))
    return _trimmed(out, len(task.objects), task.frames, task.frames - task.plan.span)


def _padded(limits: Limits | tuple[Any, Any], task: Task, dtype: Any) -> Limits:
    """Thresholds for all lanes; those of padding are 1."""
    objects, n = len(task.objects), task.frames - task.plan.span
    lanes = (task.clip.used if isinstance(task.clip, Joints) else task.clip.valid).shape[0]
    out = []
    for name, x in zip(("sigma_max", "eps_max"), limits, strict=True):
        y = jnp.asarray(x, dtype)
        if y.shape not in ((objects,), (objects, n)):
            raise ShapeError(f"{name} of shape {y.shape}: it must be ({objects},) or ({objects}, {n}), by object")
        if not isinstance(x, jax.core.Tracer) and not bool(np.all(np.asarray(x) > 0)):
            raise OptionError(f"{name} must be positive everywhere")
        if y.ndim == 2:
            length = (task.clip.valid.shape[-1] - task.plan.span) // BLOCK * BLOCK
            y = jnp.concatenate([y, jnp.ones((objects, length), dtype)], axis=1)[:, :length]
        out.append(jnp.concatenate([y, jnp.ones((lanes - objects, *y.shape[1:]), dtype)]))
    return Limits(*out)


def _trimmed(x: SoftDetection, objects: int, frames: int, n: int) -> SoftDetection:
    return SoftDetection(
        x.labels[:objects, :frames],
        x.passed[:objects, :n],
        x.merged[:objects, :n],
        x.sigma[:objects, :n],
        x.eps[:objects, :n],
        x.valid[:objects, :n],
        Limits(*(y[:objects] if y.ndim == 1 else y[:objects, :n] for y in x.limits)),
        (x.noise[0][:objects], x.noise[1][:objects]),
    )
