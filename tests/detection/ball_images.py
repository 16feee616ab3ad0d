"""Analytic radiographs of a ball half sunk in a tube, for tests and benchmarks of detection.

The scene is computed ray by ray on sub-pixels (the ball's silhouette with fractional coverage), blurred by a Gaussian
on the sub-pixel grid and averaged into pixels: the error of the simulated centre stays below 0.0001 px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from tomopose import Scanner
from tomopose.units import Array

PEEK = 0.025
"""Linear attenuation of the tube, 1/mm, about that of PEEK in a filtered 120 kV beam."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One ball in one tube, written in S (mm).  mu = inf is an opaque ball; mu_tube = 0 leaves the tube out."""

    scanner: Scanner
    centre: tuple[float, float, float]
    radius: float = 4.0
    mu: float = np.inf
    floor: float = 0.01
    mu_tube: float = PEEK
    tube_inner: float = 4.0
    tube_outer: float = 6.0
    tube_tilt: float = 0.0
    tube_roll: float = 0.0
    tube_top: float = 0.0
    blur: float = 0.7

    @property
    def x_D(self) -> Array:
        """Projection of the ball's centre, px."""
        x = self.scanner.K @ np.asarray(self.centre)
        return x[:2] / x[2]

    @property
    def silhouette_radius(self) -> float:
        """About, px."""
        return self.radius * self.scanner.d_SD / abs(self.centre[2]) / np.sqrt(self.scanner.p_u * self.scanner.p_v)


def centre_at(scanner: Scanner, u: float, v: float, distance: float) -> tuple[float, float, float]:
    """The point of S at that depth which projects to (u, v)."""
    ray = np.linalg.solve(scanner.K, [u, v, 1.0])
    x, y, z = ray * (distance / abs(ray[2]))
    return float(x), float(y), float(z)


def noise_free(scene: Scene, *, u: int, v: int, n_u: int, n_v: int, oversample: int = 5) -> Array:
    """Transmission image [v, u] of the window whose pixel [0, 0] is pixel (u, v) of the detector."""
    pad = int(np.ceil(6 * scene.blur)) + 1
    k = oversample
    fine_u = u - pad + (np.arange((n_u + 2 * pad) * k) + 0.5) / k - 0.5
    fine_v = v - pad + (np.arange((n_v + 2 * pad) * k) + 0.5) / k - 0.5
    image = _transmission(scene, fine_u, fine_v, 1.0 / k)
    p = np.sqrt(scene.scanner.p_u * scene.scanner.p_v)
    sigma = (scene.blur * k * p / scene.scanner.p_v, scene.blur * k * p / scene.scanner.p_u)
    image = gaussian_filter(image, sigma, truncate=6.0)
    image = image.reshape(n_v + 2 * pad, k, n_u + 2 * pad, k).mean(axis=(1, 3))
    return image[pad:-pad, pad:-pad]


def _transmission(scene: Scene, fine_u: Array, fine_v: Array, width: float) -> Array:
    inverse = np.linalg.inv(scene.scanner.K)
    uu, vv = np.meshgrid(fine_u, fine_v)
    d = inverse[:, 0, None, None] * uu + inverse[:, 1, None, None] * vv + inverse[:, 2, None, None]
    d *= np.sign(inverse[2, 2]) * np.sign(scene.centre[2])
    d /= np.sqrt((d**2).sum(axis=0))
    c = np.asarray(scene.centre)
    along = np.einsum("i,ijk->jk", c, d)
    miss = np.sqrt(np.maximum((c @ c) - along**2, 0.0))
    background = np.exp(-scene.mu_tube * _tube_chord(scene, d, c)) if scene.mu_tube else np.ones_like(miss)
    grad_v, grad_u = np.gradient(miss, fine_v, fine_u)
    step = width * (np.abs(grad_u) + np.abs(grad_v)) + 1e-300
    if np.isinf(scene.mu):
        low, high = np.sort(width * np.abs(np.stack([grad_u, grad_v])), axis=0)
        through = 1.0 - _coverage((scene.radius - miss), low, high)
    else:
        parts = np.linspace(-0.45, 0.45, 10)
        through = np.mean(
            [np.exp(-2 * scene.mu * np.sqrt(np.maximum(scene.radius**2 - (miss + p * step) ** 2, 0))) for p in parts],
            axis=0,
        )
    return scene.floor + (1.0 - scene.floor) * background * through


def _coverage(distance: Array, low: Array, high: Array) -> Array:
    """Covered share of a square cut by a line: the integral of a trapezoid with half-widths (high +- low) / 2."""
    low = np.maximum(low, 1e-9 * high)

    def ramp(x: Array) -> Array:
        return np.maximum(x, 0.0) ** 2 / 2

    h, l = high / 2, low / 2
    area = ramp(distance + h + l) - ramp(distance + h - l) - ramp(distance - h + l) + ramp(distance - h - l)
    return area / (low * high)


def _tube_chord(scene: Scene, d: Array, c: Array) -> Array:
    """Path through a half-infinite tube whose end lies at the ball's centre (plus tube_top) and points up (+y)."""
    axis = np.array(
        [
            np.sin(scene.tube_roll),
            np.cos(scene.tube_roll) * np.cos(scene.tube_tilt),
            np.cos(scene.tube_roll) * np.sin(scene.tube_tilt),
        ]
    )
    da, ca = np.einsum("i,ijk->jk", axis, d), axis @ c
    perpendicular = d - axis[:, None, None] * da
    centre = c - axis * ca
    A = (perpendicular**2).sum(axis=0)
    B = np.einsum("i,ijk->jk", centre, perpendicular)
    with np.errstate(divide="ignore", invalid="ignore"):
        t_top = (ca + scene.tube_top) / da
    below_first = da > 0
    path = np.zeros_like(A)
    for radius, sign in ((scene.tube_outer, 1.0), (scene.tube_inner, -1.0)):
        root = np.sqrt(np.maximum(B**2 - A * (centre @ centre - radius**2), 0.0))
        t0, t1 = (B - root) / A, (B + root) / A
        level = (ca + scene.tube_top) > 0
        start = np.where(da == 0, np.where(level, t0, t1), np.where(below_first, t0, np.maximum(t0, t_top)))
        end = np.where(da == 0, t1, np.where(below_first, np.minimum(t1, t_top), t1))
        path += sign * np.maximum(end - start, 0.0)
    return path


def noisy(image: Array, snr: float, rng: np.random.Generator, *, white: float = 1.0) -> Array:
    """Poisson noise, background SNR `snr` at transmission 1; the result is scaled so that transmission 1 is `white`."""
    return rng.poisson(np.maximum(image, 0.0) * snr**2) * (white / snr**2)


def standard_scene(magnification: float = 2.7, *, du: float = 0.0, dv: float = 0.0, blur: float = 0.7) -> Scene:
    """8 mm ball, d_SD 1500, pitch 0.2, off the detector's centre by (300 + du, -200 + dv) px."""
    d_SR = 1500.0 / magnification
    scanner = Scanner(d_SD=1500.0, d_SR=d_SR, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048)
    centre = centre_at(scanner, 1321.0 + du, 827.0 + dv, d_SR)
    return Scene(scanner=scanner, centre=centre, blur=blur)


def window(scene: Scene, margin: float = 1.35) -> dict[str, int]:
    """A square window around the ball."""
    x, half = scene.x_D, int(scene.silhouette_radius * margin + 12)
    return {"u": round(x[0]) - half, "v": round(x[1]) - half, "n_u": 2 * half + 1, "n_v": 2 * half + 1}


def derivatives(scene: Scene, box: dict[str, int]) -> Array:
    """(6, n_v, n_u): image by centre u, v (tube fixed), radius, level, floor, blur; central differences."""

    def moved(**change: float) -> Array:
        x = scene.x_D + np.array([change.get("u", 0.0), change.get("v", 0.0)])
        shifted = centre_at(scene.scanner, x[0], x[1], abs(scene.centre[2]))
        delta = np.asarray(shifted) - np.asarray(scene.centre)
        new = replace(
            scene, centre=shifted, radius=scene.radius + change.get("r", 0.0), blur=scene.blur + change.get("blur", 0.0)
        )
        return _fixed_tube(new, delta, box)

    h, hr, hs = 0.05, 0.005, 0.01
    out = [(moved(**{k: s}) - moved(**{k: -s})) / (2 * s) for k, s in (("u", h), ("v", h), ("r", hr))]
    base = noise_free(scene, **box)
    ball = noise_free(replace(scene, floor=0.0, mu_tube=0.0), **box)
    out += [base - scene.floor, 1.0 - ball, (moved(blur=hs) - moved(blur=-hs)) / (2 * hs)]
    return np.stack(out)


def _fixed_tube(scene: Scene, delta: Array, box: dict[str, int]) -> Array:
    """The scene with the ball moved by delta and the tube left where it was (to first order: separate factors)."""
    ball = noise_free(replace(scene, mu_tube=0.0, floor=0.0), **box)
    old = replace(scene, centre=tuple(np.asarray(scene.centre) - delta), radius=1e-9)
    return scene.floor + (1 - scene.floor) * ball * noise_free(replace(old, floor=0.0), **box)


def cramer_rao(scene: Scene, box: dict[str, int], snr: float) -> Array:
    """Covariance bound (2, 2) of the centre, jointly with radius, level, floor and blur, Poisson noise.

    The holder counts as known: no detector can know more.
    """
    J = derivatives(scene, box).reshape(6, -1)
    variance = np.maximum(noise_free(scene, **box).ravel(), 1e-6) / snr**2
    return np.linalg.inv((J / variance) @ J.T)[:2, :2]


def frame(scene: Scene, *, extra: Array | None = None, margin: float = 2.0) -> Array:
    """Noise-free full frame: the scene near the ball, transmission 1 elsewhere, times `extra` (n_v, n_u)."""
    s = scene.scanner
    image = np.ones(s.shape)
    box = window(scene, margin)
    u0, v0 = max(box["u"], 0), max(box["v"], 0)
    u1, v1 = min(box["u"] + box["n_u"], s.n_u), min(box["v"] + box["n_v"], s.n_v)
    image[v0:v1, u0:u1] = noise_free(scene, u=u0, v=v0, n_u=u1 - u0, n_v=v1 - v0)
    return image if extra is None else image * extra


def scene_of(
    *, radius_px: float, u: float, v: float, n: int = 1024, pitch: tuple[float, float] = (0.2, 0.2), **change: object
) -> Scene:
    """An 8 mm ball whose silhouette has about that radius, centred at (u, v) of an n x (n - 23) detector."""
    p = float(np.sqrt(pitch[0] * pitch[1]))
    d_SR = min(4.0 * 1500.0 / (radius_px * p), 1499.0)
    diameter = 2 * radius_px * p * d_SR / 1500.0
    scanner = Scanner(d_SD=1500.0, d_SR=d_SR, p_u=pitch[0], p_v=pitch[1], u_0=0.49 * n, v_0=0.53 * n, n_u=n, n_v=n - 23)
    size = diameter / 8.0
    values: dict[str, object] = {
        "radius": diameter / 2,
        "tube_inner": 4.0 * size,
        "tube_outer": 6.0 * size,
        "mu_tube": PEEK / size,
    }
    return Scene(scanner=scanner, centre=centre_at(scanner, u, v, d_SR), **{**values, **change})  # type: ignore[arg-type]
