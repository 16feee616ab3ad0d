"""`tomopose compare`: has the mount changed between two calibrations, and is the change more than chance?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, ForceOption, JsonOption, QuietOption, Say, arguments

EPILOG = "Example: tomopose compare before/calibration.json after/calibration.json --out change.html"


def register(app: typer.Typer) -> None:
    app.command("compare", epilog=EPILOG)(compare)


def compare(
    a: Annotated[Path, typer.Argument(help="calibration.json of the earlier run.")],
    b: Annotated[Path, typer.Argument(help="calibration.json of the later run.")],
    out: Annotated[Path | None, typer.Option("--out", help="Also write the comparison as one HTML file.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Say what changed from calibration A to calibration B, with its uncertainty and significance (paper, table 2).

    A changed scanner.json is named first; the mount is then not tested, since T_HT depends on it.  Exit code 3 says
    that something changed.
    """
    import tomopose as tp
    from tomopose.files import require_absent
    from tomopose.provenance import provenance, sha256
    from tomopose.report import comparison_report, write_report
    from tomopose.units import value_with_uncertainty

    say = Say(json=as_json, quiet=quiet)
    if out is not None:
        require_absent(out, force=force)
    found = tp.compare(tp.read_calibration(a), tp.read_calibration(b))
    if out is not None:
        # By their paths: both files are commonly called calibration.json.
        made = replace(provenance(arguments=arguments()), inputs={str(path): sha256(path) for path in (a, b)})
        write_report(out, comparison_report(found, labels=(str(a), str(b)), provenance=made))
    changes = [
        f"  {name:<10} {value_with_uncertainty(float(d), float(u))}   z = {z:+.1f}"
        for name, d, u, z in zip(found.names, found.difference, found.u, found.z, strict=True)
    ]
    say.result({**found.to_json(), "mount_changed": found.mount_changed}, [*found.words, *changes])
    return NOT_TRUSTWORTHY if found.changed else OK
