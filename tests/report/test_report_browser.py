"""The report in a real browser: every figure is drawn, nothing is asked of a network, nothing goes wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from browser import open_browser, violations
from tomopose.report import (
    Figure,
    Page,
    Section,
    calibration_report,
    matrices_report,
    observations_report,
    render,
    write_report,
)
from tomopose.report.style import axis, layout

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


class Visit:
    """A page after its scripts ran, what it said to the console, and what it asked a network for."""

    def __init__(self, browser, html: str, folder: Path, *, width: int = 1400, scheme: str = "light") -> None:
        write_report(folder / "report.html", html)
        self.console: list[str] = []
        self.requests: list[str] = []
        self.page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
        self.page.on("console", lambda message: self.console.append(message.text))
        self.page.on("pageerror", lambda error: self.console.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto((folder / "report.html").as_uri())

    @property
    def drawn(self) -> int:
        return int(self.page.evaluate("document.body.dataset.figuresDrawn"))

    def draw_all(self) -> None:
        self.page.evaluate("tomoposeFigures.all()")

    def count(self, selector: str) -> int:
        return self.page.locator(selector).count()


def inspect(browser, html: str, folder: Path, *, flat: int, space: int) -> Visit:
    """Visit a report and require so many plots in the plane and so many in space, each with marks, and silence."""
    visit = Visit(browser, html, folder)
    visit.draw_all()
    assert visit.drawn == flat + space
    assert visit.count(".plot[data-drawn]") == flat + space
    assert visit.count(".plot canvas.space") == space
    marks = "e => e.querySelectorAll('.point, .line, .bar, .cell, canvas').length"
    assert all(visit.page.locator(".plot").nth(k).evaluate(marks) for k in range(flat + space))
    inked = "e => e.getContext('2d').getImageData(0, 0, e.width, e.height).data.some(x => x > 0)"
    assert all(visit.page.locator("canvas.space").nth(k).evaluate(inked) for k in range(space))
    assert visit.console == []
    assert [r for r in visit.requests if not r.startswith(("file:", "data:"))] == []
    return visit


@pytest.mark.slow
def test_a_full_report_is_drawn(browser, sample, scan, tmp_path):
    calibration, observations, poses = sample()
    html = calibration_report(calibration, observations=observations, poses=poses, scan=scan)
    visit = inspect(browser, html, tmp_path, flat=12, space=3)
    assert visit.count(".point") > 5 * len(calibration.pose_id)


@pytest.mark.slow
def test_a_bare_report_is_drawn(browser, sample, tmp_path):
    calibration, _, _ = sample(turns=(0.0,))
    inspect(browser, calibration_report(calibration, observations=None, poses=None), tmp_path, flat=8, space=1)


@pytest.mark.slow
def test_the_other_reports_are_drawn(browser, sample, scan, tmp_path):
    _, observations, _ = sample()
    for name, html, flat, space in (
        ("observations", observations_report(observations), 2, 0),
        ("matrices", matrices_report(scan), 2, 1),
    ):
        folder = tmp_path / name
        folder.mkdir()
        inspect(browser, html, folder, flat=flat, space=space)


@pytest.mark.slow
def test_plots_are_drawn_when_they_are_scrolled_to(browser, sample, scan, tmp_path):
    calibration, observations, poses = sample()
    html = calibration_report(calibration, observations=observations, poses=poses, scan=scan)
    visit = Visit(browser, html, tmp_path)
    visit.page.wait_for_timeout(200)
    before = visit.drawn
    assert before < 15
    visit.page.locator(".plot").last.scroll_into_view_if_needed()
    visit.page.locator(".plot").nth(14).and_(visit.page.locator("[data-drawn='yes']")).wait_for()
    assert visit.drawn > before


@pytest.mark.slow
def test_a_page_that_tries_to_load_is_noticed_and_stopped(browser, sample, tmp_path):
    """The checks above can fail: a smuggled address is refused by the page's policy, and seen where there is none."""
    _, observations, _ = sample()
    html = observations_report(observations).replace("</main>", '<img src="http://192.0.2.1/x.png"></main>')
    guarded = Visit(browser, html, tmp_path)
    assert any("Content Security Policy" in line for line in guarded.console)
    opened = Visit(browser, re.sub(r"<meta http-equiv=.*?>", "", html), tmp_path)
    assert "http://192.0.2.1/x.png" in opened.requests


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_report_is_accessible(browser, sample, scan, tmp_path, scheme):
    calibration, observations, poses = sample(verdict="doubtful")
    html = calibration_report(calibration, observations=observations, poses=poses, scan=scan)
    visit = Visit(browser, html, tmp_path, scheme=scheme)
    visit.draw_all()
    assert violations(visit.page) == []


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 700, 1400])
def test_nothing_is_wider_than_the_window(browser, sample, scan, tmp_path, width):
    calibration, observations, poses = sample()
    html = calibration_report(calibration, observations=observations, poses=poses, scan=scan)
    visit = Visit(browser, html, tmp_path, width=width)
    visit.draw_all()
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    wide = "e => e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).overflowX === 'visible'"
    if width < 640:
        tables = visit.page.locator("table")
        assert not any(tables.nth(k).evaluate(wide) for k in range(tables.count()))


@pytest.mark.slow
def test_a_table_is_sorted_by_the_keyboard(browser, sample, tmp_path):
    _, observations, _ = sample()
    visit = Visit(browser, observations_report(observations), tmp_path)
    visit.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    table = visit.page.locator("table").last
    button = table.locator("thead button").nth(1)
    button.focus()
    cells = "t => [...t.tBodies[0].rows].map(r => parseFloat(r.children[1].textContent)).filter(x => !isNaN(x))"
    for order, sign in (("ascending", 1), ("descending", -1)):
        visit.page.keyboard.press("Enter")
        assert table.locator("th").nth(1).get_attribute("aria-sort") == order
        values = np.array(table.evaluate(cells))
        assert len(values) > 100
        assert (sign * np.diff(values) >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("low", "high", "labels", "note"),
    [
        (0.0, 1.0, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"], ""),
        (-0.0003, 0.0003, ["−200", "0", "200"], " · 10⁻⁶"),
        (0.0, 25000.0, ["0", "5", "10", "15", "20", "25"], " · 10³"),
        (1021.4, 1021.46, ["0", "20", "40", "60"], " − 1021.40, · 10⁻³"),
    ],
)
def test_tick_labels_have_at_most_four_digits(browser, low, high, labels, note, tmp_path):
    figure = Figure(title="t", meaning="m", look_for="l", data=[], layout=layout(xaxis=axis("x"), yaxis=axis("y")))
    figure = Figure(**{**vars(figure), "data": [{"type": "scatter", "x": [low, high], "y": [0, 1]}]})
    html = render(Page(title="ticks", sections=[Section(title="s", blocks=[figure])]))
    visit = Visit(browser, html, tmp_path)
    count = 3 if len(labels) == 3 else 5
    found = visit.page.evaluate(f"tomoposeNumbers.ticks({low}, {high}, {count})")
    assert found["labels"] == labels
    assert found["note"] == note
    assert all(sum(c.isdigit() for c in label) <= 4 for label in found["labels"])
