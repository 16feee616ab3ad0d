"""A real browser for tests: Debian's Chromium, driven by Playwright, with axe-core for accessibility."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def chromium_path() -> str:
    """A Chromium.  Its absence is a failure where CI is set, a skip elsewhere."""
    found = next(filter(None, map(shutil.which, (os.environ.get("TOMOPOSE_CHROMIUM", ""), *NAMES))), None)
    if found is None:
        message = "the browser tests did not run: no Chromium found (set TOMOPOSE_CHROMIUM, or install chromium)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


@contextmanager
def open_browser() -> Iterator[object]:
    """A headless browser whose pages know no name server."""
    if not os.environ.get("CI"):
        pytest.importorskip("playwright")
    from playwright import sync_api

    arguments = ["--no-sandbox", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=arguments)
        yield browser
        browser.close()


def violations(page) -> list[str]:
    """What axe-core calls serious or critical on a page, in words."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page).response["violations"]
    return [
        f"{v['id']} ({v['impact']}): {v['help']}; {[n['target'] for n in v['nodes']][:3]}"
        for v in found
        if v["impact"] in ("serious", "critical")
    ]


ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/[\w-]{43}/")


@contextmanager
def review_address(*words: str) -> Iterator[str]:
    """The address of `tomopose review WORDS` in a process of its own, as a person starts it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tomopose", "review", *words, "--no-browser"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        line = process.stdout.readline()
        found = ADDRESS.search(line)
        assert found, (line, "" if line else process.stderr.read())
        yield found[0]
    finally:
        process.terminate()
        process.wait(timeout=30)
        process.stdout.close()
        process.stderr.close()


def open_page(browser, address: str, *, width: int = 1400, scheme: str = "light"):
    """A page with a list `said` of everything that it said to the console."""
    page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
    page.said = []
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.goto(address)
    return page
