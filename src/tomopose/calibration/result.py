"""What a calibration is: one immutable value, whatever the model and the arrangement, with its findings and verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Literal, TypeAlias, get_args

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import Hypothesis
from tomopose.calibration.checks.score_tests.ranking import Explanation
from tomopose.calibration.checks.stability import Stability
from tomopose.calibration.checks.verdict import Finding, Judged
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.model.budget import Halves, ScanBudget
from tomopose.calibration.model.unseen import Unseen
from tomopose.calibration.rigid.contradiction import Contradicted
from tomopose.calibration.rigid.observability import Observability
from tomopose.errors import ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import Errors, RigidErrors
from tomopose.provenance import Provenance
from tomopose.units import Array, float_array, value_with_uncertainty
from tomopose.values import value, verdict_html

Arrangement: TypeAlias = Literal["moving-object", "moving-scanner", "twin", "turntable"]
ARRANGEMENTS: tuple[Arrangement, ...] = get_args(Arrangement)
SCANNER_MOVES: tuple[Arrangement, ...] = ("moving-scanner", "twin")


@value
class Parameter:
    """One estimated number: value, standard uncertainty u (nan: not determinable), unit; `free` or held."""

    name: str
    value: float
    u: float
    unit: str


@value
class PoseNoiseFound:
    """Scatter of the poses beside detection noise, a coordinate each: translation mm, rotation rad; gain: how much
    -2 log L falls by it; chi2/dof with it and without; found: the residuals show it, else they leave room for it."""

    translation_mm: float
    rotation_rad: float
    gain: float
    chi2_dof_with: float
    chi2_dof_without: float
    found: bool = True


@value
class ModelJudgement:
    """How one model of the manipulator did.

    log_evidence: at its optimum.  log_predictive: of the held-out centres.  cv_rms: px, rms distance of the held-out
    centres from their predictions.  cv_chi2: mean square of the held-out misses in predicted standard deviations,
    1 where the model holds all there is.  d_rms: of the fit itself, px.  scatter: factor on the variance of the
    stated repeatability.  size: factor on the stated sizes of the errors.
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


@value
class RotationResiduals:
    """Residuals of n poses turned about one axis: model -> rms distance in px, and in um at the object."""

    rotation: str
    n: int
    px: Mapping[str, float]
    um: Mapping[str, float]


@value
class ModelComparison:
    """The models side by side, and the residuals of the first and the chosen one by axis of rotation."""

    models: tuple[ModelJudgement, ...]
    chosen: str
    by_rotation: tuple[RotationResiduals, ...] = ()


@value
class ViewDistances:
    """d_SD of every view, (n,) mm, with its standard uncertainty u (n,), where it scatters by `sigma` mm a view."""

    sigma: float
    pose_id: tuple[str, ...]
    d_SD: Array
    u: Array


@value
class Calibration(Judged):
    """How the manipulator sits in the scanner.  Eq. (7) solved.

    scanner:      with the values of this calibration (freed parameters replaced by their estimates).
    T_HT:         manipulator base -> table.
    balls:        ball_id -> ball centre in M, mm, (3,).
    tangent:      names of the coordinates of `covariance`, in order: w_HT_x, w_HT_y, w_HT_z (rad; the rotation vector
                  that multiplies R_HT from the left: R_true = exp(w) R_HT), t_HT_x ... (mm), t_x ... per ball (mm; with
                  several balls t[ID]_x), then freed scanner and manipulator parameters by name.
    covariance:   (m, m), in the units of `tangent`.
    pose_id, x_D, residuals:  of the poses used: names, observed centres (n, 2), observed minus calculated (n, 2), px.
    outliers:     pose ids set aside, with the reason;  not_seen: pose ids without a measured ball, with the reason.
    chi2, dof:    of the weighted fit; dof = equations - parameters (+ priors).
    model:        rigid | kinematic | slack.   arrangement: what moves.
    errors:       the manipulator's: RigidErrors, IdentifiedErrors, EmpiricalErrors or TwinErrors.
    priors:       freed parameter -> prior standard deviation; inf where it had none.
    assumed:      what was taken with a standard uncertainty rather than measured.
    unseen:       errors of table and manipulator that no ball shows, with their priors; None: none apply.
    explanations: what explains best why the values as declared do not fit, and what is left, likeliest first.
    contradicted: values that were freed because the images contradict the sigma that was stated or assumed.
    budget:       what the uncertainty of a scan is made of.
    halves:       how calibrations from two halves of the poses differ over the field of view.
    status:       a sentence; converged: whether an optimum was reached.
    checks:       the findings; `verdict` and `reasons` follow from them and from nothing else.
    hypotheses:   alternative conventions tried, ranked.
    stability, comparison, pose_noise, views: what else was found, None where it was not looked for.
    widening:     factor on the covariance by the rule of `covariance.widening`.
    expected_residual: px, the d_rms that the covariances in use explain; NaN where not calculated.
    magnification_at_ball: mean over the poses of d_SD over the ball's distance from the source; None: not known.
    runs:         the scanner of each run where several were solved together.
    """

    scanner: Scanner
    T_HT: RigidTransform
    balls: Mapping[int, Array]
    tangent: tuple[str, ...]
    covariance: Array
    pose_id: tuple[str, ...]
    x_D: Array
    residuals: Array
    chi2: float
    dof: int
    parameters: tuple[Parameter, ...]
    observability: Observability
    outliers: Mapping[str, str] = field(default_factory=dict)
    not_seen: Mapping[str, str] = field(default_factory=dict)
    model: str = "rigid"
    arrangement: Arrangement = "moving-object"
    errors: Errors = field(default_factory=RigidErrors)
    priors: Mapping[str, float] = field(default_factory=dict)
    assumed: tuple[Assumed, ...] = ()
    unseen: Unseen | None = None
    explanations: tuple[Explanation, ...] = ()
    contradicted: tuple[Contradicted, ...] = ()
    budget: ScanBudget | None = None
    halves: Halves | None = None
    converged: bool = True
    status: str = ""
    checks: tuple[Finding, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    stability: Stability | None = None
    comparison: ModelComparison | None = None
    pose_noise: PoseNoiseFound | None = None
    views: ViewDistances | None = None
    widening: float = 1.0
    expected_residual: float = float("nan")
    magnification_at_ball: float | None = None
    runs: tuple[Scanner, ...] = ()
    pivot: Array | None = None
    convention: str = "pi-hexapod"
    provenance: Provenance | None = None

    def __post_init__(self) -> None:
        self.T_HT.require(Frame.H, Frame.T)
        m = len(self.tangent)
        if np.shape(self.covariance) != (m, m):
            raise ShapeError(f"covariance is {np.shape(self.covariance)} but {m} coordinates are named")
        if self.arrangement not in ARRANGEMENTS:
            raise ShapeError(f"arrangement {self.arrangement!r} is not one of {', '.join(ARRANGEMENTS)}")
        object.__setattr__(self, "balls", {int(k): float_array(v) for k, v in self.balls.items()})
        for name in ("covariance", "x_D", "residuals"):
            object.__setattr__(self, name, float_array(getattr(self, name)))
        if self.pivot is not None:
            object.__setattr__(self, "pivot", float_array(self.pivot))

    def _repr_html_(self) -> str:
        """The verdict with its reasons, and the parameters with U, for notebooks."""
        fit = f"d_rms {self.d_rms:.3g} px, {self.d_rms_um:.3g} um at the ball" if self.pose_id else "no residuals"
        lines = [*self.reasons, f"{self.status or 'no status'}; {fit}; {len(self.outliers)} centres set aside"]
        rows = [
            [p.name, value_with_uncertainty(p.value, p.u, p.unit), f"{2 * p.u:.2g} {p.unit}"] for p in self.parameters
        ]
        return verdict_html(self.verdict, lines, ["parameter", "value", "U (k = 2)"], rows)

    @property
    def inverse(self) -> bool:
        """Whether source and detector move, so that pose tables enter inverted."""
        return self.arrangement in SCANNER_MOVES

    @property
    def t(self) -> Array:
        """Ball centre in M, mm, (3,); of the ball with the lowest id where there are several."""
        return self.balls[min(self.balls)]

    @property
    def d(self) -> Array:
        """d_k (n,), px: distance between detected and calculated centre.  Eq. (8)."""
        result: Array = np.linalg.norm(self.residuals, axis=1)
        return result

    @property
    def d_rms(self) -> float:
        """Reprojection error, px: the sum over poses divided by n poses, not 2n.  Eq. (8)."""
        return float(np.sqrt(np.mean(self.d**2)))

    @property
    def d_rms_um(self) -> float:
        """d_rms at the ball, um: pixels times the mean pitch over the magnification there."""
        pitch = np.sqrt(self.scanner.p_u * self.scanner.p_v)
        at_ball = self.scanner.magnification if self.magnification_at_ball is None else self.magnification_at_ball
        return float(self.d_rms * pitch / at_ball * 1000.0)

    @property
    def chi2_dof(self) -> float:
        return float(self.chi2 / self.dof) if self.dof > 0 else float("nan")
