"""From calibration runs to volumes: each scan of sec. 6 reconstructed by the paper's method and by ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any, Literal

import numpy as np

from tomopose.calibration.apply import projection_matrices
from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.observations import BallObservations
from tomopose.reconstruction.reconstruct import PAPER, reconstruct
from tomopose.studies.hexapod_runs import solve_run
from tomopose.studies.radiographs import BallRun
from tomopose.studies.result import Progress
from tomopose.studies.section6_scan import WHITE, Numbers, Object, Path, Radiographs, Scan, grid_of
from tomopose.studies.steps import Steps
from tomopose.studies.table1 import PRINTED
from tomopose.studies.virtual_hexapod import ball_run, believed_hexapod
from tomopose.volume import Volume

Method = Literal["paper", "best"]
DETECTION_PX = PRINTED[5.3, 3][1]
"""Table 1, row 5: d_rms_exact of the paper's detection at M 5.3; both coordinates together."""
GRID = 3
CHECKPOINT_SECONDS = 300.0


@dataclass(frozen=True, kw_only=True)
class Case:
    """One volume.

    run:   the calibration run whose matrices are used: 1 before the scan, 2 after it; 0 for the circular scan, whose
           matrices are the scanner's own.
    order: of the views in one iteration of SART, where it is not the method's own.
    """

    thing: Object
    path: Path
    method: Method
    run: int = 0
    order: str = ""

    @property
    def name(self) -> str:
        return "-".join(x for x in (self.thing, self.path, self.method, f"run{self.run}", self.order) if x)


def cases_of(thing: Object, runs: tuple[int, ...]) -> tuple[Case, ...]:
    """Circular and 3D scan by both methods; for the standard, the order of views as well."""
    methods: tuple[Method, ...] = ("paper", "best")
    cases = [Case(thing=thing, path="circular", method=m) for m in methods]
    cases += [Case(thing=thing, path="3D", method=m, run=run) for run in runs for m in methods]
    if thing == "standard":
        cases += [Case(thing=thing, path="3D", method="best", run=1, order=o) for o in ("sequential", "golden")]
    return tuple(cases)


def both_methods(run: BallRun, x_D: Any, sigma: float, magnification: float) -> dict[Method, Calibration]:
    """Rigid, as the paper, and kinematic calibration from the same centres (n, 2), px, with one sigma a coordinate."""
    seen = BallObservations.from_sigma(x_D, sigma, pose_id=run.poses.pose_id)
    return {
        "paper": calibrate(run.scanner, run.poses, seen, model="rigid", robust=False, hypotheses=False,
                           pose_noise=None),
        "best": calibrate(run.scanner, run.poses, seen, manipulator=believed_hexapod(magnification),
                          model="kinematic", hypotheses=False),
    }


def calibrations(
    magnification: float, number: int, numbers: Numbers, seed: int, steps: Steps, progress: Progress
) -> dict[Method, Calibration]:
    """Calibration run `number` of the virtual hexapod, by both methods."""
    if numbers.radiographs:
        solved = solve_run(magnification, GRID, seed, number, steps, progress)
        return {"paper": solved.paper_method, "best": solved.best}
    run = ball_run(magnification, GRID, seed, number=number)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 61, round(10 * magnification), number]))
    sigma = DETECTION_PX / np.sqrt(2)
    return both_methods(run, run.x_D + sigma * rng.standard_normal(run.x_D.shape), sigma, magnification)


def matrices_for(case: Case, scan: Scan, found: Mapping[int, Mapping[Method, Calibration]]) -> ProjectionMatrices:
    """The matrices with which a case is reconstructed; nothing of the true poses is in those of a 3D scan."""
    if case.path == "circular":
        return scan.truth
    return projection_matrices(found[case.run][case.method], scan.poses, binning=scan.binning)


def volume_for(
    case: Case, scan: Scan, images: Radiographs, matrices: ProjectionMatrices, numbers: Numbers,
    checkpoint: FilePath | None, progress: Progress | None,
) -> Volume:
    """Reconstructed as the paper does, or by default; a kept state lets an interrupted one go on."""
    options: dict[str, Any] = {}
    if case.method == "paper" or case.order:
        options = {**PAPER, **({"order": case.order} if case.order else {})}
    # The matrices belong to the images by construction, so that other readings need not be tried.
    return reconstruct(
        images, matrices, grid_of(case.thing, numbers), white=WHITE, engine="cpu", consistency="off",
        checkpoint=checkpoint, checkpoint_seconds=CHECKPOINT_SECONDS, progress=progress, **options,
    )


def measured(
    case: Case, scan: Scan, images: Radiographs, matrices: Callable[[], ProjectionMatrices], numbers: Numbers,
    measure: Callable[[Volume], Mapping[str, Any]], steps: Steps, progress: Progress,
) -> dict[str, Any]:
    """What is measured in a case's volume, kept as a step."""
    def compute() -> dict[str, Any]:
        checkpoint = None if steps.folder is None else steps.folder / f"state-{case.name}"
        volume = volume_for(case, scan, images, matrices(), numbers, checkpoint, progress)
        residual = volume.view_residual
        return {**measure(volume), "residual": None if residual is None else float(np.median(residual))}

    return steps.of(f"volume-{case.name}", compute, numbers=asdict(numbers))
