"""The report: one file that needs nothing else, whose names can do no harm."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from test_plots import fake_detection

from kinjax.annotations import TYPES, Annotations
from kinjax.report import write_report

EVIL = "<script>alert('x')</script>"


class Page(HTMLParser):
    """Tags with their attributes, and the text of a page; every tag that is opened must be closed."""

    void = frozenset({"meta", "img", "br", "hr", "link", "input"})

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def all(self, tag):
        return [a for t, a in self.tags if t == tag]


def read(path):
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """One rich report for most tests: three types, truth, warnings, an evil name."""
    d = fake_detection(("LeftFoot", EVIL), types=TYPES)
    d = replace(
        d,
        settings=d.settings.but(max_gap=0.25, free_pivots=True),
        clip="<b>walk</b>.bvh",
        warnings=("the template moves & <i>turns</i>",),
        patterns=(replace(d.patterns[0], status="ambiguous+few_intervals"), *d.patterns[1:]),
    )
    path = write_report(tmp_path_factory.mktemp("report") / "out.html", d, truth=fake_detection().constraints)
    return d, path, read(path)


def test_it_needs_nothing_else(page):
    _, path, tree = page
    raw = path.read_text(encoding="utf-8")
    for name in ("src", "href", "srcset", "data", "action"):
        assert all(a[name].startswith("data:image/png;base64,") for _, a in tree.tags if name in a)
    assert not re.search(r"https?://|@import|url\(", raw)
    assert not tree.all("script") and not tree.all("link") and not tree.all("iframe")
    assert "default-src 'none'" in tree.all("meta")[1]["content"]
    assert len(raw) < 1_000_000


def test_pictures_are_png_with_words_instead(page):
    d, _, tree = page
    pictures = tree.all("img")
    assert len(pictures) == 1 + 2 * 4  # timeline; two types of two pictures for each object
    assert all(base64.b64decode(p["src"].split(",")[1]).startswith(b"\x89PNG") for p in pictures)
    assert all(len(p["alt"]) > 20 for p in pictures)
    assert len(tree.all("figcaption")) == len(pictures)
    assert [("open" in a) for a in tree.all("details")] == [True, False]
    assert d.objects[0] in pictures[1]["alt"]


def test_names_are_escaped(page):
    _, path, tree = page
    raw = path.read_text(encoding="utf-8")
    assert EVIL not in raw and "<b>walk" not in raw and "<i>turns" not in raw
    assert EVIL in tree.text and "<b>walk</b>.bvh" in tree.text and "& <i>turns</i>" in tree.text
    assert any(EVIL in p["alt"] for p in tree.all("img"))
    assert not tree.all("b") and not tree.all("i")


def test_it_says_what_was_found_and_how(page):
    d, path, tree = page
    text = re.sub(r"\s+", " ", tree.text)
    assert "240 at 60 frames a second" in text and "3.98 s" in text and "robust" in text
    assert (
        "max_gap = 0.25 (default 0.1)" in text and "free_pivots = yes (default no)" in text and "stride =" not in text
    )
    assert "8 of 240 frames missing, or rejected as spikes" in text
    assert "two equally large groups" in text and "fewer than ten template intervals" in text
    raw = path.read_text(encoding="utf-8")
    body = raw.split("<h2>Constraints</h2>")[1].split("</table>")[0]
    assert body.count("<tr>") == len(d.constraints) + 1
    first = d.constraints[0]
    assert f'<td class="n">{first.begin}</td><td class="n">{first.end}</td>' in body and "2.10" in body
    assert "Agreement with the truth" in text and "100.0 %" in text


def test_no_constraints_no_template_default_settings(tmp_path):
    d = fake_detection(("A",), frames=1, templates=False)
    d = replace(d, patterns=(), missing=np.zeros(1, int))
    text = re.sub(r"\s+", " ", read(write_report(tmp_path / "a.html", d)).text)
    assert "No constraint was found." in text and "all default" in text and "Warnings" not in text and "0.00 s" in text
    assert "No pattern was needed" in text and "Agreement" not in text


def test_many_objects_are_capped(tmp_path, monkeypatch):
    import kinjax.report as report

    d = fake_detection(tuple(f"Joint{i}" for i in range(31)))
    monkeypatch.setattr(report, "MOST_OBJECTS", 1)
    monkeypatch.setattr(report, "MOST_ROWS", 20)
    path = write_report(tmp_path / "a.html", d, title="A & B")
    tree = read(path)
    assert len(tree.all("details")) == 1 and len(tree.all("img")) == 1 + 2
    assert "Joint30" in tree.text and f"the first 20 of {len(d.constraints)}" in tree.text and "A & B" in tree.text


def test_scenes_of_motion_and_of_poses(tmp_path):
    from kinjax import synthetic

    walk, dice = synthetic.walking_biped(), synthetic.rolling_dice()
    for scene, given in ((walk, {"motion": walk.motion}), (dice, {"poses": dice.poses})):
        names = scene.poses.names[:1]
        d = fake_detection(names, frames=scene.frames, rate=scene.rate, templates=False)
        truth = Annotations(scene.name, scene.rate, scene.frames, scene.truth)
        tree = read(write_report(tmp_path / f"{scene.name}.html", d, truth=truth, **given))
        assert any("up to four frames" in p["alt"] for p in tree.all("img"))


def test_a_name_that_no_encoding_holds(tmp_path):
    path = write_report(tmp_path / "a.html", fake_detection(("A\udc80",), templates=False, frames=60))
    assert "A?" in path.read_text(encoding="utf-8")
