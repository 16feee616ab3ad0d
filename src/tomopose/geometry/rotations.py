"""Rotation matrices and angles (paper, appendix), and the named conventions of robot makers.

The paper's order, which the hexapod's controller uses too, is R = R_x(a) R_y(b) R_z(c).  Angles are for people and
files; inside, rotations are matrices, and two of them are compared by their logarithm, never by their angles.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, cast

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.errors import ConventionError, InputError, ShapeError
from tomopose.units import Array

GIMBAL_COSINE = 1e-9
"""Below this |cos beta| the first and third axis are parallel within rounding and only their sum is determined."""


def _stack(rows: list[list[Array]]) -> Array:
    shape = np.broadcast_shapes(*(np.shape(x) for row in rows for x in row))
    M = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, x in enumerate(row):
            M[..., i, j] = x
    return M


def R_x(alpha: Array | float) -> Array:
    """Rotation about x, shape (..., 3, 3).  Paper, appendix."""
    a = np.asarray(alpha, dtype=np.float64)
    s, c, o, i = np.sin(a), np.cos(a), np.zeros_like(a), np.ones_like(a)
    return _stack([[i, o, o], [o, c, -s], [o, s, c]])


def R_y(beta: Array | float) -> Array:
    """Rotation about y, shape (..., 3, 3).  Paper, appendix."""
    b = np.asarray(beta, dtype=np.float64)
    s, c, o, i = np.sin(b), np.cos(b), np.zeros_like(b), np.ones_like(b)
    return _stack([[c, o, s], [o, i, o], [-s, o, c]])


def R_z(gamma: Array | float) -> Array:
    """Rotation about z, shape (..., 3, 3).  Paper, appendix."""
    g = np.asarray(gamma, dtype=np.float64)
    s, c, o, i = np.sin(g), np.cos(g), np.zeros_like(g), np.ones_like(g)
    return _stack([[c, -s, o], [s, c, o], [o, o, i]])


def rotation_from_angles(angles: Array) -> Array:
    """R = R_x(a) R_y(b) R_z(c) from angles (..., 3) in rad.  Paper, appendix."""
    angles = np.asarray(angles, dtype=np.float64)
    if angles.shape[-1:] != (3,):
        raise ShapeError(f"angles have shape {angles.shape}; three angles (..., 3) in rad are needed")
    return R_x(angles[..., 0]) @ R_y(angles[..., 1]) @ R_z(angles[..., 2])


def angles_from_rotation(R: Array) -> Array:
    """Angles (a, b, c), rad, with R = R_x(a) R_y(b) R_z(c) and |b| <= pi/2.  Paper, appendix.

    At the gimbal lock (|b| = pi/2) only a +- c is determined; c = 0 is chosen there, and the angles still give R.
    """
    R = np.asarray(R, dtype=np.float64)
    cos_b = np.hypot(R[..., 0, 0], R[..., 0, 1])
    b = np.arctan2(R[..., 0, 2], cos_b)  # arcsin R13, written so that it is exact near the poles too
    locked = cos_b < GIMBAL_COSINE
    a = np.where(locked, np.arctan2(R[..., 2, 1], R[..., 1, 1]), np.arctan2(-R[..., 1, 2], R[..., 2, 2]))
    c = np.where(locked, 0.0, np.arctan2(-R[..., 0, 1], R[..., 0, 0]))
    return np.stack([a, b, c], axis=-1) + 0.0  # without minus zeros, which would reach files


def exp_rotation(w: Array) -> Array:
    """Rotation matrices from rotation vectors (..., 3), rad."""
    w = np.array(w, dtype=np.float64)  # SciPy takes no read-only array
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape[:-1], 3, 3)


def log_rotation(R: Array) -> Array:
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3): the logarithm."""
    R = np.asarray(R, dtype=np.float64)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def rotation_angle_between(R_1: Array, R_2: Array) -> Array:
    """Angle (...,), rad, of the rotation that takes R_1 to R_2: the one honest way to compare rotations."""
    result: Array = np.linalg.norm(log_rotation(np.swapaxes(R_1, -1, -2) @ R_2), axis=-1)
    return result


def skew(x: Array) -> Array:
    """[x]_x with [x]_x y = x cross y, shape (..., 3, 3)."""
    x = np.asarray(x, dtype=np.float64)
    o = np.zeros_like(x[..., 0])
    return _stack([[o, -x[..., 2], x[..., 1]], [x[..., 2], o, -x[..., 0]], [-x[..., 1], x[..., 0], o]])


@dataclass(frozen=True, kw_only=True)
class Convention:
    """How a machine writes an orientation.

    columns:  its angle columns in poses.csv, in file order.
    kind:     euler | rotvec | quaternion.
    axes:     for euler, scipy's code (capitals: about moved axes; small letters: about fixed axes).
    unit:     deg | rad | none.
    """

    name: str
    kind: Literal["euler", "rotvec", "quaternion"]
    columns: tuple[str, ...]
    axes: str = ""
    scalar_first: bool = True
    unit: Literal["deg", "rad", "none"] = "deg"
    source: str = ""


_RXYZ = ("rx_deg", "ry_deg", "rz_deg")

CONVENTIONS = MappingProxyType(
    {
        c.name: c
        for c in (
            Convention(name="pi-hexapod", kind="euler", columns=_RXYZ, axes="XYZ", source="paper, appendix; PI: U V W"),
            Convention(name="symetrie-hexapod", kind="euler", columns=_RXYZ, axes="xyz", source="API manual"),
            Convention(name="kuka", kind="euler", columns=("a_deg", "b_deg", "c_deg"), axes="ZYX", source="KUKA A B C"),
            Convention(name="fanuc", kind="euler", columns=("w_deg", "p_deg", "r_deg"), axes="xyz", source="W P R"),
            Convention(name="yaskawa", kind="euler", columns=_RXYZ, axes="xyz", source="Rx Ry Rz, fixed axes"),
            Convention(name="staubli", kind="euler", columns=_RXYZ, axes="XYZ", source="RX RY RZ, moved axes"),
            Convention(
                name="abb",
                kind="quaternion",
                columns=("q1", "q2", "q3", "q4"),
                scalar_first=True,
                unit="none",
                source="RAPID orient, (w, x, y, z)",
            ),
            Convention(
                name="ur", kind="rotvec", columns=("rx_rad", "ry_rad", "rz_rad"), unit="rad", source="rotation vector"
            ),
            Convention(name="kawasaki", kind="euler", columns=("o_deg", "a_deg", "t_deg"), axes="ZYZ", source="O A T"),
            Convention(
                name="quaternion-wxyz",
                kind="quaternion",
                columns=("qw", "qx", "qy", "qz"),
                scalar_first=True,
                unit="none",
                source="scalar first",
            ),
            Convention(
                name="quaternion-xyzw",
                kind="quaternion",
                columns=("qx", "qy", "qz", "qw"),
                scalar_first=False,
                unit="none",
                source="scalar last",
            ),
            Convention(
                name="rotvec",
                kind="rotvec",
                columns=("rx_rad", "ry_rad", "rz_rad"),
                unit="rad",
                source="axis times angle",
            ),
        )
    }
)
"""The named conventions, `# convention: NAME` in poses.csv."""

QUATERNION_NORM_TOLERANCE = 1e-3


def convention_named(name: str) -> Convention:
    """The convention of that name; ConventionError lists the known ones."""
    try:
        return CONVENTIONS[name]
    except KeyError:
        raise ConventionError(f"unknown convention {name!r}; known are: {', '.join(CONVENTIONS)}") from None


def rotation_from_convention(values: Array, convention: str) -> Array:
    """Rotation matrices (n, 3, 3) from a machine's orientation columns (n, 3 or 4), in the convention's unit."""
    c = convention_named(convention)
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(c.columns):
        columns = ", ".join(c.columns)
        raise ShapeError(f"convention {c.name} has columns {columns}; got an array of shape {values.shape}")
    if c.kind == "quaternion":
        norm = np.linalg.norm(values, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1) > QUATERNION_NORM_TOLERANCE)
        if bad.size:
            raise InputError(
                f"row {bad[0] + 1}: quaternion has norm {norm[bad[0]]:.6g}, not 1; "
                "check the columns' order and that no component is missing"
            )
        return Rotation.from_quat(values, scalar_first=c.scalar_first).as_matrix()
    if c.kind == "rotvec":
        return exp_rotation(values)
    return Rotation.from_euler(c.axes, values, degrees=c.unit == "deg").as_matrix()


def convention_from_rotation(R: Array, convention: str) -> Array:
    """The orientation columns (n, 3 or 4) of a convention, in its unit: the inverse of `rotation_from_convention`."""
    c = convention_named(convention)
    R = np.asarray(R, dtype=np.float64)
    if c.axes == "XYZ":
        return np.degrees(angles_from_rotation(R))
    rotation = Rotation.from_matrix(R)
    if c.kind == "quaternion":
        return rotation.as_quat(canonical=True, scalar_first=c.scalar_first)
    if c.kind == "rotvec":
        return rotation.as_rotvec()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")  # the angles chosen there still give R
        return rotation.as_euler(cast(Any, c.axes), degrees=c.unit == "deg")
