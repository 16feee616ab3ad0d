"""What a certificate says, as values: who, what, when, under which conditions, and the results with U (k = 2)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.provenance import MEASUREMENT
from tomopose.report.words import meaning

NOT_STATED = "not stated"
K = 2.0
COVERAGE = 0.95
"""Of U = 2 u under a normal law, as a certificate says it."""
HEADER: Mapping[str, str] = {
    "machine": "Machine",
    "serial": "Serial number",
    "customer": "Customer",
    "order": "Order",
    "operator": "Operator",
    "ball_certificate": "Certificate of the ball",
    "scanner_certificate": "Certificate of the scanner",
    "temperature_C": "Temperature / °C",
    "valid_until": "Valid until",
}
"""Keys of tomopose.toml, in the order of the page."""
DECISION_RULE = (
    "Simple acceptance of the method's own checks: the calibration is called trustworthy where none of the documented "
    "rules is exceeded. No conformity of the machine with a specification is stated."
)
METHOD = "Pose calibration from radiographs of one ball: T_HT and ball position by weighted least squares, eq. (7)."


@dataclass(frozen=True, kw_only=True)
class Line:
    """A result: value and expanded uncertainty U (k = 2) in `unit`; U is NaN where it is not determinable."""

    name: str
    meaning: str
    value: float
    U: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """number: derived from the content, so that the same result has the same number.

    facts: of the project file, by key;  results: in the order of the calibration;  assumed: words for each value that
    was taken with an uncertainty and not measured;  date: ISO 8601.
    """

    number: str
    date: str
    facts: Mapping[str, str]
    verdict: str
    reasons: tuple[str, ...]
    results: tuple[Line, ...]
    assumed: tuple[str, ...]
    inputs: Mapping[str, str]
    version: str
    d_rms_px: float
    d_rms_um: float
    poses: int

    def fact(self, key: str) -> str:
        """A fact of the project file, or that it is not stated."""
        return self.facts.get(key) or NOT_STATED


def certificate_of(calibration: Calibration, facts: Mapping[str, str] | None = None) -> Certificate:
    """The certificate of a calibration.

    facts: of tomopose.toml; without them those that the calibration was made with.

    Raises InputError where the calibration was rejected or never converged: there is nothing to certify.
    """
    made = calibration.provenance
    if calibration.verdict == "rejected" or not calibration.converged:
        raise InputError(
            "a rejected calibration is not certified: "
            + (calibration.reasons[0] if calibration.reasons else "no optimum")
        )
    if made is None:
        raise InputError("the calibration has no provenance, so that nobody can say what a certificate would be of")
    said = facts if facts is not None else made.arguments.get(MEASUREMENT, {})
    results = tuple(
        Line(name=p.name, meaning=meaning(p.name), value=p.value, U=K * p.u, unit=p.unit)
        for p in calibration.parameters
    )
    content = repr([(x.name, x.value, x.U, x.unit) for x in results]) + repr(sorted(made.inputs.items()))
    return Certificate(
        number="TP-" + hashlib.sha256(content.encode()).hexdigest()[:12].upper(),
        date=made.time_utc,
        facts={str(k): str(v) for k, v in dict(said).items()},
        verdict=calibration.verdict,
        reasons=calibration.reasons,
        results=results,
        assumed=tuple(_assumed_words(a.name, a.sigma, a.unit, a.source) for a in calibration.assumed),
        inputs=dict(made.inputs),
        version=made.version,
        d_rms_px=calibration.d_rms,
        d_rms_um=calibration.d_rms_um,
        poses=len(calibration.pose_id),
    )


def _assumed_words(name: str, sigma: float, unit: str, source: str) -> str:
    what = f" ({meaning(name)})" if meaning(name) else ""
    if sigma == 0:
        return f"{name}{what}: taken as exact, in the user's own words"
    told = {"default": "nobody stated one; default", "scanner.json": "stated in scanner.json"}.get(source, source)
    number = f"{sigma:.3g} {unit}" if math.isfinite(sigma) else "free"
    return f"{name}{what}: standard uncertainty {number} ({told})"
