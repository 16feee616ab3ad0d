"""`tomopose import-poses`: a controller's position log to poses.csv."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose import-poses positions.log --out poses.csv"


def register(app: typer.Typer) -> None:
    app.command("import-poses", epilog=EPILOG)(import_poses)


def import_poses(
    file: Annotated[Path, typer.Argument(help="Log of a PI controller: replies to POS?, MOV? and SPI?, or a table.")],
    out: Annotated[Path, typer.Option("--out", help="poses.csv to write.")],
    confirmed: Annotated[
        bool, typer.Option("--units-confirmed", help="The values are in mm and degrees although they look otherwise.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Read a PI GCS position log: POS? gives the encoder's poses, MOV? the set poses, SPI? the pivot.

    A pivot or coordinate system that changes during the run is refused.
    """
    import tomopose as tp

    say = Say(json=as_json, quiet=quiet)
    poses = tp.read_gcs_log(file, units_confirmed=confirmed)
    tp.write_poses(out, poses, force=force)
    pivot = "not in the log" if poses.pivot is None else ", ".join(f"{x:g}" for x in poses.pivot) + " mm"
    say.result(
        {"out": out.name, "poses": len(poses), "pivot_mm": poses.pivot, "source": poses.source},
        [f"{out}: {len(poses)} poses ({poses.source}), pivot {pivot}"],
    )
    return OK
