"""One page about one detection: what was found, by which thresholds, and the pictures that show why.

In: a `Detection`, and what is known of the motion. Out: a single HTML file that needs nothing else: style and pictures
are inside it, it runs no script and asks no network. Every name comes from a file, and is escaped.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .annotations import TYPES, Annotations, Constraint, Constraints, NoisePattern
from .detect.results import Detection
from .detect.settings import Settings
from .motion import Motion, Poses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_OBJECTS, MOST_ROWS, DPI = 8, 500, 100
STATUS = {
    "ok": "from templates, nothing to remark",
    "few_intervals": "fewer than ten template intervals: little evidence",
    "exact_fit": "more than half of the template's values are the same (rest without noise): thresholds at their floor",
    "ambiguous": "the template holds two equally large groups: which of them is the constraint is a guess",
    "unrepresentative": "the template would label most of the clip: it is hardly an example of rest",
    "template_moving": "the object moves during its template: thresholds were held at their cap",
    "automatic": "no template: the physical floor decides",
    "given": "thresholds given by hand",
}


def write_report(
    path: str | Path,
    detection: Detection,
    motion: Motion | None = None,
    poses: Poses | None = None,
    truth: Annotations | Iterable[Constraint] | None = None,
    title: str | None = None,
) -> Path:
    """Write the page and return its path.

    `motion` or `poses` add the three-dimensional pictures, `truth` a row in the timeline and a table of agreement.
    Objects beyond the eight with most constraints keep their rows in the tables, and have no pictures.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    place = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    real = None if truth is None else truth.constraints if isinstance(truth, Annotations) else Constraints(tuple(truth))
    shown = _objects(detection)
    found = detection.constraints
    page = place.get_template("report.html.jinja").render(
        title=title or f"Constraints of {detection.clip or 'a clip'}",
        facts=_facts(detection, motion),
        changed=_changed(detection.settings),
        warnings=[*detection.warnings, *_missing(detection)],
        notes=motion.notes if motion is not None else (),
        constraints=[_row(c) for c in found[:MOST_ROWS]],
        total=len(found),
        with_truth=real is not None,
        patterns=[_pattern(p) for p in detection.patterns],
        agreement=_agreement(found, real, detection.frames) if real is not None else [],
        overview=_overview(detection, motion, poses, real),
        objects=[{"name": n, "count": len(_own(found, n)), "pictures": _pictures(detection, n)} for n in shown],
        without=[n for n in detection.objects if n not in shown],
    )
    path = Path(path)
    path.write_bytes(page.encode("utf-8", "replace"))
    return path


def _own(found: Iterable[Constraint], name: str) -> list[Constraint]:
    return [c for c in found if c.object == name]


def _objects(detection: Detection) -> list[str]:
    """Objects that get pictures: those with most constraints, in the detection's order."""
    count = {n: len(_own(detection.constraints, n)) for n in detection.objects}
    chosen = set(sorted(detection.objects, key=lambda n: -count[n])[:MOST_OBJECTS])
    return [n for n in detection.objects if n in chosen]


def _facts(detection: Detection, motion: Motion | None) -> list[tuple[str, str]]:
    """What the clip is."""
    rate, frames, found = float(detection.rate), detection.frames, detection.constraints
    objects = f"{len(detection.objects)}" + (f" of {motion.joints} joints" if motion is not None else "")
    kinds = ", ".join(f"{n} {t}" for t in TYPES if (n := len(found.of(type=t)))) or "none"
    return [
        ("Clip", detection.clip or "no name"),
        ("Frames", f"{frames} at {rate:g} frames a second"),
        ("Duration", f"{max(frames - 1, 0) / rate:.2f} s" if rate > 0 else "not known"),
        ("Method", detection.settings.method),
        ("Types looked for", ", ".join(detection.settings.types)),
        ("Objects", objects),
        ("Constraints", kinds),
    ]


def _changed(settings: Settings) -> list[tuple[str, str, str]]:
    """Settings that are not the default: name, value, default."""
    plain, out = Settings(), []
    for f in fields(settings):
        now, default = getattr(settings, f.name), getattr(plain, f.name)
        if now != default:
            out.append((f.name, _words(now), _words(default)))
    return out


def _words(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(_words(v) for v in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if value is None:
        return "none"
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _missing(detection: Detection) -> list[str]:
    """Objects that were not seen all the time, where the detection's own warnings do not name them already."""
    counts = zip(detection.objects, np.asarray(detection.missing).astype(int).tolist(), strict=True)
    known = tuple(w.split(" of ")[0] for w in detection.warnings)
    return [f"{o}: {n} of {detection.frames} frames missing, or rejected as spikes" for o, n in counts if n and f"{o}: {n}" not in known]


def _row(c: Constraint) -> dict[str, str]:
    """A constraint as text."""
    axis = "" if c.axis is None else " ".join(f"{round(x, 2) + 0.0:.2f}" for x in c.axis)
    position = ", ".join(f"{round(x, 3) + 0.0:.3f}" for x in c.position)
    return {
        "object": c.object, "type": c.type, "begin": str(c.begin), "end": str(c.end), "begin_s": f"{c.begin_s:.3f}",
        "end_s": f"{c.end_s:.3f}", "length": f"{c.frames / c.fps:.2f}" if c.fps else "",
        "residual": f"{1e3 * c.residual:.2f}", "position": position, "axis": axis,
    }  # fmt: skip


def _pattern(p: NoisePattern) -> dict[str, str]:
    """A noise pattern as text."""
    second = p.unit == "per_second"

    def span(values: tuple[float, ...], unit: str) -> str:
        low, high = min(values, default=np.nan), max(values, default=np.nan)
        text = f"{low:.3g}" if high - low <= 1e-6 * abs(high) else f"{low:.3g} to {high:.3g}"
        return f"{text} {unit}"

    others = [f" of {t.object}" if t.object != p.object else "" for t in p.templates]
    templates = ", ".join(f"{t.begin} to {t.end}{of}" for t, of in zip(p.templates, others, strict=True))
    return {
        "object": p.object, "type": p.type, "sigma": span(p.sigma_max, "rad/s" if second else "rad"),
        "eps": span(p.eps_max, "m/s" if second else "m"),
        "templates": templates or "none",
        "kept": f"{p.kept} of {p.intervals}" if p.intervals else "",
        "status": "; ".join(STATUS.get(s, s.replace("_", " ")) for s in p.status.split("+")),
        "remark": "" if p.status in ("ok", "automatic", "given") else "remark",
    }  # fmt: skip


def _agreement(found: Constraints, real: Constraints, frames: int) -> list[dict[str, str]]:
    """Frames found against frames of the truth, by object and type."""
    keys = dict.fromkeys((c.object, c.type) for c in (*real, *found))
    out = []
    for name, kind in keys:
        a, b = (Constraints(tuple(_own(x, name))).mask(frames, type=kind) for x in (found, real))
        both = int((a & b).sum())
        out.append({
            "object": name, "type": kind, "found": str(int(a.sum())), "true": str(int(b.sum())), "both": str(both),
            "precision": f"{100 * both / a.sum():.1f} %" if a.any() else "nothing found",
            "recall": f"{100 * both / b.sum():.1f} %" if b.any() else "nothing to find",
        })  # fmt: skip
    return out


def _png(figure: Figure) -> str:
    """A figure as a data URI: 256 colours are enough for it, and a third of the size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    out = io.BytesIO()
    image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(out, "png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode("ascii")


def _picture(figure: Figure, kind: str, alt: str) -> dict[str, str]:
    """What the page needs of a picture; it has a caption for each kind."""
    return {"src": _png(figure), "kind": kind, "alt": alt}


def _overview(
    detection: Detection, motion: Motion | None, poses: Poses | None, real: Constraints | None
) -> list[dict[str, str]]:
    """The pictures of the whole clip: timeline and scene."""
    from . import plots

    found, known = detection.constraints, detection.objects
    alt = f"Timeline of {len(found)} constraints on {len(known)} objects over {detection.frames} frames"
    out = [_picture(plots.timeline(detection, real), "timeline", alt)]
    if motion is not None and np.ndim(motion.rotations) == 3:
        ends = [n for n in known if n in motion.skeleton.names and len(_own(found, n))][:2]
        alt = "The skeleton in up to four frames, with the constraints"
        out.append(_picture(plots.skeleton_3d(motion, detection, trail=ends), "scene", alt))
    elif poses is not None and np.ndim(poses.position) == 3:
        names = ([n for n in poses.names if n in known] or list(poses.names))[:MOST_OBJECTS]
        alt = "The objects in up to four frames, with the constraints"
        out.append(_picture(plots.objects_3d(poses.select(names), detection), "scene", alt))
    return out


def _pictures(detection: Detection, name: str) -> list[dict[str, str]]:
    """The pictures of one object: the first type looked for, and line or point where some were found."""
    from . import plots

    have = {c.type for c in _own(detection.constraints, name)}
    kinds = [t for t in TYPES if t in detection.sigma_max] or ["space"]
    turning = [t for t in kinds if t != "space"][:1] if have & {"line", "point"} else []
    out = []
    for kind in dict.fromkeys([kinds[0], *turning]):
        alt = f"Sigma-epsilon space of {name}, {kind} constraint"
        out.append(_picture(plots.sigma_epsilon(detection, name, kind), "space", alt))
        alt = f"Sigma and epsilon of {name} over time, with the noise pattern of the {kind} constraint"
        out.append(_picture(plots.noise_pattern(detection, name, kind), "time", alt))
    return out
