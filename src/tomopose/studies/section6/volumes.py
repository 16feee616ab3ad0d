"""From calibrations to volumes: each scan of sec. 6 reconstructed by the paper's method and by ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.result import Calibration
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.line_integrals import Correction
from tomopose.reconstruction.run import reconstruct
from tomopose.reconstruction.settings import FDK, Algorithm, Execution, described
from tomopose.simulation.objects.sphere_standard import SHAFT_DIAMETER, sphere_centres, sphere_diameters
from tomopose.studies.parts.result import Progress
from tomopose.studies.parts.steps import Steps
from tomopose.studies.section6.calibrations import Method
from tomopose.studies.section6.scan import (
    MOUNTED,
    WHITE,
    Numbers,
    Object,
    Path,
    Radiographs,
    Scan,
    grid_of,
    specimen,
)
from tomopose.studies.section6.specimen import measure_specimen
from tomopose.studies.section6.standard import measure_standard
from tomopose.volume import Volume, VoxelGrid

CHECKPOINT_SECONDS = 300.0
NEAR_MM = 1.5
"""Air around the object that is measured: far more than an edge search reaches."""


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
    case: Case,
    scan: Scan,
    images: Radiographs,
    matrices: ProjectionMatrices,
    numbers: Numbers,
    algorithm: Algorithm,
    checkpoint: FilePath | None,
    progress: Progress | None,
) -> Volume:
    """Reconstructed by an algorithm; a kept state lets an interrupted one continue.

    FDK finds each voxel by itself, so that those far from the object need not be found.
    """
    grid = grid_of(case.thing, numbers)
    mask = near(case.thing, grid, numbers.edge) if isinstance(algorithm, FDK) else None
    # The matrices belong to the images by construction, so that other readings need not be tried.
    return reconstruct(
        images,
        matrices,
        grid,
        correction=Correction(images_are="counts", white=WHITE),
        algorithm=algorithm,
        engine="cpu",
        execution=Execution(checkpoint=checkpoint, checkpoint_seconds=CHECKPOINT_SECONDS),
        consistency="off",
        mask=mask,
        progress=progress,
    )


def near(thing: Object, grid: VoxelGrid, edge: float) -> np.ndarray:
    """bool [z, y, x]: voxels within NEAR_MM of the specimen's own bounding box, or of the balls and shafts."""
    out = np.zeros(grid.shape, dtype=bool)
    z, y, x = (grid.origin[2 - a] + grid.spacing[2 - a] * np.arange(grid.shape[a]) for a in range(3))
    if thing == "specimen":
        part = specimen(edge).vertices
        low, high = part.min(axis=0) - NEAR_MM, part.max(axis=0) + NEAR_MM
        for layer, height in zip(out, z, strict=True):
            layer[:] = True
            for k, (a, b, c) in enumerate(MOUNTED.T):
                along = a * x + b * y[:, None] + c * height
                layer &= (along > low[k]) & (along < high[k])
        return out
    ball, shaft = sphere_diameters() / 2 + NEAR_MM, SHAFT_DIAMETER / 2 + NEAR_MM
    for centre, reach in zip(sphere_centres(), ball, strict=True):
        iy, ix = (np.flatnonzero(np.abs(line - middle) < reach) for line, middle in ((y, centre[1]), (x, centre[0])))
        across = (x[ix] - centre[0]) ** 2 + (y[iy, None] - centre[1]) ** 2
        inside = across + (z[:, None, None] - centre[2]) ** 2 < reach**2
        inside |= (across < shaft**2) & (z < centre[2])[:, None, None]
        out[:, iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] |= inside
    return out


def measured(
    case: Case,
    scan: Scan,
    images: Radiographs,
    matrices: Callable[[], ProjectionMatrices],
    numbers: Numbers,
    algorithm: Algorithm,
    steps: Steps,
    progress: Progress,
) -> dict[str, Any]:
    """What is measured in a case's volume, kept as a step."""

    def compute() -> dict[str, Any]:
        checkpoint = None if steps.folder is None else steps.folder / f"state-{case.name}"
        volume = volume_for(case, scan, images, matrices(), numbers, algorithm, checkpoint, progress)
        residual = volume.view_residual
        found = measure_specimen(volume, numbers.edge) if case.thing == "specimen" else measure_standard(volume)
        return {**found, "residual": None if residual is None else float(np.median(residual))}

    return steps.of(
        f"volume-{case.name}",
        compute,
        options=described(algorithm),
        numbers={k: v[case.thing] if isinstance(v, Mapping) else v for k, v in asdict(numbers).items() if k != "runs"},
    )
