"""ASTRA toolbox (GPLv3, optional): forward and back-projection on a CUDA GPU through `cone_vec` geometries.

Written against ASTRA's documented interface (create_vol_geom, create_proj_geom 'cone_vec', data3d.link, FP3D_CUDA,
BP3D_CUDA).  The geometry is tested without a GPU; the kernels themselves need one and are not run by the tests.
ASTRA's back-projection is close to the transpose of its forward projection but not equal to it, so that
`exact_transpose` is False, and it has no 1/w^2 weight, so that FDK is not offered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tomopose.engines.protocol import (
    Availability,
    Limits,
    Weight,
    hold_to,
    require_images,
    require_returned,
    require_support,
    require_views,
    view_lengths,
)
from tomopose.errors import EngineFailedError, InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array
from tomopose.volume import VoxelGrid

INSTALL = "pip install 'tomopose[gpu]'"


def cone_vectors(matrices: ProjectionMatrices) -> Array:
    """(n, 12): source, panel centre, step along u, step along v, mm in W; array row index = v."""
    rays = matrices.decompose()
    return np.hstack([rays.source, rays.centre, rays.U, rays.V])


def volume_window(grid: VoxelGrid) -> tuple[float, ...]:
    """x_min, x_max, y_min, y_max, z_min, z_max of the grid's box, mm, as create_vol_geom takes them."""
    low, high = grid.corners.min(axis=0), grid.corners.max(axis=0)
    return tuple(float(edge) for pair in zip(low, high, strict=True) for edge in pair)


class AstraEngine:
    """FP3D_CUDA and BP3D_CUDA over arrays [z, y, x] in the computer's memory; ASTRA splits them to fit the GPU."""

    name = "astra"
    limits = Limits(weights=("mean",), exact_transpose=False, most_voxels=2**40, device="cuda")

    def __init__(self, matrices: ProjectionMatrices, grid: VoxelGrid, *, support: np.ndarray | None = None) -> None:
        import astra

        self._astra = astra
        self.matrices, self.grid = matrices, grid
        self._support = require_support(support, grid)
        self._vectors = cone_vectors(matrices)
        n_z, n_y, n_x = grid.shape
        self._volume_geometry = astra.create_vol_geom(n_y, n_x, n_z, *volume_window(grid))

    def empty(self) -> np.ndarray:
        return np.zeros(self.grid.shape, dtype=np.float32)

    def put(self, values: np.ndarray) -> np.ndarray:
        return np.array(values, dtype=np.float32, order="C").reshape(self.grid.shape)

    def values(self, state: np.ndarray) -> np.ndarray:
        return state

    def projection_geometry(self, views: Sequence[int]) -> dict[str, Any]:
        """ASTRA's description of those views."""
        require_views(views, len(self.matrices))
        geometry: dict[str, Any] = self._astra.create_proj_geom(
            "cone_vec", self.matrices.n_v, self.matrices.n_u, np.ascontiguousarray(self._vectors[list(views)])
        )
        return geometry

    def _run(self, algorithm: str, volume: np.ndarray, lines: np.ndarray, views: Sequence[int]) -> None:
        """Run FP3D_CUDA or BP3D_CUDA between linked arrays, [z, y, x] and [v, view, u]."""
        astra = self._astra
        made: list[Any] = []
        try:
            volume_id = astra.data3d.link("-vol", self._volume_geometry, volume)
            made.append((astra.data3d, volume_id))
            lines_id = astra.data3d.link("-sino", self.projection_geometry(views), lines)
            made.append((astra.data3d, lines_id))
            config = astra.astra_dict(algorithm)
            config["ProjectionDataId"] = lines_id
            config["VolumeDataId" if algorithm == "FP3D_CUDA" else "ReconstructionDataId"] = volume_id
            run_id = astra.algorithm.create(config)
            made.append((astra.algorithm, run_id))
            astra.algorithm.run(run_id)
        except Exception as error:  # ASTRA raises bare Exceptions
            raise EngineFailedError(f"ASTRA failed in {algorithm}: {error}") from error
        finally:
            for home, number in reversed(made):
                home.delete(number)

    def forward(self, state: np.ndarray, views: Sequence[int]) -> np.ndarray:
        shape = (self.matrices.n_v, len(views), self.matrices.n_u)
        lines = np.full(shape, np.nan, dtype=np.float32)  # a view that ASTRA leaves out shows as NaN
        self._run("FP3D_CUDA", state, lines, views)
        images = lines.transpose(1, 0, 2)
        return require_returned(images, (len(views), self.matrices.n_v, self.matrices.n_u), self.name)

    def transpose(self, images: np.ndarray, views: Sequence[int]) -> np.ndarray:
        images = require_images(images, views, self.matrices)
        volume = np.full(self.grid.shape, np.nan, dtype=np.float32)
        self._run("BP3D_CUDA", volume, np.ascontiguousarray(images.transpose(1, 0, 2)), views)
        return require_returned(volume, self.grid.shape, self.name)

    def back(
        self,
        images: np.ndarray,
        views: Sequence[int],
        *,
        into: np.ndarray,
        weight: Weight = "mean",
        scale: float = 1.0,
        nonnegative: bool = False,
    ) -> None:
        if weight not in self.limits.weights:
            raise InputError(f"engine astra has the weight 'mean' only; {weight!r} was asked for")
        total = self.transpose(images, views)
        share = self.transpose(np.ones_like(images, dtype=np.float32), views)
        seen = share > 1e-6 * share.max()
        into[seen] += np.float32(scale) * total[seen] / share[seen]
        hold_to(into, self._support, nonnegative=nonnegative)

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        return view_lengths(self.matrices, self.grid, views)


def availability() -> Availability:
    """Whether ASTRA is installed and sees a CUDA GPU."""
    try:
        import astra
    except ImportError as error:
        return Availability(name="astra", available=False, reason=f"not installed ({error})", install_line=INSTALL)
    if not astra.use_cuda():
        return Availability(
            name="astra",
            available=False,
            reason=f"ASTRA {astra.__version__} is installed but finds no CUDA GPU; its CPU builds have no cone beam",
            install_line="install a CUDA driver, or use engine cpu",
        )
    return Availability(name="astra", available=True, reason=f"ASTRA {astra.__version__} with CUDA")
