"""Runs the studies at small scale and keeps their pictures for docs/gallery.md in docs/images/gallery.

python docs/images/make_gallery.py [STUDY ...]

Ends with code 1 where texts of a drawing lie over one another, or a legend over its data.
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
    bad = 0
    for name in sys.argv[1:] or KEPT:
        figures = run_study(name).figures  # before anything is removed: a run that ends early loses no picture
        for old in FOLDER.glob(f"{name}-*.png"):
            old.unlink()
        for k in KEPT[name]:
            hidden = figure_png(FOLDER / f"{name}-{k}.png", figures[k - 1])
            print(FOLDER / f"{name}-{k}.png", figures[k - 1].title, *hidden, sep="; ", flush=True)
            bad += len(hidden)
    if bad:
        sys.exit(f"{bad} overlaps in the gallery's drawings")


if __name__ == "__main__":
    main()
