"""The report in a real browser: every figure is drawn, nothing is asked of a network, nothing goes wrong."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tomopose.report import calibration_report, matrices_report, observations_report, write_report

pytestmark = pytest.mark.browser

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HARMLESS = ("GPU stall due to ReadPixels", "Canvas2D: Multiple readback operations")
"""Remarks about speed that a browser without a graphics card makes."""

OF_THE_BROWSER = "not an origin"
"""What the browser's log names as the initiator of its own requests (updates, its clock); a page has an origin."""


@pytest.fixture(scope="module")
def chromium() -> str:
    """A Chromium.  Its absence is a failure where CI is set, a skip elsewhere."""
    found = next(filter(None, map(shutil.which, (os.environ.get("TOMOPOSE_CHROMIUM", ""), *NAMES))), None)
    if found is None:
        message = "the browser tests did not run: no Chromium found (set TOMOPOSE_CHROMIUM, or install chromium)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


def visit(chromium: str, page: Path, folder: Path) -> tuple[str, list[str], list[str]]:
    """The page's DOM after its scripts ran, its words to the console, and the addresses it asked a network for."""
    log = folder / "net.json"
    result = subprocess.run(
        [
            chromium,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-unsafe-swiftshader",
            "--disable-background-networking",
            "--disable-component-update",
            "--no-first-run",
            "--disable-sync",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={folder / 'profile'}",
            f"--log-net-log={log}",
            "--window-size=1400,6000",
            "--virtual-time-budget=20000",
            "--enable-logging=stderr",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=180,
        check=True,
    )
    console = [
        line for line in re.findall(r'CONSOLE:\d+\] "(.*?)", source', result.stderr) if not line.startswith(HARMLESS)
    ]
    console = [line for line in console if not any(words in line for words in HARMLESS)]
    events = [event.get("params", {}) for event in json.loads(log.read_text(encoding="utf-8"))["events"]]
    requests = [p["url"] for p in events if "url" in p and p.get("initiator", OF_THE_BROWSER) != OF_THE_BROWSER]
    return result.stdout, console, requests


def inspect(chromium: str, html: str, folder: Path, *, flat: int, space: int) -> str:
    """Visit a report and require so many plots in the plane and so many in space, and silence."""
    write_report(folder / "report.html", html)
    dom, console, requests = visit(chromium, folder / "report.html", folder)
    body = re.sub(r"<script.*?</script>", "", dom, flags=re.S)
    assert f'data-figures-drawn="{flat + space}"' in body
    assert len(re.findall(r'<div class="plot js-plotly-plot"', body)) == flat + space
    assert len(re.findall(r'<div id="scene"|<div class="gl-container"', body)) >= space
    assert body.count("<canvas") == space
    assert "WebGL is not supported" not in body
    plots = re.split(r'<div class="plot js-plotly-plot"', body)[1:]
    assert all('class="main-svg"' in plot for plot in plots)
    assert console == []
    assert requests == []
    return body


def test_a_full_report_is_drawn(chromium, sample, scan, tmp_path):
    calibration, observations, poses = sample()
    html = calibration_report(calibration, observations=observations, poses=poses, scan=scan)
    body = inspect(chromium, html, tmp_path, flat=12, space=3)
    assert body.count('class="point"') > 5 * len(calibration.pose_id)


def test_a_bare_report_is_drawn(chromium, sample, tmp_path):
    calibration, _, _ = sample(turns=(0.0,))
    inspect(chromium, calibration_report(calibration, observations=None, poses=None), tmp_path, flat=8, space=1)


def test_the_other_reports_are_drawn(chromium, sample, scan, tmp_path):
    _, observations, _ = sample()
    for name, html, flat, space in (
        ("observations", observations_report(observations), 2, 0),
        ("matrices", matrices_report(scan), 2, 1),
    ):
        folder = tmp_path / name
        folder.mkdir()
        inspect(chromium, html, folder, flat=flat, space=space)


def test_a_page_that_tries_to_load_is_noticed_and_stopped(chromium, sample, tmp_path):
    """The checks above can fail: a smuggled address is refused by the page's policy, and seen where there is no
    policy."""
    _, observations, _ = sample()
    html = observations_report(observations).replace("</main>", '<img src="http://192.0.2.1/x.png"></main>')
    for name, page in (("guarded", html), ("open", re.sub(r"<meta http-equiv=.*?>", "", html))):
        (tmp_path / name).mkdir()
        write_report(tmp_path / name / "report.html", page)
    _, console, requests = visit(chromium, tmp_path / "guarded" / "report.html", tmp_path / "guarded")
    assert any("Content Security Policy" in line for line in console)
    assert requests == []
    _, _, requests = visit(chromium, tmp_path / "open" / "report.html", tmp_path / "open")
    assert requests == ["http://192.0.2.1/x.png"]
