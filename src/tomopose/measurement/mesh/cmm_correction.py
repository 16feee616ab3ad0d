"""A reference mesh that follows what a coordinate measuring machine found (paper sec. 6.2, ref. [21]).

A mesh from the CAD model, of small triangles, is shifted element by element (a plane, a cylinder, a bore) towards the
probed points.  Vertices on the part's edges cannot be probed and stay nominal, and so do elements without points: the
result is nominal in part and measured in part.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError, ShapeError, UnitError
from tomopose.measurement.mesh.mesh import Mesh, nearest_triangles
from tomopose.reading import read_text, reader
from tomopose.units import Array

Interpolation = Literal["cells", "natural"]
FAR_SHARE = 0.05
"""Share of the part's size beyond which a probed point cannot belong to it."""
BLOCK = 2000
COLUMNS = ("x_mm", "y_mm", "z_mm")


@reader("table of probed points")
def read_probed_points(path: str | Path) -> Array:
    """Probed points (n, 3), mm, part coordinates, from CSV with the columns x_mm, y_mm, z_mm.

    FileError for a file that cannot be read, UnitError for columns without their unit.
    """
    path = Path(path)
    lines = [line for line in read_text(path).splitlines() if line and line[0] != "#"]
    rows = list(csv.DictReader(lines, delimiter="\t" if lines and "\t" in lines[0] else ","))
    names = [] if not rows else [str(n).strip() for n in rows[0]]
    if not set(COLUMNS) <= set(names):
        raise UnitError(f"{path}: columns are {', '.join(names) or 'missing'}; {', '.join(COLUMNS)} are needed")
    points = np.array([[float({str(k).strip(): v for k, v in r.items()}[c]) for c in COLUMNS] for r in rows])
    if not np.isfinite(points).all():
        raise InputError(f"{path}: probed point {int(np.argmin(np.isfinite(points).all(axis=1))) + 1} is not finite")
    return points


def corrected_reference(mesh: Mesh, probed: npt.ArrayLike, *, interpolation: Interpolation = "cells") -> Mesh:
    """The reference shifted to points (n, 3), mm, that a coordinate measuring machine probed.

    Each vertex moves along its normal by the deviation of the probed points of its own element:

    cells:    that of the point whose Voronoi cell it lies in;
    natural:  the mean over the points whose cells it would take from, by how much (Sibson), on the mesh's vertices.

    Raises ShapeError, or InputError where a point lies farther than a twentieth of the part's size from the mesh.
    """
    x = np.asarray(probed, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise ShapeError(f"probed points are (n, 3); got {x.shape}")
    if interpolation not in ("cells", "natural"):
        raise InputError(f"interpolation is {interpolation!r}; 'cells' or 'natural' is needed")
    deviation, face = nearest_triangles(x, mesh)
    far = np.abs(deviation) > FAR_SHARE * mesh.size
    if far.any():
        raise InputError(
            f"{int(far.sum())} of {len(x)} probed points lie up to {float(np.abs(deviation).max()):.3g} mm off the "
            "reference; check unit and alignment"
        )
    points = np.array(mesh.points)
    vertex_element = np.zeros(len(points), dtype=np.intp)
    vertex_element[mesh.faces.ravel()] = np.repeat(mesh.elements, 3)
    between = _cells if interpolation == "cells" else _natural
    for element in np.unique(mesh.elements[face]):
        mine = np.flatnonzero((vertex_element == element) & ~mesh.on_edge)
        theirs = np.flatnonzero(mesh.elements[face] == element)
        if mine.size:
            shift = between(mesh.points[mine], x[theirs], deviation[theirs])
            points[mine] += shift[:, None] * mesh.normals[mine]
    return Mesh(points=points, faces=mesh.faces)


def _cells(vertices: Array, probed: Array, deviation: Array) -> Array:
    from scipy.spatial import cKDTree

    return deviation[cKDTree(probed).query(vertices)[1]]


def _natural(vertices: Array, probed: Array, deviation: Array) -> Array:
    """A new point at q takes each vertex that lies nearer to q than to its own probed point: each vertex gives its
    cell's value to all that lie within its distance from that point, and each takes the mean of what it gets."""
    from scipy.spatial import cKDTree

    apart, cell = (np.asarray(a) for a in cKDTree(probed).query(vertices))
    tree = cKDTree(vertices)
    total, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    for first in range(0, len(vertices), BLOCK):
        block = slice(first, first + BLOCK)
        # Each vertex reaches itself; one that is a probed point is reached by no other cell's.
        reached = tree.query_ball_point(vertices[block], apart[block] * (1 - 1e-9))
        to = np.concatenate(reached).astype(np.intp)
        given = np.repeat(deviation[cell[block]], [len(r) for r in reached])
        total += np.bincount(to, weights=given, minlength=len(vertices))
        count += np.bincount(to, minlength=len(vertices))
    return total / count
