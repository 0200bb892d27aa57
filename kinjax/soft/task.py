"""What soft detection works on: a clip that was checked, named and padded once, as a pytree whose arrays can be replaced.

In: a `Motion` or `Poses`, objects, templates, settings. Out: `Task`. Errors are raised here, before any `jit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..annotations import Template
from ..detect.interface import Clip, Joints, Numbers
from ..detect.planning import numbers, template_spans, widths
from ..detect.prepare import prepared, used_joints, working_dtype
from ..detect.settings import Settings
from ..errors import OptionError, ShapeError, TemplateError
from ..lengths import bucket
from ..motion import Motion, Poses
from .core import Membership, SoftPlan

MARGIN = 16
"""Displacements on either side of a template that are looked at too, should a gradient step move its ends there."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Task:
    """One clip, ready for soft detection; a pytree, to be closed over, differentiated, stacked and mapped.

    clip: the engine's padded arrays, world poses (`Clip`) or joint rotations (`Joints`). numbers: settings that are data.
    templates: how much each frame belongs to its object's template, or None. objects: names. joints: the skeleton's joints
    that the objects need, and `translated` the rows of `Motion.translations` among them; `root` (T, 3) was taken from those.
    origin (objects, 3): metres, taken from world positions. Use `with_motion` and `with_poses` to put traced arrays in.
    """

    clip: Clip | Joints
    numbers: Numbers
    templates: Membership | None
    root: Float[Array, "t 3"]
    origin: Float[Array, "objects 3"]
    plan: SoftPlan = field(metadata={"static": True})
    objects: tuple[str, ...] = field(metadata={"static": True})
    frames: int = field(metadata={"static": True})
    joints: tuple[int, ...] = field(metadata={"static": True})
    translated: tuple[int, ...] = field(metadata={"static": True})
    settings: Settings = field(metadata={"static": True})

    def with_motion(
        self,
        rotations: Float[Array, "frames joints 4"] | None = None,
        translations: Float[Array, "frames moving 3"] | None = None,
        offsets: Float[Array, "joints 3"] | None = None,
    ) -> Task:
        """The same task on other joint rotations, translations (metres) or offsets, in the shapes that `Motion` has.

        What is left out stays. Which frames are valid stays too: numbers in other frames are ignored, and get gradient 0.
        """
        clip = self.clip
        if not isinstance(clip, Joints):
            raise OptionError("this task was prepared from world poses: use with_poses")
        length, at = clip.valid.shape[-1], np.array(self.joints, np.int32)
        if rotations is not None:
            rows = jnp.moveaxis(_frames_of(rotations, self.frames, "rotations"), 0, -1)[at]
            old = jnp.asarray(clip.rotations)
            new = old.at[: len(at), :, : self.frames].set(rows.astype(old.dtype))
            clip = clip._replace(rotations=new)
        if translations is not None:
            rows = _frames_of(translations, self.frames, "translations")[:, np.array(self.translated, np.int32)]
            rows = jnp.moveaxis(rows - jnp.asarray(self.root, rows.dtype), 0, -1)
            pad = jnp.zeros((*rows.shape[:-1], length - self.frames), rows.dtype)
            clip = clip._replace(moving=jnp.concatenate([rows, pad], axis=-1))
        if offsets is not None:
            old = jnp.asarray(clip.offsets)
            clip = clip._replace(offsets=old.at[: len(at)].set(jnp.asarray(offsets)[at].astype(old.dtype)))
        return replace(self, clip=clip)

    def with_poses(
        self,
        rotation: Float[Array, "frames objects 4"] | None = None,
        position: Float[Array, "frames objects 3"] | None = None,
    ) -> Task:
        """The same task on other world poses of the objects, in the shapes and the order that `Poses` has; else as above."""
        clip = self.clip
        if not isinstance(clip, Clip):
            raise OptionError("this task was prepared from a motion: use with_motion")
        count = len(self.objects)
        for name, value, away in (("q", rotation, None), ("t", position, self.origin)):
            if value is None:
                continue
            value = _frames_of(value, self.frames, "rotation" if away is None else "position")
            if value.shape[1] != count:
                raise ShapeError(f"poses of {value.shape[1]} objects for a task of {count}: {', '.join(self.objects)}")
            if away is not None:
                value = value - jnp.asarray(away, value.dtype)
            old = jnp.asarray(getattr(clip, name))
            new = old.at[:, :count, : self.frames].set(jnp.transpose(value, (2, 1, 0)).astype(old.dtype))
            clip = clip._replace(**{name: new})
        return replace(self, clip=clip)

    def with_template(self, weights: Float[Array, "objects frames"]) -> Task:
        """The same task with other template weights, in [0, 1] by frame; only frames near the prepared templates count."""
        if self.templates is None:
            raise OptionError("this task was prepared without templates: give prepare(..., templates=[...])")
        if weights.shape != (len(self.objects), self.frames):
            raise ShapeError(f"weights {weights.shape} must be (objects, frames) = {(len(self.objects), self.frames)}")
        old = jnp.asarray(self.templates.frames)
        new = old.at[: len(self.objects), : self.frames].set(weights.astype(old.dtype))
        return replace(self, templates=self.templates._replace(frames=new))


def _frames_of(x: Any, frames: int, what: str) -> Array:
    x = jnp.asarray(x)
    if x.ndim != 3 or x.shape[0] != frames:
        raise ShapeError(f"{what} of shape {x.shape}: a clip of {frames} frames was prepared; vmap for batches")
    return x


def prepare(
    source: Motion | Poses,
    objects: Sequence[str] | None = None,
    *,
    templates: Sequence[Template] = (),
    relative_to: str | None = None,
    settings: Settings | None = None,
    **changes: Any,
) -> Task:
    """A clip made ready for soft detection, once and on the host.

    objects, relative_to, settings and single settings by name: as `kinjax.detect.detect` has them. Space constraints of
    the robust and the paper's method only. templates: at most one for an object (thresholds that change over time
    can be given to `detect` as `Limits`). The clip's length, rate and masks shape what is compiled.

    Raises `OptionError` for settings that have no soft counterpart, and what `kinjax.detect` raises for names and templates.
    """
    settings = (settings or Settings()).but(**changes)
    for name, only in (
        ("projection", "closed"),
        ("formulation", "local"),
        ("estimator", "lmeds"),
        ("types", ("space",)),
    ):
        if getattr(settings, name) != only:
            raise OptionError(f"{name}={getattr(settings, name)!r}: soft detection has {only!r} only")
    if settings.method == "window":
        raise OptionError('method="window": soft detection has "robust" and "paper"')
    clip = prepared(source, objects, relative_to, settings)
    wide: Any = widths(settings, clip.rate)
    data = numbers(settings, clip.rate, np.zeros(clip.lanes))
    if clip.frames <= wide["span"]:
        raise OptionError(f"{clip.frames} frames cannot hold a displacement over {wide['span']}: nothing to detect")
    plan = SoftPlan(
        settings.method,
        wide["span"],
        wide["mean"],
        wide["hampel"],
        max_gap=int(data.tolerance.max_gap),
        max_missing=int(data.tolerance.max_missing),
        least=int(data.least),
        settle=settings.method == "robust",
    )
    joints: tuple[int, ...] = ()
    translated: tuple[int, ...] = ()
    root = np.zeros((0, 3))
    if isinstance(clip.arrays, Joints) and isinstance(source, Motion):
        top = source.skeleton.topology
        joints, translated = used_joints(source, [top.names.index(n) for n in clip.names])
        roots = np.array([top.parents[top.translated[k]] < 0 for k in translated])
        root = np.where(roots[:, None], clip.origin[:1], 0.0)
    return Task(
        clip.arrays,  # type: ignore[arg-type]
        data,
        _membership(templates, clip, settings, wide["span"]),
        root,  # type: ignore[arg-type]
        clip.origin,  # type: ignore[arg-type]
        plan,
        clip.names,
        clip.frames,
        joints,
        translated,
        settings,
    )


def _membership(templates: Sequence[Template], clip: Any, settings: Settings, span: int) -> Membership | None:
    """Templates as weights by frame, and the displacements that their estimate looks at."""
    spans, slots, _ = template_spans(templates, clip, settings, span, ("space",))
    if not spans:
        return None
    if slots > 1:
        raise TemplateError("soft detection takes one template an object; give thresholds over time as Limits")
    begin, end, some = (np.asarray(x)[:, 0] for x in spans[0])
    length = clip.arrays.valid.shape[-1]
    frames = np.zeros((clip.lanes, length), working_dtype())
    capacity = bucket(int((end - begin)[some].max()) + 2 * MARGIN)
    first = np.clip(begin - MARGIN, 0, None)
    at = first[:, None] + np.arange(capacity)
    for lane in np.flatnonzero(some):
        frames[lane, begin[lane] : end[lane] + 1] = 1
    at = np.where((at < length - span) & some[:, None], at, -1).astype(np.int32)
    return Membership(frames, at, some)  # type: ignore[arg-type]
