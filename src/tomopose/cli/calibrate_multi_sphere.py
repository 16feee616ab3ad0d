"""`tomopose calibrate --method multi-sphere`: radiographs of a calibrated standard to the matrices of their path."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import typer

from tomopose.cli.calibration_options import Options, repeatability_of
from tomopose.cli.common import NOT_TRUSTWORTHY, OK, arguments, names
from tomopose.cli.job import assumed_rows, finding_rows

if TYPE_CHECKING:
    from tomopose import MultiSphereCalibration

FILES = ("multi-sphere.json", "observations.csv", "matrices.npz", "report.html")
NOT_FOR_IT = {
    "observations": "--observations", "ball_diameter": "--ball-diameter-mm", "manipulator": "--manipulator",
    "distance": "--distance", "twin": "--twin", "source_poses": "--source-poses",
    "from_pose": "--from-pose", "until_pose": "--until-pose",
}  # fmt: skip


def require_options(o: Options) -> None:
    """A usage error for options of the other method, and where the standard or the images are missing."""
    for field, option in NOT_FOR_IT.items():
        if getattr(o, field):
            raise typer.BadParameter("has no meaning with --method multi-sphere", param_hint=option)
    if o.arrangement != "moving-object" or o.model not in ("auto", "rigid") or o.free != "auto":
        raise typer.BadParameter(
            "takes the pose of every view from the standard; leave out --arrangement, --model and --free",
            param_hint="--method multi-sphere",
        )
    if o.standard is None:
        raise typer.BadParameter("give the standard's coordinates, standard.csv", param_hint="--standard")
    if o.images is None:
        raise typer.BadParameter("give the radiographs of the standard", param_hint="--images")


def calibrate_multi_sphere(o: Options) -> int:
    """The whole way from radiographs to files."""
    import tomopose as tp
    from tomopose.cli.job import image_source, note_missing_flat, open_for
    from tomopose.files import atomic_folder, require_absent
    from tomopose.io.multi_sphere.result_json import used_centres, write_multi_sphere
    from tomopose.provenance import provenance
    from tomopose.report import write_report
    from tomopose.report.pages.multi_sphere_page import multi_sphere_report

    require_options(o)
    assert o.standard is not None
    for name in FILES:
        require_absent(o.out / name, force=o.force)
    scanner, poses, standard = tp.read_scanner(o.scanner), tp.read_poses(o.poses), tp.read_standard(o.standard)
    images = open_for(
        o.say, image_source(str(o.images)), scanner, poses,
        dark=o.dark, flat=o.flat, dataset=o.dataset, rows=o.rows, raw=o.raw,
    )  # fmt: skip
    note_missing_flat(o.say, o.flat)
    with o.say.progress("finding balls") as progress:
        found = tp.detect_balls(
            images, scanner, ball_diameters=standard.diameters.tolist(), workers=o.workers, progress=progress
        )
    result = tp.calibrate_multi_sphere(
        scanner,
        poses,
        [tp.Circles.of(image.balls) for image in found],
        standard,
        left_out=[(image.fault,) if image.fault else image.left_out for image in found],
        fix=names(o.fix) or (),
        repeatability=repeatability_of(o.repeatability),
    )
    made = provenance(
        inputs=[o.scanner, o.poses, o.standard],
        arguments=arguments(method=o.method, fix=o.fix, repeatability=o.repeatability, images=len(found)),
    )
    result = replace(result, provenance=made)
    with atomic_folder(o.out, force=o.force) as folder:
        write_multi_sphere(folder / "multi-sphere.json", result)
        tp.write_observations(folder / "observations.csv", used_centres(result))
        tp.write_matrices(folder / "matrices.npz", result.matrices(), provenance=made)
        write_report(folder / "report.html", multi_sphere_report(result))
    summary, lines = multi_sphere_summary(result)
    o.say.result({"out": o.out.name, **summary}, [*lines, f"{o.out}: {', '.join(FILES)}"])
    return OK if result.verdict == "trustworthy" else NOT_TRUSTWORTHY


def multi_sphere_summary(result: MultiSphereCalibration) -> tuple[dict[str, object], list[str]]:
    """The figures of a multi-sphere calibration, for programs and for people."""
    import numpy as np

    matrices = result.matrices()
    assert matrices.points_sigma is not None
    assert matrices.points_sigma_shared is not None
    sigma, shared = (
        float(np.sqrt(np.mean(np.square(s)))) for s in (matrices.points_sigma, matrices.points_sigma_shared)
    )
    n, balls = len(result.pose_id), result.balls_used
    alone = 1e3 * float(np.sqrt(np.mean(np.sum(result.alone[:, 3:] ** 2, axis=1))))
    summary: dict[str, object] = {
        "verdict": result.verdict, "reasons": list(result.reasons), "method": "multi-sphere",
        "views": n, "lost": dict(result.lost), "d_rms_px": result.d_rms, "chi2_dof": result.chi2_dof,
        "balls_used": [int(balls.min()), int(balls.max())],
        "points_sigma_px": sigma, "points_sigma_shared_px": shared, "alone_um": alone,
        "findings": finding_rows(result.checks),
        "assumed": assumed_rows(result.assumed),
    }  # fmt: skip
    lines = [
        f"{result.verdict}: the standard's pose was found in {n} of {n + len(result.lost)} views",
        *(f"  - {reason}" for reason in result.reasons),
        f"  d_rms {result.d_rms:.4g} px, chi2/dof {result.chi2_dof:.3g}, {balls.min()} to {balls.max()} of "
        f"{len(result.standard)} balls a view",
        f"  matrices: {sigma:.2g} px of standard uncertainty in a view, {shared:.2g} px of it shared by all views",
        f"  each view alone, with scanner and coordinates as given, differs by {alone:.2g} um (rms)",
    ]
    if result.repeatability is None:
        lines.append(
            "  note: the manipulator's scatter between this scan and the next is not in it; state "
            "--repeatability-um-urad"
        )
    return summary, lines
