"""Reports: the only home of plotting and HTML.  Each function takes values and returns one offline HTML document.

Other results are reported with the same parts: a `Page` of `Section`s made of `Figure`, `Table`, `Words` and `Pictures`
blocks, rendered by `render`.
"""

from tomopose.report.figures.thumbnails import Thumbnail, thumbnail, worst_thumbnails
from tomopose.report.page import (
    Figure,
    KeyFigure,
    Page,
    Pictures,
    Section,
    Table,
    Verdict,
    Words,
    render,
    write_report,
)
from tomopose.report.pages.calibration_page import calibration_report
from tomopose.report.pages.history_page import comparison_report, history_report
from tomopose.report.pages.other_pages import matrices_report, observations_report
from tomopose.report.pages.volume_page import volume_pictures, volume_report

__all__ = [
    "Figure",
    "KeyFigure",
    "Page",
    "Pictures",
    "Section",
    "Table",
    "Thumbnail",
    "Verdict",
    "Words",
    "calibration_report",
    "comparison_report",
    "history_report",
    "matrices_report",
    "observations_report",
    "render",
    "thumbnail",
    "volume_pictures",
    "volume_report",
    "worst_thumbnails",
    "write_report",
]
