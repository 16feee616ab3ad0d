"""The pose that would help most now: the next image of a run that is being taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.assumed import taken_as_known
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.rigid.pose_noise import expected_scatter
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.planning.design import DesignSettings, pose_information, prior_information
from tomopose.planning.exchange import START_WEIGHT, criterion_gains
from tomopose.planning.limits import PlanLimits, candidates
from tomopose.planning.target import scan_target

DETERMINED = 1e-12
"""Least eigenvalue of the balanced information (largest 1) from which every coordinate counts as determined."""


@dataclass(frozen=True, kw_only=True)
class NextPose:
    """pose: one row;  before, after: scan reprojection error, px rms, without and with it; inf where the poses so far
    leave a coordinate undetermined;  undetermined: names of the coordinates that they cannot distinguish."""

    pose: PoseSequence
    before: float
    after: float
    undetermined: tuple[str, ...]


def next_pose(
    scanner: Scanner,
    taken: PoseSequence,
    *,
    T_HT: RigidTransform,
    t: ArrayLike,
    limits: PlanLimits | None = None,
    settings: DesignSettings | None = None,
) -> NextPose:
    """The candidate within the limits that lowers the error of the paper's tilted scan most.

    taken: poses imaged so far;  T_HT, t: mount and ball centre in M, mm, as far as they are known: roughly is enough.
    """
    T_HT = T_HT.require(Frame.H, Frame.T)
    ball = np.asarray(t, dtype=np.float64).reshape(3)
    limits = PlanLimits() if limits is None else limits
    settings = DesignSettings() if settings is None else settings
    _, _, freed = taken_as_known((scanner,))
    target = scan_target(scanner, T_HT=T_HT, free=freed)
    pool = candidates(scanner, T_HT=T_HT, t=ball, limits=limits)
    noise: dict[str, Any] = {
        "T_HT": T_HT, "t": ball, "sigma": settings.sigma, "free": freed, "scatter": expected_scatter(settings.maker)
    }  # fmt: skip
    L, own = pose_information(scanner, pool, **noise), pose_information(scanner, taken, **noise)
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("kia,kia->a", L, L), 1e-300))
    L, own, M = L * scale, own * scale, target.M * scale[:, None] * scale
    N = np.einsum("kia,kib->ab", own, own) + prior_information(freed) * scale[:, None] * scale
    ridge = START_WEIGHT * np.einsum("kia,kib->ab", L, L) / len(L)
    best = int(criterion_gains(L, np.linalg.inv(N + ridge), M, "A", 1).argmin())
    with_it = N + L[best].T @ L[best]
    return NextPose(
        pose=pool.select([best]),
        before=_error(N, M),
        after=_error(with_it, M),
        undetermined=tuple(name for name, w in zip(target.names, _weakest(N), strict=True) if w),
    )


def _balanced(N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues, ascending, and vectors of the information with a diagonal of ones."""
    d = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    value, vector = np.linalg.eigh(N * d[:, None] * d)
    return value, vector


def _error(N: np.ndarray, M: np.ndarray) -> float:
    if _balanced(N)[0][0] < DETERMINED:
        return float("inf")
    return float(np.sqrt(max(np.trace(M @ inverse_information(N)), 0.0)))


def _weakest(N: np.ndarray) -> np.ndarray:
    """(m,) bool: coordinates with a notable part in a direction that is not determined."""
    value, vector = _balanced(N)
    weak = np.abs(vector[:, value < DETERMINED])
    return (weak > 0.3 * weak.max(axis=0, initial=1e-300)).any(axis=1) if weak.size else np.zeros(len(N), dtype=bool)
