"""What limits a plan: how to place the part on the plate, and which freedom would help most, each tried coarsely.

The coarse search takes twice the steps of the grid and no refinement; its J is compared only with its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.rotations import R_x, R_y, log_rotation
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import MeasurementPlan
from tomopose.planning.part.part import Part
from tomopose.planning.part.settings import WEIGHTS
from tomopose.planning.part_scan.choose import choose, value
from tomopose.planning.part_scan.limits_file import ScanLimits
from tomopose.planning.part_scan.setting import Setting
from tomopose.trajectory.feasibility import TravelLimits
from tomopose.units import Array

COARSE = 2.0
TURNS_DEG = (30.0, 45.0, 60.0, 90.0)
"""By which the part is tilted about x and y of W."""
CORNER_DEG = (45.0, 35.264)
"""A cube on its corner."""
MORE_TILT, MORE_LIFT, MORE_MAGNIFICATION = 2.0, 2.0, 1.25


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """J of the coarse search with one more freedom; gain: relative to the coarse search without it."""

    name: str
    J: float
    gain: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Placing:
    """How the part is best placed: x -> R (x - centre) + centre, mm in W at home.

    tried: rotation vector in words -> J of the coarse search.
    """

    R: Array
    centre: Array
    part: Part
    features: MeasurementPlan | None
    tried: Mapping[str, float]

    def document(self) -> dict[str, object]:
        return {
            "R": self.R.tolist(),
            "t_mm": (self.centre - self.R @ self.centre).tolist(),
            "rotation_vector_deg": np.degrees(log_rotation(self.R)).tolist(),
            "tried": [{"rotation": k, "J": v} for k, v in self.tried.items()],
        }


def coarse_J(setting: Setting) -> float:
    """J of a coarse search; 0 where nothing is allowed."""
    s = setting.settings
    coarse = replace(setting, settings=replace(s, alpha_step=COARSE * s.alpha_step, tilt_step=COARSE * s.tilt_step))
    goal = coarse.goal()
    try:
        q, tables = coarse.candidates(goal)
    except OutOfReachError:
        return 0.0
    N = min(coarse.views, len(q))
    m = WEIGHTS[2] * tables.M / N
    return value(tables.A, m, goal.w, choose(tables.A, m, goal.w, N))


def placings(part: Part) -> dict[str, Array]:
    """Rotations (3, 3) to try, by name."""
    out = {"as given": np.eye(3)}
    for degrees in TURNS_DEG:
        out[f"{degrees:g} deg about x"] = R_x(np.radians(degrees))
        out[f"{degrees:g} deg about y"] = R_y(np.radians(degrees))
    out["on a corner"] = R_y(np.radians(CORNER_DEG[1])) @ R_x(np.radians(CORNER_DEG[0]))
    return out


def placed(part: Part, features: MeasurementPlan | None, R: Array) -> tuple[Part, MeasurementPlan | None]:
    """Part and features turned by R (3, 3) about the part's middle."""
    c = part.centre
    mesh = Mesh(points=(part.mesh.points - c) @ R.T + c, faces=part.mesh.faces)
    if features is None:
        return Part(mesh=mesh, name=part.name), None
    start = np.array(features.alignment.start, dtype=np.float64)
    turned = np.column_stack([R @ start[:, :3], R @ (start[:, 3] - c) + c])
    rows = tuple((float(a), float(b), float(d), float(e)) for a, b, d, e in turned)
    alignment = features.alignment.model_copy(update={"start": rows})
    return Part(mesh=mesh, name=part.name), features.model_copy(update={"alignment": alignment})


def best_placing(setting: Setting) -> Placing:
    """The placing whose coarse search reaches the largest J.  OutOfReachError where none is in view."""
    tried = {}
    for name, R in placings(setting.part).items():
        part, features = placed(setting.part, setting.features, R)
        tried[name] = coarse_J(replace(setting, part=part, features=features))
    best = max(tried, key=lambda name: tried[name])
    if tried[best] == 0.0:
        raise OutOfReachError(
            f"{setting.part.name}: none of {len(tried)} placings keeps the part in view within the limits; move it "
            "towards the panel, or widen the limits",
            limits=setting.limits,
        )
    R = placings(setting.part)[best]
    part, features = placed(setting.part, setting.features, R)
    return Placing(R=R, centre=setting.part.centre, part=part, features=features, tried=tried)


def _wider(limits: ScanLimits, rows: slice, factor: float) -> ScanLimits:
    low, high = limits.travel.low.copy(), limits.travel.high.copy()
    middle, half = (low[rows] + high[rows]) / 2, (high[rows] - low[rows]) / 2
    low[rows], high[rows] = middle - factor * half, middle + factor * half
    return replace(limits, travel=TravelLimits(low=low, high=high))


def freedoms(setting: Setting) -> tuple[Freedom, ...]:
    """More tilt, more lift, another magnification, other placings: each by itself, the best first."""
    base = coarse_J(setting)
    if base == 0.0:
        raise InputError("the coarse search finds no allowed view, so no freedom can be compared with it")
    nearer = replace(setting.scanner, d_SR=setting.scanner.d_SR / MORE_MAGNIFICATION)
    farther = replace(setting.scanner, d_SR=min(setting.scanner.d_SR * MORE_MAGNIFICATION, 0.98 * setting.scanner.d_SD))
    tried = {
        "twice the tilt": replace(setting, limits=_wider(setting.limits, slice(3, 5), MORE_TILT)),
        "twice the lift": replace(setting, limits=_wider(setting.limits, slice(2, 3), MORE_LIFT)),
        f"{MORE_MAGNIFICATION:g} x the magnification": replace(setting, scanner=nearer),
        f"1 / {MORE_MAGNIFICATION:g} of the magnification": replace(setting, scanner=farther),
    }
    for name, R in placings(setting.part).items():
        if name in ("45 deg about x", "45 deg about y", "90 deg about x"):
            part, features = placed(setting.part, setting.features, R)
            tried[f"the part placed {name}"] = replace(setting, part=part, features=features)
    found = [Freedom(name=name, J=J, gain=J / base - 1) for name, J in ((n, coarse_J(s)) for n, s in tried.items())]
    return tuple(sorted(found, key=lambda f: -f.J))
