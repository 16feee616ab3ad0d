"""A study's files: study.json, study.html, and its figures as PNG."""

from __future__ import annotations

import re
from pathlib import Path

from tomopose.files import require_absent, write_json
from tomopose.report.page import write_report
from tomopose.report.pages.study_page import figure_png, study_report
from tomopose.studies.parts.result import StudyResult


def picture_name(k: int, title: str) -> str:
    """figure-1-TITLE.png with a title that every file system takes."""
    return f"figure-{k + 1}-{re.sub('[^a-z0-9]+', '-', title.lower()).strip('-')[:50]}.png"


def write_study(folder: str | Path, result: StudyResult, *, force: bool = False) -> None:
    """Page and JSON first, then the pictures.

    Raises FileError where a file exists and `force` is not set, EngineMissingError where matplotlib, which draws the
    pictures, is not installed; page and JSON are there by then.
    """
    folder = Path(folder)
    pictures = [folder / picture_name(k, f.title) for k, f in enumerate(result.figures)]
    paths = [folder / "study.json", folder / "study.html", *pictures]
    for path in paths:
        require_absent(path, force=force)
    content = result.to_json()
    write_json(paths[0], "study", content)
    write_report(
        paths[1],
        study_report(
            title=result.title,
            paper=result.paper,
            question=result.question,
            rows=content["rows"],
            checks=content["checks"],
            figures=result.figures,
            notes=result.notes,
            scale=result.scale,
            seconds=result.seconds,
            provenance=result.provenance,
        ),
    )
    for path, figure in zip(pictures, result.figures, strict=True):
        figure_png(path, figure)
