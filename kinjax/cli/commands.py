"""`kinjax info` and `kinjax export`.

In: options. Out: a description of a clip, or a file for another program.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

from rich.text import Text
from rich.tree import Tree

from ..errors import OptionError
from ..motion import Motion, Poses
from ..skeleton import Topology
from .options import Export, Info
from .request import check_file, default_objects, load_clip
from .show import Screen

EXPORT_SUFFIX = {"vtt": ".vtt", "blender": ".py", "events": "-events.csv"}  # annotations may stand beside as .csv
EXPORT_NAME = {"vtt": "webvtt"}  # where the library calls it by another name


def info_command(options: Info) -> int:
    """`kinjax info`."""
    if options.clip is None:
        raise OptionError("no clip is given")
    clip = load_clip(options.clip, options)
    screen = Screen()
    screen.print(str(options.clip))
    for name, value in describe(clip):
        screen.print(f"  {name:<9} {value}")
    if isinstance(clip, Motion):
        screen.print(joint_tree(clip.skeleton.topology, set(default_objects(clip)[0])))
        screen.print("* looked at when no --object is given")
    return 0


def describe(clip: Motion | Poses) -> Iterable[tuple[str, str]]:
    """What there is to say of a clip, as (name, value)."""
    rate = float(clip.rate)
    yield "frames", str(clip.frames)
    yield "rate", f"{rate:g} frames a second"
    yield "duration", f"{max(clip.frames - 1, 0) / rate:.3f} s"
    if isinstance(clip, Poses):
        yield "up", clip.up
        yield "objects", ", ".join(clip.names)
        unseen = [f"{n} {int((~clip.valid[..., i]).sum())}" for i, n in enumerate(clip.names) if not clip.valid[..., i].all()]
        yield "not seen", (", ".join(unseen) + " (frames)") if unseen else "nothing"
        return
    yield "up", clip.skeleton.topology.up
    yield "joints", str(clip.joints)
    for note in clip.notes:
        yield "note", note


def joint_tree(top: Topology, marked: set[str]) -> Tree:
    """The joints as a tree, the `marked` ones with a star, End Sites in brackets."""
    trees: list[Tree] = []
    whole = Tree(Text("joints"))
    for name, parent in zip(top.names, top.parents, strict=True):
        above = whole if parent < 0 else trees[parent]
        trees.append(above.add(Text(f"{name} *" if name in marked else name)))
    for k, parent in enumerate(top.end_parents):
        trees[parent].add(Text(f"({top.end_names[k] or 'End Site'})"))
    return whole


def export_command(options: Export) -> int:
    """`kinjax export`."""
    if options.annotations is None:
        raise OptionError("no annotations are given: the file that `kinjax detect CLIP -o FILE` wrote")
    if options.to is None:
        raise OptionError("--to says what for: vtt, blender or events")
    from ..formats import export, read_annotations

    source = check_file(options.annotations, "annotations file")
    found = read_annotations(source)
    name = EXPORT_NAME.get(options.to, options.to)
    target = options.output or source.with_name(source.stem + EXPORT_SUFFIX[options.to])
    if target == Path("-"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"annotations{EXPORT_SUFFIX[options.to]}"
            export(found, path, name)
            print(path.read_text(encoding="utf-8").rstrip("\n"), flush=True)
        return 0
    if target.resolve() == source.resolve():
        raise OptionError(f"{target} would be written over: name another file with -o FILE")
    target.parent.mkdir(parents=True, exist_ok=True)
    export(found, target, name)
    Screen().print(f"{options.to}: {target}")
    return 0
