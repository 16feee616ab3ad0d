"""Runs the studies at small scale and keeps their pictures for docs/gallery.md in docs/images/gallery.

python docs/images/make_gallery.py [STUDY ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

from tomopose.report.pages.study_page import figure_png
from tomopose.studies.registry import run_study

FOLDER = Path(__file__).parent / "gallery"
KEPT = {
    "table1": (1,),
    "table2": (1,),
    "figure8": (1, 2, 3),
    "figure9": (1,),
    "tuy": (1, 6, 7),
    "cylinder": (1,),
    "section6": (2, 3, 4, 5, 6, 7, 8),
    "improvements": (1,),
}
"""Study -> numbers of its figures."""


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or KEPT:
        for old in FOLDER.glob(f"{name}-*.png"):
            old.unlink()
        figures = run_study(name).figures
        for k in KEPT[name]:
            figure_png(FOLDER / f"{name}-{k}.png", figures[k - 1])
            print(FOLDER / f"{name}-{k}.png", figures[k - 1].title)


if __name__ == "__main__":
    main()
