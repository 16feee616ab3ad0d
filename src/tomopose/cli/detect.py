"""`tomopose detect`: radiographs to observations.csv."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tomopose.cli.common import (
    OK,
    DarkOption,
    DaskOption,
    DatasetOption,
    FlatOption,
    ForceOption,
    JsonOption,
    QuietOption,
    RawOption,
    RowsOption,
    Say,
    ScannerOption,
    WorkersOption,
)

if TYPE_CHECKING:
    from tomopose import ImageSequence, PoseSequence
    from tomopose.units import Array

EPILOG = (
    "Example: tomopose detect --scanner scanner.json --images 'run/*.tif' --poses poses.csv --ball-diameter-mm 8 "
    "--out observations.csv"
)


def register(app: typer.Typer) -> None:
    app.command("detect", epilog=EPILOG)(detect)


def detect(
    scanner: ScannerOption,
    images: Annotated[str, typer.Option("--images", help="Folder, glob or multi-page file of radiographs.")],
    out: Annotated[Path, typer.Option("--out", help="observations.csv to write.")],
    ball_diameter: Annotated[
        str,
        typer.Option(
            "--ball-diameter-mm",
            help="Nominal diameter of the ball, mm; with several balls in an image ID=MM,ID=MM (ids of --poses).",
        ),
    ],
    poses: Annotated[
        Path | None, typer.Option("--poses", help="poses.csv; gives the pose ids. Without it: the images' names.")
    ] = None,
    predicted: Annotated[
        Path | None,
        typer.Option("--predicted", help="Table like observations.csv: where each pose's ball should be."),
    ] = None,
    dark: DarkOption = None,
    flat: FlatOption = None,
    dataset: DatasetOption = None,
    rows: RowsOption = None,
    raw: RawOption = None,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", help="Journal of finished images: go on where a run was interrupted.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Find the projection of the ball's centre in each radiograph, with its uncertainty.

    An image that cannot be measured is listed with the reason, never silently measured.
    """
    import tomopose as tp
    from tomopose.cli.job import executor_of, image_source, note_missing_flat, observe, open_for
    from tomopose.files import require_absent

    say = Say(json=as_json, quiet=quiet)
    require_absent(out, force=force)
    geometry = tp.read_scanner(scanner)
    sequence = None if poses is None else tp.read_poses(poses)
    stack = open_for(
        say, image_source(images), geometry, sequence, dark=dark, flat=flat, dataset=dataset, rows=rows, raw=raw
    )
    note_missing_flat(say, flat)
    sizes = diameters(ball_diameter)
    several = isinstance(sizes, dict)
    if several and sequence is None:
        raise typer.BadParameter("several balls need --poses with a row for each image and ball", param_hint="--poses")
    with executor_of(dask) as executor:
        found = observe(
            say,
            geometry,
            stack,
            sequence,
            ball_diameter=sizes,
            ball_id=sequence.ball_id if several and sequence is not None else None,
            predicted=None if predicted is None else places(predicted, stack, sequence),
            workers=workers,
            executor=executor,
            journal=resume,
        )
    tp.write_observations(out, found, force=force)
    missed = {i: s for i, s, seen in zip(found.pose_id, found.status or (), found.seen, strict=True) if not seen}
    say.result(
        {"out": out.name, "images": len(found), "measured": int(found.seen.sum()), "not_measured": missed},
        [f"{out}: {int(found.seen.sum())} of {len(found)} balls measured", *(f"  {k}: {v}" for k, v in missed.items())],
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
