"""Projections of all views by this machine's threads, or by the workers of a dask cluster with the same bytes.

Views are taken in pieces of `PIECE`, here as there.  A projection and its derivatives belong to one view each; a
back-projection adds up each piece on its own and then the pieces in order, so that rounding does not depend on who
calculates what.  On a cluster the volume travels to every worker, the images of a piece to one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.engines.cpu import CpuEngine
from tomopose.errors import EngineError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.refinement.joint_fit.derivatives import integrals_with_derivatives
from tomopose.units import Floats
from tomopose.volume import VoxelGrid

PIECE = 16
"""Views of a piece: a cluster takes n/16 pieces of a back-projection at a time, and each costs one volume more to add,
a fiftieth of its work at 72^3 voxels."""


@dataclass(frozen=True, kw_only=True)
class Workers:
    """threads: of this machine.  client: of a dask cluster whose workers take the projections, or None; its threads
    take a piece each."""

    threads: int
    client: Any = None  # dask is optional and untyped

    def projector(self, matrices: ProjectionMatrices, grid: VoxelGrid) -> Projector:
        return Projector(matrices, grid, self)


class Projector:
    """The projector of one geometry: volumes as the CPU engine holds them, images (n, N) with pixels as [u, v]."""

    def __init__(self, matrices: ProjectionMatrices, grid: VoxelGrid, workers: Workers) -> None:
        self.matrices, self.grid, self._workers = matrices, grid, workers
        self._here = CpuEngine(matrices, grid, threads=workers.threads)
        rows = np.arange(len(matrices))
        self._pieces = [rows[k : k + PIECE] for k in range(0, len(rows), PIECE)]

    def put(self, values: np.ndarray) -> np.ndarray:
        """The engine's state of a volume [z, y, x]."""
        return self._here.put(values)

    def values(self, state: np.ndarray) -> np.ndarray:
        """The volume [z, y, x] of a state."""
        return self._here.values(state)

    def project(self, state: np.ndarray) -> Floats:
        """A x, (n, N)."""
        if self._workers.client is None:
            return projected(state, self._here)
        return np.concatenate(list(self._there(_projected, state, None)))

    def with_derivatives(self, state: np.ndarray) -> tuple[Floats, Floats]:
        """A x (n, N), and its derivatives (n, 6, N) by each view's motion."""
        if self._workers.client is None:
            return derived(state, self.matrices, self.grid, threads=self._workers.threads)
        lines, J = zip(*self._there(_derived, state, None), strict=True)
        return np.concatenate(lines), np.concatenate(J)

    def back(self, y: Floats) -> np.ndarray:
        """A' y of images (n, N), as a state."""
        images = [y[rows] for rows in self._pieces]
        if self._workers.client is None:
            views = [range(rows[0], rows[-1] + 1) for rows in self._pieces]
            parts = (back_projected(piece, self._here, at) for piece, at in zip(images, views, strict=True))
        else:
            parts = self._there(_back_projected, None, images)
        total = next(parts)
        for part in parts:
            total += part
        return total

    def _there(self, function: Callable[..., object], state: np.ndarray | None, images: Sequence[Floats] | None) -> Any:
        """What the workers make of each piece, in order."""
        client = self._workers.client
        if not client.nthreads():
            raise EngineError("the dask client has no workers")
        volume = None if state is None else client.scatter(state, broadcast=True, hash=False)
        given = [None] * len(self._pieces) if images is None else client.scatter(list(images), hash=False)
        asked = [
            client.submit(function, volume, piece, self._part(rows), self.grid, pure=False)
            for rows, piece in zip(self._pieces, given, strict=True)
        ]
        return (future.result() for future in asked)

    def _part(self, rows: np.ndarray) -> ProjectionMatrices:
        """The matrices of a piece, without what a projection does not ask for."""
        m = self.matrices
        return replace(m.select(rows), points_sigma=None, points_sigma_shared=None, scanner=None)


def projected(state: np.ndarray, engine: CpuEngine) -> Floats:
    """(n, N) line integrals of all views of an engine."""
    n = len(engine.matrices)
    return np.asarray(engine.forward(state, range(n)).transpose(0, 2, 1)).reshape(n, -1)


def derived(state: np.ndarray, matrices: ProjectionMatrices, grid: VoxelGrid, *, threads: int) -> tuple[Floats, Floats]:
    """(n, N) line integrals and (n, 6, N) derivatives by each view's motion."""
    n = len(matrices)
    lines, J = integrals_with_derivatives(state, matrices, grid, range(n), threads=threads)
    return lines.transpose(0, 2, 1).reshape(n, -1), J.transpose(0, 1, 3, 2).reshape(n, 6, -1)


def back_projected(y: Floats, engine: CpuEngine, views: Sequence[int]) -> np.ndarray:
    """The state of the back-projected images y (m, N) of some views."""
    m = engine.matrices
    return engine.transpose(y.reshape(len(views), m.n_u, m.n_v).transpose(0, 2, 1), views)


# On a worker of a cluster each task has one thread: the cluster runs one task a thread.


def _projected(state: np.ndarray, _: None, matrices: ProjectionMatrices, grid: VoxelGrid) -> Floats:
    return projected(state, CpuEngine(matrices, grid, threads=1))


def _derived(state: np.ndarray, _: None, matrices: ProjectionMatrices, grid: VoxelGrid) -> tuple[Floats, Floats]:
    return derived(state, matrices, grid, threads=1)


def _back_projected(_: None, y: Floats, matrices: ProjectionMatrices, grid: VoxelGrid) -> np.ndarray:
    return back_projected(y, CpuEngine(matrices, grid, threads=1), range(len(matrices)))
