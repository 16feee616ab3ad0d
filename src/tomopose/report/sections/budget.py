"""Where the uncertainty of measured values comes from."""

from __future__ import annotations

import math

from tomopose.measurement.budget import Budget
from tomopose.measurement.results import MeasurementResults
from tomopose.report.page import Section, Table
from tomopose.report.words import NOT_DETERMINABLE
from tomopose.units import MICROMETRES_PER_MM

MANY = 40
"""Results of one kind from which they are shown by number instead of by name."""


def micrometres(value: float | None, signed: bool = False) -> str:
    """A length, mm, as micrometres in words."""
    if value is None or not math.isfinite(value):
        return NOT_DETERMINABLE
    return f"{value * MICROMETRES_PER_MM:+.2f}" if signed else f"{value * MICROMETRES_PER_MM:.2f}"


def budget_sections(results: MeasurementResults) -> list[Section]:
    """Where the uncertainty comes from, where more than the fit is known."""
    found = [b for b in results.budgets() if b.unit == "mm"]
    stated = ("repeats", "calibration", "simulation", "workpiece", "temperature")
    if not any(getattr(b, name) is not None for b in found for name in stated):
        return []

    def cells(b: Budget) -> list[str]:
        shares = [
            "–" if u is None or not math.isfinite(u) else micrometres(u)
            for u in (b.fit, b.repeats, b.calibration, b.simulation, b.workpiece, b.temperature)
        ]
        corrected = ["–", "–"] if b.mean_error is None else [micrometres(b.mean_error, True), f"{b.corrected:.5f}"]
        return [
            b.volume,
            b.name,
            f"{b.value:.5f}",
            *shares,
            *corrected,
            micrometres(b.U) if math.isfinite(b.U) else "–",
            b.interval,
        ]

    return [
        Section(
            title="Uncertainty",
            lead="Standard uncertainties, each by itself, and the 95 % interval of all together.",
            blocks=[
                Table(
                    title="Shares",
                    meaning="Fit and repeats show the same scatter, the larger counts; the calibration's share is "
                    "added in squares. Virtual scans hold noise and systematic part, and cover all: their mean "
                    "error is taken off the value, and U is that of one more scan like them.",
                    columns=[
                        "volume",
                        "name",
                        "measured / mm",
                        "fit / µm",
                        "repeats / µm",
                        "calibration / µm",
                        "simulation / µm",
                        "workpiece / µm",
                        "temperature / µm",
                        "its mean error / µm",
                        "corrected by simulation / mm",
                        "U / µm",
                        "holds",
                    ],
                    numeric=tuple(range(2, 12)),
                    rows=[cells(b) for b in found],
                    folded=len(found) > MANY,
                )
            ],
        )
    ]
