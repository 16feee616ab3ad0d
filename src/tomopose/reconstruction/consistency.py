"""Do the images belong to the matrices?  A coarse reconstruction under several readings of the images answers first.

Each reading (as given, rows flipped, columns mirrored ...) is reconstructed from a few binned views and reprojected.
The reading that the data contradict least is the right one; where several do equally well the object or the path is too
symmetric to decide, and nothing is claimed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tomopose.engines import make_engine
from tomopose.engines.protocol import Engine
from tomopose.errors import EngineFailedError, InputError
from tomopose.reconstruction.line_integrals import LineIntegrals
from tomopose.trajectory.view_order import view_order
from tomopose.volume import VoxelGrid

VIEWS, PIXELS, VOXELS, SWEEPS = 60, 96, 56, 2
"""The coarse reconstruction: views, detector pixels and voxels along the longest edge, sweeps over the views."""
CLEARLY = 1.5
"""A reading counts as better where it leaves a residual smaller by this factor."""
RIGHT = 0.3
"""Share of the signal that the coarse views may leave unexplained under a reading that is offered as the remedy: right
readings of sharp parts leave 0.05 to 0.2, wrong ones 0.5 and more."""

READINGS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "as given": (lambda p: p, ""),
    "rows flipped": (
        lambda p: p[:, ::-1],
        'row 0 of the images is the top; flip them (image[::-1]) or open them with image_rows="top-first"',
    ),
    "columns mirrored": (lambda p: p[:, :, ::-1], "mirror the images (image[:, ::-1])"),
    "turned by 180 degrees": (lambda p: p[:, ::-1, ::-1], "turn the images (image[::-1, ::-1])"),
    "rows and columns exchanged": (lambda p: p.transpose(0, 2, 1), "transpose the images (image.T)"),
    "views in reverse order": (lambda p: p[::-1], "reverse the images or the matrices"),
}


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """residual: relative rms residual of each reading; best: the reading with the smallest; views: how many were used.

    contradicted: whether another reading does clearly better than "as given", and leaves a residual that is right.
    """

    residual: dict[str, float]
    best: str
    views: int
    contradicted: bool

    @property
    def doubtful(self) -> bool:
        """Whether no reading that was tried is right."""
        return min(self.residual.values()) > RIGHT

    @property
    def message(self) -> str:
        """One sentence for a person."""
        given = self.residual["as given"]
        if self.contradicted:
            return (
                f"the images contradict the matrices: {self.best}. Read so, {self.views} coarse views leave "
                f"{100 * self.residual[self.best]:.1f} % of the signal unexplained; as given they leave "
                f"{100 * given:.1f} %. Remedy: {READINGS[self.best][1]}"
            )
        said = f"as given, {self.views} coarse views leave {100 * given:.1f} % of the signal unexplained"
        if given <= RIGHT:
            return said
        others = ", ".join(f"{name} {100 * left:.0f} %" for name, left in self.residual.items() if name != "as given")
        return f"{said}, and no other reading of the images that was tried is right ({others})"


def check_consistency(
    scan: LineIntegrals, grid: VoxelGrid, *, engine: str = "cpu", options: Mapping[str, object] | None = None
) -> Consistency:
    """Compare the readings of the images on a coarse grid, with the engine that reconstructs and its options.

    Raises EngineFailedError where a residual is not a number.
    """
    matrices = scan.matrices
    chosen = np.unique(np.linspace(0, len(scan) - 1, min(VIEWS, len(scan))).round().astype(int))
    factor = max(1, max(matrices.n_u, matrices.n_v) // PIXELS)
    coarse = matrices.select(chosen.tolist()).binned(factor)
    images = np.stack([binned(scan[int(j)], factor) for j in chosen])
    spacing = float((grid.spacing * np.array(grid.n_xyz)).max()) / VOXELS
    shape = [max(1, round(n * s / spacing)) for n, s in zip(grid.shape, grid.spacing[::-1], strict=True)]
    coarse_grid = replace(grid, shape=(shape[0], shape[1], shape[2]), spacing=np.array([spacing] * 3))
    residual = {}
    for name, (read, _) in READINGS.items():
        seen = read(images)
        if seen.shape == images.shape:
            residual[name] = coarse_residual(seen, make_engine(engine, coarse, coarse_grid, **dict(options or {})))
    broken = [name for name, left in residual.items() if not np.isfinite(left)]
    if broken:
        raise EngineFailedError(
            f"the coarse reconstruction by engine {engine} leaves a residual that is not a number (images read "
            f"{broken[0]})"
        )
    best = min(residual, key=lambda name: residual[name])
    return Consistency(
        residual=residual,
        best=best,
        views=len(chosen),
        contradicted=residual["as given"] > CLEARLY * residual[best] and residual[best] <= RIGHT,
    )


def require_consistent(
    scan: LineIntegrals, grid: VoxelGrid, *, engine: str, options: Mapping[str, object]
) -> Consistency:
    """The comparison; InputError, saying which, where another reading of the images does clearly better."""
    result = check_consistency(scan, grid, engine=engine, options=options)
    if result.contradicted:
        raise InputError(result.message)
    return result


def binned(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over factor x factor pixels; rows and columns that fill no whole bin are dropped at the high end."""
    n_v, n_u = image.shape[0] // factor, image.shape[1] // factor
    cut = image[: n_v * factor, : n_u * factor]
    return np.asarray(cut.reshape(n_v, factor, n_u, factor).mean(axis=(1, 3)), dtype=np.float32)


def coarse_residual(images: np.ndarray, engine: Engine) -> float:
    """Relative rms residual of a few sweeps of SART with relaxation 1."""
    x = engine.empty()
    shortest = 2 * float(engine.grid.spacing[0])
    order = view_order(len(images))
    for _ in range(SWEEPS):
        for j in order:
            length = engine.lengths([j])
            with np.errstate(divide="ignore"):
                inverse = np.where(length > shortest, 1 / length, 0)
            residual = (images[[j]] - engine.forward(x, [j])) * inverse
            engine.back(residual, [j], into=x, weight="mean", nonnegative=True)
    views = list(range(len(images)))
    # Rays beside the grid see matter that no voxel can hold; they say nothing about the geometry.
    inside = engine.lengths(views) > shortest
    difference = np.where(inside, images - engine.forward(x, views), 0)
    size = float((np.where(inside, images, 0).astype(np.float64) ** 2).sum())
    return float(np.sqrt((difference.astype(np.float64) ** 2).sum() / size)) if size > 0 else 0.0
