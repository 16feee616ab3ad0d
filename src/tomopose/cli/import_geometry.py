"""`tomopose import-geometry`: another package's geometry file to matrices.npz."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say, arguments

EPILOG = "Example: tomopose import-geometry rtk.xml --side rtk.json --n-u-px 1501 --n-v-px 1203 --out matrices.npz"


def register(app: typer.Typer) -> None:
    app.command("import-geometry", epilog=EPILOG)(import_geometry)


def import_geometry(
    file: Annotated[
        Path,
        typer.Argument(
            help="RTK .xml, ASTRA .npy, CERA .config or table, openCT or CTSimU .json, leap, tigre, cil or "
            "pyronn .npz, or an export folder."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="matrices.npz to write.")],
    format: Annotated[
        str | None,
        typer.Option(
            "--format", help="Where the file does not say: rtk, astra, cera, openct, ctsimu, leap, tigre, cil, pyronn."
        ),
    ] = None,
    n_u: Annotated[int | None, typer.Option("--n-u-px", help="Detector width, px.")] = None,
    n_v: Annotated[int | None, typer.Option("--n-v-px", help="Detector height, px.")] = None,
    p_u: Annotated[float | None, typer.Option("--p-u-mm", help="Pixel pitch along u, mm.")] = None,
    p_v: Annotated[float | None, typer.Option("--p-v-mm", help="Pixel pitch along v, mm.")] = None,
    rows: Annotated[
        str | None, typer.Option("--rows", help="Row 0 of the arrays that the file was made for: bottom or top.")
    ] = None,
    side: Annotated[Path | None, typer.Option("--side", help="Side file of an RTK geometry, rtk.json.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Read another package's geometry.  What the file does not hold must be given; nothing is guessed."""
    import tomopose as tp
    from tomopose.provenance import provenance

    if rows not in (None, "bottom", "top"):
        raise typer.BadParameter(f"{rows!r} is neither bottom nor top", param_hint="--rows")
    order: Literal["bottom", "top"] | None = None if rows is None else ("top" if rows == "top" else "bottom")
    say = Say(json=as_json, quiet=quiet)
    matrices = tp.read_geometry(file, format=format, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, rows=order, side=side)
    source = file / "manifest.json" if file.is_dir() else file
    given = arguments(format=format, n_u=n_u, n_v=n_v, rows=rows)
    made = provenance(inputs=[source, *([side] if side else [])], arguments=given)
    tp.write_matrices(out, matrices, provenance=made, force=force)
    say.result(
        {"out": out.name, "views": len(matrices), "n_u_px": matrices.n_u, "n_v_px": matrices.n_v},
        [f"{out}: {len(matrices)} views of {matrices.n_u} x {matrices.n_v} px"],
    )
    return OK
