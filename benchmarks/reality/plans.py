"""Calibration plans and scans of the benchmark: what is commanded, as angles (rad), positions (mm), table (rad)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chain import Panel, World, small_turn, turn


@dataclass
class Poses:
    w: np.ndarray
    t: np.ndarray
    alpha: np.ndarray
    ball: np.ndarray

    def __len__(self) -> int:
        return len(self.w)


def _grid() -> np.ndarray:
    g = np.array([-10.0, 0.0, 10.0])
    return np.stack(np.meshgrid(g, g, g, indexing="ij"), axis=-1).reshape(-1, 3)


def paper() -> Poses:
    """27 positions x 7 turns about single axes, table still: the paper's 189 poses."""
    a = np.radians(5.0)
    turns = np.concatenate([np.zeros((1, 3)), *(s * a * np.eye(3)[[k]] for k in range(3) for s in (1, -1))])
    return Poses(np.tile(turns, (27, 1)), np.repeat(_grid(), 7, axis=0), np.zeros(189), np.zeros(189, int))


def two_angles() -> Poses:
    """27 positions x 7 compound turns, half of them at another table angle; the first pose again at the end."""
    a = np.radians(5.0)
    signs = [(0, 0, 0), (1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1), (-1, -1, -1), (1, 1, -1)]
    w = np.tile(a * np.array(signs, float), (27, 1))
    t = np.repeat(_grid(), 7, axis=0)
    alpha = np.repeat(np.where(np.arange(27) % 2 == 0, 0.0, np.pi / 2), 7)
    order = np.argsort(alpha, kind="stable")
    order = np.append(order, order[0])
    return Poses(w[order], t[order], alpha[order], np.zeros(190, int))


def small(rng: np.random.Generator) -> Poses:
    """40 mixed poses at four table angles, the first again at the end."""
    w, t = rng.uniform(-1, 1, (40, 3)) * np.radians(5.0), rng.uniform(-10, 10, (40, 3))
    alpha = np.sort(np.tile(np.radians([0.0, 90.0, 180.0, 270.0]), 10))
    again = np.append(np.arange(40), 0)
    return Poses(w[again], t[again], alpha[again], np.zeros(41, int))


def robot(rng: np.random.Generator, n: int = 90) -> Poses:
    """A robot that turns the object by up to 150 degrees about its own z axis and tilts it by 15."""
    w = np.column_stack([rng.uniform(-1, 1, (n, 2)) * np.radians(15.0), rng.uniform(-1, 1, n) * np.radians(150.0)])
    t = rng.uniform(-15, 15, (n, 3))
    again = np.append(np.arange(n), 0)
    return Poses(w[again], t[again], np.zeros(n + 1), np.zeros(n + 1, int))


def hexapod_scan() -> Poses:
    """A tilted scan: one turn of the table, plate tilted to and fro by 5 degrees."""
    alpha = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    wave = np.radians(5.0) * np.sin(2 * alpha)
    return Poses(np.column_stack([wave, np.roll(wave, 3), 0 * wave]), np.zeros((24, 3)), alpha, np.zeros(24, int))


def robot_scan() -> Poses:
    w = np.column_stack([0.1 * np.sin(np.arange(24.0)), 0.1 * np.cos(2.0 * np.arange(24)), np.linspace(-2.5, 2.5, 24)])
    return Poses(w, np.zeros((24, 3)), np.zeros(24), np.zeros(24, int))


def points_in_view(panel: Panel) -> np.ndarray:
    """(9, 3) mm about the axis: corners and centre of a box that fills half of the field at every angle."""
    half = 0.25 * min(panel.n_u * panel.p_u, panel.n_v * panel.p_v) * panel.d_SR / panel.d_SD
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T * half
    return np.concatenate([np.zeros((1, 3)), corners * [0.7, 0.7, 1.0]])


def scan_error(P: np.ndarray, target: np.ndarray, x: np.ndarray) -> float:
    """px, rms per coordinate: pixels of points x (m, 3) under matrices P (n, 3, 4) against target (n, m, 2), the rigid
    motion of the whole object that explains most of it taken out (Gauss-Newton with numerical derivatives)."""
    q = np.zeros(6)
    middle = x.mean(axis=0)

    def calculated(q: np.ndarray) -> np.ndarray:
        y = (x - middle) @ small_turn(q[:3]).T + middle + q[3:]
        h = np.einsum("nij,mj->nmi", P[:, :, :3], y) + P[:, None, :, 3]
        return (h[..., :2] / h[..., 2:]).ravel()

    for _ in range(8):
        r = target.ravel() - calculated(q)
        step = np.array([1e-5] * 3 + [1e-3] * 3)
        J = np.column_stack([(calculated(q + s) - calculated(q - s)) for s in np.diag(step)]) / (2 * step)
        q = q + np.linalg.lstsq(J, r, rcond=None)[0]
    return float(np.sqrt(np.mean((target.ravel() - calculated(q)) ** 2)))


def world(kind: str, rng: np.random.Generator) -> tuple[World, np.ndarray]:
    """A scanner with a random mount, and its balls (b, 3)."""
    balls = np.array([[14.0, -9.0, 10.0]]) + rng.uniform(-2, 2, (1, 3))
    R_HT = small_turn(rng.normal(0, 0.01, 3)) @ turn(2, np.pi)
    t_HT = rng.uniform(-2, 2, 3)
    if kind == "moving":
        # the object is 600 mm before the plate's zero; the scanner is seen from the plate
        return World(R_HT=R_HT, t_HT=t_HT, moving=True), balls
    if kind == "two balls":
        balls = np.concatenate([balls, [[-12.0, 8.0, -11.0]] + rng.uniform(-2, 2, (1, 3))])
    return World(R_HT=R_HT, t_HT=t_HT), balls
