"""What the rules measure of one effect after the other: causes left unexplained, values freed, causes that tie."""

from __future__ import annotations

from collections.abc import Iterator

from tomopose.calibration.checks.evidence.evidence import Evidence
from tomopose.calibration.checks.evidence.measures import Found, part_of_run


def culprits(e: Evidence, limit: float, kinds: tuple[str, ...]) -> Iterator[Found]:
    for x in e.tests.left if e.tests else ():
        if x.kind in kinds and x.evidence > limit:
            yield Found(
                value=x.evidence,
                words=f"{x.words}: explains {x.share:.0%} of what is left (odds e^{x.evidence:.0f})",
                remedy=part_of_run(x.at) if x.at else "",
            )


def contradicted(e: Evidence, limit: float) -> Iterator[Found]:
    for c in e.contradicted:
        yield Found(
            value=c.off / c.stated,
            words=f"{c.name} is off by {c.off:+.3g}, {abs(c.off) / c.stated:.0f} times what was stated or assumed; "
            "it was freed",
            remedy=f"correct {c.name} in scanner.json, or state a larger sigma; --free none holds the prior",
        )


def either_or(e: Evidence, limit: float) -> Iterator[Found]:
    """Another cause explains the images as well as the scanner's values, with another scan as the consequence."""
    rivals = e.tests.rivals if e.tests else ()
    if rivals:
        yield Found(
            value=rivals[0].evidence,
            words="the scanner's values as declared do not fit, and the images cannot distinguish which is so: "
            "scanner values further off than was assumed of them, or "
            f"{', '.join(r.short for r in rivals[:3])}; the scan differs",
            remedy="state what you know better (sigma in scanner.json), or measure a known length in the scan",
        )
