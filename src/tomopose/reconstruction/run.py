"""`reconstruct`: from radiographs and projection matrices to a volume in frame W."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tomopose.engines import ENGINES, make_engine
from tomopose.engines.geometry import require_usable, truncated_views
from tomopose.engines.protocol import require_support
from tomopose.errors import EngineError, InputError, TrajectoryError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import provenance
from tomopose.reconstruction.checkpoint import Checkpoint, fingerprint
from tomopose.reconstruction.consistency import require_consistent, suspicious_views
from tomopose.reconstruction.fdk import FdkFilter
from tomopose.reconstruction.field import DaskField, DiskField, Field, Piece
from tomopose.reconstruction.line_integrals import (
    Correction,
    ImagesAre,
    LineIntegrals,
    images_kind,
    require_contrast,
    ring_offset,
)
from tomopose.reconstruction.memory import memory_plan, require_room_for_cgls, sampling_stride
from tomopose.reconstruction.order import subsets, view_order
from tomopose.reconstruction.path import SourcePath, source_path
from tomopose.reconstruction.updates import Samples, cgls, fdk_update, run, sart_update, view_residuals
from tomopose.volume import Volume, VoxelGrid

Algorithm = Literal["fdk+sart", "sart", "ossart", "fdk", "fdk-preview", "cgls"]
ALGORITHMS = ("fdk+sart", "sart", "ossart", "fdk", "fdk-preview", "cgls")
OSSART_SUBSET = 5
PAPER: dict[str, Any] = {"algorithm": "sart", "iterations": 1, "relaxation": 0.8, "order": "random"}
"""As in Butzhammer et al., Meas. Sci. Technol. 34 (2023) 015403, sec. 6.2: one iteration of SART, relaxation 0.8.

The paper does not say in which order the views were taken.  From zero, one sweep in random order left ball centres
0.003 voxel beside their place, in golden order 0.008 (docs/validation/reconstruction.md).
"""


def reconstruct(
    images: Sequence[Any],
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    *,
    images_are: ImagesAre | None = None,
    white: Any = None,
    dark: Any = 0.0,
    engine: str = "auto",
    algorithm: Algorithm = "fdk+sart",
    relaxation: float | Sequence[float] = 0.8,
    iterations: int | None = None,
    order: Any = "golden",
    seed: int = 0,
    subset_size: int | None = None,
    nonnegative: bool = False,
    mask: np.ndarray | None = None,
    bad_pixels: np.ndarray | None = None,
    invalid: Literal["error", "exclude"] = "error",
    beam_hardening: Sequence[float] = (),
    ring_width: int | None = None,
    consistency: Literal["error", "off"] = "error",
    memory_gib: float | None = None,
    scratch: str | Path | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_seconds: float = 60.0,
    progress: Callable[[int, int], None] | None = None,
    client: Any = None,
    slabs: int | None = None,
    engine_options: dict[str, Any] | None = None,
) -> Volume:
    """Reconstruct a scan along any path from its projection matrices.

    Parameters
    ----------
    images:     n images [v, u] in any lazy sequence with a length; array row index = v (row 0 is the bottom).
    matrices:   n projection matrices of eq. (5).
    grid:       where the voxels lie in W.
    images_are, white, dark, bad_pixels, invalid: how images become line integrals, see `Correction`.  images_are may be
                left out where the sequence says it itself; it is never guessed.
    engine:     "cpu", "reference", "rtk", "astra", or "auto": the GPU where ASTRA finds one, else the CPU.
    algorithm:  "fdk+sart" (default: FDK as a start, then SART), "sart" (from zero; `PAPER` is one iteration at 0.8),
                "ossart" (subsets of 5 views unless given), "fdk" (refused where the path is no full turn, or jumps),
                "fdk-preview" (FDK on any path, its errors noted), "cgls" (20 iterations unless given).
    relaxation: one factor, or one an iteration, above 0 and below 2.
    iterations: sweeps over all views; 1 unless given (cgls: 20).
    order:      "golden", "random" (from `seed`), "sequential", or a permutation of the views.
    subset_size: views an update takes; 1 unless given.
    nonnegative: cut negative values after each update of SART.
    mask:       bool [z, y, x]: voxels that may differ from zero.
    beam_hardening: coefficients of `beam_hardening_polynomial`.
    ring_width: window (px, odd) of the correction of `ring_offset`; None for none.
    consistency: "error" reconstructs a few views coarsely first and refuses images that contradict the matrices.
    memory_gib, scratch: memory to keep within, and a folder for the slabs of volumes that do not fit.
    checkpoint, checkpoint_seconds: folder in which the state is kept, at most that often (0: after every update); a
                second call with the same arguments goes on from there and ends with the same numbers.
    progress:   called with (updates done, updates in all).
    client:     a dask.distributed client: its workers hold the volume in slabs.
    slabs:      number of slabs; as many as needed, or one a worker, unless given.

    Returns
    -------
    Volume, float32, attenuation in 1/mm, with the relative residual of each view's reprojection.

    Raises
    ------
    InputError, ShapeError, ConventionError   for images that cannot be used or contradict the matrices.
    OutOfViewError                            where the grid lies outside the field of view.
    TrajectoryError                           for "fdk" on a path that is no full turn, or jumps.
    EngineMissingError                        where the engine cannot run here.
    """
    if algorithm not in ALGORITHMS:
        raise InputError(f"algorithm is {algorithm!r}; {', '.join(ALGORITHMS)} are known")
    sweeps = (20 if algorithm == "cgls" else 1) if iterations is None else iterations
    if int(sweeps) != sweeps or sweeps < 1:
        raise InputError(f"iterations is {iterations!r}; a positive whole number is needed")
    factors = relaxations(relaxation, int(sweeps))
    size = (OSSART_SUBSET if algorithm == "ossart" else 1) if subset_size is None else subset_size
    support = require_support(mask, grid)
    if support is not None and not support.any():
        raise InputError("the mask holds no voxel")
    require_usable(matrices, grid)
    correction = Correction(
        images_are=images_kind(images, images_are),
        white=white,
        dark=dark,
        bad_pixels=bad_pixels,
        invalid=invalid,
        beam_hardening=tuple(beam_hardening),
    )
    scan = LineIntegrals(images, matrices, correction)
    if ring_width is not None:
        scan = LineIntegrals(images, matrices, with_rings(scan, ring_width))
    require_contrast(scan, sorted({0, len(scan) // 3, len(scan) // 2, len(scan) - 1}))
    name = chosen_engine(engine, matrices, grid)
    path = source_path(matrices)
    notes = path_notes(matrices, grid, path)
    if algorithm == "fdk":
        require_followed(path)
    agreement = None
    if consistency == "error":
        agreement = require_consistent(scan, grid)
    elif consistency != "off":
        raise InputError(f"consistency is {consistency!r}; 'error' or 'off' is needed")

    settings = {
        "algorithm": algorithm,
        "engine": name,
        "iterations": int(sweeps),
        "relaxation": list(factors),
        "order": order if isinstance(order, str) else "given",
        "seed": seed,
        "subset_size": int(size),
        "nonnegative": nonnegative,
        "mask": support is not None,
        "images_are": correction.images_are,
        "invalid": invalid,
        "beam_hardening": list(correction.beam_hardening),
        "ring_width": ring_width,
    }
    options = dict(engine_options or {})
    stride = sampling_stride(matrices)
    if algorithm == "cgls":
        unserved = {"checkpoint": checkpoint, "scratch": scratch, "client": client, "slabs": slabs}
        asked = [option for option, value in unserved.items() if value is not None]
        if asked:
            raise InputError(f"cgls works on the whole volume in memory and serves no {asked[0]}; sart and ossart do")
        require_room_for_cgls(matrices, grid, memory_gib=memory_gib)
        values, residual = solve_cgls(name, scan, grid, support, options, int(sweeps), progress)
    else:
        field = open_field(
            name,
            matrices,
            grid,
            support,
            options,
            subset_size=int(size),
            sweeps=int(sweeps) + 1,
            memory_gib=memory_gib,
            scratch=scratch,
            client=client,
            slabs=slabs,
        )
        samples = Samples(len(scan), stride)
        schedule = []
        sequence = view_order(len(scan), order, seed=seed)
        start = algorithm in ("fdk", "fdk-preview") or (algorithm == "fdk+sart" and path.full_turn)
        if start and "inverse-square" not in field.limits().weights:
            if algorithm != "fdk+sart":
                raise EngineError(f"engine {name} has no distance-weighted back-projection; FDK needs engine cpu")
            start = False
            notes.append(f"engine {name} has no FDK: SART began from zero")
        if start:
            filtered = FdkFilter(matrices, path, threads=options.get("threads") or 2)
            schedule.append(
                (fdk_update(field, filtered, nonnegative=False), subsets(np.arange(len(scan)), max(4, int(size))))
            )
        if algorithm in ("fdk+sart", "sart", "ossart"):
            for factor in factors:
                update = sart_update(field, relaxation=factor, nonnegative=nonnegative)
                schedule.append((update, subsets(sequence, int(size))))
        keeper = None
        if checkpoint is not None:
            exact = {**settings, "order": sequence.tolist(), "mask": mask_digest(support)}
            identity = fingerprint(matrices, grid, exact)
            keeper = Checkpoint(Path(checkpoint), identity, seconds=checkpoint_seconds)
        run(schedule, field, scan, samples=samples, checkpoint=keeper, progress=progress)
        residual = view_residuals(field, scan, samples)
        values = field.values()
        if keeper:
            keeper.remove()
    if agreement is not None:
        settings["coarse_consistency"] = agreement.residual
    odd = suspicious_views(residual)
    if odd.size:
        listed = ", ".join(str(j) for j in odd[:10]) + (" ..." if odd.size > 10 else "")
        notes.append(
            f"{odd.size} views disagree with the volume more than the others (views {listed}): look at their poses and "
            "their images"
        )
    return Volume(
        values=values,
        grid=grid,
        view_residual=residual,
        notes=tuple(notes),
        settings=settings,
        provenance=provenance(arguments=settings, seed=seed),
    )


def relaxations(relaxation: float | Sequence[float], iterations: int) -> tuple[float, ...]:
    """One factor an iteration."""
    given = np.atleast_1d(np.asarray(relaxation, dtype=np.float64))
    factors = np.broadcast_to(given, (iterations,)) if given.size == 1 else given
    if factors.shape != (iterations,):
        raise InputError(f"{given.size} relaxation factors but {iterations} iterations")
    if not ((factors > 0) & (factors < 2)).all():
        raise InputError(f"relaxation is {relaxation!r}; SART needs factors above 0 and below 2")
    return tuple(float(f) for f in factors)


def chosen_engine(engine: str, matrices: ProjectionMatrices, grid: VoxelGrid) -> str:
    """The engine's own name, once it is known to run here: tried on one voxel of the grid."""
    name = make_engine(engine, matrices.select([0]), VoxelGrid(shape=(1, 1, 1), spacing=grid.spacing)).name
    assert name in ENGINES
    return name


def with_rings(scan: LineIntegrals, width: int) -> Correction:
    """The scan's correction with its ring offset."""
    from dataclasses import replace

    return replace(scan.correction, rings=ring_offset(scan, width=width))


def path_notes(matrices: ProjectionMatrices, grid: VoxelGrid, path: SourcePath) -> list[str]:
    """What the path itself has to say: short scan, truncation."""
    notes = []
    if not path.full_turn:
        notes.append(
            f"short scan: the source covers {math.degrees(path.coverage):.0f} of 360 degrees about the object; FDK is "
            "not used, and SART cannot replace what no view shows"
        )
    beside = truncated_views(matrices, grid)
    if beside.size:
        notes.append(
            f"truncated: corners of the grid fall beside the detector in {beside.size} of {len(matrices)} views; what "
            "the grid does not hold but the rays cross is smeared into it"
        )
    return notes


def require_followed(path: SourcePath) -> None:
    """TrajectoryError where filtered back-projection alone would mislead."""
    if not path.smooth:
        raise TrajectoryError(
            "FDK follows the source's path from view to view about the axis; here its height jumps between neighbours "
            'by angle (several rings, or scattered views). Use algorithm="fdk+sart", or "fdk-preview" for a quick look'
        )
    if not path.full_turn:
        raise TrajectoryError(
            f"FDK needs a full turn; the source covers {math.degrees(path.coverage):.0f} degrees. "
            'Use algorithm="sart", or "fdk-preview" for a quick look'
        )


def mask_digest(support: np.ndarray | None) -> str:
    """What of a mask belongs in a checkpoint's identity."""
    import hashlib

    return "" if support is None else hashlib.sha256(np.packbits(support).tobytes()).hexdigest()


def open_field(
    name: str,
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    support: np.ndarray | None,
    options: dict[str, Any],
    *,
    subset_size: int,
    sweeps: int,
    memory_gib: float | None,
    scratch: str | Path | None,
    client: Any,
    slabs: int | None,
) -> Field:
    """Where the volume lives while it is made: in memory, in slabs on disk, or on a cluster."""
    if client is not None:
        workers = len(client.scheduler_info(n_workers=-1)["workers"])
        if workers == 0:
            raise EngineError("the dask client has no workers")
        return DaskField(name, matrices, grid, support, options, slabs=slabs or workers, client=client)
    limits = make_engine(name, matrices.select([0]), VoxelGrid(shape=(1, 1, 1), spacing=grid.spacing)).limits
    plan = memory_plan(
        matrices,
        grid,
        subset_size=subset_size,
        passes=sweeps,
        memory_gib=memory_gib,
        most_voxels=limits.most_voxels,
        may_cut=scratch is not None,
        support=support is not None,
    )
    pieces = slabs or plan.slabs
    if pieces == 1:
        return Piece(name, matrices, grid, support, options)
    if scratch is None:
        raise InputError(f"{pieces} slabs need a folder: scratch=FOLDER")
    return DiskField(name, matrices, grid, support, options, slabs=pieces, scratch=Path(scratch))


def solve_cgls(
    name: str,
    scan: LineIntegrals,
    grid: VoxelGrid,
    support: np.ndarray | None,
    options: dict[str, Any],
    iterations: int,
    progress: Callable[[int, int], None] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """CGLS in one piece, and the residual of each view."""
    engine = make_engine(name, scan.matrices, grid, **options)
    x = cgls(engine, scan, iterations=iterations, support=support, progress=progress)
    residual = np.empty(len(scan))
    for j in range(len(scan)):
        p = scan[j].astype(np.float64)
        residual[j] = np.sqrt(((p - engine.forward(x, [j])[0]) ** 2).sum() / max((p**2).sum(), 1e-300))
    return np.asarray(engine.values(x), dtype=np.float32), residual
