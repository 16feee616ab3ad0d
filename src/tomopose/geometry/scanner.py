"""The scanner as it is known before a calibration: eqs. (2) and (4), the table, magnification, binning."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array
from tomopose.values import value

R_WS = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Rotation part of eq. (4)."""
R_WS.setflags(write=False)

LARGEST_TILT = math.radians(45.0)

PARAMETER_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "d_SD": "mm",
        "d_SR": "mm",
        "p_u": "mm",
        "p_v": "mm",
        "u_0": "px",
        "v_0": "px",
        "eta": "rad",
        "theta": "rad",
        "phi": "rad",
        "axis_y": "mm",
        "axis_tilt_x": "rad",
        "axis_tilt_y": "rad",
    }
)
"""Every continuous parameter of a scanner and its unit; in files the name is `NAME_UNIT`."""


def intrinsic_matrices(d_SD: Array, p_u: Array, p_v: Array, u_0: Array, v_0: Array, panel: Array) -> Array:
    """Matrices (a, 3, 3) of eq. (2), the last row of length 1, from numbers (a,) and rotations `panel` (a, 3, 3) in S.

    The inverse of the columns is (U, V, O): a point O + u U + v V of the panel has the homogeneous pixel (u, v, 1).
    """
    # the axes of the panel are the columns r of R: along the third, y_3 = r_3 . x_S is 1 in every pixel
    r_1, r_2, r_3 = (panel[:, :, k] for k in range(3))
    in_u, in_v = d_SD / p_u, d_SD / p_v
    K = np.empty((len(panel), 3, 3))
    K[:, 0] = (u_0 + in_u * panel[:, 2, 0])[:, None] * r_3 - (in_u * panel[:, 2, 2])[:, None] * r_1
    K[:, 1] = (v_0 - in_v * panel[:, 2, 1])[:, None] * r_3 + (in_v * panel[:, 2, 2])[:, None] * r_2
    K[:, 2] = r_3
    return K


@value
class Scanner:
    """Intrinsic geometry of a cone-beam scanner.

    d_SD, d_SR:  source to detector, source to rotation axis, mm.
    p_u, p_v:    pixel pitch, mm.
    u_0, v_0:    where the central ray meets the detector, px in D.
    n_u, n_v:    detector size, px.
    eta:         roll of the detector about the beam (about z_S), rad.
    theta, phi:  tilts of the detector about its u line (x_S) and its v line (y_S), rad.  The panel turns about the
                 point (u_0, v_0) by R_x(theta) R_y(phi) R_z(eta), written in S; without tilts (u_0, v_0) is the
                 piercing point of the paper.
    axis_y, axis_tilt_x, axis_tilt_y:  where the real table axis passes the W origin (mm along y_W) and its
                 direction R_x(axis_tilt_x) R_y(axis_tilt_y) e_z, rad; the paper takes all three as 0.
    sigma:       prior standard deviations by parameter name, in the parameter's own unit; 0: the value is exact.
                 A name that is missing is not exact: a calibration assumes a documented default for it.
    image_rows:  row order of image *files*: with "top-first", file row r is v = n_v - 1 - r.
    certificate: where the numbers come from.
    """

    d_SD: float
    d_SR: float
    p_u: float
    p_v: float
    u_0: float
    v_0: float
    n_u: int
    n_v: int
    eta: float = 0.0
    theta: float = 0.0
    phi: float = 0.0
    axis_y: float = 0.0
    axis_tilt_x: float = 0.0
    axis_tilt_y: float = 0.0
    sigma: Mapping[str, float] = field(default_factory=dict)
    image_rows: Literal["top-first", "bottom-first"] = "top-first"
    certificate: str = ""

    def __post_init__(self) -> None:
        for name in PARAMETER_UNITS:
            value = float(getattr(self, name))
            if not math.isfinite(value):
                raise InputError(f"scanner: {name} is {value}, not a finite number")
            object.__setattr__(self, name, value)
        for name in ("d_SD", "d_SR", "p_u", "p_v"):
            if getattr(self, name) <= 0:
                raise InputError(f"scanner: {name} is {getattr(self, name):g} {PARAMETER_UNITS[name]}; must be above 0")
        if self.d_SR >= self.d_SD:
            raise InputError(
                f"scanner: d_SR is {self.d_SR:g} mm, not smaller than d_SD = {self.d_SD:g} mm: the rotation axis would "
                "lie behind the detector; were the two exchanged?"
            )
        for name in ("n_u", "n_v"):
            value = getattr(self, name)
            if int(value) != value or value < 1:
                raise InputError(f"scanner: {name} is {value!r}; a positive whole number of pixels is needed")
            object.__setattr__(self, name, int(value))
        for name in ("theta", "phi", "axis_tilt_x", "axis_tilt_y"):
            if abs(getattr(self, name)) > LARGEST_TILT:
                raise InputError(f"scanner: {name} is {getattr(self, name):g} rad; is it given in degrees?")
        if self.image_rows not in ("top-first", "bottom-first"):
            raise InputError(f"scanner: image_rows is {self.image_rows!r}; 'top-first' or 'bottom-first' is needed")
        for name, value in self.sigma.items():
            if name not in PARAMETER_UNITS:
                raise InputError(f"scanner: sigma names {name!r}; known are {', '.join(PARAMETER_UNITS)}")
            if not (math.isfinite(value) and value >= 0):
                raise InputError(
                    f"scanner: sigma of {name} is {value}; a positive number is needed, or 0 for a value that is exact"
                )
        object.__setattr__(self, "sigma", MappingProxyType(dict(self.sigma)))

    def __reduce__(self) -> tuple[object, tuple[dict[str, object]]]:
        # A mapping proxy cannot be pickled, and worker processes receive scanners.
        values = {**self.__dict__, "sigma": dict(self.sigma)}
        return _scanner_from_dict, (values,)

    def exact(self) -> Scanner:
        """The same scanner with sigma 0 for every parameter that has none: known without error."""
        return replace(self, sigma={**dict.fromkeys(PARAMETER_UNITS, 0.0), **self.sigma})

    @property
    def magnification(self) -> float:
        """d_SD / d_SR, of an object on the rotation axis."""
        return self.d_SD / self.d_SR

    @property
    def shape(self) -> tuple[int, int]:
        """(n_v, n_u), the shape of an image[v, u]."""
        return self.n_v, self.n_u

    @property
    def _panel_axes(self) -> Array:
        """(3, 3): the rotation of the panel, written in S."""
        R: Array = R_x(self.theta) @ R_y(self.phi) @ R_z(self.eta)
        return R

    @property
    def panel(self) -> tuple[Array, Array, Array]:
        """(U, V, O) in S, mm: the steps from pixel to pixel along u and v, and the centre of pixel (0, 0)."""
        R = self._panel_axes
        U, V = R @ [-self.p_u, 0.0, 0.0], R @ [0.0, self.p_v, 0.0]
        return U, V, np.array([0.0, 0.0, self.d_SD]) - self.u_0 * U - self.v_0 * V

    @property
    def K(self) -> Array:
        """Intrinsic matrix (3, 3) of eq. (2), scaled so that its last row has length 1.

        Without roll and tilts it is the printed matrix; else see `intrinsic_matrices`.
        """
        if self.eta == self.theta == self.phi == 0.0:
            return np.array(
                [[-self.d_SD / self.p_u, 0.0, self.u_0], [0.0, self.d_SD / self.p_v, self.v_0], [0.0, 0.0, 1.0]]
            )
        d_SD, p_u, p_v, u_0, v_0 = np.array([[self.d_SD], [self.p_u], [self.p_v], [self.u_0], [self.v_0]])
        K: Array = intrinsic_matrices(d_SD, p_u, p_v, u_0, v_0, self._panel_axes[None])[0]
        return K

    @property
    def P_S(self) -> Array:
        """[K | 0], (3, 4): projects points of S.  Eq. (2)."""
        return np.hstack([self.K, np.zeros((3, 1))])

    @property
    def T_WS(self) -> RigidTransform:
        """World to source.  Eq. (4)."""
        return RigidTransform.of_rotations(R_WS, np.array([0.0, 0.0, self.d_SR]), Frame.W, Frame.S)

    @property
    def table_axis(self) -> RigidTransform:
        """A map of W onto itself that takes the z axis to the real table axis; the identity for the paper's setup."""
        return RigidTransform.of_rotations(*self._axis, Frame.W, Frame.W)

    @property
    def _axis(self) -> tuple[Array, Array]:
        """R (3, 3) and t (3,) of `table_axis`."""
        return R_x(self.axis_tilt_x) @ R_y(self.axis_tilt_y), np.array([0.0, self.axis_y, 0.0])

    def T_TW(self, alpha: Array | float) -> RigidTransform:
        """Table to world at table angle alpha (rad): a turn about the table axis, the identity at 0.  Paper sec. 3."""
        alpha = np.asarray(alpha, dtype=np.float64)
        if not np.isfinite(alpha).all():
            raise InputError("table angles hold values that are not finite")
        if self.axis_y == self.axis_tilt_x == self.axis_tilt_y == 0.0:
            return RigidTransform.of_rotations(R_z(alpha), np.zeros((*alpha.shape, 3)), Frame.T, Frame.W)
        A, t = self._axis
        R = A @ R_z(alpha) @ A.T
        return RigidTransform.of_rotations(R, t - R @ t, Frame.T, Frame.W)

    def binned(self, factor: int) -> Scanner:
        """The scanner of images averaged over factor x factor pixels.

        Pixel 0 of the binned image covers pixels 0 .. factor-1, so its centre lies at (factor - 1) / 2: a coordinate u
        becomes (u - (factor - 1) / 2) / factor.  Rows and columns that fill no whole bin are dropped at the high end.
        """
        if int(factor) != factor or factor < 1:
            raise InputError(f"binning factor is {factor!r}; a positive whole number is needed")
        shift = (factor - 1) / 2
        sigma = {
            k: s / factor if k in ("u_0", "v_0") else s * (factor if k in ("p_u", "p_v") else 1)
            for k, s in self.sigma.items()
        }
        return replace(
            self,
            p_u=self.p_u * factor,
            p_v=self.p_v * factor,
            u_0=(self.u_0 - shift) / factor,
            v_0=(self.v_0 - shift) / factor,
            n_u=self.n_u // factor,
            n_v=self.n_v // factor,
            sigma=sigma,
        )

    def cropped(self, *, u: int, v: int, n_u: int, n_v: int) -> Scanner:
        """The scanner of a read-out window of n_u x n_v pixels whose pixel (0, 0) is pixel (u, v) of this one."""
        return replace(self, u_0=self.u_0 - u, v_0=self.v_0 - v, n_u=n_u, n_v=n_v)


def _scanner_from_dict(values: dict[str, object]) -> Scanner:
    return Scanner(**values)  # type: ignore[arg-type]
