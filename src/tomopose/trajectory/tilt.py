"""Tilts of the object about the fixed y_W axis while the table turns.  Paper sec. 6.1: eqs. (10), (11) and the sine."""

from __future__ import annotations

import math

import numpy as np

from tomopose.errors import ShapeError
from tomopose.geometry.rotations import R_y, R_z
from tomopose.units import Array

R_HT_MOUNTED = R_z(math.pi)
"""The paper's approximation of R_HT before a calibration is known."""
R_HT_MOUNTED.setflags(write=False)


def eq10_rotation(alpha: Array, phi_tilt: Array, R_HT: Array = R_HT_MOUNTED) -> Array:
    """R_MH,j (n, 3, 3) = R_HT^-1 R_TW,j^-1 R_y(phi_tilt,j) R_TW,j R_HT.  Eq. (10).

    alpha: table angles (n,), rad; phi_tilt: wanted tilt about y_W (n,), rad; R_HT: (3, 3), of a calibration, or the
    paper's R_z(pi).  The tilt is about an axis through the origin of H, exactly y_W only where t_HT = 0.
    """
    alpha, phi_tilt = np.broadcast_arrays(np.asarray(alpha, np.float64), np.asarray(phi_tilt, np.float64))
    R_HT = np.asarray(R_HT, dtype=np.float64)
    if R_HT.shape != (3, 3):
        raise ShapeError(f"R_HT has shape {R_HT.shape}; one rotation (3, 3) is needed")
    R_TH = R_z(alpha) @ R_HT
    return np.swapaxes(R_TH, -1, -2) @ R_y(phi_tilt) @ R_TH


def eq11_triangle(alpha: Array) -> Array:
    """phi_tilt,j (n,), rad: amplitude 8 deg, phase 90 deg, seven periods a turn.  Eq. (11), as printed."""
    alpha = np.asarray(alpha, dtype=np.float64)
    return 28 / 45 * np.abs(np.mod(alpha + math.pi / 14, 2 * math.pi / 7) - math.pi / 7) - 2 * math.pi / 45


def triangle_wave(
    alpha: Array, *, amplitude: float, periods: float = 7.0, phase: float = math.pi / 2, offset: float = 0.0
) -> Array:
    """The general form of eq. (11), rad: a triangle wave that starts at its crest at phase 0 and at 0, falling, at
    phase pi/2.  With amplitude 8 deg, seven periods and phase pi/2 it is eq. (11)."""
    period = 2 * math.pi / periods
    shifted = np.asarray(alpha, dtype=np.float64) + phase / (2 * math.pi) * period
    return offset + 4 * amplitude / period * np.abs(np.mod(shifted, period) - period / 2) - amplitude


def sine_tilt(alpha: Array) -> Array:
    """phi_tilt,j (n,), rad: pi/180 + 4 pi/180 sin(7 alpha).  Paper sec. 6.1, the unnumbered equation after eq. (11)."""
    return sine_wave(alpha, amplitude=4 * math.pi / 180, offset=math.pi / 180)


def sine_wave(
    alpha: Array, *, amplitude: float, periods: float = 7.0, phase: float = 0.0, offset: float = 0.0
) -> Array:
    """offset + amplitude sin(periods alpha + phase), rad."""
    return offset + amplitude * np.sin(periods * np.asarray(alpha, dtype=np.float64) + phase)
