"""`tomopose detect`: radiographs to observations.csv."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tomopose.cli.common import OK, DaskOption, ScannerOption, WorkersOption
from tomopose.cli.options import ImageFileOptions, WritingOptions, add_command

if TYPE_CHECKING:
    from tomopose import ImageSequence, PoseSequence
    from tomopose.units import Array

EPILOG = (
    "Example: tomopose detect --scanner scanner.json --images 'run/*.tif' --poses poses.csv --ball-diameter-mm 8 "
    "--out observations.csv"
)


def register(app: typer.Typer) -> None:
    add_command(app, "detect", detect, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(ImageFileOptions, WritingOptions):
    """The options of `tomopose detect`."""

    scanner: ScannerOption
    images: Annotated[str, typer.Option("--images", help="Folder, glob or multi-page file of radiographs.")]
    out: Annotated[Path, typer.Option("--out", help="observations.csv to write.")]
    ball_diameter: Annotated[
        str,
        typer.Option(
            "--ball-diameter-mm",
            help="Nominal diameter of the ball, mm; with several balls in an image ID=MM,ID=MM (ids of --poses).",
        ),
    ]
    poses: Annotated[
        Path | None, typer.Option("--poses", help="poses.csv; gives the pose ids. Without it: the images' names.")
    ] = None
    predicted: Annotated[
        Path | None,
        typer.Option("--predicted", help="Table like observations.csv: where each pose's ball should be."),
    ] = None
    workers: WorkersOption = 1
    dask: DaskOption = None
    resume: Annotated[
        Path | None,
        typer.Option("--resume", help="Journal of finished images: continue where a run was interrupted."),
    ] = None


def detect(options: Options) -> int:
    """Find the projection of the ball's centre in each radiograph, with its uncertainty.

    An image that cannot be measured is listed with the reason, never silently measured.
    """
    import tomopose as tp
    from tomopose.cli.job import executor_of, image_source, note_missing_flat, observe, open_for
    from tomopose.files import require_absent

    o = options
    require_absent(o.out, force=o.force)
    scanner = tp.read_scanner(o.scanner)
    poses = None if o.poses is None else tp.read_poses(o.poses)
    read = {"dark": o.dark, "flat": o.flat, "dataset": o.dataset, "rows": o.rows, "raw": o.raw}
    stack = open_for(o.say, image_source(o.images), scanner, poses, **read)
    note_missing_flat(o.say, o.flat)
    sizes = diameters(o.ball_diameter)
    several = isinstance(sizes, dict)
    if several and poses is None:
        raise typer.BadParameter("several balls need --poses with a row for each image and ball", param_hint="--poses")
    with executor_of(o.dask) as executor:
        found = observe(
            o.say,
            scanner,
            stack,
            poses,
            ball_diameter=sizes,
            ball_id=poses.ball_id if several and poses is not None else None,
            predicted=None if o.predicted is None else places(o.predicted, stack, poses),
            workers=o.workers,
            executor=executor,
            journal=o.resume,
        )
    tp.write_observations(o.out, found, force=o.force)
    missed = {i: s for i, s, seen in zip(found.pose_id, found.status or (), found.seen, strict=True) if not seen}
    measured = int(found.seen.sum())
    o.say.result(
        {"out": o.out.name, "images": len(found), "measured": measured, "not_measured": missed},
        [f"{o.out}: {measured} of {len(found)} balls measured", *(f"  {k}: {v}" for k, v in missed.items())],
    )
    return OK


def diameters(text: str) -> float | dict[int, float]:
    """`8` or `0=8,1=5`: one diameter, or one for each ball id, mm."""
    try:
        if "=" not in text:
            return float(text)
        pairs = [part.split("=") for part in text.split(",")]
        found = {int(ball): float(mm) for ball, mm in pairs}
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r} is neither a number of mm nor ID=MM,ID=MM", param_hint="--ball-diameter-mm"
        ) from error
    if len(found) != len(pairs):
        raise typer.BadParameter(f"{text!r} names a ball twice", param_hint="--ball-diameter-mm")
    return found


def places(path: Path, images: ImageSequence, poses: PoseSequence | None) -> Array:
    """(n, 2) px where the ball of each image should be, by pose id; NaN for one that the table does not have."""
    import numpy as np

    import tomopose as tp

    table = tp.read_observations(path)
    at = {name: table.x_D[k] for k, name in enumerate(table.pose_id)}
    ids = [Path(name).stem for name in images.names] if poses is None else poses.pose_id
    return np.array([at.get(i, (np.nan, np.nan)) for i in ids], dtype=np.float64).reshape(-1, 2)
