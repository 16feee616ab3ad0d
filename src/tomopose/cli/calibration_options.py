"""The options of `tomopose calibrate`, which `diagnose` shares except for the results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tomopose.cli.common import PosesOption, ScannerOption, SourcePosesOption
from tomopose.cli.options import ObservedOptions, SpokenOptions, WritingOptions

if TYPE_CHECKING:
    from tomopose.manipulator.real_poses import Repeatability


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions(ObservedOptions, SpokenOptions):
    """Everything that says what is calibrated and how; `diagnose` takes the same."""

    scanner: ScannerOption
    poses: PosesOption
    ball_diameter: Annotated[
        float | None,
        typer.Option(
            "--ball-diameter-mm",
            min=0.0,
            help="Diameter of the ball, mm; with observations that hold semi axes it checks the magnification.",
        ),
    ] = None
    manipulator: Annotated[
        Path | None, typer.Option("--manipulator", help="hexapod.json or robot.json: nominal geometry and its priors.")
    ] = None
    model: Annotated[
        str, typer.Option("--model", help="auto, rigid, kinematic or slack: how the manipulator may err.")
    ] = "auto"
    free: Annotated[
        str,
        typer.Option(
            "--free",
            help="Scanner values to estimate without a prior, e.g. d_SR,u_0; auto: those whose stated or assumed sigma "
            "the images contradict; none: none.",
        ),
    ] = "auto"
    fix: Annotated[
        str | None, typer.Option("--fix", help="Parameters to hold although scanner.json gives them a sigma.")
    ] = None
    confirm_convention: Annotated[
        bool,
        typer.Option(
            "--confirm-convention",
            help="The orientation columns are in the declared convention, although the poses fit another as well.",
        ),
    ] = False
    repeatability: Annotated[
        str | None,
        typer.Option(
            "--repeatability-um-urad",
            help="The maker's repeatability of the manipulator, 1 sigma, as 0.5,12: prior of its scatter.",
        ),
    ] = None
    distance: Annotated[
        list[str] | None,
        typer.Option("--distance", help="Scale bar between two balls, ID,ID=MM(U), as in 0,1=25.000(0.001)."),
    ] = None
    arrangement: Annotated[
        str,
        typer.Option(
            "--arrangement",
            help="What the manipulator carries: moving-object, or moving-scanner (source "
            "and detector; C-arm, gantry), where the ball does not move; turntable: nothing moves but the table.",
        ),
    ] = "moving-object"
    method: Annotated[
        str,
        typer.Option(
            "--method",
            help="poses; turntable: the same as --arrangement turntable; or multi-sphere: the path is run with a "
            "calibrated standard of several balls, and every view's pose is found from it.",
        ),
    ] = "poses"
    from_pose: Annotated[
        str | None, typer.Option("--from-pose", help="Use the poses of the table from this pose_id on.")
    ] = None
    until_pose: Annotated[
        str | None, typer.Option("--until-pose", help="Use the poses before this pose_id, which is left out.")
    ] = None
    distance_sigma: Annotated[
        float,
        typer.Option(
            "--d-sd-sigma-mm",
            min=0.0,
            help="With moving-scanner: scatter of d_SD from view to view, one "
            "more number a view; 0: source and detector are fixed to one another.",
        ),
    ] = 0.0
    twin: Annotated[
        Path | None,
        typer.Option(
            "--twin", help="twin.json: source and detector on a robot each; --poses is then the detector's table."
        ),
    ] = None
    source_poses: SourcePosesOption = None

    @property
    def moving_scanner(self) -> bool:
        return self.arrangement == "moving-scanner"

    @property
    def turntable(self) -> bool:
        return "turntable" in (self.arrangement, self.method)


@dataclass(frozen=True, kw_only=True)
class Options(CalibrationOptions, WritingOptions):
    """The options of `tomopose calibrate`."""

    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Folder for calibration.json (multi-sphere: multi-sphere.json and matrices.npz), observations.csv, "
            "report.html, job.json.",
        ),
    ]
    review: Annotated[
        Path | None,
        typer.Option("--review", help="review.jsonl of `tomopose review`: replay its decisions to the same bytes."),
    ] = None
    standard: Annotated[
        Path | None,
        typer.Option(
            "--standard", help="With multi-sphere: standard.csv, the balls' calibrated coordinates and diameters."
        ),
    ] = None


def repeatability_of(text: str | None) -> Repeatability | None:
    """`0.5,12` (um, urad) as a Repeatability."""
    from tomopose.manipulator.real_poses import Repeatability

    if text is None:
        return None
    try:
        t_um, w_urad = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not UM,URAD", param_hint="--repeatability-um-urad") from None
    return Repeatability(t_mm=t_um * 1e-3, w_rad=w_urad * 1e-6)
