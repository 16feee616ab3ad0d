"""What gives away numbers of another unit, and images that are mirrored, as soon as a geometry is read.

A projection matrix knows no unit: only the pitch does.  With the pitch in mm, the depth of W's origin lies between
source and panel; numbers in micrometres, in voxels or in metres put it far outside.  Vector formats carry the pitch
themselves, and a panel whose pixels are millimetres wide, or thinner than a wavelength of its own light, is one in
another unit.
"""

from __future__ import annotations

import numpy as np

from tomopose.errors import ConventionError, InputError, UnitError
from tomopose.geometry.projection import ProjectionMatrices

PITCH_MM = (0.0008, 1.5)
"""mm; pixels of area detectors for imaging: 1 um behind an objective, 1 mm in portal imagers."""
DISTANCE_MM = (3.0, 20000.0)
"""mm; source to panel: nano-CT to halls for whole cars."""
LARGEST_MAGNIFICATION = 900.0
"""Metres taken for millimetres look like a magnification of 1000 and more; optics aside, cone beams stay below."""
HINT = "--unit-mm says what one unit of the file is (0.001: micrometres; the voxel size: voxels; 1000: metres; 1: mm)"


def scaled_to_mm(matrices: ProjectionMatrices, unit_mm: float, *, scale_pitch: bool) -> ProjectionMatrices:
    """The same geometry with points of W in mm, where one unit of the file is `unit_mm`.

    scale_pitch: the file held the pitch, in its own unit too.
    """
    if not (np.isfinite(unit_mm) and unit_mm > 0):
        raise InputError(f"--unit-mm is {unit_mm!r}; a positive number is needed")
    P = matrices.P.copy()
    P[:, :, :3] /= unit_mm
    f = unit_mm if scale_pitch else 1.0
    return ProjectionMatrices(
        P=P,
        n_u=matrices.n_u,
        n_v=matrices.n_v,
        p_u=matrices.p_u * f,
        p_v=matrices.p_v * f,
        pose_id=matrices.pose_id,
    )


def require_millimetres(matrices: ProjectionMatrices, where: str) -> None:
    """UnitError where pitch, distance or the place of W's origin say that the numbers are in another unit."""
    for name, p in (("p_u", matrices.p_u), ("p_v", matrices.p_v)):
        if not PITCH_MM[0] <= p <= PITCH_MM[1]:
            raise UnitError(f"{where}: {name} is {p:g} mm, which no detector has; is the file in another unit? {HINT}")
    M = matrices.P[:, :, :3]
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.linalg.inv(M)[:, :, 0], axis=1)
        distance = matrices.p_u / (length * np.linalg.norm(M[:, 2], axis=1))
    depth = matrices.P[:, 2, 3]
    bad = np.flatnonzero(~((distance > DISTANCE_MM[0]) & (distance < DISTANCE_MM[1])))
    if bad.size:
        k = int(bad[0])
        raise UnitError(
            f"{where}: source and panel of view {k} are {distance[k]:.4g} mm apart; is the file in another unit? {HINT}"
        )
    behind = depth > distance
    near = (depth > 0) & (depth < distance / LARGEST_MAGNIFICATION)
    for found, place in ((behind, "behind the panel"), (near, "at the source")):
        if found.all():
            raise UnitError(
                f"{where}: the origin of its world lies {place} (depth {depth[0]:.4g}, the panel at {distance[0]:.4g} "
                "mm); "
                f"are positions in micrometres, voxels or metres? {HINT}"
            )


def require_unmirrored(matrices: ProjectionMatrices, where: str, *, rows: str | None) -> None:
    """ConventionError where the images, as the geometry describes them, are mirror images seen from the source."""
    mirrored = np.linalg.det(matrices.P[:, :, :3]) > 0
    if not mirrored.any():
        return
    other = {"bottom": "top", "top": "bottom"}.get(rows or "", "")
    way = f"try --rows {other}, the other row order" if other and mirrored.all() else "a column direction is reversed"
    raise ConventionError(
        f"{where}: in {int(mirrored.sum())} of {len(matrices)} views u to the right and v up are mirrored, seen from "
        "the "
        f"source; {way}; --mirrored accepts images that are mirrored"
    )
