"""What a reader of a volume has to know: how each view agrees with it, and what the scan could not show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.engines.protocol import view_lengths
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.choice import CUT_ROWS, FEWEST_FOR_FDK, Situation
from tomopose.reconstruction.fdk.redundancy import lines_missing
from tomopose.reconstruction.field import every_nth_pixel
from tomopose.units import Array
from tomopose.volume import VoxelGrid

ABSURD = 0.3
"""Share of a view's signal (rms) that a volume may leave unexplained.  Scans of 16 to 120 views leave 0.02 to 0.28 (see
`FEWEST_FOR_FDK`); images of another object, in another order, 0.3 to 0.6."""
NOTHING = 1.0
"""The share that an empty volume leaves: the limit where the grid does not hold the object."""
OUTSIDE = 0.05
"""Share of a view's signal (squared) beside the grid up to which the grid holds the object."""
FAINT = 0.1
"""Views whose signal is below this share of the median view's are judged by that share."""
SUSPICIOUS = 6.0
"""A view counts as suspicious whose residual lies this many robust standard deviations above the median."""
NAMED = 10
"""Views that a sentence names."""
SAMPLED_VOXELS = 24
"""Voxels along each axis in which the share that views see is counted."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How the views agree with a volume, each (n,): residual, rms of measured minus reprojected over the rms of the
    measured; unexplained, the same without what noise explains, faint views over a tenth of the median view's rms;
    outside, the share of the signal, squared, on rays beside the grid."""

    residual: Array
    unexplained: Array
    outside: Array

    @property
    def contradicted(self) -> tuple[int, ...]:
        """The views whose residual is absurd, or no number."""
        limit = np.where(self.outside <= OUTSIDE, ABSURD, NOTHING)
        return tuple(int(j) for j in np.flatnonzero(~(self.unexplained < limit)))

    @property
    def suspicious(self) -> tuple[int, ...]:
        """The views whose residual is far above the others'."""
        median = float(np.median(self.residual))
        spread = MAD_TO_SIGMA * float(np.median(np.abs(self.residual - median)))
        limit = median + SUSPICIOUS * max(spread, 0.02 * median, 1e-6)
        return tuple(int(j) for j in np.flatnonzero(self.residual > limit))


def noise_of(p: Array) -> float:
    """Standard deviation of the noise of an image, robustly, from second differences along its rows."""
    if p.shape[1] < 3:
        return 0.0
    return MAD_TO_SIGMA * float(np.median(np.abs(p[:, :-2] - 2 * p[:, 1:-1] + p[:, 2:]))) / math.sqrt(6)


def agreement_of(
    measured: Callable[[int], np.ndarray],
    reprojected: Callable[[int], np.ndarray],
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    stride: int,
) -> Agreement:
    """Compare images [::stride, ::stride] of all views; both functions give that of a view."""
    sampled = every_nth_pixel(matrices, stride)
    n = len(matrices)
    size, apart, noise, outside = (np.zeros(n) for _ in range(4))
    for j in range(n):
        p = measured(j).astype(np.float64)
        apart[j] = ((p - reprojected(j)) ** 2).mean()
        size[j] = (p**2).mean()
        noise[j] = noise_of(p) ** 2
        beside = view_lengths(sampled, grid, [j])[0] == 0
        outside[j] = (p[beside] ** 2).sum() / max(float((p**2).sum()), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(size > 0, np.sqrt(apart / size), 0.0)
        # The reprojection has at most as much noise as the image.
        left = np.maximum(apart - 2 * noise, 0.0)
        unexplained = np.sqrt(left / np.maximum(size, max(FAINT**2 * float(np.median(size)), 1e-300)))
    return Agreement(residual=residual, unexplained=unexplained, outside=outside)


def listed(views: tuple[int, ...], matrices: ProjectionMatrices) -> str:
    """Views by number and pose_id."""
    named = ", ".join(f"{j} (pose {matrices.pose_id[j]})" for j in views[:NAMED])
    return named + (f" and {len(views) - NAMED} more" if len(views) > NAMED else "")


def agreement_notes(agreement: Agreement, matrices: ProjectionMatrices) -> list[str]:
    """What the agreement of the views says."""
    contradicted, suspicious = agreement.contradicted, agreement.suspicious
    if contradicted:
        worst = float(np.nan_to_num(agreement.unexplained[list(contradicted)], nan=np.inf).max())
        return [
            f"not trustworthy: the volume contradicts {len(contradicted)} of {len(matrices)} views, of whose signal it "
            f"leaves up to {100 * worst:.0f} % unexplained (limit {100 * ABSURD:.0f} %): views "
            f"{listed(contradicted, matrices)}. Compare their matrices and images: another scan, order, row order or "
            "size does this"
        ]
    if suspicious:
        return [
            f"{len(suspicious)} views disagree with the volume more than the others: views "
            f"{listed(suspicious, matrices)}. Look at their poses and their images"
        ]
    return []


def scan_notes(s: Situation, matrices: ProjectionMatrices, grid: VoxelGrid) -> list[str]:
    """What the scan cannot show, and what that does to the volume."""
    notes = [*few_views(s), *missing_angles(s), *wide_grid(s, matrices, grid)]
    if max(s.cut_low, s.cut_high) > 0 and not s.displaced:
        share = max(s.cut_low, s.cut_high)
        what = "densities rise towards the rim of the field of view, and are too high there"
        notes.append(
            f"the object reaches beyond the panel in {100 * share:.0f} % of the grid's rows"
            + (f": {what}" if share > CUT_ROWS else f"; in those, {what}")
        )
    return notes


def few_views(s: Situation) -> list[str]:
    """A handful of views determines no density."""
    if s.n == 1:
        return [
            "1 view: only the sum along each ray is known. The volume spreads it evenly from the source to the panel; "
            "depth and density are not determined"
        ]
    if s.n == 2:
        return [
            "2 views: the volume is one of many that explain both. Matter is smeared along the rays of either view, "
            "and densities are far too low; shapes across the rays of both are not determined"
        ]
    if s.n < FEWEST_FOR_FDK:
        return [
            f"{s.n} views: the volume is one of many that explain them. Parts are smeared along the rays, with streaks "
            "about them, and densities are too low, the more so the smaller the part (by 30 % for 12 views, 60 % for "
            "4, where parts are a fifth of the field wide)"
        ]
    return []


def missing_angles(s: Situation) -> list[str]:
    """Stretches of the turn without views."""
    if s.path is None or s.path.full_turn:
        return []
    covered = math.degrees(s.path.coverage)
    stretches = ", ".join(f"{math.degrees(size):.0f}" for size in s.path.holes[:, 1])
    said = f"short scan: the source covers {covered:.0f} of 360 degrees about the object (without views: {stretches})"
    if len(s.path.holes) == 1 and not lines_missing(s.path, s.needed):
        return [f"{said}. Every line in the plane of the path is measured; noise is uneven"]
    return [
        f"{said}. Missing angles: surfaces that lie along the missing rays are blurred, densities beside them are off, "
        "and streaks run along the rays at the ends of the stretches; no algorithm restores what no view shows"
    ]


def wide_grid(s: Situation, matrices: ProjectionMatrices, grid: VoxelGrid) -> list[str]:
    """The part of the grid that views do not see."""
    axes = [np.linspace(0, n - 1, min(n, SAMPLED_VOXELS)) for n in grid.shape]
    x = grid.points(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)).reshape(-1, 3)
    seen, cut = np.zeros(len(x)), 0
    for j in range(len(matrices)):
        u, v = matrices.select([j]).project(x)[0].T
        inside = (u > -1) & (u < matrices.n_u) & (v > -1) & (v < matrices.n_v)
        seen += inside
        cut += not inside.all()
    enough = len(matrices) * (0.45 if s.displaced else 1.0)  # a displaced panel sees each half of the object in turn
    never, partly = 100 * float((seen == 0).mean()), 100 * float(((seen > 0) & (seen < enough)).mean())
    if not cut or (s.displaced and never + partly == 0):
        return []
    return [
        f"truncated: the grid is wider than the field of view in {cut} of {len(matrices)} views. About {partly:.0f} % "
        f"of its voxels are seen by some of the views only, and their values are incomplete; {never:.0f} % are seen by "
        "none and stay 0"
    ]
