"""`tomopose calibrate`: poses and radiographs (or observations) to calibration.json, observations.csv, report.html."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import PosesOption, ScannerOption, SourcePosesOption, arguments, either, names
from tomopose.cli.options import ObservedOptions, SpokenOptions, WritingOptions, add_command

if TYPE_CHECKING:
    from tomopose import BallObservations, Calibration, PoseSequence, Scanner, TwinRobots
    from tomopose.manipulator.real_poses import Repeatability
    from tomopose.manipulator.twin_file import TwinDrawing

EPILOG = (
    "Example: tomopose calibrate --scanner scanner.json --poses poses.csv --images radiographs/ --ball-diameter-mm 8 "
    "--out cal/\n\n"
    "C-arm: tomopose calibrate --arrangement moving-scanner --manipulator robot.json --scanner scanner.json --poses "
    "poses.csv --observations observations.csv --out cal/\n\n"
    "Twin robots: tomopose calibrate --twin twin.json --poses detector.csv --source-poses source.csv --scanner "
    "scanner.json --observations observations.csv --out cal/\n\n"
    "A table that turns alone: tomopose calibrate --arrangement turntable --scanner scanner.json --poses poses.csv "
    "--observations observations.csv --out cal/"
)
ARRANGEMENTS = ("moving-object", "moving-scanner", "turntable")
METHODS = ("poses", "turntable")

SCALE_BAR = re.compile(r"(?P<a>\d+),(?P<b>\d+)=(?P<mm>\d+\.?\d*)\((?P<u>\d*\.?\d+)\)")


def register(app: typer.Typer) -> None:
    add_command(app, "calibrate", calibrate, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions(ObservedOptions, SpokenOptions):
    """Everything that says what is calibrated and how; `diagnose` takes the same."""

    scanner: ScannerOption
    poses: PosesOption
    ball_diameter: Annotated[
        float | None,
        typer.Option(
            "--ball-diameter-mm",
            min=0.0,
            help="Diameter of the ball, mm; with observations that hold semi axes it checks the magnification.",
        ),
    ] = None
    manipulator: Annotated[
        Path | None, typer.Option("--manipulator", help="hexapod.json or robot.json: nominal geometry and its priors.")
    ] = None
    model: Annotated[
        str, typer.Option("--model", help="auto, rigid, kinematic or slack: how the manipulator may err.")
    ] = "auto"
    free: Annotated[
        str,
        typer.Option(
            "--free",
            help="Scanner values to estimate without a prior, e.g. d_SR,u_0; auto: those whose stated or assumed sigma "
            "the images contradict; none: none.",
        ),
    ] = "auto"
    fix: Annotated[
        str | None, typer.Option("--fix", help="Parameters to hold although scanner.json gives them a sigma.")
    ] = None
    repeatability: Annotated[
        str | None,
        typer.Option(
            "--repeatability-um-urad",
            help="The maker's repeatability of the manipulator, 1 sigma, as 0.5,12: prior of its scatter.",
        ),
    ] = None
    distance: Annotated[
        list[str] | None,
        typer.Option("--distance", help="Scale bar between two balls, ID,ID=MM(U), as in 0,1=25.000(0.001)."),
    ] = None
    arrangement: Annotated[
        str,
        typer.Option(
            "--arrangement",
            help="What the manipulator carries: moving-object, or moving-scanner (source "
            "and detector; C-arm, gantry), where the ball does not move; turntable: nothing moves but the table.",
        ),
    ] = "moving-object"
    method: Annotated[
        str, typer.Option("--method", help="poses, or turntable: the same as --arrangement turntable.")
    ] = "poses"
    from_pose: Annotated[
        str | None, typer.Option("--from-pose", help="Use the poses of the table from this pose_id on.")
    ] = None
    until_pose: Annotated[
        str | None, typer.Option("--until-pose", help="Use the poses before this pose_id, which is left out.")
    ] = None
    distance_sigma: Annotated[
        float,
        typer.Option(
            "--d-sd-sigma-mm",
            min=0.0,
            help="With moving-scanner: scatter of d_SD from view to view, one "
            "more number a view; 0: source and detector are fixed to one another.",
        ),
    ] = 0.0
    twin: Annotated[
        Path | None,
        typer.Option(
            "--twin", help="twin.json: source and detector on a robot each; --poses is then the detector's table."
        ),
    ] = None
    source_poses: SourcePosesOption = None

    @property
    def moving_scanner(self) -> bool:
        return self.arrangement == "moving-scanner"

    @property
    def turntable(self) -> bool:
        return "turntable" in (self.arrangement, self.method)


@dataclass(frozen=True, kw_only=True)
class Options(CalibrationOptions, WritingOptions):
    """The options of `tomopose calibrate`."""

    out: Annotated[Path, typer.Option("--out", help="Folder for calibration.json, observations.csv, report.html.")]


def scale_bars(texts: list[str] | None) -> dict[tuple[int, int], tuple[float, float]] | None:
    """`0,1=25.0000(0.0005)` as {(0, 1): (25.0, 0.0005)}, mm."""
    bars = {}
    for text in texts or ():
        found = SCALE_BAR.fullmatch(text.replace(" ", ""))
        if not found:
            raise typer.BadParameter(f"{text!r} is not ID,ID=MM(U)", param_hint="--distance")
        bars[int(found["a"]), int(found["b"])] = float(found["mm"]), float(found["u"])
    return bars or None


def require_arrangement(o: CalibrationOptions) -> None:
    """A usage error where the options contradict one another."""
    if o.arrangement not in ARRANGEMENTS:
        raise typer.BadParameter(
            f"{o.arrangement!r} is unknown; choose one of {', '.join(ARRANGEMENTS)}", param_hint="--arrangement"
        )
    if o.method not in METHODS:
        raise typer.BadParameter(f"{o.method!r} is unknown; choose one of {', '.join(METHODS)}", param_hint="--method")
    if o.turntable and (o.twin is not None or o.manipulator is not None or o.moving_scanner):
        raise typer.BadParameter(
            "a table that turns alone has no manipulator; leave out --manipulator, --twin and --arrangement",
            param_hint="--method" if o.method == "turntable" else "--arrangement",
        )
    if (o.twin is None) != (o.source_poses is None):
        lost, there = ("--twin", "--source-poses") if o.twin is None else ("--source-poses", "--twin")
        raise typer.BadParameter(
            f"{there} needs {lost}: twin robots have a description and two tables", param_hint=lost
        )
    if o.twin is not None and (o.manipulator is not None or o.moving_scanner):
        raise typer.BadParameter(
            "twin.json names both robots and says what moves; leave out --manipulator and --arrangement",
            param_hint="--twin",
        )
    if o.distance_sigma and not o.moving_scanner:
        raise typer.BadParameter("is used with --arrangement moving-scanner alone", param_hint="--d-sd-sigma-mm")


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What the files of a calibration hold.  images: the open stack, None where observations were read."""

    scanner: Scanner
    poses: PoseSequence
    observations: BallObservations
    images: Any
    manipulator: Any
    twin: TwinDrawing | None


def read_inputs(o: CalibrationOptions) -> Inputs:
    """Read every file that the options name, and find the ball where images are given."""
    import tomopose as tp
    from tomopose.cli.job import forward_of, image_source, note_missing_flat, observe, open_for
    from tomopose.manipulator.twin_file import read_twin

    scanner = tp.read_scanner(o.scanner)
    manipulator = None if o.manipulator is None else tp.read_manipulator(o.manipulator)
    twin = None if o.twin is None else read_twin(o.twin)
    # A table of joint values alone becomes poses by the robot's own kinematics.
    poses = tp.read_poses(o.poses, forward=forward_of(manipulator if twin is None else twin.detector))
    images = None
    if o.observations is not None:
        observations = tp.read_observations(o.observations).with_ball_diameter(o.ball_diameter)
        observations.require_on_panel(scanner, str(o.observations))
    else:
        images = open_for(
            o.say, image_source(str(o.images)), scanner, poses,
            dark=o.dark, flat=o.flat, dataset=o.dataset, rows=o.rows, raw=o.raw,
        )  # fmt: skip
        note_missing_flat(o.say, o.flat)
        observations = observe(o.say, scanner, images, poses, ball_diameter=o.ball_diameter, workers=o.workers)
    observations = part_of_run(observations, poses, o.from_pose, o.until_pose)
    return Inputs(
        scanner=scanner, poses=poses, observations=observations, images=images, manipulator=manipulator, twin=twin
    )


def part_of_run(
    observations: BallObservations, poses: PoseSequence, first: str | None, stop: str | None
) -> BallObservations:
    """The centres of the poses from `first` on and before `stop`, in the order of the pose table."""
    if first is None and stop is None:
        return observations
    ends = {}
    for option, pose in (("--from-pose", first), ("--until-pose", stop)):
        if pose is not None and pose not in poses.pose_id:
            raise typer.BadParameter(f"the pose table has no pose {pose!r}", param_hint=option)
        ends[option] = None if pose is None else poses.pose_id.index(pose)
    kept = set(poses.pose_id[ends["--from-pose"] : ends["--until-pose"]])
    return observations.select([k for k, name in enumerate(observations.pose_id) if name in kept])


def twin_robots(o: CalibrationOptions, given: Inputs) -> TwinRobots:
    """Both robots of twin.json, with the table of the source's."""
    import tomopose as tp
    from tomopose.cli.job import forward_of

    assert given.twin is not None
    assert o.source_poses is not None
    return given.twin.robots(tp.read_poses(o.source_poses, forward=forward_of(given.twin.source)))


def repeatability_of(text: str | None) -> Repeatability | None:
    """`0.5,12` (um, urad) as a Repeatability."""
    from tomopose.manipulator.real_poses import Repeatability

    if text is None:
        return None
    try:
        t_um, w_urad = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not UM,URAD", param_hint="--repeatability-um-urad") from None
    return Repeatability(t_mm=t_um * 1e-3, w_rad=w_urad * 1e-6)


def solve(o: Options, given: Inputs) -> Calibration:
    """The calibration of the arrangement; where no optimum was reached, what was reached (it is rejected)."""
    import tomopose as tp
    from tomopose.errors import NotConvergedError

    scanner, poses, observations = given.scanner, given.poses, given.observations
    free = o.free if o.free in ("auto", "none") else names(o.free)
    settings: dict[str, Any] = {
        "model": o.model, "free": free, "fix": names(o.fix), "distances": scale_bars(o.distance),
    }  # fmt: skip
    try:
        if given.twin is not None:
            robots, mount = twin_robots(o, given), given.twin.mount(scanner)
            return tp.calibrate_twin(scanner, poses, observations, twin=robots, mount=mount, **settings)
        if o.turntable:
            return tp.calibrate_turntable(
                scanner, poses, observations, free=free, fix=names(o.fix), distances=scale_bars(o.distance)
            )
        if o.moving_scanner:
            return tp.calibrate_inverse(
                scanner, poses, observations, manipulator=given.manipulator, d_SD_sigma=o.distance_sigma, **settings
            )
        return tp.calibrate(
            scanner,
            poses,
            observations,
            manipulator=given.manipulator,
            repeatability=repeatability_of(o.repeatability),
            **settings,
        )
    except NotConvergedError as error:
        if not isinstance(error.calibration, tp.Calibration):
            raise
        return error.calibration


def calibrate(options: Options) -> int:
    """Find how the manipulator sits in the scanner.  No start value is needed.

    Exit code 3 says that the calibration finished but is not trustworthy; the report leads with the reasons.
    """
    import tomopose as tp
    from tomopose.cli.job import calibration_summary, exit_code, require_free_folder, write_calibration_folder
    from tomopose.manipulator.error_models import RigidErrors
    from tomopose.provenance import provenance

    o = options
    either(o.images, o.observations)
    require_arrangement(o)
    require_free_folder(o.out, force=o.force)
    scale_bars(o.distance)
    given = read_inputs(o)
    result = solve(o, given)
    # Where the scanner moves, the chain runs through the inverse poses.
    shown = tp.inverse_poses(given.poses) if o.moving_scanner or given.twin is not None else given.poses
    made = provenance(
        inputs=[p for p in (o.scanner, o.poses, o.observations, o.manipulator, o.twin, o.source_poses) if p],
        arguments=arguments(
            model=o.model,
            free=o.free,
            fix=o.fix,
            distance=o.distance,
            ball_diameter_mm=given.observations.ball_diameter,
            images=None if o.images is None else len(given.observations),
            arrangement=result.arrangement,
            d_sd_sigma_mm=o.distance_sigma or None,
            from_pose=o.from_pose,
            until_pose=o.until_pose,
        ),
    )
    result = replace(result, provenance=made)
    write_calibration_folder(o.out, result, given.observations, shown, images=given.images, force=o.force)
    summary, lines = calibration_summary(result)
    if not isinstance(result.errors, RigidErrors):
        lines += [f"  {note}" for note in result.observability.notes]
    o.say.result({"out": o.out.name, **summary}, [*lines, f"{o.out}: calibration.json, observations.csv, report.html"])
    return exit_code(result)
