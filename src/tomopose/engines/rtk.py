"""itk-rtk (Apache-2.0, optional): an independent CPU implementation, for comparison.

RTK turns its gantry about its y axis: x_R = (y_W, z_W, x_W).  It works in detector millimetres and wants |m3| = 1.
In RTK a ray ends at the centres of the outermost voxels, here at their faces.  `AddProjection` answers False, with a
warning only, where it refuses a matrix; that answer is checked, as are the numbers of views that go in and come out.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from tomopose.engines.protocol import (
    Availability,
    Limits,
    Weight,
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

INSTALL = "pip install 'tomopose[recon]'"
R_RTK = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""W to RTK's axes."""


def rtk_matrices(matrices: ProjectionMatrices) -> Array:
    """(n, 3, 4): RTK's axes, mm, to detector mm about the panel's middle."""
    o_u, o_v = panel_origin(matrices)
    A = np.array([[matrices.p_u, 0, o_u], [0, matrices.p_v, o_v], [0, 0, 1.0]])
    turn = np.eye(4)
    turn[:3, :3] = R_RTK
    return A @ matrices.P @ turn.T


def panel_origin(matrices: ProjectionMatrices) -> tuple[float, float]:
    """Place of pixel (0, 0) in RTK's detector coordinates, mm."""
    return -(matrices.n_u - 1) / 2 * matrices.p_u, -(matrices.n_v - 1) / 2 * matrices.p_v


def load_itk() -> tuple[Any, Any]:
    """The modules itk and itk.RTK.

    SWIG's types raise a DeprecationWarning while they are made, and where warnings are errors that ends the process.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import itk
        from itk import RTK

        itk.imread, itk.imwrite, RTK.ThreeDCircularProjectionGeometry  # noqa: B018  (itk loads on first use)
    return itk, RTK


def rtk_geometry(matrices: ProjectionMatrices, views: Sequence[int]) -> Any:
    """RTK's geometry object of those views; EngineFailedError names a view that RTK refuses."""
    itk, RTK = load_itk()
    require_views(views, len(matrices))
    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    M = rtk_matrices(matrices)
    for j in views:
        matrix = itk.Matrix[itk.D, 3, 4](itk.vnl_matrix_from_array(np.ascontiguousarray(M[j])))
        if geometry.AddProjection(matrix) is False:
            raise EngineFailedError(f"RTK refuses the matrix of view {j}")
    found = len(geometry.GetGantryAngles())
    if found != len(views):
        raise EngineFailedError(f"RTK holds {found} of {len(views)} views")
    return geometry


class RtkEngine:
    """Joseph's forward projection and voxel-driven back-projection of itk-rtk.  A volume is [x, z, y], RTK's order."""

    name = "rtk"
    limits = Limits(
        weights=("sum", "mean", "inverse-square"), exact_transpose=True, most_voxels=2**31 - 1, device="cpu"
    )

    def __init__(self, matrices: ProjectionMatrices, grid: VoxelGrid, *, support: np.ndarray | None = None) -> None:
        self._itk, self._rtk = load_itk()
        self._kind = self._itk.Image[self._itk.F, 3]
        self.matrices, self.grid = matrices, grid
        self._support = require_support(support, grid)
        self._distance = matrices.decompose().d_SD

    def empty(self) -> np.ndarray:
        n_z, n_y, n_x = self.grid.shape
        return np.zeros((n_x, n_z, n_y), dtype=np.float32)

    def put(self, values: np.ndarray) -> np.ndarray:
        return np.array(np.asarray(values, dtype=np.float32).transpose(2, 0, 1), order="C")

    def values(self, state: np.ndarray) -> np.ndarray:
        return state.transpose(1, 2, 0)

    # An ITK view does not keep its array alive: callers hold the array until the filter has run.

    def volume_image(self, state: np.ndarray) -> Any:
        """An ITK image on the memory of a volume."""
        image = self._itk.image_view_from_array(state)
        image.SetOrigin([float(x) for x in R_RTK @ self.grid.origin])
        image.SetSpacing([float(x) for x in R_RTK @ self.grid.spacing])
        return image

    def stack_image(self, images: np.ndarray) -> Any:
        """An ITK image on the memory of contiguous float32 projections (m, n_v, n_u)."""
        image = self._itk.image_view_from_array(images)
        image.SetOrigin([*panel_origin(self.matrices), 0.0])
        image.SetSpacing([self.matrices.p_u, self.matrices.p_v, 1.0])
        return image

    def run(self, kind: str, *, volume: np.ndarray, images: np.ndarray, views: Sequence[int], back: bool) -> np.ndarray:
        """Output of RTK's filter `kind` from a volume and images; back-projectors take the volume first."""
        images = np.ascontiguousarray(images, dtype=np.float32)
        filters = getattr(self._rtk, kind)[self._kind, self._kind]
        try:
            filtered = filters.New()
            filtered.SetInput(0 if back else 1, self.volume_image(volume))
            filtered.SetInput(1 if back else 0, self.stack_image(images))
            filtered.SetGeometry(rtk_geometry(self.matrices, views))
            filtered.Update()
        except RuntimeError as error:
            raise EngineFailedError(f"RTK failed in {kind}: {str(error).strip().splitlines()[-1]}") from error
        return np.asarray(self._itk.array_from_image(filtered.GetOutput()))

    def forward(self, state: np.ndarray, views: Sequence[int]) -> np.ndarray:
        shape = (len(views), self.matrices.n_v, self.matrices.n_u)
        images = self.run(
            "JosephForwardProjectionImageFilter", volume=state, images=np.zeros(shape), views=views, back=False
        )
        return require_returned(images, shape, self.name)

    def transpose(self, images: np.ndarray, views: Sequence[int]) -> np.ndarray:
        images = require_images(images, views, self.matrices)
        volume = self.run("JosephBackProjectionImageFilter", volume=self.empty(), images=images, views=views, back=True)
        return require_returned(volume, self.empty().shape, self.name)

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
        total = self._look_up(images, views, inverse_square=weight == "inverse-square")
        if weight == "mean":
            total /= np.maximum(self._look_up(np.ones_like(images), views, inverse_square=False), 1e-6)
        into += np.float32(scale) * total
        if self._support is not None:
            self.values(into)[~self._support] = 0.0
        if nonnegative:
            np.maximum(into, 0, out=into)

    def _look_up(self, images: np.ndarray, views: Sequence[int], *, inverse_square: bool) -> np.ndarray:
        """Sum of the views' bilinear look-ups, or of those over w^2.

        RTK's FDK filter weights each view by (SID / depth)^2 of its own geometry; dividing by SID^2 leaves 1/w^2.
        """
        kind = "BackProjectionImageFilter"
        if inverse_square:
            kind = "FDKBackProjectionImageFilter"
            geometry = rtk_geometry(self.matrices, views)
            square = np.array(geometry.GetSourceToIsocenterDistances()) ** 2
            images = images / square[:, None, None].astype(np.float32)
        volume = self.run(kind, volume=self.empty(), images=images, views=views, back=True)
        return require_returned(volume, self.empty().shape, self.name)

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        return view_lengths(self.matrices, self.grid, views)


def availability() -> Availability:
    """Whether itk-rtk is installed."""
    import importlib.metadata

    try:
        version = importlib.metadata.version("itk-rtk")
    except importlib.metadata.PackageNotFoundError:
        return Availability(name="rtk", available=False, reason="itk-rtk is not installed", install_line=INSTALL)
    return Availability(name="rtk", available=True, reason=f"itk-rtk {version}")
