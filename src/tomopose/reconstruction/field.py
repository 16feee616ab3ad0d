"""The volume while it is being made: in memory, on disk in slabs, or on the workers of a dask cluster.

All three do the same arithmetic.  Forward projections of slabs add up to that of the whole, because Joseph's projector
is linear and a slab's margin is zero; back-projection touches each voxel once.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tomopose.engines import make_engine
from tomopose.engines.protocol import Engine, Weight
from tomopose.engines.storage import mapped, store, write_layers
from tomopose.files import atomic_file
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.volume import VoxelGrid

if TYPE_CHECKING:
    from dask.distributed import Client


def every_nth_pixel(matrices: ProjectionMatrices, stride: int) -> ProjectionMatrices:
    """The matrices of images[::stride, ::stride]: pixels are left out, not averaged."""
    return replace(
        matrices,
        P=np.diag([1 / stride, 1 / stride, 1.0]) @ matrices.P,
        n_u=(matrices.n_u - 1) // stride + 1,
        n_v=(matrices.n_v - 1) // stride + 1,
        p_u=matrices.p_u * stride,
        p_v=matrices.p_v * stride,
        points_sigma=None,
        scanner=None,
    )


def wider_panel(matrices: ProjectionMatrices, beyond: tuple[int, int]) -> ProjectionMatrices:
    """The matrices of images with `beyond` columns added (below column 0, above the last)."""
    below, above = beyond
    shift = np.array([[1.0, 0.0, below], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(matrices, P=shift @ matrices.P, n_u=matrices.n_u + below + above, points_sigma=None, scanner=None)


@dataclass(frozen=True, kw_only=True)
class Adding:
    """How a back-projection is added: as `Engine.back`; beyond: columns by which the images are wider than the panel,
    see `wider_panel`."""

    weight: Weight
    scale: float = 1.0
    nonnegative: bool = False
    beyond: tuple[int, int] = (0, 0)


class Field(Protocol):
    """The volume under reconstruction.  Images are (m, n_v, n_u) float32, as for an engine."""

    grid: VoxelGrid

    def forward(self, views: Sequence[int]) -> np.ndarray: ...
    def sampled(self, views: Sequence[int], stride: int) -> np.ndarray:
        """`forward` at every stride-th pixel of every stride-th row only."""

    def back(self, images: np.ndarray, views: Sequence[int], how: Adding) -> None:
        """Add a back-projection."""

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        """A 1: lengths of the rays in the grid, or in the support where there is one."""

    def save(self, folder: Path) -> None:
        """The volume into a folder; `load` reads it back."""

    def load(self, folder: Path) -> None: ...
    def values(self) -> np.ndarray:
        """[z, y, x] float32."""


class Piece:
    """One slab (or the whole) with its engine, in memory."""

    def __init__(
        self,
        engine: str,
        matrices: ProjectionMatrices,
        grid: VoxelGrid,
        support: np.ndarray | None,
        options: dict[str, object],
    ) -> None:
        self.grid = grid
        self._made = engine, matrices, options
        self._support = support
        self.engine: Engine = make_engine(engine, matrices, grid, support=support, **options)
        self.state = self.engine.empty()
        self._inside = None if support is None else self.engine.put(support.astype(np.float32))
        self._sampling: dict[int, Engine] = {}
        self._wider: dict[tuple[int, int], Engine] = {(0, 0): self.engine}

    def forward(self, views: Sequence[int]) -> np.ndarray:
        return self.engine.forward(self.state, views)

    def sampled(self, views: Sequence[int], stride: int) -> np.ndarray:
        if stride not in self._sampling:
            name, matrices, options = self._made
            self._sampling[stride] = make_engine(name, every_nth_pixel(matrices, stride), self.grid, **options)
        return self._sampling[stride].forward(self.state, views)

    def back(self, images: np.ndarray, views: Sequence[int], how: Adding) -> None:
        if how.beyond not in self._wider:
            name, matrices, options = self._made
            wide = wider_panel(matrices, how.beyond)
            self._wider[how.beyond] = make_engine(name, wide, self.grid, support=self._support, **options)
        self._wider[how.beyond].back(
            images, views, into=self.state, weight=how.weight, scale=how.scale, nonnegative=how.nonnegative
        )

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        if self._inside is not None:
            return self.engine.forward(self._inside, views)
        return self.engine.lengths(views)

    def values(self) -> np.ndarray:
        return self.engine.values(self.state)

    def put(self, values: np.ndarray) -> None:
        self.state = self.engine.put(values)

    def save(self, folder: Path) -> None:
        store(folder / "slab-000.h5", self.values())

    def load(self, folder: Path) -> None:
        self.put(mapped(folder / "slab-000.h5"))


def slab_bounds(n_z: int, slabs: int) -> tuple[tuple[int, int], ...]:
    """`slabs` runs of layers of nearly equal thickness."""
    edges = np.linspace(0, n_z, slabs + 1).round().astype(int)
    return tuple((int(a), int(b)) for a, b in itertools.pairwise(edges) if b > a)


class DiskField:
    """Slabs in HDF5 files of a scratch folder; one is in memory at a time.

    Back-projection reads the files of one generation and writes the next, so that a killed process always leaves one
    whole generation behind.
    """

    def __init__(
        self,
        engine: str,
        matrices: ProjectionMatrices,
        grid: VoxelGrid,
        support: np.ndarray | None,
        options: dict[str, object],
        *,
        slabs: int,
        scratch: Path,
    ) -> None:
        self.grid, self._scratch = grid, scratch
        self._bounds = slab_bounds(grid.shape[0], slabs)
        self._made = engine, matrices, options
        self._support = support
        self._generation = 0
        for i, (a, b) in enumerate(self._bounds):
            store(self._file(i, 0), np.broadcast_to(np.float32(0), (b - a, *grid.shape[1:])))

    def _file(self, i: int, generation: int) -> Path:
        return self._scratch / f"generation-{generation % 2}" / f"slab-{i:03d}.h5"

    def _piece(self, i: int, *, filled: bool = True) -> Piece:
        engine, matrices, options = self._made
        a, b = self._bounds[i]
        support = None if self._support is None else self._support[a:b]
        piece = Piece(engine, matrices, self.grid.slab(a, b), support, options)
        if filled:
            piece.put(mapped(self._file(i, self._generation)))
        return piece

    def _sum(self, method: str, *arguments: object, filled: bool = True) -> np.ndarray:
        total = getattr(self._piece(0, filled=filled), method)(*arguments)
        for i in range(1, len(self._bounds)):
            total = total + getattr(self._piece(i, filled=filled), method)(*arguments)
        return np.asarray(total)

    def forward(self, views: Sequence[int]) -> np.ndarray:
        return self._sum("forward", views)

    def sampled(self, views: Sequence[int], stride: int) -> np.ndarray:
        return self._sum("sampled", views, stride)

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        return self._sum("lengths", views, filled=False)

    def back(self, images: np.ndarray, views: Sequence[int], how: Adding) -> None:
        for i in range(len(self._bounds)):
            piece = self._piece(i)
            piece.back(images, views, how)
            store(self._file(i, self._generation + 1), piece.values())
        self._generation += 1

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for i in range(len(self._bounds)):
            with atomic_file(folder / f"slab-{i:03d}.h5") as temporary:
                shutil.copyfile(self._file(i, self._generation), temporary)

    def load(self, folder: Path) -> None:
        for i in range(len(self._bounds)):
            store(self._file(i, self._generation), mapped(folder / f"slab-{i:03d}.h5"))

    def values(self) -> np.ndarray:
        """The slabs joined in scratch/volume.h5, mapped: read where it is used."""
        import h5py

        path = self._scratch / "volume.h5"
        with atomic_file(path) as temporary, h5py.File(temporary, "w") as file:
            dataset = file.create_dataset("volume", shape=self.grid.shape, dtype="<f4")
            for i, (a, _) in enumerate(self._bounds):
                write_layers(dataset, mapped(self._file(i, self._generation)), a)
        return mapped(path)


class DaskField:
    """Slabs on the workers of a dask cluster, one actor a slab; images travel, the volume stays where it is."""

    def __init__(
        self,
        engine: str,
        matrices: ProjectionMatrices,
        grid: VoxelGrid,
        support: np.ndarray | None,
        options: dict[str, object],
        *,
        slabs: int,
        client: Client,
    ) -> None:
        self.grid = grid
        self._bounds = slab_bounds(grid.shape[0], slabs)
        workers = sorted(client.nthreads())  # type: ignore[no-untyped-call]
        futures = [
            client.submit(
                Piece,
                engine,
                matrices,
                grid.slab(a, b),
                None if support is None else support[a:b],
                options,
                actor=True,
                workers=[workers[i % len(workers)]],
                pure=False,
            )
            for i, (a, b) in enumerate(self._bounds)
        ]
        # actors: each method gives a future
        self._pieces: list[Any] = [future.result() for future in futures]

    def _all(self, method: str, *arguments: object, **named: object) -> list[Any]:
        return [answer.result() for answer in [getattr(p, method)(*arguments, **named) for p in self._pieces]]

    def _sum(self, method: str, *arguments: object) -> np.ndarray:
        # In the order of the slabs, so that rounding does not depend on which worker is first.
        answers = self._all(method, *arguments)
        total = answers[0]
        for answer in answers[1:]:
            total = total + answer
        return np.asarray(total)

    def forward(self, views: Sequence[int]) -> np.ndarray:
        return self._sum("forward", views)

    def sampled(self, views: Sequence[int], stride: int) -> np.ndarray:
        return self._sum("sampled", views, stride)

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        return self._sum("lengths", views)

    def back(self, images: np.ndarray, views: Sequence[int], how: Adding) -> None:
        self._all("back", np.ascontiguousarray(images), views, how)

    def save(self, folder: Path) -> None:
        for i, piece in enumerate(self._pieces):
            store(folder / f"slab-{i:03d}.h5", piece.values().result())

    def load(self, folder: Path) -> None:
        for i, piece in enumerate(self._pieces):
            piece.put(np.array(mapped(folder / f"slab-{i:03d}.h5"))).result()

    def values(self) -> np.ndarray:
        values = np.empty(self.grid.shape, dtype=np.float32)
        for (a, b), piece in zip(self._bounds, self._pieces, strict=True):
            values[a:b] = piece.values().result()
        return values
