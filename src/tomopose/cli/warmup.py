"""`tomopose warmup`: compile now what the first commands would compile while one waits."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from tomopose.cli.common import OK, JsonOption, QuietOption, Say, names

EPILOG = "Example: tomopose warmup --workers 4   once, after an installation or an upgrade"


def register(app: typer.Typer) -> None:
    app.command("warmup", epilog=EPILOG)(warmup)


def warmup(
    only: Annotated[
        str | None,
        typer.Option(
            "--only", help="Only these jobs: simulate, detect, calibrate, reconstruct, measure, plan; default: all."
        ),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")] = os.cpu_count() or 1,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Compile the kernels of the first commands in parallel processes, and keep them for every later command.

    Kernels are compiled once for this installation and this kind of processor, by this command or by the first one
    that needs them.  What is compiled already is left alone.
    """
    from tomopose import kernel_cache
    from tomopose.studies.warmup import JOBS, PACKAGE, compile_jobs, compiled_jobs

    say = Say(json=as_json, quiet=quiet)
    wanted = names(only) or tuple(JOBS)
    unknown = [name for name in wanted if name not in JOBS]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not one of {', '.join(JOBS)}", param_hint="--only")
    folder = kernel_cache.kept_in(PACKAGE)
    if folder is None:
        say.result(
            {"folder": None, "compiled": []},
            [
                "no folder can be written that compiled kernels could be kept in: each command compiles its own; "
                "set NUMBA_CACHE_DIR to a folder of yours"
            ],
        )
        return OK
    missing = [name for name in wanted if name not in compiled_jobs()]
    if missing:
        with say.progress("compiling") as progress:
            compile_jobs(missing, workers=workers, progress=progress)
    done = [name for name in JOBS if name in compiled_jobs()]
    say.result(
        {"folder": str(folder), "compiled": done},
        [f"compiled for {', '.join(done)}; kept in {folder}"],
    )
    return OK
