"""`tomopose import-poses`: a controller's log, a robot's program or any table to poses.csv."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK
from tomopose.cli.options import WritingOptions, add_command

EPILOG = (
    "Example: tomopose import-poses positions.log --out poses.csv\n\n"
    "A table: tomopose import-poses points.csv --convention kuka --columns x=X_mm,y=Y_mm,z=Z_mm,a=A,b=B,c=C --out "
    "poses.csv"
    "\n\nA log with a clock: tomopose import-poses rsi.xml --join images.csv --out poses.csv"
)


def register(app: typer.Typer) -> None:
    add_command(app, "import-poses", import_poses, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose import-poses`."""

    file: Annotated[
        Path,
        typer.Argument(
            help="Log, program or table: PI, KUKA, ABB, Universal Robots, FANUC, Yaskawa, Staubli, 4 x 4 "
            "matrices, NXtomo, or columns with a header."
        ),
    ]
    out: Annotated[Path, typer.Option("--out", help="poses.csv to write.")]
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="What the file is, where it is not recognised: pi-gcs, kuka, abb, ur, fanuc, yaskawa, staubli, "
            "matrix4, nxtomo, csv.",
        ),
    ] = None
    convention: Annotated[
        str | None, typer.Option("--convention", help="Whose angles a table holds: kuka, fanuc, ur, abb, yaskawa, ...")
    ] = None
    columns: Annotated[
        str | None, typer.Option("--columns", help="Which column is what: x=X_mm,y=Y_mm,z=Z_mm,a=A,b=B,c=C,image=File.")
    ] = None
    units: Annotated[
        str | None, typer.Option("--units", help="Unit of lengths that state none: mm, m, cm, um or inch.")
    ] = None
    join: Annotated[
        Path | None,
        typer.Option("--join", help="Images (a folder) or a table with a time column: the poses at those times."),
    ] = None
    longest_gap: Annotated[
        float, typer.Option("--longest-gap-s", min=0.0, help="With --join: longest gap of the log that is bridged, s.")
    ] = 1.0
    clock_offset: Annotated[
        float, typer.Option("--clock-offset-s", help="With --join: how far the log's clock is ahead of the other, s.")
    ] = 0.0
    confirmed: Annotated[
        bool, typer.Option("--units-confirmed", help="The values are in mm and degrees although they look otherwise.")
    ] = False


def column_roles(text: str | None) -> dict[str, str]:
    """`x=X_mm,y=Y_mm` as {"x": "X_mm", "y": "Y_mm"}."""
    roles = {}
    for part in (text or "").split(","):
        role, equals, column = part.partition("=")
        if part.strip() and not (equals and role.strip() and column.strip()):
            raise typer.BadParameter(f"{part!r} is not ROLE=COLUMN", param_hint="--columns")
        if part.strip():
            roles[role.strip()] = column.strip()
    return roles


def import_poses(options: Options) -> int:
    """Read poses as machines and people write them: logs, programs, recordings, tables.

    The file's kind is recognised from its content; the numbers are written as the file has them, and what was read how
    is said.  A unit, a convention or a pivot that the file does not settle is refused with the line to type.
    """
    from tomopose.files import require_absent, write_text
    from tomopose.io import read_pose_log
    from tomopose.io.foreign.pose_log import table_text

    say = options.say
    require_absent(options.out, force=options.force)
    log = read_pose_log(
        options.file,
        format=options.format,
        convention=options.convention,
        columns=column_roles(options.columns),
        units=options.units,
        join=options.join,
        longest_gap_s=options.longest_gap,
        clock_offset_s=options.clock_offset,
    )
    poses = log.poses(units_confirmed=options.confirmed)
    write_text(options.out, table_text(log.table(units_confirmed=options.confirmed)))
    for note in log.notes:
        say.note(f"note: {note}")
    pivot = "not in the file" if poses.pivot is None else ", ".join(f"{x:g}" for x in poses.pivot) + " mm"
    say.result(
        {
            "out": options.out.name,
            "poses": len(poses),
            "convention": poses.convention,
            "source": poses.source,
            "pivot_mm": poses.pivot,
            "joints_only": not log.rows,
            "notes": list(log.notes),
        },
        [f"{options.out}: {len(poses)} poses ({poses.source}, convention {poses.convention}), pivot {pivot}"],
    )
    return OK
