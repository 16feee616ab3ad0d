"""One rule of the verdict: a condition, its limit with the reason for it, and what the limit is compared with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from tomopose.calibration.checks.evidence.evidence import Evidence
from tomopose.calibration.checks.evidence.measures import Found
from tomopose.calibration.checks.verdict import Finding, Verdict

MODELS = ("rigid", "kinematic", "slack")
ARRANGEMENTS = ("moving-object", "moving-scanner", "twin", "turntable")


@dataclass(frozen=True, kw_only=True)
class Rule:
    """name; condition: in words, with {limit}; limit; verdict of a calibration that meets the condition; reason: where
    the limit comes from; measure(evidence, limit): what meets the condition; models, arrangements: where it applies."""

    name: str
    condition: str
    limit: float
    verdict: Verdict
    reason: str
    measure: Callable[[Evidence, float], Iterator[Found]]
    models: tuple[str, ...] = MODELS
    arrangements: tuple[str, ...] = ARRANGEMENTS

    def findings(self, evidence: Evidence) -> Iterator[Finding]:
        """What this rule finds in the evidence."""
        if evidence.model in self.models and evidence.arrangement in self.arrangements:
            for found in self.measure(evidence, self.limit):
                yield Finding(
                    rule=self.name,
                    value=float(found.value),
                    limit=self.limit,
                    words=found.words,
                    remedy=found.remedy,
                    verdict=self.verdict,
                )
