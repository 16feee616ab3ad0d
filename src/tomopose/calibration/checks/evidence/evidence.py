"""What the rules of the verdict look at, whatever the model and the arrangement."""

from __future__ import annotations

from dataclasses import dataclass

from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests
from tomopose.calibration.checks.stability import Stability
from tomopose.calibration.model.budget import Halves
from tomopose.calibration.rigid.contradiction import Contradicted

MISFIT_CHI2 = 4.0
"""chi2/dof of residuals twice as large as stated."""
RAISED_SCATTER = 1.5
"""Factor on the variance of the stated repeatability above which a machine counts as one with play."""


@dataclass(frozen=True, kw_only=True)
class ScatterFound:
    """ratio: variance of the poses' scatter over that of the stated repeatability, t_mm and w_rad."""

    ratio: float
    t_mm: float
    w_rad: float


@dataclass(frozen=True, kw_only=True)
class AgainstRigid:
    """Held-out poses, px rms, under the model that was chosen and under that which trusts the poses; better: whether
    evidence and held-out poses both speak for the chosen one."""

    chosen_px: float
    rigid_px: float
    better: bool


@dataclass(frozen=True, kw_only=True)
class BallSize:
    """ratio: measured size of the ball's silhouettes over the calculated one;  diameter: mm, as it was given;
    unit: (name, symbol, millimetres) of the unit of the positions under which they agree, where that is another one."""

    ratio: float
    diameter: float
    unit: tuple[str, str, float] | None = None

    @property
    def words(self) -> str:
        return (
            f"the ball's silhouettes are {100 * abs(self.ratio - 1.0):.1f} % "
            f"{'larger' if self.ratio > 1 else 'smaller'} than a ball of {self.diameter:g} mm would throw from where "
            "the calibration places it; the diameter (--ball-diameter-mm), the scale of the poses' translations or a "
            "value in scanner.json is wrong"
        )


@dataclass(frozen=True, kw_only=True)
class Undistinguished:
    """A reading that the poses cannot distinguish.  name, words, remedy: of the alternative;  px: rms of a coordinate
    by which a scan would be off, were it right."""

    name: str
    words: str
    remedy: str
    px: float


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the rules look at.  None: does not apply to this model or arrangement, or was not looked at.

    finite:       chi2, the residuals and the covariance are finite numbers.
    misfit:       more rows fail than may be outliers, and none was set aside.
    outliers:     pose ids set aside.
    chi2_dof:     by the sigmas that were stated; chi2, dof: as the covariance rests on.
    widened:      whether the covariance grows with chi2/dof.
    residual_px, expected_px: d_rms, and what the stated sigmas explain of it;  spread_px: rms spread of the centres.
    scan_px:      predicted standard uncertainty of a scan tilted by 5 degrees, px, were everything assumed exact.
    stated_px:    the same with everything assumed;  stated_words: the sentence that names its parts.
    diagnosis:    alternative conventions, fitted by the model that trusts the poses.
    size:         identified errors over what the machine's file states.
    run_effects:  drift and lag of the run are among the parameters.
    prior_pulls:  (name, deviation from its stated value in prior standard deviations) of each freed parameter.
    tests:        one effect after the other, beside everything that was assumed; in place of stability's effects.
    contradicted: scanner values that were freed because the images contradict what was assumed of them.
    undistinguished: readings of the orientation columns that these poses cannot distinguish from the declared one.
    halves:       how calibrations from two halves of the poses differ.
    open_turns:   the sentence on turns of the plate that no data determine; "" where they are determined.
    """

    model: str
    arrangement: str
    converged: bool
    finite: bool
    dof: int
    n_used: int
    outliers: tuple[str, ...]
    misfit: bool
    chi2: float
    chi2_dof: float
    widened: bool
    residual_px: float
    expected_px: float
    spread_px: float
    scan_px: float | None = None
    stated_px: float | None = None
    stated_words: str = ""
    diagnosis: Diagnosis | None = None
    stability: Stability | None = None
    scatter: ScatterFound | None = None
    against_rigid: AgainstRigid | None = None
    size: float | None = None
    run_effects: bool = False
    open_turns: str = ""
    ball_size: BallSize | None = None
    prior_pulls: tuple[tuple[str, float], ...] = ()
    tests: ScannerTests | None = None
    contradicted: tuple[Contradicted, ...] = ()
    undistinguished: tuple[Undistinguished, ...] = ()
    halves: Halves | None = None

    @property
    def n(self) -> int:
        return self.n_used + len(self.outliers)

    @property
    def coloured(self) -> bool:
        """Residuals that come from the poses are not white: there, chance alone explains what looks significant."""
        scattered = self.scatter is not None and self.scatter.ratio > RAISED_SCATTER
        return self.chi2_dof > MISFIT_CHI2 or scattered or self.run_effects
