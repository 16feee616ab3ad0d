"""The uncertainty of a measurand from all that is known of it, each share apart and together.

    fit           from the scatter of the fitted points of one volume
    repeats       standard deviation over volumes that repeat the measurement
    calibration   of the manipulator, propagated through the projection matrices
    simulation    standard deviation over virtual scans, and their mean error (JCGM 101)

Scans that repeat scatter by the noise that the fit states, and by more: the larger of both stands for the two.  To it
the calibration's share is added in squares, since one calibration serves all repeats.  What all scans have in common
(what is not linear in the attenuation, artefacts, the mean over a pixel) is in none of the three.

A simulation holds noise, places within voxels and, where it drew them, calibrations, and its mean error is that common
part.  It therefore stands for all: the errors of n virtual scans, of standard deviation s, say that the next one lies
within

    e_mean +- t(n - 1) s sqrt(1 + 1 / n)

with 95 % probability, whatever n, if its error is one more of the same kind.  The larger of this and the fit would hold
more than 95 %, and is not taken.  Where the scan is noisier than the virtual ones beyond chance (F-test at 1 %), the
scene does not describe it: then the difference is added in squares, and said.  The mean error is taken off the value;
not off a form deviation, which noise makes larger, never smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tomopose.measurement.uncertainty import Simulated

if TYPE_CHECKING:
    from tomopose.measurement.results import MeasurementResult, Repeat

COVERAGE = 0.95
CHANCE = 0.01
"""Probability at which a scan is taken as noisier than the virtual ones although it is not."""
FIT_ALONE = "fit alone, without the systematic part"


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Standard uncertainties of one result, mm or rad; None where a share was not looked at.

    value:      as measured;  mean_error: of the simulated scans, None without truth and for form;
    corrected:  the value with the mean error taken off, about which the interval lies;
    u, dof, U:  combined standard uncertainty, its degrees of freedom, half width of the 95 % interval;
    interval:   what the interval holds and what it does not, in words.
    """

    volume: str
    name: str
    unit: str
    value: float
    fit: float
    repeats: float | None
    calibration: float | None
    simulation: float | None
    mean_error: float | None
    corrected: float
    u: float
    dof: float
    interval: str

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
    result: MeasurementResult,
    *,
    repeat: Repeat | None = None,
    calibration: float | None = None,
    simulated: Simulated | None = None,
) -> Budget:
    """Everything about one result together; see the module.

    repeat: of the result's own group;  calibration: standard uncertainty from the calibration's covariance;
    simulated: mean (the mean error, nan without truth) and u over virtual scans.
    """
    s = None if repeat is None or not math.isfinite(repeat.s) else repeat.s
    c = None if calibration is None or not math.isfinite(calibration) else calibration
    scatter = _scatter(result, s, 0 if repeat is None else repeat.n)
    mean_error = None
    if simulated is None:
        shares, words = [scatter], ["fit" if s is None else "fit and repeats"]
    else:
        shares, words = _simulated(result, simulated, None if s is None else scatter)
        if math.isfinite(simulated.mean) and not result.kind.startswith("form"):
            mean_error = simulated.mean
    if c is not None and not (simulated is not None and simulated.with_calibration):
        # The calibration's share is taken as well known.
        shares.append((c, math.inf))
        words.append("calibration")
    u, dof = _together(shares)
    known = math.isfinite(result.u) or s is not None or simulated is not None
    return Budget(
        volume=result.volume,
        name=result.name,
        unit=result.unit,
        value=result.value,
        fit=result.u,
        repeats=s,
        calibration=calibration,
        simulation=None if simulated is None else simulated.u,
        mean_error=mean_error,
        corrected=result.value - (mean_error or 0.0),
        u=u if known else math.nan,
        dof=dof,
        interval=_in_words(words, simulated, mean_error) if known else "not determined",
    )


def _scatter(result: MeasurementResult, s: float | None, n: int) -> tuple[float, float]:
    """Standard uncertainty and degrees of freedom of one scan: the larger of fit and repeats."""
    own = (result.u, result.dof) if math.isfinite(result.u) else (0.0, math.inf)
    return own if s is None or s <= own[0] else (s, n - 1.0)


def _simulated(
    result: MeasurementResult, simulated: Simulated, repeated: tuple[float, float] | None
) -> tuple[list[tuple[float, float]], list[str]]:
    """Shares of one more scan like the simulated ones, and of what the scan is noisier than them; names of both."""
    n, s = simulated.runs, simulated.u
    shares, words = [(s * math.sqrt(1.0 + 1.0 / n), n - 1.0)], ["virtual scans"]
    seen = (result.u, result.dof, simulated.u_fit, simulated.dof_fit)
    if repeated is not None:
        seen = (*repeated, s, n - 1.0)
    u, dof, expected, dof_expected = seen
    if math.isfinite(u) and math.isfinite(expected) and _beyond_chance(u, dof, expected, dof_expected):
        shares.append((math.sqrt(u**2 - expected**2), dof))
        words.append(f"noise, {u / expected:.1f} times that of the virtual scans")
    return shares, words


def _beyond_chance(u: float, dof: float, expected: float, dof_expected: float) -> bool:
    """F-test of two standard deviations, one-sided."""
    from scipy.stats import f

    return u > expected * math.sqrt(float(f.isf(CHANCE, min(dof, 1e6), min(max(dof_expected, 1.0), 1e6))))


def _together(shares: list[tuple[float, float]]) -> tuple[float, float]:
    """Root of the sum of squares, and the degrees of freedom by Welch and Satterthwaite (JCGM 100:2008, G.4)."""
    if len(shares) == 1:
        return shares[0]
    u = math.hypot(*(u for u, _ in shares))
    weight = sum(u_i**4 / dof for u_i, dof in shares)
    return u, u**4 / weight if weight > 0 else math.inf


def _in_words(shares: list[str], simulated: Simulated | None, mean_error: float | None) -> str:
    if shares == ["fit"]:
        return FIT_ALONE
    held = ", ".join(shares)
    if simulated is None:
        return f"{held}; without the systematic part"
    if mean_error is not None:
        return f"{held}; corrected by simulation"
    return f"{held}; mean error not corrected"
