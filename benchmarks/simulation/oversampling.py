"""The reference for edges and centres: every pixel near a rim cut in 96 x 96 points, blurred on that fine grid.

Nothing of the projector is used: the ball's chord is computed here in closed form, with the full spectrum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from scipy.special import ndtr

from tomopose.geometry.frames import Frame
from tomopose.simulation.physics.materials import attenuation
from tomopose.simulation.projector.view import View
from tomopose.simulation.run import SimulatedRun


@njit
def _chords(base: Any, v: Any, V: Any, c: Any, r: float) -> Any:
    """Chords (rows, columns), mm, of a ball at c on rays from the origin along base + v V."""
    out = np.zeros((len(v), len(base)))
    for j in range(len(v)):
        for i in range(len(base)):
            x, y, z = base[i, 0] + v[j] * V[0], base[i, 1] + v[j] * V[1], base[i, 2] + v[j] * V[2]
            # |c x d| / |d| is the distance at which the ray passes the ball's centre.
            a, b, e = c[1] * z - c[2] * y, c[2] * x - c[0] * z, c[0] * y - c[1] * x
            inside = r * r - (a * a + b * b + e * e) / (x * x + y * y + z * z)
            if inside > 0:
                out[j, i] = 2 * np.sqrt(inside)
    return out


def ball_image(run: SimulatedRun, i: int, window: tuple[int, int, int, int], *, n: int = 96, sigma: float) -> Any:
    """Transmission of the ball alone on pixels (u_0, v_0, n_u, n_v): n x n points a pixel, then blur and pixel box."""
    view, T_MW = View.of(run.scanner), run.frames(i)[Frame.M]
    c = T_MW.apply(run.t) - view.source
    r = run.ball_diameter / 2
    mu = attenuation("WC-Co", run.spectrum.energy)
    w = run.spectrum.weight / run.spectrum.weight.sum()
    # The exact spectrum as a function of the chord, by interpolation on 200,000 points: 1e-9.
    chords = np.linspace(0, 2 * r, 200_001)
    table = np.zeros_like(chords)
    for a, b in zip(w, mu, strict=True):
        table += a * np.exp(-b * chords)
    u_0, v_0, n_u, n_v = window
    half = int(np.ceil(6 * sigma)) + 1
    u = u_0 - half - 0.5 + (np.arange((n_u + 2 * half) * n) + 0.5) / n
    v = v_0 - half - 0.5 + (np.arange((n_v + 2 * half) * n) + 0.5) / n

    def weights(x: Any, centres: Any) -> Any:
        d = x[:, None] - centres[None, :]
        k = (ndtr((d + 0.5) / sigma) - ndtr((d - 0.5) / sigma)) if sigma > 0 else (abs(d) < 0.5).astype(float)
        return k / k.sum(axis=0)

    k_u, k_v = weights(u, u_0 + np.arange(n_u)), weights(v, v_0 + np.arange(n_v))
    out = np.zeros((n_v, n_u))
    base = np.ascontiguousarray(view.O[None] - view.source + u[:, None] * view.U)
    for start in range(0, len(v), n):
        rows = slice(start, start + n)
        if not k_v[rows].any():
            continue
        chord = _chords(base, v[rows], view.V, c, r)
        out += k_v[rows].T @ (np.interp(chord, chords, table) @ k_u)
    return out


def shift_between(a: Any, b: Any) -> Any:
    """The least-squares shift (u, v), px, of image a against image b."""
    g_v, g_u = np.gradient(b)
    inner = (slice(1, -1), slice(1, -1))
    A = np.stack([-g_u[inner].ravel(), -g_v[inner].ravel()], axis=1)
    return np.linalg.lstsq(A, (a - b)[inner].ravel(), rcond=None)[0]


def edge_error(a: Any, b: Any) -> float:
    """Largest displacement of the edge, px: grey difference over the local slope, where the slope is steep."""
    g_v, g_u = np.gradient(b)
    slope = np.hypot(g_u, g_v)
    steep = slope > 0.25 * slope.max()
    return float((np.abs(a - b) / np.maximum(slope, 1e-12))[steep].max())
