"""The rigid motion between two sets of paired points."""

from __future__ import annotations

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array


def rigid_motion(x: Array, y: Array) -> tuple[Array, Array]:
    """(R (3, 3), t (3,)) of the least-squares motion y = R x + t of points (n, 3) onto points (n, 3).

    Source: Kabsch, Acta Cryst. A32 (1976) 922.  InputError where the points lie on a line.
    """
    a, b = x - x.mean(axis=0), y - y.mean(axis=0)
    if np.linalg.matrix_rank(a, tol=1e-9 * max(float(np.abs(a).max()), 1e-300)) < 2:
        raise InputError(f"{len(a)} points on a line fix no orientation; give points beside it")
    u, _, vt = np.linalg.svd(a.T @ b)
    R = (u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt).T
    return R, y.mean(axis=0) - R @ x.mean(axis=0)
