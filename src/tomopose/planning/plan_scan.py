"""`plan_scan`: a scan planned from a part, as one call."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tomopose.calibration.projection_matrices import require_same_scanner
from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.serial import SerialRobot
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import MeasurementPlan
from tomopose.planning.part.part import Part, read_part, require_simple
from tomopose.planning.part.settings import PartSettings, Uncertainty
from tomopose.planning.part_scan.limits_file import ScanLimits, read_limits
from tomopose.planning.part_scan.plan import plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.summary import plan_document
from tomopose.values import require_types, value

OWN = ("mu", "uncertainty", "draws", "beam")
"""Settings that are no numbers, or have an argument of their own."""


@value
class ScanPlan:
    """Views of a part in the order to be taken.

    poses:    of the views;  matrices: theirs, part at home to pixels;  way: poses between the views, if continuous.
    J, bound: what the views are worth on the points that they were chosen with, and what no choice of as many of the
              candidates could exceed.
    u_mm:     standard uncertainty of each distance and diameter of the measurement plan that noise lets expect, mm; inf
              where no edge is to be expected.
    unseen:   feature -> why no allowed view shows some of it, and what would.
    document: all figures, as scan.json holds them.
    """

    poses: PoseSequence
    matrices: ProjectionMatrices
    J: float
    bound: float
    u_mm: Mapping[str, float]
    unseen: Mapping[str, str]
    document: Mapping[str, object]
    way: PoseSequence | None = None


@require_types
def plan_scan(
    part: Mesh | str | Path,
    *,
    views: int,
    mu_per_mm: float,
    scanner: Scanner | None = None,
    calibration: Calibration | None = None,
    features: MeasurementPlan | None = None,
    limits: str | Path | None = None,
    manipulator: Hexapod | SerialRobot | None = None,
    continuous: bool = False,
    uncertainty: Uncertainty = "filters",
    draws: int = 100,
    options: Mapping[str, float] | None = None,
) -> ScanPlan:
    """Choose `views` table angles and plate poses that show a part best.

    part:        a closed mesh, mm in W at home, or an STL, PLY, OBJ or STEP file.
    mu_per_mm:   its attenuation as a volume shows it, 1/mm.
    scanner:     the calibration's unless given;  calibration: mount, pivot and shared uncertainty.
    features:    what is to be measured; the whole surface without.
    limits:      limits.toml; +-10 mm, +-5 deg and a table that turns freely without.
    manipulator: a hexapod or a robot whose legs or joints have to stay within their stroke; a robot's poses are counted
                 from its working pose, where the part lies in W, and come with their joint values.
    continuous:  whether the views lie on one smooth turn.
    uncertainty: how u_mm is predicted: "filters" in seconds; "exact", through SART's own steps, about a reconstruction
                 for each length; "drawn", the scatter of `draws` scans with noise, a reconstruction for each.
    options:     of the objective and the prediction: least_transmission, tangent (rad), tuy_width (rad), margin (px),
                 quanta, readout, blur (px), sweeps, room (mm), alpha_step and tilt_step (rad), seed ...

    Raises
    ------
    OutOfReachError  where no pose keeps the part in view, clear and in reach;  InputError  for an open mesh, features
    off the part, limits or a scanner that contradict themselves, or an option that does not exist.
    """
    if scanner is None and calibration is None:
        raise InputError("a scan of a part needs a scanner or a calibration")
    if scanner is not None and calibration is not None:
        require_same_scanner(calibration, scanner)
    given = dict(options or {})
    known = [k for k in PartSettings.__dataclass_fields__ if k not in OWN]
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise InputError(f"options: {', '.join(unknown)} is not known; {', '.join(known)} are")
    whole = {k: int(v) if k in ("sweeps", "seed") and float(v).is_integer() else v for k, v in given.items()}
    setting = Setting(
        scanner=scanner if calibration is None else calibration.scanner,  # type: ignore[arg-type]
        part=_part(part),
        views=views,
        settings=PartSettings(mu=mu_per_mm, uncertainty=uncertainty, draws=draws, **whole),  # type: ignore[arg-type]
        features=features,
        limits=ScanLimits() if limits is None else read_limits(limits),
        calibration=calibration,
        manipulator=manipulator,
        continuous=continuous,
    )
    plan = plan_part_scan(setting)
    return ScanPlan(
        poses=plan.poses,
        matrices=plan.matrices,
        J=plan.planned_J,
        bound=plan.bound,
        u_mm=dict(plan.chosen.lengths),
        unseen=dict(plan.unseen),
        document=plan_document(plan),
        way=None if plan.way is None else plan.machine.commanded(np.asarray(plan.way)),
    )


def _part(given: Mesh | str | Path) -> Part:
    if not isinstance(given, Mesh):
        return read_part(given)
    part = Part(mesh=given)
    require_simple(part)
    return part
