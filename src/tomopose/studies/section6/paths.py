"""Path lengths of all rays of a view: through a closed mesh, and through balls on shafts in closed form."""

from __future__ import annotations

import numpy as np

from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.objects.mesh import MeshSolid
from tomopose.simulation.projector.raster import mesh_path_image
from tomopose.simulation.projector.view import View, Window
from tomopose.units import Array


def fine_matrices(P: Array, samples: int) -> Array:
    """Matrices (..., 3, 4) to pixels cut into samples x samples: u becomes samples (u + 1/2) - 1/2."""
    shift = (samples - 1) / 2
    B = np.array([[samples, 0, shift], [0, samples, shift], [0, 0, 1.0]])
    return np.asarray(B @ P)


def mesh_paths(P: Array, solid: MeshSolid, n_u: int, n_v: int) -> Array:
    """Path lengths (n_v, n_u), mm, in the view with P (3, 4) through a closed mesh that does not move in W."""
    window = Window(u_0=0, v_0=0, n_u=n_u, n_v=n_v)
    return mesh_path_image((solid,), View.of_matrix(P), {solid.frame: RigidTransform.identity(Frame.W)}, window)


def ball_paths(P: Array, centres: Array, radii: Array, shaft_radius: float, bottom: Array, n_u: int, n_v: int) -> Array:
    """Path lengths (n_v, n_u), mm, through balls, centres (m, 3), mm in W, and radii (m,), each on an upright shaft
    from the height `bottom` (m,); what a ball and its own shaft share counts once."""
    out = np.zeros((n_v, n_u))
    _add_balls(P, np.linalg.inv(P[:, :3]), centres, radii, shaft_radius, bottom, out)
    return out


@njit(cache=True, nogil=True)
def _ball_on_shaft(o: np.ndarray, d: np.ndarray, r: float, shaft: float, bottom: float) -> float:
    """Path (mm) of the ray o + t d, |d| = 1, through a ball of radius r at the origin and the upright shaft below it
    that reaches down to z = bottom; what they share counts once."""
    # Distances from the point nearest to the ball, so that no small number is a difference of large ones.
    n = o - (o @ d) * d
    under = r * r - n @ n
    ball = np.sqrt(under) if under > 0.0 else 0.0
    path = 2.0 * ball
    a = d[0] * d[0] + d[1] * d[1]
    e = n[0] * d[0] + n[1] * d[1]
    under = e * e - a * (n[0] * n[0] + n[1] * n[1] - shaft * shaft)
    if under <= 0.0 or a <= 0.0 or bottom >= 0.0:
        return float(path)
    root = np.sqrt(under)
    low, high = (-e - root) / a, (-e + root) / a
    if d[2] != 0.0:
        end_1, end_2 = (bottom - n[2]) / d[2], -n[2] / d[2]
        low, high = max(low, min(end_1, end_2)), min(high, max(end_1, end_2))
    elif n[2] > 0.0 or n[2] < bottom:
        high = low
    if high > low:
        path += high - low - max(min(high, ball) - max(low, -ball), 0.0)
    return float(path)


@njit(cache=True, nogil=True)
def _add_balls(
    P: np.ndarray,
    inverse: np.ndarray,
    centres: np.ndarray,
    radii: np.ndarray,
    shaft: float,
    bottom: np.ndarray,
    out: np.ndarray,
) -> None:
    n_v, n_u = out.shape
    s = -(inverse @ np.ascontiguousarray(P[:, 3]))
    for m in range(len(centres)):
        c, r = centres[m], radii[m]
        # The shaft ends at the ball's centre: the hidden part changes nothing.
        u_low, u_high, v_low, v_high = 1e30, -1e30, 1e30, -1e30
        for corner in range(8):
            x = c[0] + (r if corner & 1 else -r)
            y = c[1] + (r if corner & 2 else -r)
            z = c[2] + r if corner & 4 else min(bottom[m], c[2] - r)
            w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
            u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
            v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
            u_low, u_high, v_low, v_high = min(u_low, u), max(u_high, u), min(v_low, v), max(v_high, v)
        u_low, u_high = min(max(u_low, 0.0), float(n_u)), min(max(u_high + 2, 0.0), float(n_u))
        v_low, v_high = min(max(v_low, 0.0), float(n_v)), min(max(v_high + 2, 0.0), float(n_v))
        for v in range(int(v_low), int(v_high)):
            for u in range(int(u_low), int(u_high)):
                d = inverse @ np.array([u, v, 1.0])
                path = _ball_on_shaft(s - c, d / np.sqrt(d @ d), r, shaft, bottom[m] - c[2])
                out[v, u] += path
