"""The ideal detector image: transmission averaged over each pixel, exact at edges, cheap elsewhere.

Rays go through the pixels' corners.  Where a pixel and its neighbours see the same surfaces and the transmission is
smooth, its mean follows from the corners (bilinear with the curvature's correction).  Everywhere else the pixel is
cut in f x f cells; a cell with a faint edge is sampled at the points of a Fibonacci lattice, which no straight edge
can follow, and a cell with a steep edge is cut along it.
The result has f x f cells a pixel, so that blur acts before the pixel integrates, as it does in a scintillator; and
each cell holds the quadratic surface nearest to the transmission (`cells`), so that an edge keeps its place inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.physics.spectrum import Beam
from tomopose.simulation.projector.cells import (
    HELD,
    LATTICE_5,
    LATTICE_13,
    add,
    add_moments,
    bows,
    fill_pixel,
    fill_smooth,
    gather_value,
)
from tomopose.simulation.projector.rays import LARGEST, Compiled
from tomopose.simulation.projector.sampling import (
    BLOCK,
    KernelScene,
    WorkSpace,
    at,
    corners,
    kernel_scene,
    lengths,
    work_space,
)
from tomopose.simulation.projector.view import Arrays, View, Window, in_bands
from tomopose.units import Array

FLAT = 2e-3
"""Differences of transmission over a cell below this need no lattice; above 6 times this the finer one; above 24 times
an edge is cut exactly."""
HALVINGS = 9
GAUSS = np.stack([(np.polynomial.legendre.leggauss(4)[0] + 1) / 2, np.polynomial.legendre.leggauss(4)[1] / 2], axis=1)
SMALL_PX = 8.0
"""Where a primitive is thinner than this (half its side, px), every ray is cast."""


@njit(cache=True, nogil=True)
def _crossing(c: KernelScene, work: WorkSpace, u_0: float, v_0: float, u_1: float, v_1: float, mark: int) -> float:
    """Where between two points (0 to 1) the surfaces seen change from those of signature `mark`, by halving."""
    lo, hi = 0.0, 1.0
    for _ in range(HALVINGS):
        x = 0.5 * (lo + hi)
        if lengths(c, work, u_0 + x * (u_1 - u_0), v_0 + x * (v_1 - v_0)) == mark:
            lo = x
        else:
            hi = x
    return 0.5 * (lo + hi)


@njit(cache=True, nogil=True, inline="always")
def _split_cell(
    c: KernelScene, work: WorkSpace, left: float, low: float, h: float, along_u: bool, marks: Arrays, M: np.ndarray
) -> None:
    """Gather in M the moments of a cell that a steep edge crosses.

    x runs across the edge (along u or v), y along it; marks: signatures of the corners, m_xy.  The cell is cut at the
    y where the edge leaves it sideways, if it does; on Gauss's lines in y the edge's place is found by halving, and
    both sides are integrated by Gauss's rule in the root of the distance from the edge, where a round rim is smooth.
    """
    m_00, m_10, m_01, m_11 = marks
    u_x, v_x, u_y, v_y = (h, 0.0, 0.0, h) if along_u else (0.0, h, h, 0.0)
    cut = 1.0
    if (m_00 != m_10) != (m_01 != m_11):
        if m_00 != m_01:
            cut = _crossing(c, work, left, low, left + u_y, low + v_y, m_00)
        else:
            cut = _crossing(c, work, left + u_x, low + v_x, left + u_x + u_y, low + v_x + v_y, m_10)
    for part in range(1 if cut == 1.0 else 2):
        y_0, y_1 = (0.0, cut) if part == 0 else (cut, 1.0)
        for q in range(len(GAUSS)):
            y = y_0 + (y_1 - y_0) * GAUSS[q, 0]
            u, v = left + y * u_y, low + y * v_y
            start, mark = at(c, work, u, v)
            end, other = at(c, work, u + u_x, v + v_x)
            if mark != other:
                edge = _crossing(c, work, u, v, u + u_x, v + v_x, mark)
            else:
                # The edge lies just outside: integrate in the root of the distance from that end.
                middle, _ = at(c, work, u + 0.5 * u_x, v + 0.5 * v_x)
                edge = 0.0 if abs(start - middle) > abs(end - middle) else 1.0
            for side in range(2):
                length = -edge if side == 0 else 1.0 - edge
                if length == 0.0:
                    continue
                for g in range(len(GAUSS)):
                    x = edge + length * GAUSS[g, 0] ** 2
                    value, _ = at(c, work, u + x * u_x, v + x * v_x)
                    value *= 2 * GAUSS[g, 0] * GAUSS[g, 1] * abs(length) * GAUSS[q, 1] * (y_1 - y_0)
                    a, b = (x - 0.5, y - 0.5) if along_u else (y - 0.5, x - 0.5)
                    gather_value(M, value, a, b)


@njit(cache=True, nogil=True, inline="always")
def _nodes(
    c: KernelScene,
    work: WorkSpace,
    I: np.ndarray,
    seen: np.ndarray,
    j: int,
    i: int,
    f: int,
    left: float,
    low: float,
    node: np.ndarray,
    node_seen: np.ndarray,
) -> None:
    """Transmission and signature at the (f + 1) x (f + 1) corners of the cells of pixel (j, i); its own are known."""
    h = 1.0 / f
    for a in range(f + 1):
        for b in range(f + 1):
            if a in (0, f) and b in (0, f):
                node[a, b], node_seen[a, b] = I[j + a // f, i + b // f], seen[j + a // f, i + b // f]
            else:
                node[a, b], node_seen[a, b] = at(c, work, left + b * h, low + a * h)


@njit(cache=True, nogil=True, inline="always")
def _edge_runs(m: np.ndarray, along_u: bool) -> Any:
    """Whether the edge in a cell is crossed along u, and the corners' signatures in that order, from m[v, u].

    along_u: what the slopes say, which counts where as many sides of either direction are cut.
    """
    sides_u = int(m[0, 0] != m[0, 1]) + int(m[1, 0] != m[1, 1])
    sides_v = int(m[0, 0] != m[1, 0]) + int(m[0, 1] != m[1, 1])
    if sides_u != sides_v:
        along_u = sides_u > sides_v
    return along_u, (m[0, 0], m[0, 1], m[1, 0], m[1, 1]) if along_u else (m[0, 0], m[1, 0], m[0, 1], m[1, 1])


@njit(cache=True, nogil=True, inline="always")
def _cell(
    c: KernelScene,
    work: WorkSpace,
    node: np.ndarray,
    marks: np.ndarray,
    f: int,
    left: float,
    low: float,
    row: int,
    column: int,
    weight: float,
    out: np.ndarray,
    M: np.ndarray,
) -> None:
    """Add weight x moments of one cell to `out`; node, marks (2, 2): transmission and signature at its corners [v, u];
    (left, low): its corner on the panel."""
    h = 1.0 / f
    f_00, f_01, f_10, f_11 = node[0, 0], node[0, 1], node[1, 0], node[1, 1]
    same = marks[0, 0] == marks[1, 0] and marks[0, 0] == marks[0, 1] and marks[0, 0] == marks[1, 1]
    if same and marks[0, 0] == 0:
        out[0, row, column] += weight
        return
    M[:] = 0.0
    corners = (f_00 + f_01 + f_10 + f_11) / 4
    middle, _ = at(c, work, left + 0.5 * h, low + 0.5 * h)
    span = max(f_00, f_01, f_10, f_11, middle) - min(f_00, f_01, f_10, f_11, middle)
    rise_u, rise_v = f_01 + f_11 - f_00 - f_10, f_10 + f_11 - f_00 - f_01
    if span < FLAT or (same and abs(middle - corners) < FLAT):
        twist = weight * f * f * (f_11 - f_10 - f_01 + f_00)
        value = weight * (2 * middle + corners) / 3
        add(out, row, column, value, weight * f * rise_u / 2, weight * f * rise_v / 2, twist, 0.0, 0.0)
        return
    if span > 24 * FLAT:
        along_u, m = _edge_runs(marks, abs(rise_u) > abs(rise_v))
        _split_cell(c, work, left, low, h, along_u, m, M)
        add_moments(out, row, column, weight, f, M, 0.0, 1 / 12)
        return
    points = LATTICE_13 if span > 6 * FLAT else LATTICE_5
    n = len(points)
    for q in range(n):
        x, y = points[q]
        value, _ = at(c, work, left + (x + 0.5) * h, low + (y + 0.5) * h)
        gather_value(M, value / n, x, y)
    xy = 0.0
    for q in range(n):
        xy += points[q, 0] * points[q, 1] / n
    add_moments(out, row, column, weight, f, M, xy, (1 - 1 / n**2) / 12)


@njit(cache=True, nogil=True)
def _cells(
    c: KernelScene,
    work: WorkSpace,
    u_0: int,
    v_0: int,
    I: np.ndarray,
    seen: np.ndarray,
    f: int,
    j_0: int,
    j_1: int,
    weight: float,
    rough: np.ndarray,
    out: np.ndarray,
) -> None:
    """Add weight x moments of the f x f cells of the rough pixels in rows j_0 to j_1 to `out` (HELD, rows, columns)."""
    node, node_seen = np.empty((f + 1, f + 1)), np.empty((f + 1, f + 1), dtype=np.int64)
    h, M, bow = 1.0 / f, np.empty(HELD), bows(f)
    for number in range(j_0 * rough.shape[1], j_1 * rough.shape[1]):
        j, i = number // rough.shape[1], number % rough.shape[1]
        if not rough[j, i]:
            continue
        left, low = u_0 + i - 0.5, v_0 + j - 0.5
        f_00, f_01, f_10, f_11 = I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1]
        mark = seen[j, i]
        if mark == seen[j, i + 1] and mark == seen[j + 1, i] and mark == seen[j + 1, i + 1]:
            middle, here = at(c, work, left + 0.5, low + 0.5)
            off = middle - (f_00 + f_01 + f_10 + f_11) / 4
            if here == mark and abs(off) < FLAT / 2:
                # A neighbour meets the edge.  The middle gives the sum of the curvatures alone.
                fill_pixel(out, j, i, f, weight, bow, f_00, f_01, f_10, f_11, -4 * off, -4 * off)
                continue
        _nodes(c, work, I, seen, j, i, f, left, low, node, node_seen)
        for cell in range(f * f):
            a, b = cell // f, cell % f
            corners, marks = node[a : a + 2, b : b + 2], node_seen[a : a + 2, b : b + 2]
            _cell(c, work, corners, marks, f, left + b * h, low + a * h, j * f + a, i * f + b, weight, out, M)


def _without_small_parts(compiled: Compiled, boxes: Array) -> bool:
    """Whether every primitive is so large on the panel that none can hide between coarse corners."""
    size = np.linalg.norm(compiled.t.max(axis=0) - compiled.t.min(axis=0)) + 2 * compiled.radius.max()
    px_per_mm = max(np.ptp(boxes[:, :, 0]), np.ptp(boxes[:, :, 1])) / size
    return bool(compiled.smallest * px_per_mm > SMALL_PX)


def add_transmission(
    out: np.ndarray,
    window: Window,
    compiled: Compiled,
    beam: Beam,
    view: View,
    T_FW: dict[Frame, RigidTransform],
    *,
    f: int,
    weight: float = 1.0,
    threads: int = 1,
) -> None:
    """Add weight x transmission to `out` (HELD, n_v f, n_u f), float32, the cells of the window's pixels.

    T_FW: each frame's transform to W.  Raises InputError where a ray crosses more surfaces than `LARGEST`.
    """
    c = kernel_scene(compiled, beam, view, T_FW)
    boxes = c.boxes
    I = np.empty((window.n_v + 1, window.n_u + 1))
    seen = np.empty(I.shape, dtype=np.int64)
    mask = np.zeros(I.shape, dtype=np.bool_)
    for (u_lo, v_lo), (u_hi, v_hi) in boxes:
        j = slice(max(int(np.floor(v_lo)) - window.v_0, 0), max(int(np.ceil(v_hi)) - window.v_0 + 2, 0))
        i = slice(max(int(np.floor(u_lo)) - window.u_0, 0), max(int(np.ceil(u_hi)) - window.u_0 + 2, 0))
        mask[j, i] = True
    shape = (window.n_v // BLOCK + 1, window.n_u // BLOCK + 1) if _without_small_parts(compiled, boxes) else (0, 0)
    rough_I, rough_seen = np.empty(shape), np.empty(shape, dtype=np.int64)
    none_I, none_seen = np.empty((0, 0)), np.empty((0, 0), dtype=np.int64)
    fine = [True]

    def rays(step: int, known: tuple[Array, np.ndarray], found: tuple[Array, np.ndarray]) -> Callable[[int, int], None]:
        def band(lo: int, hi: int) -> None:
            work = work_space(c, compiled.depth)
            if not corners(c, work, window.u_0, window.v_0, step, mask, *known, lo, hi, *found):
                fine[0] = False

        return band

    in_bands(rays(BLOCK, (none_I, none_seen), (rough_I, rough_seen)), shape[0], threads)
    in_bands(rays(1, (rough_I, rough_seen), (I, seen)), window.n_v + 1, threads)
    if not fine[0]:
        raise InputError(f"a ray crosses more than {LARGEST} surfaces of one solid; split the solid in several")
    rough = np.empty((window.n_v, window.n_u), dtype=np.bool_)

    def cells(lo: int, hi: int) -> None:
        fill_smooth(I, seen, f, lo, hi, weight, out, rough)
        work = work_space(c, compiled.depth)
        _cells(c, work, window.u_0, window.v_0, I, seen, f, lo, hi, weight, rough, out)

    in_bands(cells, window.n_v, threads)
