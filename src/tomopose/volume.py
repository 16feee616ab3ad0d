"""Voxel grids and volumes.  Only `VoxelGrid` knows that an array is [z, y, x] while a point is (x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.box import BOX_CORNERS
from tomopose.provenance import Provenance
from tomopose.units import Array, float_array
from tomopose.values import value


@value(kw_only=False)
class VoxelGrid:
    """A grid of voxels along the axes of W.

    shape:    (n_z, n_y, n_x), the shape of the array.
    spacing:  (x, y, z) distance of neighbouring voxel centres, mm; one number serves all three.
    centre:   (x, y, z) of the middle of the grid in W, mm; the W origin unless given.

    Voxel (iz, iy, ix) has its centre at centre + spacing * ((ix, iy, iz) - (n - 1) / 2): every index grows with its
    coordinate.
    """

    shape: tuple[int, int, int]
    spacing: Any
    centre: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        shape = tuple(self.shape)
        if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
            raise ShapeError(f"a voxel grid has three positive whole numbers (n_z, n_y, n_x); got {self.shape!r}")
        spacing = np.broadcast_to(np.asarray(self.spacing, dtype=np.float64), (3,))
        if not (np.isfinite(spacing).all() and (spacing > 0).all()):
            raise InputError(f"voxel spacing is {spacing.tolist()} mm; three positive lengths are needed")
        centre = np.asarray(self.centre, dtype=np.float64)
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise InputError(f"the centre of the grid is {self.centre!r}; three finite coordinates in mm are needed")
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))
        object.__setattr__(self, "spacing", float_array(spacing))
        object.__setattr__(self, "centre", float_array(centre))

    @classmethod
    def cube(cls, *, n: int = 512, spacing: float = 0.1) -> VoxelGrid:
        """n x n x n voxels of `spacing` mm about the W origin."""
        return cls(shape=(n, n, n), spacing=float_array([spacing] * 3))

    @property
    def n_xyz(self) -> tuple[int, int, int]:
        """(n_x, n_y, n_z)."""
        return self.shape[2], self.shape[1], self.shape[0]

    @property
    def origin(self) -> Array:
        """Centre of voxel (0, 0, 0) in W, mm, (x, y, z)."""
        result: Array = self.centre - self.spacing * (np.array(self.n_xyz) - 1) / 2
        return result

    @property
    def size(self) -> int:
        """Number of voxels."""
        return math.prod(self.shape)

    @property
    def corners(self) -> Array:
        """The eight outer corners of the grid's box (8, 3), mm in W: half a voxel beyond the outermost centres."""
        half = self.spacing * np.array(self.n_xyz) / 2
        corners: Array = self.centre + BOX_CORNERS * half
        return corners

    @property
    def index_to_W(self) -> Array:
        """(4, 4): takes the homogeneous index (ix, iy, iz, 1) to (x, y, z, 1), mm in W."""
        matrix = np.diag([*self.spacing, 1.0])
        matrix[:3, 3] = self.origin
        return matrix

    def points(self, index: ArrayLike) -> Array:
        """Centres (..., 3), mm in W, of voxels given by array indices (..., 3) as (iz, iy, ix); fractions allowed."""
        result: Array = self.origin + self.spacing * np.asarray(index, dtype=np.float64)[..., ::-1]
        return result

    def indices(self, x_W: ArrayLike) -> Array:
        """Fractional array indices (..., 3), (iz, iy, ix), of points (..., 3) in W, mm."""
        result: Array = ((np.asarray(x_W, dtype=np.float64) - self.origin) / self.spacing)[..., ::-1]
        return result

    def same_as(self, other: VoxelGrid) -> bool:
        """Whether both hold the same voxels, to a thousandth of one."""
        near = 1e-3 * np.asarray(self.spacing)
        apart = np.abs(self.corners - other.corners)
        return self.shape == other.shape and bool((apart <= near).all())

    def slab(self, z_0: int, z_1: int) -> VoxelGrid:
        """The part of the grid with z_0 <= iz < z_1."""
        if not 0 <= z_0 < z_1 <= self.shape[0]:
            raise InputError(f"slab {z_0} to {z_1} does not lie within the {self.shape[0]} layers of the grid")
        low = self.origin[2] + z_0 * self.spacing[2]
        centre = np.array([self.centre[0], self.centre[1], low + (z_1 - z_0 - 1) / 2 * self.spacing[2]])
        return replace(self, shape=(z_1 - z_0, *self.shape[1:]), centre=centre)


@value(kw_only=False)
class Volume:
    """A reconstructed volume in frame W.

    values:         [z, y, x] float32, attenuation in 1/mm where the images were line integrals of it.
    grid:           where the voxels lie.
    view_residual:  (n,) rms over the detector of measured minus reprojected line integral, per view, in the images'
                    order; divided by the rms of the measured ones.  None where no reprojection was made.
    contradicted:   indices of views whose residual is absurd: the volume does not explain them.
    notes:          what a reader has to know: the algorithm chosen and why, short scan, truncation, suspicious views.
    settings:       how it was made.
    """

    values: np.ndarray
    grid: VoxelGrid
    view_residual: Array | None = None
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance | None = None
    contradicted: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.values.shape != self.grid.shape:
            raise ShapeError(f"values are {self.values.shape}; the grid is (n_z, n_y, n_x) = {self.grid.shape}")
        if self.values.dtype != np.float32:
            raise ShapeError(f"values are {self.values.dtype}; a volume is float32")
        if self.view_residual is not None:
            object.__setattr__(self, "view_residual", float_array(self.view_residual))
        object.__setattr__(self, "contradicted", tuple(int(j) for j in self.contradicted))
        object.__setattr__(self, "notes", tuple(self.notes))
        object.__setattr__(self, "settings", dict(self.settings))

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return self.values.astype(dtype or self.values.dtype, copy=bool(copy))

    @property
    def trustworthy(self) -> bool:
        """Whether the volume contradicts none of the views that it was made from."""
        return not self.contradicted

    def slices(self, at: Sequence[int] | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Three orthogonal slices through voxel `at` (iz, iy, ix), the middle unless given: [y, x], [z, x], [z, y]."""
        iz, iy, ix = (n // 2 for n in self.grid.shape) if at is None else (int(i) for i in at)
        if not all(0 <= i < n for i, n in zip((iz, iy, ix), self.grid.shape, strict=True)):
            raise InputError(f"voxel {(iz, iy, ix)} lies outside the grid {self.grid.shape}")
        return np.array(self.values[iz]), np.array(self.values[:, iy]), np.array(self.values[:, :, ix])

    def maximum_projection(self, axis: str = "y") -> np.ndarray:
        """Largest value along a W axis: [y, x] along z, [z, x] along y, [z, y] along x."""
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis is {axis!r}; 'x', 'y' or 'z' is needed")
        return np.array(self.values.max(axis="zyx".index(axis)))
