"""`tomopose matrices`: a calibration and a scan's poses to projection matrices, eq. (5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import (
    OK,
    ForceOption,
    JsonOption,
    PosesOption,
    QuietOption,
    Say,
    SourcePosesOption,
    arguments,
)

EPILOG = (
    "Example: tomopose matrices --calibration cal/calibration.json --poses scan.csv --binning 2 --out matrices.npz\n\n"
    "Twin robots: tomopose matrices --calibration cal/calibration.json --poses scan.csv --source-poses "
    "scan_source.csv --out matrices.npz"
)


def register(app: typer.Typer) -> None:
    app.command("matrices", epilog=EPILOG)(matrices)


def require_tables(cal: Any, path: Path, *, source_poses: Path | None, home: str | None, commands: Path | None) -> None:
    """InputError where the tables and options do not fit the calibration's arrangement."""
    from tomopose.errors import InputError

    twins = cal.manipulator.get("kind") == "twin"
    if twins and source_poses is None:
        raise InputError(f"{path} is of twin robots; --source-poses with the source robot's table is missing")
    if not twins and source_poses is not None:
        raise InputError(f"{path} is not of twin robots; --source-poses belongs to a calibration made with --twin")
    if twins and (home is not None or commands is not None):
        raise InputError(
            "twin robots: W is that of the first view, and commands are not corrected; leave out --home and --commands"
        )
    if commands is not None and cal.model == "rigid":
        raise InputError(f"{path} holds no errors of the manipulator; command the poses as they are")


def matrices(
    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.json.")],
    poses: PosesOption,
    out: Annotated[Path, typer.Option("--out", help="matrices.npz to write.")],
    binning: Annotated[int, typer.Option("--binning", min=1, help="The scan's images average N x N pixels.")] = 1,
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="The scan's scanner.json; refused where it is another scanner.")
    ] = None,
    commands: Annotated[
        Path | None,
        typer.Option("--commands", help="Also write what to command so that the real machine reaches the poses."),
    ] = None,
    home: Annotated[
        str | None,
        typer.Option("--home", help="pose_id at which the object has its coordinates in W; default: zero."),
    ] = None,
    source_poses: SourcePosesOption = None,
    manipulator: Annotated[
        Path | None,
        typer.Option(
            "--manipulator",
            help="robot.json (or twin.json): for tables of joint values alone, where the "
            "calibration trusts the robot and does not hold it.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Turn a scan's poses into one 3x4 projection matrix a view, with the predicted uncertainty in pixels.

    Refuses a scan with another pivot or another scanner than the calibration's.  A robot's zero is far from the
    scanner: name one of its poses as --home.  Where the calibration is one of a moving scanner or of twin robots, the
    tables are those of the same plates, and W stands still with the object; for twins it is W of the first view.
    """
    import numpy as np

    import tomopose as tp
    from tomopose.cli.job import forward_of
    from tomopose.files import require_absent
    from tomopose.manipulator.error_models import correction, machines_of, moving_scanner
    from tomopose.manipulator.twin_file import read_twin
    from tomopose.provenance import provenance

    say = Say(json=as_json, quiet=quiet)
    require_absent(out, force=force)
    cal = tp.read_calibration(calibration)
    require_tables(cal, calibration, source_poses=source_poses, home=home, commands=commands)
    if commands is not None:
        require_absent(commands, force=force)
    machine, other = machines_of(cal.manipulator)
    if manipulator is not None:
        drawn = read_twin(manipulator) if source_poses is not None else None
        machine, other = (drawn.detector, drawn.source) if drawn else (tp.read_manipulator(manipulator), None)
    scan = tp.read_poses(poses, forward=forward_of(machine))
    given: dict[str, Any] = {"binning": binning, "scanner": None if scanner is None else tp.read_scanner(scanner)}
    if source_poses is not None:
        from tomopose.calibration.arrangements.twin_robots import twin_notes

        source = tp.read_poses(source_poses, forward=forward_of(other))
        result, notes = tp.twin_matrices(cal, scan, source, **given), twin_notes(cal, scan, source)
    else:
        turn = tp.inverse_poses if moving_scanner(cal.manipulator) else lambda table: table
        scan = turn(scan)
        real = correction(cal.manipulator, scan)
        at_home = None if home is None else real.poses.T_MH[int(real.poses.index_of([home])[0])]
        result, notes = tp.projection_matrices(cal, scan, home=at_home, **given), real.notes
    wanted = None if commands is None else turn(tp.commands_for(cal.manipulator, scan))
    inputs = [calibration, poses, *(p for p in (source_poses, scanner, manipulator) if p is not None)]
    tp.write_matrices(
        out, result, provenance=provenance(inputs=inputs, arguments=arguments(binning=binning, home=home)), force=force
    )
    if commands is not None and wanted is not None:
        tp.write_poses(commands, wanted, joint_units=getattr(machine, "joint_units", ()), force=force)
    for note in notes:
        say.note(f"note: {note}")
    sigma, shared = (
        None if s is None else float(np.sqrt(np.mean(s**2))) for s in (result.points_sigma, result.points_sigma_shared)
    )
    told = "not determinable"
    if sigma is not None and shared is not None:
        own = float(np.sqrt(max(sigma**2 - shared**2, 0.0)))
        told = f"{sigma:.2g} px (1 sigma a coordinate of the single view, rms over the field of view)"
        told += f": {shared:.2g} px of the calibration, shared by all views, and "
        told += f"{own:.2g} px of the manipulator's scatter" if own else "no known scatter of the manipulator"
    say.result(
        {
            "out": out.name,
            "views": len(result),
            "n_u_px": result.n_u,
            "n_v_px": result.n_v,
            "points_sigma_px": sigma,
            "points_sigma_shared_px": shared,
            "calibration_verdict": cal.verdict,
        },
        [f"{out}: {len(result)} matrices for images of {result.n_u} x {result.n_v} px; uncertainty {told}"],
    )
    if home is None and source_poses is None and (result.P[:, 2, 3] <= 0).any():
        say.note(
            "note: at the machine's zero the W origin lies behind the source; a pose of the scan as --home puts "
            "the object near it"
        )
    if cal.verdict != "trustworthy":
        say.note(f"note: the calibration's verdict is {cal.verdict}: {'; '.join(cal.reasons)}")
    return OK
