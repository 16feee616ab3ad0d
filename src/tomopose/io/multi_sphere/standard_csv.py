"""standard.csv: the certificate of a standard of several balls as a table.

Columns `ball, x_mm, y_mm, z_mm, diameter_mm`, and `sigma_mm`, the standard uncertainty of each coordinate, where it
differs from ball to ball; `# sigma_mm: 0.0005` states one for all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.standard import SphereStandard
from tomopose.errors import InputError, TomoposeError
from tomopose.files import require_absent, write_text
from tomopose.io.table_text import format_table, read_table, unknown_column
from tomopose.reading import reader
from tomopose.values import require_types

NAME, OTHER_NAME, SIGMA = "ball", "sphere", "sigma_mm"
COORDINATES = ("x_mm", "y_mm", "z_mm")
DIAMETER = "diameter_mm"
KNOWN = (NAME, OTHER_NAME, *COORDINATES, DIAMETER, SIGMA)


@reader("table of a standard's balls")
def read_standard(path: str | Path) -> SphereStandard:
    """Read standard.csv.

    Raises InputError (with row and column) for unknown or missing columns, cells that are no numbers, balls that
    repeat, overlap or lie in a line; FileError if the file cannot be read.
    """
    table = read_table(path)
    for column in table.columns:
        if column not in KNOWN:
            raise InputError(f"{table.path}: column {column!r} is unknown{unknown_column(column, KNOWN)}")
    name = OTHER_NAME if OTHER_NAME in table.columns else NAME
    missing = [c for c in (name, *COORDINATES, DIAMETER) if c not in table.columns]
    if missing:
        raise InputError(f"{table.path}: columns {', '.join(missing)} are missing; found {', '.join(table.columns)}")
    stated = table.comments.get(SIGMA)
    sigma = None
    if SIGMA in table.columns:
        sigma = table.numbers(SIGMA)
    elif stated is not None:
        try:
            sigma = np.full(len(table), float(stated))
        except ValueError:
            raise InputError(f"{table.path}: {SIGMA} is {stated!r}; a number of millimetres is needed") from None
    try:
        return SphereStandard(
            names=table.words(name),
            centres=np.column_stack([table.numbers(c) for c in COORDINATES]),
            diameters=table.numbers(DIAMETER),
            sigma=sigma,
        )
    except TomoposeError as error:
        raise InputError(f"{table.path}: {error}") from error


@require_types
def write_standard(path: str | Path, standard: SphereStandard, *, force: bool = False) -> None:
    """Write standard.csv.  FileError if the file exists and `force` is not given."""
    columns = {
        NAME: standard.names,
        **{c: standard.centres[:, k].tolist() for k, c in enumerate(COORDINATES)},
        DIAMETER: standard.diameters.tolist(),
    }
    if standard.sigma is not None:
        columns[SIGMA] = standard.sigma.tolist()
    write_text(require_absent(path, force=force), format_table({}, columns))
