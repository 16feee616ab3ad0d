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

FAR_COSINE = -0.5
"""Cosine of the angle (120 degrees) from which a logarithm is taken by quaternions: there R - R^T begins to lose it."""

GIMBAL_COSINE = 1e-9
"""Below this |cos beta| the first and third axis are parallel within rounding and only their sum is determined."""


def _about(axis: int, angle: Array | float) -> Array:
    """Rotation about x, y or z (0, 1, 2), shape (..., 3, 3)."""
    a = np.asarray(angle, dtype=np.float64)
    s, c = np.sin(a), np.cos(a)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((*a.shape, 3, 3))
    R[..., axis, axis] = 1.0
    R[..., i, i] = R[..., j, j] = c
    R[..., i, j], R[..., j, i] = -s, s
    return R


def R_x(alpha: Array | float) -> Array:
    """Rotation about x, shape (..., 3, 3).  Paper, appendix."""
    return _about(0, alpha)


def R_y(beta: Array | float) -> Array:
    """Rotation about y, shape (..., 3, 3).  Paper, appendix."""
    return _about(1, beta)


def R_z(gamma: Array | float) -> Array:
    """Rotation about z, shape (..., 3, 3).  Paper, appendix."""
    return _about(2, gamma)


ABOUT = MappingProxyType({"X": R_x, "Y": R_y, "Z": R_z})
"""The rotation about an axis, by its name."""


def rotation_from_angles(angles: Array) -> Array:
    """R = R_x(a) R_y(b) R_z(c) from angles (..., 3) in rad.  Paper, appendix."""
    angles = np.asarray(angles, dtype=np.float64)
    if angles.shape[-1:] != (3,):
        raise ShapeError(f"angles have shape {angles.shape}; three angles (..., 3) in rad are needed")
    return R_x(angles[..., 0]) @ R_y(angles[..., 1]) @ R_z(angles[..., 2])


def rotation_about_axes(axes: str, angles: Array) -> Array:
    """Rotations (n, 3, 3) of angles (n, 3), rad, about three axes in a row: capitals moved, small ones fixed."""
    first, second, third = (ABOUT[a](angles[:, k]) for k, a in enumerate(axes.upper()))
    R: Array = first @ second @ third if axes.isupper() else third @ second @ first
    return R


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
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3): the logarithm.

    R - R^T = 2 sin(a) [axis]_x and tr R = 1 + 2 cos(a); near half a turn, where the sine vanishes, by quaternions.
    """
    R = np.asarray(R, dtype=np.float64)
    twice = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    sine = np.sqrt((twice * twice).sum(axis=-1)) / 2
    cosine = (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1) / 2
    angle = np.arctan2(sine, cosine)
    w: Array = twice * (np.divide(angle, sine, out=np.ones_like(angle), where=sine > 0) / 2)[..., None]
    far = cosine < FAR_COSINE
    if far.any():
        w[far] = Rotation.from_matrix(R[far]).as_rotvec()
    return w


def rotation_angle_between(R_1: Array, R_2: Array) -> Array:
    """Angle (...,), rad, of the rotation that takes R_1 to R_2: the one honest way to compare rotations."""
    result: Array = np.linalg.norm(log_rotation(np.swapaxes(R_1, -1, -2) @ R_2), axis=-1)
    return result


def skew(x: Array) -> Array:
    """[x]_x with [x]_x y = x cross y, shape (..., 3, 3)."""
    x = np.asarray(x, dtype=np.float64)
    M = np.zeros((*x.shape, 3))
    M[..., 2, 1], M[..., 0, 2], M[..., 1, 0] = x[..., 0], x[..., 1], x[..., 2]
    M[..., 1, 2], M[..., 2, 0], M[..., 0, 1] = -x[..., 0], -x[..., 1], -x[..., 2]
    return M


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
