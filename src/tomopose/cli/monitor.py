"""`tomopose monitor`: the calibrations of one machine over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, arguments
from tomopose.cli.options import SpokenOptions, add_command

EPILOG = (
    "Example: tomopose monitor history.jsonl --add cal/calibration.json --label monday --out history.html\n\n"
    "After a repair: tomopose monitor history.jsonl --baseline monday --out history.html"
)


def register(app: typer.Typer) -> None:
    add_command(app, "monitor", monitor, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(SpokenOptions):
    """The options of `tomopose monitor`."""

    history: Annotated[Path, typer.Argument(help="History file, one line a calibration; made where absent.")]
    add: Annotated[Path | None, typer.Option("--add", help="calibration.json to add.")] = None
    label: Annotated[str, typer.Option("--label", help="A word to find the calibration again by.")] = ""
    machine: Annotated[
        str, typer.Option("--machine", help="Which machine was calibrated; the history of another one is refused.")
    ] = ""
    baseline: Annotated[
        str | None,
        typer.Option(
            "--baseline",
            help="Runs that define the normal state, FROM:TO, or FROM to judge only what came since; labels or numbers "
            "from 1. Without it every run is judged by the others.",
        ),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Control charts as one HTML file, from three calibrations on; it is drawn anew each time."
        ),
    ] = None


def monitor(options: Options) -> int:
    """Keep a history of calibrations, and say whether the machine changed.

    The first line is the answer; exit code 3 says that a number of the calibrations changed.  Single runs, steps,
    lasting shifts and trends are tested; one look raises a false alarm with a probability of at most 1 %.  A
    calibration is added once; nothing is added by a command that fails.
    """
    import tomopose as tp
    from tomopose.calibration.records.history import history_entry, read_history, with_entry, write_history
    from tomopose.calibration.records.monitor import monitor as judge
    from tomopose.errors import InputError
    from tomopose.provenance import provenance
    from tomopose.report import history_report, write_report

    o = options
    if o.add is None and (o.label or o.machine):
        raise typer.BadParameter("--label and --machine describe the calibration that --add names", param_hint="--add")
    known: Sequence[Mapping[str, Any]] = read_history(o.history) if o.add is None or o.history.exists() else []
    entries = known
    if o.add is not None:
        entry = history_entry(tp.read_calibration(o.add), label=o.label, machine=o.machine)
        entries = with_entry(known, entry)
    if not entries:
        raise InputError(f"{o.history} holds no calibration; add one with --add calibration.json")
    found = judge(entries, baseline=o.baseline)
    drawn = o.out is not None and len(entries) >= 3
    if o.out is not None and drawn:
        read = [path for path in (o.history, o.add) if path is not None and path.exists()]
        asked = arguments(label=o.label or None, machine=o.machine or None, baseline=o.baseline)
        made = provenance(inputs=read, arguments=asked)
        write_report(o.out, history_report(entries, baseline=o.baseline, provenance=made))
    if o.add is not None:
        write_history(o.history, entries)
    if o.out is not None and not drawn:
        o.say.note(f"note: {o.out} is not written; control charts start with three calibrations")
    o.say.result(
        {"history": o.history.name, "calibrations": len(entries), **found.to_json(), "last": entries[-1]},
        [
            *found.words,
            *found.notes,
            f"{o.history}: {len(entries)} calibrations",
            *([f"{o.out}: control charts"] if drawn else []),
        ],
    )
    return NOT_TRUSTWORTHY if found.alarms else OK
