"""Path lengths of all rays of a view: through a closed mesh, and through balls on shafts in closed form."""

from __future__ import annotations

import numpy as np
from numba import njit

from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
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
        o_x, o_y, o_z = s[0] - c[0], s[1] - c[1], s[2] - c[2]
        u_low, u_high = min(max(u_low, 0.0), float(n_u)), min(max(u_high + 2, 0.0), float(n_u))
        v_low, v_high = min(max(v_low, 0.0), float(n_v)), min(max(v_high + 2, 0.0), float(n_v))
        for v in range(int(v_low), int(v_high)):
            for u in range(int(u_low), int(u_high)):
                d_x = inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]
                d_y = inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]
                d_z = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
                length = np.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
                d_x, d_y, d_z = d_x / length, d_y / length, d_z / length
                b = o_x * d_x + o_y * d_y + o_z * d_z
                # Distances from the point nearest to the ball, so that no small number is a difference of large ones.
                n_x, n_y, n_z = o_x - b * d_x, o_y - b * d_y, o_z - b * d_z
                under = r * r - (n_x * n_x + n_y * n_y + n_z * n_z)
                ball = np.sqrt(under) if under > 0.0 else 0.0
                path = 2.0 * ball
                a = d_x * d_x + d_y * d_y
                e = n_x * d_x + n_y * d_y
                under = e * e - a * (n_x * n_x + n_y * n_y - shaft * shaft)
                if under > 0.0 and a > 0.0 and bottom[m] < c[2]:
                    root = np.sqrt(under)
                    low, high = (-e - root) / a, (-e + root) / a
                    if d_z != 0.0:
                        end_1, end_2 = (bottom[m] - c[2] - n_z) / d_z, -n_z / d_z
                        low, high = max(low, min(end_1, end_2)), min(high, max(end_1, end_2))
                    elif n_z > 0.0 or n_z < bottom[m] - c[2]:
                        high = low
                    if high > low:
                        path += high - low - max(min(high, ball) - max(low, -ball), 0.0)
                out[v, u] += path
