"""A real browser for tests: Debian's Chromium, driven by Playwright, with axe-core for accessibility."""

from __future__ import annotations

import os
import shutil
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
