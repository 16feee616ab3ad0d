"""The robot-CT community's JSON: one view a file, focal spot, detector centre and orientation in the cell's axes, mm.

The detector's quaternion (x, y, z, w) turns its axes into the cell's: the first along the columns (u), the second up
the panel (v), the third from the panel towards the source.  Its image files have the top row first.  W is the cell's
frame. Source: the projection geometry JSON of THD Deggendorf's robot CT (focal_spot_position_mm,
detector_center_position_mm, detector_center_orientation_quat; the pitch's key occurs as `height` and as `heigth`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.errors import InputError
from tomopose.exports.panel import Given, matrices_of_panels, numbers, unmirrored_panels
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.projection import ProjectionMatrices, compose
from tomopose.units import Array

MAKER = "robot-CT JSON of THD Deggendorf"
PITCH_V = ("pixel_pitch_height_mm", "pixel_pitch_heigth_mm")
QUATERNION_TOLERANCE = 1e-3
CROSS_CHECK_TOLERANCE_PX = 1e-3


@dataclass(frozen=True, kw_only=True)
class RobotPanel:
    """Source, centre and axes (3,) of one view in the cell, mm; pitch, size, distance along the normal, piercing
    point.
    """

    source: Array
    centre: Array
    u: Array
    v: Array
    p_u: float
    p_v: float
    n_u: int
    n_v: int

    @property
    def d_SD(self) -> float:
        return abs(float(np.cross(self.u, self.v) @ (self.centre - self.source)))

    @property
    def u_0(self) -> float:
        return (self.n_u - 1) / 2 + float(self.u @ (self.source - self.centre)) / self.p_u

    @property
    def v_0(self) -> float:
        return (self.n_v - 1) / 2 + float(self.v @ (self.source - self.centre)) / self.p_v


def is_robot_json(content: object) -> bool:
    """Whether a JSON content is a view of a robot scanner, or a list of them."""
    if isinstance(content, list):
        return bool(content) and is_robot_json(content[0])
    geometry = content.get("projection_geometry") if isinstance(content, Mapping) else None
    return isinstance(geometry, Mapping) and "focal_spot_position_mm" in geometry


def panel_of(view: Mapping[str, object], where: str) -> RobotPanel:
    """Source and panel of one view; InputError names what is missing or no number."""
    geometry, detector = view.get("projection_geometry"), view.get("detector")
    if not isinstance(geometry, Mapping) or not isinstance(detector, Mapping):
        raise InputError(f"{where} ({MAKER}) lacks the section projection_geometry or detector")

    def entry(section: Mapping[str, object], shape: tuple[int, ...], *names: str) -> Any:
        for name in names:
            if section.get(name) is not None:
                return numbers(section[name], shape, f"{where}: {name}")
        raise InputError(f"{where} ({MAKER}) lacks {names[0]}")

    source = entry(geometry, (3,), "focal_spot_position_mm")
    centre = entry(geometry, (3,), "detector_center_position_mm")
    q = entry(geometry, (4,), "detector_center_orientation_quat")
    if abs(np.linalg.norm(q) - 1) > QUATERNION_TOLERANCE:
        raise InputError(f"{where}: detector_center_orientation_quat has the norm {np.linalg.norm(q):.6g}, not 1")
    R = Rotation.from_quat(q).as_matrix()
    return RobotPanel(
        source=source,
        centre=centre,
        u=R[:, 0],
        v=R[:, 1],
        p_u=float(entry(detector, (), "pixel_pitch_width_mm")),
        p_v=float(entry(detector, (), *PITCH_V)),
        n_u=int(entry(detector, (), "image_width_px")),
        n_v=int(entry(detector, (), "image_height_px")),
    )


def from_robot_json(
    content: Mapping[str, object] | Sequence[Mapping[str, object]], given: Given, *, where: str = MAKER
) -> ProjectionMatrices:
    """Matrices of one view or of a list of views.  v counts up the panel; the image files' order has no part.

    A matrix `projection_matrix_cera` that a view holds too is compared with its positions; InputError where they
    differ.
    """
    views = [content] if isinstance(content, Mapping) else list(content)
    panels = [panel_of(view, f"{where}, view {k}" if len(views) > 1 else where) for k, view in enumerate(views)]
    first = panels[0]
    for k, p in enumerate(panels):
        if (p.n_u, p.n_v) != (first.n_u, first.n_v):
            raise InputError(f"{where}: view {k} has {p.n_u} x {p.n_v} px, view 0 {first.n_u} x {first.n_v}")
    place = f"{where} ({MAKER})"
    size = {"n_u": given.settle("n_u", first.n_u, place), "n_v": given.settle("n_v", first.n_v, place)}
    matrices = matrices_of_panels(
        np.stack([p.source for p in panels]),
        np.stack([p.centre for p in panels]),
        np.stack([p.p_u * p.u for p in panels]),
        np.stack([p.p_v * p.v for p in panels]),
        given=given.with_values(**size),
        rows="bottom",
        where=place,
    )
    for k, view in enumerate(views):
        _compare(view, panels[k], f"{where}, view {k}")
    return matrices


def _compare(view: Mapping[str, Any], panel: RobotPanel, where: str) -> None:
    """InputError where the CERA matrix of a view is another one than its positions give."""
    geometry = view["projection_geometry"]
    stored = geometry.get("projection_matrix_cera", view.get("projection_matrix_cera"))
    if stored is None:
        return
    flat = isinstance(stored, list) and len(stored) == 12
    stored = numbers(stored, (12,) if flat else (3, 4), f"{where}: projection_matrix_cera").reshape(3, 4)
    P = compose(
        panel.source[None],
        panel.centre[None],
        panel.p_u * panel.u[None],
        panel.p_v * panel.v[None],
        n_u=panel.n_u,
        n_v=panel.n_v,
    )[0]
    middle = (panel.source + panel.centre) / 2
    reach = np.linalg.norm(panel.centre - panel.source) / 10
    x = middle + reach * BOX_CORNERS
    with np.errstate(all="ignore"):  # a matrix of nonsense gives NaN, which the test below refuses
        a, b = (h[:, :2] / h[:, 2:] for h in (np.c_[x, np.ones(8)] @ m.T for m in (P, stored)))
    if not np.abs(a - b).max() < CROSS_CHECK_TOLERANCE_PX:
        raise InputError(
            f"{where}: projection_matrix_cera and the positions disagree by {np.abs(a - b).max():.3g} px; one was "
            "changed "
            "alone"
        )


def to_robot_json(matrices: ProjectionMatrices) -> list[dict[str, Any]]:
    """One JSON content a view.  NotRepresentableError for mirrored images, skew and wrong aspect."""
    g, m = unmirrored_panels(matrices, "thd"), matrices
    U, V = g.U / m.p_u, g.V / m.p_v
    q = Rotation.from_matrix(np.stack([U, V, np.cross(U, V)], axis=-1)).as_quat(canonical=True)
    return [
        {
            "projection_geometry": {
                "focal_spot_position_mm": g.source[k].tolist(),
                "focal_spot_orientation_quat": [0.0, 0.0, 0.0, 1.0],
                "detector_center_position_mm": g.centre[k].tolist(),
                "detector_center_orientation_quat": q[k].tolist(),
                "projection_matrix_cera": m.P[k].tolist(),
            },
            "image": {"image_path": f"{m.pose_id[k]}.tif"},
            "detector": {
                "image_width_px": m.n_u,
                "image_height_px": m.n_v,
                "pixel_pitch_width_mm": m.p_u,
                "pixel_pitch_height_mm": m.p_v,
            },
        }
        for k in range(len(m))
    ]
