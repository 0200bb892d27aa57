"""`kinjax plot`: PNG pictures of a clip's constraints, or of annotations from a file.

In: options. Out: files; no window is opened.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..errors import FileFormatError, OptionError
from ..motion import Motion
from .cache import use_cache
from .options import Plot
from .request import SUFFIXES, check_file, load_clip
from .show import Screen, summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..annotations import Annotations
    from ..detect import Detection
    from .request import Clip


def plot_command(options: Plot) -> int:
    """`kinjax plot`."""
    if options.source is None:
        raise OptionError("nothing to draw: give a clip, or the annotations that `kinjax detect CLIP -o FILE` wrote")
    source, screen = check_file(options.source, "file"), Screen(options.quiet)
    if options.output.exists() and not options.output.is_dir():
        raise OptionError(f"{options.output} is a file, and a directory is needed")
    with screen.busy() as busy:
        kept = annotations_in(source)
        if kept is not None:
            from ..plots import timeline

            figures = iter([("timeline", timeline(kept))])
            lines = [f"{source.name}: {summary(kept)}"]
        else:
            from .detecting import detect_in

            use_cache()
            busy.step(f"detecting in {source.name}")
            clip = load_clip(source, options)
            found, note = detect_in(clip, options, source.name)
            figures = clip_figures(found, clip)
            lines = [f"{source.name}: {summary(found.annotations())}", *([note] if note else [])]
            for warning in found.warnings:
                screen.warn(warning)
        options.output.mkdir(parents=True, exist_ok=True)
        written = []
        for name, figure in figures:
            busy.step(f"drawing {name}")
            written.append(options.output / f"{source.stem}-{name}.png")
            figure.savefig(written[-1], dpi=150)
    for line in (*lines, *(f"picture: {path}" for path in written)):
        screen.print(line)
    return 0


def annotations_in(path: Path) -> Annotations | None:
    """The annotations in a file; None when it is a clip."""
    from ..formats import read_annotations

    if path.suffix.lower() not in SUFFIXES:
        return None
    try:
        return read_annotations(path)
    except FileFormatError as error:
        if path.suffix.lower() == ".npz" and ("kinjax-motion/" in error.found or "kinjax-poses/" in error.found):
            return None
        raise


def clip_figures(found: Detection, clip: Clip) -> Iterator[tuple[str, Figure]]:
    """The pictures of one detection with the names of their files: times, scene, and by object the noise patterns."""
    from .. import plots

    yield "timeline", plots.timeline(found)
    yield "scene", plots.skeleton_3d(clip, found) if isinstance(clip, Motion) else plots.objects_3d(clip, found)
    for name in found.objects:
        for kind in sorted(found.sigma_max):
            part = re.sub(r"[^\w.-]+", "_", name)
            yield f"{part}-{kind}-sigma-epsilon", plots.sigma_epsilon(found, name, kind)
            yield f"{part}-{kind}-noise-pattern", plots.noise_pattern(found, name, kind)
