"""What a calibration is: one immutable value with a status in a human sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomopose.errors import ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.provenance import Provenance
from tomopose.units import Array, float_array

VERDICTS = ("trustworthy", "doubtful", "rejected")


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One estimated number: value, standard uncertainty u (nan: not determinable), unit; `free` or held."""

    name: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class Observability:
    """What the poses can tell.  singular_values of the scaled Jacobian, largest first; unobservable: directions, in
    words; notes: what would cure them."""

    singular_values: Array
    unobservable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def condition(self) -> float:
        s = np.asarray(self.singular_values)
        return float(s[0] / s[-1]) if s.size and s[-1] > 0 else float("inf")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """How the manipulator sits in the scanner.  Eq. (7) solved.

    scanner:      with the values of this calibration (freed parameters replaced by their estimates).
    T_HT:         manipulator base -> table.
    balls:        ball_id -> ball centre in M, mm, (3,).
    tangent:      names of the coordinates of `covariance`, in order: w_HT_x, w_HT_y, w_HT_z (rad; the rotation vector
                  that multiplies R_HT from the left: R_true = exp(w) R_HT), t_HT_x ... (mm), t_x ... per ball (mm; with
                  several balls t[ID]_x), then freed scanner and manipulator parameters by name.
    covariance:   (m, m), in the units of `tangent`.
    pose_id, x_D, residuals:  of the poses used: names, observed centres (n, 2), observed minus calculated (n, 2), px.
    outliers:     pose ids set aside, with the reason.
    chi2, dof:    of the weighted fit; dof = equations - parameters (+ priors).
    model:        rigid | kinematic | slack.
    manipulator:  identified errors as named numbers, or empty.
    status:       a sentence; converged: whether an optimum was reached.
    verdict, reasons: trustworthy | doubtful | rejected, and why.
    hypotheses:   rival conventions tried, ranked (dicts ready for JSON).
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
    model: str = "rigid"
    manipulator: Mapping[str, Any] = field(default_factory=dict)
    converged: bool = True
    status: str = ""
    verdict: str = "trustworthy"
    reasons: tuple[str, ...] = ()
    hypotheses: tuple[Mapping[str, Any], ...] = ()
    pivot: Array | None = None
    convention: str = "pi-hexapod"
    extra: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance | None = None

    def __post_init__(self) -> None:
        self.T_HT.require(Frame.H, Frame.T)
        m = len(self.tangent)
        if np.shape(self.covariance) != (m, m):
            raise ShapeError(f"covariance is {np.shape(self.covariance)} but {m} coordinates are named")
        if self.verdict not in VERDICTS:
            raise ShapeError(f"verdict {self.verdict!r} is none of {', '.join(VERDICTS)}")
        object.__setattr__(self, "balls", {int(k): float_array(v) for k, v in self.balls.items()})
        for name in ("covariance", "x_D", "residuals"):
            object.__setattr__(self, name, float_array(getattr(self, name)))
        if self.pivot is not None:
            object.__setattr__(self, "pivot", float_array(self.pivot))

    @property
    def t(self) -> Array:
        """Ball centre in M, mm, (3,); of the ball with the lowest id where there are several."""
        return self.balls[min(self.balls)]

    @property
    def d(self) -> Array:
        """d_k (n,), px: distance between detected and calculated centre.  Eq. (8)."""
        return np.linalg.norm(self.residuals, axis=1)

    @property
    def d_rms(self) -> float:
        """Reprojection error, px: the sum over poses divided by n poses, not 2n.  Eq. (8)."""
        return float(np.sqrt(np.mean(self.d**2)))

    @property
    def d_rms_um(self) -> float:
        """d_rms at the object, um: pixels times the mean pitch over the magnification."""
        pitch = np.sqrt(self.scanner.p_u * self.scanner.p_v)
        return float(self.d_rms * pitch / self.scanner.magnification * 1000.0)

    @property
    def chi2_dof(self) -> float:
        return float(self.chi2 / self.dof) if self.dof > 0 else float("nan")
