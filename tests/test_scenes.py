"""The scenes of the 2004 paper's section 6: what it claims of them comes out on real clips."""

import pytest

from benchmarks.scenes import SCENES, reaching
from benchmarks.scenes.scene import Finding, run


def claims(findings):
    """All of them hold, aims apart; a failure prints every number."""
    assert findings and all(f.holds or f.aim for f in findings), "\n" + "\n".join(map(str, findings))


LONG = {"karate": ("weights",)}
"""Variants left to the long tests: stepping shows priorities against weights already."""


@pytest.mark.parametrize("name", [*SCENES, *(pytest.param(n, marks=pytest.mark.slow, id=f"{n} whole") for n in LONG)])
def test_scene(name, data, request):
    scene = SCENES[name].build(data)
    whole = request.node.get_closest_marker("slow") is not None
    results = run(scene, [v for v in scene.variants if whole or v not in LONG.get(name, ())])
    for outcome in results.values():
        assert outcome.motion.frames == scene.motion.frames
        assert len(outcome.by_layer()) == 1 + max(outcome.deformation.report.layer)
        assert outcome.work()[0] == scene.motion.frames * outcome.deformation.report.passes
    claims(SCENES[name].check(scene, results))


def test_an_edit_of_the_reach(data):
    claims(reaching.check_edit(data))


def test_a_finding_says_what_was_asked():
    assert Finding("a", 0.05, below=0.1).holds and not Finding("a", 0.5, below=0.1).holds
    assert not Finding("a", float("nan"), below=0.1).holds and not Finding("a", float("nan"), above=0.1).holds
    assert str(Finding("feet hold", 0.5, below=0.1)) == "NOT feet hold: 0.5 mm (< 0.1)"
    assert str(Finding("feet hold", 0.5, below=0.1, aim=True)).startswith("aim feet")
    assert str(Finding("between", 0.5, 0.8, 0.2, "x")) == "ok  between: 0.5 x (> 0.2 and < 0.8)"
