"""`tomopose detect`: radiographs to observations.csv."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import (
    OK,
    BallOption,
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

EPILOG = "Example: tomopose detect --scanner scanner.json --images 'run/*.tif' --poses poses.csv --out observations.csv"


def register(app: typer.Typer) -> None:
    app.command("detect", epilog=EPILOG)(detect)


def detect(
    scanner: ScannerOption,
    images: Annotated[str, typer.Option("--images", help="Folder, glob or multi-page file of radiographs.")],
    out: Annotated[Path, typer.Option("--out", help="observations.csv to write.")],
    poses: Annotated[
        Path | None, typer.Option("--poses", help="poses.csv; gives the pose ids. Without it: the images' names.")
    ] = None,
    ball_diameter: BallOption = 8.0,
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
    with executor_of(dask) as executor:
        found = observe(
            say,
            geometry,
            stack,
            sequence,
            ball_diameter=ball_diameter,
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
