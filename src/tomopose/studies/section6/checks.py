"""What the numbers of figs. 12 to 16 have to show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tomopose.measurement.mesh.mesh import Mesh
from tomopose.studies.parts.result import StudyCheck, StudyRow, check_below, check_between
from tomopose.studies.section6.specimen import azimuth, cylinder_areas
from tomopose.studies.section6.tables import ORDERS, PERIODS, PRINTED_CYLINDER_UM, Found, deviations, limit, rms, waves

CIRCLE_FACTOR = 1.2
"""How much worse than the circular scan's the cylinder areas may be."""
CHANCE = 1 + 1 / np.sqrt(26)
"""The scatter of 27 diameters is known to 1 / sqrt(2 x 26) of itself, the ratio of two to 1 / sqrt(26)."""


TILTED, CIRCLE = "3D scan, calibration run 1", "circular scan"
SEVEN_PERIODS = "cylinder areas, part with seven periods"

AGAINST_CIRCLE = (
    ("the 3D scan's cylinder areas are within 1.2 x of the circular scan's (fig. 12, rms)", "Fig. 12",
     "cylinder areas, rms", CIRCLE_FACTOR),
    ("the 3D scan's lengths are not worse than the circular scan's (fig. 13, rms)", "Fig. 13",
     "errors of L1 to L7, rms", 1.0),
    ("the 3D scan's sphericities are not worse than the circular scan's (fig. 16)", "Fig. 16",
     "sphericity, mean of 27", 1.0),
    ("the 3D scan's distances are not worse than the circular scan's (fig. 14, rms)", "Fig. 14",
     "errors of 351 distances, rms", 1.0),
    ("the 3D scan's diameters scatter no more than the circular scan's, except for chance (fig. 15)", "Fig. 15",
     "scatter of 27 diameters", CHANCE),
)  # fmt: skip
"""(statement, figure, quantity, largest ratio to the better circular volume's)."""


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """The tables' rows by (group, quantity)."""

    at: Mapping[tuple[str, str], StudyRow]

    def of(self, figure: str, quantity: str, side: str) -> float:
        """A number of the 3D scan; side: paper_method or best."""
        return float(getattr(self.at[f"{figure}, {TILTED}", quantity], side))

    def against_circle(self, statement: str, figure: str, quantity: str, factor: float) -> StudyCheck:
        there = self.at[f"{figure}, {CIRCLE}", quantity]
        least = min(v for v in (there.paper_method, there.best) if v is not None)
        ours = self.of(figure, quantity, "best")
        return check_below(f"by our best {statement}", ours / least, factor, "x the better circular volume's")


def cylinder_checks(rows: _Rows, found: Found, mesh: Mesh) -> list[StudyCheck]:
    """Fig. 12: size and form of the deviations by the paper's method, and by ours."""
    cylinder = cylinder_areas(mesh)
    spectrum = waves(deviations(found, "specimen-3D-paper-run1")[cylinder], azimuth(mesh)[cylinder])
    loudest = int(np.argmax(spectrum[1:])) + 1
    return [
        check_between(
            "fig. 12: by the paper's method the cylinder areas' largest deviation is of the printed order",
            rows.of("Fig. 12", "cylinder areas, largest deviation", "paper_method"),
            PRINTED_CYLINDER_UM / 2,
            2 * PRINTED_CYLINDER_UM,
            "um",
        ),
        StudyCheck(
            statement="fig. 12: by the paper's method the deviations repeat with the tilt's seven periods",
            found=f"the strongest part has {loudest} periods",
            holds=loudest == PERIODS,
        ),
        check_below(
            "fig. 12: by our best the part with seven periods is five times smaller or better",
            rows.of("Fig. 12", SEVEN_PERIODS, "best") / rows.of("Fig. 12", SEVEN_PERIODS, "paper_method"),
            0.2,
            "",
        ),
    ]


def order_checks(found: Found) -> list[StudyCheck]:
    """The order of views matters to one iteration of SART; no check where the volumes were not made."""
    if not all(f"standard-3D-best-run1-{order}" in found for order in ORDERS):
        return []
    in_turn, golden = (rms(found[f"standard-3D-best-run1-{order}"]["distance_um"]) for order in ORDERS)
    statement = "in one iteration of SART views in sequence are worse than in golden order (figs. 14, 16)"
    said = f"{in_turn:.3g} um against {golden:.3g} um"
    return [StudyCheck(statement=statement, found=said, holds=in_turn > golden)]


def as_printed(rows: _Rows, runs: tuple[int, ...]) -> list[StudyCheck]:
    """What the paper says of its own method beside its numbers."""
    cylinder, cuboid = (
        rows.of("Fig. 12", f"{name}, largest deviation", "paper_method") for name in ("cylinder areas", "six cuboids")
    )
    out = [
        StudyCheck(
            statement="fig. 12: by the paper's method the six cuboids deviate less than the cylinder areas (printed: "
            "18 beside 90 um, 0.2 of it; where ours is larger the pattern differs)",
            found=f"{cuboid:.3g} beside {cylinder:.3g} um, {cuboid / cylinder:.2g} of it",
            holds=cuboid < cylinder,
        )
    ]
    for figure, quantity in (
        ("Fig. 12", "cylinder areas, rms"),
        ("Fig. 15", "scatter of 27 diameters"),
        ("Fig. 16", "sphericity, mean of 27"),
    ):
        theirs = rows.of(figure, quantity, "paper_method")
        circle = rows.at[f"{figure}, {CIRCLE}", quantity]
        other = circle.best if circle.paper_method is None else circle.paper_method
        out.append(StudyCheck(
            statement=f"{figure.lower()}: by the paper's method the 3D scan is worse than the circular one "
            f"({quantity})",
            found=f"{theirs:.3g} against {other:.3g} um",
            holds=other is not None and theirs > other,
        ))  # fmt: skip
    if len(runs) > 1:
        quantity = "errors of 351 distances, rms"
        first, second = (
            rows.at[f"Fig. 14, 3D scan, calibration run {r}", quantity].paper_method or 0.0 for r in (1, 2)
        )
        out.append(check_below(
            "fig. 14: by the paper's method the second calibration changes the distances' rms by 5 % at most",
            abs(second / first - 1), 0.05, "",
        ))  # fmt: skip
    return out


def checks_of(
    table: list[StudyRow], found: Found, mesh: Mesh, runs: tuple[int, ...], *, strict: bool
) -> list[StudyCheck]:
    """What the tables have to show; runs: calibration runs of the standard.

    strict: also what needs finer voxels to show: with balls of four voxels' radius the largest error is that of the
    voxels, whatever the matrices.
    """
    rows = _Rows(at={(r.group, r.quantity): r for r in table})
    compared = [rows.against_circle(*row) for row in AGAINST_CIRCLE]
    lengths = check_below(
        "fig. 13: by our best the 3D scan's lengths lie within the MPE",
        rows.of("Fig. 13", "errors of L1 to L7, largest", "best"),
        float(limit(0.0)[0]),
        "um",
    )
    distances = check_below(
        "fig. 14: by our best the 3D scan's 351 distances lie within the MPE",
        rows.of("Fig. 14", "largest share of the MPE", "best"),
        1.0,
        "of it",
    )
    first, *others = compared
    return [
        *cylinder_checks(rows, found, mesh),
        *as_printed(rows, runs),
        first,
        lengths,
        *others,
        *order_checks(found),
        *([distances] if strict else []),
    ]
