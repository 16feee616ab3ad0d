"""The geometry objects of other packages, made in memory: what a notebook hands to ASTRA, CIL, TIGRE, RTK or LEAP.

Each function imports its package when it is called, and says how to install it where it is not there.  The numbers are
those of `tp.export`; nothing passes through a file.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from tomopose.engines.rtk import INSTALL as RTK_INSTALL
from tomopose.engines.rtk import rtk_geometry
from tomopose.errors import EngineMissingError
from tomopose.exports import astra as astra_format
from tomopose.exports import cil as cil_format
from tomopose.exports import leap as leap_format
from tomopose.exports import tigre as tigre_format
from tomopose.exports.panel import Rows, check_rows, unmirrored_panels
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.values import require_types

INSTALL = {
    "astra": "pip install 'tomopose[gpu]'",
    "cil.framework": "conda install -c conda-forge -c ccpi cil",
    "tigre": "pip install git+https://github.com/CERN/TIGRE.git",
    "leapctype": "pip install git+https://github.com/LLNL/LEAP.git",
}


def _module(name: str, package: str) -> Any:
    """A package's module; EngineMissingError, with the line that installs it, where it is not there."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise EngineMissingError(
            f"{package} is not installed; its geometry can still be written with tp.export", install_line=INSTALL[name]
        ) from error


@require_types
def to_astra(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> dict[str, Any]:
    """ASTRA's projection geometry `cone_vec`, for data (rows, views, columns) with that row order.

    Volumes that go with it: `create_vol_geom(Ny, Nx, Nz, xmin, xmax, ymin, ymax, zmin, zmax)` in mm, arrays [z, y, x].
    """
    check_rows(rows)
    package = _module("astra", "astra-toolbox")
    vectors = astra_format.to_astra(matrices, rows=rows)
    return dict(package.create_proj_geom("cone_vec", int(matrices.n_v), int(matrices.n_u), vectors))


@require_types
def to_rtk(matrices: ProjectionMatrices) -> Any:
    """RTK's ThreeDCircularProjectionGeometry, world axes (y, z, x) of W.

    The stack of projections that goes with it has its first row at the bottom (image index j = v), origin
    (-(n_u - 1) / 2 p_u, -(n_v - 1) / 2 p_v, 0) and spacing (p_u, p_v, 1).  NotRepresentableError for mirrored images;
    EngineFailedError where RTK refuses a view.
    """
    unmirrored_panels(matrices, "rtk")
    if importlib.util.find_spec("itk") is None:
        raise EngineMissingError("itk-rtk is not installed", install_line=RTK_INSTALL)
    return rtk_geometry(matrices, range(len(matrices)))


@require_types
def to_cil(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> Any:
    """CIL's AcquisitionGeometry (Cone3D_Flex, 25.0 and later), labels (projection, vertical, horizontal)."""
    check_rows(rows)
    package = _module("cil.framework", "CIL")
    f = cil_format.to_cil(matrices, rows=rows)
    geometry = package.AcquisitionGeometry.create_Cone3D_Flex(
        f["source"], f["detector"], f["direction_x"], f["direction_y"], volume_centre_position=[0.0, 0.0, 0.0]
    )
    geometry.set_panel([int(matrices.n_u), int(matrices.n_v)], [matrices.p_u, matrices.p_v], origin=str(f["origin"]))
    geometry.set_labels(["projection", "vertical", "horizontal"])
    return geometry


@require_types
def to_tigre(matrices: ProjectionMatrices) -> tuple[Any, Any]:
    """TIGRE's geometry and the angles (n, 3) that go with it; projections [angle, v, u], row 0 at the bottom.

    Set nVoxel, sVoxel and dVoxel before use.  NotRepresentableError for mirrored images.
    """
    package = _module("tigre", "TIGRE")
    fields = tigre_format.to_tigre(matrices)
    geometry = package.geometry()
    angles = fields.pop("angles")
    for name, value in {**fields, "mode": "cone", "accuracy": 0.5}.items():
        setattr(geometry, name, value)
    geometry.sDetector = geometry.nDetector * geometry.dDetector
    return geometry, angles


@require_types
def to_leap(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> Any:
    """LEAP's model with a modular beam, for projections (n, rows, columns) with that row order.

    Set the volume (`set_volume` or `set_default_volume`) before use.
    """
    check_rows(rows)
    package = _module("leapctype", "LEAP")
    f = leap_format.to_leap(matrices, rows=rows)
    model = package.tomographicModels()
    arrays = [f[k].astype("float32") for k in ("source_positions", "module_centers", "row_vectors", "col_vectors")]
    model.set_modularbeam(
        len(matrices), int(matrices.n_v), int(matrices.n_u), float(matrices.p_v), float(matrices.p_u), *arrays
    )
    return model
