"""`reconstruct`: from radiographs and projection matrices to a volume in frame W."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, Unpack

import numpy as np
import numpy.typing as npt

from tomopose.engines import make_engine
from tomopose.engines.geometry import require_usable
from tomopose.engines.protocol import require_support
from tomopose.errors import ConventionError, InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import provenance
from tomopose.reconstruction.choice import choose, situation_of
from tomopose.reconstruction.consistency import require_consistent
from tomopose.reconstruction.findings import agreement_notes, scan_notes
from tomopose.reconstruction.line_integrals import (
    Correction,
    ImagesAre,
    LineIntegrals,
    images_kind,
    require_contrast,
    ring_offset,
)
from tomopose.reconstruction.settings import (
    Algorithm,
    EarlierOptions,
    Execution,
    algorithm_of,
    with_earlier,
)
from tomopose.reconstruction.work import Work, solve
from tomopose.values import Images, require_types
from tomopose.volume import Volume, VoxelGrid


@require_types
def reconstruct(
    images: Images,
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    *,
    images_are: ImagesAre | None = None,
    algorithm: Algorithm | str | None = None,
    engine: str = "auto",
    correction: Correction | None = None,
    execution: Execution | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
    consistency: Literal["error", "off"] = "error",
    progress: Callable[[int, int], None] | None = None,
    **earlier: Unpack[EarlierOptions],
) -> Volume:
    """Reconstruct a scan along any path from its projection matrices.

    Parameters
    ----------
    images:     n images [v, u] in any lazy sequence with a length; array row index = v (row 0 is the bottom).
    matrices:   n projection matrices of eq. (5).
    grid:       where the voxels lie in W.
    images_are: "transmission", "line-integrals" or "counts"; may be left out where the sequence or `correction` says
                it.  It is never guessed.
    algorithm:  a value, SART(iterations=2), OSSART(), FDK(), CGLS(), `PAPER`, or its short name: "sart", "ossart",
                "fdk", "fdk+sart", "cgls", "fdk-preview".  None or "auto": FDK on smooth full turns of enough views,
                else SART, which begins with FDK where that is defined.  The choice and its reason are in the notes.
    engine:     "cpu", "reference", "rtk", "astra", or "auto": the GPU where ASTRA finds one, else the CPU.
    correction: how images become line integrals.
    execution:  memory, slabs, checkpoint, cluster and the engine's own options.
    mask:       bool [z, y, x]: voxels that may differ from zero.
    consistency: "error" reconstructs a few views coarsely first and refuses images that contradict the matrices where
                another reading of them is right.
    progress:   called with (updates done, updates in all).
    earlier:    the options of tomopose 0.1 (relaxation=, memory_gib= ...), which belong to the values above now.

    Returns
    -------
    Volume, float32, attenuation in 1/mm, with the relative residual of each view's reprojection, notes, and the views
    that it contradicts (`Volume.contradicted`; `Volume.trustworthy` is False where there are any).

    Raises
    ------
    InputError, ShapeError, ConventionError   for images that cannot be used or contradict the matrices.
    OutOfViewError                            where the grid lies outside the field of view.
    TrajectoryError                           for FDK, alone or as a start, where it is not defined.
    EngineMissingError                        where the engine cannot run here.
    """
    asked, correction, execution = with_earlier(algorithm_of(algorithm), correction, execution, earlier)
    require_known(consistency)
    support = support_of(mask, grid)
    require_usable(matrices, grid)
    scan = line_integrals_of(images, matrices, images_are, correction)
    require_contrast(scan, sorted({0, len(scan) // 3, len(scan) // 2, len(scan) - 1}))
    probe = make_engine(engine, matrices.select([0]), VoxelGrid(shape=(1, 1, 1), spacing=grid.spacing))
    situation = situation_of(scan, grid)
    choice = choose(asked, situation, scan, probe.limits, probe.name)
    work = Work(
        scan=scan,
        grid=grid,
        support=support,
        engine=probe.name,
        limits=probe.limits,
        choice=choice,
        path=situation.path,
    )
    notes = [choice.words, *scan_notes(situation, matrices, grid)]
    settings = work.described
    if consistency == "error":
        notes += coarse_check(work, execution, settings)
    values, agreement = solve(work, execution, progress)
    return Volume(
        values=values,
        grid=grid,
        view_residual=agreement.residual,
        contradicted=agreement.contradicted,
        notes=(*notes, *agreement_notes(agreement, matrices)),
        settings=settings,
        provenance=provenance(arguments=settings, seed=work.seed),
    )


def require_known(consistency: str) -> None:
    """InputError for another word than "error" and "off"."""
    if consistency not in ("error", "off"):
        raise InputError(f"consistency is {consistency!r}; 'error' or 'off' is needed")


def coarse_check(work: Work, execution: Execution, settings: dict[str, object]) -> list[str]:
    """What the coarse check has to say; its residuals are put into the settings."""
    coarse = require_consistent(work.scan, work.grid, engine=work.engine, options=execution.engine_options)
    settings["coarse_consistency"] = coarse.residual
    return [coarse.message] if coarse.doubtful else []


def support_of(mask: npt.NDArray[np.bool_] | None, grid: VoxelGrid) -> npt.NDArray[np.bool_] | None:
    """The mask, if it is one of the grid's voxels and holds some."""
    support = require_support(mask, grid)
    if support is not None and not support.any():
        raise InputError("the mask holds no voxel")
    return support


def line_integrals_of(
    images: Images, matrices: ProjectionMatrices, images_are: ImagesAre | None, correction: Correction | None
) -> LineIntegrals:
    """The scan's line integrals, rings taken out where the correction asks for it."""
    said = correction.images_are if correction is not None else None
    if images_are is not None and said is not None and images_are != said:
        raise ConventionError(f"images_are is {images_are!r} but the correction says {said!r}")
    kind = images_kind(images, images_are if images_are is not None else said)
    correction = Correction(images_are=kind) if correction is None else replace(correction, images_are=kind)
    scan = LineIntegrals(images, matrices, correction)
    if correction.ring_width is None:
        return scan
    rings = ring_offset(scan, width=correction.ring_width)
    return LineIntegrals(images, matrices, replace(correction, rings=rings))
