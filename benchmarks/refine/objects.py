"""Objects as sums of ellipsoids and cylinders, their line integrals in closed form, and scans with pose errors.

Shares no projector, grid or interpolation with the package: a ray of pixel (u, v) is cut with each solid exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Solid:
    """An ellipsoid ("ellipsoid") or a cylinder ("cylinder": axis z of its own frame); mu in 1/mm may be negative."""

    kind: str
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    mu: float
    turn: np.ndarray | None = None

    def chord(self, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Length, mm, of the rays s + t d (d: unit vectors) inside the solid."""
        R = np.eye(3) if self.turn is None else self.turn
        half = np.asarray(self.half)
        q, e = (s - np.asarray(self.centre)) @ R / half, d @ R / half
        m = 3 if self.kind == "ellipsoid" else 2
        a = (e[..., :m] ** 2).sum(-1)
        b = (q[..., :m] * e[..., :m]).sum(-1)
        c = (q[..., :m] ** 2).sum(-1) - 1
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (-b - root) / a, (-b + root) / a
            if self.kind == "cylinder":
                ends = np.stack([(-1 - q[..., 2]) / e[..., 2], (1 - q[..., 2]) / e[..., 2]])
                low, high = np.maximum(low, ends.min(0)), np.minimum(high, ends.max(0))
        return np.where(root > 0, np.maximum(high - low, 0), 0)


def balls(seed: int = 1, mu: float = 0.05) -> list[Solid]:
    rng, out = np.random.default_rng(seed), []
    while len(out) < 9:
        c, r = rng.uniform(-6.5, 6.5, 3), rng.uniform(1.0, 2.6)
        if all(np.linalg.norm(c - o.centre) > r + o.half[0] for o in out):
            out.append(Solid(kind="ellipsoid", centre=tuple(c), half=(r, r, r), mu=mu * rng.uniform(0.6, 1.4)))
    return out


def step_cylinder(mu: float = 0.04) -> list[Solid]:
    steps = [(8.0, -6.0), (6.0, -2.0), (4.5, 2.0), (3.0, 6.0)]
    out = [Solid(kind="cylinder", centre=(0, 0, z), half=(r, r, 2.0), mu=mu) for r, z in steps]
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    bores = ((4.6, 0.5, -6.0, 2.2), (-3.2, 3.4, -6.0, 1.5), (2.2, -2.4, 2.0, 1.0))
    out += [Solid(kind="cylinder", centre=(x, y, z), half=(r, r, 1.9), mu=-mu) for x, y, z, r in bores]
    out.append(Solid(kind="cylinder", centre=(0, 0, 2.0), half=(0.8, 0.8, 4.4), mu=-mu, turn=turn))
    return out


def ellipsoids(seed: int = 3, mu: float = 0.02) -> list[Solid]:
    rng = np.random.default_rng(seed)
    out = [Solid(kind="ellipsoid", centre=(0, 0, 0), half=(7.5, 6.0, 8.5), mu=mu)]
    for _ in range(8):
        c = rng.uniform(-3.5, 3.5, 3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        out.append(
            Solid(
                kind="ellipsoid",
                centre=tuple(c),
                half=tuple(rng.uniform(0.6, 1.8, 3)),
                mu=mu * rng.uniform(-0.9, 2),
                turn=turn,
            )
        )
    return out


def rod(mu: float = 0.04) -> list[Solid]:
    return [Solid(kind="cylinder", centre=(0.5, -0.3, 0), half=(3.0, 3.0, 60.0), mu=mu)]


def too_large(mu: float = 0.015) -> list[Solid]:
    return [*balls(5), Solid(kind="ellipsoid", centre=(4, 2, 0), half=(22, 16, 9), mu=mu)]


OBJECTS = {"balls": balls, "step cylinder": step_cylinder, "ellipsoids": ellipsoids, "rod": rod, "cut": too_large}


def rotation(w: np.ndarray) -> np.ndarray:
    """exp of rotation vectors (n, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = np.zeros((*w.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    K = K - np.swapaxes(K, -1, -2)
    a = np.where(angle > 1e-12, angle, 1)
    return (
        np.eye(3)
        + np.where(angle > 1e-12, np.sin(angle) / a, 1) * K
        + np.where(angle > 1e-12, (1 - np.cos(angle)) / a**2, 0.5) * K @ K
    )


@dataclass(frozen=True, kw_only=True)
class Panel:
    n_u: int = 109
    n_v: int = 101
    p_u: float = 1.2
    p_v: float = 1.1
    d_SD: float = 1200.0
    d_SR: float = 226.0
    u_0: float = 56.3
    v_0: float = 48.2

    @property
    def K(self) -> np.ndarray:
        return np.array([[self.d_SD / self.p_u, 0, self.u_0], [0, self.d_SD / self.p_v, self.v_0], [0, 0, 1.0]])


def path(kind: str, n: int) -> np.ndarray:
    """Rotations (n, 3, 3) of the object: circular, tilted once (sine) or seven times a turn."""
    a = 2 * np.pi * np.arange(n) / n
    zero = np.zeros(n)
    tilt = {"circle": zero, "sine": np.radians(10) * np.sin(a), "seven": np.radians(8) * np.sin(7 * a)}[kind]
    return rotation(np.stack([tilt, zero, zero], 1)) @ rotation(np.stack([zero, zero, a], 1))


def matrices(R: np.ndarray, t: np.ndarray, panel: Panel) -> np.ndarray:
    """P (n, 3, 4): the object turned by R and shifted by t; source at -y, axis v along z."""
    to_camera = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
    M = panel.K @ to_camera @ R
    last = panel.K @ (to_camera @ t[..., None] + np.array([0, 0, panel.d_SR])[:, None])
    return np.concatenate([M, last], axis=2)


def line_integrals(P: np.ndarray, solids: list[Solid], panel: Panel, fine: int = 2) -> np.ndarray:
    """(n, n_v, n_u), each pixel the mean over fine x fine rays."""
    shift = (np.arange(fine) + 0.5) / fine - 0.5
    out = np.zeros((len(P), panel.n_v, panel.n_u))
    v, u = np.mgrid[: panel.n_v, : panel.n_u].astype(float)
    for j, Pj in enumerate(P):
        M_inv = np.linalg.inv(Pj[:, :3])
        s = -M_inv @ Pj[:, 3]
        for dv in shift:
            for du in shift:
                d = np.stack([u + du, v + dv, np.ones_like(u)], -1) @ M_inv.T
                d /= np.linalg.norm(d, axis=-1, keepdims=True)
                out[j] += sum(solid.mu * solid.chord(s, d) for solid in solids)
    return out / fine**2


def moved(P: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """P with the object moved first by (t, w), xi (n, 6), mm and rad."""
    T = np.zeros((len(P), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rotation(xi[:, 3:]), xi[:, :3], 1
    return P @ T


def slow_errors(n: int, panel: Panel) -> np.ndarray:
    """L (n, 6, 60): motions (mm, rad) by unit errors of a hexapod that turns with the table, five harmonics of it."""
    a = 2 * np.pi * np.arange(n) / n
    px = panel.p_u * panel.d_SR / panel.d_SD
    size = np.diag([0.35 * px] * 3 + [np.radians(0.12)] * 3)
    waves = [f(k * a) for k in (1, 2, 3, 7, 14) for f in (np.cos, np.sin)]
    return np.concatenate([wave[:, None, None] * size for wave in waves], axis=2)


def errors(kind: str, n: int, seed: int, panel: Panel) -> np.ndarray:
    """xi (n, 6): white scatter of 1 px and 0.4 degrees, smooth errors as a hexapod makes them, one jump, or none."""
    rng = np.random.default_rng(seed)
    px = panel.p_u * panel.d_SR / panel.d_SD
    if kind == "white":
        return np.concatenate([rng.normal(size=(n, 3)) * px, np.radians(0.4) * rng.normal(size=(n, 3))], 1)
    xi = np.zeros((n, 6))
    if kind == "hexapod":
        xi = slow_errors(n, panel) @ rng.normal(size=60)
    if kind == "jump":
        xi[n // 3] = np.concatenate([rng.normal(size=3), np.zeros(3)]) * 0.7 * px
    return xi


def scan(
    obj: str = "balls",
    way: str = "seven",
    kind: str = "white",
    *,
    n: int = 64,
    seed: int = 0,
    noise: float = 0.005,
    hardening: float = 0.0,
    panel: Panel | None = None,
    integrals: Callable[[np.ndarray, list[Solid], Panel], np.ndarray] = line_integrals,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Panel]:
    """images (n, n_v, n_u) transmissions with noise, P as calibrated, P true, panel; integrals: who casts the rays."""
    panel = panel or Panel()
    P = matrices(path(way, n), np.zeros((n, 3)), panel)
    P_true = moved(P, errors(kind, n, seed, panel))
    p = integrals(P_true, OBJECTS[obj](), panel)
    if hardening:
        p = p - hardening * p**2
    rng = np.random.default_rng(1000 + seed)
    T = np.exp(-p)
    count = 1 / noise**2
    return np.maximum(rng.poisson(T * count), 1) / count, P, P_true, panel


def pixels(P: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(n, m, 2) of points x (m, 3)."""
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    return h[..., :2] / h[..., 2:]


def differences(P: np.ndarray, P_true: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(n, m, 2) px of points x (m, 3), the object's best rigid pose removed (Gauss-Newton, own code)."""
    target, pose = pixels(P_true, x), np.zeros(6)

    def at(q: np.ndarray) -> np.ndarray:
        return (pixels(P, x @ rotation(q[3:]).T + q[:3]) - target).ravel()

    for _ in range(6):
        r = at(pose)
        J = np.stack([(at(pose + 1e-5 * e) - r) / 1e-5 for e in np.eye(6)], 1)
        pose = pose - np.linalg.lstsq(J, r, rcond=None)[0]
    return at(pose).reshape(target.shape)


def error_px(P: np.ndarray, P_true: np.ndarray, half: float = 8.0) -> float:
    """rms px over corners of the object, the object's best rigid pose removed."""
    x = half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return float(np.sqrt(2 * np.mean(differences(P, P_true, x) ** 2)))
