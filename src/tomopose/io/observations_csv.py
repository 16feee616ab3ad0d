"""observations.csv: where the ball's centre is projected in each radiograph.

The variances come back exactly: sigma is written with as many digits as its square needs, and squared in decimals.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from decimal import Context, Decimal
from pathlib import Path

import numpy as np

from tomopose.errors import InputError, UnitError
from tomopose.files import require_absent, write_text
from tomopose.io.table_text import TextTable, format_table, read_table, unknown_column
from tomopose.observations import BallObservations
from tomopose.reading import reader
from tomopose.units import Array
from tomopose.values import require_types

REQUIRED = ("pose_id", "u_px", "v_px", "sigma_u_px", "sigma_v_px")
NUMBERS = {"snr": "snr", "semi_major": "semi_major_px", "semi_minor": "semi_minor_px", "angle": "angle_rad"}
ELLIPSE = ("u_ellipse_px", "v_ellipse_px")
DIAMETER = "ball_diameter_mm"
COVARIANCE = "cov_uv_px2"
KNOWN = (*REQUIRED, "image", "ball_id", "seen", "status", *NUMBERS.values(), *ELLIPSE, COVARIANCE)
SMALLEST_SIGMA_PX, LARGEST_SIGMA_PX = 1e-9, 1e4
"""The best radiographs give 1e-4 px, and 1e-9 px is rounding; 1e4 px is wider than a panel."""
YES, NO = ("1", "true", "yes"), ("0", "false", "no")
LONG = Context(prec=40)


@reader("table of observations")
def read_observations(path: str | Path) -> BallObservations:
    """Read observations.csv.  Rows whose `seen` is 0 may have blank u, v and sigma; without that column all are seen.

    Raises InputError (with row and column) for unknown or missing columns, cells that are no numbers in a row that
    counts as seen, sigma <= 0, ids that repeat; FileError if the file cannot be read.
    """
    table = read_table(path)
    _require_known(table)
    n = len(table)
    seen = _seen(table)
    unseen = [not s for s in seen]
    x_D = np.column_stack([table.numbers(c, blank=unseen) for c in ("u_px", "v_px")])
    covariance = np.full((n, 2, 2), np.nan)
    for k, column in enumerate(("sigma_u_px", "sigma_v_px")):
        covariance[:, k, k] = _variance(table, column, unseen)
    covariance[:, 0, 1] = covariance[:, 1, 0] = (
        table.numbers(COVARIANCE, blank=unseen) if COVARIANCE in table.columns else np.where(seen, 0.0, np.nan)
    )
    anywhere = [True] * n
    numbers = {k: table.numbers(c, blank=anywhere) for k, c in NUMBERS.items() if c in table.columns}
    ellipse = [c in table.columns for c in ELLIPSE]
    if any(ellipse) and not all(ellipse):
        raise InputError(f"{table.path}: columns {' and '.join(ELLIPSE)} belong together; one is missing")
    try:
        return BallObservations(
            x_D=x_D,
            covariance=covariance,
            pose_id=table.words("pose_id"),
            seen=seen,
            status=table.words("status") if "status" in table.columns else None,
            image=table.words("image") if "image" in table.columns else None,
            x_ellipse=np.column_stack([table.numbers(c, blank=anywhere) for c in ELLIPSE]) if all(ellipse) else None,
            ball_id=table.whole_numbers("ball_id") if "ball_id" in table.columns else None,
            ball_diameter=_ball_diameter(table),
            **numbers,
        )
    except InputError as error:
        raise InputError(f"{table.path}: {error}") from error


def _require_known(table: TextTable) -> None:
    for column in table.columns:
        if column in KNOWN:
            continue
        with_unit = [k for k in KNOWN if k.rpartition("_")[0] == column]
        if with_unit:
            raise UnitError(f"{table.path}: column {column!r} has no unit; write {with_unit[0]!r}")
        raise InputError(f"{table.path}: column {column!r} is unknown{unknown_column(column, KNOWN)}")
    missing = [c for c in REQUIRED if c not in table.columns]
    if missing:
        raise InputError(f"{table.path}: columns {', '.join(missing)} are missing; found {', '.join(table.columns)}")


def _ball_diameter(table: TextTable) -> float | None:
    text = table.comments.get(DIAMETER)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{table.path}: {DIAMETER} is {text!r}; a number of millimetres is needed") from None


def _seen(table: TextTable) -> list[bool]:
    if "seen" not in table.columns:
        return [True] * len(table)
    cells = [cell.lower() for cell in table.words("seen")]
    for i, cell in enumerate(cells):
        if cell not in YES + NO:
            raise InputError(f"{table.where(i, 'seen')}: {cell!r} is neither 1 nor 0")
    return [cell in YES for cell in cells]


def _variance(table: TextTable, column: str, unseen: Sequence[bool]) -> Array:
    sigma = table.numbers(column, blank=unseen)
    for i in np.flatnonzero(sigma <= 0):
        raise InputError(f"{table.where(int(i), column)}: sigma is {sigma[i]:g} px; it must be above 0")
    for i in np.flatnonzero((sigma < SMALLEST_SIGMA_PX) | (sigma > LARGEST_SIGMA_PX)):
        raise InputError(
            f"{table.where(int(i), column)}: sigma is {sigma[i]:g} px; a centre is measured to between "
            f"{SMALLEST_SIGMA_PX:g} and {LARGEST_SIGMA_PX:g} px"
        )
    k = table.columns.index(column)
    return np.array(
        [
            np.nan if np.isnan(s) else variance_from_cell(table.digits(row[k]))
            for s, row in zip(sigma, table.rows, strict=True)
        ]
    )


def variance_from_cell(cell: str) -> float:
    """The float nearest to the square of a decimal number."""
    return float(LONG.multiply(Decimal(cell), Decimal(cell)))


def sigma_cell(variance: float) -> str:
    """The shortest decimal number whose square is that variance; blank where it is not known."""
    if not (np.isfinite(variance) and variance > 0):
        return ""
    short = repr(float(np.sqrt(variance)))
    return short if variance_from_cell(short) == variance else str(Context(prec=22).sqrt(Decimal(float(variance))))


@require_types
def write_observations(
    path: str | Path, obs: BallObservations, *, comments: Iterable[tuple[str, str]] = (), force: bool = False
) -> None:
    """Write observations.csv; values that are not finite become blank.  FileError if it exists and not `force`."""
    path = require_absent(path, force=force)
    assert obs.status is not None
    C = obs.covariance
    columns: dict[str, Sequence[object]] = {
        "pose_id": obs.pose_id,
        "u_px": obs.x_D[:, 0].tolist(),
        "v_px": obs.x_D[:, 1].tolist(),
        "sigma_u_px": [sigma_cell(c) for c in C[:, 0, 0]],
        "sigma_v_px": [sigma_cell(c) for c in C[:, 1, 1]],
    }
    if np.any(C[:, 0, 1][np.isfinite(C[:, 0, 1])] != 0):
        columns[COVARIANCE] = C[:, 0, 1].tolist()
    if obs.image is not None:
        columns["image"] = obs.image
    if obs.ball_id is not None:
        columns["ball_id"] = obs.ball_id.tolist()
    columns["seen"] = [int(s) for s in obs.seen]
    columns["status"] = obs.status
    for name, column in NUMBERS.items():
        values = getattr(obs, name)
        if values is not None:
            columns[column] = np.where(np.isfinite(values), values, np.nan).tolist()
    if obs.x_ellipse is not None:
        columns |= {c: obs.x_ellipse[:, k].tolist() for k, c in enumerate(ELLIPSE)}
    diameter = {} if obs.ball_diameter is None else {DIAMETER: repr(obs.ball_diameter)}
    write_text(path, format_table(diameter | dict(comments), columns))
