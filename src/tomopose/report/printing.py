"""An HTML report on paper: PDF by an installed Chromium, which draws every figure before it prints."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from tomopose.errors import EngineFailedError, EngineMissingError
from tomopose.files import atomic_file

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "msedge")
INSTALL = "apt-get install chromium"
SECONDS = 180


def browser() -> str:
    """The browser that prints: of TOMOPOSE_CHROMIUM, else the first that is installed.  EngineMissingError without."""
    found = next(filter(None, map(shutil.which, (os.environ.get("TOMOPOSE_CHROMIUM", ""), *BROWSERS))), None)
    if found is None:
        raise EngineMissingError(
            "PDF needs a Chromium, and none is installed or named by TOMOPOSE_CHROMIUM; a browser prints the page too",
            install_line=INSTALL,
        )
    return found


def write_pdf(path: str | Path, html: str) -> None:
    """Write an HTML document as PDF, A4, atomically.

    Raises EngineMissingError without a Chromium, EngineFailedError where it prints nothing.
    """
    program = browser()
    with tempfile.TemporaryDirectory() as folder, atomic_file(path) as target:
        page, printed = Path(folder) / "page.html", Path(folder) / "page.pdf"
        page.write_text(html, encoding="utf-8")
        # A root user (a container) has no sandbox to give; the page is ours and may load nothing.
        sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        words = [
            program, "--headless", "--disable-gpu", *sandbox, "--no-first-run", "--disable-background-networking",
            f"--user-data-dir={folder}/profile", "--no-pdf-header-footer", f"--print-to-pdf={printed}", page.as_uri(),
        ]  # fmt: skip
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired as error:
            raise EngineFailedError(f"{program} printed nothing in {SECONDS} s") from error
        if done.returncode or not printed.is_file() or not printed.read_bytes().startswith(b"%PDF"):
            said = " ".join(done.stderr.split())[-300:]
            raise EngineFailedError(f"{program} printed nothing (exit code {done.returncode}): {said}")
        target.write_bytes(printed.read_bytes())
