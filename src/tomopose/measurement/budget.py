"""The uncertainty of a measurand from all that is known of it, each share apart and together.

    fit           from the scatter of the fitted points of one volume
    repeats       standard deviation over volumes that repeat the measurement
    calibration   of the manipulator, propagated through the projection matrices
    simulation    standard deviation over virtual scans, and their mean error (JCGM 101)

Scans that repeat scatter by the noise that the fit states, and by more: the larger of both covers the two.  To it
the calibration's share is added in squares, since one calibration serves all repeats.  What all scans have in common
(what is not linear in the attenuation, artefacts, the mean over a pixel) is in none of the three.

A simulation holds noise, places within voxels and, where it drew them, calibrations, and its mean error is that common
part.  It therefore covers all: the errors of n virtual scans, of standard deviation s, say that the next one lies
within

    e_mean +- t(n - 1) s sqrt(1 + 1 / n)

with 95 % probability, whatever n, if its error is one more of the same kind.  The larger of this and the fit would hold
more than 95 %, and is not taken.  Where the scan is noisier than the virtual ones beyond chance (F-test at 1 %), the
scene does not describe it: then the difference is added in squares, and said.  The mean error is taken off the value;
not off a form deviation, which noise makes larger, never smaller.

What no scan shows is stated in the plan and added in squares: the workpiece (u_w), the temperature, and to errors the
calibration of the reference (u_cal) and its drift since then (u_drift), as VDI/VDE 2630-2.1 lists them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.coverage import combined, expanded
from tomopose.measurement.conformity import Decision
from tomopose.measurement.result import (
    FIT_ALONE,
    MeasurementResult,
    Repeat,
    decided,
    reference_shares,
    value_shares,
)
from tomopose.measurement.uncertainty import Simulated

CHANCE = 0.01
"""Probability at which a scan is taken as noisier than the virtual ones although it is not."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Standard uncertainties of one result, mm or rad; None where a share was not looked at.

    value:      as measured;  mean_error: of the simulated scans, None without truth and for form;
    corrected:  the value with the mean error taken off, about which the interval lies;
    workpiece, temperature, drift: as the plan states them; drift is that of the reference and belongs to the error;
    u, dof, U:  combined standard uncertainty of the value, its degrees of freedom, half width of the 95 % interval;
    interval:   what the interval holds and what it does not, in words;
    error, U_error: corrected value minus reference (for an MPE: measured value minus reference) and the half width of
                its 95 % interval, with the reference's own uncertainty;  decision: after ISO 14253-1.
    """

    volume: str
    name: str
    unit: str
    value: float
    fit: float
    repeats: float | None
    calibration: float | None
    simulation: float | None
    workpiece: float | None
    temperature: float | None
    drift: float | None
    mean_error: float | None
    corrected: float
    u: float
    dof: float
    interval: str
    error: float | None
    U_error: float
    decision: Decision | None

    @property
    def U(self) -> float:
        return expanded(self.u, self.dof)

    def to_json(self) -> dict[str, Any]:
        decision = None if self.decision is None else self.decision.value
        return {**vars(self), "U95": self.U, "decision": decision}


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
    shares += value_shares(result)
    words += [name for name in ("workpiece", "temperature") if name in result.stated]
    known = math.isfinite(result.u) or s is not None or simulated is not None
    u, dof = combined(shares) if known else (math.nan, math.inf)
    corrected = result.value - (mean_error or 0.0)
    permissible = result.limit_rule == "MPE"
    judged = [scatter if known else (math.nan, math.inf), *value_shares(result)] if permissible else [(u, dof)]
    error = None if result.reference is None else (result.value if permissible else corrected) - result.reference
    return Budget(
        volume=result.volume,
        name=result.name,
        unit=result.unit,
        value=result.value,
        fit=result.u,
        repeats=s,
        calibration=calibration,
        simulation=None if simulated is None else simulated.u,
        workpiece=result.stated.get("workpiece"),
        temperature=result.stated.get("temperature"),
        drift=result.stated.get("drift"),
        mean_error=mean_error,
        corrected=corrected,
        u=u,
        dof=dof,
        interval=_in_words(words, simulated, mean_error) if known else "not determined",
        error=error,
        U_error=math.nan if error is None else expanded(*combined([*judged, *reference_shares(result)])),
        decision=None if error is None else decided(result, error, judged),
    )


def repeat_of(group: str, rows: Sequence[MeasurementResult]) -> Repeat:
    """The repeats of one measurand: rows of at least two volumes of a group."""
    values = np.array([r.value for r in rows])
    n, first = len(rows), rows[0]
    mean, s = float(values.mean()), float(values.std(ddof=1))
    finite = [(r.u, r.dof) for r in rows if math.isfinite(r.u)]
    u_fit = float(np.mean([u for u, _ in finite])) if finite else 0.0
    # The spread of repeats holds the fit's noise already; the larger of the two covers both.
    own = (s, n - 1.0) if s >= u_fit else (u_fit, float(sum(dof for _, dof in finite)))
    stated = value_shares(first)
    b = None if first.reference is None or not first.calibrated else mean - first.reference
    U = expanded(*combined([own, *stated, *(reference_shares(first) if b is not None else [])]))
    held = ", ".join(["repeats", *(name for name in ("workpiece", "temperature") if name in first.stated)])
    if b is not None and math.isnan(first.u_reference):
        systematic = "not determined, the reference's uncertainty is not stated"
    else:
        systematic = "without the systematic part" if b is None else "mean error from the reference"
    return Repeat(
        group=group,
        name=first.name,
        n=n,
        mean=mean,
        s=s,
        unit=first.unit,
        error=None if first.reference is None else mean - first.reference,
        U=U + (0.0 if b is None else abs(b)),
        U_mean=expanded(*combined([(own[0] / math.sqrt(n), own[1]), *stated])),
        interval=f"{held}; {systematic}",
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


def _in_words(shares: list[str], simulated: Simulated | None, mean_error: float | None) -> str:
    if shares == ["fit"]:
        return FIT_ALONE
    held = ", ".join(shares)
    if simulated is None:
        return f"{held}; without the systematic part"
    if mean_error is not None:
        return f"{held}; corrected by simulation"
    return f"{held}; mean error not corrected"
