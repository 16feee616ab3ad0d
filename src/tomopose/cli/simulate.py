"""`tomopose simulate`: radiographs of a scene, with poses.csv, scanner.json and truth.json."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tomopose.cli.common import OK, DaskOption, ForceOption, JsonOption, QuietOption, Say, WorkersOption, names

if TYPE_CHECKING:
    from tomopose.simulation.scene.scene import Scene

EPILOG = (
    "Example: tomopose simulate scene.toml --out run/ --workers 2; the paper's table 1: tomopose simulate "
    "examples/scenes/ball-m2.7.toml examples/scenes/ball-m5.3.toml --grid 2,3,5 --out table1"
)


class Form(StrEnum):
    tiff = "tiff"
    hdf5 = "hdf5"


def register(app: typer.Typer) -> None:
    app.command("simulate", epilog=EPILOG)(simulate)


def simulate(
    scenes: Annotated[list[Path], typer.Argument(help="scene.toml: source, detector, objects, mount, poses.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for radiographs/ and the tables; of several runs one folder each.")
    ],
    grid: Annotated[
        str | None, typer.Option("--grid", help="Positions along each axis in place of the scenes', 2,3,5: a run each.")
    ] = None,
    form: Annotated[Form, typer.Option("--format", help="TIFF files in radiographs/, or radiographs.h5.")] = Form.tiff,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep this scene's radiographs that are there.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Make radiographs that can replace the scanner's.  The same scene and seed give the same bytes."""
    import tomopose as tp
    from tomopose.cli.job import executor_of
    from tomopose.cli.simulated import run_of, write_run

    say = Say(json=as_json, quiet=quiet)
    wanted = {}
    for scene in scenes:
        for content, name in with_grids(tp.read_scene(scene), grid, scene):
            folder = out if len(scenes) == 1 and grid is None else out / name
            if folder in wanted:
                raise typer.BadParameter(f"two runs would be written to {folder}", param_hint="SCENES")
            wanted[folder] = scene, content
    images = 0
    lines = []
    for folder, (scene, content) in wanted.items():
        run = run_of(content, scene)
        with say.progress("simulating") as progress, executor_of(dask) as client:
            write_run(
                folder,
                run,
                inputs=[scene],
                form=form.value,
                workers=workers,
                client=client,
                resume=resume,
                force=force,
                progress=progress,
            )
        images += len(run)
        lines.append(f"{folder}: {len(run)} radiographs, tables and truth.json")
    say.result({"out": out.name, "images": images, "runs": [f.name for f in wanted]}, lines)
    return OK


def with_grids(scene: Scene, grid: str | None, path: Path) -> list[tuple[Scene, str]]:
    """The scene, or one for each grid that was asked for, and the names of their folders."""
    if grid is None:
        return [(scene, path.stem)]
    if scene.poses.grid is None:
        raise typer.BadParameter(f"{path} has no grid of poses", param_hint="--grid")
    numbers = names(grid)
    if not numbers or not all(n.isdigit() and int(n) > 0 for n in numbers):
        raise typer.BadParameter(f"{grid!r} is not a list of whole numbers", param_hint="--grid")
    made = []
    for n in numbers:
        poses = scene.poses.model_copy(update={"grid": scene.poses.grid.model_copy(update={"n": int(n)})})
        made.append((scene.model_copy(update={"poses": poses}), f"{path.stem}-grid{n}"))
    return made
