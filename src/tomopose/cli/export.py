"""`tomopose export`: projection matrices to the geometry files of reconstruction packages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say, names

EPILOG = "Example: tomopose export --matrices matrices.npz --to astra,rtk --out geometry/"


def register(app: typer.Typer) -> None:
    app.command("export", epilog=EPILOG)(export)


def export(
    matrices: Annotated[Path, typer.Option("--matrices", help="matrices.npz, as `tomopose matrices` writes it.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the geometry files and manifest.json.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            help="Formats, separated by commas, or all: astra, rtk, leap, tigre, cil, cera, openct, ctsimu, pyronn.",
        ),
    ] = "all",
    rows: Annotated[
        str, typer.Option("--rows", help="Row 0 of the projection arrays: bottom (row index = v) or top.")
    ] = "bottom",
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Write projection matrices in the formats of reconstruction packages.

    The packages themselves need not be installed.  A format that cannot hold a geometry refuses it by name.
    """
    import tomopose as tp

    if rows not in ("bottom", "top"):
        raise typer.BadParameter(f"{rows!r} is neither bottom nor top", param_hint="--rows")
    say = Say(json=as_json, quiet=quiet)
    order: Literal["bottom", "top"] = "top" if rows == "top" else "bottom"
    written = tp.export(
        tp.read_matrices(matrices), out, formats="all" if to == "all" else names(to), rows=order, force=force
    )
    say.result(
        {"out": out.name, "files": dict(written.files), "refused": dict(written.refused)},
        [f"{out}: {', '.join(written.files)}", *(f"refused {k}: {v}" for k, v in written.refused.items())],
    )
    return OK
