"""`tomopose simulate`: radiographs of a scene, with poses.csv, scanner.json and truth.json."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, DaskOption, ForceOption, JsonOption, QuietOption, Say, WorkersOption

EPILOG = "Example: tomopose simulate scene.toml --out run/ --workers 2"


class Form(StrEnum):
    tiff = "tiff"
    hdf5 = "hdf5"


def register(app: typer.Typer) -> None:
    app.command("simulate", epilog=EPILOG)(simulate)


def simulate(
    scene: Annotated[Path, typer.Argument(help="scene.toml: source, detector, objects, mount, poses.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for radiographs/ and the tables.")],
    form: Annotated[Form, typer.Option("--format", help="TIFF files in radiographs/, or radiographs.h5.")] = Form.tiff,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the radiographs that are there already.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Make radiographs that can stand in for the scanner's.  The same scene and seed give the same bytes."""
    import tomopose as tp
    from tomopose.cli.job import executor_of
    from tomopose.cli.simulated import write_run

    say = Say(json=as_json, quiet=quiet)
    content = tp.read_scene(scene)
    table = content.poses.file
    run = tp.simulate(content, poses=tp.read_poses(scene.parent / table) if table else None)
    with say.progress("simulating") as progress, executor_of(dask) as client:
        write_run(
            out,
            run,
            inputs=[scene],
            form=form.value,
            workers=workers,
            client=client,
            resume=resume,
            force=force,
            progress=progress,
        )
    say.result({"out": out.name, "images": len(run)}, [f"{out}: {len(run)} radiographs, tables and truth.json"])
    return OK
