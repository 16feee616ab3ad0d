"""`tomopose import-geometry`: another package's geometry file to matrices.npz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from tomopose.cli.common import OK, arguments
from tomopose.cli.options import WritingOptions, add_command

EPILOG = "Example: tomopose import-geometry rtk.xml --side rtk.json --n-u-px 1501 --n-v-px 1203 --out matrices.npz"


def register(app: typer.Typer) -> None:
    add_command(app, "import-geometry", import_geometry, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose import-geometry`."""

    file: Annotated[
        Path,
        typer.Argument(
            help="RTK, ASTRA, CERA, openCT, CTSimU, leap, tigre, cil, pyronn, matrices as .npy, .mat or text, "
            "robot-CT JSON, RX geom.csv, or an export folder."
        ),
    ]
    out: Annotated[Path, typer.Option("--out", help="matrices.npz to write.")]
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Format of the file, where it does not say: rtk, astra, cera, openct, ctsimu, leap, tigre, cil, "
            "pyronn, matrices, thd, rx.",
        ),
    ] = None
    n_u: Annotated[int | None, typer.Option("--n-u-px", help="Detector width, px.")] = None
    n_v: Annotated[int | None, typer.Option("--n-v-px", help="Detector height, px.")] = None
    p_u: Annotated[float | None, typer.Option("--p-u-mm", help="Pixel pitch along u, mm.")] = None
    p_v: Annotated[float | None, typer.Option("--p-v-mm", help="Pixel pitch along v, mm.")] = None
    rows: Annotated[
        str | None, typer.Option("--rows", help="Row 0 of the arrays that the file was made for: bottom or top.")
    ] = None
    side: Annotated[Path | None, typer.Option("--side", help="Side file of an RTK geometry, rtk.json.")] = None
    unit_mm: Annotated[
        float | None,
        typer.Option("--unit-mm", help="One unit of the file, mm: 0.001 for micrometres, the voxel size for voxels."),
    ] = None
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="The images are mirror images, seen from the source, and that is right.")
    ] = False


def import_geometry(options: Options) -> int:
    """Read another package's geometry.  What the file does not hold must be given; nothing is guessed."""
    import tomopose as tp
    from tomopose.errors import UnknownKindError
    from tomopose.files import require_absent
    from tomopose.io.foreign.registry import describe
    from tomopose.provenance import provenance

    o = options
    if o.rows not in (None, "bottom", "top"):
        raise typer.BadParameter(f"{o.rows!r} is neither bottom nor top", param_hint="--rows")
    order: Literal["bottom", "top"] | None = None if o.rows is None else ("top" if o.rows == "top" else "bottom")
    require_absent(o.out, force=o.force)
    try:
        matrices = tp.read_geometry(
            o.file,
            format=o.format,
            n_u=o.n_u,
            n_v=o.n_v,
            p_u=o.p_u,
            p_v=o.p_v,
            rows=order,
            side=o.side,
            unit_mm=o.unit_mm,
            mirrored=o.mirrored,
        )
    except UnknownKindError as error:
        raise UnknownKindError(f"{error}; {describe(o.file, 'geometry')}", path=o.file) from error
    source = o.file / "manifest.json" if o.file.is_dir() else o.file
    given = arguments(
        format=o.format, n_u=o.n_u, n_v=o.n_v, rows=o.rows, unit_mm=o.unit_mm, mirrored=o.mirrored or None
    )
    inputs = [path for path in (source, o.side) if path is not None and path.is_file()]
    made = provenance(inputs=inputs, arguments=given)
    tp.write_matrices(o.out, matrices, provenance=made, force=o.force)
    o.say.result(
        {"out": o.out.name, "views": len(matrices), "n_u_px": matrices.n_u, "n_v_px": matrices.n_v},
        [f"{o.out}: {len(matrices)} views of {matrices.n_u} x {matrices.n_v} px"],
    )
    return OK
