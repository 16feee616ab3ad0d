"""`tomopose monitor`: the calibrations of one machine over time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose monitor history.jsonl --add cal/calibration.json --label monday --out history.html"


def register(app: typer.Typer) -> None:
    app.command("monitor", epilog=EPILOG)(monitor)


def monitor(
    history: Annotated[Path, typer.Argument(help="History file, one line a calibration; made where absent.")],
    add: Annotated[Path | None, typer.Option("--add", help="calibration.json to add.")] = None,
    label: Annotated[str, typer.Option("--label", help="A word to find the calibration again by.")] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Control charts as one HTML file, from three calibrations on; it is drawn anew each time."
        ),
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Keep a history of calibrations and draw control charts of the mount and the residual."""
    import tomopose as tp
    from tomopose.calibration.records.history import append_history, read_history
    from tomopose.report import history_report, write_report

    say = Say(json=as_json, quiet=quiet)
    entries = read_history(history) if add is None else append_history(history, tp.read_calibration(add), label=label)
    if out is not None:
        write_report(out, history_report(entries))
    say.result(
        {"history": history.name, "calibrations": len(entries), "last": entries[-1] if entries else None},
        [f"{history}: {len(entries)} calibrations", *([f"{out}: control charts"] if out else [])],
    )
    return OK
