"""Runs the studies at small scale and keeps their pictures for docs/gallery.md in docs/images/gallery.

    python docs/images/make_gallery.py [STUDY ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

from tomopose.report.study_page import figure_png
from tomopose.studies.registry import PAPER, run_study

FOLDER = Path(__file__).parent / "gallery"


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PAPER:
        for old in FOLDER.glob(f"{name}-*.png"):
            old.unlink()
        for k, figure in enumerate(run_study(name).figures, start=1):
            figure_png(FOLDER / f"{name}-{k}.png", figure)
            print(FOLDER / f"{name}-{k}.png", figure.title)


if __name__ == "__main__":
    main()
