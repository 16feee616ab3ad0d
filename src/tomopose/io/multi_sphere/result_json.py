"""multi-sphere.json and balls.csv: a multi-sphere calibration as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.result import MultiSphereCalibration
from tomopose.files import require_absent, write_json
from tomopose.io.calibration.checks_blocks import finding_document
from tomopose.io.scanner_json import scanner_document
from tomopose.observations import BallObservations
from tomopose.values import require_types

SCHEMA_NAME = "multi-sphere"


@require_types
def write_multi_sphere(path: str | Path, result: MultiSphereCalibration, *, force: bool = False) -> None:
    """Write multi-sphere.json.  FileError if the file exists and `force` is not given."""
    path = require_absent(path, force=force)
    standard, solved = result.standard, result.path
    sigma = np.sqrt(np.einsum("nii->ni", solved.covariance))
    shared = np.sqrt(np.diag(solved.shared.covariance))
    m = len(standard)
    wrong = result.manipulator_errors
    write_json(path, SCHEMA_NAME, {
        "verdict": result.verdict, "reasons": list(result.reasons),
        "findings": [finding_document(f) for f in result.checks],
        "d_rms_px": result.d_rms, "chi2": solved.chi2, "dof": solved.dof, "chi2_dof": result.chi2_dof,
        "home": result.home.matrix,
        "views": [
            {
                "pose_id": name, "T_MW": T.matrix, "sigma_turn_rad": sigma[k, :3], "sigma_shift_mm": sigma[k, 3:],
                "covariance": solved.covariance[k], "d_px": result.d[k],
                "balls": [standard.names[b] for b in result.views[k].ball],
                "left_out": list(result.left_out.get(name, ())),
                "alone_turn_rad": result.alone[k, :3], "alone_shift_mm": result.alone[k, 3:],
                "manipulator_turn_rad": None if wrong is None else wrong[k, :3],
                "manipulator_shift_mm": None if wrong is None else wrong[k, 3:],
            }
            for k, (name, T) in enumerate(zip(result.pose_id, solved.T_MW, strict=True))
        ],
        "lost": dict(result.lost),
        "standard": [
            {"ball": name, "calibrated_mm": standard.centres[i], "estimated_mm": solved.centres[i],
             "diameter_mm": standard.diameters[i], "prior_sigma_mm": standard.sigma_mm[i],
             "sigma_mm": shared[3 * i : 3 * i + 3]} for i, name in enumerate(standard.names)
        ],
        "standard_sigma_from": "default" if standard.sigma is None else "standard.csv",
        "scanner_estimated": {
            name: {"value": getattr(result.scanner, name), "given": getattr(result.given, name),
                   "sigma": shared[3 * m + q]} for q, name in enumerate(solved.shared.scanner_names)
        },
        "assumed": [{"name": a.name, "sigma": a.sigma, "unit": a.unit, "from": a.source} for a in result.assumed],
        "repeatability": None if result.repeatability is None
        else {"t_mm": result.repeatability.t_mm, "w_rad": result.repeatability.w_rad},
        "scanner": scanner_document(result.scanner),
        "provenance": None if result.provenance is None else result.provenance.to_json(),
    })  # fmt: skip


def used_centres(result: MultiSphereCalibration) -> BallObservations:
    """The centres that were used, a row each, named VIEW/BALL, for observations.csv."""
    return BallObservations(
        x_D=np.concatenate([v.x_D for v in result.views]),
        covariance=np.concatenate([v.covariance for v in result.views]),
        pose_id=tuple(
            f"{name}/{result.standard.names[b]}"
            for name, v in zip(result.pose_id, result.views, strict=True)
            for b in v.ball
        ),
    )
