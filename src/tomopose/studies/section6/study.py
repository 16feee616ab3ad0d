"""Section 6: dimensional measurements in circular and 3D scans, by the paper's method and by ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tomopose.reconstruction.settings import FDK, PAPER, Algorithm
from tomopose.studies.parts.result import Progress, Scale, check_below
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import ball_run, scan_error_um
from tomopose.studies.section6 import real_beam
from tomopose.studies.section6.calibrations import GRID, calibrations
from tomopose.studies.section6.checks import checks_of
from tomopose.studies.section6.figures import figures_of
from tomopose.studies.section6.scan import MAGNIFICATION, Numbers, Object, Path, Radiographs, scan_with
from tomopose.studies.section6.specimen import reference, reference_error_um
from tomopose.studies.section6.tables import (
    MPE_A_UM,
    MPE_K,
    calibration_rows,
    specimen_rows,
    standard_rows,
)
from tomopose.studies.section6.volumes import Case, cases_of, matrices_for, measured
from tomopose.trajectory.completeness import source_path

PLAN: Mapping[Scale, Numbers] = {
    "small": Numbers(
        binning={"specimen": 10, "standard": 8},
        views={"specimen": 210, "standard": 252},
        runs={"specimen": (1,), "standard": (1, 2)},
        edge=1.0,
        samples=2,
        radiographs=False,
    ),
    "paper": Numbers(
        binning={"specimen": 2, "standard": 2},
        views={"specimen": 900, "standard": 1000},
        runs={"specimen": (1,), "standard": (1,)},
        edge=0.25,
        samples=2,
        radiographs=True,
    ),
}
"""Binning, views and calibration of table 3 at scale "paper"."""
FINE = 4
"""Binning up to which a ball of 5 mm is many voxels wide, so that the largest error shows more than the voxels."""
THINGS: tuple[Object, ...] = ("specimen", "standard")
REAL_VOLUMES = 3
REFERENCE_UM = 2.0
"""Of the machine's noise and the way between probed points; the deviations to be measured are ten times larger."""

TITLE = "Section 6: dimensional measurements in 3D scans"
QUESTION = (
    "What do the manipulator's errors do to surfaces, lengths and balls measured in a 3D scan, does the second "
    "calibration change it, and are the errors gone once those of the manipulator are identified?"
)
NOTES = (
    "The hexapod is the virtual one of study table2, whose errors leave the paper's residuals, with its scatter from "
    "pose to pose in the measurement scans too. It is calibrated before (run 1) and after (run 2) the scan. The "
    "circular scan does not move it and has the scanner's own matrices, taken as exact.",
    "By the paper's method: 189 poses of its grid, rigid calibration, one iteration of SART with relaxation 0.8 from "
    "zero, views in random order (the paper does not print its order). By our best: 189 mixed poses at four table "
    "angles, kinematic calibration, filtered back-projection with the ramp along the source's path; of its voxels only "
    "those near the object are found, which changes none of them. Both reconstruct the same radiographs, and are "
    "measured alike. What the kinematic calibration makes of the paper's own poses is in study table2.",
    "The paper prints few numbers here: most of its results are bars and colours. Only what is in its text is "
    "repeated in the column of printed values.",
    "The specimen and the standard have the paper's kinds of feature and size; all their other measures are this "
    "project's own. The specimen is mounted tilted by 42 degrees, the standard upright; neither angle is printed.",
    "Radiographs hold photon noise (signal to noise 200 in an unbinned pixel of the open beam) in 16 bits, averaged "
    "over 2 x 2 rays a pixel. Except for the rows with the real beam, beam hardening, scatter, focal spot and detector "
    "blur are left out: the attenuation is that at the mean energy of the tube. With the real beam the spectrum is "
    "that of 180 kV behind 0.25 mm of copper, the blur 0.73 px, scatter 1 % of the open beam and a tenth of the "
    "object's forward-scatter potential, and the circular scan's matrices err by u_0 0.05 px, eta 30 urad, tilts 100 "
    "urad and a table's error motion of 0.1 um; none of these is printed. The standard's base is left out, its shafts "
    "are of ruby like its balls.",
    "The target-actual comparison is a best fit of the nominal mesh corrected by probed points after ref. [21]: a "
    "point a square millimetre of the specimen as made, with 0.5 um of probing noise, natural interpolation, edges "
    "nominal. The lengths' true values are fitted to the specimen as made, the standard's come from its coordinates "
    "file. Points are probed along the nominal normals, on balls all but around their shafts; each volume has one "
    "blur, found from its own edges.",
    f"The limit is a user's: MPE = {MPE_A_UM:g} um + L/{MPE_K:g}, L in mm. The paper draws its supplier's and prints "
    "no numbers.",
    "At the small scale centres are projected and given the paper's detection error of table 1 for both methods, and "
    "volumes are coarse (0.38 and 0.59 mm): what is left in the circular scan is mostly the voxels and the few views, "
    "and the sphericities say more about these than about matrices. At the paper's scale the centres come from "
    "simulated radiographs, and volumes that others represent are left out: the second calibration, the circular scan "
    "by SART, the true matrices and the orders of the views.",
    "A circle sees a surface where some source position lies in its tangent plane (Tuy's condition). At the small "
    "scale the thread, where the specimen breaks it, is not resolved; the rows over such places appear where it is.",
)


def is_compared(case: Case) -> bool:
    """Whether a volume is one of those that the study was made to set side by side."""
    if case.path == "circular":
        return case.method == "best"
    return case.run > 0 and not case.order


def algorithm_of(case: Case) -> Algorithm:
    """How a volume is reconstructed: as the paper does, or by our best, the ramp filter along the source's path."""
    if case.method == "paper" or case.order:
        return replace(PAPER, order=case.order) if case.order else PAPER
    return FDK()


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes."""
    return run_with(PLAN[scale], seed, steps, progress, compared_only=scale == "paper")


def run_with(
    numbers: Numbers, seed: int, steps: Steps, progress: Progress, *, compared_only: bool = False
) -> tuple[Any, Any, Any, Any]:
    """The study at any size between the two scales.

    compared_only: leave out what explains the numbers but is not needed for them: the circular scan by the paper's
    method, the true matrices and the orders of the views.
    """
    cases = {
        thing: [c for c in cases_of(thing, numbers.runs[thing]) if not compared_only or is_compared(c)]
        for thing in THINGS
    }
    parts = sum(len(numbers.runs[t]) + len(cases[t]) for t in THINGS) + REAL_VOLUMES
    done = 0

    def part(k: int, n: int) -> None:
        progress(100 * done + 100 * k // max(n, 1), 100 * parts)

    found: dict[str, dict[str, Any]] = {}
    residuals: dict[tuple[float, int], tuple[float, float]] = {}
    errors: dict[tuple[float, int], tuple[float, float]] = {}
    for thing in THINGS:
        m = MAGNIFICATION[thing]
        solved = {}
        for number in numbers.runs[thing]:
            both = solved[number] = calibrations(
                m, number, radiographs=numbers.radiographs, seed=seed, steps=steps, progress=part
            )
            truth = ball_run(m, GRID, seed, number=number)
            residuals[m, number] = (both["paper"].d_rms, both["best"].d_rms)
            errors[m, number] = (scan_error_um(both["paper"], truth, m), scan_error_um(both["best"], truth, m))
            done += 1
        paths: tuple[Path, ...] = ("circular", "3D")
        scans = {path: scan_with(thing, path, numbers, seed) for path in paths}
        images = {path: Radiographs(scan, steps.folder) for path, scan in scans.items()}

        for case in cases[thing]:
            scan = scans[case.path]
            found[case.name] = measured(
                case,
                scan,
                images[case.path],
                lambda c=case, s=scan, d=solved: matrices_for(c, s, d),  # type: ignore[misc]
                numbers,
                algorithm_of(case),
                steps,
                part,
            )
            done += 1
            part(0, 1)
        for kept in images.values():
            kept.forget()
        if thing == "specimen":
            found |= real_beam.volumes(scans, solved, numbers, seed, steps, part)
            done += REAL_VOLUMES
    mesh = reference(numbers.edge)
    source = source_path(scan_with("specimen", "circular", numbers, seed).truth)
    rows = [
        *calibration_rows(residuals, errors),
        *specimen_rows(found, mesh, source, numbers.runs["specimen"]),
        *real_beam.rows_of(found, mesh),
        *standard_rows(found, numbers.runs["standard"]),
    ]
    fine = max(numbers.binning.values()) <= FINE
    checks = [
        *checks_of(rows, found, mesh, numbers.runs["standard"], strict=fine),
        *real_beam.checks_of(found, mesh),
        check_below(
            "the reference, corrected by probed points, follows the specimen as made (rms of the smooth vertices)",
            reference_error_um(numbers.edge), REFERENCE_UM, "um",
        ),
    ]  # fmt: skip
    return rows, checks, figures_of(found, mesh, numbers), NOTES
