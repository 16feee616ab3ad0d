"""One measured value beside its reference and its limit, one group of repeats, and what is decided of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any, Literal

from tomopose.coverage import combined, expanded
from tomopose.measurement.conformity import Decision, decide, decide_form
from tomopose.values import value

FormKind = Literal["form", "form_95", "form_25"]
FIT_ALONE = "fit alone, without the systematic part"
FORMS: tuple[FormKind, ...] = ("form", "form_95", "form_25")


@value
class MeasurementResult:
    """One measurand in one volume.

    value, u:     mm or rad as `unit` says; u is the standard uncertainty of the fit, nan where it cannot be determined.
    dof:          degrees of freedom of u.
    reference:    calibrated value, else the nominal one, else None;  calibrated: which of the two it is.
    u_reference:  standard uncertainty of the reference: 0 for a nominal value, nan for a calibrated value whose
                  uncertainty the plan does not state.
    limit:        largest permitted |value - reference|: the MPE or the tolerance; None where none is given.
    direction:    unidirectional | bidirectional | one-sided (only one end is a surface).
    noise:        of a form deviation: the largest that noise of the points alone makes, in 95 % of cases; else 0.
    stated:       standard uncertainties that the plan states: workpiece, temperature, drift (of the reference).
    association:  how the features were fitted;  n_points, n_set_aside: measured points of the features, and how many of
                  them a robust option of the plan set aside.
    contributions: standard uncertainties that u is made of.
    """

    name: str
    kind: str
    value: float
    u: float
    unit: str
    method: str
    direction: str
    volume: str = ""
    dof: float = math.inf
    reference: float | None = None
    calibrated: bool = True
    u_reference: float = 0.0
    limit: float | None = None
    limit_rule: str = ""
    association: str = "least-squares"
    n_points: int = 0
    n_set_aside: int = 0
    noise: float = 0.0
    stated: Mapping[str, float] = field(default_factory=dict)
    contributions: Mapping[str, float] = field(default_factory=dict)

    @property
    def error(self) -> float | None:
        """value - reference, or None."""
        return None if self.reference is None else self.value - self.reference

    @property
    def U(self) -> float:
        """Half width of the 95 % interval of the value by the fit alone, by Student's t; `interval` says so."""
        return expanded(self.u, self.dof)

    @property
    def interval(self) -> str:
        """What U holds, in words."""
        return FIT_ALONE if math.isfinite(self.u) else "not determined"

    @property
    def decision(self) -> Decision | None:
        """By this volume's fit and what the plan states; None without reference or limit.  `Budget.decision` knows
        repeats, calibration and virtual scans too."""
        if self.error is None or self.limit is None:
            return None
        return decided(self, self.error, [(self.u, self.dof), *value_shares(self)])

    @property
    def within(self) -> bool | None:
        """Whether the limit is kept, by `decision`: None where nothing is judged or nothing can be decided."""
        return None if self.decision is None else self.decision.within

    def to_json(self) -> dict[str, Any]:
        return {
            "volume": self.volume,
            "name": self.name,
            "kind": self.kind,
            "value": self.value,
            "u": self.u,
            "U95": self.U,
            "dof": self.dof,
            "unit": self.unit,
            "reference": self.reference,
            "reference_is": None if self.reference is None else "calibrated" if self.calibrated else "nominal",
            "u_reference": self.u_reference,
            "error": self.error,
            "limit": self.limit,
            "limit_rule": self.limit_rule,
            "decision": None if self.decision is None else self.decision.value,
            "within": self.within,
            "direction": self.direction,
            "method": self.method,
            "association": self.association,
            "n_points": self.n_points,
            "n_set_aside": self.n_set_aside,
            "noise": self.noise,
            "interval": self.interval,
            "stated": dict(self.stated),
            "contributions": dict(self.contributions),
        }


@value
class Repeat:
    """A measurand over a group of n repeats: mean and standard deviation s.

    U:       half width of the 95 % interval about the value of one *further* scan like these, not corrected:
             U = t(nu) sqrt(u_p^2 + u_cal^2 + u_drift^2 + u_w^2 + u_T^2) + |b|,  the terms of VDI/VDE 2630-2.1 and
             ISO 15530-3 with Student's factor in place of k = 2; u_p is the larger of s and the fit's u.  b is the mean
             error, where the reference is a calibrated value; without one the systematic part is not in U.
    U_mean:  half width of the 95 % interval about the mean, u_p / sqrt(n) in place of u_p and no b.
    interval: what U holds, in words.
    """

    group: str
    name: str
    n: int
    mean: float
    s: float
    unit: str
    error: float | None
    U: float
    U_mean: float = math.nan
    interval: str = ""


def value_shares(result: MeasurementResult) -> list[tuple[float, float]]:
    """(u, dof) of what the plan states of the value itself: workpiece and temperature, taken as well known."""
    return [(result.stated[k], math.inf) for k in ("workpiece", "temperature") if k in result.stated]


def reference_shares(result: MeasurementResult) -> list[tuple[float, float]]:
    """(u, dof) of the reference: its calibration and its drift since then."""
    shares = [(result.u_reference, math.inf)]
    return shares + ([(result.stated["drift"], math.inf)] if "drift" in result.stated else [])


def decided(result: MeasurementResult, error: float, shares: list[tuple[float, float]]) -> Decision | None:
    """The decision about an error whose value has the shares (u, dof); None where the result has no limit.

    A reference whose uncertainty is not stated can prove no conformity.  It does prove the contrary: that the measured
    value alone lies beyond the limit stays a reason to look.
    """
    if result.limit is None:
        return None
    if result.kind in FORMS:
        return decide_form(error, expanded(*combined(shares)), result.noise, result.limit)
    if math.isnan(result.u_reference):
        alone = decide(error, expanded(*combined(shares)), result.limit)
        return alone if alone is Decision.NOT_CONFORMING else Decision.NOT_DECIDABLE
    return decide(error, expanded(*combined([*shares, *reference_shares(result)])), result.limit)
