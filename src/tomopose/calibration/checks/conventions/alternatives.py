"""The alternative conventions of the same data: what each would change, and the line of the input that would change.

An alternative is a function from a `Problem` to the `Problem` that would be right if the data had been written in the
other convention; None where it does not apply to these data.  The readings of the orientation columns are in
`orientation_readings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tomopose.calibration.checks.conventions.alternative import Alternative, Change
from tomopose.calibration.checks.conventions.orientation_readings import POSES, orientation_alternatives
from tomopose.calibration.model.problem import POSITION_UNITS, Problem, rotated

TABLE_OFFSET = np.radians(5.0)
ROWS = "scanner.json: the other value of image_rows"
FEWEST_PAIRS = 5


def _upside_down(p: Problem) -> Problem | None:
    """Half a turn about the beam, of images and table together: it takes a scanner into itself."""
    if not p.alpha.any():
        return None
    centre = np.array([[s.u_0, s.v_0] for s in p.scanners])[p.run]
    return replace(p, x_D=np.ascontiguousarray(2 * centre - p.x_D), alpha=-p.alpha)


def _image(matrix: tuple[tuple[int, int], tuple[int, int]]) -> Change:
    """The symmetry about the detector's centre whose linear part is `matrix`."""
    S = np.array(matrix, dtype=np.float64)

    def change(p: Problem) -> Problem | None:
        centre = np.array([[s.n_u - 1.0, s.n_v - 1.0] for s in p.scanners])[p.run] / 2
        turned = np.abs(S) @ centre[:, :, None]
        return replace(p, x_D=np.ascontiguousarray((p.x_D - centre) @ S.T + turned[..., 0]))

    return change


def _positions(M: Sequence[Sequence[float]] | np.ndarray) -> Change:
    return lambda p: replace(p, t_MH=np.ascontiguousarray(p.t_MH @ np.asarray(M, dtype=np.float64).T))


def _shift(du: float, dv: float) -> Change:
    return lambda p: replace(p, x_D=p.x_D + [du, dv])


def _inverse(p: Problem) -> Problem:
    Rt = np.swapaxes(p.R_MH, 1, 2)
    return replace(p, R_MH=np.ascontiguousarray(Rt), t_MH=np.ascontiguousarray(-(Rt @ p.t_MH[:, :, None])[..., 0]))


def _inverse_rotation(p: Problem) -> Problem:
    return rotated(p, np.swapaxes(p.R_MH, 1, 2))


def _tool_translation(p: Problem) -> Problem:
    return replace(p, t_MH=np.ascontiguousarray((p.R_MH @ p.t_MH[:, :, None])[..., 0]))


def _base_translation(p: Problem) -> Problem:
    return replace(p, t_MH=np.ascontiguousarray((np.swapaxes(p.R_MH, 1, 2) @ p.t_MH[:, :, None])[..., 0]))


def _lag(lag: int) -> Change:
    """The image of a row belongs to the pose `lag` rows further on, within its run."""

    def change(p: Problem) -> Problem | None:
        place = p.run * (int(p.index.max()) + 1 + 2 * abs(lag)) + p.index  # neighbours of a run differ by 1
        order = np.argsort(place, kind="stable")
        last = np.searchsorted(place[order], place + lag, side="right") - 1
        found = order[np.maximum(last, 0)]
        image = np.flatnonzero(place[found] == place + lag)
        if len(image) < FEWEST_PAIRS:
            return None
        return replace(
            p.select(found[image]),
            x_D=p.x_D[image],
            covariance=p.covariance[image],
            W=p.W[image],
            outline=None if p.outline is None else p.outline[image],
        )

    return change


def _alpha(sign: int, offset: float) -> Change:
    def change(p: Problem) -> Problem | None:
        return replace(p, alpha=sign * p.alpha + offset) if sign > 0 or p.alpha.any() else None

    return change


def _images() -> list[Alternative]:
    return [
        Alternative(
            name="rows flipped",
            words="image rows run the other way",
            remedy=ROWS,
            change=_image(((1, 0), (0, -1))),
            quick=True,
        ),
        Alternative(
            name="columns flipped",
            words="image columns run the other way",
            remedy="mirror the images left to right (the detector is read from behind)",
            change=_image(((-1, 0), (0, 1))),
            quick=True,
        ),
        Alternative(
            name="image turned by 180 degrees",
            words="rows and columns run the other way",
            remedy=f"{ROWS} and mirror left to right",
            change=_image(((-1, 0), (0, -1))),
            quick=True,
        ),
        Alternative(
            name="image transposed",
            words="rows and columns are exchanged",
            remedy="transpose the images (axis order [v, u])",
            change=_image(((0, 1), (1, 0))),
        ),
        Alternative(
            name="image turned by 90 degrees",
            words="the image is turned by a quarter turn",
            remedy="turn the images by 90 degrees",
            change=_image(((0, -1), (1, 0))),
        ),
        Alternative(
            name="image turned by 270 degrees",
            words="the image is turned by three quarter turns",
            remedy="turn the images by 270 degrees",
            change=_image(((0, 1), (-1, 0))),
        ),
        Alternative(
            name="image transposed and turned by 180 degrees",
            words="rows and columns are exchanged and reversed",
            remedy="transpose and turn the images",
            change=_image(((0, -1), (-1, 0))),
        ),
    ]


def _tables() -> list[Alternative]:
    return [
        Alternative(
            name="table sign",
            words="the table turns the other way",
            remedy=f"{POSES}the sign of alpha_deg",
            change=_alpha(-1, 0.0),
            quick=True,
        ),
        Alternative(
            name="image turned by 180 degrees and table sign",
            words="the scanner is upside down: images turned about the beam and the table turning the other way",
            remedy="check one labelled fact, such as an image before and after a move in +z",
            change=_upside_down,
            symmetry=True,
        ),
        Alternative(
            name="table zero",
            words="the table's zero lies elsewhere (5 degrees tried)",
            remedy="none needed while the scan uses the same zero",
            change=_alpha(1, TABLE_OFFSET),
            symmetry=True,
        ),
    ]


def _frames() -> list[Alternative]:
    return [
        Alternative(
            name="pose inverted",
            words="the poses map base to plate, or it is the scanner that moves",
            remedy=f"{POSES}invert every pose; where the scanner moves: --arrangement moving-scanner",
            change=_inverse,
            quick=True,
        ),
        Alternative(
            name="rotation inverted",
            words="only the rotations are transposed",
            remedy=f"{POSES}transpose every rotation",
            change=_inverse_rotation,
            quick=True,
        ),
        Alternative(
            name="translation in the tool frame",
            words="translations run along the moved axes",
            remedy=f"{POSES}turn the translations by the pose's rotation",
            change=_tool_translation,
            quick=True,
        ),
        Alternative(
            name="translation turned back",
            words="translations were written along fixed axes after turning",
            remedy=f"{POSES}turn the translations back by the pose's rotation",
            change=_base_translation,
        ),
    ]


def _translations() -> list[Alternative]:
    swaps = [
        Alternative(
            name=f"{a} and {b} exchanged",
            words=f"the translation columns {a} and {b} are exchanged",
            remedy=f"{POSES}exchange the columns {a}_mm and {b}_mm",
            change=_positions(M),
        )
        for a, b, M in (
            ("x", "y", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
            ("y", "z", [[1, 0, 0], [0, 0, 1], [0, 1, 0]]),
            ("x", "z", [[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
        )
    ]
    senses = [
        Alternative(
            name=f"sign of {''.join(n)}",
            words=f"translation {' and '.join(n)} counted the other way",
            remedy=f"{POSES}the sign of " + ", ".join(f"{c}_mm" for c in n),
            change=_positions(np.diag([-1.0 if c in n else 1.0 for c in "xyz"])),
        )
        for n in ("x", "y", "z", "xyz")
    ]
    units = [
        Alternative(
            name=f"positions in {name}",
            words=f"the positions are in {name} ({symbol}), not in millimetres",
            remedy=f"{POSES}multiply x_mm, y_mm and z_mm by {factor:g}",
            change=_positions(factor * np.eye(3)),
            quick=True,
            length_factor=factor,
        )
        for name, symbol, factor in POSITION_UNITS
    ]
    return [*swaps, *senses, *units]


def _pairings() -> list[Alternative]:
    return [
        Alternative(
            name=f"pairing lag {lag:+d}",
            words=f"each image belongs to the pose {abs(lag)} {'later' if lag > 0 else 'earlier'}",
            remedy="pair images and poses by name (column image or pose_id)",
            change=_lag(lag),
            quick=abs(lag) == 1,
        )
        for lag in (-3, -2, -1, 1, 2, 3)
    ]


def _pixels() -> list[Alternative]:
    return [
        Alternative(
            name="half a pixel low",
            words="(0, 0) is a pixel's corner: u and v are half a pixel too high",
            remedy="observations.csv: subtract 0.5 px from u_px and v_px",
            change=_shift(-0.5, -0.5),
        ),
        Alternative(
            name="half a pixel high",
            words="u and v are half a pixel too low",
            remedy="observations.csv: add 0.5 px to u_px and v_px",
            change=_shift(0.5, 0.5),
        ),
        Alternative(
            name="pixels counted from 1",
            words="pixels are counted from 1",
            remedy="observations.csv: subtract 1 px from u_px and v_px",
            change=_shift(-1.0, -1.0),
        ),
    ]


ALTERNATIVES = (
    *_images(),
    *_tables(),
    *_frames(),
    *_translations(),
    *_pairings(),
    *_pixels(),
    *orientation_alternatives(),
)


def _over_inverse(alternative: Alternative) -> Alternative:
    def change(p: Problem) -> Problem | None:
        changed = alternative.change(_inverse(p))
        return None if changed is None else _inverse(changed)

    if alternative.name != "pose inverted":
        return replace(alternative, change=change)
    return replace(
        alternative,
        change=change,
        words="the object moves and the scanner does not move, or the poses map base to plate",
        remedy="leave out --arrangement moving-scanner, or poses.csv: invert every pose",
    )


ALTERNATIVES_OF_MOVING_SCANNER = tuple(_over_inverse(alternative) for alternative in ALTERNATIVES)
"""The same readings of a table whose inverse poses are those of the problem."""
