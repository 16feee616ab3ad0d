"""The list of rival readings of the same data: what each would change, and the line that would cure it.

A rival is a function from a `Problem` to the `Problem` that would be right if the data had been written in the rival's
convention; None where it does not apply to these data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.calibration.model.problem import Problem
from tomopose.geometry.rotations import CONVENTIONS
from tomopose.units import Array

EULER_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
TABLE_OFFSET = np.radians(5.0)


@dataclass(frozen=True, kw_only=True)
class Rival:
    """name: short, fixed;  words: what would be so;  cure: what to change in the input;  change: see above;
    quick: tried by every calibration;  symmetry: the data are the same by nature, in any plan."""

    name: str
    words: str
    cure: str
    change: Callable[[Problem], Problem | None]
    quick: bool = False
    symmetry: bool = False


def _angles(p: Problem) -> tuple[Any, Array]:
    """(scipy's axes, angles (n, 3) rad) in which the poses were written; R_x R_y R_z for conventions without angles."""
    convention = CONVENTIONS.get(p.convention)
    axes: Any = convention.axes if convention is not None and convention.axes else "XYZ"
    if axes[0].upper() == axes[2].upper():
        axes = "XYZ"
    return axes, Rotation.from_matrix(p.R_MH).as_euler(axes, suppress_warnings=True)


def _rotated(p: Problem, R: Array) -> Problem:
    return replace(p, R_MH=np.ascontiguousarray(R))


def _signs(signs: tuple[int, int, int]) -> Callable[[Problem], Problem | None]:
    def change(p: Problem) -> Problem | None:
        axes, angles = _angles(p)
        by_axis = np.array([signs["XYZ".index(a)] for a in axes.upper()])
        return _rotated(p, Rotation.from_euler(axes, by_axis * angles).as_matrix())

    return change


def _order(order: str) -> Callable[[Problem], Problem | None]:
    def change(p: Problem) -> Problem | None:
        axes, angles = _angles(p)
        # every order about fixed axes is the reversed one about moved axes
        moved = axes if axes.isupper() else axes[::-1].upper()
        if order == moved:
            return None
        columns = angles if axes.isupper() else angles[:, ::-1]
        by_axis = {a: columns[:, i] for i, a in enumerate(moved)}
        return _rotated(p, Rotation.from_euler(order, np.column_stack([by_axis[a] for a in order])).as_matrix())

    return change


def _angle_factor(factor: float) -> Callable[[Problem], Problem | None]:
    def change(p: Problem) -> Problem | None:
        axes, angles = _angles(p)
        return _rotated(p, Rotation.from_euler(axes, factor * angles).as_matrix())

    return change


def _upside_down(p: Problem) -> Problem | None:
    """Half a turn about the beam, of images and table together: it takes a scanner into itself."""
    if not p.alpha.any():
        return None
    centre = np.array([[p.scanners[r].u_0, p.scanners[r].v_0] for r in p.run])
    return replace(p, x_D=np.ascontiguousarray(2 * centre - p.x_D), alpha=-p.alpha)


def _image(matrix: tuple[tuple[int, int], tuple[int, int]]) -> Callable[[Problem], Problem | None]:
    """The symmetry about the detector's centre whose linear part is `matrix`."""
    S = np.array(matrix, dtype=np.float64)

    def change(p: Problem) -> Problem | None:
        sizes = np.array([[p.scanners[r].n_u - 1.0, p.scanners[r].n_v - 1.0] for r in p.run])
        centre = sizes / 2
        turned = np.abs(S) @ centre[:, :, None]
        return replace(p, x_D=np.ascontiguousarray((p.x_D - centre) @ S.T + turned[..., 0]))

    return change


def _axes_signs(M: Any) -> Callable[[Problem], Problem | None]:
    return lambda p: replace(p, t_MH=np.ascontiguousarray(p.t_MH @ np.asarray(M, dtype=np.float64).T))


def _shift(du: float, dv: float) -> Callable[[Problem], Problem | None]:
    return lambda p: replace(p, x_D=p.x_D + [du, dv])


def _inverse(p: Problem) -> Problem:
    Rt = np.swapaxes(p.R_MH, 1, 2)
    return replace(p, R_MH=np.ascontiguousarray(Rt), t_MH=np.ascontiguousarray(-(Rt @ p.t_MH[:, :, None])[..., 0]))


def _inverse_rotation(p: Problem) -> Problem:
    return _rotated(p, np.swapaxes(p.R_MH, 1, 2))


def _tool_translation(p: Problem) -> Problem:
    return replace(p, t_MH=np.ascontiguousarray((p.R_MH @ p.t_MH[:, :, None])[..., 0]))


def _base_translation(p: Problem) -> Problem:
    return replace(p, t_MH=np.ascontiguousarray((np.swapaxes(p.R_MH, 1, 2) @ p.t_MH[:, :, None])[..., 0]))


def _lag(lag: int) -> Callable[[Problem], Problem | None]:
    """The image of a row belongs to the pose `lag` rows further on, within its run."""

    def change(p: Problem) -> Problem | None:
        where = {(int(r), int(i)): k for k, (r, i) in enumerate(zip(p.run, p.index, strict=True))}
        pairs = [
            (k, where[int(r), int(i) + lag])
            for k, (r, i) in enumerate(zip(p.run, p.index, strict=True))
            if (int(r), int(i) + lag) in where
        ]
        if len(pairs) < 5:
            return None
        image, pose = (np.array(column) for column in zip(*pairs, strict=True))
        of_pose, of_image = p.select(pose), p.select(image)
        return replace(of_pose, x_D=of_image.x_D, covariance=of_image.covariance, W=of_image.W)

    return change


def _alpha(sign: int, offset: float) -> Callable[[Problem], Problem | None]:
    def change(p: Problem) -> Problem | None:
        return replace(p, alpha=sign * p.alpha + offset) if sign > 0 or p.alpha.any() else None

    return change


_ROWS = "scanner.json: the other value of image_rows"
_POSES = "poses.csv: "


def _product(order: str) -> str:
    return " ".join(f"R_{axis}" for axis in order.lower())


def _order_cure(order: str) -> str:
    named = [c.name for c in CONVENTIONS.values() if c.axes in (order, order[::-1].lower())]
    if named:
        return "# convention: " + " or ".join(named)
    return f"rewrite the angles in a named convention; {_product(order)} has no name here"


def _list() -> tuple[Rival, ...]:
    image = [
        Rival(
            name="rows flipped",
            words="image rows run the other way",
            cure=_ROWS,
            change=_image(((1, 0), (0, -1))),
            quick=True,
        ),
        Rival(
            name="columns flipped",
            words="image columns run the other way",
            cure="mirror the images left to right (the detector is read from behind)",
            change=_image(((-1, 0), (0, 1))),
            quick=True,
        ),
        Rival(
            name="image turned by 180 degrees",
            words="rows and columns run the other way",
            cure=f"{_ROWS} and mirror left to right",
            change=_image(((-1, 0), (0, -1))),
            quick=True,
        ),
        Rival(
            name="image transposed",
            words="rows and columns are exchanged",
            cure="transpose the images (axis order [v, u])",
            change=_image(((0, 1), (1, 0))),
        ),
        Rival(
            name="image turned by 90 degrees",
            words="the image is turned by a quarter turn",
            cure="turn the images by 90 degrees",
            change=_image(((0, -1), (1, 0))),
        ),
        Rival(
            name="image turned by 270 degrees",
            words="the image is turned by three quarter turns",
            cure="turn the images by 270 degrees",
            change=_image(((0, 1), (-1, 0))),
        ),
        Rival(
            name="image transposed and turned by 180 degrees",
            words="rows and columns exchanged and reversed",
            cure="transpose and turn the images",
            change=_image(((0, -1), (-1, 0))),
        ),
    ]
    table = [
        Rival(
            name="table sign",
            words="the table turns the other way",
            cure=_POSES + "the sign of alpha_deg",
            change=_alpha(-1, 0.0),
            quick=True,
        ),
        Rival(
            name="image turned by 180 degrees and table sign",
            words="the scanner stands upside down: images turned about the beam and the table turning the other way",
            cure="check one labelled fact, such as an image before and after a move in +z",
            change=_upside_down,
            symmetry=True,
        ),
        Rival(
            name="table zero",
            words="the table's zero lies elsewhere (5 degrees tried)",
            cure="none needed while the scan uses the same zero",
            change=_alpha(1, TABLE_OFFSET),
            symmetry=True,
        ),
    ]
    axis = "UVW"
    signs = []
    for s in ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, -1)):
        turned = "".join(a for a, one in zip(axis, s, strict=True) if one < 0)
        signs.append(
            Rival(
                name=f"sign of {turned}",
                words=f"rotation {' and '.join(turned)} counted the other way",
                cure=_POSES + f"the sign of the angle columns {', '.join(turned)}",
                change=_signs(s),
                quick=len(turned) in (1, 3),
            )
        )
    orders = [
        Rival(
            name=f"order {o}",
            words=f"the angles are those of {_product(o)}",
            cure=_POSES + _order_cure(o),
            change=_order(o),
            quick=o in ("ZYX", "XYZ"),
        )
        for o in EULER_ORDERS
    ]
    frames = [
        Rival(
            name="pose inverted",
            words="the poses map base to plate, or it is the scanner that moves",
            cure=_POSES + "invert every pose; where the scanner moves: --arrangement moving-scanner",
            change=_inverse,
            quick=True,
        ),
        Rival(
            name="rotation inverted",
            words="only the rotations are transposed",
            cure=_POSES + "transpose every rotation",
            change=_inverse_rotation,
            quick=True,
        ),
        Rival(
            name="translation in the tool frame",
            words="translations run along the moved axes",
            cure=_POSES + "turn the translations by the pose's rotation",
            change=_tool_translation,
            quick=True,
        ),
        Rival(
            name="translation turned back",
            words="translations were written along fixed axes after turning",
            cure=_POSES + "turn the translations back by the pose's rotation",
            change=_base_translation,
        ),
    ]
    swaps = [
        Rival(
            name=f"{a} and {b} exchanged",
            words=f"the translation columns {a} and {b} are exchanged",
            cure=_POSES + f"exchange the columns {a}_mm and {b}_mm",
            change=_axes_signs(M),
        )
        for a, b, M in (
            ("x", "y", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
            ("y", "z", [[1, 0, 0], [0, 0, 1], [0, 1, 0]]),
            ("x", "z", [[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
        )
    ]
    senses = [
        Rival(
            name=f"sign of {''.join(n)}",
            words=f"translation {' and '.join(n)} counted the other way",
            cure=_POSES + "the sign of " + ", ".join(f"{c}_mm" for c in n),
            change=_axes_signs(np.diag([-1.0 if c in n else 1.0 for c in "xyz"])),
        )
        for n in ("x", "y", "z", "xyz")
    ]
    lags = [
        Rival(
            name=f"pairing lag {lag:+d}",
            words=f"each image belongs to the pose {abs(lag)} {'later' if lag > 0 else 'earlier'}",
            cure="pair images and poses by name (column image or pose_id)",
            change=_lag(lag),
            quick=abs(lag) == 1,
        )
        for lag in (-3, -2, -1, 1, 2, 3)
    ]
    units = [
        Rival(
            name="angles are radians",
            words="the angles read as degrees are radians",
            cure=_POSES + "convert the angles to degrees",
            change=_angle_factor(180.0 / np.pi),
        ),
        Rival(
            name="angles are degrees",
            words="the angles read as radians are degrees",
            cure=_POSES + "convert the angles to radians",
            change=_angle_factor(np.pi / 180.0),
        ),
        Rival(
            name="half a pixel low",
            words="(0, 0) is a pixel's corner: u and v are half a pixel too high",
            cure="observations.csv: subtract 0.5 px from u_px and v_px",
            change=_shift(-0.5, -0.5),
        ),
        Rival(
            name="half a pixel high",
            words="u and v are half a pixel too low",
            cure="observations.csv: add 0.5 px to u_px and v_px",
            change=_shift(0.5, 0.5),
        ),
        Rival(
            name="pixels counted from 1",
            words="pixels are counted from 1",
            cure="observations.csv: subtract 1 px from u_px and v_px",
            change=_shift(-1.0, -1.0),
        ),
    ]
    return (*image, *table, *signs, *orders, *frames, *swaps, *senses, *lags, *units)


RIVALS = _list()


def _over_inverse(rival: Rival) -> Rival:
    def change(p: Problem) -> Problem | None:
        changed = rival.change(_inverse(p))
        return None if changed is None else _inverse(changed)

    if rival.name != "pose inverted":
        return replace(rival, change=change)
    return replace(
        rival,
        change=change,
        words="the object moves and the scanner stands still, or the poses map base to plate",
        cure="leave out --arrangement moving-scanner, or poses.csv: invert every pose",
    )


RIVALS_OF_MOVING_SCANNER = tuple(_over_inverse(rival) for rival in RIVALS)
"""The same readings of a table whose inverse poses stand in the problem."""
