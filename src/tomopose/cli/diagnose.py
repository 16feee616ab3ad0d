"""`tomopose diagnose`: which other reading of the data fits as well or better, and which cannot be distinguished."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from tomopose.cli.calibrate import Inputs, read_inputs, require_arrangement, twin_robots
from tomopose.cli.calibration_options import CalibrationOptions
from tomopose.cli.common import NOT_TRUSTWORTHY, OK, either, names
from tomopose.cli.options import add_command

if TYPE_CHECKING:
    from tomopose import Diagnosis

EPILOG = (
    "Example: tomopose diagnose --scanner scanner.json --poses poses.csv --observations observations.csv\n\n"
    "C-arm: tomopose diagnose --arrangement moving-scanner --scanner scanner.json --poses poses.csv --observations "
    "observations.csv"
)

SHOWN = 12


def register(app: typer.Typer) -> None:
    add_command(app, "diagnose", diagnose, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(CalibrationOptions):
    """The options of `tomopose diagnose`: those of `calibrate` except for the folder."""


def answer(found: Diagnosis) -> str:
    """The first line."""
    if found.leading:
        return "another convention fits: " + "; or ".join(h.words for h in found.leading)
    if not found.as_declared:
        if found.nothing_fits:
            return "nothing fits"
        unit = found.other_unit
        if unit is None:
            return "the centres fit as declared, the size of the ball does not"
        return unit.words if unit.sized else "the unit of the positions is in doubt"
    return "the data fit as they were declared"


def ranking(o: Options, given: Inputs) -> Diagnosis:
    """The diagnosis of the arrangement that the options name."""
    import tomopose as tp

    poses, observed = given.poses, given.observations
    free, fix = () if o.free in ("auto", "none") else names(o.free), names(o.fix)
    if given.twin is not None:
        robots, mount = twin_robots(o, given), given.twin.mount(given.scanner)
        return tp.diagnose_twin(given.scanner, poses, observed, twin=robots, mount=mount, free=free, fix=fix)
    if o.turntable:
        return tp.diagnose_turntable(given.scanner, poses, observed, free=free, fix=fix)
    return tp.diagnose(given.scanner, poses, observed, free=free, fix=fix, moving_scanner=o.moving_scanner)


def diagnose(options: Options) -> int:
    """Rank alternative conventions: rotation orders, signs, units, flipped or turned images, a pairing lag, and more.

    Nothing is changed by itself.  The first line is the answer; where an alternative fits better the line to change is
    printed. Nothing is advised that leaves more than 10 stated standard uncertainties. Exit code 3 says that the data
    do not fit as they were declared.
    """
    o = options
    either(o.images, o.observations)
    require_arrangement(o)
    found = ranking(o, read_inputs(o))
    shown = [f"{h.d_rms:10.4f}  {h.delta:11.3g}  {h.words} [{h.outcome}]" for h in found.hypotheses[:SHOWN]]
    more = len(found.hypotheses) - SHOWN
    o.say.result(
        {
            "answer": answer(found),
            "hypotheses": [h.to_json() for h in found.hypotheses],
            "leading": [h.name for h in found.leading],
            "nothing_fits": found.nothing_fits,
            "advice": list(found.advice),
        },
        [
            answer(found),
            *found.advice,
            f"{'d_rms px':>10}  {'delta chi2':>11}  reading",
            *shown,
            *([f"and {more} more that fit worse (--json lists all)"] if more > 0 else []),
        ],
    )
    return OK if found.as_declared else NOT_TRUSTWORTHY
