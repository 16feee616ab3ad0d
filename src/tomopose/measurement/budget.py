"""The uncertainty of a measurand from all that is known of it, each share apart and together.

    fit           from the scatter of the fitted points of one volume
    repeats       standard deviation over volumes that repeat the measurement
    calibration   of the manipulator, propagated through the projection matrices
    simulation    standard deviation over virtual scans, and their mean error (JCGM 101)

Scans that repeat scatter by the noise that the fit states, and by more: the larger of both stands for the two.  To it
the calibration's share is added in squares, since one calibration serves all repeats.  A simulation draws noise and
calibrations by itself, so it is no further share: the larger of both results counts.  Its mean error is a systematic
one (blur, the exponential mean over a pixel, artefacts) and is taken off the value; not off a form deviation, which
noise makes larger, never smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tomopose.measurement.uncertainty import Simulated

if TYPE_CHECKING:
    from tomopose.measurement.results import MeasurementResult, Repeat

COVERAGE = 0.95


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Standard uncertainties of one result, mm or rad; None where a share was not looked at.

    mean_error: of the simulated scans, None without truth and for form;  corrected: the value with it taken off;
    u, dof, U:  combined standard uncertainty, its degrees of freedom, half width of the 95 % interval.
    """

    volume: str
    name: str
    unit: str
    fit: float
    repeats: float | None
    calibration: float | None
    simulation: float | None
    mean_error: float | None
    corrected: float
    u: float
    dof: float

    @property
    def U(self) -> float:
        return half_width(self.u, self.dof)

    def to_json(self) -> dict[str, Any]:
        return {**vars(self), "U95": self.U}


def half_width(u: float, dof: float) -> float:
    """Half width of the 95 % interval of u by Student's t."""
    from scipy.stats import t

    return float(t.ppf(0.5 + COVERAGE / 2, dof) * u) if math.isfinite(u) else math.nan


def budget(
    result: MeasurementResult, *, repeat: Repeat | None = None, calibration: float | None = None,
    simulated: Simulated | None = None,
) -> Budget:
    """Everything about one result together; see the module.

    repeat: of the result's own group;  calibration: standard uncertainty from the calibration's covariance;
    simulated: mean (the mean error, nan without truth) and u over virtual scans.
    """
    u, dof = (result.u, result.dof) if math.isfinite(result.u) else (0.0, math.inf)
    s = None if repeat is None or not math.isfinite(repeat.s) else repeat.s
    if s is not None and s > u:
        u, dof = s, repeat.n - 1.0 if repeat is not None else dof
    if calibration is not None and math.isfinite(calibration):
        together = math.hypot(u, calibration)
        # Welch and Satterthwaite: the calibration's share is taken as well known.
        dof = dof * (together / u) ** 4 if u > 0 else math.inf
        u = together
    mean_error = None
    if simulated is not None:
        # One more scan like the simulated ones, and the mean of those itself.
        next_one = simulated.u * math.sqrt(1.0 + 1.0 / simulated.runs)
        if half_width(next_one, simulated.runs - 1.0) > half_width(u, dof):
            u, dof = next_one, simulated.runs - 1.0
        systematic = math.isfinite(simulated.mean) and not result.kind.startswith("form")
        mean_error = simulated.mean if systematic else None
    known = math.isfinite(result.u) or s is not None or simulated is not None
    return Budget(
        volume=result.volume, name=result.name, unit=result.unit, fit=result.u, repeats=s, calibration=calibration,
        simulation=None if simulated is None else simulated.u, mean_error=mean_error,
        corrected=result.value - (mean_error or 0.0), u=u if known else math.nan, dof=dof,
    )
