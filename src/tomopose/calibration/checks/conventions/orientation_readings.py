"""Other readings of a pose table's orientation columns: angle orders, signs, units, rotation vectors, quaternions.

A table holds three or four numbers a pose.  Which rotation they mean is a declaration; every reading here takes the
same numbers for another kind of rotation.  Three numbers are named for axes (A, B, C of a KUKA for z, y, x) and are
in an order, so each reading is tried for the numbers by the axis that names them and in the reversed order.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.calibration.checks.conventions.alternative import Alternative, Change
from tomopose.calibration.model.problem import Problem, rotated
from tomopose.geometry.rotations import CONVENTIONS, convention_from_rotation, exp_rotation, rotation_about_axes
from tomopose.units import Array

EULER_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
PROPER_EULER = ("ZYZ", "ZXZ")
DEG = np.pi / 180.0
SIGNED = "UVW"
POSES = "poses.csv: "


def _written(p: Problem) -> tuple[str, Any, Array]:
    """(kind, scipy's axes of euler angles, columns (n, 3) rad or (n, 4)) as the table declares and holds them."""
    convention = CONVENTIONS.get(p.convention)
    if convention is None:
        return "euler", "XYZ", convention_from_rotation(p.R_MH, "pi-hexapod") * DEG
    columns = convention_from_rotation(p.R_MH, convention.name) if p.orientations is None else p.orientations
    # a copy, since scipy wants arrays that it may write to
    return convention.kind, convention.axes, np.array(columns) * (DEG if convention.unit == "deg" else 1.0)


def _by_axis(p: Problem) -> tuple[str, Any, Array]:
    """(kind, axes, (n, 3) rad: the numbers named for x, y, z).  Quaternions: the angles of R_x R_y R_z that they make.

    O, A, T of z-y-z are named for no axis; they are taken in their order.
    """
    kind, axes, columns = _written(p)
    if kind == "quaternion":
        return "quaternion", "XYZ", convention_from_rotation(p.R_MH, "pi-hexapod") * DEG
    if kind == "rotvec" or axes[0].upper() == axes[2].upper():
        return kind, axes, columns
    return kind, axes, columns[:, np.argsort(list(axes.upper()))]


def moved_axes(axes: str) -> str:
    """Every order about fixed axes is the reversed one about moved axes."""
    return axes if axes.isupper() else axes[::-1].upper()


def _as_declared(kind: str, axes: str, xyz: Array) -> Array:
    """The rotations of numbers by axis under the declared kind."""
    if kind == "rotvec":
        return exp_rotation(xyz)
    if axes[0].upper() == axes[2].upper():
        return rotation_about_axes(axes, xyz)
    return rotation_about_axes(axes, xyz[:, ["XYZ".index(a) for a in axes.upper()]])


def _signs(signs: tuple[int, int, int]) -> Change:
    return lambda p: rotated(p, _with(p, np.array(signs, dtype=np.float64)))


def _with(p: Problem, factor: float | Array) -> Array:
    kind, axes, xyz = _by_axis(p)
    return _as_declared(kind, axes, factor * xyz)


def _angle_factor(factor: float) -> Change:
    def change(p: Problem) -> Problem | None:
        return None if _written(p)[0] == "quaternion" else rotated(p, _with(p, factor))

    return change


def _order(order: str, *, reversed_columns: bool = False) -> Change:
    def change(p: Problem) -> Problem | None:
        kind, axes, xyz = _by_axis(p)
        declared = kind in ("euler", "quaternion") and moved_axes(axes) == order
        if (declared and not reversed_columns) or (reversed_columns and kind == "quaternion"):
            return None
        columns = xyz[:, ::-1] if reversed_columns else xyz
        return rotated(p, rotation_about_axes(order, columns[:, ["XYZ".index(a) for a in order]]))

    return change


def _proper_euler(order: str) -> Change:
    def change(p: Problem) -> Problem | None:
        kind, axes, columns = _written(p)
        if kind == "quaternion" or (kind == "euler" and axes == order):
            return None
        return rotated(p, rotation_about_axes(order, columns))

    return change


def _rotation_vector(unit: str, *, reversed_columns: bool = False) -> Change:
    def change(p: Problem) -> Problem | None:
        kind, _, xyz = _by_axis(p)
        if kind == "quaternion" or (kind == "rotvec" and not reversed_columns):
            return None
        declared = CONVENTIONS[p.convention].unit if p.convention in CONVENTIONS else "deg"
        factor = 1.0 if unit == declared else DEG if unit == "deg" else 1.0 / DEG
        vectors = factor * (xyz[:, ::-1] if reversed_columns else xyz)
        return rotated(p, exp_rotation(vectors))

    return change


def _quaternion(*, scalar_first: bool) -> Change:
    def change(p: Problem) -> Problem | None:
        kind, _, columns = _written(p)
        if kind != "quaternion" or CONVENTIONS[p.convention].scalar_first == scalar_first:
            return None
        return rotated(p, Rotation.from_quat(columns, scalar_first=scalar_first).as_matrix())

    return change


def product(order: str) -> str:
    """R_x R_y R_z of "XYZ"."""
    return " ".join(f"R_{axis}" for axis in order.lower())


def _order_remedy(order: str) -> str:
    named = [c.name for c in CONVENTIONS.values() if c.axes and moved_axes(c.axes) == order]
    if named:
        return f"{POSES}# convention: {' or '.join(named)}, with that convention's columns (angles in degrees)"
    return f"{POSES}rewrite the angles in a named convention; {product(order)} has no name here"


def _order_words(order: str) -> str:
    fixed = ", ".join(order[::-1].lower())
    also = "; roll, pitch, yaw" if order == "ZYX" else ""
    return f"the angles are those of {product(order)} (rotations about fixed axes {fixed}{also})"


def _orders() -> list[Alternative]:
    straight = [
        Alternative(
            name=f"order {o}",
            words=_order_words(o),
            remedy=_order_remedy(o),
            change=_order(o),
            quick=o in ("ZYX", "XYZ"),
        )
        for o in EULER_ORDERS
    ]
    turned = [
        Alternative(
            name=f"order {o}, columns reversed",
            words=f"{_order_words(o)}, and the first and the third angle column are exchanged",
            remedy=f"{_order_remedy(o)}; exchange the first and the third angle column",
            change=_order(o, reversed_columns=True),
        )
        for o in EULER_ORDERS
    ]
    proper = [
        Alternative(
            name=f"order {o}",
            words=f"the angles are Euler angles {'-'.join(o.lower())}: {product(o)}",
            remedy=_order_remedy(o),
            change=_proper_euler(o),
            quick=o == "ZYZ",
        )
        for o in PROPER_EULER
    ]
    return [*straight, *turned, *proper]


def _vectors() -> list[Alternative]:
    return [
        Alternative(
            name=f"rotation vector in {unit}{', columns reversed' if backwards else ''}",
            words=f"the three numbers are a rotation vector in {unit}"
            + (", with its first and third component exchanged" if backwards else ""),
            remedy=f"{POSES}# convention: rotvec, with the columns rx_rad, ry_rad, rz_rad in radians",
            change=_rotation_vector(short, reversed_columns=backwards),
            quick=not backwards,
        )
        for short, unit in (("deg", "degrees"), ("rad", "radians"))
        for backwards in (False, True)
    ]


def _sign_changes() -> list[Alternative]:
    sets = [s for k in (1, 2, 3) for s in combinations(range(3), k)]
    found = []
    for s in sets:
        names = "".join(SIGNED[i] for i in s)
        signs = (-1 if 0 in s else 1, -1 if 1 in s else 1, -1 if 2 in s else 1)
        found.append(
            Alternative(
                name=f"sign of {names}",
                words=f"rotation {' and '.join(names)} counted the other way",
                remedy=f"{POSES}the sign of the angle columns {', '.join(names)} (about x, y, z)",
                change=_signs(signs),
                quick=len(names) in (1, 3),
            )
        )
    return found


def _quaternions() -> list[Alternative]:
    return [
        Alternative(
            name=f"quaternion w {place}",
            words=f"the quaternion is written with w {place}",
            remedy=f"{POSES}# convention: {convention}, with the columns {columns}",
            change=_quaternion(scalar_first=place == "first"),
            quick=True,
        )
        for place, convention, columns in (
            ("first", "quaternion-wxyz", "qw, qx, qy, qz"),
            ("last", "quaternion-xyzw", "qx, qy, qz, qw"),
        )
    ]


def _angle_units() -> list[Alternative]:
    return [
        Alternative(
            name="angles are radians",
            words="the angles that were read as degrees are radians",
            remedy=f"{POSES}convert the angles to degrees",
            change=_angle_factor(1.0 / DEG),
        ),
        Alternative(
            name="angles are degrees",
            words="the angles that were read as radians are degrees",
            remedy=f"{POSES}convert the angles to radians",
            change=_angle_factor(DEG),
        ),
    ]


def orientation_alternatives() -> tuple[Alternative, ...]:
    """All of the above."""
    return (*_sign_changes(), *_orders(), *_vectors(), *_quaternions(), *_angle_units())
