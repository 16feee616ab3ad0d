"""`tomopose calibrate`: poses and radiographs (or observations) to calibration.json, observations.csv, report.html."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

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
    WorkersOption,
    arguments,
    either,
    names,
)

EPILOG = "Example: tomopose calibrate --scanner scanner.json --poses poses.csv --images radiographs/ --out cal/"

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
    from tomopose.cli.job import (
        calibration_summary,
        exit_code,
        image_source,
        observe,
        open_for,
        require_free_folder,
        write_calibration_folder,
    )
    from tomopose.errors import NotConvergedError
    from tomopose.provenance import provenance

    either(images, observations)
    say = Say(json=as_json, quiet=quiet)
    require_free_folder(out, force=force)
    bars = scale_bars(distance)
    geometry = tp.read_scanner(scanner)
    errors = None if manipulator is None else tp.read_manipulator(manipulator)
    # A table of joint values alone becomes poses by the robot's own kinematics.
    sequence = tp.read_poses(poses, forward=getattr(errors, "forward", None) if hasattr(errors, "joints") else None)
    stack = None
    if observations is not None:
        observed = tp.read_observations(observations)
    else:
        stack = open_for(
            say, image_source(str(images)), geometry, sequence,
            dark=dark, flat=flat, dataset=dataset, rows=rows, raw=raw,
        )
        observed = observe(say, geometry, stack, sequence, ball_diameter=ball_diameter, workers=workers)
    try:
        result = tp.calibrate(
            geometry, sequence, observed, manipulator=errors, model=model, free=names(free), fix=names(fix),
            distances=bars,
        )
    except NotConvergedError as error:
        # what was reached is rejected, and its report says why
        if not isinstance(error.calibration, tp.Calibration):
            raise
        result = error.calibration
    given = [scanner, poses, *(p for p in (observations, manipulator) if p is not None)]
    made = provenance(
        inputs=given,
        arguments=arguments(model=model, free=free, fix=fix, distance=distance, ball_diameter_mm=ball_diameter,
                            images=None if images is None else len(observed)),
    )
    result = replace(result, provenance=made)
    write_calibration_folder(out, result, observed, sequence, images=stack, force=force)
    summary, lines = calibration_summary(result)
    say.result({"out": out.name, **summary}, [*lines, f"{out}: calibration.json, observations.csv, report.html"])
    return exit_code(result)
