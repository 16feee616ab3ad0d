"""Reports: the only home of plotting and HTML.  Each function takes values and returns one offline HTML document."""

from tomopose.report.calibration_page import calibration_report
from tomopose.report.other_pages import matrices_report, observations_report
from tomopose.report.page import write_report
from tomopose.report.thumbnails import Thumbnail, thumbnail, worst_thumbnails

__all__ = [
    "Thumbnail",
    "calibration_report",
    "matrices_report",
    "observations_report",
    "thumbnail",
    "worst_thumbnails",
    "write_report",
]
