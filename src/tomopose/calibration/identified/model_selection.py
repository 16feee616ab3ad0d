"""Which model of the manipulator to believe: evidence, and what held-out poses say.

Two tests must agree before a model replaces a simpler one: the (Laplace) evidence, which charges every parameter for
the room it takes, and blocked cross-validation, which leaves out runs of neighbouring poses and predicts them.  So
`auto` never takes a model that predicts worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tomopose.calibration.checks.cross_validation import held_out
from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import linear_fit
from tomopose.calibration.result import ModelJudgement, RotationResiduals
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array


class SelectionSettings(NamedTuple):
    """Thresholds of the choice between models, and of the table of residuals by rotation."""

    evidence_gain: float = 3.0
    """Natural log units of evidence that a richer model must gain: a Bayes factor of 20, where Kass and Raftery (J. Am.
    Stat. Assoc. 90, 1995, 773) begin to call evidence strong.  Held-out poses must be predicted better as well."""
    axis_share: float = 0.9
    """A pose counts as turned about one axis when that axis carries this share of its rotation: within 26 degrees."""
    smallest_turn: float = 1e-3
    """Rotation, rad, below which a pose counts as not turned: plans turn by degrees, controllers hold 0.1 mrad."""


SELECTION = SelectionSettings()


def judged(name: str, fit: ModelFit) -> ModelJudgement:
    """How a fitted model did, with cross-validation on the rows that it used."""
    estimate = fit.estimate
    left_out = held_out(linear_fit(estimate))
    return ModelJudgement(
        model=name,
        log_evidence=estimate.log_evidence,
        log_predictive=left_out.log_predictive,
        cv_rms=left_out.rms,
        cv_chi2=left_out.chi2,
        d_rms=float(np.sqrt(np.mean(np.sum(estimate.at.r**2, axis=1)))),
        chi2_dof=estimate.chi2 / max(estimate.dof, 1),
        scatter=fit.scatter,
        size=fit.size,
    )


def better(rich: ModelJudgement, simple: ModelJudgement) -> bool:
    """Whether the richer model is to replace the simpler one: more evidence, and held-out poses predicted better."""
    return (
        rich.log_evidence > simple.log_evidence + SELECTION.evidence_gain
        and rich.log_predictive > simple.log_predictive
        and rich.cv_rms <= simple.cv_rms
    )


def by_rotation(poses: PoseSequence, residuals: Mapping[str, Array], scanner: Scanner) -> tuple[RotationResiduals, ...]:
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
    label = np.where(np.abs(main) < SELECTION.axis_share * angle, "mixed", label)
    label = np.where(angle < SELECTION.smallest_turn, "none", label)
    um = float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification * 1000.0
    rows = []
    for name in ("none", "+x", "-x", "+y", "-y", "+z", "-z", "mixed"):
        mine = label == name
        if not mine.any():
            continue
        px = {model: float(np.sqrt(np.mean(np.sum(r[mine] ** 2, axis=1)))) for model, r in residuals.items()}
        in_um = {model: rms * um for model, rms in px.items()}
        rows.append(RotationResiduals(rotation=name, n=int(mine.sum()), px=px, um=in_um))
    return tuple(rows)
