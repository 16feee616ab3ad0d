"""`tomopose demo`: the whole main job on radiographs that it simulates itself."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import ForceOption, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose demo --out demo   then open demo/report.html"


def register(app: typer.Typer) -> None:
    app.command("demo", epilog=EPILOG)(demo)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for everything that the demo makes.")] = Path(
        "tomopose-demo"
    ),
    paper: Annotated[
        bool, typer.Option("--paper", help="The paper's own plan: 189 poses, table still, instead of 57.")
    ] = False,
    small: Annotated[bool, typer.Option("--small", help="A detector binned 4 x 4, for a quick look.")] = False,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")] = os.cpu_count() or 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Simulate radiographs of a ball, find it, calibrate, make a tilted scan's matrices, export them, report.

    The folder is laid out as one would lay out one's own data, and the result is held against the simulation's truth.
    """
    import tomopose as tp
    from tomopose.calibration.records.truth import d_rms_exact
    from tomopose.cli.job import calibration_summary, exit_code, observe, open_for, write_calibration_folder
    from tomopose.cli.simulated import RADIOGRAPHS, write_run
    from tomopose.files import require_absent
    from tomopose.geometry.rotations import rotation_angle_between
    from tomopose.provenance import provenance
    from tomopose.studies.demo import demo_setup
    from tomopose.studies.warmup import compiled_while

    say = Say(json=as_json, quiet=quiet)
    for name in ("calibration.json", "scan.csv", "matrices.npz", "scanner.json"):
        require_absent(out / name, force=force)
    setup = demo_setup(paper=paper, small=small)
    run = tp.simulate_ball_run(
        setup.scanner,
        T_HT=setup.T_HT,
        t=setup.t,
        poses=setup.poses,
        ball_diameter=setup.ball_diameter,
        snr=setup.snr,
        seed=setup.seed,
    )
    with say.progress("simulating") as progress, compiled_while("simulate", beside=("detect", "calibrate")):
        write_run(out, run, workers=workers, force=force, progress=progress)

    # From here on as with one's own data: only what the files say is used.
    scanner, poses = tp.read_scanner(out / "scanner.json"), tp.read_poses(out / "poses.csv")
    images = open_for(say, out / RADIOGRAPHS, scanner, poses)
    observations = observe(say, scanner, images, poses, ball_diameter=setup.ball_diameter, workers=workers)
    made = provenance(inputs=[out / "scanner.json", out / "poses.csv"], seed=setup.seed)
    calibration = replace(tp.calibrate(scanner, poses, observations), provenance=made)
    tp.write_poses(out / "scan.csv", setup.scan, force=True)
    matrices = tp.projection_matrices(calibration, tp.read_poses(out / "scan.csv"))
    write_calibration_folder(out, calibration, observations, poses, images=images, scan=matrices, force=force)
    tp.write_matrices(out / "matrices.npz", matrices, provenance=made, force=force)
    tp.export(matrices, out / "geometry", formats="all", force=force)

    off = (calibration.T_HT.t - setup.T_HT.t) * 1000.0
    found = d_rms_exact(scanner, poses, observations, T_HT=setup.T_HT, t=setup.t)
    turned = float(rotation_angle_between(setup.T_HT.R, calibration.T_HT.R)) * 1e6
    summary, lines = calibration_summary(calibration)
    say.result(
        {"out": out.name, **summary, "error_t_HT_um": off, "error_R_HT_urad": turned, "d_rms_exact_px": found},
        [
            *lines,
            f"  against the simulation's truth: t_HT off by {off[0]:+.2f}, {off[1]:+.2f}, {off[2]:+.2f} um, "
            f"R_HT by {turned:.2f} urad, detected centres by {found:.5f} px rms",
            f"{out}: radiographs, tables, calibration.json, matrices.npz, geometry/, and report.html to look at",
        ],
    )
    return exit_code(calibration)
