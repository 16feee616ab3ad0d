"""Which model of the manipulator to believe: evidence, and what held-out poses say.

Two judges must agree before a model replaces a simpler one: the (Laplace) evidence, which charges every parameter for
the room it takes, and blocked cross-validation, which leaves out runs of neighbouring poses and predicts them.  So
`auto` never takes a model that predicts worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

BLOCKS = 7
EVIDENCE_GAIN = 3.0
"""Natural log units that a richer model must gain."""
AXIS_SHARE = 0.9
"""A pose counts as turned about one axis when that axis carries this share of its rotation."""
SMALLEST_TURN = 1e-3


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """How one model did.

    log_evidence: at its optimum.  log_predictive: of the held-out centres.  cv_rms: rms distance, px, of the held-out
    centres from their predictions.  cv_chi2: mean square of the held-out misses in predicted standard deviations,
    1 where the model holds all there is.  d_rms: of the fit itself, px.
    """

    model: str
    log_evidence: float
    log_predictive: float
    cv_rms: float
    cv_chi2: float
    d_rms: float
    chi2_dof: float
    scatter: float
    size: float

    def to_json(self) -> dict[str, Any]:
        return {
            "model": self.model,
            "log_evidence": self.log_evidence,
            "log_predictive": self.log_predictive,
            "cv_rms_px": self.cv_rms,
            "cv_chi2": self.cv_chi2,
            "d_rms_px": self.d_rms,
            "chi2_dof": self.chi2_dof,
            "scatter": self.scatter,
            "size": self.size,
        }


def blocks_of(n: int, ball: Any, blocks: int = BLOCKS) -> list[Any]:
    """Index arrays of at most `blocks` runs of neighbouring poses, such that every ball keeps rows outside each."""
    parts = np.array_split(np.arange(n), min(blocks, n))
    whole = len(np.unique(ball))
    return [part for part in parts if len(np.unique(np.delete(ball, part))) == whole]


def judge(name: str, fit: ModelFit) -> Judgement:
    r"""Cross-validate a fitted model on the rows that it used.

    Without block b the optimum moves to theta - S_b A_b^T r_b, S_b = (Sigma^-1 - A_b^T A_b)^-1, with A_b and r_b the
    whitened rows of the block: exact where the prediction is linear over that move, which is small beside the poses'
    travel.  The held-out rows are then missed by (1 + A_b S_b A_b^T) r_b, whose covariance is the bracket itself.
    """
    estimate = fit.estimate
    n = len(estimate.problem.poses)
    W = whiteners(estimate.at.C)
    r = (W @ estimate.at.r[:, :, None])[..., 0]
    A = W @ estimate.at.J
    information = np.linalg.inv(estimate.covariance)
    log_predictive, squares, chi2, count = float(np.sum(np.log(np.einsum("nii->ni", W)))), 0.0, 0.0, 0
    for block in blocks_of(n, estimate.problem.data.ball):
        A_b, r_b = A[block].reshape(2 * len(block), -1), r[block].ravel()
        S_b = np.linalg.pinv(information - A_b.T @ A_b, hermitian=True, rcond=1e-14)
        V = np.eye(len(r_b)) + A_b @ S_b @ A_b.T
        missed = V @ r_b
        log_predictive -= 0.5 * float(r_b @ missed + np.linalg.slogdet(V)[1])
        chi2 += float(r_b @ missed)
        d = np.linalg.solve(W[block], missed.reshape(-1, 2, 1))
        squares += float(np.sum(d**2))
        count += len(block)
    return Judgement(
        model=name,
        log_evidence=estimate.log_evidence,
        log_predictive=log_predictive,
        cv_rms=float(np.sqrt(squares / max(count, 1))),
        cv_chi2=chi2 / max(2 * count, 1),
        d_rms=float(np.sqrt(np.mean(np.sum(estimate.at.r**2, axis=1)))),
        chi2_dof=estimate.chi2 / max(estimate.dof, 1),
        scatter=fit.scatter,
        size=fit.size,
    )


def better(rich: Judgement, simple: Judgement) -> bool:
    """Whether the richer model is to replace the simpler one: more evidence, and held-out poses predicted better."""
    return (
        rich.log_evidence > simple.log_evidence + EVIDENCE_GAIN
        and rich.log_predictive > simple.log_predictive
        and rich.cv_rms <= simple.cv_rms
    )


def by_rotation(poses: PoseSequence, residuals: Mapping[str, Array], scanner: Scanner) -> list[dict[str, Any]]:
    """Residuals of each model by the axis about which a pose is turned: fig. 8 (b) before and after.

    residuals: model -> (n, 2) px, rows as in `poses`.  Rows: none, +x, -x, +y, -y, +z, -z, mixed, with n and, for
    each model, the rms distance in px and in um at the object.
    """
    w = log_rotation(poses.T_MH.R)
    angle = np.linalg.norm(w, axis=1)
    axis = np.argmax(np.abs(w), axis=1)
    main = np.take_along_axis(w, axis[:, None], axis=1)[:, 0]
    label = np.where(main > 0, "+", "-").astype("<U5")
    label = np.char.add(label, np.array(["x", "y", "z"])[axis])
    label = np.where(np.abs(main) < AXIS_SHARE * angle, "mixed", label)
    label = np.where(angle < SMALLEST_TURN, "none", label)
    um = float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification * 1000.0
    rows = []
    for name in ("none", "+x", "-x", "+y", "-y", "+z", "-z", "mixed"):
        mine = label == name
        if not mine.any():
            continue
        row: dict[str, Any] = {"rotation": name, "n": int(mine.sum())}
        for model, r in residuals.items():
            rms = float(np.sqrt(np.mean(np.sum(r[mine] ** 2, axis=1))))
            row |= {f"{model}_px": rms, f"{model}_um": rms * um}
        rows.append(row)
    return rows
