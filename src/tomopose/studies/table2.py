"""Table 2: two calibration runs at each magnification on a manipulator that does not turn as it reports."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from tomopose.calibration.records.compare import compare
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ORANGE, SOFT, axis, layout
from tomopose.studies.parts.hexapod_runs import SolvedRun, solve_run
from tomopose.studies.parts.result import Progress, Scale, StudyCheck, StudyRow, check_below, check_between
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import scan_error_um
from tomopose.studies.table1 import FACTOR, NAMES

# Table 2: magnification -> d_rms_opt of run 1 and run 2, px (rows 1, 2 and 3, 4).
PRINTED_D_RMS: Mapping[float, tuple[float, float]] = MappingProxyType({2.7: (0.1578, 0.1542), 5.3: (0.4960, 0.4947)})
# Table 2, rows 2 and 4: differences of t_HT (um), angles (urad), t (um) between the runs.
PRINTED_CHANGE: Mapping[float, tuple[float, ...]] = MappingProxyType(
    {
        2.7: (-11.9, -10.8, -11.8, -4.3, 87.5, -156.2, 312.6, -97.7, 9.6),
        5.3: (-7.4, 1.0, 0.4, -5.0, 24.7, 24.7, 2.2, -4.5, -0.9),
    }
)
LAST_ROW: Mapping[float, int] = MappingProxyType({2.7: 2, 5.3: 4})
EXPECTED: Mapping[float, tuple[float, float]] = MappingProxyType({2.7: (0.15, 0.16), 5.3: (0.48, 0.51)})
FLOOR_FACTOR, SCAN_GAIN = 1.3, 3.0
RUN_TO_RUN = 0.02
"""Sec. 5.2: "2 % or less"; its own numbers at M 2.7 differ by 2.3 %."""

TITLE = "Table 2: two runs on an erring manipulator"
QUESTION = (
    "What does a manipulator that does not turn as it reports leave in the residuals, do two runs agree, and what "
    "remains once its errors are identified from the same radiographs?"
)
NOTES = (
    "The small scale takes 2 x 2 x 2 x 7 poses; the printed numbers are those of 3 x 3 x 3 x 7.",
    "The hexapod is virtual: its tilts are made about axes turned by 2.64 mrad about z (and 0.79 mrad about y) against "
    "those of its translations, with its own pivot 150 mm (M 5.3) or 92 mm (M 2.7) below the set one. These numbers "
    "are chosen so that the rigid fit leaves the printed residuals; they are not printed.",
    "Its scatter of 0.6 um and 2 urad from pose to pose follows from the printed residual of poses without rotation.",
    "Our kinematic model is given a platform of common size with joints good to 0.1 mm. It does not know the form of "
    "the error.",
    "The paper's runs lie apart in time, with a scan between, and at M 2.7 its t moved by 0.3 mm: the ball itself "
    "moved. Our two runs differ by scatter and noise alone, so the differences are smaller. They come with their "
    "uncertainties: a difference within two of them says nothing.",
    "By our best the single coordinates of the mount are less certain than by the paper's method, and differ more from "
    "run to run: mount and machine errors share directions that no ball can distinguish. They cancel in the scan, "
    "whose error is the row that counts; the stated uncertainties hold the differences.",
    "The uncertainties stated by the paper's method take its residuals for noise. They are the same errors in both "
    "runs, so the differences are far smaller than stated.",
    "The floor is the plate's scatter and our detection's error together: no calibration can go below it but by "
    "fitting noise.",
)


def rows_of(magnification: float, runs: tuple[SolvedRun, SolvedRun]) -> list[StudyRow]:
    """d_rms of both runs with their floor, the scan's error, and nine differences with their uncertainties."""
    group = f"M {magnification}"
    rows = []
    for k, solved in enumerate(runs):
        source = f"table 2, row {LAST_ROW[magnification] - 1 + k}"
        rows.append(
            StudyRow(
                group=group,
                quantity=f"d_rms_opt, run {k + 1}",
                unit="px",
                source=source,
                printed=PRINTED_D_RMS[magnification][k],
                paper_method=solved.paper_method.d_rms,
                best=solved.best.d_rms,
                note=f"floor {solved.floor:.4f} px",
            )
        )
    for k, solved in enumerate(runs):
        errors = [scan_error_um(c, solved.run, magnification) for c in (solved.paper_method, solved.best)]
        rows.append(
            StudyRow(
                group=group,
                quantity=f"error of the tilted scan, run {k + 1}",
                unit="um",
                paper_method=errors[0],
                best=errors[1],
                note="rms at the object's corners, rigid pose removed",
            )
        )
    theirs, ours = (compare(*(getattr(s, side) for s in runs)) for side in ("paper_method", "best"))
    for k, name in enumerate(NAMES):
        factor, unit = FACTOR[name[0]]
        i, j = theirs.names.index(name), ours.names.index(name)
        rows.append(
            StudyRow(
                group=group,
                quantity=f"change of {name}",
                unit=unit,
                source=f"table 2, row {LAST_ROW[magnification]}",
                printed=PRINTED_CHANGE[magnification][k],
                paper_method=factor * float(theirs.difference[i]),
                u_paper_method=factor * float(theirs.u[i]),
                best=factor * float(ours.difference[j]),
                u=factor * float(ours.u[j]),
                note=f"probability by chance: {float(theirs.p[i]):.2g} paper's method, {float(ours.p[j]):.2g} ours",
            )
        )
    return rows


def checks_of(magnification: float, runs: tuple[SolvedRun, SolvedRun], rows: list[StudyRow]) -> list[StudyCheck]:
    """Residuals as printed by the paper's method; the floor, no false change and a better scan by ours."""
    at = f" (M {magnification})"
    d = [s.paper_method.d_rms for s in runs]
    low, high = EXPECTED[magnification]
    over = max(s.best.d_rms / s.floor for s in runs)
    gain = min((r.paper_method or 0.0) / (r.best or np.inf) for r in rows if r.quantity.startswith("error of the"))
    p = compare(runs[0].best, runs[1].best).p_mount
    return [
        check_below(
            f"by the paper's method d_rms_opt of both runs differs by 2 % at most, as printed{at}",
            abs(d[1] / d[0] - 1),
            RUN_TO_RUN,
            "",
        ),
        check_between(
            f"by the paper's method d_rms_opt of both runs is as printed{at}", float(np.mean(d)), low, high, "px"
        ),
        check_below(f"by our best d_rms_opt is within {FLOOR_FACTOR:g} x of the floor{at}", over, FLOOR_FACTOR, "x"),
        StudyCheck(
            statement=f"by our best the tilted scan's error is three times smaller or better{at}",
            found=f"{gain:.3g} times",
            holds=gain >= SCAN_GAIN,
        ),
        StudyCheck(
            statement=f"by our best no change of the mount is claimed, where none was made{at}",
            found=f"probability by chance {p:.2g}",
            holds=p >= 0.01,
        ),
    ]


def figure_of(rows: list[StudyRow]) -> Figure:
    """Residuals as bars: printed, by the paper's method, by ours."""
    d = [r for r in rows if r.quantity.startswith("d_rms")]
    labels = [f"{r.group}, {r.quantity[-5:]}" for r in d]
    sides = (
        ("printed", "printed", SOFT),
        ("by the paper's method", "paper_method", ORANGE),
        ("by our best", "best", ACCENT),
    )
    return Figure(
        title="Reprojection error of both runs",
        meaning="d_rms_opt of eq. (8) on a logarithmic axis.",
        look_for="The first two agree: the virtual manipulator errs like the real one. The third is the manipulator's "
        "scatter and the detection's error, which nothing can foresee.",
        data=[
            {"type": "bar", "name": name, "x": labels, "y": [getattr(r, side) for r in d], "marker": {"color": colour}}
            for name, side, colour in sides
        ],
        layout=layout(xaxis=axis(type="category"), yaxis=axis("d_rms_opt / px", type="log"), barmode="group"),
    )


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes."""
    n = 3 if scale == "paper" else 2
    images = 7 * n**3
    rows: list[StudyRow] = []
    checks: list[StudyCheck] = []
    for m, magnification in enumerate(PRINTED_D_RMS):
        solved = []
        for number in (1, 2):
            before = images * (2 * m + number - 1)

            def count(done: int, _: int, before: int = before) -> None:
                progress(before + done, 4 * images)

            solved.append(solve_run(magnification, n, seed, number, steps, count))
        runs = (solved[0], solved[1])
        own = rows_of(magnification, runs)
        rows += own
        checks += checks_of(magnification, runs, own)
    return rows, checks, (figure_of(rows),), NOTES
