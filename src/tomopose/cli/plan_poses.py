"""`tomopose plan poses`: the paper's grid, or the best poses for a scan, with the machine's own command lists."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say, names

if TYPE_CHECKING:
    from tomopose import PoseSequence, Scanner

EPILOG = "Example: tomopose plan poses --scanner scanner.json --optimal --table-angles-deg 0,90 --out poses.csv"

KINEMATIC_IMAGES = 100
"""Images of a kinematic plan unless given."""

SUFFIXES = {"pi-gcs": ".gcs", "kuka-krl": ".src", "abb-rapid": ".mod", "ur-script": ".script"}


def numbers(text: str, option: str) -> tuple[float, ...]:
    """`0,90` as numbers."""
    try:
        return tuple(float(part) for part in names(text))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no list of numbers", param_hint=option) from None


def require_ball_in_view(scanner: Scanner, sequence: PoseSequence, ball_diameter: float) -> None:
    """OutOfViewError where the ball leaves the panel.  The mount is known only roughly: pivot and ball on the axis."""
    import numpy as np

    from tomopose.errors import OutOfViewError
    from tomopose.planning.design import nominal_mount
    from tomopose.trajectory.feasibility import ball_in_view

    seen = ball_in_view(scanner, T_HT=nominal_mount(), poses=sequence, t=np.zeros(3), radius=ball_diameter / 2)
    bad = np.flatnonzero(~seen)
    if bad.size:
        raise OutOfViewError(
            f"in {bad.size} of {len(sequence)} poses the ball leaves the field of view, first in pose "
            f"{sequence.pose_id[int(bad[0])]!r}; reduce --half-range-mm or the magnification",
            indices=bad.tolist(),
        )


def plan_limits(*, half_range: float, tilt: float, table_angles: tuple[float, ...], ball_diameter: float) -> Any:
    """Travel (mm, deg), table angles (deg) and ball (mm) as PlanLimits."""
    from tomopose.planning.limits import PlanLimits
    from tomopose.trajectory.feasibility import TravelLimits

    angle = math.radians(tilt)
    travel = TravelLimits.symmetric(x=half_range, y=half_range, z=half_range, rx=angle, ry=angle, rz=angle)
    return PlanLimits(
        travel=travel, table_angles=tuple(math.radians(a) for a in table_angles), ball_radius=ball_diameter / 2
    )


def kinematic_poses(
    scanner: Scanner,
    machine: Any,
    *,
    half_range: float,
    tilt: float,
    table_angles: tuple[float, ...],
    ball_diameter: float,
    images: int,
    spin: float,
) -> Any:
    """The plan that determines what a tilted scan needs of the manipulator's own errors; angles in degrees."""
    import numpy as np

    from tomopose.calibration.uncertainty.trajectory import object_points
    from tomopose.planning.design import BALL_MM, nominal_mount
    from tomopose.planning.identified_design import plan_kinematic
    from tomopose.planning.limits import candidates
    from tomopose.planning.target import default_scan

    ball = np.array(BALL_MM)
    if hasattr(machine, "joints"):
        from tomopose.planning.robot_candidates import robot_work

        work = robot_work(
            machine,
            half_range=half_range,
            tilt=math.radians(tilt),
            spin=math.radians(spin),
            table_angles=tuple(math.radians(a) for a in table_angles),
        )
        return plan_kinematic(
            scanner,
            machine,
            T_HT=work.T_HT,
            balls=ball,
            candidates=work.candidates,
            scan=work.scan,
            points=object_points(),
            n=images,
        )
    limits = plan_limits(half_range=half_range, tilt=tilt, table_angles=table_angles, ball_diameter=ball_diameter)
    mount = nominal_mount()
    return plan_kinematic(
        scanner,
        machine,
        T_HT=mount,
        balls=ball,
        candidates=candidates(scanner, T_HT=mount, t=ball, limits=limits),
        scan=default_scan(mount),
        points=object_points(),
        n=images,
    )


def best_poses(
    scanner: Scanner,
    *,
    half_range: float,
    tilt: float,
    table_angles: tuple[float, ...],
    ball_diameter: float,
    images: int | None,
    goal: float | None,
) -> Any:
    """The plan that tells a tilted scan's matrices best, within the given travel (mm, deg) and table angles (deg)."""
    from tomopose.planning.design import plan_poses

    limits = plan_limits(half_range=half_range, tilt=tilt, table_angles=table_angles, ball_diameter=ball_diameter)
    return plan_poses(scanner, n=images, goal=goal, limits=limits)


def poses(
    out: Annotated[Path, typer.Option("--out", help="poses.csv to write.")],
    grid: Annotated[int, typer.Option("--grid", min=1, help="Positions along each axis; 3 is the paper's plan.")] = 3,
    optimal: Annotated[
        bool, typer.Option("--optimal", help="Instead of the grid: the poses that serve a tilted scan best.")
    ] = False,
    purpose: Annotated[
        str, typer.Option("--for", help="With --optimal: rigid, or kinematic to identify the manipulator's errors.")
    ] = "rigid",
    manipulator: Annotated[
        Path | None, typer.Option("--manipulator", help="hexapod.json or robot.json, for --for kinematic.")
    ] = None,
    images: Annotated[
        int | None, typer.Option("--images", help="With --optimal: how many; default as few as equal the paper's 189.")
    ] = None,
    goal: Annotated[
        float | None, typer.Option("--goal-px", help="With --optimal: scan reprojection error to reach, px rms.")
    ] = None,
    half_range: Annotated[float, typer.Option("--half-range-mm", help="How far the positions reach, mm.")] = 10.0,
    tilt: Annotated[float, typer.Option("--tilt-deg", help="Largest rotation about each axis, degrees.")] = 5.0,
    spin: Annotated[
        float, typer.Option("--spin-deg", help="With --for kinematic: a robot's largest turn about its tool's z, deg.")
    ] = 165.0,
    table_angles: Annotated[
        str, typer.Option("--table-angles-deg", help="Table angles to use; 0,90 shows what 0 alone cannot.")
    ] = "0",
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="scanner.json; refuses poses that put the ball out of view.")
    ] = None,
    ball_diameter: Annotated[float, typer.Option("--ball-diameter-mm", help="For the field of view, mm.")] = 8.0,
    commands: Annotated[
        str | None,
        typer.Option("--commands", help="Also write the machine's own list: pi-gcs, kuka-krl, abb-rapid or ur-script."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Write calibration poses: the paper's grid n x n x n x 7 (fig. 5), or an optimal plan with its predicted error.

    An optimal plan says what uncertainty to expect before a single image is taken, and which mistakes it would show.
    """
    import tomopose as tp
    from tomopose.files import require_absent, write_text
    from tomopose.planning.commands import command_list

    say = Say(json=as_json, quiet=quiet)
    angles = numbers(table_angles, "--table-angles-deg")
    if commands is not None and commands not in SUFFIXES:
        raise typer.BadParameter(f"{commands!r} is none of {', '.join(SUFFIXES)}", param_hint="--commands")
    require_absent(out, force=force)
    listing = None if commands is None else require_absent(out.with_suffix(SUFFIXES[commands]), force=force)
    geometry = None if scanner is None else tp.read_scanner(scanner)
    summary: dict[str, Any] = {"out": out.name}
    lines: list[str] = []
    if optimal:
        if geometry is None:
            raise typer.BadParameter("an optimal plan needs the scanner", param_hint="--scanner")
        given: dict[str, Any] = {
            "half_range": half_range,
            "tilt": tilt,
            "table_angles": angles,
            "ball_diameter": ball_diameter,
        }
        if purpose == "kinematic":
            if manipulator is None:
                raise typer.BadParameter("its nominal geometry is needed", param_hint="--manipulator")
            machine = tp.read_manipulator(manipulator)
            found = kinematic_poses(geometry, machine, images=images or KINEMATIC_IMAGES, spin=spin, **given)
            sequence = found.poses
            summary |= {
                "trusted_px": found.trusted,
                "identified_px": found.identified,
                "identified_but_scale_px": found.but_scale,
            }
            lines.append(
                f"  predicted scan error: {found.trusted:.3g} px if the poses are trusted, {found.identified:.3g} px "
                "with the manipulator's errors identified from these images"
            )
            if found.but_scale < 0.5 * found.identified:
                lines.append(
                    f"  most of it is the scale of the object; without it {found.but_scale:.3g} px. More table angles "
                    "or a known distance between two balls determine the scale"
                )
        elif purpose == "rigid":
            plan = best_poses(geometry, images=images, goal=goal, **given)
            sequence = plan.poses
            told = plan.resolved
            summary |= {
                "predicted_px": plan.predicted,
                "paper_189_px": plan.reference,
                "u": dict(plan.u),
                "duration_s": plan.duration,
                "not_shown": [h.name for h in told.unresolved],
                "symmetries": [h.name for h in told.symmetric],
            }
            lines.append(
                f"  predicted scan reprojection error {plan.predicted:.4f} px (the paper's 189 poses: "
                f"{plan.reference:.4f} px), about {plan.duration / 60:.0f} minutes"
            )
            lines += [f"  {words}" for words in told.words]
        else:
            raise typer.BadParameter(f"{purpose!r} is neither rigid nor kinematic", param_hint="--for")
    else:
        sequence = tp.pose_grid(
            grid, half_range=half_range, tilt=math.radians(tilt), table_angles=[math.radians(a) for a in angles]
        )
        if geometry is not None:
            require_ball_in_view(geometry, sequence, ball_diameter)
    tp.write_poses(out, sequence, force=force)
    if commands is not None and listing is not None:
        write_text(listing, command_list(sequence, commands))
        lines.append(f"  {listing}: the same poses as {commands}")
    say.result({**summary, "poses": len(sequence)}, [f"{out}: {len(sequence)} poses", *lines])
    if len(angles) == 1:
        say.note("note: one table angle leaves d_SR, u_0 and the detector's roll unknown; see --table-angles-deg")
    return OK
