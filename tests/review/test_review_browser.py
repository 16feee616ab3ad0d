"""A technician reviews 200 detections by keyboard, in a real browser; a replay gives the same bytes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from browser import open_browser, open_page, review_address, violations
from tomopose.calibration.records.decisions import read_decisions
from tomopose.cli.main import run

pytestmark = [pytest.mark.browser, pytest.mark.slow]

FAR = 10.0
"""Times the usual residual from which the scripted person leaves a detection out: spoilt ones are at 30 and above."""


PIXELS = "(c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data)(document.getElementById('picture'))"


@pytest.fixture
def address(project):
    """A review of the project in a process of its own, as a person starts it."""
    with review_address(str(project.cal), "--who", "N. Sato", "--images", str(project.folder / "radiographs")) as found:
        yield found


@pytest.fixture
def browser():
    with open_browser() as opened:
        yield opened


def visit(browser, address: str, *, width: int = 1400, scheme: str = "light"):
    page = open_page(browser, address, width=width, scheme=scheme)
    page.wait_for_selector("body[data-ready]")
    page.wait_for_selector("#tabs button")
    return page


def times_usual(page) -> float:
    return page.evaluate("parseFloat([...document.querySelectorAll('#numbers dd')][2].textContent)")


def settled(page) -> None:
    """Wait by selectors: the page's policy forbids to evaluate text as a script, a test's too."""
    page.wait_for_selector("body[data-busy='0']", state="attached", timeout=600_000)


@pytest.mark.slow
def test_a_person_finds_every_spoilt_detection_by_keyboard_alone(browser, address, project):
    page = visit(browser, address)
    for _ in range(200):
        page.keyboard.press("x" if times_usual(page) > FAR else "a")
    settled(page)
    page.keyboard.press("s")
    page.locator("#said", has_text="written: reviewed/calibration.json").wait_for(timeout=120_000)
    decisions = read_decisions(project.cal / "review.jsonl")
    assert len(decisions) == 200
    assert sorted(d.pose_id for d in decisions if d.action == "leave-out") == list(project.spoilt)
    assert page.said == []

    job = project.words("again", "--review", str(project.cal / "review.jsonl"), "--quiet")
    images = [*job, "--force"]
    assert run(images) in (0, 3)
    for name in ("calibration.json", "observations.csv", "decisions.jsonl"):
        assert (project.cal / "reviewed" / name).read_bytes() == (project.folder / "again" / name).read_bytes(), name
    report = (project.cal / "reviewed" / "report.html").read_text(encoding="utf-8")
    assert report.count("N. Sato") >= 200


@pytest.mark.slow
def test_undo_move_start_and_reasons_work_by_keyboard(browser, address, project):
    page = visit(browser, address)
    names = page.locator("#rows .name").all_inner_texts()
    place = names.index("p000")
    for _ in range(place):
        page.keyboard.press("j")
    assert page.locator("#pose").inner_text().startswith("p000 ")
    page.keyboard.press("w")
    page.keyboard.type("start was off: axum")
    page.keyboard.press("Enter")
    page.keyboard.press("m")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowUp")
    page.keyboard.press("Enter")
    settled(page)
    (decision,) = read_decisions(project.cal / "review.jsonl")
    assert (decision.pose_id, decision.action, decision.why) == ("p000", "measure-again", "start was off: axum")
    content = json.loads((project.cal / "review.jsonl").read_text())
    centre = decision.judged
    assert decision.start[1] - centre[1] == pytest.approx(10.0, abs=0.5)
    assert decision.start[0] - centre[0] == pytest.approx(1.0, abs=0.5)
    assert abs(content["measured"]["x_px"][0] - centre[0]) < 2.5
    assert page.locator("#decisions li").count() == 1
    page.keyboard.press("u")
    settled(page)
    page.wait_for_selector("#decisions:empty", state="attached")
    assert (project.cal / "review.jsonl").read_text() == ""
    assert page.said == []


@pytest.mark.slow
def test_the_radiograph_is_shown_with_what_was_found(browser, address):
    page = visit(browser, address)
    for _ in range(100):
        if page.evaluate(f"{PIXELS}.some((x, i) => i % 4 === 0 && x > 60)"):
            break
        page.wait_for_timeout(100)
    colours = page.evaluate(
        f"(() => {{ const d = {PIXELS}; let found = 0, predicted = 0; for (let i = 0; i < d.length; i += 4) {{"
        "if (d[i] > 230 && d[i + 2] < 80) found += 1; if (d[i] < 90 && d[i + 2] > 230) predicted += 1; }"
        "return [found, predicted]; })()"
    )
    assert min(colours) > 20


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (1400, "dark"), (380, "light")])
def test_the_page_is_accessible_and_fits(browser, address, width, scheme):
    page = visit(browser, address, width=width, scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert violations(page) == []
    for key in "1234567":
        page.keyboard.press(key)
        assert page.locator("#plot[data-drawn]").count() == 1
    assert violations(page) == []
    assert page.said == []


@pytest.mark.slow
def test_the_address_without_its_token_shows_nothing(browser, address):
    page = browser.new_page()
    answer = page.goto(address.rsplit("/", 2)[0] + "/")
    assert answer.status == 403
    assert "token" in page.inner_text("body")


@pytest.mark.slow
def test_nothing_of_the_reviewed_folder_is_changed(browser, address, project: Path):
    before = {p.name: p.read_bytes() for p in project.cal.iterdir() if p.is_file()}
    page = visit(browser, address)
    page.keyboard.press("x")
    settled(page)
    after = {p.name: p.read_bytes() for p in project.cal.iterdir() if p.is_file() and p.name != "review.jsonl"}
    assert after == before
