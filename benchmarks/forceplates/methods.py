"""The methods that are compared: a foot's markers in, labelled frames out, one result for every stance of a trial.

A method with a template gets it from another stance of the same trial: its core, the middle 25 to 55 %. The next stance
of the same foot is taken, else the next of the other foot, whose noise pattern then serves for this one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kinjax.annotations import Template
from kinjax.detect import Detection, calibrate, detect
from kinjax.evaluation.rules import RULES, Rule, toe_speed
from kinjax.evaluation.spans import runs
from kinjax.motion import Poses

from .trials import MARKERS, Stance, Trial, poses_of


@dataclass(frozen=True)
class Label:
    """What a method says of one foot: frames under a constraint, and the constraints as first and last frame."""

    frames: np.ndarray
    spans: tuple[tuple[int, int], ...]


Method = Callable[[Trial, Mapping[str, np.ndarray]], list[Label]]
"""A trial and its disturbed markers -> one label for each of the trial's stances, of that stance's foot."""


def template_stance(trial: Trial, stance: Stance) -> Stance:
    """The stance that a template for `stance` is taken from: never itself."""
    i = trial.stances.index(stance)
    others = trial.stances[i + 1 :] + trial.stances[:i]
    if not others:
        raise ValueError(f"{trial.name} has no other stance to take a template from")
    return next((s for s in others if s.foot == stance.foot), others[0])


def automatic(**settings: Any) -> Method:
    """Detection without a template."""

    def run(trial: Trial, markers: Mapping[str, np.ndarray]) -> list[Label]:
        found = detect(poses_of(markers, trial.rate, trial.name), **settings)
        return [_label(found, s.foot) for s in trial.stances]

    return run


def with_template(**settings: Any) -> Method:
    """Detection with one template on another stance; the disturbed data are what the template shows."""

    def run(trial: Trial, markers: Mapping[str, np.ndarray]) -> list[Label]:
        poses = poses_of(markers, trial.rate, trial.name)
        found: dict[tuple[Stance, str], Detection] = {}
        out = []
        for s in trial.stances:
            key = template_stance(trial, s), s.foot
            if key not in found:
                found[key] = _detect_like(poses, *key, settings)
            out.append(_label(found[key], s.foot))
        return out

    return run


def rule(plants: Rule, marker: str = "TOE") -> Method:
    """A peer: a rule of thumb (`kinjax.evaluation.rules`) on the path of one marker of the foot."""

    def run(trial: Trial, markers: Mapping[str, np.ndarray]) -> list[Label]:
        out = {}
        for foot, x in markers.items():
            planted = plants(x[:, MARKERS.index(marker)], trial.rate)
            out[foot] = Label(planted, tuple((int(b), int(e)) for b, e in runs(planted)))
        return [out[s.foot] for s in trial.stances]

    return run


def toe_rule(limit: float = 0.15, width: int = 6) -> Method:
    """A peer: the toe marker slower than `limit` m/s from frame to frame, then a median filter over `width` frames."""
    return rule(lambda path, rate: toe_speed(path, rate, limit, width / rate))


METHODS: dict[str, Method] = {
    "paper, template": with_template(method="paper"),
    "robust, template": with_template(method="robust"),
    "robust, no template": automatic(method="robust"),
    "window, no template": automatic(method="window"),
    "toe under 0.15 m/s": toe_rule(),
}
"""The rows of the table."""

PIVOTS: dict[str, Method] = {"robust, space and pivots": automatic(method="robust", types=("space", "line", "point"))}
"""Space with the pivots that touch it: compared with the whole stance."""


ALL = ("space", "line", "point")
COMPARED: dict[str, Method] = {
    "space, no template": METHODS["robust, no template"],
    "space, one template": METHODS["robust, template"],
    "space and pivots, no template": PIVOTS["robust, space and pivots"],
    "space and pivots, one template": with_template(method="robust", types=ALL),
    **{name: rule(plants) for name, plants in RULES.items()},
}
"""The rows of the comparison with the rules of thumb."""


def _detect_like(poses: Poses, shown: Stance, foot: str, settings: Mapping[str, Any]) -> Detection:
    """Detection with a template on the core of `shown`; for the other foot with the pattern that it gives."""
    begin, end = shown.core
    template = [Template(shown.foot, begin, end - 1)]
    if shown.foot == foot:
        return detect(poses, templates=template, **settings)
    patterns = [p.with_object(foot) for p in calibrate(poses, template, **settings) if p.object == shown.foot]
    return detect(poses, patterns=patterns, **settings)


def _label(found: Detection, foot: str) -> Label:
    spans = tuple((c.begin, c.end) for c in found.constraints.of(foot))
    frames = np.zeros(found.frames, bool)
    for begin, end in spans:
        frames[begin : end + 1] = True
    return Label(frames, spans)


def labels_of(method: Method | str, trial: Trial, markers: Mapping[str, np.ndarray]) -> list[Label]:
    """The labels of a method, or of one of `METHODS`, `PIVOTS` or `COMPARED` by its name."""
    return ({**METHODS, **PIVOTS, **COMPARED}[method] if isinstance(method, str) else method)(trial, markers)
