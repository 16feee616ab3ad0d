"""`tomopose calibrate`: poses and radiographs (or observations) to calibration.json, observations.csv, report.html."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import (
    BallOption,
    DarkOption,
    DatasetOption,
    FlatOption,
    ForceOption,
    ImagesOption,
    JsonOption,
    ObservationsOption,
    PosesOption,
    QuietOption,
    RawOption,
    RowsOption,
    Say,
    ScannerOption,
    SourcePosesOption,
    WorkersOption,
    arguments,
    either,
    names,
)

EPILOG = (
    "Example: tomopose calibrate --scanner scanner.json --poses poses.csv --images radiographs/ --out cal/\n\n"
    "C-arm: tomopose calibrate --arrangement moving-scanner --manipulator robot.json --scanner scanner.json --poses "
    "poses.csv --observations observations.csv --out cal/\n\n"
    "Twin robots: tomopose calibrate --twin twin.json --poses detector.csv --source-poses source.csv --scanner "
    "scanner.json --observations observations.csv --out cal/"
)
ARRANGEMENTS = ("moving-object", "moving-scanner")

SCALE_BAR = re.compile(r"(?P<a>\d+),(?P<b>\d+)=(?P<mm>\d+\.?\d*)\((?P<u>\d*\.?\d+)\)")


def register(app: typer.Typer) -> None:
    app.command("calibrate", epilog=EPILOG)(calibrate)


def scale_bars(texts: list[str] | None) -> dict[tuple[int, int], tuple[float, float]] | None:
    """`0,1=25.0000(0.0005)` as {(0, 1): (25.0, 0.0005)}, mm."""
    bars = {}
    for text in texts or ():
        found = SCALE_BAR.fullmatch(text.replace(" ", ""))
        if not found:
            raise typer.BadParameter(f"{text!r} is not ID,ID=MM(U)", param_hint="--distance")
        bars[int(found["a"]), int(found["b"])] = float(found["mm"]), float(found["u"])
    return bars or None


def require_arrangement(
    arrangement: str, distance_sigma: float, twin: Path | None, source_poses: Path | None, manipulator: Path | None
) -> bool:
    """Whether one manipulator carries the scanner; a usage error where the options contradict one another."""
    if arrangement not in ARRANGEMENTS:
        raise typer.BadParameter(f"{arrangement!r} is none of {', '.join(ARRANGEMENTS)}", param_hint="--arrangement")
    if (twin is None) != (source_poses is None):
        lost, there = ("--twin", "--source-poses") if twin is None else ("--source-poses", "--twin")
        raise typer.BadParameter(
            f"{there} needs {lost}: twin robots have a description and two tables", param_hint=lost
        )
    moving = arrangement == "moving-scanner"
    if twin is not None and (manipulator is not None or moving):
        raise typer.BadParameter(
            "twin.json names both robots and says what moves; leave out --manipulator and --arrangement",
            param_hint="--twin",
        )
    if distance_sigma and not moving:
        raise typer.BadParameter("serves --arrangement moving-scanner", param_hint="--d-sd-sigma-mm")
    return moving


def calibrate(
    scanner: ScannerOption,
    poses: PosesOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for calibration.json, observations.csv, report.html.")],
    images: ImagesOption = None,
    observations: ObservationsOption = None,
    ball_diameter: BallOption = 8.0,
    manipulator: Annotated[
        Path | None, typer.Option("--manipulator", help="hexapod.json or robot.json: nominal geometry and its priors.")
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="auto, rigid, kinematic or slack: how the manipulator may err.")
    ] = "auto",
    free: Annotated[
        str | None, typer.Option("--free", help="Scanner parameters to estimate too, e.g. d_SR,u_0.")
    ] = None,
    fix: Annotated[
        str | None, typer.Option("--fix", help="Parameters to hold although scanner.json gives them a sigma.")
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option("--distance", help="Scale bar between two balls, ID,ID=MM(U), as in 0,1=25.000(0.001)."),
    ] = None,
    arrangement: Annotated[
        str,
        typer.Option(
            "--arrangement",
            help="What the manipulator carries: moving-object, or moving-scanner (source "
            "and detector; C-arm, gantry), where the ball stands still.",
        ),
    ] = "moving-object",
    distance_sigma: Annotated[
        float,
        typer.Option(
            "--d-sd-sigma-mm",
            min=0.0,
            help="With moving-scanner: scatter of d_SD from view to view, one "
            "more number a view; 0: source and detector are fixed to one another.",
        ),
    ] = 0.0,
    twin: Annotated[
        Path | None,
        typer.Option(
            "--twin", help="twin.json: source and detector on a robot each; --poses is then the detector's table."
        ),
    ] = None,
    source_poses: SourcePosesOption = None,
    dark: DarkOption = None,
    flat: FlatOption = None,
    dataset: DatasetOption = None,
    rows: RowsOption = None,
    raw: RawOption = None,
    workers: WorkersOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Find how the manipulator sits in the scanner.  No start value is needed.

    Exit code 3 says that the calibration finished but is not trustworthy; the report leads with the reasons.
    """
    from dataclasses import replace

    import tomopose as tp
    from tomopose.calibration.checks.ball_size import require_ball_size, size_ratio
    from tomopose.cli.job import (
        calibration_summary,
        exit_code,
        forward_of,
        image_source,
        note_missing_flat,
        observe,
        open_for,
        require_free_folder,
        write_calibration_folder,
    )
    from tomopose.errors import NotConvergedError
    from tomopose.manipulator.twin_file import read_twin
    from tomopose.provenance import provenance

    either(images, observations)
    moving = require_arrangement(arrangement, distance_sigma, twin, source_poses, manipulator)
    say = Say(json=as_json, quiet=quiet)
    require_free_folder(out, force=force)
    bars = scale_bars(distance)
    geometry = tp.read_scanner(scanner)
    errors = None if manipulator is None else tp.read_manipulator(manipulator)
    twins = None if twin is None else read_twin(twin)
    # A table of joint values alone becomes poses by the robot's own kinematics.
    sequence = tp.read_poses(poses, forward=forward_of(errors if twins is None else twins.detector))
    stack = None
    if observations is not None:
        observed = tp.read_observations(observations)
    else:
        stack = open_for(
            say,
            image_source(str(images)),
            geometry,
            sequence,
            dark=dark,
            flat=flat,
            dataset=dataset,
            rows=rows,
            raw=raw,
        )
        note_missing_flat(say, flat)
        observed = observe(say, geometry, stack, sequence, ball_diameter=ball_diameter, workers=workers)
    given: dict[str, Any] = {"model": model, "free": names(free), "fix": names(fix), "distances": bars}
    try:
        if twins is not None and source_poses is not None:
            robots = twins.robots(tp.read_poses(source_poses, forward=forward_of(twins.source)))
            result = tp.calibrate_twin(geometry, sequence, observed, twin=robots, mount=twins.mount(geometry), **given)
        elif moving:
            result = tp.calibrate_inverse(
                geometry, sequence, observed, manipulator=errors, d_SD_sigma=distance_sigma, **given
            )
        else:
            result = tp.calibrate(geometry, sequence, observed, manipulator=errors, **given)
    except NotConvergedError as error:
        # what was reached is rejected, and its report says why
        if not isinstance(error.calibration, tp.Calibration):
            raise
        result = error.calibration
    # where the scanner moves, the chain runs through the inverse poses
    shown = tp.inverse_poses(sequence) if moving or twins is not None else sequence
    if stack is not None and twins is None and result.verdict != "rejected":
        size = require_ball_size(size_ratio(result, shown, observed, ball_diameter), ball_diameter)
        if size:
            say.note(f"note: {size}")
    made = provenance(
        inputs=[scanner, poses, *(p for p in (observations, manipulator, twin, source_poses) if p is not None)],
        arguments=arguments(
            model=model,
            free=free,
            fix=fix,
            distance=distance,
            ball_diameter_mm=ball_diameter,
            images=None if images is None else len(observed),
            arrangement="twin" if twins is not None else arrangement,
            d_sd_sigma_mm=distance_sigma or None,
        ),
    )
    result = replace(result, provenance=made)
    write_calibration_folder(out, result, observed, shown, images=stack, force=force)
    summary, lines = calibration_summary(result)
    if "kind" in result.manipulator:
        lines += [f"  {note}" for note in result.observability.notes]
    say.result({"out": out.name, **summary}, [*lines, f"{out}: calibration.json, observations.csv, report.html"])
    return exit_code(result)
