"""What a multi-sphere calibration is: the pose of the standard in every view of a path, and the path's matrices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.identify import view_matrix
from tomopose.calibration.arrangements.multi_sphere.path import BallView, PathSolution
from tomopose.calibration.arrangements.multi_sphere.standard import SphereStandard
from tomopose.calibration.arrangements.multi_sphere.view_pose import view_rows
from tomopose.calibration.checks.verdict import Finding, Judged
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.uncertainty.propagation import field_of_view_points
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.real_poses import Repeatability
from tomopose.provenance import Provenance
from tomopose.units import Array
from tomopose.values import Column, Rows, value


@value
class MultiSphereCalibration(Judged, Rows):
    """One row a view whose pose was found.

    scanner:   with the values as estimated along the path; given: as they were before.
    standard:  as calibrated;  path: poses, coordinates as estimated, covariance.
    pose_id:   names of the views;  views: which balls were used where.
    home:      M -> W of the standard at home: matrices are of points of W, mm, with the object at home.
    alone:     (n, 6) by which each view's own pose, scanner and coordinates held at their given values, differs from
               the one along the path: rotation vector, rad, and translation of the standard's middle, mm.
    manipulator_errors: (n, 6) what the pose table says less what was found, or None where it does not say.
    lost:      view -> why it has no pose;  left_out: view -> balls that were not used, in words.
    repeatability: of the manipulator between this scan and another one on the same path; None: not stated.
    """

    scanner: Scanner
    given: Scanner
    standard: SphereStandard
    pose_id: tuple[str, ...]
    views: tuple[BallView, ...]
    path: PathSolution
    home: RigidTransform
    alone: Array
    manipulator_errors: Array | None = None
    assumed: tuple[Assumed, ...] = ()
    lost: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    checks: tuple[Finding, ...] = ()
    repeatability: Repeatability | None = None
    provenance: Provenance | None = None

    @property
    def d(self) -> Array:
        """(n,) px: rms distance of measured and calculated centres of each view.  As eq. (8), ball by ball."""
        return np.array([np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in self.path.residuals])

    @property
    def d_rms(self) -> float:
        """px, rms over all balls of all views.  As eq. (8)."""
        r = np.concatenate(self.path.residuals)
        return float(np.sqrt(np.mean(np.sum(r**2, axis=1))))

    @property
    def chi2_dof(self) -> float:
        return self.path.chi2 / self.path.dof if self.path.dof > 0 else float("nan")

    @property
    def balls_used(self) -> Array:
        """(n,) how many balls determine each view's pose."""
        return np.array([len(v.ball) for v in self.views])

    def columns(self) -> dict[str, Column]:
        sigma = np.sqrt(np.einsum("nii->ni", self.path.covariance))
        return {"balls": self.balls_used, "d_px": self.d, "sigma_turn_rad": sigma[:, :3].max(axis=1),
                "sigma_shift_mm": sigma[:, 3:].max(axis=1)}  # fmt: skip

    def select(self, index: object) -> MultiSphereCalibration:
        raise InputError("views of a path share what was estimated from all of them; calibrate from those you want")

    def matrices(self, *, points: Array | None = None, binning: int = 1) -> ProjectionMatrices:
        """Points of W, mm, with the object at home, to pixels, in every view that has a pose.

        points: (k, 3) of W where `points_sigma` is predicted; by default the volume that the field of view covers.
        `points_sigma_shared` comes from the scanner's values and the standard's coordinates, `points_sigma` also from
        the view's own centres and, where it is stated, the manipulator's repeatability.  Both are what a volume sees:
        a rigid pose of the object is taken out.
        """
        own = self.scanner
        to_M = self.home.inv
        x_M = to_M.apply(field_of_view_points(own) if points is None else np.asarray(points, dtype=np.float64))
        sigma, shared = self._sigma(x_M)
        matrices = ProjectionMatrices(
            P=np.array([view_matrix(own, T) @ to_M.matrix for T in self.path.T_MW]),
            n_u=own.n_u, n_v=own.n_v, p_u=own.p_u, p_v=own.p_v, pose_id=self.pose_id,
            points_sigma=sigma, points_sigma_shared=shared, scanner=own,
            in_front=self.home.apply(self.standard.centres.mean(axis=0)),
        )  # fmt: skip
        return matrices if binning == 1 else matrices.binned(binning)

    def _sigma(self, x_M: Array) -> tuple[Array, Array]:
        """(n, k) px of points x_M (k, 3): in the single view, and the part that all views share."""
        names, m = self.path.shared.scanner_names, len(self.standard)
        J, own, turn = [], [], []
        scatter = np.zeros(6) if self.repeatability is None else self.repeatability.variance
        for T, C, gain in zip(self.path.T_MW, self.path.covariance, self.path.gain, strict=True):
            _, J_pose, J_x, J_s = view_rows(self.scanner, T, x_M, names)
            by_shared = J_pose @ gain
            by_shared[:, :, 3 * m :] += J_s
            J.append(by_shared)
            own.append(np.einsum("kia,ab,kib->ki", J_pose, C, J_pose) + (J_pose**2) @ scatter)
            turn.append(np.concatenate([-J_x @ skew(x_M - x_M.mean(axis=0)), J_x], axis=2))
        flat, moves = np.stack(J), np.stack(turn).reshape(-1, 6)
        Q, _ = np.linalg.qr(moves / np.linalg.norm(moves, axis=0))
        columns = flat.reshape(-1, flat.shape[-1])
        columns = columns - Q @ (Q.T @ columns)
        shared = np.einsum("ra,ab,rb->r", columns, self.path.shared.covariance, columns).reshape(flat.shape[:3])
        shared_px = np.sqrt(np.maximum(shared.mean(axis=2), 0.0))
        return np.sqrt(shared_px**2 + np.stack(own).mean(axis=2)), shared_px
