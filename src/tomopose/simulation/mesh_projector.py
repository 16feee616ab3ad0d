"""The ideal detector image of scenes that hold meshes: the same cells as `projector`, filled from lists of rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.mesh import MeshSolid
from tomopose.simulation.projector import fill_smooth
from tomopose.simulation.rays import Compiled, path_lengths
from tomopose.simulation.spectrum import Beam
from tomopose.simulation.view import View, Window, in_bands
from tomopose.units import Array

POINTS, STEP = 13, 8
"""Fibonacci lattice of a cell near an edge."""
MOST_RAYS = 400_000


def add_mesh_transmission(
    out: Any,
    window: Window,
    compiled: Compiled | None,
    meshes: tuple[MeshSolid, ...],
    materials: tuple[str, ...],
    beam: Beam,
    view: View,
    T_FW: dict[Frame, RigidTransform],
    *,
    f: int,
    weight: float = 1.0,
    threads: int = 1,
) -> None:
    """Add weight x transmission of meshes and solids to `out`, cells as `projector.add_transmission` describes them.

    materials: names of the beam's columns.
    """

    def at(u: Array, v: Array) -> tuple[Array, Any]:
        d = view.O + u[:, None] * view.U + v[:, None] * view.V - view.source
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        L, seen = np.zeros((len(d), len(materials))), np.zeros(len(d), dtype=np.int64)
        if compiled is not None:
            analytic = path_lengths(compiled, view.source, d, T_FW)
            for k, name in enumerate(compiled.materials):
                L[:, materials.index(name)] += analytic[:, k]
            seen += (analytic > 0) @ (1 << np.arange(analytic.shape[1]))
        for solid in meshes:
            T_WF = T_FW[solid.frame].inv
            o = np.broadcast_to(T_WF.apply(view.source), d.shape)
            path, hits = solid.tracer.paths(o, d @ T_WF.R.T)
            L[:, materials.index(solid.material)] += path
            seen = seen * 64 + hits
        return beam.transmission(L), seen

    n_v, n_u = window.n_v, window.n_u
    I, seen = np.ones((n_v + 1, n_u + 1)), np.zeros((n_v + 1, n_u + 1), dtype=np.int64)
    rows = max(1, MOST_RAYS // (n_u + 1))
    u = window.u_0 + np.arange(n_u + 1) - 0.5
    for start in range(0, n_v + 1, rows):
        v = window.v_0 + np.arange(start, min(start + rows, n_v + 1)) - 0.5
        T, s = at(np.tile(u, len(v)), np.repeat(v, n_u + 1))
        band = slice(start, start + len(v))
        I[band], seen[band] = T.reshape(len(v), -1), s.reshape(len(v), -1)
    rough = np.empty((n_v, n_u), dtype=np.bool_)
    in_bands(lambda lo, hi: fill_smooth(I, seen, f, lo, hi, weight, out, rough), n_v, threads)
    q = np.arange(POINTS)
    x, y = (q + 0.5) / POINTS - 0.5, (((q - POINTS // 2) * STEP + POINTS // 2) % POINTS + 0.5) / POINTS - 0.5
    rows_of, columns_of = np.nonzero(np.kron(rough, np.ones((f, f), dtype=np.bool_)))
    batch = MOST_RAYS // POINTS
    for k in range(0, len(rows_of), batch):
        j, i = rows_of[k : k + batch], columns_of[k : k + batch]
        u_at = window.u_0 - 0.5 + (i[:, None] + 0.5 + x) / f
        v_at = window.v_0 - 0.5 + (j[:, None] + 0.5 + y) / f
        T, _ = at(u_at.ravel(), v_at.ravel())
        T = T.reshape(-1, POINTS)
        slope = weight * 12 * f
        out[0, j, i] += weight * T.mean(axis=1)
        out[1, j, i] += slope * (T * x).mean(axis=1)
        out[2, j, i] += slope * (T * y).mean(axis=1)
        out[3, j, i] += slope * 12 * f * (T * x * y).mean(axis=1)
