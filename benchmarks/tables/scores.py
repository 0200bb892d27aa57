"""Table 2: mislabelled frames, over every labelled constraint used as the template in turn.

In: a clip, its labels, ways to detect. Out: a `Score` for each template. Lanes of the engine share nothing, so all
templates of all effectors run at once: each in a lane that holds its own copy of the effector.

Frames are those of the file; results at 25 fps are brought back to them. A frame is mislabelled where label and
detection differ. Ambiguous frames are not scored; `everywhere` counts them too, as frames without a constraint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kinjax.annotations import Constraint, Constraints, Template
from kinjax.detect import Settings, detect
from kinjax.detect.planning import template_spans, widths
from kinjax.detect.prepare import prepared
from kinjax.errors import TemplateTooShort
from kinjax.kinematics import object_poses
from kinjax.motion import Motion, Poses

from .labels import Span, Target


@dataclass(frozen=True)
class Way:
    """A way to detect, with templates or without, and how many run at once (all windows of a lane take memory)."""

    name: str
    settings: Settings
    templates: bool = True
    lanes: int = 128


WAYS = (
    Way("paper, 25 fps", Settings(method="paper", rate=25.0)),
    Way("paper", Settings(method="paper")),
    Way("robust", Settings(method="robust")),
    Way("robust, no template", Settings(method="robust"), templates=False),
    Way("window", Settings(method="window"), lanes=16),
    Way("window, no template", Settings(method="window"), templates=False),
)


@dataclass(frozen=True)
class Score:
    """One detection against a target: frames `extra` (found, not labelled) and `missed`; `sure`: both, but farther from
    a labelled begin or end than its uncertainty; `everywhere`: both, with the ambiguous frames. `overlap`: frames found
    and labelled, of those found or labelled. `covered`: labelled constraints of which at least half was found."""

    template: Span | None
    constraints: Constraints
    extra: int
    missed: int
    sure: int
    everywhere: int
    overlap: float
    covered: int

    @property
    def mislabelled(self) -> int:
        """Frames where label and detection differ."""
        return self.extra + self.missed


def score(target: Target, template: Span | None, constraints: Constraints) -> Score:
    """The constraints of one effector against its labels."""
    found, truth, scored = constraints.mask(target.frames, type="space"), target.mask(), target.scored()
    wrong = found != truth
    both, either = int((found & truth & scored).sum()), int(((found | truth) & scored).sum())
    return Score(
        template, constraints, int((found & ~truth & scored).sum()), int((~found & truth & scored).sum()),
        int((wrong & scored & ~target.edges()).sum()), int(wrong.sum()), both / either if either else 1.0,
        sum(2 * int(found[s.begin : s.end + 1].sum()) >= s.frames for s in target.spans),
    )  # fmt: skip


def usable(poses: Poses, target: Target, settings: Settings) -> tuple[Span, ...]:
    """The spans of a target that are long enough to be templates."""
    clip = prepared(poses, [target.effector], None, settings)
    span = widths(settings, clip.rate)["span"]

    def long_enough(s: Span) -> bool:
        template = Template(target.effector, s.begin, s.end)
        try:
            template_spans([template], clip, settings, span, ("space",))  # type: ignore[arg-type]
        except TemplateTooShort:
            return False
        return True

    return tuple(s for s in target.spans if long_enough(s))


def in_lanes(poses: Poses, jobs: Sequence[tuple[str, Span]]) -> tuple[Poses, list[Template]]:
    """A copy of the effector for each (effector, template), named after both, and the templates of the copies."""
    names = tuple(f"{e} {s.begin}:{s.end}" for e, s in jobs)
    at = np.array([poses.index(e) for e, _ in jobs], int)
    copies = {k: getattr(poses, k)[:, at] for k in ("rotation", "position", "valid")}
    templates = [Template(n, s.begin, s.end) for n, (_, s) in zip(names, jobs, strict=True)]
    return replace(poses, names=names, **copies), templates


def scores(motion: Motion, targets: Sequence[Target], way: Way) -> dict[Target, list[Score]]:
    """A score for each usable template of each target; one score each where no template is given."""
    poses = object_poses(motion, list(dict.fromkeys(t.effector for t in targets)))
    if not way.templates:
        constraints = detect(poses, settings=way.settings).constraints
        return {t: [score(t, None, constraints.of(t.effector))] for t in targets}
    jobs = list(dict.fromkeys((t.effector, s) for t in targets for s in usable(poses, t, way.settings)))
    jobs.sort(key=lambda job: job[1].frames)  # templates of about one length run together: fewer compilations
    found = {}
    for some in (jobs[i : i + way.lanes] for i in range(0, len(jobs), way.lanes)):
        lanes, templates = in_lanes(poses, some)
        by_lane: dict[str, list[Constraint]] = {n: [] for n in lanes.names}
        for c in detect(lanes, templates=templates, settings=way.settings).constraints:
            by_lane[c.object].append(c)
        for name, (e, s) in zip(lanes.names, some, strict=True):
            found[e, s] = Constraints(tuple(replace(c, object=e) for c in by_lane[name]))
    return {t: [score(t, s, found[t.effector, s]) for s in t.spans if (t.effector, s) in found] for t in targets}


def typical(some: Sequence[Score]) -> Score:
    """The score of the longest template: the one that a person would give."""
    return max(some, key=lambda s: s.template.frames if s.template else 0)


HEAD = (
    "clip", "effector", "truth", "constraints", "frames", "scored", "method", "templates", "least", "median", "most",
    "least %", "most %", "sure", "everywhere", "covered", "extra+missed at least", "at most",
)  # fmt: skip


def row(clip: str, target: Target, way: Way, some: Sequence[Score]) -> list[Any]:
    """One line of Table 2."""
    order = sorted(some, key=lambda s: s.mislabelled)
    scored = int(target.scored().sum())
    pair = lambda get: f"{min(map(get, some))}/{max(map(get, some))}"  # noqa: E731
    share = lambda s: f"{100 * s.mislabelled / scored:.1f}"  # noqa: E731
    name = lambda s: f" ({s.template.begin}:{s.template.end})" if s.template else ""  # noqa: E731
    at = lambda s: f"{s.extra}+{s.missed}{name(s)}"  # noqa: E731
    low, high = order[0], order[-1]
    return [
        clip, target.effector, target.truth, len(target.spans), int(target.mask().sum()), scored, way.name,
        f"{len(some)}/{len(target.spans)}" if way.templates else "none", low.mislabelled,
        int(np.median([s.mislabelled for s in some])), high.mislabelled, share(low), share(high),
        pair(lambda s: s.sure), pair(lambda s: s.everywhere), pair(lambda s: s.covered), at(low), at(high),
    ]  # fmt: skip
