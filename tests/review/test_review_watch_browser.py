"""The page of a run that is being taken, in a real browser, with radiographs that arrive one after the other."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest

import tomopose as tp
from browser import open_browser, open_page, review_address, violations

pytestmark = [pytest.mark.browser, pytest.mark.slow]

TAKEN = 12
"""More than a first calibration needs."""


@pytest.fixture
def browser():
    with open_browser() as opened:
        yield opened


@pytest.fixture
def run(project, drawn, tmp_path):
    """(address, arrive): a watched folder that is empty, and what lets further radiographs of the run arrive."""
    folder, waiting = tmp_path / "arriving", tmp_path / "waiting"
    folder.mkdir()
    waiting.mkdir()
    poses = tp.read_poses(project.folder / "poses.csv")
    chosen = np.linspace(0, len(poses) - 1, TAKEN).round().astype(int)
    names = [f"{poses.pose_id[k]}.tif" for k in chosen]
    for k, name in zip(chosen, names, strict=True):
        drawn(waiting / name, int(k))

    def arrive(first: int, last: int) -> None:
        for name in names[first:last]:
            shutil.copy(waiting / name, folder / name)

    given = {"--scanner": "scanner.json", "--poses": "poses.csv"}
    words = [w for name, file in given.items() for w in (name, str(project.folder / file))]
    with review_address("--watch", str(folder), *words, "--ball-diameter-mm", "8") as address:
        yield address, arrive


def arrived(page, count: int) -> None:
    page.wait_for_selector(f"body[data-arrived='{count}']", timeout=120_000)


def test_the_page_follows_a_run_image_by_image(browser, run):
    address, arrive = run
    page = open_page(browser, address)
    arrived(page, 0)
    assert page.inner_text("#verdict") == "0 of 200 images"
    assert page.inner_text("#said") == "No ball was measured yet."
    assert page.locator("#copy").is_disabled()
    arrive(0, 3)
    arrived(page, 3)
    assert page.inner_text("#verdict") == "3 of 200 images"
    assert page.inner_text("#said") == "5 more measured poses until a first calibration."
    assert "% of the panel's parts" in page.inner_text("#panel-words")
    assert page.locator("#plot .point").count() == 3
    assert page.locator("#decisions li").count() == 3
    assert "MOV X" in page.inner_text("#command")
    arrive(3, TAKEN)
    arrived(page, TAKEN)
    assert page.locator("#sigma tr").count() >= 9
    assert page.locator("#plot .point").count() == TAKEN
    assert all(line.split(": ")[1] in ("ok", "truncated") for line in page.locator("#decisions li").all_inner_texts())
    found = [float(x) for x in page.inner_text("#next-words").split("scan: ")[1].split() if x[0].isdigit()]
    assert found[1] < found[0]
    assert math.isfinite(found[0])
    assert page.inner_text("#scan").startswith("Error of a tilted scan so far: ")
    assert page.said == []


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (1400, "dark"), (380, "light"), (380, "dark")])
def test_the_page_is_accessible_and_fits(browser, run, width, scheme):
    address, arrive = run
    page = open_page(browser, address, width=width, scheme=scheme)
    arrived(page, 0)
    assert violations(page) == []
    arrive(0, TAKEN)
    arrived(page, TAKEN)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert violations(page) == []
    plain = page.evaluate("[...document.querySelectorAll('#plot .point')].map(p => getComputedStyle(p).fill)")
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert len(plain) == TAKEN
    assert ground not in plain
    assert page.said == []


def test_the_command_is_copied_by_the_keyboard(browser, run):
    address, arrive = run
    page = open_page(browser, address)
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    arrive(0, 1)
    arrived(page, 1)
    page.keyboard.press("c")
    page.locator("#copied", has_text="copied").wait_for()
    assert page.evaluate("navigator.clipboard.readText()") == page.inner_text("#command")
    for _ in range(6):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.id") == "copy":
            break
    assert page.evaluate("document.activeElement.id") == "copy"
    page.keyboard.press("Enter")
    assert page.said == []


def test_a_watch_that_has_ended_is_said(browser, project, tmp_path):
    words = ["--scanner", str(project.folder / "scanner.json"), "--poses", str(project.folder / "poses.csv")]
    with review_address("--watch", str(tmp_path), *words, "--ball-diameter-mm", "8") as address:
        page = open_page(browser, address)
        arrived(page, 0)
    page.locator("#said", has_text="the run is not being watched any more").wait_for()
