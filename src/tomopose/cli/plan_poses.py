"""`tomopose plan poses`: a grid or the best poses for a scan, with the machine's own command lists."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import OK, names
from tomopose.cli.options import WritingOptions

if TYPE_CHECKING:
    from tomopose import PoseSequence, Scanner
    from tomopose.manipulator.real_poses import ErrorModel
    from tomopose.planning.identified_design import KinematicPlan as IdentifiedPlan
    from tomopose.planning.limits import PlanLimits

EPILOG = "Example: tomopose plan poses --scanner scanner.json --optimal --out poses.csv"

DEFAULT_ANGLES = (0.0, 90.0)

KINEMATIC_IMAGES = 100
"""Images of a kinematic plan unless given."""

SUFFIXES = {"pi-gcs": ".gcs", "kuka-krl": ".src", "abb-rapid": ".mod", "ur-script": ".script"}


def numbers(text: str, option: str) -> tuple[float, ...]:
    """`0,90` as numbers."""
    try:
        return tuple(float(part) for part in names(text))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a list of numbers", param_hint=option) from None


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose plan poses`."""

    out: Annotated[Path, typer.Option("--out", help="poses.csv to write.")]
    grid: Annotated[int, typer.Option("--grid", min=1, help="Positions along each axis; 3 is the paper's plan.")] = 3
    optimal: Annotated[
        bool, typer.Option("--optimal", help="Instead of the grid: the poses that serve a tilted scan best.")
    ] = False
    purpose: Annotated[
        str, typer.Option("--for", help="With --optimal: rigid, or kinematic to identify the manipulator's errors.")
    ] = "rigid"
    manipulator: Annotated[
        Path | None, typer.Option("--manipulator", help="hexapod.json or robot.json, for --for kinematic.")
    ] = None
    images: Annotated[
        int | None, typer.Option("--images", help="With --optimal: how many; default as few as equal the paper's 189.")
    ] = None
    goal: Annotated[
        float | None, typer.Option("--goal-px", help="With --optimal: scan reprojection error to reach, px rms.")
    ] = None
    half_range: Annotated[float, typer.Option("--half-range-mm", help="How far the positions reach, mm.")] = 10.0
    tilt: Annotated[float, typer.Option("--tilt-deg", help="Largest rotation about each axis, degrees.")] = 5.0
    spin: Annotated[
        float, typer.Option("--spin-deg", help="With --for kinematic: a robot's largest turn about its tool's z, deg.")
    ] = 165.0
    paper: Annotated[
        bool, typer.Option("--paper", help="The paper's own plan: turns about single axes, table at 0.")
    ] = False
    table_angles: Annotated[
        str | None,
        typer.Option(
            "--table-angles-deg",
            help="Table angles; the whole grid is repeated at each. Without it each position is taken at 0 or 90.",
        ),
    ] = None
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="scanner.json; refuses poses that put the ball out of view.")
    ] = None
    ball_diameter: Annotated[
        float, typer.Option("--ball-diameter-mm", help="Diameter of the ball, mm, which has to stay in view.")
    ] = 8.0
    commands: Annotated[
        str | None,
        typer.Option("--commands", help="Also write the machine's own list: pi-gcs, kuka-krl, abb-rapid or ur-script."),
    ] = None

    @property
    def angles(self) -> tuple[float, ...]:
        """Table angles, deg: those given, or the paper's one, or two, which show what one alone cannot."""
        if self.table_angles is None:
            return (0.0,) if self.paper else DEFAULT_ANGLES
        return numbers(self.table_angles, "--table-angles-deg")


def require_ball_in_view(scanner: Scanner, sequence: PoseSequence, ball_diameter: float) -> None:
    """OutOfViewError where the ball leaves the panel.  The mount is known only roughly: pivot and ball on the axis."""
    import numpy as np

    from tomopose.errors import OutOfViewError
    from tomopose.planning.design import nominal_mount
    from tomopose.trajectory.feasibility import ball_in_view

    seen = ball_in_view(scanner, T_HT=nominal_mount(), poses=sequence, t=np.zeros(3), radius=ball_diameter / 2)
    bad = np.flatnonzero(~seen)
    if bad.size:
        raise OutOfViewError(
            f"in {bad.size} of {len(sequence)} poses the ball leaves the field of view, first in pose "
            f"{sequence.pose_id[int(bad[0])]!r}; reduce --half-range-mm or the magnification",
            indices=bad.tolist(),
        )


def plan_limits(o: Options) -> PlanLimits:
    """Travel, table angles and ball of the options as PlanLimits."""
    from tomopose.planning.limits import PlanLimits
    from tomopose.trajectory.feasibility import TravelLimits

    reach, angle = o.half_range, math.radians(o.tilt)
    travel = TravelLimits.symmetric(x=reach, y=reach, z=reach, rx=angle, ry=angle, rz=angle)
    return PlanLimits(
        travel=travel, table_angles=tuple(math.radians(a) for a in o.angles), ball_radius=o.ball_diameter / 2
    )


@dataclass(frozen=True, kw_only=True)
class Planned:
    """Poses with what the plan says of them, for programs (summary) and for people (lines)."""

    poses: PoseSequence
    summary: dict[str, Any] = field(default_factory=dict)
    lines: tuple[str, ...] = ()


def identified_plan(o: Options, scanner: Scanner, machine: ErrorModel) -> IdentifiedPlan:
    """The plan that determines what a tilted scan needs of the manipulator's own errors."""
    import numpy as np

    from tomopose.calibration.uncertainty.trajectory import object_points
    from tomopose.manipulator.serial import SerialRobot
    from tomopose.planning.design import BALL_MM, nominal_mount
    from tomopose.planning.identified_design import plan_kinematic
    from tomopose.planning.limits import candidates
    from tomopose.planning.robot_candidates import robot_work
    from tomopose.planning.target import default_scan

    ball = np.array(BALL_MM)
    if isinstance(machine, SerialRobot):
        work = robot_work(
            machine,
            half_range=o.half_range,
            tilt=math.radians(o.tilt),
            spin=math.radians(o.spin),
            table_angles=tuple(math.radians(a) for a in o.angles),
        )
        mount, possible, scan = work.T_HT, work.candidates, work.scan
    else:
        mount = nominal_mount()
        possible = candidates(scanner, T_HT=mount, t=ball, limits=plan_limits(o))
        scan = default_scan(mount)
    return plan_kinematic(
        scanner,
        machine,
        T_HT=mount,
        balls=ball,
        candidates=possible,
        scan=scan,
        points=object_points(),
        n=o.images or KINEMATIC_IMAGES,
    )


def planned_to_identify(o: Options, scanner: Scanner) -> Planned:
    """Poses for `--optimal --for kinematic`."""
    import tomopose as tp

    if o.manipulator is None:
        raise typer.BadParameter("its nominal geometry is needed", param_hint="--manipulator")
    found = identified_plan(o, scanner, tp.read_manipulator(o.manipulator))
    lines = [
        f"  predicted scan error: {found.trusted:.3g} px if the poses are trusted, {found.identified:.3g} px "
        "with the manipulator's errors identified from these images"
    ]
    if found.but_scale < 0.5 * found.identified:
        lines.append(
            f"  most of it is the scale of the object; without it {found.but_scale:.3g} px. More table angles "
            "or a known distance between two balls determine the scale"
        )
    summary = {
        "trusted_px": found.trusted,
        "identified_px": found.identified,
        "identified_but_scale_px": found.but_scale,
    }
    return Planned(poses=found.poses, summary=summary, lines=tuple(lines))


def planned_for_mount(o: Options, scanner: Scanner) -> Planned:
    """Poses for `--optimal --for rigid`: those that determine a tilted scan's matrices best."""
    from tomopose.planning.design import plan_poses

    plan = plan_poses(scanner, n=o.images, goal=o.goal, limits=plan_limits(o))
    told = plan.resolved
    summary = {
        "predicted_px": plan.predicted,
        "paper_189_px": plan.reference,
        "u": dict(plan.u),
        "duration_s": plan.duration,
        "not_shown": [h.name for h in told.unresolved] if told else [],
        "symmetries": [h.name for h in told.symmetric] if told else [],
    }
    expected = (
        f"  predicted scan reprojection error {plan.predicted:.4f} px (the paper's 189 poses: "
        f"{plan.reference:.4f} px), about {plan.duration / 60:.0f} minutes"
    )
    return Planned(
        poses=plan.poses, summary=summary, lines=(expected, *(f"  {words}" for words in (told.words if told else ())))
    )


OPTIMAL = {"rigid": planned_for_mount, "kinematic": planned_to_identify}


def planned(o: Options, scanner: Scanner | None) -> Planned:
    """The poses that the options ask for."""
    import tomopose as tp
    from tomopose.trajectory.pose_grid import calibration_grid, compound_orientations

    if o.paper and (o.optimal or o.table_angles is not None):
        other = "--optimal" if o.optimal else "--table-angles-deg"
        raise typer.BadParameter(
            f"the paper's plan is a grid with the table at 0; leave out {other}", param_hint="--paper"
        )
    if o.optimal:
        if scanner is None:
            raise typer.BadParameter("an optimal plan needs the scanner", param_hint="--scanner")
        if o.purpose not in OPTIMAL:
            raise typer.BadParameter(f"{o.purpose!r} is neither rigid nor kinematic", param_hint="--for")
        return OPTIMAL[o.purpose](o, scanner)
    given: dict[str, Any] = {
        "half_range": o.half_range,
        "tilt": math.radians(o.tilt),
        "table_angles": [math.radians(a) for a in o.angles],
    }
    if o.paper:
        sequence = tp.pose_grid(o.grid, **given)
    elif o.table_angles is None:
        sequence = calibration_grid(o.grid, **given)
    else:
        sequence = tp.pose_grid(o.grid, orientations=compound_orientations(given.pop("tilt")), **given)
    if scanner is not None:
        require_ball_in_view(scanner, sequence, o.ball_diameter)
    return Planned(poses=sequence)


def poses(options: Options) -> int:
    """Write calibration poses: a grid n x n x n x 7, or an optimal plan with its predicted error.

    The grid turns the plate about all axes together and the table to two angles, and takes the first pose again at the
    end, so that the images determine the scanner's own values too and show a wrong convention; --paper writes the
    paper's (fig. 5), which shows neither.  An optimal plan says what uncertainty to expect before an image is taken.
    """
    import tomopose as tp
    from tomopose.files import require_absent, write_text
    from tomopose.planning.commands import command_list

    o = options
    if o.commands is not None and o.commands not in SUFFIXES:
        raise typer.BadParameter(
            f"{o.commands!r} is unknown; choose one of {', '.join(SUFFIXES)}", param_hint="--commands"
        )
    require_absent(o.out, force=o.force)
    listing = None if o.commands is None else require_absent(o.out.with_suffix(SUFFIXES[o.commands]), force=o.force)
    plan = planned(o, None if o.scanner is None else tp.read_scanner(o.scanner))
    lines = [f"{o.out}: {len(plan.poses)} poses", *plan.lines]
    # whether the controller turns the plate as these angles mean is for its user to say
    tp.write_poses(o.out, replace(plan.poses, convention_confirmed=False), force=o.force)
    if o.commands is not None and listing is not None:
        write_text(listing, command_list(plan.poses, o.commands))
        lines.append(f"  {listing}: the same poses as {o.commands}")
    o.say.result({"out": o.out.name, **plan.summary, "poses": len(plan.poses)}, lines)
    if len(o.angles) == 1:
        o.say.note("note: one table angle leaves d_SR, u_0 and the detector's roll unknown; see --table-angles-deg")
    return OK
