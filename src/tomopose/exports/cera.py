"""CERA: a .config with the detector's size and pitch, and a table of projection matrices beside it.

CERA's image frame is D (px, origin in the centre of the lower-left pixel, v up) and its volume frame is W, so the table
holds P unchanged.  The matrices always mean the image after the flips that the .config asks for: FlipV = true says that
image files have the top row first.  The circular keys (StartAngle ...) are neither written nor read: their zero is not
known for certain.  Source: ctsimu 1.7, create_CERA_config; CERA itself was not available.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Any

import numpy as np

from tomopose.errors import InputError, SchemaVersionError
from tomopose.exports.panel import Given, Rows, numbers
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

TABLE_NAME = "cera_projtable.txt"
TABLE_VERSION = 3
UNTOUCHED = {
    "Rotation": "None",
    "FlipU": "false",
    "BinningFactor": "None",
    "SkipProjectionInterval": "1",
    "CropBorderRight": "0",
    "CropBorderLeft": "0",
    "CropBorderTop": "0",
    "CropBorderBottom": "0",
}
"""Keys that change the projections; other values than these are refused."""
EFFECT = {
    "SkipProjectionInterval": "it leaves projections out, and which matrices remain is not documented",
    "Rotation": "it turns the images, and whether the matrices mean them before or after is not documented",
}
MOVES = "it moves the pixels, and whether the matrices mean them before or after is not documented"


def to_cera(
    matrices: ProjectionMatrices,
    *,
    image_rows: Rows = "top",
    table_name: str = TABLE_NAME,
    date: datetime | None = None,
) -> tuple[str, str]:
    """The .config text and the table's text.  `image_rows`: row 0 of the image files ("top" is the TIFF order).

    Any matrix fits, skewed and mirrored ones too; what CERA makes of those is not known.  `date`: is written in the
    table; now where it is not given.
    """
    n, p_u, p_v = len(matrices), float(matrices.p_u), float(matrices.p_v)
    config = f"""#CERACONFIG

[Projections]
NumChannelsPerRow = {int(matrices.n_u)}
NumRows = {int(matrices.n_v)}
PixelSizeU = {p_u!r}
PixelSizeV = {p_v!r}
Rotation = None
FlipU = false
FlipV = {"true" if image_rows == "top" else "false"}
Padding = 0
BigEndian = false
CropBorderRight = 0
CropBorderLeft = 0
CropBorderTop = 0
CropBorderBottom = 0
BinningFactor = None
SkipProjectionInterval = 1

[Volume]
MidpointX = 0
MidpointY = 0
MidpointZ = 0

[CustomKeys]
NumProjections = {n}

[CustomKeys.ProjectionMatrices]
ProjectionMatrixFilename = {table_name}
"""
    when = (date or datetime.now(UTC)).ctime()
    lines = [f"projtable.txt version {TABLE_VERSION}", when, ""]
    lines += ["# format: angle / entries of projection matrices", str(n)]
    for k, P in enumerate(matrices.P, start=1):
        lines += [f"@{k}", "0.0 0.0", *(" ".join(repr(float(x)) for x in row) for row in P), ""]
    return config, "\n".join(lines)


def cera_config(text: str, *, where: str = "the CERA .config") -> tuple[dict[str, Any], str]:
    """What a .config says: n_u, n_v, p_u, p_v, n (views); and the name of its table.

    Raises InputError where it has no matrices (a circular scan given by angles alone) or asks for changes of the
    images that move the pixels.
    """
    keys = dict(re.findall(r"^[ \t]*([A-Za-z0-9_]+)[ \t]*=[ \t]*([^#\r\n]*?)[ \t]*(?:#.*)?$", text, flags=re.M))
    table = keys.get("ProjectionMatrixFilename", "")
    if not table:
        raise InputError(
            f"{where} names no ProjectionMatrixFilename; a circular scan given by StartAngle and ScanAngle alone is "
            "not read, because the zero and the sense of those angles are not documented; export it with matrices"
        )
    for name, plain in UNTOUCHED.items():
        if keys.get(name, plain).lower() != plain.lower():
            why = EFFECT.get(name, MOVES)
            raise InputError(f"{where}: {name} = {keys[name]}; only {name} = {plain} is read: {why}")
    numbers_of = {"n_u": "NumChannelsPerRow", "n_v": "NumRows", "p_u": "PixelSizeU", "p_v": "PixelSizeV"}
    found: dict[str, Any] = {}
    for name, key in {**numbers_of, "n": "NumProjections"}.items():
        if key in keys:
            value = float(numbers(keys[key], (), f"{where}: {key}"))
            if name not in ("p_u", "p_v") and value != int(value):
                raise InputError(f"{where}: {key} = {keys[key]} is no whole number")
            found[name] = value if name in ("p_u", "p_v") else int(value)
    return found, table


HEAD = re.compile(r"(?:\S+\s+)?projtable(?:\.txt)?\s+version\s+(?P<version>\S.*)", re.IGNORECASE)
"""First line of a table: `projtable.txt version 3` (ctsimu, aRTist), `projtable version 3` (CONRAD,
EpipolarConsistency), `ETRI projtable version iterative`."""
INDEX = re.compile(r"@\s*(\d+)")


def is_cera_table(text: str) -> bool:
    """Whether a text begins as a projection table of any writer does."""
    return HEAD.fullmatch(text.lstrip("\ufeff").split("\n", 1)[0].strip()) is not None


def cera_table(text: str, *, where: str = "the CERA table") -> Array:
    """The matrices (n, 3, 4) of a table.

    Read in the dialects of ctsimu and aRTist, CONRAD, EpipolarConsistency and ETRI: they differ in the first line, in
    blanks, and in counting the matrices from 0 or from 1.
    """
    lines = [line.strip() for line in text.lstrip("\ufeff").splitlines()]
    first = lines[0] if lines else ""
    head = HEAD.fullmatch(first)
    if not head:
        raise InputError(f"{where}: the first line is {first[:60]!r}, not 'projtable.txt version 3' or one like it")
    number = re.match(r"\d+", head["version"])
    if number and int(number[0]) != TABLE_VERSION:
        raise SchemaVersionError(f"{where}: table version {number[0]}; version {TABLE_VERSION} is read")
    # The second line is the date, whatever its wording; comments and blank lines carry nothing.
    body = [line for line in lines[2:] if line and not line.startswith("#")]
    if not body or not body[0].isdigit():
        raise InputError(f"{where}: the number of matrices is missing")
    n, rest = int(body[0]), body[1:]
    if n == 0 or len(rest) != 5 * n:
        raise InputError(
            f"{where} announces {n} matrices (five lines each) but {len(rest)} lines follow; is the file truncated?"
        )
    start = INDEX.fullmatch(rest[0])
    base = int(start[1]) if start and int(start[1]) in (0, 1) else 1
    for k in range(n):
        found = INDEX.fullmatch(rest[5 * k])
        if not found or int(found[1]) != k + base:
            raise InputError(f"{where}: '@{k + base}' is due but {rest[5 * k][:40]!r} is there")
    rows = [rest[5 * k + j].split() for k in range(n) for j in (2, 3, 4)]
    bad = [i for i, row in enumerate(rows) if len(row) != 4]
    if bad:
        raise InputError(f"{where}: a row of matrix @{bad[0] // 3 + base} has {len(rows[bad[0]])} numbers, not 4")
    return numbers(rows, (3 * n, 4), where).reshape(n, 3, 4)


def from_cera(
    table: str, given: Given, *, config: str | None = None, where: str = "the CERA geometry"
) -> ProjectionMatrices:
    """Matrices of a table's text, with its .config's text or, for the table alone, size and pitch in `given`.

    The row order of the images has no part in them: the matrices count v upwards either way.
    """
    found = {} if config is None else cera_config(config, where=where)[0]
    P = cera_table(table, where=where)
    if found.get("n", len(P)) != len(P):
        raise InputError(f"{where}: NumProjections is {found['n']} but the table holds {len(P)} matrices")
    n_u, n_v, p_u, p_v = (given.settle(k, found.get(k), where) for k in ("n_u", "n_v", "p_u", "p_v"))
    if not np.linalg.norm(P[:, 2, :3], axis=1).min() > 0:
        raise InputError(f"{where}: a matrix has a third row of zeros; no cone beam")
    return given.matrices(P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)
