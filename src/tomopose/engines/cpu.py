"""The default engine: own kernels on all cores of the machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np

from tomopose.engines import vector
from tomopose.engines.back_projection import back_columns
from tomopose.engines.forward_projection import forward_columns, ray_lengths, scatter_planes, steepest_axis
from tomopose.engines.geometry import index_geometry
from tomopose.engines.layout import BORDER, MARGIN, TILE, Lookup, Rays, Support
from tomopose.engines.protocol import Availability, Limits, Weight, require_images, require_support, require_views
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.volume import VoxelGrid

RAY_COLUMNS = 8
"""Detector columns that a thread takes at a time."""


def processors() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class CpuEngine:
    """Vector kernels (`kernels="vector"`) or the plain ones (`"plain"`) on `threads` threads; see layout.py.

    Results do not depend on the number of threads: no two write to one voxel or pixel.
    """

    name = "cpu"
    limits = Limits(
        weights=("sum", "mean", "inverse-square"), exact_transpose=True, most_voxels=2**31 - 1, device="cpu"
    )

    def __init__(
        self,
        matrices: ProjectionMatrices,
        grid: VoxelGrid,
        *,
        support: np.ndarray | None = None,
        threads: int | None = None,
        kernels: Literal["vector", "plain"] = "vector",
    ) -> None:
        if kernels not in ("vector", "plain"):
            raise InputError(f"kernels is {kernels!r}; 'vector' or 'plain' is needed")
        padded = np.prod([n + MARGIN for n in grid.shape], dtype=np.int64)
        if padded > self.limits.most_voxels:
            raise InputError(
                f"{padded} voxels with their margin are more than {self.limits.most_voxels} in one piece; "
                "let the volume be cut into slabs (memory_gib, scratch)"
            )
        self.matrices, self.grid = matrices, grid
        support = require_support(support, grid)
        self._support = Support(inside=inside_of(support), layers=layers_of(support, grid))
        self.threads = processors() if threads is None else threads
        self.vector = kernels == "vector"
        self._geometry = index_geometry(matrices, grid)
        self._pool: ThreadPoolExecutor | None = None

    # A volume is [x, y, z] with a margin of one zero voxel below and two above; see layout.py.

    def empty(self) -> np.ndarray:
        return np.zeros(tuple(n + MARGIN for n in self.grid.n_xyz), dtype=np.float32)

    def put(self, values: np.ndarray) -> np.ndarray:
        state = self.empty()
        self.values(state)[:] = values
        return state

    def values(self, state: np.ndarray) -> np.ndarray:
        return state[1:-2, 1:-2, 1:-2].transpose(2, 1, 0)

    def forward(self, state: np.ndarray, views: Sequence[int]) -> np.ndarray:
        require_views(views, len(self.matrices))
        # [u, v] inside, so that the returned (m, v, u) has v contiguous: elementwise work on it keeps that order.
        lines = np.empty((len(views), self.matrices.n_u, self.matrices.n_v), dtype=np.float32)
        flat = state.reshape(-1)
        for image, j in zip(lines, views, strict=True):
            rays = self._rays(j)

            def part(start: int, stop: int, image: np.ndarray = image, rays: Rays = rays) -> None:
                forward_columns(flat, rays, image, self.vector, start, stop)

            self._share(part, self.matrices.n_u, RAY_COLUMNS)
        return lines.transpose(0, 2, 1)

    def back(
        self,
        images: np.ndarray,
        views: Sequence[int],
        *,
        into: np.ndarray,
        weight: Weight = "sum",
        scale: float = 1.0,
        nonnegative: bool = False,
    ) -> None:
        images = require_images(images, views, self.matrices)
        if weight not in self.limits.weights:
            raise InputError(f"weight is {weight!r}; one of {', '.join(self.limits.weights)} is needed")
        m, n_v, n_u = images.shape
        bordered = np.empty((m, n_u + 2 * BORDER, n_v + 2 * BORDER), dtype=np.float32)
        bordered[:, BORDER:-BORDER, BORDER:-BORDER] = images.transpose(0, 2, 1)
        for i in range(BORDER):
            bordered[:, i], bordered[:, -1 - i] = bordered[:, BORDER], bordered[:, -1 - BORDER]
        for i in range(BORDER):
            bordered[:, :, i], bordered[:, :, -1 - i] = bordered[:, :, BORDER], bordered[:, :, -1 - BORDER]
        look = Lookup(
            P=self._geometry.P[np.asarray(views, dtype=np.intp)],
            images=bordered.reshape(m, -1),
            n_u=n_u,
            n_v=n_v,
            scale=float(scale),
            inverse_square=weight == "inverse-square",
            vector=self.vector and self.grid.shape[0] >= vector.W,
        )
        flat, mean = into.reshape(-1), weight == "mean"

        def part(start: int, stop: int) -> None:
            back_columns(flat, self.grid.n_xyz, look, mean, nonnegative, self._support, start, stop)

        self._share(part, self.grid.n_xyz[0], TILE)

    def transpose(self, images: np.ndarray, views: Sequence[int]) -> np.ndarray:
        images = require_images(images, views, self.matrices)
        state = self.empty()
        flat = state.reshape(-1)
        for image, j in zip(images, views, strict=True):
            lines, rays = np.ascontiguousarray(image.T), self._rays(j)
            for axis in axes_of(rays, *lines.shape):
                n = self.grid.n_xyz[axis]

                def part(start: int, stop: int, axis: int = axis, lines: np.ndarray = lines, rays: Rays = rays) -> None:
                    scatter_planes(flat, rays, lines, axis, start, stop)

                self._share(part, n, max(2 * TILE, -(-n // self.threads)))
        for axis in range(3):
            edge = np.moveaxis(state, axis, 0)
            edge[0], edge[-2:] = 0.0, 0.0
        return state

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        require_views(views, len(self.matrices))
        lines = np.empty((len(views), self.matrices.n_u, self.matrices.n_v), dtype=np.float32)
        for image, j in zip(lines, views, strict=True):
            ray_lengths(self._rays(j), image, 0, self.matrices.n_u)
        return lines.transpose(0, 2, 1)

    def _rays(self, j: int) -> Rays:
        """View j as the kernels need it."""
        return Rays(
            shape=self.grid.n_xyz,
            spacing=self.grid.spacing,
            source=self._geometry.source[j],
            M_inv=self._geometry.M_inv[j],
        )

    def _share(self, part: Callable[[int, int], None], n: int, chunk: int) -> None:
        """part(start, stop) over 0 .. n, in pieces of `chunk`, on all threads."""
        if self.threads == 1 or n <= chunk:
            part(0, n)
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="tomopose-cpu")
        list(self._pool.map(lambda start: part(start, min(start + chunk, n)), range(0, n, chunk)))

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_pool": None}


def axes_of(rays: Rays, n_u: int, n_v: int) -> tuple[int, ...]:
    """The axes along which rays of a view of n_u x n_v pixels may be steepest.

    Directions steepest along one axis, with one sign, are a convex cone: where those of the four corner pixels are, all
    are.
    """
    corners = np.array([[u, v, 1] for u in (0, n_u - 1) for v in (0, n_v - 1)])
    d = corners @ rays.M_inv.T
    found = {steepest_axis(*each) for each in d}
    axis = found.pop()
    signs = np.sign(d[:, axis])
    return (axis,) if not found and signs[0] != 0 and np.all(signs == signs[0]) else (0, 1, 2)


def inside_of(support: np.ndarray | None) -> np.ndarray:
    """Flat [x, y, z], 1 inside the support; empty without one."""
    if support is None:
        return np.zeros(0, dtype=np.uint8)
    return np.ascontiguousarray(support.transpose(2, 1, 0), dtype=np.uint8).reshape(-1)


def layers_of(support: np.ndarray | None, grid: VoxelGrid) -> np.ndarray:
    """Flat [x, y, 2]: the first layer of the support in each column and the one after its last; empty without one."""
    if support is None:
        return np.zeros(0, dtype=np.int32)
    some = support.any(axis=0)
    first, last = support.argmax(axis=0), grid.shape[0] - support[::-1].argmax(axis=0)
    ends = np.stack([np.where(some, first, 0), np.where(some, last, 0)], axis=-1)
    return np.ascontiguousarray(ends.transpose(1, 0, 2), dtype=np.int32).reshape(-1)


def availability() -> Availability:
    """The CPU engine needs numba only, which tomopose depends on."""
    return Availability(name="cpu", available=True, reason=f"{processors()} processors, {vector.W} lanes a vector")
