"""What a scan's uncertainty is made of, and what would make it smaller.

The scan is one turn of the table with the plate tilted to and fro by 5 degrees, or, for a manipulator that turns the
object itself, its own calibration poses.  Points: the field of view's corners and centre.  Everything is what a volume
sees: a rigid motion of the whole object is taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.model.budget import ScanBudget
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.unseen import PLATFORM_RAD, ROTATIONS, TRANSLATIONS, largest_turn
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.propagation import field_of_view_points
from tomopose.calibration.uncertainty.trajectory import scan_jacobian
from tomopose.errors import OutOfReachError, TrajectoryError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import RigidErrors, TwinErrors
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

TILT = np.radians(5.0)
VIEWS = 12


def reference_scan(poses: PoseSequence, *, tilt: float = TILT) -> PoseSequence:
    """The scan for which the first screen states an uncertainty; tilt: rad, 0 for a table that turns alone."""
    if largest_turn(poses.T_MH.R) > PLATFORM_RAD:
        return poses.select(np.unique(np.linspace(0, len(poses) - 1, 2 * VIEWS).round().astype(int)))
    alpha = np.linspace(0.0, 2 * np.pi, VIEWS, endpoint=False)
    w = tilt * np.column_stack([np.sin(2 * alpha), np.cos(2 * alpha + 0.5), np.zeros(VIEWS)])
    T_MH = RigidTransform(
        R=exp_rotation(w), t=np.broadcast_to(poses.T_MH.t.mean(axis=0), (VIEWS, 3)), source=Frame.M, target=Frame.H
    )
    return PoseSequence(T_MH=T_MH, pose_id=tuple(str(k) for k in range(VIEWS)), alpha=alpha)


def shares_of(
    J: Array, covariance: Array, columns: dict[str, list[int]]
) -> tuple[float, float, list[tuple[str, float]]]:
    """(total, measured, shares): J (k, c) px of the scan, covariance (c, c), columns of what was assumed, by name."""
    M = J.T @ J / max(len(J), 1)
    MC = M @ covariance
    total2 = max(float(np.trace(MC)), 0.0)

    def due_to(which: list[int]) -> float:
        """By how much the mean square would fall if those coordinates were exact: C falls by G S^+ G^T."""
        S = covariance[np.ix_(which, which)]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
        H = (covariance[which] @ MC[:, which]) * scale[:, None] * scale
        if len(which) == 1:  # scaled to 1, or without any variance
            return float(H[0, 0])
        return float((np.linalg.pinv(S * scale[:, None] * scale, rcond=1e-12, hermitian=True) * H).sum())

    everything = [j for which in columns.values() for j in which]
    measured = float(np.sqrt(max(total2 - due_to(everything), 0.0))) if everything else float(np.sqrt(total2))
    parts = [(name, float(np.sqrt(min(max(due_to(which), 0.0), total2)))) for name, which in columns.items()]
    return float(np.sqrt(total2)), measured, sorted(parts, key=lambda p: -p[1])


@dataclass(frozen=True, kw_only=True)
class ReferenceScan:
    """x_D (k, 2) px: where points of the field of view are imaged;  J (k, 2, c) px: how they answer to what was
    estimated and to what no ball shows, the object's rigid pose removed;  C (c, c): covariance of both."""

    x_D: Array
    J: Array
    C: Array


def reference_of(calibration: Calibration, problem: Problem) -> ReferenceScan | None:
    """The scan; None for twin robots, whose scans have two tables, and where no such scan is within reach."""
    if isinstance(calibration.errors, TwinErrors):
        return None
    own = PoseSequence(
        T_MH=problem.T_MH,
        pose_id=problem.pose_id,
        alpha=problem.alpha,
    )
    tilted = calibration.arrangement != "turntable"
    scan = reference_scan(own, tilt=TILT if tilted else 0.0)
    scanner = calibration.scanner
    first = scanner.T_TW(float(scan.alpha[0])) @ calibration.T_HT @ scan.T_MH[0]
    x_M = first.inv.apply(field_of_view_points(scanner))
    try:
        J, C = scan_jacobian(calibration, scan, x_M)
    except (TrajectoryError, OutOfReachError):
        return None
    pose = np.repeat(np.arange(len(scan)), len(x_M))
    b = projection_blocks(
        scanner, T_HT=calibration.T_HT, T_MH=scan.T_MH[pose], t=np.tile(x_M, (len(scan), 1)), alpha=scan.alpha[pose]
    )
    return ReferenceScan(x_D=b.x_D, J=J.reshape(len(pose), 2, -1), C=C)


def scan_budget(
    calibration: Calibration, problem: Problem, linear: LinearFit, scan: ReferenceScan | None
) -> ScanBudget | None:
    """The budget of a calibration; None where there is no scan of reference."""
    if scan is None:
        return None
    flat = scan.J.reshape(-1, scan.J.shape[-1])
    names = [*calibration.tangent, *(calibration.unseen.names if calibration.unseen else ())]
    columns: dict[str, list[int]] = {}
    held = {a.name for a in calibration.assumed if a.sigma > 0}
    for j, name in enumerate(names):
        base = name.split("[")[0]
        if base in held:
            columns.setdefault(base, []).append(j)
        elif j >= len(calibration.tangent):
            columns.setdefault(_group(name), []).append(j)
    total, measured, shares = shares_of(flat, scan.C, columns)
    return ScanBudget(
        total=total,
        measured=measured,
        shares=tuple(shares),
        two_angles=_with_two_angles(calibration, problem, linear, flat, total),
        tilted=calibration.arrangement != "turntable",
    )


def _group(name: str) -> str:
    """What directions that no ball shows are called together."""
    if name == TRANSLATIONS:
        return "the scale of the translations"
    return "the scale of the rotations" if name in ROTATIONS else "the table's wobble"


def _with_two_angles(
    calibration: Calibration, problem: Problem, linear: LinearFit, flat: Array, total: float
) -> float | None:
    """px: the same, had half of the poses been taken with the table at another angle; None where that is no remedy."""
    rigid = isinstance(calibration.errors, RigidErrors) and calibration.arrangement == "moving-object"
    if not rigid or np.ptp(problem.alpha) > 0 or len(problem.ball_ids) > 1 or len(problem.scanners) > 1:
        return None
    b = projection_blocks(
        calibration.scanner,
        T_HT=calibration.T_HT,
        T_MH=problem.T_MH,
        t=calibration.t,
        alpha=problem.alpha + np.pi / 2,
    )
    if not np.isfinite(b.x_D).all():
        return None
    scanner_part = [SCANNER_COLUMNS.index(n) if n in SCANNER_COLUMNS else -1 for n in calibration.tangent[9:]]
    if -1 in scanner_part:
        return None
    J = np.concatenate([b.J_mount, b.J_t, b.J_scanner[:, :, scanner_part]], axis=2)
    turned = (linear.W @ J).reshape(-1, J.shape[2])
    now = linear.J_white().reshape(-1, J.shape[2])
    N = (now.T @ now + turned.T @ turned) / 2 + linear.prior_rows.T @ linear.prior_rows
    m = len(calibration.tangent)
    C = inverse_information(N)
    return float(np.sqrt(max(np.einsum("kc,cd,kd->", flat[:, :m], C, flat[:, :m], optimize=True) / len(flat), 0.0)))
