"""`tomopose study`: the paper's tables and figures, ours beside its printed numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, ForceOption, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose study table1 --out table1   then open table1/study.html; tomopose study --list"


def register(app: typer.Typer) -> None:
    app.command("study", epilog=EPILOG)(study)


def _show_names(wanted: bool) -> None:
    if wanted:
        from tomopose.studies.registry import PAPER

        for name, paper in PAPER.items():
            print(f"{name:<14}{paper}")
        raise typer.Exit


def study(
    name: Annotated[str, typer.Argument(help="table1, table2, figure8 ...; --list names them all.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results; default: study-NAME.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed for the whole study.")] = 2023,
    scale: Annotated[
        str, typer.Option("--scale", help="small: a minute or so; paper: the paper's full plan.")
    ] = "small",
    listed: Annotated[
        bool, typer.Option("--list", callback=_show_names, is_eager=True, help="Name the studies and stop.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Run a study: printed, ours by the paper's method, ours by our best; as JSON, page and pictures.

    An interrupted study continues where it stopped when it is called again with the same folder, seed and scale.  Exit
    code 3 where a statement that the study tests does not hold.
    """
    from tomopose.files import require_absent
    from tomopose.studies.parts.writing import write_study
    from tomopose.studies.registry import run_study

    say = Say(json=as_json, quiet=quiet)
    folder = Path(f"study-{name}") if out is None else out
    for file in ("study.json", "study.html"):
        require_absent(folder / file, force=force)
    with say.progress(name) as progress:
        result = run_study(name, scale=scale, seed=seed, folder=folder, progress=progress)  # type: ignore[arg-type]
    write_study(folder, result, force=force)
    say.result(
        {"out": folder.name, **result.to_json()},
        [
            f"{result.title} ({result.scale}, {result.seconds:.0f} s by the clock, {result.processor_seconds:.0f} s of "
            f"processor time, {result.compile_seconds:.0f} s by the clock for compiling)",
            *(f"  {'holds' if c.holds else 'DOES NOT HOLD'}: {c.statement}: {c.found}" for c in result.checks),
            f"{folder}: study.json, study.html, and {len(result.figures)} figures as PNG",
        ],
    )
    return OK if result.holds else NOT_TRUSTWORTHY
