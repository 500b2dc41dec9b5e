"""The page: complete, self-contained, escaped, and with the report's own numbers."""

import base64
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from sb3_rpto.effects.effect import LIBRARY
from sb3_rpto.sysid import Finding, Report
from sb3_rpto.sysid.data.recording import Noise
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.report import descriptions, figures
from sb3_rpto.sysid.report.results import Candidate


@pytest.fixture(scope="module")
def page(report: Report) -> str:
    return report.html()


class Reader(HTMLParser):
    """Text, images, cells of tables, and tags that were not closed."""

    EMPTY = ("meta", "img", "br")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.images: list[dict] = []
        self.sources: list[str] = []
        self.cells: list[str] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        found = dict(attrs)
        self.sources += [found[name] for name in ("src", "href") if name in found]
        if tag == "img":
            self.images.append(found)
        if tag == "td":
            self.cells.append("")
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)
        if "td" in self.open:
            self.cells[-1] += data


@pytest.mark.slow
def test_known_noise_is_listed_of_velocities_too(report: Report) -> None:
    joints = report.data.columns.qvel
    assert f"{joints[0]}, velocity" not in Reader(report.html()).cells
    noise = Noise(np.full(len(report.data.columns.qpos), 0.001), np.linspace(0.0125, 0.0225, len(joints)))
    cells = Reader(replace(report, data=replace(report.data, noise=noise)).html()).cells
    at = cells.index(f"{joints[0]}, velocity")
    assert cells[at + 1 : at + 3] == ["0.0125", "rad/s"]


def test_page_is_whole_and_needs_nothing_else(page: str) -> None:
    reader = Reader(page)
    assert not reader.open
    assert reader.sources
    assert all(s.startswith("data:image/svg+xml;base64,") for s in reader.sources)
    assert "<script" not in page
    assert "http" not in "".join(reader.words)
    assert "url(" not in page
    assert len(page.encode()) < 3e6


def test_images_are_svg_that_load_nothing(page: str) -> None:
    images = Reader(page).images
    assert len(images) == 3  # errors, force residual of the one effect, trajectories
    for image in images:
        text = base64.b64decode(image["src"].partition(",")[2]).decode()
        root = ElementTree.fromstring(text)
        assert root.tag.endswith("svg")
        links = re.findall(r'(?:xlink:)?href="([^"]+)"', text)
        assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
        assert image["alt"]


def test_numbers_are_those_of_the_report(page: str, report: Report) -> None:
    cells = Reader(page).cells
    (effect,) = report.effects
    at = cells.index("level")
    assert cells[at + 1] == descriptions.number(effect.effect.values[0])
    assert cells[at + 2] == descriptions.interval(*effect.interval[:, 0])
    assert cells[at + 3] == "N·m"
    for declared in report.declared:
        at = cells.index(declared.label)
        assert cells[at + 1] == descriptions.number(declared.effect.values[0])
    at = cells.index("0.5 s")
    before, after, floor = (
        next(e for e in found if e.horizon == 0.5) for found in (report.before, report.after, report.floor)
    )
    assert cells[at + 3] == descriptions.number(before.rmse[0])
    assert cells[at + 5] == descriptions.number(after.rmse[0])
    assert cells[at + 7] == descriptions.number(floor.rmse[0])
    for candidate in report.candidates:
        row = [candidate.label, candidate.status, candidate.reason]
        assert any(cells[at : at + 3] == row for at in range(len(cells)))


def test_every_section_and_the_verdict_are_there(page: str, report: Report) -> None:
    words = "".join(Reader(page).words)
    for title in ("Verdict", "Model", "Effects", "Error before and after", "Missing force", "Predictions"):
        assert title in words
    for title in ("Candidates", "Findings in the data", "Data and split", "How this was obtained"):
        assert title in words
    assert all(sentence in words for sentence in descriptions.VERDICTS[report.verdict])
    assert f"seed {report.seed}" in words
    assert report.equation() in words


@pytest.mark.parametrize("verdict", ["explained", "partly explained", "unexplained"])
def test_only_an_explanation_is_claimed(report: Report, verdict: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "draw", lambda *_: "data:image/svg+xml;base64,")
    words = "".join(Reader(replace(report, verdict=verdict).html()).words)
    assert ("not claimed as the explanation" in words) == (verdict != "explained")


@pytest.mark.slow
def test_the_same_report_gives_the_same_page(page: str, report: Report) -> None:
    assert report.html() == page


def test_names_of_users_cannot_break_the_page(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "draw", lambda *_: "data:image/svg+xml;base64,")
    evil = '<script>alert("x")</script>&'
    other = replace(
        report,
        candidates=[Candidate(evil, "dropped", evil, 1.0, [evil])],
        findings=[Finding(FindingKind.GAP, evil, evil)],
        runs={"train": [evil], "select": [], "test": [evil]},
        noise={"hinge": 1e-3},
        effects=[replace(report.effects[0], alike=[evil])],
        before=[replace(e, joints=(evil,)) for e in report.before],
        after=[replace(e, joints=(evil,)) for e in report.after],
    )
    page = other.html()
    assert "<script" not in page
    reader = Reader(page)
    assert not reader.open
    assert evil in reader.cells


def test_dollars_in_names_are_no_formulas(report: Report) -> None:
    found = [replace(e, joints=("a$_{",)) for e in report.before]
    assert figures.errors_by_horizon(replace(report, before=found, after=found))


def test_without_effects_the_usual_causes_are_shown(report: Report) -> None:
    reader = Reader(replace(report, effects=[], verdict="complete", findings=[], candidates=[]).html())
    assert any("its possible causes" in image["alt"] for image in reader.images)
    assert "No effect was needed" in "".join(reader.words)


def test_without_test_runs_the_page_says_so(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "draw", lambda *_: "data:image/svg+xml;base64,")
    other = replace(report, runs={**report.runs, "test": []})
    assert "There are no test runs" in "".join(Reader(other.html()).words)
    assert "no test runs" in str(other)


def test_without_this_effect_alone_its_own_force_is_what_is_missing(report: Report) -> None:
    (found,) = report.effects
    without = figures.residuals_without(report, found.effect)
    speed = np.concatenate([r.qvel[:, 0] for r in without])
    force = np.concatenate([r.force[:, 0] for r in without])
    for sign in (-1, 1):
        median = np.median(force[sign * speed > 1.0])
        assert median == pytest.approx(-sign * found.effect.values[0], rel=0.15)


def test_medians_follow_the_data() -> None:
    x = np.linspace(-1, 1, 4001)
    noise = np.random.default_rng(0).standard_cauchy(len(x)) * 0.01
    centre, median = figures.binned_medians(x, np.sign(x) + noise)
    away = np.abs(centre) > 0.1
    np.testing.assert_allclose(median[away], np.sign(centre[away]), atol=0.01)


def test_every_effect_of_the_library_has_a_cause() -> None:
    for kind, effect in LIBRARY.items():
        assert effect.place in figures.BY_PLACE, kind
    assert set(figures.CAUSES) <= set(LIBRARY)
    assert set(figures.LEVELS) <= set(figures.CAUSES)


def test_without_matplotlib_the_extra_is_named(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install -e '.\[tracing\]'"):
        report.html()
