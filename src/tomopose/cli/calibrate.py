"""`tomopose calibrate`: poses and radiographs (or observations) to calibration.json, observations.csv, report.html."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import typer

from tomopose.cli.calibrate_multi_sphere import calibrate_multi_sphere
from tomopose.cli.calibration_options import CalibrationOptions, Options, repeatability_of
from tomopose.cli.common import arguments, either, names
from tomopose.cli.options import add_command

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tomopose import BallObservations, Calibration, PoseSequence, Scanner, TwinRobots
    from tomopose.calibration.records.decisions import Decision
    from tomopose.manipulator.twin_file import TwinDrawing

EPILOG = (
    "Example: tomopose calibrate --scanner scanner.json --poses poses.csv --images radiographs/ --ball-diameter-mm 8 "
    "--out cal/\n\n"
    "C-arm: tomopose calibrate --arrangement moving-scanner --manipulator robot.json --scanner scanner.json --poses "
    "poses.csv --observations observations.csv --out cal/\n\n"
    "Twin robots: tomopose calibrate --twin twin.json --poses detector.csv --source-poses source.csv --scanner "
    "scanner.json --observations observations.csv --out cal/\n\n"
    "A table that turns alone: tomopose calibrate --arrangement turntable --scanner scanner.json --poses poses.csv "
    "--observations observations.csv --out cal/\n\n"
    "Multi-sphere: tomopose calibrate --method multi-sphere --standard standard.csv --scanner scanner.json --poses "
    "scan.csv --images standard_radiographs/ --out path/\n\n"
    "Reviewed: tomopose calibrate --scanner scanner.json --poses poses.csv --images radiographs/ --ball-diameter-mm 8 "
    "--review cal/review.jsonl --out reviewed/"
)
ARRANGEMENTS = ("moving-object", "moving-scanner", "turntable")
METHODS = ("poses", "turntable", "multi-sphere")

SCALE_BAR = re.compile(r"(?P<a>\d+),(?P<b>\d+)=(?P<mm>\d+\.?\d*)\((?P<u>\d*\.?\d+)\)")


def register(app: typer.Typer) -> None:
    add_command(app, "calibrate", calibrate, epilog=EPILOG)


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
    if o.method == "multi-sphere":
        raise typer.BadParameter("is a way to calibrate; no conventions enter it", param_hint="--method")
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
    poses = tp.read_poses(
        o.poses,
        convention_confirmed=o.confirm_convention,
        forward=forward_of(manipulator if twin is None else twin.detector),
    )
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
            pose_noise=repeatability_of(o.repeatability) or "auto",
            **settings,
        )
    except NotConvergedError as error:
        if not isinstance(error.calibration, tp.Calibration):
            raise
        return error.calibration


def after_review(given: Inputs, decisions: Sequence[Decision]) -> Inputs:
    """The inputs with the observations that the decisions leave."""
    from tomopose.calibration.records.decisions import decided

    return replace(given, observations=decided(given.observations, decisions))


def made_by(
    o: Options, given: Inputs, result: Calibration, decisions: Sequence[Decision], facts: Mapping[str, str]
) -> Calibration:
    """The result with its provenance, whose time is that of the last decision: a replay gives the same bytes.

    facts: what the project file says for reports.
    """
    from tomopose.provenance import MEASUREMENT, provenance

    made = provenance(
        inputs=[p for p in (o.scanner, o.poses, o.observations, o.manipulator, o.twin, o.source_poses, o.review) if p],
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
        )
        | ({MEASUREMENT: dict(facts)} if facts else {}),
    )
    return replace(result, provenance=replace(made, time_utc=decisions[-1].when) if decisions else made)


def shown_poses(o: CalibrationOptions, given: Inputs) -> PoseSequence:
    """The pose table as the report draws it: where the scanner moves, the chain runs through the inverse poses."""
    import tomopose as tp

    return tp.inverse_poses(given.poses) if o.moving_scanner or given.twin is not None else given.poses


def write_result(o: Options, out: Path, result: Calibration, given: Inputs, decisions: Sequence[Decision]) -> None:
    """The folder of a calibration: values, observations, report, and the job that made them."""
    from tomopose.cli.calibration_job import job_of
    from tomopose.cli.job import write_calibration_folder

    write_calibration_folder(
        out,
        result,
        given.observations,
        shown_poses(o, given),
        images=given.images,
        decisions=decisions,
        job=job_of(o, out),
        force=o.force,
    )


def calibrate(options: Options) -> int:
    """Find how the manipulator sits in the scanner.  No start value is needed.

    Exit code 3 says that the calibration finished but is not trustworthy; the report leads with the reasons.
    """
    from tomopose.calibration.records.decisions import read_decisions
    from tomopose.cli.job import calibration_summary, exit_code, require_free_folder
    from tomopose.cli.project import current_facts
    from tomopose.manipulator.error_models import RigidErrors

    o = options
    if o.method == "multi-sphere":
        return calibrate_multi_sphere(o)
    if o.standard is not None:
        raise typer.BadParameter("belongs to --method multi-sphere", param_hint="--standard")
    either(o.images, o.observations)
    require_arrangement(o)
    require_free_folder(o.out, force=o.force)
    scale_bars(o.distance)
    decisions = () if o.review is None else read_decisions(o.review)
    given = after_review(read_inputs(o), decisions)
    result = made_by(o, given, solve(o, given), decisions, current_facts())
    write_result(o, o.out, result, given, decisions)
    summary, lines = calibration_summary(result)
    if decisions:
        lines.append(f"  {len(decisions)} decisions of a review replayed")
    if not isinstance(result.errors, RigidErrors):
        lines += [f"  {note}" for note in result.observability.notes]
    o.say.result({"out": o.out.name, **summary}, [*lines, f"{o.out}: calibration.json, observations.csv, report.html"])
    return exit_code(result)
