r"""The paper's way to find the ball: an ellipse fitted to edge pixels, its centre corrected (paper sec. 5, ref. [19]).

The paper's code for it is not published; this is in for it: whole edge pixels as of Canny's detector (Gaussian
smoothing, non-maximum suppression of the gradient), the direct least-squares ellipse, and the exact correction of the
centre.  Pixels are whole, so each edge point is off by up to half a pixel: some 0.3 / sqrt(n / 2) px in each coordinate
of the centre, whatever the noise.

The ellipse's centre c lies further out than the projected centre m of the ball.  Both measured from the piercing point,
in mm, with semi-minor axis b and d_SD:  m = c / (1 + b^2 / d_SD^2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, sobel

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.errors import BallNotFoundError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

SMOOTHING_PX = 1.4142
STRONG = 0.3
"""Share of the strongest gradient from which on an edge counts."""
RING_PX = 4.0
ROUNDS = 3
FEWEST = 24


def edge_pixels(image: ArrayLike) -> tuple[Array, Array]:
    """u, v (n,): pixels where the gradient is strong and largest across the edge.  image[v, u]."""
    smooth = gaussian_filter(np.asarray(image, dtype=np.float64), SMOOTHING_PX, mode="nearest")
    g_u, g_v = sobel(smooth, axis=1), sobel(smooth, axis=0)
    g = np.hypot(g_u, g_v)
    sector = np.round(np.arctan2(g_v, g_u) / (np.pi / 4)).astype(int) % 4
    largest = np.zeros(g.shape, dtype=bool)
    inner = g[1:-1, 1:-1]
    for k, (dv, du) in enumerate(((0, 1), (1, 1), (1, 0), (1, -1))):
        ahead = g[1 + dv : g.shape[0] - 1 + dv, 1 + du : g.shape[1] - 1 + du]
        behind = g[1 - dv : g.shape[0] - 1 - dv, 1 - du : g.shape[1] - 1 - du]
        largest[1:-1, 1:-1] |= (sector[1:-1, 1:-1] == k) & (inner >= behind) & (inner > ahead)
    v, u = np.nonzero(largest & (g > STRONG * g.max()))
    return u.astype(np.float64), v.astype(np.float64)


def fit_ellipse(x: Array, y: Array) -> Array:
    """Conic (6,) a x^2 + b x y + c y^2 + d x + e y + f = 0, an ellipse by construction: the direct fit.

    Source: Fitzgibbon, Pilu, Fisher, IEEE Trans. PAMI 21 (1999) 476, in the numerically stable form of Halir and
    Flusser, Proc. WSCG (1998) 125.
    """
    D_1, D_2 = np.column_stack([x * x, x * y, y * y]), np.column_stack([x, y, np.ones_like(x)])
    S_1, S_2, S_3 = D_1.T @ D_1, D_1.T @ D_2, D_2.T @ D_2
    T = -np.linalg.solve(S_3, S_2.T)
    M = S_1 + S_2 @ T
    M = np.array([M[2] / 2, -M[1], M[0] / 2])
    _, vectors = np.linalg.eig(M)
    vectors = np.real(vectors)
    kind = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    a_1 = vectors[:, int(np.argmax(kind))]
    return np.concatenate([a_1, T @ a_1])


def centre_and_axes(conic: Array) -> tuple[Array, float, float]:
    """Centre (2,), semi-major and semi-minor axis of a conic (6,)."""
    a, b, c, d, e, f = conic
    Q = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(Q, -np.array([d, e]) / 2)
    value = f + np.array([d, e]) @ centre / 2
    axes = np.sqrt(-value / np.linalg.eigvalsh(Q))
    return centre, float(axes.max()), float(axes.min())


def corrected_centre(scanner: Scanner, centre: Array, semi_minor_mm: float) -> Array:
    """Projected centre of the ball (2,), px, from the ellipse's centre (2,), px, and its semi-minor axis, mm."""
    piercing = np.array([scanner.u_0, scanner.v_0])
    return np.asarray(piercing + (centre - piercing) / (1 + (semi_minor_mm / scanner.d_SD) ** 2))


def ellipse_method(image: ArrayLike, scanner: Scanner, *, origin: tuple[int, int] = (0, 0)) -> Array:
    """Projected centre of the ball (2,), px in D, by the paper's method; a detector without tilts.

    image:  a crop [v, u] around the ball, which is darker than what surrounds it.
    origin: (u, v) in D of its pixel [0, 0].

    Raises BallNotFoundError where there are too few edge pixels on a ring around the dark disc.
    """
    image = np.asarray(image, dtype=np.float64)
    level = (image.min() + image.max()) / 2
    v, u = np.nonzero(image < level)
    middle = np.array([u.mean(), v.mean()])
    x, y = edge_pixels(image)
    r = np.hypot(x - middle[0], y - middle[1])
    expected = np.sqrt(u.size / np.pi)
    near = np.abs(r - expected) < RING_PX
    x, y = x[near], y[near]
    for _ in range(ROUNDS):
        if x.size < FEWEST:
            raise BallNotFoundError(f"only {x.size} edge pixels lie on a ring of {expected:.1f} px; is a ball there?")
        # Centred and scaled, the normal equations are well conditioned; pitches make the ellipse one in mm.
        X, Y = (x - middle[0]) * scanner.p_u, (y - middle[1]) * scanner.p_v
        scale = np.sqrt(np.mean(X**2 + Y**2))
        centre, major, minor = centre_and_axes(fit_ellipse(X / scale, Y / scale))
        off = np.abs(np.hypot(X / scale - centre[0], Y / scale - centre[1]) - (major + minor) / 2)
        keep = off < max(3.5 * MAD_TO_SIGMA * np.median(off), 1e-6)
        if keep.all():
            break
        x, y = x[keep], y[keep]
    c = middle + scale * centre / [scanner.p_u, scanner.p_v] + np.asarray(origin, dtype=np.float64)
    return corrected_centre(scanner, c, scale * minor)
