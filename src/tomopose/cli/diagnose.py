"""`tomopose diagnose`: which other reading of the data fits as well or better, and which cannot be told apart."""

from __future__ import annotations

import typer

from tomopose.cli.common import (
    NOT_TRUSTWORTHY,
    OK,
    BallOption,
    ImagesOption,
    JsonOption,
    ObservationsOption,
    PosesOption,
    QuietOption,
    Say,
    ScannerOption,
    WorkersOption,
    either,
)

EPILOG = "Example: tomopose diagnose --scanner scanner.json --poses poses.csv --observations observations.csv"

SHOWN = 12


def register(app: typer.Typer) -> None:
    app.command("diagnose", epilog=EPILOG)(diagnose)


def diagnose(
    scanner: ScannerOption,
    poses: PosesOption,
    images: ImagesOption = None,
    observations: ObservationsOption = None,
    ball_diameter: BallOption = 8.0,
    workers: WorkersOption = 1,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Rank rival conventions: rotation orders, signs, flipped or turned images, a pairing lag, inverse poses.

    Nothing is changed by itself; where a rival fits better the line that would cure it is printed, and the exit code
    is 3.  Rivals that these poses cannot tell apart are listed as such.
    """
    import tomopose as tp
    from tomopose.cli.job import image_source, observe, open_for

    either(images, observations)
    say = Say(json=as_json, quiet=quiet)
    geometry, sequence = tp.read_scanner(scanner), tp.read_poses(poses)
    if observations is not None:
        observed = tp.read_observations(observations)
    else:
        stack = open_for(say, image_source(str(images)), geometry, sequence)
        observed = observe(say, geometry, stack, sequence, ball_diameter=ball_diameter, workers=workers)
    found = tp.diagnose(geometry, sequence, observed)
    lines = [f"{'d_rms px':>10}  {'delta chi2':>11}  reading"]
    lines += [f"{h.d_rms:10.4f}  {h.delta:11.3g}  {h.words} [{h.outcome}]" for h in found.hypotheses[:SHOWN]]
    if len(found.hypotheses) > SHOWN:
        lines.append(f"and {len(found.hypotheses) - SHOWN} more that fit worse (--json lists all)")
    say.result(
        {
            "hypotheses": [h.to_json() for h in found.hypotheses],
            "leading": [h.name for h in found.leading],
            "advice": list(found.advice),
        },
        [*lines, *found.advice],
    )
    return OK if found.as_declared else NOT_TRUSTWORTHY
