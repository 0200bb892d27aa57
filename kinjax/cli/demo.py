"""`kinjax` alone and `kinjax samples`: the clips whose constraints are known by construction.

In: an output directory. Out: a table of what was found beside what is true, annotations, reports, and what to try next.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rich.table import Table

from ..annotations import Constraint
from ..detect import Detection, Settings, detect
from ..errors import OptionError
from ..formats import save, write_annotations
from ..synthetic import Scene, sample_clips
from .cache import use_cache
from .detecting import write_html
from .options import Demo, Samples
from .request import default_objects
from .show import Screen, table

Pair = tuple[Constraint | None, Constraint | None]

REACH = """# The left hand reaches up by 20 cm for a second; the feet, above it, stay on their paths.

[[position]]
joint = "LeftFoot"
priority = 2

[[position]]
joint = "RightFoot"
priority = 2

[[position]]
joint = "LeftHand"
offset = [0, 0.2, 0]
begin = "1 s"
end = "2 s"
priority = 1
"""


def demo_command(options: Demo) -> int:
    """`kinjax demo`: detect, compare, write."""
    folder, screen = _folder(options.output), Screen()
    use_cache()
    scenes = sample_clips()
    pairs: dict[str, list[Pair]] = {}
    with screen.busy(len(scenes)) as busy, ThreadPoolExecutor(os.cpu_count()) as pool:
        busy.step("detecting (the first time, this compiles)")
        for done, (name, found) in enumerate(zip(scenes, pool.map(detect_scene, scenes.values()), strict=True)):
            scene = scenes[name]
            clip = scene.poses if scene.motion is None else scene.motion
            truth = [c for c in scene.truth if c.object in found.objects]
            busy.step(f"drawing the report on {name}", done)
            found.save(folder / f"{name}.json")
            write_html(folder / f"{name}.html", found, clip, truth)
            write_scene(folder, scene)
            pairs[name] = pair(found.constraints, truth)
            busy.step("detecting", done + 1)
    (folder / "walk-reach.toml").write_text(REACH, encoding="utf-8")
    for name, scene in scenes.items():
        screen.print(comparison(name, scene, pairs[name]))
        screen.print()
    screen.print(verdict([p for some in pairs.values() for p in some]))
    for line in farewell(folder):
        screen.print(line)
    return 0


def detect_scene(scene: Scene) -> Detection:
    """Detection in a sample clip: feet of a skeleton, or all objects with every type of constraint."""
    if scene.motion is None:
        settings = Settings(types=("space", "line", "point"), free_pivots=True)
        return detect(scene.poses, objects=list(scene.poses.names), settings=settings)
    known = {c.object for c in scene.truth}
    objects = [n for n in default_objects(scene.motion)[0] if n in known]
    return detect(scene.motion, objects=objects, settings=Settings(types=("space", "line", "point")))


def pair(found: Sequence[Constraint], truth: Sequence[Constraint]) -> list[Pair]:
    """Each true constraint with the found one of its object and type that shares most frames with it, then the rest."""
    shared = sorted(
        ((_overlap(f, t), i, j) for i, f in enumerate(found) for j, t in enumerate(truth)),
        key=lambda x: (-x[0], x[1], x[2]),
    )
    of_truth: dict[int, int] = {}
    taken: set[int] = set()
    for frames, i, j in shared:
        if frames > 0 and i not in taken and j not in of_truth:
            of_truth[j] = i
            taken.add(i)
    out: list[Pair] = [(found[of_truth[j]] if j in of_truth else None, t) for j, t in enumerate(truth)]
    out += [(f, None) for i, f in enumerate(found) if i not in taken]
    return sorted(out, key=_order)


def comparison(name: str, scene: Scene, pairs: Sequence[Pair]) -> Table:
    """The table of one clip: found beside true."""
    rows = []
    for found, true in pairs:
        either = found or true
        assert either is not None
        off = "" if found is None or true is None else f"{found.begin - true.begin:+d} {found.end - true.end:+d}"
        residual = "" if found is None else f"{1e3 * found.residual:.1f}"
        rows.append((either.object, either.type, _span(found, "not found"), _span(true, "none"), off, residual))
    title = f"{name}: {scene.frames} frames at {scene.rate:g} a second"
    return table(("object", "type", "found, frames", "truth, frames", "off by", "moves mm"), rows, title, numbers=(2, 3, 4, 5))


def verdict(pairs: Sequence[Pair]) -> str:
    """One line on all clips together."""
    both = [(f, t) for f, t in pairs if f is not None and t is not None]
    real, extra = sum(t is not None for _, t in pairs), sum(t is None for _, t in pairs)
    off = [max(abs(f.begin - t.begin), abs(f.end - t.end)) for f, t in both]
    exact = f" ({off.count(0)} exact to the frame, the others to within {max(off)})" if off else ""
    return f"{len(both)} of {real} constraints found{exact}; {extra} found that are not in the truth."


def samples_command(options: Samples) -> int:
    """`kinjax samples`: the clips and their truth as files."""
    folder, screen = _folder(options.output), Screen()
    for scene in sample_clips().values():
        for path in write_scene(folder, scene):
            screen.print(str(path))
    return 0


def write_scene(folder: Path, scene: Scene) -> Iterator[Path]:
    """The scene's clip (BVH where it has a skeleton, else npz) and its truth; gives the paths."""
    from ..formats import write_poses_npz

    clip = folder / f"{scene.name}{'.npz' if scene.motion is None else '.bvh'}"
    if scene.motion is None:
        write_poses_npz(clip, scene.poses)
    else:
        save(clip, scene.motion)
    return iter([clip, write_annotations(folder / f"{scene.name}-truth.json", scene.annotations())])


def farewell(folder: Path) -> Iterator[str]:
    """Where everything is, and what to try next."""
    kinjax = shlex.quote(os.environ.get("KINJAX_PROG") or "kinjax")
    walk, found, edit = (shlex.quote(str(folder / f"walk{end}")) for end in (".bvh", ".json", "-reach.toml"))
    yield ""
    yield f"Written to {folder}{os.sep}:"
    yield "  *.html        reports with pictures, made to be opened in a browser"
    yield "  *.json        annotations; *-truth.json is what is true by construction"
    yield "  *.bvh, *.npz  the clips"
    yield "  *.toml        an edit: constraints to bend a clip to"
    yield "Try next:"
    yield f"  {kinjax} info {walk}"
    yield f"  {kinjax} detect {walk} --object LeftFoot --template 0:120 -o left-foot.csv"
    yield f"  {kinjax} clean {walk} --annotations {found} -o walk-clean.bvh"
    yield f"  {kinjax} deform {walk} {edit} -o walk-reach.bvh"
    yield f"  {kinjax} detect your-own.bvh --report your-own.html"
    yield f"  {kinjax} --help"


def _folder(path: Path) -> Path:
    if path.exists() and not path.is_dir():
        raise OptionError(f"{path} is a file, and a directory is needed")
    path.mkdir(parents=True, exist_ok=True)
    return path


def _overlap(a: Constraint, b: Constraint) -> int:
    """Frames that two constraints of one object and type share."""
    if (a.object, a.type) != (b.object, b.type):
        return 0
    return min(a.end, b.end) - max(a.begin, b.begin) + 1


def _order(p: Pair) -> tuple[str, int]:
    c = p[1] or p[0]
    assert c is not None
    return c.object, c.begin


def _span(c: Constraint | None, absent: str) -> str:
    return absent if c is None else f"{c.begin} to {c.end}"
