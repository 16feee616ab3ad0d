"""RX Solutions' geom.csv: a source, a panel's centre and the middles of its upper and right edges a view, mm.

Columns index, src, det, top, right (x, y, z each), separated by semicolons, under two header lines.  `top` and `right`
lie on the outer edges of the panel: half its height and half its width from its centre.  W is the file's own world,
whose vertical axis is y; the image files have the top row first.  The file holds neither pixel pitch nor size: one of
them gives the other.  Source: geom.csv as X-Act writes it; published readers for CIL.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.panel import Given, matrices_of_panels, panels
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

MAKER = "geom.csv of RX Solutions"
COLUMNS = ("index", *(f"{a}_{b}" for a in ("src", "det", "top", "right") for b in "xyz"))
WHOLE = 1e-3
"""Pixels; how far half edge / pitch may be from a whole or half number of pixels, since nine digits are printed."""


def is_rx_views(text: str) -> bool:
    """Whether a text has the columns of geom.csv."""
    return "src_x" in text[:400] and "det_x" in text[:400]


def from_rx_views(text: str, given: Given, *, where: str = MAKER) -> ProjectionMatrices:
    """Matrices of a geom.csv; `given` holds the detector's size or its pitch (or both, which must agree)."""
    table = _table(text, where)
    source, centre = table[:, :3], table[:, 3:6]
    up, right = table[:, 6:9] - centre, table[:, 9:12] - centre
    place = f"{where} ({MAKER})"
    n_u, p_u = _settle(given, "u", right, place)
    n_v, p_v = _settle(given, "v", up, place)
    return matrices_of_panels(
        source,
        centre,
        right * (2 / n_u),
        up * (2 / n_v),
        given=given.with_values(n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v),
        rows="bottom",
        where=place,
    )


def to_rx_views(matrices: ProjectionMatrices) -> str:
    """The text of a geom.csv.  NotRepresentableError where a matrix has no flat panel."""
    m, g = matrices, panels(matrices, "rx")
    top, right = g.centre + g.V * (m.n_v / 2), g.centre + g.U * (m.n_u / 2)
    lines = ["geom" + ";" * (len(COLUMNS) - 1), ";".join(COLUMNS)]
    for k in range(len(m)):
        values = np.hstack([g.source[k], g.centre[k], top[k], right[k]]).tolist()
        lines.append(";".join([str(k), *map(repr, values)]))
    return "\n".join(lines) + "\n"


def _table(text: str, where: str) -> Array:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    at = next((k for k, line in enumerate(lines) if "src_x" in line), None)
    if at is None:
        raise InputError(f"{where}: no header line names src_x ... right_z ({MAKER})")
    separator = ";" if ";" in lines[at] else "," if "," in lines[at] else "\t"
    names = [n.strip().lower() for n in lines[at].split(separator)]
    missing = [c for c in COLUMNS[1:] if c not in names]
    if missing:
        raise InputError(f"{where} lacks the columns {', '.join(missing)} ({MAKER})")
    rows = []
    for k, line in enumerate(lines[at + 1 :]):
        cells = [c.strip() for c in line.split(separator)]
        if len(cells) < len(names):
            raise InputError(
                f"{where}: view {k} has {len(cells)} cells, the header {len(names)}; is the file truncated?"
            )
        rows.append([_number(cells[names.index(c)], f"{where}: view {k}, {c}") for c in COLUMNS[1:]])
    if not rows:
        raise InputError(f"{where} holds no view")
    return np.array(rows)


def _number(cell: str, where: str) -> float:
    cell = re.sub(r"^([+-]?\d*),(\d)", r"\1.\2", cell)
    try:
        value = float(cell)
    except ValueError as error:
        raise InputError(f"{where} is {cell[:30]!r}; a number is needed") from error
    if not np.isfinite(value):
        raise InputError(f"{where} is not finite")
    return value


def _settle(given: Given, axis: str, half: Array, where: str) -> tuple[int, float]:
    """Number of pixels and pitch along an axis, from the half edges (n, 3) and what is given."""
    n: Any = getattr(given, f"n_{axis}")
    p: Any = getattr(given, f"p_{axis}")
    length = float(np.median(np.linalg.norm(half, axis=1)))
    if n is None and p is None:
        raise InputError(
            f"{where} holds neither the detector's size nor its pitch; give --n-{axis}-px or --p-{axis}-mm (the panel "
            "is "
            f"{2 * length:.6g} mm along {axis})"
        )
    if n is None:
        n = 2 * length / given.settle(f"p_{axis}", None, where)
        if abs(n - round(n)) > WHOLE:
            raise InputError(
                f"{where}: a panel of {2 * length:.6g} mm is {n:.4f} pixels of {p:g} mm; the pitch is wrong"
            )
        n = round(n)
    n = given.settle(f"n_{axis}", int(n), where)
    pitch = 2 * length / n
    if p is not None and abs(pitch / p - 1) > WHOLE / n + 1e-6:
        raise InputError(
            f"{where}: {n} pixels of {p:g} mm are {n * p:g} mm, but the panel is {2 * length:.6g} mm along {axis}; "
            "leave "
            f"--p-{axis}-mm out, or correct --n-{axis}-px"
        )
    return int(n), pitch
