"""`tomopose plan scan`: the poses of a circular or tilted scan, or of a scan planned from the part."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from tomopose.cli.common import OK, arguments
from tomopose.cli.options import WritingOptions
from tomopose.cli.plan_poses import SUFFIXES

if TYPE_CHECKING:
    from tomopose import Calibration, PoseSequence, Scanner
    from tomopose.manipulator.hexapod import Hexapod
    from tomopose.manipulator.serial import SerialRobot
    from tomopose.planning.part.part import Part
    from tomopose.planning.part.settings import PartSettings, Uncertainty
    from tomopose.planning.part_scan.freedoms import Freedom, Placing
    from tomopose.planning.part_scan.plan import PartScanPlan
    from tomopose.provenance import Provenance
    from tomopose.report.pages.scan_plan_page import ScanPlanFigures
    from tomopose.simulation.physics.materials import Material
    from tomopose.simulation.physics.spectrum import Spectrum
    from tomopose.trajectory.scan import Wave

EPILOG = (
    "Examples: tomopose plan scan --shape triangle --views 900 --calibration cal/calibration.json --out scan.csv\n\n"
    "tomopose plan scan --part part.stl --material Al --kv 150 --views 100 --scanner scanner.json --limits limits.toml "
    "--features plan.toml --commands pi-gcs --out scan.csv"
)

SHAPES = ("circular", "triangle", "sine")
VIEWS, VIEWS_OF_A_PART = 900, 100
DEFAULT_KV = 150.0
"""Tube voltage where a material's name is all that is given: a common setting for parts of a few centimetres."""


@dataclass(frozen=True, kw_only=True)
class ShapeOptions:
    """A scan along one of the usual paths."""

    shape: Annotated[
        str | None, typer.Option("--shape", help="circular, triangle (eq. 11) or sine (paper sec. 6.1).")
    ] = None
    amplitude: Annotated[
        float | None, typer.Option("--amplitude-deg", help="Amplitude of the tilt; paper: 8 and 4.")
    ] = None
    periods: Annotated[int, typer.Option("--periods", min=1, help="Periods of the tilt in one turn.")] = 7
    offset: Annotated[float | None, typer.Option("--offset-deg", help="Offset of the sine; paper: 1.")] = None
    object_radius: Annotated[
        float | None, typer.Option("--object-radius-mm", help="Upright cylinder that must stay in view (with height).")
    ] = None
    object_height: Annotated[
        float | None, typer.Option("--object-height-mm", help="Height of that cylinder, centred.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class PartOptions:
    """A scan planned from the part."""

    part: Annotated[
        Path | None, typer.Option("--part", help="STL, PLY, OBJ or STEP of the part, mm in W at home: plan for it.")
    ] = None
    scanner: Annotated[Path | None, typer.Option("--scanner", help="scanner.json; else the calibration's.")] = None
    material: Annotated[str | None, typer.Option("--material", help="What the part is made of, such as Al.")] = None
    mu: Annotated[
        float | None,
        typer.Option("--mu-per-mm", help="Attenuation of the part as a volume shows it, 1/mm, in place of --material."),
    ] = None
    kv: Annotated[
        float | None,
        typer.Option("--kv", help=f"Tube voltage for --material (mean energy); {DEFAULT_KV:g} unless given."),
    ] = None
    scene: Annotated[Path | None, typer.Option("--scene", help="scene.toml whose beam is meant, in place of --kv.")] = (
        None
    )
    limits: Annotated[
        Path | None, typer.Option("--limits", help="limits.toml: travel, times, keep-outs; else +-10 mm, +-5 deg.")
    ] = None
    features: Annotated[
        Path | None, typer.Option("--features", help="Measurement plan whose features count; else the whole surface.")
    ] = None
    commands: Annotated[
        str | None,
        typer.Option("--commands", help="Also write the machine's own list: pi-gcs, kuka-krl, abb-rapid or ur-script."),
    ] = None
    least_transmission: Annotated[
        float, typer.Option("--least-transmission", help="Least transmission of a ray that shows a surface.")
    ] = 0.05
    least_view_transmission: Annotated[
        float, typer.Option("--least-view-transmission", help="Least mean transmission of a view; 0 admits all.")
    ] = 0.0
    tangent: Annotated[
        float, typer.Option("--tangent-deg", help="Largest angle to the tangent plane at which a ray shows a surface.")
    ] = 1.5
    tuy: Annotated[float, typer.Option("--tuy-deg", help="Soft width of the completeness.")] = 3.0
    margin: Annotated[
        float, typer.Option("--margin-px", help="Distance that the part keeps from the panel's edge.")
    ] = 2.0
    quanta: Annotated[
        float, typer.Option("--quanta", help="X-ray quanta in an open pixel, for the predicted uncertainty.")
    ] = 20_000.0
    blur: Annotated[float, typer.Option("--blur-px", help="Standard width of the unsharpness at the panel.")] = 0.5
    sweeps: Annotated[
        int, typer.Option("--sweeps", min=1, help="Sweeps of SART that the predicted uncertainty is for.")
    ] = 1
    room: Annotated[
        float, typer.Option("--room-mm", help="By how much the reconstructed box exceeds the part on each side.")
    ] = 5.0
    uncertainty: Annotated[
        str,
        typer.Option(
            "--uncertainty",
            help="How lengths are predicted: filters (seconds), exact (SART's own steps, a reconstruction for each "
            "length) or drawn (scans with drawn noise, a reconstruction for each; knows the beam of --kv or --scene).",
        ),
    ] = "filters"
    draws: Annotated[int, typer.Option("--draws", min=10, help="Scans that are drawn for --uncertainty drawn.")] = 100
    manipulator: Annotated[
        Path | None,
        typer.Option("--manipulator", help="hexapod.json or robot.json: its legs or joints keep to their stroke."),
    ] = None
    continuous: Annotated[
        bool, typer.Option("--continuous", help="Views on one smooth turn, without stops; also writes scan.way.csv.")
    ] = False
    placing: Annotated[bool, typer.Option("--placing", help="Also search how to place the part on the plate.")] = False
    seed: Annotated[int, typer.Option("--seed", help="Random seed for the points of the whole surface.")] = 0


@dataclass(frozen=True, kw_only=True)
class Options(ShapeOptions, PartOptions, WritingOptions):
    """The options of `tomopose plan scan`."""

    out: Annotated[Path, typer.Option("--out", help="scan.csv to write.")]
    views: Annotated[
        int | None, typer.Option("--views", min=1, help=f"Number of projections; {VIEWS}, of a part {VIEWS_OF_A_PART}.")
    ] = None
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.json: the mount; without it R_z(180 deg).")
    ] = None


def scan(options: Options) -> int:
    """Write the poses of a scan: along a usual path (eqs. 10 and 11), or planned from the part.

    --shape: the table turns once while the object is tilted about y_W. With a calibration and the object's size the
    views are checked against the field of view, and the completeness of the source path (Tuy's condition) is stated.

    --part: as many views as wanted are chosen from all table angles and plate poses that the limits allow, so that rays
    graze the part's features, planes are crossed by the source and the part is transmitted. Beside scan.csv come
    scan.json, with a bound on what any choice could reach and the same figures of the usual paths, and scan.html.
    """
    o = options
    if (o.shape is None) == (o.part is None):
        raise typer.BadParameter("give --shape for a usual path, or --part for a planned one", param_hint="--shape")
    return _shaped(o) if o.part is None else _planned(o)


def _wave(o: Options) -> Wave | None:
    """The tilt over the table angle; None for the circular scan."""
    from tomopose.trajectory.tilt import sine_wave, triangle_wave

    if o.shape == "circular":
        return None
    if o.shape == "triangle":
        amplitude = math.radians(8.0 if o.amplitude is None else o.amplitude)
        return functools.partial(triangle_wave, amplitude=amplitude, periods=o.periods)
    if o.shape == "sine":
        amplitude = math.radians(4.0 if o.amplitude is None else o.amplitude)
        offset = math.radians(1.0 if o.offset is None else o.offset)
        return functools.partial(sine_wave, amplitude=amplitude, periods=o.periods, offset=offset)
    raise typer.BadParameter(f"{o.shape!r} is not one of {', '.join(SHAPES)}", param_hint="--shape")


def _shaped(o: Options) -> int:
    import tomopose as tp
    from tomopose.trajectory.scan import circular_scan, tilted_scan
    from tomopose.trajectory.tilt import R_HT_MOUNTED

    views = VIEWS if o.views is None else o.views
    wave = _wave(o)
    cal = None if o.calibration is None else tp.read_calibration(o.calibration)
    R_HT = R_HT_MOUNTED if cal is None else cal.T_HT.R
    pivot = None if cal is None else cal.pivot
    sequence = circular_scan(views) if wave is None else tilted_scan(views, wave, R_HT=R_HT, pivot=pivot)
    summary: dict[str, object] = {"out": o.out.name, "views": len(sequence), "shape": o.shape}
    lines = [f"{o.out}: {len(sequence)} views, {o.shape}"]
    if o.object_radius is not None and o.object_height is not None:
        share = _completeness(o, cal, sequence)
        summary["tuy_share_lowest"] = share
        lines.append(f"  in view; planes met by the source path: at the worst point {100 * share:.1f} %")
    tp.write_poses(o.out, sequence, force=o.force)
    o.say.result(summary, lines)
    return OK


def _completeness(o: Options, cal: Calibration | None, sequence: PoseSequence) -> float:
    """Lowest share of planes that the source path meets, over points of the object's cylinder."""
    import tomopose as tp
    from tomopose.trajectory.completeness import object_points, source_path, tuy_completeness
    from tomopose.trajectory.feasibility import cylinder, require_in_view

    assert o.object_radius is not None
    assert o.object_height is not None
    if cal is None:
        raise typer.BadParameter("the object's size says nothing without --calibration", param_hint="--calibration")
    matrices = tp.projection_matrices(cal, sequence)
    low, high = -o.object_height / 2, o.object_height / 2
    require_in_view(matrices.P, cylinder(o.object_radius, low, high), n_u=matrices.n_u, n_v=matrices.n_v)
    points = object_points(o.object_radius, low, high, spacing=o.object_radius / 3)
    return float(tuy_completeness(source_path(matrices), points).share.min())


def _source(o: Options) -> tuple[Spectrum, Mapping[str, Material], str]:
    """The scene's beam and materials, or those of a tube at --kv, and what it is, in words."""
    from tomopose.simulation.physics.materials import MATERIALS
    from tomopose.simulation.physics.spectrum import tube_spectrum
    from tomopose.simulation.scene.build import beam
    from tomopose.simulation.scene.scene import read_scene

    if o.scene is not None:
        return *beam(read_scene(o.scene)), o.scene.name
    kv = DEFAULT_KV if o.kv is None else o.kv
    said = "assumed: --kv was not given" if o.kv is None else "as given"
    return tube_spectrum(kv), MATERIALS, f"a tube at {kv:g} kV ({said})"


def _attenuation(o: Options) -> tuple[float, str]:
    """(mu in 1/mm, where it comes from)."""
    from tomopose.simulation.physics.materials import attenuation

    if o.mu is not None:
        if o.material is not None:
            raise typer.BadParameter("--mu-per-mm and --material say the same; give one", param_hint="--mu-per-mm")
        return o.mu, f"{o.mu:g} /mm as given"
    if o.material is None:
        raise typer.BadParameter(
            "the part's attenuation is needed: --mu-per-mm, or --material", param_hint="--material"
        )
    spectrum, materials, said = _source(o)
    mu = float(attenuation(o.material, [spectrum.mean_energy], materials=materials)[0])
    return mu, f"{mu:.4g} /mm of {o.material} at {spectrum.mean_energy:.1f} keV, the mean of {said}"


def _beam(o: Options, part: Part) -> tuple[tuple[float, float], ...]:
    """(share, 1/mm) of the energies of the beam that --kv or --scene says; empty where only mu is known."""
    from tomopose.simulation.physics.spectrum import condense

    if o.material is None or (o.kv is None and o.scene is None):
        return ()
    spectrum, materials, _ = _source(o)
    return condense(spectrum, (o.material,), [part.mesh.size], materials).of_first_material


def _settings(o: Options, mu: float, part: Part) -> PartSettings:
    from tomopose.planning.part.settings import PartSettings

    return PartSettings(
        mu=mu,
        least_transmission=o.least_transmission,
        least_view_transmission=o.least_view_transmission,
        tangent=math.radians(o.tangent),
        tuy_width=math.radians(o.tuy),
        margin=o.margin,
        quanta=o.quanta,
        blur=o.blur,
        sweeps=o.sweeps,
        room=o.room,
        uncertainty=cast("Uncertainty", o.uncertainty),
        draws=o.draws,
        beam=_beam(o, part) if o.uncertainty == "drawn" else (),
        seed=o.seed,
    )


def _scanner(o: Options, cal: Calibration | None) -> Scanner:
    import tomopose as tp
    from tomopose.calibration.projection_matrices import require_same_scanner

    given = None if o.scanner is None else tp.read_scanner(o.scanner)
    if cal is None:
        if given is None:
            raise typer.BadParameter("a scan of a part needs --scanner or --calibration", param_hint="--scanner")
        return given
    if given is not None:
        require_same_scanner(cal, given)
    return cal.scanner


def _manipulator(o: Options) -> Hexapod | SerialRobot | None:
    import tomopose as tp
    from tomopose.errors import InputError
    from tomopose.manipulator.hexapod import Hexapod

    if o.manipulator is None:
        return None
    found = tp.read_manipulator(o.manipulator)
    if isinstance(found, Hexapod) and found.leg_limits is None:
        raise InputError(f"{o.manipulator}: leg_limits_mm is missing; without it nobody knows the stroke of the legs")
    return found


def _planned(o: Options) -> int:
    import tomopose as tp
    from tomopose.files import require_absent
    from tomopose.measurement.plan import read_plan
    from tomopose.planning.part.part import read_part
    from tomopose.planning.part_scan.freedoms import best_placing, freedoms
    from tomopose.planning.part_scan.limits_file import ScanLimits, read_limits
    from tomopose.planning.part_scan.plan import plan_part_scan
    from tomopose.planning.part_scan.setting import Setting

    assert o.part is not None
    for path in _beside(o):
        require_absent(path, force=o.force)
    cal = None if o.calibration is None else tp.read_calibration(o.calibration)
    mu, source = _attenuation(o)
    part = read_part(o.part)
    setting = Setting(
        scanner=_scanner(o, cal),
        part=part,
        views=VIEWS_OF_A_PART if o.views is None else o.views,
        settings=_settings(o, mu, part),
        features=None if o.features is None else read_plan(o.features),
        limits=ScanLimits() if o.limits is None else read_limits(o.limits),
        calibration=cal,
        manipulator=_manipulator(o),
        continuous=o.continuous,
    )
    placing = None
    if o.placing:
        o.say.note("searching how to place the part")
        placing = best_placing(setting)
        setting = replace(setting, part=placing.part, features=placing.features)
    plan = plan_part_scan(setting, progress=o.say.note)
    o.say.note("trying which freedom would help most")
    _write(o, plan, source, freedoms(setting), placing)
    return OK


def _beside(o: Options) -> list[Path]:
    """scan.csv, scan.json, scan.html, the way of a continuous scan, and the machine's own list, if one is wanted."""
    paths = [o.out, o.out.with_suffix(".json"), o.out.with_suffix(".html")]
    if o.continuous:
        paths.append(o.out.with_suffix(".way.csv"))
    if o.commands is not None:
        if o.commands not in SUFFIXES:
            raise typer.BadParameter(
                f"{o.commands!r} is unknown; choose one of {', '.join(SUFFIXES)}", param_hint="--commands"
            )
        paths.append(o.out.with_suffix(SUFFIXES[o.commands]))
    return paths


def _fdk(plan: PartScanPlan) -> tuple[dict[str, object], str]:
    """(what scan.json holds, in words): whether FDK follows this path of the source."""
    from tomopose.reconstruction.choice import path_obstacle

    why = path_obstacle(plan.matrices)
    words = f"FDK is not defined along this path: {why}; reconstruct with sart" if why else "FDK follows this path"
    return {"possible": not why, "why": why}, words


def _made(o: Options) -> Provenance:
    """What the plan was made from, and what the project file says for its report."""
    from tomopose.provenance import provenance

    files = (o.part, o.scanner, o.calibration, o.limits, o.features, o.manipulator, o.scene)
    asked = arguments(views=o.views, material=o.material, kv=o.kv, mu_per_mm=o.mu)
    return provenance(inputs=[path for path in files if path is not None], arguments=asked, seed=o.seed)


def _write(o: Options, plan: PartScanPlan, attenuation: str, free: Sequence[Freedom], placing: Placing | None) -> None:
    """Write all files of a planned scan and say what it reaches."""
    import tomopose as tp
    from tomopose.files import write_json, write_text
    from tomopose.planning.commands import command_list
    from tomopose.planning.part_scan.summary import plan_document, plan_lines
    from tomopose.report.page import write_report
    from tomopose.report.pages.scan_plan_page import PartSurface, scan_plan_report

    document = plan_document(plan)
    document["attenuation"] = attenuation
    document["freedoms"] = [{"name": f.name, "J": f.J, "gain": f.gain} for f in free]
    document["fdk"], fdk = _fdk(plan)
    document["placing"] = None if placing is None else placing.document()
    mesh = plan.goal.part.mesh
    surface = PartSurface.of(mesh.points, mesh.faces, plan.goal.x, plan.chosen.seen)
    made = _made(o)
    page = scan_plan_report(cast("ScanPlanFigures", document), surface, plan.source_path, provenance=made)
    paths = _beside(o)
    units = plan.machine.joint_units
    tp.write_poses(paths[0], plan.poses, joint_units=units, force=o.force)
    write_json(paths[1], "scan-plan", {**document, "provenance": made.to_json()})
    write_report(paths[2], page)
    if plan.way is not None:
        tp.write_poses(paths[3], plan.machine.commanded(plan.way), joint_units=units, force=o.force)
    if o.commands is not None:
        write_text(paths[-1], command_list(plan.poses, o.commands))
    lines = [f"{o.out}: {len(plan)} views of {plan.goal.part.name}; attenuation {attenuation}"]
    if placing is not None:
        best = max(placing.tried, key=lambda name: placing.tried[name])
        lines.append(f"  place the part {best} ({len(placing.tried)} placings tried); the views hold for that placing")
    helps = [f"  with {f.name}: {100 * f.gain:+.0f} % of J" for f in free[:3]]
    o.say.result({"out": o.out.name, **document}, [*lines, *plan_lines(plan), f"  {fdk}", *helps])
