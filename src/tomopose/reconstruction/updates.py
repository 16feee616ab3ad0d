r"""SART and ordered subsets, the FDK sum, and CGLS, over a volume that may lie anywhere.

SART (Andersen and Kak, Ultrasonic Imaging 6 (1984) 81), for one subset S of views:

    x <- x + lambda  mean_{j in S sees x}  [ (p_j - A_j x) / (A_j 1) ] looked up where x falls in view j

A is Joseph's projector; the look-up is voxel-driven and bilinear, normalised by its own column sums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from tomopose.engines.geometry import per_length
from tomopose.reconstruction.checkpoint import Checkpoint
from tomopose.reconstruction.fdk.filter import FdkFilter
from tomopose.reconstruction.field import Adding, Field
from tomopose.reconstruction.line_integrals import LineIntegrals

if TYPE_CHECKING:
    from tomopose.engines.protocol import Engine

Subset = tuple[int, ...]
View = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Line integrals, bad pixels, and what fills those in the line integrals' residual."""
Update = Callable[[Subset, list[Any]], None]


def read_ahead(scan: LineIntegrals, subsets: Sequence[Subset]) -> Iterator[tuple[Subset, list[Any]]]:
    """Each subset with its views (p, bad, fill), the next one read while this one is worked on.

    At most two subsets are in memory.  p is laid out with v contiguous, as the CPU engine wants it.
    """

    def read(subset: Subset) -> list[Any]:
        return [(np.asfortranarray(p), bad, fill) for p, bad, fill in (scan.view(j) for j in subset)]

    with ThreadPoolExecutor(1, thread_name_prefix="tomopose-read") as reader:
        coming = reader.submit(read, subsets[0]) if subsets else None
        for k, subset in enumerate(subsets):
            assert coming is not None
            now = coming.result()
            coming = reader.submit(read, subsets[k + 1]) if k + 1 < len(subsets) else None
            yield subset, now


def stacked(images: Iterable[np.ndarray]) -> np.ndarray:
    """(m, n_v, n_u) of images, with v contiguous."""
    return np.stack([image.T for image in images]).transpose(0, 2, 1)


def sart_update(field: Field, *, relaxation: float, nonnegative: bool) -> Update:
    """One SART step with a subset."""

    def update(subset: Subset, views: list[View]) -> None:
        residual = stacked(p for p, _, _ in views)
        residual -= field.forward(subset)
        residual *= per_length(field.lengths(subset), field.grid).astype(np.float32)
        for image, (_, bad, fill) in zip(residual, views, strict=True):
            if fill.shape[0]:
                image[bad] = fill @ np.where(bad, 0, image).ravel()
        field.back(residual, subset, Adding(weight="mean", scale=relaxation, nonnegative=nonnegative))

    return update


def fdk_update(field: Field, filtered: FdkFilter) -> Update:
    """Add the views of a subset to the FDK sum."""
    how = Adding(weight="inverse-square", beyond=filtered.beyond)

    def update(subset: Subset, views: list[View]) -> None:
        images = stacked(filtered(p, j) for j, (p, _, _) in zip(subset, views, strict=True))
        field.back(images, subset, how)

    return update


class Samples:
    """Every stride-th pixel of the measured views, kept for the final comparison."""

    def __init__(self, n: int, stride: int) -> None:
        self.stride = stride
        self.measured: list[np.ndarray | None] = [None] * n

    def keep(self, subset: Subset, views: list[View]) -> None:
        for j, (p, _, _) in zip(subset, views, strict=True):
            if self.measured[j] is None:
                self.measured[j] = np.ascontiguousarray(p[:: self.stride, :: self.stride])

    def view(self, scan: LineIntegrals, j: int) -> np.ndarray:
        kept = self.measured[j]
        return scan[j][:: self.stride, :: self.stride] if kept is None else kept


def run(
    schedule: Sequence[tuple[Update, Sequence[Subset]]],
    field: Field,
    scan: LineIntegrals,
    *,
    samples: Samples,
    checkpoint: Checkpoint | None,
    progress: Callable[[int, int], None] | None,
) -> None:
    """All stages of a schedule, from where a checkpoint says."""
    total = sum(len(subsets) for _, subsets in schedule)
    done = checkpoint.resume(field) if checkpoint else 0
    passed = 0
    for update, subsets in schedule:
        left = subsets[max(0, done - passed) :]
        passed += len(subsets)
        for count, (subset, views) in enumerate(read_ahead(scan, left), start=passed - len(left) + 1):
            update(subset, views)
            samples.keep(subset, views)
            if checkpoint:
                checkpoint.after(field, count)
            if progress:
                progress(count, total)


def cgls(
    engine: Engine,
    scan: LineIntegrals,
    *,
    iterations: int,
    support: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Any:
    """Least squares |p - A x|^2 by conjugate gradients (Hestenes and Stiefel), from zero; A' is the engine's transpose.

    support: bool [z, y, x], the voxels that x may fill.  Holds two volumes, the measured and one reprojected scan in
    memory beside the result.
    """
    views = list(range(len(scan)))
    residual = np.stack([scan[j] for j in views])
    x = engine.empty()

    def transpose() -> Any:
        all_voxels = engine.transpose(residual, views)
        return all_voxels if support is None else engine.put(np.where(support, engine.values(all_voxels), 0))

    gradient = transpose()
    direction = gradient.copy()
    size = float(np.vdot(gradient, gradient))
    for k in range(iterations):
        if size == 0.0:
            break
        projected = engine.forward(direction, views)
        alpha = size / float((projected.astype(np.float64) ** 2).sum())
        x += np.float32(alpha) * direction
        residual -= np.float32(alpha) * projected
        gradient = transpose()
        new = float(np.vdot(gradient, gradient))
        direction *= np.float32(new / size)
        direction += gradient
        size = new
        if progress:
            progress(k + 1, iterations)
    return x
