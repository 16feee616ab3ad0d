"""RTK ThreeDCircularProjectionGeometry: nine parameters and a matrix a view in XML, and a side file beside it.

RTK counts the detector in mm, x = o_x + p_u u and y = o_y + p_v v, and turns its gantry about its own y axis; the
world axes are therefore permuted, x_R = (y_W, z_W, x_W).  In RTK axes, with unit vectors U, V and n = U x V:

    SID = n.S, SDD = d_SD, SourceOffset = (S.U, S.V), ProjectionOffset = (C.U, C.V),
    rows (U, V, n) = R_z(-InPlane) R_x(-OutOfPlane) R_y(-Gantry),  angles in the file in degrees.

The stored matrix has |m3| = 1 and w < 0 in front of the source, RTK's own sign.  The XML holds neither origin, spacing,
size nor axes: rtk.json does.  Source: RTK, ThreeDCircularProjectionGeometry; S. Rit et al., J. Phys.: Conf. Ser. 489,
012079 (2014).
"""

from __future__ import annotations

import difflib
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomopose.errors import ConventionError, InputError, InputWarning, SchemaVersionError
from tomopose.exports.euler import zxy_angles
from tomopose.exports.panel import OPTIONS, Given, numbers, unmirrored_panels
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.units import Array, float_array

R_WORLD_TO_RTK: Array = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""x_R = (y_W, z_W, x_W): RTK's gantry axis y is the rotation axis of W."""

PARAMETERS = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "GantryAngle",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
    "InPlaneAngle",
    "OutOfPlaneAngle",
    "SourceOffsetX",
    "SourceOffsetY",
)
IGNORED = ("CollimationUInf", "CollimationUSup", "CollimationVInf", "CollimationVSup")
XML_VERSION = "3"
READABLE_VERSIONS = ("2", "3")
"""RTK's own reader takes both."""
MISSPELT = 0.85
"""Likeness to a known name (difflib) above which an unknown element is a slip of the pen, and not an addition."""
SIDE_KEYS = ("world_to_rtk", "origin", "spacing", "direction", "size")
CROSS_CHECK_TOLERANCE_PX = 1e-3
"""Largest difference, px, between a stored matrix and the one of its parameters before the file is refused."""


def to_rtk(matrices: ProjectionMatrices) -> tuple[str, dict[str, Any]]:
    """The XML text and the content of rtk.json.  Projections have row 0 at the bottom.

    Raises NotRepresentableError for mirrored images (SID would be negative and reconstructions empty), skew, wrong
    aspect.
    """
    parameters, origin = _parameters(matrices)
    M = -_to_detector_mm(origin, (matrices.p_u, matrices.p_v)) @ matrices.P @ _homogeneous(R_WORLD_TO_RTK).T
    lines = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>", f'<RTKThreeDCircularGeometry version="{XML_VERSION}">']
    for k, row in enumerate(M):
        lines.append("  <Projection>")
        lines += [f"    <{name}>{float(parameters[name][k])!r}</{name}>" for name in PARAMETERS]
        lines.append("    <Matrix>")
        lines += ["      " + " ".join(repr(float(x)) for x in line) for line in row]
        lines += ["    </Matrix>", "  </Projection>"]
    lines.append("</RTKThreeDCircularGeometry>")
    side = {
        "world_to_rtk": R_WORLD_TO_RTK.tolist(),
        "origin": list(origin),
        "spacing": [matrices.p_u, matrices.p_v],
        "direction": [1, 1],
        "size": [matrices.n_u, matrices.n_v],
    }
    return "\n".join(lines) + "\n", side


def from_rtk(
    text: str, side: Mapping[str, object] | None, given: Given, *, where: str = "the RTK geometry"
) -> ProjectionMatrices:
    """Matrices of an RTK XML text and its side data (`origin`, `spacing`, optional `world_to_rtk`,
    `direction`, `size`).  Without side data, size and pitch must be given, and the panel is centred.

    A view may hold parameters, a matrix or both; where it holds both they are checked against each other.  `given`
    must hold n_u, n_v where `size` is absent.  A row order that contradicts `direction` is refused.
    """
    side = side or _centred(given, where)
    unknown = [k for k in side if k not in SIDE_KEYS and difflib.get_close_matches(k, SIDE_KEYS, cutoff=0.75)]
    origin, spacing, size, direction = (_pair(side, k) for k in ("origin", "spacing", "size", "direction"))
    if unknown or origin is None:
        found = f"unknown key {unknown[0]!r}" if unknown else "no 'origin'"
        raise InputError(f"the RTK side file has {found}; it holds {', '.join(SIDE_KEYS)} (mm)")
    p_u, p_v = (given.settle(k, s, where) for k, s in zip(("p_u", "p_v"), spacing or (None, None), strict=True))
    n_u, n_v = (given.settle(k, s, where) for k, s in zip(("n_u", "n_v"), size or (None, None), strict=True))
    n_u, n_v = int(n_u), int(n_v)
    if direction not in (None, (1.0, 1.0), (1.0, -1.0)):
        raise ConventionError(f"direction {direction} of the RTK side file is neither (1, 1) nor (1, -1)")
    up = direction is None or direction[1] > 0
    given.settle("rows", "bottom" if up else "top", where)
    world = numbers(side.get("world_to_rtk", R_WORLD_TO_RTK), (3, 3), "world_to_rtk")
    if np.abs(world @ world.T - np.eye(3)).max() > 1e-9 or np.linalg.det(world) < 0:
        raise InputError("world_to_rtk of the RTK side file is no proper rotation")
    # y = o_y + d_y p_v r: for a panel stored from its top, v = n_v - 1 - r again counts from the bottom.
    bottom = (origin[0], origin[1] if up else origin[1] - p_v * (n_v - 1))
    to_px = float_array(np.linalg.inv(_to_detector_mm(bottom, (p_u, p_v))))
    M = np.stack([_view(k, view, to_px, where) for k, view in enumerate(_views(text, where))])
    return given.matrices(to_px @ M @ _homogeneous(world), n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)


def _centred(given: Given, where: str) -> dict[str, Any]:
    """Side data of a panel whose middle is RTK's detector origin: what size and pitch alone determine."""
    missing = [OPTIONS[k] for k in ("n_u", "n_v", "p_u", "p_v") if getattr(given, k) is None]
    if missing:
        raise InputError(
            f"{where}: an RTK geometry does not hold where pixel (0, 0) lies; give the panel's size and pitch "
            f"({', '.join(missing)} missing), and the panel is taken as centred; or give side (--side rtk.json), a "
            "JSON "
            'with "origin": [ox, oy] and "spacing": [p_u, p_v] in mm and, unless it is W to (y, z, x), "world_to_rtk"'
        )
    n_u, n_v, p_u, p_v = (given.settle(k, None, where) for k in ("n_u", "n_v", "p_u", "p_v"))
    return {"origin": [-(n_u - 1) / 2 * p_u, -(n_v - 1) / 2 * p_v], "spacing": [p_u, p_v]}


def matrix_of_parameters(p: Mapping[str, object]) -> Array:
    """RTK's matrix (n, 3, 4) or (3, 4), RTK axes to detector mm, of the nine parameters (mm, degrees)."""
    v = {name: np.asarray(p[name], dtype=np.float64) for name in PARAMETERS}
    gantry, in_plane, out_of_plane = (np.radians(v[f"{name}Angle"]) for name in ("Gantry", "InPlane", "OutOfPlane"))
    rotation = R_z(-in_plane) @ R_x(-out_of_plane) @ R_y(-gantry)
    SID, SDD = v["SourceToIsocenterDistance"], v["SourceToDetectorDistance"]
    sx, sy = v["SourceOffsetX"], v["SourceOffsetY"]
    K = np.zeros((*SID.shape, 3, 3))
    K[..., 0, 0] = K[..., 1, 1] = -SDD
    K[..., 0, 2], K[..., 1, 2], K[..., 2, 2] = sx - v["ProjectionOffsetX"], sy - v["ProjectionOffsetY"], 1.0
    source = np.stack(np.broadcast_arrays(sx, sy, SID), axis=-1)[..., None]
    return np.concatenate([K @ rotation, -K @ source], axis=-1)


def _parameters(matrices: ProjectionMatrices) -> tuple[dict[str, Array], tuple[float, float]]:
    g = unmirrored_panels(matrices, "rtk")
    S, C = g.source @ R_WORLD_TO_RTK.T, g.centre @ R_WORLD_TO_RTK.T
    U, V = g.U @ R_WORLD_TO_RTK.T / matrices.p_u, g.V @ R_WORLD_TO_RTK.T / matrices.p_v
    n = np.cross(U, V)
    in_plane, out_of_plane, gantry = np.degrees(-zxy_angles(np.stack([U, V, n], axis=1))).T % 360.0
    values = (
        np.einsum("ni,ni->n", n, S),
        g.d_SD,
        gantry,
        np.einsum("ni,ni->n", C, U),
        np.einsum("ni,ni->n", C, V),
        in_plane,
        out_of_plane,
        np.einsum("ni,ni->n", S, U),
        np.einsum("ni,ni->n", S, V),
    )
    origin = (-(matrices.n_u - 1) / 2 * matrices.p_u, -(matrices.n_v - 1) / 2 * matrices.p_v)
    return dict(zip(PARAMETERS, values, strict=True)), origin


def _pair(side: Mapping[str, Any], name: str) -> tuple[float, float] | None:
    """The first two of an entry's numbers (image geometries carry a third), or None where it is absent."""
    if side.get(name) is None:
        return None
    value = side[name][:2] if isinstance(side[name], (list, tuple)) else side[name]
    u, v = numbers(value, (2,), f"{name} of the RTK side file")
    return float(u), float(v)


def _to_detector_mm(origin: Sequence[float], pitch: Sequence[float]) -> Array:
    return np.array([[pitch[0], 0.0, origin[0]], [0.0, pitch[1], origin[1]], [0.0, 0.0, 1.0]])


def _homogeneous(R: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = R
    return T


def _views(text: str, where: str) -> list[dict[str, Any]]:
    """Per view its parameters and, where it has one, its matrix.  As in RTK, values hold until they are replaced."""
    if "<!ENTITY" in text:
        raise InputError(f"{where} defines XML entities; a geometry needs none, it is not read")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{where} is no whole XML: {error}; is the file truncated?") from error
    if root.tag != "RTKThreeDCircularGeometry":
        raise InputError(f"{where}: the root element is <{root.tag}>, not <RTKThreeDCircularGeometry>")
    version = root.get("version")
    if version not in READABLE_VERSIONS:
        raise SchemaVersionError(
            f"{where}: RTK geometry version {version!r}; versions {' and '.join(READABLE_VERSIONS)} are read"
        )
    current: dict[str, float] = dict.fromkeys(PARAMETERS[2:], 0.0)
    views: list[dict[str, Any]] = []
    added: dict[str, None] = {}
    for element in root:
        if element.tag != "Projection":
            _take(element, current, added, where)
            continue
        matrix = None
        for child in element:
            if child.tag == "Matrix":
                matrix = numbers((child.text or "").split(), (12,), f"{where}: Matrix of view {len(views)}")
            else:
                _take(child, current, added, where)
        views.append({**current, "Matrix": None if matrix is None else matrix.reshape(3, 4)})
    if not views:
        raise InputError(f"{where} holds no <Projection>")
    if added:
        warnings.warn(
            f"{where}: RTK knows no element <{'>, <'.join(added)}>; passed over, as RTK does",
            InputWarning,
            stacklevel=2,
        )
    return views


def _take(element: ET.Element, current: dict[str, float], added: dict[str, None], where: str) -> None:
    """One parameter element into the current values; a name that RTK does not know goes to `added`."""
    if element.tag in IGNORED:
        return
    if element.tag != "RadiusCylindricalDetector" and element.tag not in PARAMETERS:
        near = difflib.get_close_matches(str(element.tag), PARAMETERS, n=1, cutoff=MISSPELT)
        if near:
            raise InputError(f"{where}: unknown element <{element.tag}>; did you mean <{near[0]}>?")
        added[str(element.tag)] = None
        return
    value = float(numbers((element.text or "").strip(), (), f"{where}: <{element.tag}>"))
    if element.tag == "RadiusCylindricalDetector":
        if value != 0:
            raise InputError(f"{where}: the detector is a cylinder of radius {value:g} mm; only flat panels are read")
        return
    current[element.tag] = value


def _view(k: int, view: Mapping[str, Any], to_px: Array, where: str) -> Array:
    """RTK's matrix of one view; parameters and matrix are held against each other around the isocentre."""
    stored = view["Matrix"]
    missing = [name for name in PARAMETERS if name not in view]
    if missing:
        raise InputError(f"{where}: view {k} lacks {', '.join(missing)}")
    if not (view["SourceToIsocenterDistance"] > 0 and view["SourceToDetectorDistance"] > 0):
        raise InputError(
            f"{where}: view {k} has SID {view['SourceToIsocenterDistance']:g} and SDD "
            f"{view['SourceToDetectorDistance']:g} mm; both must be positive (parallel beams are not read)"
        )
    M = matrix_of_parameters(view)
    if stored is None:
        return M
    reach = view["SourceToIsocenterDistance"] / 4
    points = np.c_[reach * BOX_CORNERS, np.ones(8)]
    with np.errstate(all="ignore"):  # a matrix of nonsense gives NaN, which the test below refuses
        a, b = (h[:, :2] / h[:, 2:] for h in (points @ (to_px @ m).T for m in (M, stored)))
        difference = np.abs(a - b).max()
    if not difference < CROSS_CHECK_TOLERANCE_PX:
        raise InputError(
            f"{where}: in view {k} the matrix and the parameters disagree by {difference:.3g} px; one was changed alone"
        )
    return np.asarray(stored, dtype=np.float64)
