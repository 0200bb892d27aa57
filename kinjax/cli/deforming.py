"""`kinjax deform` and `kinjax clean`: a motion bent to an edit file, or to the constraints that are found in it.

In: options. Out: the motion, a table, and if asked for a report as JSON, schema `kinjax-deformation/1`:

* clip, fps, frames: of the motion; passes: how often it was solved; notes: what is worth knowing, in words;
* constraints: in the order of the edit, each with name, unit ("m" or "rad"), layer (1 the most important, null: weight 0),
  largest and mean residual and the frame of the largest (null: never active), status (a count for each word),
  and of every active frame its number (frames_active), residuals (null: not finite) and statuses;
* change: rms and largest turn of a joint (radians, with its name and frame) and of the root (metres), and joints: the largest
  of each joint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..annotations import Annotations, Constraints
from ..deform import STATUSES, Deformation, Settings, constraints_from, deform
from ..detect import detect
from ..errors import OptionError, UnknownNameError, find_name
from ..motion import Motion
from .assignments import assignments
from .cache import use_cache
from .options import Clean, Deform, Deforming
from .request import check_file, default_objects, load_clip, request
from .show import Busy, Screen, summary

MOTIONS = (".bvh", ".npz")
SCHEMA = "kinjax-deformation/1"


def deform_command(options: Deform) -> int:
    """`kinjax deform`."""
    clip = _checked(options.clip, options)
    if options.edit is None:
        raise OptionError("no edit is given: kinjax deform CLIP EDIT.toml -o OUT.bvh (docs/edit-files.md)")
    check_file(options.edit, "edit file")
    from ..formats.edits import read_edit

    edit = read_edit(options.edit)
    motion = _motion(clip, options)
    goals = edit.constraints(float(motion.rate), motion.skeleton.names)
    screen = Screen(options.quiet)
    use_cache()
    with screen.busy() as busy:
        done = deform(motion, goals, _settings(options, edit.settings), _progress(busy))
    _finish(done, clip, options, screen)
    return 0


def clean_command(options: Clean) -> int:
    """`kinjax clean`."""
    clip = _checked(options.clip, options)
    motion = _motion(clip, options)
    settings = _settings(options, Settings())
    screen = Screen(options.quiet)
    use_cache()
    with screen.busy() as busy:
        busy.step(f"looking for constraints in {clip.name}")
        found, note = _found(motion, clip, options)
        goals = constraints_from(found, motion, relative_to=options.relative_to, ease=options.ease)
        done = deform(motion, goals, settings, _progress(busy))
    screen.print(f"{clip.name}: {summary(found)}")
    if note:
        screen.print(note)
    rolls = sum(c.type != "space" for c in found.constraints)
    kept = sum(" line 1 " in g.name or " point " in g.name for g in goals)
    if rolls > kept:
        screen.print(f"{rolls - kept} of {rolls} lines and points are left to the rests beside them")
    if not goals:
        screen.warn("there is nothing to hold: the motion is written as it is")
    _finish(done, clip, options, screen)
    return 0


def _checked(clip: Path | None, options: Deforming) -> Path:
    """What can be known to be wrong before anything is loaded."""
    if clip is None:
        raise OptionError("no clip is given")
    check_file(clip)
    if options.output is None:
        raise OptionError("-o FILE says where the motion goes (.bvh or .npz)")
    if options.output.suffix.lower() not in MOTIONS:
        raise OptionError(f"{options.output}: motion is written as {' or '.join(MOTIONS)}")
    if options.report is not None and options.report.suffix.lower() != ".json":
        raise OptionError(f"{options.report}: the report is written as .json")
    edit = getattr(options, "edit", None) or getattr(options, "annotations", None)
    for target in (options.output, options.report):
        for source in (clip, edit):
            if target is not None and source is not None and target.resolve() == source.resolve():
                raise OptionError(f"{target} would be written over: name another file")
    return clip


def _motion(clip: Path, options: Deform | Clean) -> Motion:
    motion = load_clip(clip, options)
    if not isinstance(motion, Motion):
        raise OptionError(f"{clip.name} holds poses of objects: only the motion of a skeleton can be bent")
    return motion


def _settings(options: Deforming, base: Settings) -> Settings:
    """The settings of the edit, or of cleaning, with what the options change."""
    changes: dict[str, Any] = {"iterations": options.iterations, "precision": options.precision}
    changes = {k: v for k, v in changes.items() if v is not None}
    return replace(base, **(changes | assignments("--solver", options.solver, Settings, _word, _no_setting)))


def _word(name: str, text: str) -> Any:
    """The value of a setting of the solver: a word for nothing, yes and no, or the text as it is."""
    return {"none": None, "off": None, "true": True, "false": False}.get(text.strip().lower(), text.strip())


def _no_setting(name: str) -> None:
    raise UnknownNameError(name, [f.name for f in fields(Settings)], "setting", "--solver")


def _progress(busy: Busy) -> Callable[[int, int], None]:
    busy.step("compiling (only the first edit of a kind does)")
    return lambda done, total: busy.step(f"{done} of {total} frames")


def _found(motion: Motion, clip: Path, options: Clean) -> tuple[Annotations, str]:
    """The constraints to keep, and a note on the objects."""
    named = [n for group in options.object for n in group]
    if options.annotations is None:
        note = ""
        if not named and not options.template:
            objects, note = _feet(motion)
            options = replace(options, object=(objects,))
        asked = request(options, motion, clip.name)
        found = detect(
            motion, objects=list(asked.objects), templates=list(asked.templates), relative_to=asked.relative_to,
            settings=asked.settings,
        )  # fmt: skip
        return _fitting(found.annotations(), motion), note or asked.note
    if options.template:
        raise OptionError("--template is for detection, and --annotations says what was found")
    from ..formats import read_annotations

    found_before = read_annotations(check_file(options.annotations, "annotations file"))
    top = motion.skeleton.topology
    wanted = {top.names[find_name(n, top.names, "joint", clip.name)] for n in named}
    chosen = [
        c
        for c in found_before.constraints
        if (not wanted or c.object.casefold() in {w.casefold() for w in wanted})
        and (not options.type or c.type in options.type)
    ]
    return _fitting(replace(found_before, constraints=Constraints(tuple(chosen))), motion), ""


def _fitting(found: Annotations, motion: Motion) -> Annotations:
    """What was found at another rate (`--rate`) in the frames of the clip; of another duration, it is left, and refused later."""
    rate = float(motion.rate)
    if found.frames in (0, motion.frames) or not found.fps > 0:
        return found
    seconds = abs((found.frames - 1) / found.fps - (motion.frames - 1) / rate)
    return found.at_rate(rate, motion.frames) if seconds <= max(1 / found.fps, 1 / rate) else found


def _feet(motion: Motion) -> tuple[tuple[str, ...], str]:
    """What is cleaned when nothing is said: the feet; where no name tells them, what detection looks at."""
    objects, how = default_objects(motion)
    feet = tuple(n for n in objects if "foot" in n.casefold() or "toe" in n.casefold())
    return (feet or objects), f"looking at {', '.join(feet or objects)} ({'feet, by name' if feet else how})"


def _finish(done: Deformation, clip: Path, options: Deforming, screen: Screen) -> None:
    """Write the motion and the report, print the table."""
    from ..formats import save
    from ..formats.bvh_like import write_bvh_like

    output = options.output
    assert output is not None
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.suffix.lower() == ".bvh" and clip.suffix.lower() == ".bvh":
        write_bvh_like(output, done.motion, clip)
    else:
        save(output, done.motion)
    if options.report is not None:
        options.report.parent.mkdir(parents=True, exist_ok=True)
        from ..formats.files import write_atomically

        text = json.dumps(report_record(done), ensure_ascii=False, allow_nan=False)
        write_atomically(options.report, text.encode("utf-8", "backslashreplace") + b"\n")
    for line in str(done.report).splitlines():
        screen.print(line)
    screen.print(f"motion: {output}")
    if options.report is not None:
        screen.print(f"report: {options.report}")


def report_record(done: Deformation) -> dict[str, Any]:
    """What the JSON report holds."""
    r, motion = done.report, done.motion
    constraints = []
    for i, row in enumerate(r.rows()):
        frames = np.flatnonzero(r.active[:, i])
        constraints.append(
            {
                "name": row["constraint"], "unit": row["unit"], "layer": row["layer"],
                "largest": _number(row["largest"]), "mean": _number(row["mean"]), "frame": row["frame"],
                "status": row["status"], "frames_active": frames.tolist(),
                "residuals": [_number(x) for x in r.residual[frames, i]],
                "statuses": [STATUSES[s] for s in r.status[frames, i]],
            }
        )  # fmt: skip
    joint, angle, frame = r.largest_change()
    with np.errstate(invalid="ignore"):
        most = np.nan_to_num(r.change).max(0) if r.change.size else np.zeros(len(r.joints))
    return {
        "schema": SCHEMA, "clip": motion.name, "fps": float(motion.rate), "frames": motion.frames, "passes": r.passes,
        "constraints": constraints,
        "change": {
            "rms": _number(r.rms_change()), "largest": _number(angle), "joint": joint, "frame": frame,
            "root": _number(np.nan_to_num(r.root_change).max(initial=0.0)),
            "joints": {n: _number(x) for n, x in zip(r.joints, most, strict=True)},
        },
        "notes": list(r.notes),
    }  # fmt: skip


def _number(x: Any) -> float | None:
    return float(x) if math.isfinite(x) else None
