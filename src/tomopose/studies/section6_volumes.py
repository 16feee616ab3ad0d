"""From calibrations to volumes: each scan of sec. 6 reconstructed by the paper's method and by ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from tomopose.calibration.apply import projection_matrices
from tomopose.calibration.result import Calibration
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.reconstruct import PAPER, reconstruct
from tomopose.studies.result import Progress
from tomopose.studies.section6_calibrations import Method
from tomopose.studies.section6_scan import WHITE, Numbers, Object, Path, Radiographs, Scan, grid_of
from tomopose.studies.steps import Steps
from tomopose.volume import Volume

CHECKPOINT_SECONDS = 300.0


@dataclass(frozen=True, kw_only=True)
class Case:
    """One volume.

    run:   the calibration run whose matrices are used: 1 before the scan, 2 after it; 0 for the true ones, which the
           circular scan has as the scanner's own.
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
    """Circular and 3D scan by both methods; of the standard also with true matrices, and in both orders of views."""
    methods: tuple[Method, ...] = ("paper", "best")
    cases = [Case(thing=thing, path="circular", method=m) for m in methods]
    cases += [Case(thing=thing, path="3D", method=m, run=run) for run in runs for m in methods]
    if thing == "standard":
        cases.append(Case(thing=thing, path="3D", method="best"))
        cases += [Case(thing=thing, path="3D", method="best", run=1, order=o) for o in ("sequential", "golden")]
    return tuple(cases)


def matrices_for(case: Case, scan: Scan, found: Mapping[int, Mapping[Method, Calibration]]) -> ProjectionMatrices:
    """The matrices with which a case is reconstructed; nothing of the true poses is in those of a calibration."""
    if case.run == 0:
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
