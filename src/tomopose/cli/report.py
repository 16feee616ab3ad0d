"""`tomopose report`: one offline HTML file from a result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose report cal/ --poses poses.csv --scan matrices.npz --force"


def register(app: typer.Typer) -> None:
    app.command("report", epilog=EPILOG)(report)


def report(
    folder: Annotated[Path, typer.Argument(help="Folder with calibration.json, observations.csv or matrices.npz.")],
    poses: Annotated[Path | None, typer.Option("--poses", help="poses.csv, for the plots by axis and angle.")] = None,
    images: Annotated[str | None, typer.Option("--images", help="Radiographs, for pictures of detections.")] = None,
    history: Annotated[
        Path | None, typer.Option("--history", help="History file of `tomopose monitor`, for control charts.")
    ] = None,
    scan: Annotated[Path | None, typer.Option("--scan", help="matrices.npz of a scan, for its effect.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="The HTML file; default report.html in the folder.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Write one HTML file that needs no network: verdict, parameters, residuals, pictures, the scene in 3D."""
    import tomopose as tp
    from tomopose.calibration.records.history import read_history
    from tomopose.cli.job import image_source, open_for, worst
    from tomopose.errors import FileError
    from tomopose.files import require_absent
    from tomopose.report import calibration_report, matrices_report, observations_report, write_report

    say = Say(json=as_json, quiet=quiet)
    target = require_absent(out or folder / "report.html", force=force)
    calibration_file, observations_file = folder / "calibration.json", folder / "observations.csv"
    observations = tp.read_observations(observations_file) if observations_file.exists() else None
    sequence = None if poses is None else tp.read_poses(poses)
    calibration = tp.read_calibration(calibration_file) if calibration_file.exists() else None
    pictures: tuple[Any, ...] = ()
    if images is not None and observations is not None and calibration is not None and sequence is not None:
        stack = open_for(say, image_source(images), calibration.scanner, sequence)
        pictures = worst(calibration, observations, stack)
    if calibration is not None:
        matrices = None if scan is None else tp.read_matrices(scan)
        html = calibration_report(
            calibration,
            observations=observations,
            poses=sequence,
            thumbnails=pictures,
            scan=matrices,
            history=() if history is None else read_history(history),
        )
    elif observations is not None:
        html = observations_report(observations)
    elif (folder / "matrices.npz").exists():
        html = matrices_report(tp.read_matrices(folder / "matrices.npz"))
    else:
        raise FileError(f"{folder} holds no calibration.json, observations.csv or matrices.npz", path=folder)
    write_report(target, html)
    say.result({"out": target.name}, [f"{target}: written"])
    return OK
