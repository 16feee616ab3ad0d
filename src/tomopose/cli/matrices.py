"""`tomopose matrices`: a calibration and a scan's poses to projection matrices, eq. (5)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import OK, PosesOption, SourcePosesOption, arguments
from tomopose.cli.options import WritingOptions, add_command

if TYPE_CHECKING:
    from tomopose import Calibration, PoseSequence, ProjectionMatrices
    from tomopose.manipulator.real_poses import ErrorModel

EPILOG = (
    "Example: tomopose matrices --calibration cal/calibration.json --poses scan.csv --binning 2 --out matrices.npz\n\n"
    "Twin robots: tomopose matrices --calibration cal/calibration.json --poses scan.csv --source-poses "
    "scan_source.csv --out matrices.npz"
)


def register(app: typer.Typer) -> None:
    add_command(app, "matrices", matrices, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose matrices`."""

    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.json.")]
    poses: PosesOption
    out: Annotated[Path, typer.Option("--out", help="matrices.npz to write.")]
    binning: Annotated[int, typer.Option("--binning", min=1, help="The scan's images average N x N pixels.")] = 1
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="The scan's scanner.json; refused where it is another scanner.")
    ] = None
    commands: Annotated[
        Path | None,
        typer.Option("--commands", help="Also write what to command so that the real machine reaches the poses."),
    ] = None
    home: Annotated[
        str | None,
        typer.Option("--home", help="pose_id at which the object has its coordinates in W; default: zero."),
    ] = None
    source_poses: SourcePosesOption = None
    manipulator: Annotated[
        Path | None,
        typer.Option(
            "--manipulator",
            help="robot.json (or twin.json): for tables of joint values alone, where the "
            "calibration trusts the robot and does not hold it.",
        ),
    ] = None


def require_tables(o: Options, cal: Calibration) -> None:
    """InputError where the tables and options do not fit the calibration's arrangement."""
    from tomopose.errors import InputError

    path = o.calibration
    twins = cal.arrangement == "twin"
    if twins and o.source_poses is None:
        raise InputError(f"{path} is of twin robots; --source-poses with the source robot's table is missing")
    if not twins and o.source_poses is not None:
        raise InputError(f"{path} is not of twin robots; --source-poses belongs to a calibration made with --twin")
    if twins and (o.home is not None or o.commands is not None):
        raise InputError(
            "twin robots: W is that of the first view, and commands are not corrected; leave out --home and --commands"
        )
    if o.commands is not None and cal.model == "rigid":
        raise InputError(f"{path} holds no errors of the manipulator; command the poses as they are")


def machines(o: Options, cal: Calibration) -> tuple[Any, Any]:
    """The machine of --poses and, for twin robots, that of --source-poses: the calibration's or --manipulator's."""
    import tomopose as tp
    from tomopose.manipulator.error_models import machines_of
    from tomopose.manipulator.twin_file import read_twin

    if o.manipulator is None:
        return machines_of(cal.errors)
    if o.source_poses is None:
        return tp.read_manipulator(o.manipulator), None
    drawn = read_twin(o.manipulator)
    return drawn.detector, drawn.source


def matrices_of(
    o: Options, cal: Calibration, machine: ErrorModel | None, other: ErrorModel | None
) -> tuple[ProjectionMatrices, tuple[str, ...], PoseSequence | None]:
    """(matrices, remarks, poses to command for them, where --commands asks for those)."""
    import tomopose as tp
    from tomopose.calibration.arrangements.twin_robots import twin_notes
    from tomopose.cli.job import forward_of
    from tomopose.manipulator.error_models import correction

    scan = tp.read_poses(o.poses, forward=forward_of(machine))
    scanner = None if o.scanner is None else tp.read_scanner(o.scanner)
    if o.source_poses is not None:
        source = tp.read_poses(o.source_poses, forward=forward_of(other))
        twins = tp.twin_matrices(cal, scan, source, binning=o.binning, scanner=scanner)
        return twins, tuple(twin_notes(cal, scan, source)), None
    moving = cal.inverse
    scan = tp.inverse_poses(scan) if moving else scan
    real = correction(cal.errors, scan)
    at_home = None if o.home is None else real.poses.T_MH[int(real.poses.index_of([o.home])[0])]
    result = tp.projection_matrices(cal, scan, home=at_home, binning=o.binning, scanner=scanner)
    wanted = None if o.commands is None else tp.commands_for(cal.errors, scan)
    if wanted is not None and moving:
        wanted = tp.inverse_poses(wanted)
    return result, tuple(real.notes), wanted


def uncertainty_in_words(sigma: float | None, shared: float | None) -> str:
    """The standard uncertainty of a point's projection, rms over the field of view, and what it is made of."""
    if sigma is None or shared is None:
        return "not determinable"
    own = max(sigma**2 - shared**2, 0.0) ** 0.5
    scatter = f"{own:.2g} px of the manipulator's scatter" if own else "no known scatter of the manipulator"
    return (
        f"{sigma:.2g} px (1 sigma a coordinate of the single view, rms over the field of view): {shared:.2g} px of the "
        f"calibration, shared by all views, and {scatter}"
    )


def matrices(options: Options) -> int:
    """Turn a scan's poses into one 3x4 projection matrix a view, with the predicted uncertainty in pixels.

    Refuses a scan with another pivot or another scanner than the calibration's.  A robot's zero is far from the
    scanner: name one of its poses as --home.  Where the calibration is one of a moving scanner or of twin robots, the
    tables are those of the same plates, and W keeps still with the object; for twins it is W of the first view.
    """
    import numpy as np

    import tomopose as tp
    from tomopose.files import require_absent
    from tomopose.provenance import provenance

    o = options
    require_absent(o.out, force=o.force)
    cal = tp.read_calibration(o.calibration)
    require_tables(o, cal)
    if o.commands is not None:
        require_absent(o.commands, force=o.force)
    machine, other = machines(o, cal)
    result, notes, wanted = matrices_of(o, cal, machine, other)
    inputs = [p for p in (o.calibration, o.poses, o.source_poses, o.scanner, o.manipulator) if p is not None]
    made = provenance(inputs=inputs, arguments=arguments(binning=o.binning, home=o.home))
    tp.write_matrices(o.out, result, provenance=made, force=o.force)
    if o.commands is not None and wanted is not None:
        tp.write_poses(o.commands, wanted, joint_units=getattr(machine, "joint_units", ()), force=o.force)
    for note in notes:
        o.say.note(f"note: {note}")
    sigma, shared = (
        None if s is None else float(np.sqrt(np.mean(s**2))) for s in (result.points_sigma, result.points_sigma_shared)
    )
    o.say.result(
        {
            "out": o.out.name,
            "views": len(result),
            "n_u_px": result.n_u,
            "n_v_px": result.n_v,
            "points_sigma_px": sigma,
            "points_sigma_shared_px": shared,
            "calibration_verdict": cal.verdict,
        },
        [
            f"{o.out}: {len(result)} matrices for images of {result.n_u} x {result.n_v} px; uncertainty "
            f"{uncertainty_in_words(sigma, shared)}"
        ],
    )
    if o.home is None and o.source_poses is None and (result.P[:, 2, 3] <= 0).any():
        o.say.note(
            "note: at the machine's zero the W origin lies behind the source; a pose of the scan as --home puts "
            "the object near it"
        )
    if cal.verdict != "trustworthy":
        o.say.note(f"note: the calibration's verdict is {cal.verdict}: {'; '.join(cal.reasons)}")
    return OK
