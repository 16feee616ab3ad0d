"""The work itself: where the volume lives, the schedule of updates, and how the views agree with what comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.engines import make_engine
from tomopose.engines.protocol import Limits
from tomopose.errors import EngineError, InputError
from tomopose.kept import Key, digest_of_images, key_of
from tomopose.reconstruction.checkpoint import NAME, Checkpoint
from tomopose.reconstruction.choice import Choice
from tomopose.reconstruction.fdk.filter import FdkFilter
from tomopose.reconstruction.fdk.path import SourcePath
from tomopose.reconstruction.field import DaskField, DiskField, Field, Piece
from tomopose.reconstruction.findings import Agreement, agreement_of
from tomopose.reconstruction.line_integrals import LineIntegrals
from tomopose.reconstruction.memory import memory_plan, require_room_for_cgls, sampling_stride
from tomopose.reconstruction.settings import CGLS, FDK, SART, Execution, described
from tomopose.reconstruction.updates import Samples, Subset, Update, cgls, fdk_update, run, sart_update
from tomopose.trajectory.view_order import subsets, view_order
from tomopose.volume import VoxelGrid

FDK_SUBSET = 4
"""Views that FDK adds at a time, at least: its sum does not depend on it."""

Progress = Callable[[int, int], None] | None


@dataclass(frozen=True, kw_only=True)
class Work:
    """What is reconstructed: scan, grid, support (bool [z, y, x], or None), the engine's name and limits, the choice of
    the algorithm, and the source's path where there is one."""

    scan: LineIntegrals
    grid: VoxelGrid
    support: np.ndarray | None
    engine: str
    limits: Limits
    choice: Choice
    path: SourcePath | None

    @property
    def seed(self) -> int | None:
        """Of the random order of views; None for algorithms without one."""
        return self.choice.algorithm.seed if isinstance(self.choice.algorithm, SART) else None

    @property
    def described(self) -> dict[str, object]:
        """The settings that a volume and its provenance hold."""
        return {
            **described(self.choice.algorithm),
            "engine": self.engine,
            "mask": self.support is not None,
            **self.scan.correction.described,
            "choice": self.choice.words,
        }


def solve(work: Work, execution: Execution, progress: Progress) -> tuple[np.ndarray, Agreement]:
    """The volume [z, y, x] float32, and how the views agree with it."""
    if isinstance(work.choice.algorithm, CGLS):
        return _solve_cgls(work, work.choice.algorithm, execution, progress)
    scan, grid = work.scan, work.grid
    stride = sampling_stride(scan.matrices)
    field = open_field(work, execution)
    samples = Samples(len(scan), stride)
    keeper = None
    if execution.checkpoint is not None:
        keeper = Checkpoint(Path(execution.checkpoint), key(work, execution), seconds=execution.checkpoint_seconds)
    run(schedule(work, field, execution), field, scan, samples=samples, checkpoint=keeper, progress=progress)
    agreement = agreement_of(
        lambda j: samples.view(scan, j), lambda j: field.sampled((j,), stride)[0], scan.matrices, grid, stride
    )
    values = field.values()
    if keeper:
        keeper.remove()
    return values, agreement


def schedule(work: Work, field: Field, execution: Execution) -> list[tuple[Update, Sequence[Subset]]]:
    """The stages of FDK and SART: an update, and the subsets of views that it takes one after the other."""
    algorithm, n = work.choice.algorithm, len(work.scan)
    stages: list[tuple[Update, Sequence[Subset]]] = []
    size = algorithm.subset_size if isinstance(algorithm, SART) else 1
    if isinstance(algorithm, FDK) or (isinstance(algorithm, SART) and algorithm.start is not None):
        assert work.path is not None
        threads = execution.engine_options.get("threads")
        filtered = FdkFilter(
            work.scan.matrices,
            work.path,
            redundancy=work.choice.redundancy,
            threads=threads if isinstance(threads, int) else 2,
        )
        stages.append((fdk_update(field, filtered), subsets(np.arange(n), max(FDK_SUBSET, size))))
    if isinstance(algorithm, SART):
        sequence = view_order(n, algorithm.order, seed=algorithm.seed)
        for factor in algorithm.factors:
            update = sart_update(field, relaxation=factor, nonnegative=algorithm.nonnegative)
            stages.append((update, subsets(sequence, size)))
    return stages


def key(work: Work, execution: Execution) -> Key:
    """The key of a checkpoint: every image whole, and everything else that the numbers depend on."""
    scan = work.scan
    return key_of(
        NAME,
        images=digest_of_images(scan.raw(j) for j in range(len(scan))),
        matrices=scan.matrices.P,
        detector={
            "n_u": scan.matrices.n_u,
            "n_v": scan.matrices.n_v,
            "p_u": scan.matrices.p_u,
            "p_v": scan.matrices.p_v,
        },
        grid={"shape": work.grid.shape, "spacing": work.grid.spacing, "centre": work.grid.centre},
        mask=work.support,
        algorithm=work.choice.algorithm,
        correction=scan.correction,
        engine=work.engine,
        engine_options=dict(execution.engine_options),
        slabs=execution.slabs,
    )


def open_field(work: Work, execution: Execution) -> Field:
    """Where the volume lives while it is made: in memory, in slabs on disk, or on a cluster."""
    algorithm, grid, matrices = work.choice.algorithm, work.grid, work.scan.matrices
    options = dict(execution.engine_options)
    client: Any = execution.client  # dask is optional and untyped
    if client is not None:
        workers = len(client.nthreads())
        if workers == 0:
            raise EngineError("the dask client has no workers")
        slabs = execution.slabs or workers
        return DaskField(work.engine, matrices, grid, work.support, options, slabs=slabs, client=client)
    plan = memory_plan(
        matrices,
        grid,
        subset_size=algorithm.subset_size if isinstance(algorithm, SART) else FDK_SUBSET,
        passes=1 + (algorithm.iterations if isinstance(algorithm, SART) else 0),
        memory_gib=execution.memory_gib,
        most_voxels=work.limits.most_voxels,
        may_cut=execution.scratch is not None,
        support=work.support is not None,
    )
    pieces = execution.slabs or plan.slabs
    if pieces == 1:
        return Piece(work.engine, matrices, grid, work.support, options)
    if execution.scratch is None:
        raise InputError(f"{pieces} slabs need a folder: Execution(scratch=FOLDER)")
    return DiskField(work.engine, matrices, grid, work.support, options, slabs=pieces, scratch=Path(execution.scratch))


def _solve_cgls(work: Work, algorithm: CGLS, execution: Execution, progress: Progress) -> tuple[np.ndarray, Agreement]:
    """CGLS in one piece."""
    if execution.pieces:
        raise InputError(
            f"cgls works on the whole volume in memory and serves no {execution.pieces[0]}; sart and ossart do"
        )
    scan = work.scan
    require_room_for_cgls(scan.matrices, work.grid, memory_gib=execution.memory_gib)
    engine = make_engine(work.engine, scan.matrices, work.grid, **execution.engine_options)
    x = cgls(engine, scan, iterations=algorithm.iterations, support=work.support, progress=progress)
    agreement = agreement_of(lambda j: scan[j], lambda j: engine.forward(x, [j])[0], scan.matrices, work.grid, 1)
    return np.asarray(engine.values(x), dtype=np.float32), agreement
