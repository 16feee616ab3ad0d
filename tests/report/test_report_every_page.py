"""Every page that the package writes, in a browser: accessible, silent, small, readable on a phone, explained."""

from __future__ import annotations

import re

import pytest
from every_page import every_page

from browser import open_browser, open_page, violations

pytestmark = [pytest.mark.browser, pytest.mark.slow]

NAMES = (
    "calibration", "observations", "matrices", "comparison", "history", "certificate", "measurement", "protocol",
    "multi-sphere", "volume", "refinement", "scan plan", "study",
)  # fmt: skip
LARGEST = 1_500_000
"""Bytes of a report."""


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def pages(sample, scan, tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("pages"), {}
    for name, html in every_page(sample, scan).items():
        found[name] = folder / f"{name}.html"
        found[name].write_text(html, encoding="utf-8")
    return found


def opened(browser, path, **how):
    """A page with all its plots drawn and everything that is folded shown."""
    page = open_page(browser, path.as_uri(), **how)
    page.evaluate("window.tomoposeFigures && tomoposeFigures.all()")
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    return page


def test_every_page_is_tested(pages):
    assert tuple(pages) == NAMES


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", NAMES)
def test_a_page_is_accessible_and_silent(browser, pages, name, scheme):
    page = opened(browser, pages[name], scheme=scheme)
    assert violations(page) == []
    assert page.said == []
    page.context.close()


@pytest.mark.parametrize("name", NAMES)
def test_a_page_is_small_and_fits_a_phone(browser, pages, name):
    assert pages[name].stat().st_size < LARGEST
    page = opened(browser, pages[name], width=360)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    cut = """() => [...document.querySelectorAll("table")].filter((t) => t.scrollWidth > t.clientWidth + 1
      && getComputedStyle(t).overflowX === "visible"
      && getComputedStyle(t.parentNode).overflowX === "visible").length"""
    assert page.evaluate(cut) == 0
    page.context.close()


@pytest.mark.parametrize("name", NAMES)
def test_every_plot_has_a_role_a_label_and_short_marks(browser, pages, name):
    page = opened(browser, pages[name])
    plots = page.evaluate(
        "[...document.querySelectorAll('.plot')].map((p) => [p.getAttribute('role'), p.getAttribute('aria-label')])"
    )
    assert all(role == "figure" and len(label) > 20 for role, label in plots)
    assert page.evaluate("[...document.querySelectorAll('figcaption')].every((c) => c.textContent.trim().length > 5)")
    marks = page.evaluate("[...document.querySelectorAll('text.tick')].map((t) => t.textContent)")
    numbers = [m for m in marks if re.fullmatch(r"[\u2212-]?[\d.]+", m)]
    assert all(sum(c.isdigit() for c in m) <= 4 for m in numbers), numbers
    page.context.close()


@pytest.mark.parametrize("name", NAMES)
def test_every_table_is_sorted_by_the_keyboard(browser, pages, name):
    page = opened(browser, pages[name])
    tables = page.locator("table.sortable:has(thead button)")  # a list of fields and entries has no heads
    for k in range(tables.count()):
        head = tables.nth(k).locator("thead th:has(button)").first
        for order in ("ascending", "descending"):
            head.locator("button").focus()
            page.keyboard.press("Enter")
            assert head.get_attribute("aria-sort") == order
    page.context.close()


@pytest.mark.parametrize("name", NAMES)
def test_every_key_figure_is_explained_in_words(browser, pages, name):
    page = opened(browser, pages[name])
    keys = page.evaluate(
        "[...document.querySelectorAll('.keys > div')].map((d) => [d.querySelector('dt').textContent, "
        "d.querySelector('.note') ? d.querySelector('.note').textContent : ''])"
    )
    assert [key for key, note in keys if len(note.split()) < 2] == []
    page.context.close()
