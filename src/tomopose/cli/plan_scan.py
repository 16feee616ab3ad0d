"""`tomopose plan scan`: the poses of a circular or tilted scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose plan scan --shape triangle --views 900 --calibration cal/calibration.json --out scan.csv"


def scan(
    out: Annotated[Path, typer.Option("--out", help="scan.csv to write.")],
    shape: Annotated[str, typer.Option("--shape", help="circular, triangle (eq. 11) or sine (paper sec. 6.1).")],
    views: Annotated[int, typer.Option("--views", min=1, help="Number of projections.")] = 900,
    amplitude: Annotated[float | None, typer.Option("--amplitude-deg", help="Of the tilt; paper: 8 and 4.")] = None,
    periods: Annotated[int, typer.Option("--periods", min=1, help="Of the tilt in one turn.")] = 7,
    offset: Annotated[float | None, typer.Option("--offset-deg", help="Of the sine; paper: 1.")] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.json: the mount; without it R_z(180 deg).")
    ] = None,
    object_radius: Annotated[
        float | None, typer.Option("--object-radius-mm", help="Upright cylinder that must stay in view (with height).")
    ] = None,
    object_height: Annotated[float | None, typer.Option("--object-height-mm", help="Its height, centred.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Write the poses of a scan: the table turns once while the object is tilted about y_W (eqs. 10 and 11).

    With a calibration and the object's size the views are checked against the field of view, and the completeness of
    the source path (Tuy's condition) is stated.
    """
    import functools
    import math

    import tomopose as tp
    from tomopose.trajectory.completeness import object_points, source_path, tuy_completeness
    from tomopose.trajectory.feasibility import cylinder, require_in_view
    from tomopose.trajectory.scan import circular_scan, tilted_scan
    from tomopose.trajectory.tilt import R_HT_MOUNTED, sine_wave, triangle_wave

    say = Say(json=as_json, quiet=quiet)
    cal = None if calibration is None else tp.read_calibration(calibration)
    R_HT = R_HT_MOUNTED if cal is None else cal.T_HT.R
    pivot = None if cal is None else cal.pivot
    if shape == "circular":
        sequence = circular_scan(views)
    elif shape == "triangle":
        wave = functools.partial(
            triangle_wave, amplitude=math.radians(8.0 if amplitude is None else amplitude), periods=periods
        )
        sequence = tilted_scan(views, wave, R_HT=R_HT, pivot=pivot)
    elif shape == "sine":
        wave = functools.partial(
            sine_wave,
            amplitude=math.radians(4.0 if amplitude is None else amplitude),
            periods=periods,
            offset=math.radians(1.0 if offset is None else offset),
        )
        sequence = tilted_scan(views, wave, R_HT=R_HT, pivot=pivot)
    else:
        raise typer.BadParameter(f"{shape!r} is not one of circular, triangle, sine", param_hint="--shape")
    summary: dict[str, object] = {"out": out.name, "views": len(sequence), "shape": shape}
    lines = [f"{out}: {len(sequence)} views, {shape}"]
    if object_radius is not None and object_height is not None:
        if cal is None:
            raise typer.BadParameter("the object's size says nothing without --calibration", param_hint="--calibration")
        matrices = tp.projection_matrices(cal, sequence)
        low, high = -object_height / 2, object_height / 2
        require_in_view(matrices.P, cylinder(object_radius, low, high), n_u=matrices.n_u, n_v=matrices.n_v)
        found = tuy_completeness(
            source_path(matrices), object_points(object_radius, low, high, spacing=object_radius / 3)
        )
        summary["tuy_share_lowest"] = float(found.share.min())
        lines.append(f"  in view; planes met by the source path: at the worst point {100 * found.share.min():.1f} %")
    tp.write_poses(out, sequence, force=force)
    say.result(summary, lines)
    return OK
