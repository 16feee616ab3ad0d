"""A scanner as it is: the way from a point on the manipulator's plate to a pixel, with all that reality adds.

Nothing here uses the library: rotations, panel, table and manipulator are written anew from the definitions of the
frames (docs/concepts/frames.md), so that a mistake of the library's own chain shows as one.  Lengths in mm, angles in
rad, pixels in D.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

W_TO_S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def turn(axis: int, angle: np.ndarray | float) -> np.ndarray:
    """(..., 3, 3): right-handed turn about coordinate axis 0, 1 or 2."""
    a = np.asarray(angle, dtype=float)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((*a.shape, 3, 3))
    R[..., axis, axis] = 1.0
    R[..., i, i] = R[..., j, j] = np.cos(a)
    R[..., j, i], R[..., i, j] = np.sin(a), -np.sin(a)
    return R


def small_turn(w: np.ndarray) -> np.ndarray:
    """(..., 3, 3): turn by the rotation vector w, by the series of the exponential (|w| below about 1)."""
    w = np.asarray(w, dtype=float)
    X = np.zeros((*w.shape[:-1], 3, 3))
    X[..., 2, 1], X[..., 0, 2], X[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    X = X - np.swapaxes(X, -1, -2)
    result = term = np.broadcast_to(np.eye(3), X.shape)
    for k in range(1, 16):
        term = term @ X / k
        result = result + term
    return result


@dataclass
class Panel:
    """Source and detector.  barrel: px at the corner of the panel; tiles: (rows, columns, 2) px offset of each tile."""

    d_SD: float = 1500.0
    d_SR: float = 283.5
    p_u: float = 0.2
    p_v: float = 0.2
    u_0: float = 1021.37
    v_0: float = 1026.81
    n_u: int = 2048
    n_v: int = 2048
    eta: float = 0.0
    theta: float = 0.0
    phi: float = 0.0
    barrel: float = 0.0
    tiles: np.ndarray | None = None

    def pixels(self, x_S: np.ndarray, spot: np.ndarray | float = 0.0) -> np.ndarray:
        """(..., 2) of points (..., 3) in S, the focal spot displaced by `spot` (..., 3)."""
        R = turn(0, self.theta) @ turn(1, self.phi) @ turn(2, self.eta)
        centre = np.array([0.0, 0.0, self.d_SD])
        origin = np.zeros(3) + spot
        ray = x_S - origin
        far = ((centre - origin) @ R[:, 2]) / (ray @ R[:, 2])
        hit = origin + far[..., None] * ray - centre
        x = np.stack([self.u_0 - hit @ R[:, 0] / self.p_u, self.v_0 + hit @ R[:, 1] / self.p_v], axis=-1)
        return x + self.distortion(x)

    def distortion(self, x: np.ndarray) -> np.ndarray:
        middle = np.array([self.n_u - 1.0, self.n_v - 1.0]) / 2
        q = (x - middle) / np.linalg.norm(middle)
        d = self.barrel * q * (q * q).sum(axis=-1, keepdims=True)
        if self.tiles is not None:
            shape = np.array(self.tiles.shape[1::-1])
            k = np.clip((x / [self.n_u, self.n_v] * shape).astype(int), 0, shape - 1)
            d = d + self.tiles[k[..., 1], k[..., 0]]
        return d


@dataclass
class Table:
    """A rotary table.  encoder: (harmonic, rad amplitude, phase); shift: (harmonic, axis, mm, phase) of its centre;
    tilt: (harmonic, axis, rad, phase) of its axis; offset (3,) mm and lean (2,) rad: where the real axis is."""

    encoder: list[tuple[int, float, float]] = field(default_factory=list)
    shift: list[tuple[int, int, float, float]] = field(default_factory=list)
    tilt: list[tuple[int, int, float, float]] = field(default_factory=list)
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    lean: tuple[float, float] = (0.0, 0.0)

    def to_W(self, alpha: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Points x (n, m, 3) of T in W, at table angles alpha (n,)."""
        real = alpha + sum(a * np.sin(k * alpha + p) for k, a, p in self.encoder)
        A = turn(0, self.lean[0]) @ turn(1, self.lean[1])
        R = A @ turn(2, np.broadcast_to(real, alpha.shape)) @ A.T
        w, s = np.zeros((len(alpha), 3)), np.zeros((len(alpha), 3))
        for k, axis, a, p in self.tilt:
            w[:, axis] += a * np.cos(k * alpha + p)
        for k, axis, a, p in self.shift:
            s[:, axis] += a * np.cos(k * alpha + p)
        R = small_turn(w) @ R
        return np.einsum("nij,nmj->nmi", R, x - self.offset) + self.offset + s[:, None]


@dataclass
class Machine:
    """From reported to real poses.  scale_t, scale_w (3,): of travels and angles; periodic: (axis 0..5, mm or rad,
    period mm or rad, phase); backlash (6,) mm, rad by the direction of the last move; scatter (mm, rad)."""

    scale_t: np.ndarray = field(default_factory=lambda: np.ones(3))
    scale_w: np.ndarray = field(default_factory=lambda: np.ones(3))
    skew: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    periodic: list[tuple[int, float, float, float]] = field(default_factory=list)
    backlash: np.ndarray = field(default_factory=lambda: np.zeros(6))
    scatter: tuple[float, float] = (0.0, 0.0)

    def real(self, w: np.ndarray, t: np.ndarray, angles_to_R, rng: np.random.Generator):
        """Real (R (n, 3, 3), t (n, 3)) of poses reported as angles w (n, 3) and positions t (n, 3)."""
        x = np.concatenate([t, w], axis=1)
        off = np.zeros_like(x)
        for axis, a, period, phase in self.periodic:
            off[:, axis] += a * np.sin(2 * np.pi * x[:, axis] / period + phase)
        step = np.diff(x, axis=0, prepend=x[:1])
        way = np.zeros_like(x)
        for k in range(1, len(x)):
            way[k] = np.where(np.abs(step[k]) > 1e-9, np.sign(step[k]), way[k - 1])
        off -= self.backlash * way / 2
        t_real = (t * self.scale_t) @ (np.eye(3) + self.skew).T + off[:, :3]
        R = angles_to_R(w * self.scale_w + off[:, 3:])
        n = len(t)
        R = R @ small_turn(self.scatter[1] * rng.standard_normal((n, 3)))
        return R, t_real + self.scatter[0] * rng.standard_normal((n, 3))


def intrinsic_xyz(w: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of angles (n, 3): R_x R_y R_z."""
    return turn(0, w[:, 0]) @ turn(1, w[:, 1]) @ turn(2, w[:, 2])


@dataclass
class World:
    """Everything between the plate and the pixels.

    R_HT, t_HT: the mount;  balls (b, 3): in M;  moving: the manipulator carries the scanner, balls are fixed in its
    base.
    slip: (first pose, (3,) mm) of the ball;  bump: (first pose, (3,) rad, (3,) mm) of the mount;
    spot_drift (3,), ball_drift (3,): mm over the run;  image_drift (2,): px over the run.
    """

    panel: Panel = field(default_factory=Panel)
    table: Table = field(default_factory=Table)
    machine: Machine = field(default_factory=Machine)
    R_HT: np.ndarray = field(default_factory=lambda: np.eye(3))
    t_HT: np.ndarray = field(default_factory=lambda: np.zeros(3))
    moving: bool = False
    slip: tuple[int, np.ndarray] | None = None
    bump: tuple[int, np.ndarray, np.ndarray] | None = None
    ball_drift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    spot_drift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    image_drift: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def image(
        self,
        w: np.ndarray,
        t: np.ndarray,
        alpha: np.ndarray,
        x_M: np.ndarray,
        rng: np.random.Generator,
        *,
        run: bool,
    ) -> np.ndarray:
        """(n, m, 2) px of points x_M (n, m, 3).  run: what happens in time happens; a scan comes after it."""
        n = len(w)
        R, s = self.machine.real(w, t, intrinsic_xyz, rng)
        x_M = np.array(np.broadcast_to(x_M, (n, *np.shape(x_M)[-2:])), dtype=float)
        tau = np.linspace(0.0, 1.0, n)[:, None, None]
        R_HT, t_HT = np.broadcast_to(self.R_HT, (n, 3, 3)), np.broadcast_to(self.t_HT, (n, 3))
        if run:
            if self.slip is not None:
                x_M[self.slip[0] :] += self.slip[1]
            if self.bump is not None:
                k, turned, moved = self.bump
                late = (np.arange(n) >= k).astype(float)[:, None]
                R_HT, t_HT = small_turn(late * turned) @ R_HT, t_HT + late * moved
        if self.moving:
            x_H = np.einsum("nji,nmj->nmi", R, x_M - s[:, None])
        else:
            x_H = np.einsum("nij,nmj->nmi", R, x_M) + s[:, None]
        x_T = np.einsum("nij,nmj->nmi", R_HT, x_H) + t_HT[:, None]
        if run:
            x_T = x_T + tau * self.ball_drift
        x_S = self.table.to_W(alpha, x_T) @ W_TO_S.T + [0.0, 0.0, self.panel.d_SR]
        spot = tau * self.spot_drift if run else 0.0
        x = self.panel.pixels(x_S, spot)
        return x + tau * self.image_drift if run else x
