"""`tomopose import-scanner`: a scanner maker's file to a draft of scanner.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK
from tomopose.cli.options import WritingOptions, add_command

EPILOG = "Example: tomopose import-scanner part.xtekct --out scanner.json"


def register(app: typer.Typer) -> None:
    add_command(app, "import-scanner", import_scanner, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose import-scanner`."""

    file: Annotated[
        Path,
        typer.Argument(
            help="Nikon .xtekct, phoenix .pca, SkyScan .log, Zeiss .txrm, RX unireconstruction.xml, North Star "
            ".nsipro, Yxlon, Diondo, NXtomo, DICOM, CTSimU, robot-CT JSON, or lines of name = value."
        ),
    ]
    out: Annotated[Path, typer.Option("--out", help="scanner.json to write.")]


def import_scanner(options: Options) -> int:
    """Draft scanner.json from what a scanner wrote about itself.

    What the file states is taken, what it does not state is named, and so is which of two known readings of an
    ambiguous field was taken.  No uncertainty is made up: without `sigma` the documented defaults apply.
    """
    from tomopose.files import require_absent, write_json
    from tomopose.io import read_scanner_draft
    from tomopose.provenance import provenance

    say = options.say
    require_absent(options.out, force=options.force)
    draft = read_scanner_draft(options.file)
    made = provenance(inputs=[options.file], arguments={})
    write_json(options.out, "scanner", {**draft.document(), "provenance": made.to_json()})
    for line in draft.lines():
        say.note(line)
    say.result(
        {
            "out": options.out.name,
            "kind": draft.kind,
            "maker": draft.maker,
            "values": dict(draft.values),
            "missing": list(draft.missing),
            "assumed": list(draft.assumed),
            "readings": list(draft.readings),
            "notes": list(draft.notes),
            "unused": list(draft.unused),
            "angles": None if draft.angles_deg is None else len(draft.angles_deg),
        },
        [
            f"{options.out}: draft of {draft.maker} ({len(draft.values)} values"
            + (f"; add {', '.join(draft.missing)}" if draft.missing else "")
            + ")"
        ],
    )
    return OK
