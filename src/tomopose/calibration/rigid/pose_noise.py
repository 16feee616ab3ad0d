r"""Pose noise apart from detection noise: variance components by restricted maximum likelihood.

The covariance of a centre is V_k = C_k + s_p^2 G_k G_k^T + s_w^2 L_k L_k^T: detection, and scatter of the manipulator
in translation (G_k = dx/dx_H) and in rotation (L_k = -G_k [x_H - s t_MH]_x: the ball's lever about the moved plate's
origin).  s_p and s_w maximise the restricted likelihood of the residuals r of a fit with Jacobian J,

    -2 log L = sum log det V_k + log det(J^T V^-1 J) + r^T (V^-1 - V^-1 J (J^T V^-1 J)^-1 J^T V^-1) r,

which counts the parameters that the fit has used up (Patterson and Thompson, Biometrika 58 (1971) 545).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.geometry.rotations import skew
from tomopose.units import Array

WORTH_IT = 9.2
"""-2 log L must fall by this much (1 % of chi2 with 2 degrees of freedom) before pose noise is believed."""
SINGULAR = 1e-14
"""Least eigenvalue of the scaled information matrix over the largest: rounding of its entries."""


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Standard deviations of a pose's scatter, a coordinate each: translation (mm) and rotation (rad).

    gain: how much -2 log L falls against detection noise alone; 0 where the values were given, not estimated.
    """

    translation: float
    rotation: float
    gain: float = 0.0


def pose_spread(b: ProjectionBlocks) -> tuple[Array, Array]:
    """(n, 2, 2) each: what 1 mm and 1 rad of pose noise add to the covariance of a centre, px^2."""
    lever = (b.R_MH @ b.t[:, :, None])[..., 0]
    L = b.G_H @ skew(lever)
    return b.G_H @ np.swapaxes(b.G_H, 1, 2), L @ np.swapaxes(L, 1, 2)


def total_covariance(covariance: Array, b: ProjectionBlocks, noise: PoseNoise) -> Array:
    """V (n, 2, 2) px^2 of detection and pose noise together."""
    A, B = pose_spread(b)
    return covariance + noise.translation**2 * A + noise.rotation**2 * B


def estimate_pose_noise(
    covariance: Array, b: ProjectionBlocks, J: Array, r: Array, *, prior_rows: Array, prior_residuals: Array
) -> PoseNoise:
    """The components that best explain residuals r (n, 2) px of a fit with Jacobian J (n, 2, m).

    prior_rows (k, m), prior_residuals (k,): priors in standard deviations, whose information N needs where the poses
    alone determine no freed parameter.  Both components are 0 where detection noise explains the residuals as well.
    """
    A, B = pose_spread(b)
    d2 = float(np.mean((r**2).sum(axis=1)))
    # starts: each component alone explaining the whole of the residual
    s_A, s_B = (
        np.sqrt(d2 / np.mean(np.trace(A, axis1=1, axis2=2))),
        np.sqrt(d2 / max(np.mean(np.trace(B, axis1=1, axis2=2)), 1e-300)),
    )
    scale = 1.0 / np.maximum(np.linalg.norm(J, axis=(0, 1)), 1e-300)
    Js, held = J * scale, prior_rows * scale
    N_prior, g_prior = held.T @ held, held.T @ prior_residuals

    def objective(q: Array) -> float:
        V = covariance + (s_A * np.exp(q[0])) ** 2 * A + (s_B * np.exp(q[1])) ** 2 * B
        Vi = np.linalg.inv(V)
        ViJ = Vi @ Js
        value, Q = np.linalg.eigh(np.einsum("kia,kib->ab", Js, ViJ) + N_prior)
        value = np.maximum(value, SINGULAR * value[-1])
        g = Q.T @ (np.einsum("kia,ki->a", ViJ, r) + g_prior)
        quadratic = np.einsum("ki,kij,kj->", r, Vi, r) - g @ (g / value)
        return float(np.log(np.linalg.det(V)).sum() + np.log(value).sum() + quadratic)

    none = objective(np.array([-40.0, -40.0]))
    best = min(
        (
            minimize(
                objective,
                start,
                method="Nelder-Mead",
                options={
                    "initial_simplex": np.array(start) + [[0, 0], [1.0, 0], [0, 1.0]],
                    "xatol": 1e-3,
                    "fatol": 1e-3,
                    "maxiter": 200,
                },
            )
            for start in ([-0.5, -1.0], [-6.0, -0.3])
        ),
        key=lambda result: float(result.fun),
    )
    gain = none - float(best.fun)
    if gain < WORTH_IT:
        return PoseNoise(translation=0.0, rotation=0.0, gain=max(gain, 0.0))
    p, w = s_A * np.exp(best.x[0]), s_B * np.exp(best.x[1])
    # a component that has been driven away is none
    return PoseNoise(
        translation=float(p) if best.x[0] > -7 else 0.0, rotation=float(w) if best.x[1] > -7 else 0.0, gain=gain
    )
