r"""What a ball cannot see of table and manipulator, but a scan can: directions with a prior and no data.

A scale error of the rotations turns the object too far, and moves a ball as a longer lever would: the fit takes it for
another t.  A table that wobbles moves nothing while it does not move.  With x = f(theta) + C q + noise, q the errors
with standard deviations sigma, the estimate is off by K q, K = (J^T V^-1 J + P^-1)^-1 J^T V^-1 C, and a scan whose
pixels change by J_s and S is off by (J_s K - S) q: the "consider" covariance of orbit determination (Schmidt, Adv.
Control Systems 3 (1966) 293).
"""

from __future__ import annotations

import numpy as np

from tomopose.calibration.model.assumed import (
    AS_DELIVERED_ROTATION_SCALE,
    AS_DELIVERED_TRANSLATION_SCALE,
    ROBOT_TRANSLATION_SCALE,
    ROTATION_SCALE,
    TRANSLATION_SCALE,
    WOBBLE_MM,
    WOBBLE_RAD,
)
from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.tall import ByBall, parts
from tomopose.geometry.rotations import R_z, log_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array
from tomopose.values import value

HARMONICS = (1, 2)
PLATFORM_RAD = 0.6
"""A manipulator that turns further than this between its poses is no platform: a robot's angles are joint encoders, and
its errors those of its links, so that the scale of its rotations is not assumed."""

ROTATIONS = tuple(f"rotation_scale_{c}" for c in "xyz")
WOBBLES = (
    *(f"table_{c}_{f}{k}" for k in HARMONICS for c in "xyz" for f in ("cos", "sin")),
    *(f"table_tilt_{c}_{f}{k}" for k in HARMONICS for c in "xy" for f in ("cos", "sin")),
)
TRANSLATIONS = "scale_of_translations"


@value
class Unseen:
    """names (c), sigma (c,): priors (1, mm, rad);  gain (m, c): K, how the estimate answers to each."""

    names: tuple[str, ...]
    sigma: Array
    gain: Array


def unseen_sigma(names: tuple[str, ...], *, robot: bool, measured: bool) -> Array:
    """Prior standard deviations; the second harmonic of a wobble is half the first.

    measured: whether every value of the scanner has a standard deviation that the user stated.
    """
    rotations = ROTATION_SCALE if measured else AS_DELIVERED_ROTATION_SCALE
    translations = TRANSLATION_SCALE if measured else AS_DELIVERED_TRANSLATION_SCALE
    values = []
    for name in names:
        size = (
            (ROBOT_TRANSLATION_SCALE if robot else translations)
            if name == TRANSLATIONS
            else rotations
            if name in ROTATIONS
            else WOBBLE_RAD
            if name.startswith("table_tilt")
            else WOBBLE_MM
        )
        values.append(size / (int(name[-1]) if name in WOBBLES else 1))
    return np.array(values)


def unseen_unit(name: str) -> str:
    """Unit of a direction that no ball shows."""
    return "" if name in ROTATIONS or name == TRANSLATIONS else "rad" if name.startswith("table_tilt") else "mm"


def largest_turn(R_MH: Array) -> float:
    """rad: the largest turn from the first of poses R_MH (n, 3, 3)."""
    return float(np.linalg.norm(log_rotation(R_MH[0].T @ R_MH), axis=1).max())


def unseen_names(turned: float, *, table: bool, translations: bool = True) -> tuple[str, ...]:
    """Those that apply to a manipulator that turns by up to `turned` rad, to a set-up with or without a table, where
    the scale of the translations is known or not."""
    return (
        *((TRANSLATIONS,) if translations else ()),
        *(ROTATIONS if 0.0 < turned < PLATFORM_RAD else ()),
        *(WOBBLES if table else ()),
    )


def turns(R: Array) -> Array:
    """(n, 3) rotation vectors of poses, limited to half a radian: what a scale error multiplies."""
    w = log_rotation(R)
    size = np.linalg.norm(w, axis=1, keepdims=True)
    return np.asarray(w * np.minimum(1.0, 0.5 / np.maximum(size, 1e-300)))


def unseen_columns(
    names: tuple[str, ...],
    b: ProjectionBlocks,
    *,
    T_HT: RigidTransform,
    origin: Array,
    alpha: Array,
    about_H: bool = False,
) -> Array:
    """(n, 2, c) px by a unit of each: of the balls or points that `b` projects.

    origin (n, 3): the plate's origin in H, mm;  alpha (n,): table angle, rad;  about_H: the poses are inverse ones, of
    a scanner that moves, and turn about the origin of H.
    """
    M = R_z(alpha)
    G_W = b.J_t_HT @ np.swapaxes(M, 1, 2)
    x_W = np.einsum("nij,nj->ni", M, b.x_H @ T_HT.R.T + T_HT.t)
    by_turn = np.cross((b.x_H if about_H else b.x_H - origin)[:, None], b.G_H)
    by_tilt = np.cross(x_W[:, None], G_W)
    w = turns(b.R_MH)
    columns = []
    for name in names:
        if name == TRANSLATIONS:
            columns.append((b.G_H @ origin[:, :, None])[..., 0])
            continue
        if name in ROTATIONS:
            i = "xyz".index(name[-1])
            columns.append(by_turn[:, :, i] * w[:, None, i])
            continue
        wave = (np.cos if name[-4:-1] == "cos" else np.sin)(int(name[-1]) * alpha)[:, None]
        axis = "xyz".index(name.split("_")[-2])
        columns.append((by_tilt if name.startswith("table_tilt") else G_W)[:, :, axis] * wave)
    return np.stack(columns, axis=2) if columns else np.zeros((*b.x_D.shape, 0))


def unseen_of(
    b: ProjectionBlocks,
    covariance: Array,
    J: Array | ByBall,
    V: Array,
    *,
    T_HT: RigidTransform,
    origin: Array,
    alpha: Array,
    moving_scanner: bool,
    scale_known: bool = False,
    measured: bool = True,
) -> Unseen:
    """What no ball shows of table and manipulator, and how the estimate of any model answers to it.

    b: of the rows used;  covariance (m, m), J (n, 2, m), V (n, 2, 2): of the fit;  scale_known: the scale of the
    translations is among the parameters or exact;  measured: as of `unseen_sigma`;  the others as of `unseen_columns`.
    """
    turned = largest_turn(b.R_MH)
    names = unseen_names(turned, table=not moving_scanner, translations=not scale_known)
    seen = np.zeros((J.shape[2], len(names)))
    for p in parts(len(J)):
        C = unseen_columns(names, b.rows(p), T_HT=T_HT, origin=origin[p], alpha=alpha[p], about_H=moving_scanner)
        seen += np.einsum("nim,nic->mc", J[p], np.linalg.solve(V[p], C))
    sigma = unseen_sigma(names, robot=turned > PLATFORM_RAD, measured=measured)
    return Unseen(names=names, sigma=sigma, gain=covariance @ seen)
