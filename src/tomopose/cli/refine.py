"""`tomopose refine`: each view's geometry corrected from the scan's own images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, DaskOption, arguments
from tomopose.cli.options import WritingOptions, add_command
from tomopose.cli.reconstruct import CorrectedImages, KeptOptions, ScanAndGrid, correction_from, grid_from

if TYPE_CHECKING:
    from tomopose import Provenance, Refinement

EPILOG = (
    "Example: tomopose refine --matrices matrices.npz --images scan/ --images-are transmission --voxel-mm 0.1 "
    "--size 256 --out refined/   then use refined/matrices.npz with reconstruct and export"
)
FILES = ("matrices.npz", "refined.json", "report.html")


def register(app: typer.Typer) -> None:
    add_command(app, "refine", refine, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(ScanAndGrid, CorrectedImages, KeptOptions, WritingOptions):
    """The options of `tomopose refine`."""

    size: Annotated[str, typer.Option("--size", help="Voxels along each axis, N or NX,NY,NZ: the whole object.")]
    out: Annotated[Path, typer.Option("--out", help="Folder for matrices.npz, refined.json and report.html.")]
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.json that the matrices were made from.")
    ] = None
    poses: Annotated[
        Path | None,
        typer.Option("--poses", help="The scan's poses.csv: with --calibration its whole covariance is the prior."),
    ] = None
    balls: Annotated[
        list[Path] | None,
        typer.Option(
            "--balls", help="observations.csv of a ball on the object, pose ids as the matrices'; once for each ball."
        ),
    ] = None
    memory: Annotated[
        float | None, typer.Option("--memory-gib", help="Keep within this much memory: finer levels are left out.")
    ] = None
    sigma: Annotated[
        float | None,
        typer.Option("--sigma-px", help="Prior uncertainty of a view, px; default: what the matrices state, else 1."),
    ] = None
    seed: Annotated[int, typer.Option("--seed", help="Random seed of the held-out blocks and the draws.")] = 0
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processors to use; all unless given.")] = None
    dask: DaskOption = None


def refine(options: Options) -> int:
    """Correct each view's geometry from the scan's own images.

    Volume and poses are estimated together.  The correction is kept only where pixels that took no part in the fit
    confirm it; else matrices.npz holds the input's matrices.  Where the images do not determine a correction (an object
    beyond the grid, a symmetric part) the exit code is 3 and the report names the direction.
    """
    import tomopose as tp
    from tomopose.cli.job import executor_of, image_source, open_for
    from tomopose.files import require_absent
    from tomopose.provenance import provenance

    o, say = options, options.say
    grid = grid_from(voxel=o.voxel, size=o.size, centre=o.centre)
    for name in FILES:
        require_absent(o.out / name, force=o.force)
    P = tp.read_matrices(o.matrices)
    calibration = None if o.calibration is None else tp.read_calibration(o.calibration)
    poses = None if o.poses is None else tp.read_poses(o.poses)
    balls = [tp.read_observations(path) for path in o.balls or ()]
    known: Any = None if o.scanner is None else tp.read_scanner(o.scanner)
    stack = open_for(
        say, image_source(o.images), known, None, dark=o.dark, flat=o.flat, dataset=o.dataset, rows=o.rows, raw=o.raw
    )
    correction = correction_from(o, stack.rows)
    with say.progress("refining") as progress, executor_of(o.dask) as client:
        result = tp.refine(
            stack,
            P,
            grid,
            calibration,
            poses=poses,
            balls=balls,
            correction=correction,
            settings=tp.RefineSettings(
                sigma_px=o.sigma, seed=o.seed, threads=o.workers, memory_gib=o.memory, client=client
            ),
            checkpoint=o.checkpoint,
            progress=progress,
        )
    given = (o.matrices, o.calibration, o.poses, *(o.balls or ()), o.scanner, o.bad_pixels, o.scene)
    inputs = [path for path in given if path is not None]
    asked = arguments(
        voxel_mm=o.voxel, size=o.size, centre_mm=o.centre, images_are=o.images_are, verdict=result.verdict,
        **(dict(result.provenance.arguments) if result.provenance else {}),
    )  # fmt: skip
    write(o, result, provenance(inputs=inputs, arguments=asked, seed=o.seed))
    said(o, result)
    return OK if result.trustworthy else NOT_TRUSTWORTHY


def write(o: Options, result: Refinement, made: Provenance) -> None:
    """The three files, all or none; `made` is the provenance block of all of them."""
    from dataclasses import replace

    import tomopose as tp
    from tomopose.files import atomic_folder
    from tomopose.report import write_report
    from tomopose.report.pages.refine_page import RefinedViews, refinement_report

    result = replace(result, provenance=made)
    page = RefinedViews(
        columns=result.columns(),
        verdict=result.verdict,
        reasons=result.reasons,
        unobservable=result.unobservable,
        gain=result.held_out_gain,
        halves_px=result.halves_px,
        stated_px=result.stated_px,
        edge_blur_mm=(result.edge_blur_before_mm, result.edge_blur_after_mm),
        before=result.volume_before,
        after=result.volume,
        provenance=made,
    )
    with atomic_folder(o.out, force=o.force) as folder:
        tp.write_matrices(folder / "matrices.npz", result.matrices, provenance=made)
        tp.write_refinement(folder / "refined.json", result)
        write_report(folder / "report.html", refinement_report(page))


def said(o: Options, result: Refinement) -> None:
    """The result in words, or as JSON."""
    import numpy as np

    sigma = result.matrices.points_sigma
    o.say.result(
        {
            "out": o.out.name,
            "verdict": result.verdict,
            "trustworthy": result.trustworthy,
            "reasons": list(result.reasons),
            "unobservable": list(result.unobservable),
            "iterations": result.iterations,
            "converged": result.converged,
            "median_residual_before": float(np.median(result.residual_before)),
            "median_residual_after": float(np.median(result.residual_after)),
            "halves_px": result.halves_px,
            "stated_px": result.stated_px,
            "edge_blur_before_mm": result.edge_blur_before_mm,
            "edge_blur_after_mm": result.edge_blur_after_mm,
            "points_sigma_px": None if sigma is None else float(np.sqrt(np.mean(sigma**2))),
            "balls_mm": result.balls,
            "balls_residual_over_sigma": result.balls_misfit,
            "jumps": [result.pose_id[j] for j in result.outliers],
        },
        [
            f"{o.out}: {result.verdict}; matrices.npz, refined.json and report.html",
            *(f"  {reason}" for reason in result.reasons),
            f"  residual of a view, median: {np.median(result.residual_before):.3g} before, "
            f"{np.median(result.residual_after):.3g} after",
            f"  uncertainty of a view: {result.stated_px:.3g} px a coordinate stated, {result.halves_px:.3g} px by two "
            "halves of the views refined apart",
            *edges_in_words(result),
            *balls_in_words(result),
            *(f"  view {result.pose_id[j]} stands out from the others" for j in result.outliers),
            *(f"  note: {sentence}" for sentence in result.unobservable),
        ],
    )


def edges_in_words(result: Refinement) -> list[str]:
    """How sharp the edges are under both geometries; nothing where none can be measured."""
    before, after = result.edge_blur_before_mm, result.edge_blur_after_mm
    if not (math.isfinite(before) and math.isfinite(after)):
        return []
    words = f"{before:.3g} mm with the input's geometry, {after:.3g} mm with the refined one"
    return [f"  blur of the volume's edges, standard deviation: {words}"]


def balls_in_words(result: Refinement) -> list[str]:
    """Where the balls on the object sit; nothing without them."""
    if result.balls is None:
        return []
    places = "; ".join(", ".join(f"{c:.4f}" for c in x) for x in result.balls)
    return [f"  balls at {places} mm in W; their residual is {result.balls_misfit:.2f} times what was stated"]
