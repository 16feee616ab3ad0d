"""CTSimU scenario, file format 1.2, written: source and panel do not move, the stage carries the scan.

Source at 0, panel at x = d_SD, both with vector_u = (0, -1, 0) and vector_w = (1, 0, 0), so that the panel's v points
down.  With Q the rotation whose rows are (m3, -U/p_u, V/p_v), from W to these axes, the stage is at -Q S with axes
(u, v, w) = (-Q e_x, -Q e_y, Q e_z).  The stage's centre moves by drifts, its orientation by three deviations about
w, v, u (turning axes) with drifts; one drift value a frame, so nothing is interpolated.  Where d_SD or the piercing
point change from view to view, the panel's centre drifts too.  Reading is in ctsimu_scenario.py.

Source: CTSimU scenario file format 1.2; proved with ctsimu 1.7, Scenario.set_frame(i, reconstruction=True) and
projection_matrix(mode="CERA").
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.exports.ctsimu_scenario import from_ctsimu
from tomopose.exports.euler import zyx_angles
from tomopose.exports.panel import unmirrored_panels
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

__all__ = ["from_ctsimu", "to_ctsimu"]

STILL_MM = 1e-10
"""A panel centre that moves by less than this, rounding of the decomposition, is written without drifts."""


def to_ctsimu(matrices: ProjectionMatrices) -> dict[str, Any]:
    """The scenario's JSON content.  Image files have their top row first, as the format has it.

    Raises NotRepresentableError for mirrored images, skew and wrong aspect.
    """
    m, g = matrices, unmirrored_panels(matrices, "ctsimu")
    Q = np.stack([g.normal, -g.U / m.p_u, g.V / m.p_v], axis=1)
    stage = -(Q @ g.source[..., None])[..., 0]
    angles = zyx_angles(np.stack([-Q[:, :, 0], -Q[:, :, 1], Q[:, :, 2]], axis=-1))
    u_off, v_off = ((m.n_u - 1) / 2 - g.u_0) * m.p_u, ((m.n_v - 1) / 2 - g.v_0) * m.p_v
    panel = np.stack([g.d_SD, -u_off, v_off], axis=1)
    facing = {"vector_u": _vector((0.0, -1.0, 0.0)), "vector_w": _vector((1.0, 0.0, 0.0))}
    return {
        "file": {
            "name": "tomopose export",
            "description": "Scan trajectory of a calibrated manipulator; the stage carries the pose of every view.",
            "file_type": "CTSimU Scenario",
            "file_format_version": {"major": 1, "minor": 2},
        },
        "geometry": {
            "detector": {"center": _centre(panel), **facing},
            "source": {"type": "cone", "center": _centre(np.zeros((1, 3))), **facing},
            "stage": {
                "center": _centre(stage),
                "vector_u": _vector((1.0, 0.0, 0.0)),
                "vector_w": _vector((0.0, 0.0, 1.0)),
                "deviations": [
                    {
                        "type": "rotation",
                        "axis": axis,
                        "pivot": {k: {"value": 0.0, "unit": "mm"} for k in "uvw"},
                        "amount": _quantity(angle, "rad"),
                        "known_to_reconstruction": True,
                    }
                    for axis, angle in zip("wvu", angles.T, strict=True)
                ],
            },
        },
        "source": {"model": None, "manufacturer": None},
        "detector": {
            "model": None,
            "manufacturer": None,
            "type": "ideal",
            "columns": {"value": m.n_u},
            "rows": {"value": m.n_v},
            "pixel_pitch": {"u": {"value": m.p_u, "unit": "mm"}, "v": {"value": m.p_v, "unit": "mm"}},
        },
        "acquisition": {
            "start_angle": {"value": 0.0, "unit": "deg"},
            "stop_angle": {"value": 0.0, "unit": "deg"},
            "direction": "CCW",
            "scan_mode": "stop+go",
            "number_of_projections": len(m),
            "include_final_angle": True,
            "pixel_binning": {"u": 1, "v": 1},
        },
        "samples": [],
        "materials": [],
    }


def _quantity(values: Array, unit: str) -> dict[str, Any]:
    """A CTSimU parameter: the first value, and one drift value a frame, which CTSimU adds to it."""
    parameter: dict[str, Any] = {"value": float(values[0]), "unit": unit}
    if len(values) > 1:
        drift = (values - values[0]).tolist()
        parameter["drifts"] = [{"value": drift, "unit": unit, "known_to_reconstruction": True}]
    return parameter


def _centre(points: Array) -> dict[str, Any]:
    moved = np.abs(points - points[0]).max() > STILL_MM
    return {name: _quantity(x if moved else x[:1], "mm") for name, x in zip("xyz", points.T, strict=True)}


def _vector(values: tuple[float, float, float]) -> dict[str, Any]:
    return {name: {"value": x} for name, x in zip("xyz", values, strict=True)}
