"""TIGRE (Python): distances, ZYZ angles of the gantry, offsets and a rotation of the panel, one set a view.

With Rw = R_z(angles[0]) R_y(angles[1]) R_z(angles[2]):  source Rw (DSO, 0, 0), panel centre
Rw (DSO - DSD, offset u, offset v), panel axes the columns 2 and 3 of Rw R_z(r2) R_y(r1) R_x(r0).  Python orders are
offDetector [v, u], nDetector and dDetector [v, u].  Array row 0 is the bottom.  DSD runs along the line from the source
through the origin; it is not the normal distance.  Source: TIGRE's projector code; proved by running it on the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.euler import zyx_angles, zyz_angles
from tomopose.exports.panel import Given, matrices_of_panels, numbers, require_keys, unmirrored_panels
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import R_x, R_y, R_z

KEYS = ("DSO", "DSD", "angles", "offDetector", "rotDetector", "nDetector", "dDetector", "offOrigin", "COR")


def to_tigre(matrices: ProjectionMatrices) -> dict[str, Any]:
    """Fields of a TIGRE geometry, float64: mm and rad; offOrigin = 0, COR = 0.

    Raises NotRepresentableError for mirrored images, skew and wrong aspect.
    """
    g = unmirrored_panels(matrices, "tigre")
    u, v = g.U / matrices.p_u, g.V / matrices.p_v
    DSO = np.linalg.norm(g.source, axis=1)
    x = g.source / DSO[:, None]
    # The z axis follows the panel's v; where v is nearly along the beam (no sane scan) it follows the third axis.
    along = np.abs(np.einsum("ni,ni->n", v, x))[:, None] > 0.99
    z = np.where(along, np.cross(x, u), v)
    z = z - np.einsum("ni,ni->n", z, x)[:, None] * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    Rw = np.stack([x, np.cross(z, x), z], axis=-1)
    Rw_T = np.swapaxes(Rw, -1, -2)
    centre = (Rw_T @ g.centre[..., None])[..., 0]
    R_panel = Rw_T @ np.stack([np.cross(u, v), u, v], axis=-1)
    return {
        "DSO": DSO,
        "DSD": DSO - centre[:, 0],
        "angles": zyz_angles(Rw),
        "offDetector": centre[:, [2, 1]],
        "rotDetector": zyx_angles(R_panel)[:, ::-1],
        "nDetector": np.array([matrices.n_v, matrices.n_u]),
        "dDetector": np.array([matrices.p_v, matrices.p_u]),
        "offOrigin": np.zeros(3),
        "COR": np.zeros(1),
    }


def from_tigre(content: Mapping[str, Any], given: Given, *, where: str = "the TIGRE arrays") -> ProjectionMatrices:
    """Matrices of `to_tigre`'s fields.  Array row 0 is the bottom; another row order contradicts the format."""
    require_keys(content, KEYS, where)
    for name in ("offOrigin", "COR"):
        if numbers(np.ravel(content[name]), (-1,), f"{where}: {name}").any():
            raise InputError(f"{where}: {name} is not 0; shift the geometry instead, tilted scans cannot use it")
    DSO = numbers(content["DSO"], (-1,), f"{where}: DSO")
    n = len(DSO)
    DSD = numbers(content["DSD"], (n,), f"{where}: DSD")
    angles, r = (numbers(content[k], (n, 3), f"{where}: {k}") for k in ("angles", "rotDetector"))
    offset = numbers(content["offDetector"], (n, 2), f"{where}: offDetector")
    size = numbers(content["nDetector"], (2,), f"{where}: nDetector")
    pitch = numbers(content["dDetector"], (2,), f"{where}: dDetector")
    settled = Given(
        n_u=given.settle("n_u", int(size[1]), where),
        n_v=given.settle("n_v", int(size[0]), where),
        p_u=given.settle("p_u", float(pitch[1]), where),
        p_v=given.settle("p_v", float(pitch[0]), where),
        rows=given.settle("rows", "bottom", where),
        pose_id=given.pose_id,
    )
    Rw = R_z(angles[:, 0]) @ R_y(angles[:, 1]) @ R_z(angles[:, 2])
    panel = Rw @ R_z(r[:, 2]) @ R_y(r[:, 1]) @ R_x(r[:, 0])
    centre = Rw @ np.stack([DSO - DSD, offset[:, 1], offset[:, 0]], axis=1)[..., None]
    return matrices_of_panels(
        DSO[:, None] * Rw[:, :, 0],
        centre[..., 0],
        pitch[1] * panel[:, :, 1],
        pitch[0] * panel[:, :, 2],
        given=settled,
        rows="bottom",
        where=where,
    )
