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


def pixel_origin(e: Evidence) -> Iterator[Found]:
    """u and v off alike by half a pixel or one: nothing in the images distinguishes it from u_0 and v_0."""
    found = e.tests.pixel_origin if e.tests else None
    if found is not None:
        shift = 0.5 if abs(found.size) < 0.75 else 1.0
        low = found.size > 0
        origin = "half a pixel " + ("low" if low else "high") if shift == 0.5 else "pixels counted from 1"
        yield Found(
            value=found.size,
            words=f"u_0 and v_0 off by {found.size:+.2f} px explain the images, and so does an alternative convention "
            f"({origin}): then the pixels of observations.csv are counted from another origin than those of a scan",
            remedy=f"observations.csv: {'subtract' if low else 'add'} {shift:g} px {'from' if low else 'to'} u_px and "
            "v_px, if (0, 0) is not the centre of a pixel there; else correct u_0 and v_0 in scanner.json",
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
