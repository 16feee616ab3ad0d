"""The drawings of the documentation, in a browser: no text lies over another or leaves the sheet."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from browser import open_browser

pytestmark = pytest.mark.browser

DRAWINGS = sorted((Path(__file__).resolve().parents[2] / "docs" / "images").glob("*.svg"))

TEXTS = """() => [...document.querySelectorAll("svg text")].map((t) => {
  const b = t.getBoundingClientRect(), s = t.ownerSVGElement.getBoundingClientRect();
  const corners = (r) => [r.left, r.top, r.right, r.bottom];
  return { words: t.textContent.trim(), box: corners(b), sheet: corners(s) };
})"""
TOUCHING = 1.0


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


def hidden(browser, svg: str) -> list[str]:
    """What overlaps in a drawing, in words."""
    page = browser.new_page()
    page.set_content(f"<body style='margin: 0'>{svg}</body>")
    texts = [t for t in page.evaluate(TEXTS) if t["words"]]
    page.close()
    assert texts
    found = []
    for k, a in enumerate(texts):
        for b in texts[k + 1 :]:
            (p, q, r, s), (w, x, y, z) = a["box"], b["box"]
            if min(r, y) - max(p, w) > TOUCHING and min(s, z) - max(q, x) > TOUCHING:
                found.append(f"{a['words']!r} and {b['words']!r} overlap")
        (p, q, r, s), (w, x, y, z) = a["box"], a["sheet"]
        if p < w - TOUCHING or q < x - TOUCHING or r > y + TOUCHING or s > z + TOUCHING:
            found.append(f"{a['words']!r} leaves the sheet")
    return found


def test_every_picture_that_a_page_shows_is_there():
    docs = DRAWINGS[0].parents[1]
    for page in docs.rglob("*.md"):
        for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / name).is_file(), (page.name, name)


@pytest.mark.parametrize("drawing", DRAWINGS, ids=lambda p: p.stem)
def test_a_drawing_hides_no_text(browser, drawing):
    assert hidden(browser, drawing.read_text(encoding="utf-8")) == []


def test_texts_over_one_another_and_beside_the_sheet_are_found(browser):
    svg = (
        '<svg xmlns="http://www.w3.org/2000/svg" width="200" height="100"><text x="20" y="40">table</text>'
        '<text x="30" y="44">source</text><text x="190" y="80">detector</text></svg>'
    )
    assert hidden(browser, svg) == ["'table' and 'source' overlap", "'detector' leaves the sheet"]
