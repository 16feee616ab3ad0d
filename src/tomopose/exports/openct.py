"""openCT: one JSON with a 3 x 4 matrix a projection, whose detector frame the file itself names.

Written in the frame "OriginAtDetectorCenter.VerticalAxisRunningDownwards" and in mm: x = p_u (u - u_c),
y = p_v (v_c - v), with (u_c, v_c) the middle of the panel.  The volume frame is W.  A positive det P[:, :3] is normal
there, since y runs down.  Source: openCT JSON as written by ctsimu 1.7, create_OpenCT_config.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import ConventionError, InputError, SchemaVersionError, UnitError
from tomopose.exports.panel import Given, matrices_of_panels, numbers
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

CENTRE_DOWN = "OriginAtDetectorCenter.VerticalAxisRunningDownwards"
CENTRE_UP = "OriginAtDetectorCenter.VerticalAxisRunningUpwards"
CORNER_DOWN = "OriginAtDetectorTopLeftCorner"
CORNER_UP = "OriginAtDetectorBottomLeftCorner"
FRAMES = (CENTRE_DOWN, CENTRE_UP, CORNER_DOWN, CORNER_UP)
DIMENSIONS = ("Length", "PixelCount")
NEWEST = 1


def detector_frame(frame: str, dimension: str, *, n_u: int, n_v: int, p_u: float, p_v: float) -> Array:
    """(3, 3): pixels (u, v, 1) of D to the named detector frame.  Corners are the outer corners of the panel.

    ConventionError for a frame or dimension that is not known.
    """
    if frame not in FRAMES:
        raise ConventionError(f"unknown detectorCoordinateFrame {frame!r}; known are {', '.join(FRAMES)}")
    if dimension not in DIMENSIONS:
        raise ConventionError(f"unknown detectorCoordinateDimension {dimension!r}; known are {', '.join(DIMENSIONS)}")
    down = frame in (CENTRE_DOWN, CORNER_DOWN)
    if frame in (CENTRE_DOWN, CENTRE_UP):
        u_0, v_0 = (n_u - 1) / 2, (n_v - 1) / 2
    else:
        u_0, v_0 = -0.5, n_v - 0.5 if down else -0.5
    s_u, s_v = (p_u, p_v) if dimension == "Length" else (1.0, 1.0)
    if down:
        s_v = -s_v
    return np.array([[s_u, 0.0, -s_u * u_0], [0.0, s_v, -s_v * v_0], [0.0, 0.0, 1.0]])


def to_openct(matrices: ProjectionMatrices) -> dict[str, Any]:
    """The JSON content, variant FreeTrajectoryCBCTScan.  Any matrix fits, skewed and mirrored ones too."""
    m = matrices
    P = detector_frame(CENTRE_DOWN, "Length", n_u=m.n_u, n_v=m.n_v, p_u=m.p_u, p_v=m.p_v) @ m.P
    P = P / P[:, 2:, 3:]
    return {
        "version": {"major": 1, "minor": 0},
        "OpenCTJSON": {"versionMajor": 1, "versionMinor": 0, "revisionNumber": 0, "variant": "FreeTrajectoryCBCTScan"},
        "hints": None,
        "units": {"length": "Millimeter", "angle": "Degree"},
        "volumeName": None,
        "projections": {
            "numProjections": len(m),
            "intensityDomain": True,
            "images": None,
            "detectorCoordinateFrame": CENTRE_DOWN,
            "detectorCoordinateDimension": "Length",
            "matrices": P.tolist(),
        },
        "geometry": {
            "detectorPixel": [m.n_u, m.n_v],
            "detectorSize": [m.n_u * m.p_u, m.n_v * m.p_v],
            "mirrorDetectorAxis": "",
            "skipAngle": 0,
            "totalAngle": None,
            "objectBoundingBox": _bounding_box(m),
        },
        "corrections": None,
    }


def _bounding_box(m: ProjectionMatrices) -> dict[str, Any]:
    """The cube of W, centred, that all views see: what readers of the format make their volume from.

    Its half side is the panel's half height or width, whichever is smaller, at the depth of W's origin; 1 mm where that
    depth is not in front of the source.
    """
    depth = np.abs(m.P[:, 2, 3])
    focal = np.linalg.norm(np.cross(m.P[:, 0, :3], m.P[:, 2, :3]), axis=1)
    seen = np.minimum(m.n_u, m.n_v * m.p_v / m.p_u) * depth / focal
    side = float(seen.min()) or 1.0
    return {"centerXYZ": [0.0, 0.0, 0.0], "sizeXYZ": [side, side, side]}


def from_openct(content: Mapping[str, object], given: Given, *, where: str = "the openCT file") -> ProjectionMatrices:
    """Matrices of an openCT JSON content.  Its detector frame says how rows count; the images' order has no part.

    A circular scan may state distances and its total angle instead.  Raises InputError where it has neither, or mirrors
    the detector.
    """
    head = _part(content, "OpenCTJSON", where)
    if not isinstance(head.get("versionMajor"), int) or head["versionMajor"] > NEWEST:
        raise SchemaVersionError(f"{where}: openCT version {head.get('versionMajor')!r}; version {NEWEST} is read")
    length = _part(content, "units", where).get("length")
    if length != "Millimeter":
        raise UnitError(f"{where}: units.length is {length!r}; 'Millimeter' is read")
    projections, geometry = _part(content, "projections", where), _part(content, "geometry", where, needed=False)
    if geometry.get("mirrorDetectorAxis"):
        raise InputError(
            f"{where}: mirrorDetectorAxis is {geometry['mirrorDetectorAxis']!r}; whether the matrices mean the images "
            "before or after the mirror is not documented; write the file without it"
        )
    table = projections.get("matrices")
    if not table:
        return _circular(head, projections, geometry, given, where)
    P = numbers(table, (-1, 3, 4), f"{where}: projections.matrices")
    announced = projections.get("numProjections")
    files = _part(projections, "images", where, needed=False).get("files")
    # A file that lists no images may leave the count at 0; any other count must be that of the matrices.
    if announced not in (None, len(P)) and not (announced == 0 and not files):
        raise InputError(f"{where}: numProjections is {announced!r} but there are {len(P)} matrices")
    size = geometry.get("detectorPixel")
    found: dict[str, Any] = {}
    if size is not None:
        n_u, n_v = (int(n) for n in numbers(size, (2,), f"{where}: detectorPixel"))
        found |= {"n_u": n_u, "n_v": n_v}
        if min(n_u, n_v) > 0 and geometry.get("detectorSize") is not None:
            w, h = numbers(geometry["detectorSize"], (2,), f"{where}: detectorSize")
            found |= {"p_u": float(w) / n_u, "p_v": float(h) / n_v}
    values = {k: given.settle(k, found.get(k), where) for k in ("n_u", "n_v", "p_u", "p_v")}
    for name in ("detectorCoordinateFrame", "detectorCoordinateDimension"):
        if name not in projections:
            raise ConventionError(f"{where} lacks projections.{name}; the matrices have no meaning without it")
    A = detector_frame(projections["detectorCoordinateFrame"], projections["detectorCoordinateDimension"], **values)
    return given.matrices(np.linalg.inv(A) @ P, **values)


def _circular(
    head: Mapping[str, object],
    projections: Mapping[str, object],
    geometry: Mapping[str, object],
    given: Given,
    where: str,
) -> ProjectionMatrices:
    """Matrices of the variant CircularTrajectoryCBCTScan, which states distances and the total angle alone.

    The source lies on the x axis of W, the panel's middle on the beam; the object turns by totalAngle / n from view to
    view, counter-clockwise about z (writers reverse the file names of a clockwise scan).
    """
    if head.get("variant") != "CircularTrajectoryCBCTScan":
        raise InputError(
            f"{where} holds no projections.matrices, and is not a circular scan (variant CircularTrajectoryCBCTScan)"
        )
    if geometry.get("skipAngle") not in (None, 0):
        raise InputError(
            f"{where}: skipAngle is {geometry['skipAngle']!r}; whether it turns the first view is not documented"
        )

    def number(section: Mapping[str, object], name: str) -> float:
        if section.get(name) is None:
            raise InputError(f"{where}: a circular scan needs {name}, which is missing")
        return float(numbers(section[name], (), f"{where}: {name}"))

    d_SO, d_OD = number(geometry, "distanceSourceObject"), number(geometry, "distanceObjectDetector")
    total, n = number(geometry, "totalAngle"), int(number(projections, "numProjections"))
    if not (d_SO > 0 and d_OD >= 0 and n > 0):
        raise InputError(f"{where}: distances {d_SO:g} and {d_OD:g} mm and {n} projections are no scan")
    (n_u, n_v), (w, h) = (numbers(geometry.get(k), (2,), f"{where}: {k}") for k in ("detectorPixel", "detectorSize"))
    values = {"n_u": int(n_u), "n_v": int(n_v), "p_u": float(w) / int(n_u), "p_v": float(h) / int(n_v)}
    settled = {k: given.settle(k, v, where) for k, v in values.items()}
    alpha = np.radians(total) * np.arange(n) / n
    c, s, o, i = np.cos(alpha), np.sin(alpha), np.zeros(n), np.ones(n)
    beam = np.stack([c, -s, o], axis=-1)
    return matrices_of_panels(
        d_SO * beam,
        -d_OD * beam,
        settled["p_u"] * np.stack([s, c, o], axis=-1),
        settled["p_v"] * np.stack([o, o, i], axis=-1),
        given=given.with_values(**settled),
        rows="bottom",
        where=where,
    )


def _part(content: Mapping[str, object], name: str, where: str, *, needed: bool = True) -> Mapping[str, Any]:
    part = content.get(name)
    if part is None and not needed:
        return {}
    if not isinstance(part, Mapping):
        raise InputError(f"{where} lacks the section {name!r}")
    return part
