"""The truth for the other engines: plain numpy in float64, slow, small volumes only.

It shares no code with the CPU kernels.  Rays come from source and panel vectors, not from inverted matrices.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.engines.protocol import (
    Availability,
    Limits,
    Weight,
    hold_to,
    require_images,
    require_support,
    require_views,
    view_lengths,
)
from tomopose.geometry.projection import ProjectionMatrices, project
from tomopose.volume import VoxelGrid


class ReferenceEngine:
    """Joseph's projector and bilinear voxel-driven back-projection, written as their definitions."""

    name = "reference"
    limits = Limits(weights=("sum", "mean", "inverse-square"), exact_transpose=True, most_voxels=256**3, device="cpu")

    def __init__(self, matrices: ProjectionMatrices, grid: VoxelGrid, *, support: np.ndarray | None = None) -> None:
        self.matrices, self.grid = matrices, grid
        self._support = require_support(support, grid)
        self._rays = matrices.decompose()

    def empty(self) -> np.ndarray:
        return np.zeros(self.grid.shape)

    def put(self, values: np.ndarray) -> np.ndarray:
        return np.array(values, dtype=np.float64).reshape(self.grid.shape)

    def values(self, state: np.ndarray) -> np.ndarray:
        return state.astype(np.float32)

    def _samples(self, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For every ray (pixel, flat) of view j: voxel indices (ray, plane, 4), their weights, and the step in mm."""
        n_u, n_v = self.matrices.n_u, self.matrices.n_v
        rays = self._rays
        u, v = np.meshgrid(np.arange(n_u) - (n_u - 1) / 2, np.arange(n_v) - (n_v - 1) / 2)
        pixel = rays.centre[j] + u[..., None] * rays.U[j] + v[..., None] * rays.V[j]
        n = np.array(self.grid.n_xyz)
        source = (rays.source[j] - self.grid.origin) / self.grid.spacing
        d = ((pixel - rays.source[j]) / self.grid.spacing).reshape(-1, 3)
        axis = np.abs(d).argmax(axis=1)
        steepest = np.take_along_axis(d, axis[:, None], axis=1)
        step = np.linalg.norm(d * self.grid.spacing, axis=1) / np.abs(steepest[:, 0])
        k = np.arange(n.max())
        t = (k - source[axis][:, None]) / steepest
        place = source + t[..., None] * d[:, None, :]
        on_plane = np.arange(3) == axis[:, None, None]
        place = np.where(on_plane, k[:, None], place)
        used = k < n[axis][:, None]
        place = np.clip(np.nan_to_num(place, nan=-1.0), -1.0, n)  # beyond, all weights are 0
        base = np.floor(place).astype(np.int64)
        fraction = place - base
        indices, weights = [], []
        for corner in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)):
            at = base + corner
            inside = ((at >= 0) & (at < n)).all(axis=-1) & used
            weight = np.prod(np.where(np.array(corner) == 1, fraction, 1 - fraction), axis=-1)
            at = np.clip(at, 0, n - 1)
            indices.append(np.ravel_multi_index((at[..., 2], at[..., 1], at[..., 0]), self.grid.shape))
            weights.append(np.where(inside, weight, 0.0))
        return np.stack(indices, axis=-1), np.stack(weights, axis=-1), step

    def forward(self, state: np.ndarray, views: Sequence[int]) -> np.ndarray:
        require_views(views, len(self.matrices))
        images = np.empty((len(views), self.matrices.n_v, self.matrices.n_u), dtype=np.float32)
        for image, j in zip(images, views, strict=True):
            index, weight, step = self._samples(j)
            image[:] = ((state.ravel()[index] * weight).sum(axis=(1, 2)) * step).reshape(image.shape)
        return images

    def transpose(self, images: np.ndarray, views: Sequence[int]) -> np.ndarray:
        images = require_images(images, views, self.matrices)
        total = np.zeros(self.grid.size)
        for image, j in zip(images, views, strict=True):
            index, weight, step = self._samples(j)
            share = weight * (image.reshape(-1).astype(np.float64) * step)[:, None, None]
            total += np.bincount(index.ravel(), weights=share.ravel(), minlength=self.grid.size)
        return total.reshape(self.grid.shape)

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
        n_u, n_v = self.matrices.n_u, self.matrices.n_v
        points = self.grid.points(np.stack(np.meshgrid(*map(np.arange, self.grid.shape), indexing="ij"), axis=-1))
        x = points.reshape(-1, 3)
        total, count = np.zeros(len(x)), np.zeros(len(x))
        for image, j in zip(images, views, strict=True):
            P = self.matrices.P[j]
            uv = project(P, x)
            w = x @ P[2, :3] + P[2, 3]
            seen = (uv > -1).all(axis=1) & (uv[:, 0] < n_u) & (uv[:, 1] < n_v)
            u, v = (np.clip(np.where(seen, uv[:, i], 0), 0, n - 1) for i, n in enumerate((n_u, n_v)))
            i, k = np.minimum(u.astype(int), max(n_u - 2, 0)), np.minimum(v.astype(int), max(n_v - 2, 0))
            f_u, f_v = u - i, v - k
            i_1, k_1 = np.minimum(i + 1, n_u - 1), np.minimum(k + 1, n_v - 1)
            value = (1 - f_v) * ((1 - f_u) * image[k, i] + f_u * image[k, i_1]) + f_v * (
                (1 - f_u) * image[k_1, i] + f_u * image[k_1, i_1]
            )
            total += np.where(seen, value / w**2 if weight == "inverse-square" else value, 0.0)
            count += seen
        if weight == "mean":
            total /= np.maximum(count, 1)
        into += scale * total.reshape(self.grid.shape)
        hold_to(into, self._support, nonnegative=nonnegative)

    def lengths(self, views: Sequence[int]) -> np.ndarray:
        return view_lengths(self.matrices, self.grid, views)


def availability() -> Availability:
    """The reference engine needs numpy only."""
    return Availability(name="reference", available=True, reason="plain numpy, for checks of small volumes")
