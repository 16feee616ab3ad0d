"""The calibration object (paper fig. 6): a tungsten-carbide ball, half sunk in a tube on an extension; and where its
centre and its silhouette's centre are projected."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import OutOfViewError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.objects.shapes import Solid, cylinder, sphere
from tomopose.units import Array


def ball_in_holder(
    *,
    t: ArrayLike,
    ball_diameter: float = 8.0,
    axis: ArrayLike = (0.0, 0.0, 1.0),
    tube_diameter: float | None = None,
    tube_length: float = 15.0,
    extension_diameter: float = 16.0,
    extension_length: float = 60.0,
) -> tuple[Solid, ...]:
    """Ball of WC-Co at t (3,) mm in M, its lower half in a PEEK tube whose rim lies at the ball's equator.

    axis: the tube's direction in M, towards the ball; lengths and diameters in mm.  The tube's bore has the ball's
    diameter; below the tube an aluminium extension continues.
    """
    r = ball_diameter / 2
    outer = (1.5 * ball_diameter if tube_diameter is None else tube_diameter) / 2
    tube = cylinder(outer, -tube_length, 0.0) - cylinder(r, -tube_length - 1.0, 1.0)
    extension = cylinder(extension_diameter / 2, -tube_length - extension_length, -tube_length)
    return (
        Solid(shape=extension.along(axis, t=t), material="Al", name="extension"),
        Solid(shape=tube.along(axis, t=t), material="PEEK", name="holder"),
        Solid(shape=sphere(r).placed(t=t), material="WC-Co", name="ball"),
    )


def silhouette_centre(scanner: Scanner, x_S: ArrayLike, radius: float) -> Array:
    r"""Centre (n, 2), px, of the ellipse that balls at x_S (n, 3) in S cast: not the projected ball centre.

    The silhouette is the cone x' (c c' - (c.c - r^2) 1) x = 0; with x = K^-1 (u, v, 1)' it is a conic Q of the
    panel, and the ellipse's centre solves Q_11 m = -Q_12.
    """
    c = np.atleast_2d(np.asarray(x_S, dtype=np.float64))
    beyond = np.einsum("ni,ni->n", c, c) - radius**2
    if (beyond <= 0).any():
        raise OutOfViewError("the source lies inside the ball", indices=np.flatnonzero(beyond <= 0).tolist())
    cone = c[:, :, None] * c[:, None, :] - beyond[:, None, None] * np.eye(3)
    K_inv = np.linalg.inv(scanner.K)
    Q = K_inv.T @ cone @ K_inv
    return np.asarray(-np.linalg.solve(Q[:, :2, :2], Q[:, :2, 2:])[..., 0])


def ball_positions(
    scanner: Scanner, *, T_HT: RigidTransform, T_MH: RigidTransform, t: ArrayLike, alpha: ArrayLike
) -> Array:
    """Ball centres (n, 3) in S, mm: the chain of eq. (6) before the projection."""
    T_HT, T_MH = T_HT.require(Frame.H, Frame.T), T_MH.require(Frame.M, Frame.H)
    n = len(T_MH)
    t = np.broadcast_to(np.asarray(t, dtype=np.float64), (n, 3))
    T_TW = scanner.T_TW(np.broadcast_to(np.asarray(alpha, dtype=np.float64), (n,)))
    x_T = T_HT.apply((T_MH.R @ t[:, :, None])[..., 0] + T_MH.t)
    return scanner.T_WS.apply((T_TW.R @ x_T[:, :, None])[..., 0] + T_TW.t)
