"""The path of the source about the object: circular or not, how much of a turn, and the weight of each view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

CIRCULAR_ELEVATION = math.radians(0.5)
CIRCULAR_ROLL = math.radians(1.0)
"""Up to these a path counts as circular: elevation of the source over its plane, and of detector rows against it."""
STEEPEST = 1.5
"""Rise over run up to which a path counts as smooth."""
HOLE = 3.0
"""A stretch between neighbouring views counts as a hole from so many times the median on, and from twice the mean on:
views that are spread unevenly have none."""
FEWEST_SOURCES = 3
"""Places of the source that it takes to determine a path."""


@dataclass(frozen=True, kw_only=True)
class SourcePath:
    """The path, read off the matrices.

    axis: (3,) unit normal of the best plane through the sources, in W; centre: (3,) mm, of the circle in it.

    angle: (n,) rad about the axis; weight: (n,) rad, the share of the turn of each view; arm: (n, 3) mm, from centre to
    source; distance: (n,) mm, its length; elevation: (n,) rad over the plane; tangent: (n, 3) mm/rad, how the source
    moves with the angle; holes: (m, 2) rad, where each stretch without views begins and how long it is; circular:
    whether the source keeps to its plane, and rows to it; smooth: whether the height is a smooth function of the angle,
    so that neighbours by angle are neighbours on the way (not on two rings, or with scattered views).
    """

    axis: Array
    centre: Array
    angle: Array
    weight: Array
    arm: Array
    distance: Array
    elevation: Array
    tangent: Array
    holes: Array
    circular: bool
    smooth: bool

    @property
    def full_turn(self) -> bool:
        """Whether no stretch of the turn lacks views."""
        return len(self.holes) == 0

    @property
    def coverage(self) -> float:
        """The turn that the views cover, rad."""
        return float(self.weight.sum())


def source_path(matrices: ProjectionMatrices) -> SourcePath | None:
    """The path of the source relative to the object; None where fewer than three places do not determine one."""
    rays = matrices.decompose()
    source = rays.source
    mean = source.mean(axis=0)
    if len(np.unique((source - mean).round(6), axis=0)) < FEWEST_SOURCES:
        return None
    _, spread, axes = np.linalg.svd(source - mean, full_matrices=True)
    e_1, e_2, axis = axes
    if axis[np.abs(axis).argmax()] < 0:
        axis = -axis
    x, y = (source - mean) @ e_1, (source - mean) @ e_2
    # Kasa's circle: x^2 + y^2 = 2 a x + 2 b y + c, linear in a, b, c
    (a, b, _), *_ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x**2 + y**2, rcond=None)
    centre = mean + a * e_1 + b * e_2
    arm = source - centre
    distance = np.linalg.norm(arm, axis=1)
    elevation = np.arcsin(np.clip(arm @ axis / distance, -1, 1))
    angle = np.arctan2(arm @ np.cross(axis, e_1), arm @ e_1)
    order = np.argsort(angle, kind="stable")
    gap = np.diff(angle[order], append=angle[order[0]] + 2 * math.pi)
    typical = float(np.median(gap))
    hole = gap > max(HOLE * typical, 2 * (2 * math.pi / len(angle)))
    weight = np.empty(len(angle))
    shared = np.where(hole, typical, gap)
    weight[order] = (shared + np.roll(shared, 1)) / 2
    rows = rays.U / np.linalg.norm(rays.U, axis=1, keepdims=True)
    circular = (
        len(angle) > 2
        and bool(np.abs(elevation).max() < CIRCULAR_ELEVATION)
        and bool(np.abs(rows @ axis).max() < math.sin(CIRCULAR_ROLL))
        and bool(spread[1] > 1e-3 * spread[0])
    )
    slope = np.empty(len(angle))
    rise = np.roll(elevation[order], -1) - elevation[order]
    run = np.maximum(gap, 0.1 * typical)  # repeated views have none
    slope[order] = (rise + np.roll(rise, 1)) / (run + np.roll(run, 1))
    return SourcePath(
        axis=axis,
        centre=centre,
        angle=angle,
        weight=weight,
        arm=arm,
        distance=distance,
        elevation=elevation,
        tangent=tangents(arm, axis, slope),
        holes=np.stack([angle[order][hole] + typical / 2, gap[hole] - typical], axis=1),
        circular=circular,
        smooth=bool((np.abs(rise) < STEEPEST * run).all()),
    )


def height_obstacle(path: SourcePath) -> str:
    """Why FDK cannot follow the source's height, in words; empty where it can."""
    if path.smooth:
        return ""
    return (
        "it follows the source's path from view to view about the axis, and here the height of the source jumps "
        "between neighbours by angle (several rings, or scattered views)"
    )


def holes_obstacle(path: SourcePath) -> str:
    """Why stretches without views forbid FDK, in words; empty where they need not."""
    covered = math.degrees(path.coverage)
    if len(path.holes) > 1:
        return f"the turn has {len(path.holes)} stretches without views, {360 - covered:.0f} degrees together"
    if len(path.holes) == 1 and not path.circular:
        return (
            f"the source covers {covered:.0f} of 360 degrees and leaves the plane of its path: weights for a short "
            "scan are defined on a circle"
        )
    return ""


def tangents(arm: Array, axis: Array, slope: Array) -> Array:
    """(n, 3): d arm / d angle about the axis, where d elevation / d angle is `slope` (n,)."""
    around = np.cross(axis, arm)
    across = np.cross(arm, around)
    up = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(around + (slope * np.linalg.norm(arm, axis=1))[:, None] * up)
