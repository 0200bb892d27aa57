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
    span = _span(options.frames)
    with screen.busy() as busy:
        kept = annotations_in(source)
        if kept is not None and span is not None:
            raise OptionError("--frames goes with a clip: annotations alone are drawn whole")
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
            figures = clip_figures(found, clip, span)
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


def _span(text: str | None) -> tuple[int, int] | None:
    """First and last frame of `BEGIN:END`."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+):(\d+)\s*", text)
    if match is None or int(match[1]) > int(match[2]):
        raise OptionError(f"--frames {text!r}: write BEGIN:END, frame numbers from 0")
    return int(match[1]), int(match[2])


def clip_figures(
    found: Detection, clip: Clip, span: tuple[int, int] | None = None
) -> Iterator[tuple[str, Figure]]:
    """The pictures of one detection with the names of their files: times, scene, and by object the noise patterns.

    span: first and last frame that are shown; the rest of the clip has no part in times and scene.
    """
    from .. import plots

    times, shown = plots.timeline(found), None
    if span is not None:
        begin, end = span
        if end >= found.frames:
            raise OptionError(f"--frames {begin}:{end} is outside the clip, whose frames are 0..{found.frames - 1}")
        room = max(1, (end - begin) // 10)
        times.axes[0].set_xlim((begin - room) / float(found.rate), (end + room) / float(found.rate))
        shown = sorted({begin, (begin + end) // 2, end})
    yield "timeline", times
    yield "scene", plots.skeleton_3d(clip, found, shown) if isinstance(clip, Motion) else plots.objects_3d(clip, found, shown)
    for name in found.objects:
        for kind in sorted(found.sigma_max):
            part = re.sub(r"[^\w.-]+", "_", name)
            yield f"{part}-{kind}-sigma-epsilon", plots.sigma_epsilon(found, name, kind)
            yield f"{part}-{kind}-noise-pattern", plots.noise_pattern(found, name, kind)
