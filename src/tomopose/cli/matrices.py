"""`tomopose matrices`: a calibration and a scan's poses to projection matrices, eq. (5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, PosesOption, QuietOption, Say, arguments

EPILOG = "Example: tomopose matrices --calibration cal/calibration.json --poses scan.csv --binning 2 --out matrices.npz"


def register(app: typer.Typer) -> None:
    app.command("matrices", epilog=EPILOG)(matrices)


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
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Turn a scan's poses into one 3x4 projection matrix a view, with the predicted uncertainty in pixels.

    Refuses a scan with another pivot or another scanner than the calibration's.  A robot's zero is far from the
    scanner: name one of its poses as --home.
    """
    import numpy as np

    import tomopose as tp
    from tomopose.errors import InputError
    from tomopose.files import require_absent
    from tomopose.manipulator.error_models import correction
    from tomopose.provenance import provenance

    say = Say(json=as_json, quiet=quiet)
    require_absent(out, force=force)
    cal, scan = tp.read_calibration(calibration), tp.read_poses(poses)
    if commands is not None:
        require_absent(commands, force=force)
        if cal.model == "rigid":
            raise InputError(f"{calibration} holds no errors of the manipulator; command the poses as they are")
    at_home = None
    if home is not None:
        real = tp.corrected_poses(cal.manipulator, scan)
        at_home = real.T_MH[int(real.index_of([home])[0])]
    result = tp.projection_matrices(
        cal, scan, binning=binning, scanner=None if scanner is None else tp.read_scanner(scanner), home=at_home
    )
    inputs = [calibration, poses, *([scanner] if scanner else [])]
    tp.write_matrices(
        out, result, provenance=provenance(inputs=inputs, arguments=arguments(binning=binning, home=home)), force=force
    )
    if commands is not None:
        tp.write_poses(commands, tp.commands_for(cal.manipulator, scan), force=force)
    if "kind" in cal.manipulator:
        for note in correction(cal.manipulator, scan).notes:
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
        {"out": out.name, "views": len(result), "n_u_px": result.n_u, "n_v_px": result.n_v, "points_sigma_px": sigma,
         "points_sigma_shared_px": shared,
         "calibration_verdict": cal.verdict},
        [f"{out}: {len(result)} matrices for images of {result.n_u} x {result.n_v} px; uncertainty {told}"],
    )
    if home is None and (result.P[:, 2, 3] <= 0).any():
        say.note("note: at the machine's zero the W origin lies behind the source; a pose of the scan as --home puts "
                 "the object near it")
    if cal.verdict != "trustworthy":
        say.note(f"note: the calibration's verdict is {cal.verdict}: {'; '.join(cal.reasons)}")
    return OK
