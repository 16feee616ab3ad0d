"""What every reconstruction engine can do, in the engine's own form of a volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import EngineFailedError, InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array
from tomopose.volume import VoxelGrid

Weight = Literal["sum", "mean", "inverse-square"]
"""Of back-projection: the sum of the views' look-ups; their mean over the views that see a voxel (what SART adds); or
their sum, each divided by the square of the voxel's depth w in mm (what FDK adds)."""

State = Any
"""A volume in the form that suits the engine; `values` and `put` convert it."""


@dataclass(frozen=True, kw_only=True)
class Availability:
    """Whether an engine can run here; where not, why, and the line that installs what is missing."""

    name: str
    available: bool
    reason: str
    install_line: str = ""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an engine can do.

    weights:        the back-projection weights it has.
    exact_transpose: whether <A x, y> = <x, A' y> holds to rounding between `forward` and `transpose`.
    most_voxels:    largest volume in one piece.
    device:         "cpu" or "cuda".
    """

    weights: tuple[Weight, ...]
    exact_transpose: bool
    most_voxels: int
    device: str


class Engine(Protocol):
    """Forward and back-projection for one scan and one grid.

    Images are (m, n_v, n_u) float32, image[v, u], one for each index in `views`; line integrals in the unit of the
    volume times mm.  An engine is made by `make_engine(name, matrices, grid)`; with `support` (bool [z, y, x]) its
    back-projections leave every voxel outside at zero.
    """

    name: str
    limits: Limits
    grid: VoxelGrid

    def empty(self) -> State:
        """A volume of zeros."""

    def put(self, values: np.ndarray) -> State:
        """A volume from an array [z, y, x]."""

    def values(self, state: State) -> np.ndarray:
        """The volume as float32 [z, y, x]; a view of the state where the engine can give one."""

    def forward(self, state: State, views: Sequence[int]) -> np.ndarray:
        """Line integrals (m, n_v, n_u) of the volume: A x."""

    def back(
        self,
        images: np.ndarray,
        views: Sequence[int],
        *,
        into: State,
        weight: Weight = "sum",
        scale: float = 1.0,
        nonnegative: bool = False,
    ) -> None:
        """Add scale times the voxel-driven back-projection of images to `into`; with `nonnegative` cut it at 0 then."""

    def transpose(self, images: np.ndarray, views: Sequence[int]) -> State:
        """A' y, the transpose of `forward`: exact where `limits` says so."""

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        """(m, n_v, n_u), mm: the length of each pixel's ray inside the grid's box: A 1 to within half a voxel."""


def require_images(images: ArrayLike, views: Sequence[int], matrices: ProjectionMatrices) -> np.ndarray:
    """The images as float32 (m, n_v, n_u), one for each view."""
    images = np.asarray(images, dtype=np.float32)
    shape = (len(views), matrices.n_v, matrices.n_u)
    if images.shape != shape:
        raise InputError(f"images are {images.shape}; {shape} (views, n_v, n_u) are needed")
    require_views(views, len(matrices))
    result: np.ndarray = images
    return result


def require_support(support: object, grid: VoxelGrid) -> np.ndarray | None:
    """The support mask as bool [z, y, x]."""
    if support is None:
        return None
    support = np.asarray(support)
    if support.shape != grid.shape or support.dtype != np.bool_:
        raise InputError(f"the support is {support.dtype} {support.shape}; bool {grid.shape} (z, y, x) is needed")
    result: np.ndarray | None = support
    return result


def require_views(views: Sequence[int], n: int) -> None:
    """InputError where a view does not exist."""
    bad = [j for j in views if not 0 <= j < n]
    if bad:
        raise InputError(f"view {bad[0]} does not exist; the scan has views 0 to {n - 1}")


def require_returned(images: np.ndarray, expected: tuple[int, ...], engine: str) -> np.ndarray:
    """What an engine gave back, if it has the shape asked for and holds finite numbers only."""
    if images.shape != expected:
        raise EngineFailedError(f"engine {engine} returned {images.shape} where {expected} was asked for")
    if not np.isfinite(images).all():
        raise EngineFailedError(f"engine {engine} returned {np.count_nonzero(~np.isfinite(images))} values not finite")
    return images


def hold_to(volume: np.ndarray, support: np.ndarray | None, *, nonnegative: bool) -> None:
    """In place: zero outside the support, and nothing below zero where that is asked for."""
    if support is not None:
        volume[~support] = 0.0
    if nonnegative:
        np.maximum(volume, 0, out=volume)


def view_lengths(matrices: ProjectionMatrices, grid: VoxelGrid, views: Sequence[int]) -> np.ndarray:
    """(m, n_v, n_u) float32, mm: lengths of the rays of some views inside the grid's box."""
    require_views(views, len(matrices))
    size = matrices.n_u, matrices.n_v
    return np.stack([box_lengths(matrices.P[j], grid, *size) for j in views]).astype(np.float32)


def box_lengths(P: Array, grid: VoxelGrid, n_u: int, n_v: int) -> np.ndarray:
    """(n_v, n_u), mm: lengths of the rays of one matrix (3, 4) inside the grid's box, plainly."""
    M_inv = np.linalg.inv(P[:, :3])
    source = -M_inv @ P[:, 3]
    u, v = np.meshgrid(np.arange(n_u), np.arange(n_v))
    d = np.stack([u, v, np.ones_like(u)], axis=-1) @ M_inv.T
    low, high = grid.corners.min(axis=0), grid.corners.max(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([(low - source) / d, (high - source) / d])
    inside = (source > low) & (source < high)
    enter = np.where(d == 0, np.where(inside, -np.inf, np.inf), t.min(axis=0)).max(axis=-1)
    leave = np.where(d == 0, np.where(inside, np.inf, -np.inf), t.max(axis=0)).min(axis=-1)
    result: np.ndarray = np.maximum(leave - np.maximum(enter, 0), 0) * np.linalg.norm(d, axis=-1)
    return result
