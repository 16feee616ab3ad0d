"""What a scan of a part is planned for: the scanner, the part, the features, the limits."""

from __future__ import annotations

from dataclasses import dataclass, field

from tomopose.calibration.result import Calibration
from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.serial import SerialRobot
from tomopose.measurement.plan import MeasurementPlan
from tomopose.planning.design import nominal_mount
from tomopose.planning.part.part import Part
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part.targets import plane_normals, targets_of, tuy_points
from tomopose.planning.part.worth import Goal, Views, table
from tomopose.planning.part_scan.limits_file import ScanLimits
from tomopose.planning.part_scan.robot_at_work import RobotAtWork, require_limits
from tomopose.planning.part_scan.stations import Machine, stations
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """All that a plan rests on.

    scanner, part: the part lies in W at home, mm.
    views:       how many are wanted.
    settings:    the part's attenuation and the definition of J.
    features:    a measurement plan; without it the whole surface counts, by area.
    limits:      travel, times, obstacles; without them +-10 mm, +-5 deg and a table that turns freely.
    calibration: the mount, pivot and shared uncertainty; without it the paper's mount, R_z(180 deg).
    manipulator: the hexapod or robot whose legs or joints have to stay within their stroke.
    continuous:  whether the views lie on one smooth turn.
    """

    scanner: Scanner
    part: Part
    views: int
    settings: PartSettings
    features: MeasurementPlan | None = None
    limits: ScanLimits = field(default_factory=ScanLimits)
    calibration: Calibration | None = None
    manipulator: Hexapod | SerialRobot | None = None
    continuous: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.manipulator, SerialRobot):
            require_limits(self.manipulator)
        if self.views < 1:
            raise InputError(f"{self.views} views are wanted; a scan has at least one")

    @property
    def machine(self) -> Machine:
        cal, given = self.calibration, self.manipulator
        mount = None if cal is None else cal.T_HT
        machine = RobotAtWork(robot=given, mount=mount) if isinstance(given, SerialRobot) else given
        if isinstance(machine, RobotAtWork):
            mount = machine.T_HT
        return Machine(
            scanner=self.scanner,
            T_HT=nominal_mount() if mount is None else mount,
            limits=self.limits.travel,
            obstacles=self.limits.obstacles,
            pivot=None if cal is None else cal.pivot,
            manipulator=machine,
        )

    def candidates(self, goal: Goal) -> tuple[Array, Views]:
        """(q (n, 7), their tables): all views that limits, panel, obstacles and transmission allow.

        OutOfReachError where none is left.
        """
        q = stations(self.machine, self.part, self.settings)
        tables = table(goal, self.machine.matrices(q))
        kept = self.settings.least_view_transmission <= tables.M
        if not kept.any():
            raise OutOfReachError(
                f"no view of {self.part.name} transmits {self.settings.least_view_transmission:g} on average: the "
                f"best of {len(q)} candidates has {tables.M.max():.2g}; a higher voltage, or a lower limit, is needed",
                limits=self.limits.travel,
            )
        return q[kept], tables.take(kept)

    def goal(self, *, judged: bool = False) -> Goal:
        """Points to plan with, or, judged, points of another pattern."""
        targets = targets_of(self.part, self.features, judged=judged, seed=self.settings.seed)
        points = tuy_points(self.part, targets)
        return Goal(part=self.part, targets=targets, x_tuy=points, planes=plane_normals(), settings=self.settings)
