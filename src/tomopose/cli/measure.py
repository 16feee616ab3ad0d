"""`tomopose measure`: a measurement plan carried out on volumes, and their comparison with a reference mesh."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, USAGE, arguments
from tomopose.cli.options import WritingOptions, add_command

if TYPE_CHECKING:
    from tomopose.measurement.alignment import Alignment
    from tomopose.measurement.mesh.comparison import Comparison
    from tomopose.measurement.mesh.mesh import Mesh
    from tomopose.measurement.plan import MeasurementPlan
    from tomopose.measurement.results import MeasurementResults
    from tomopose.measurement.uncertainty import Simulated
    from tomopose.volume import Volume

EPILOG = (
    "Example: tomopose measure plan.toml --volume before=scan1.h5 --volume after=scan2.h5 --out measured\n\n"
    "Acceptance test: tomopose measure spheres.toml --volume scan.h5 --protocol --out acceptance"
)
FITS = ("none", "datum", "best-fit")
BETWEEN = ("cells", "natural")
WRITTEN = (
    *(f"comparison.{suffix}" for suffix in ("ply", "glb", "vtp", "csv", "json", "png")),
    *("report.html", "measurement.json", "measurement.csv", "uncertainty.csv"),
    *("protocol.json", "protocol.csv", "protocol.html"),
)
"""Files of an earlier run that --force removes."""


def register(app: typer.Typer) -> None:
    add_command(app, "measure", measure, epilog=EPILOG)


def named_files(items: Iterable[str], what: str, *, default: str | None = None) -> dict[str, Path]:
    """`NAME=FILE` or `FILE` as name -> path; a file without a name takes `default`, or its own stem."""
    from tomopose.errors import InputError

    files: dict[str, Path] = {}
    for item in items:
        name, separator, path = item.partition("=")
        key, file = (name, Path(path)) if separator else (Path(item).stem if default is None else default, Path(item))
        if key in files:
            raise InputError(f"two {what}s are named {key!r}; name them apart with --{what} NAME=FILE")
        files[key] = file
    return files


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose measure`."""

    plan: Annotated[Path, typer.Argument(help="Measurement plan, TOML.")]
    volume: Annotated[list[str], typer.Option("--volume", help="Volume file, or NAME=FILE; may be given repeatedly.")]
    out: Annotated[Path, typer.Option("--out", help="Folder for measurement.json, .csv and report.html.")]
    reference: Annotated[
        Path | None, typer.Option("--reference", help="STL, PLY or STEP, mm, watertight: nominal-actual comparison.")
    ] = None
    fit: Annotated[
        str, typer.Option("--fit", help="Alignment to the reference: none (as the plan says), datum or best-fit.")
    ] = "none"
    edge_mm: Annotated[
        float | None, typer.Option("--edge-mm", min=0.0, help="Divide the reference's triangles to edges this short.")
    ] = None
    probed: Annotated[
        Path | None, typer.Option("--cmm-points", help="CSV x_mm,y_mm,z_mm: shift the reference to probed points.")
    ] = None
    between: Annotated[
        str,
        typer.Option("--cmm-interpolation", help="Between probed points: cells (Voronoi) or natural (blended cells)."),
    ] = "cells"
    range_um: Annotated[float, typer.Option("--range-um", min=0.001, help="Colours are clipped at +- so much.")] = 25.0
    search_mm: Annotated[
        float | None, typer.Option("--search-mm", min=0.0, help="How far surface and reference may lie apart.")
    ] = None
    calibration: Annotated[
        list[str] | None,
        typer.Option("--calibration", help="calibration.json, or VOLUME=FILE: its share in the uncertainty."),
    ] = None
    poses: Annotated[
        list[str] | None, typer.Option("--poses", help="The scan's poses.csv, or VOLUME=FILE; with --calibration.")
    ] = None
    scene: Annotated[
        Path | None, typer.Option("--simulate", help="scene.toml of the nominal object's scan: uncertainty by draws.")
    ] = None
    draws: Annotated[int, typer.Option("--draws", min=3, help="Virtual scans for --simulate.")] = 20
    protocol: Annotated[
        bool,
        typer.Option("--protocol", help="Fill the acceptance protocol of VDI/VDE 2630-1.3: a plan with [spheres]."),
    ] = False
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed for the virtual scans.")] = 0
    coarser: Annotated[
        float, typer.Option("--simulate-voxel", min=1.0, help="Voxels of virtual scans, in those of the volume.")
    ] = 1.0

    def usage_faults(self) -> list[str]:
        """What is wrong with the options by themselves."""
        found = []
        if self.fit not in FITS:
            found.append(f"--fit is {', '.join(FITS)}")
        if self.between not in BETWEEN:
            found.append(f"--cmm-interpolation is {', '.join(BETWEEN)}")
        if bool(self.calibration) != bool(self.poses):
            found.append("--calibration and --poses belong together")
        return found

    def recorded(self) -> dict[str, object]:
        """What the provenance keeps."""
        return arguments(
            fit=self.fit,
            range_um=self.range_um,
            search_mm=self.search_mm,
            edge_mm=self.edge_mm,
            cmm_interpolation=self.between if self.probed else None,
            draws=self.draws if self.scene else None,
            simulate_voxel=self.coarser if self.scene else None,
        )


def measure(options: Options) -> int:
    """Measure lengths, form and deviations in one or more volumes, beside calibrated values and permissible errors.

    The uncertainty comes from the fit, from repeats that the plan names, from a calibration's covariance, from virtual
    scans and from what the plan states, each by itself and together. Exit code 3 where a limit is exceeded by more than
    the uncertainty.
    """
    from dataclasses import replace

    from tomopose.files import atomic_folder, require_absent
    from tomopose.io.volume_files import read_volume
    from tomopose.measurement.acceptance.protocol import tested_spheres
    from tomopose.measurement.measure import measure as carry_out
    from tomopose.measurement.plan import read_plan
    from tomopose.measurement.results import write_results
    from tomopose.provenance import provenance
    from tomopose.report.page import write_report
    from tomopose.report.pages.measurement_page import measurement_report

    o, say = options, options.say
    faults = o.usage_faults()
    if faults:
        say.note("; ".join(faults))
        return USAGE
    for name in ("report.html", "measurement.json"):
        require_absent(o.out / name, force=o.force)
    plan = read_plan(o.plan)
    if o.protocol:
        tested_spheres(plan)
    files = named_files(o.volume, "volume")
    mesh = None if o.reference is None else reference_of(o.reference, o.edge_mm, o.probed, o.between)
    volumes = {name: read_volume(file) for name, file in files.items()}
    calibrations, scans = (
        named_files(x or (), w, default="") for x, w in ((o.calibration, "calibration"), (o.poses, "poses"))
    )
    given = [o.plan, *files.values(), *calibrations.values(), *scans.values()]
    made = provenance(
        inputs=[*given, *(p for p in (o.reference, o.probed, o.scene) if p is not None)],
        seed=o.seed if o.scene else None,
        arguments=o.recorded(),
    )
    with say.progress("measuring") as progress:
        results = carry_out(volumes, plan, provenance=made, progress=progress)
    if calibrations:
        results = replace(results, calibration_u=calibration_u(results, plan, calibrations, scans))
    if o.scene is not None:
        results = replace(results, simulated=simulated(o, o.scene, plan, next(iter(volumes.values())), calibrations))
    comparisons: dict[str, Comparison] = {}
    with atomic_folder(o.out, force=o.force, stale=WRITTEN) as folder:
        if mesh is not None:
            comparisons = {
                n: compared(v, mesh, results.alignments[n], fit=o.fit, search_mm=o.search_mm)
                for n, v in volumes.items()
            }
        for name, one in comparisons.items():
            write_comparison_to(folder / name if len(volumes) > 1 else folder, one, o.range_um / 1000, name)
        protocols = protocols_of(o, results, plan, folder)
        write_results(folder, results, force=True)
        page = measurement_report(results, comparisons=comparisons, range_mm=o.range_um / 1000)
        write_report(folder / "report.html", page)
    summary, lines = told(o.out, results, comparisons)
    summary["protocols"] = protocols
    say.result(summary, [*lines, *(f"  protocol of {v}: {_in_words(d)}" for v, d in protocols.items())])
    failed = any("not conforming" in d.values() for d in protocols.values())
    return NOT_TRUSTWORTHY if failed or results.out_of_limits else OK


def protocols_of(
    o: Options, results: MeasurementResults, plan: MeasurementPlan, out: Path
) -> dict[str, dict[str, str]]:
    """Acceptance protocols written into a folder that is being made: volume -> quantity -> decision."""
    if not o.protocol:
        return {}
    from tomopose.measurement.acceptance.protocol import DEFINITIONS, acceptance_protocol, write_protocol
    from tomopose.report.page import write_report
    from tomopose.report.pages.protocol_page import protocol_report

    made = {name: acceptance_protocol(results, plan, name) for name in results.volumes}
    found: dict[str, dict[str, str]] = {}
    for name, protocol in made.items():
        folder = out / name if len(made) > 1 else out
        write_protocol(folder, protocol, force=True)
        write_report(folder / "protocol.html", protocol_report(protocol))
        decisions = {q: protocol.decision(q) for q in DEFINITIONS}
        found[name] = {q: "no limit" if d is None else d.value for q, d in decisions.items()}
    return found


def _in_words(decisions: Mapping[str, str]) -> str:
    return ", ".join(f"{quantity} {decision}" for quantity, decision in decisions.items())


def reference_of(path: Path, edge_mm: float | None, probed: Path | None, between: str) -> Mesh:
    """The reference mesh, of smaller triangles and corrected by probed points where that is asked for."""
    from tomopose.measurement.mesh.cmm_correction import corrected_reference, read_probed_points
    from tomopose.measurement.mesh.mesh_files import read_mesh
    from tomopose.measurement.mesh.refine import refined

    mesh = read_mesh(path)
    if edge_mm is not None:
        mesh = refined(mesh, edge_mm)
    if probed is None:
        return mesh
    return corrected_reference(mesh, read_probed_points(probed), interpolation=between)  # type: ignore[arg-type]


def compared(volume: Volume, mesh: Mesh, alignment: Alignment, *, fit: str, search_mm: float | None) -> Comparison:
    """The comparison, from the alignment that the plan gave."""
    from tomopose.errors import InputError
    from tomopose.measurement.mesh.comparison import compare

    if fit == "datum" and not alignment.rule.startswith("datum"):
        raise InputError('--fit datum needs a plan with [alignment] kind = "datum" and three datums')
    return compare(
        volume, mesh, alignment=alignment, fit="best-fit" if fit == "best-fit" else "none", search_mm=search_mm
    )


def write_comparison_to(folder: Path, comparison: Comparison, range_mm: float, name: str) -> None:
    """Mesh files, tables and the picture of one comparison, into a folder that is being made."""
    from tomopose.files import atomic_file
    from tomopose.measurement.mesh.comparison_files import write_comparison
    from tomopose.report.figures.measurement_png import comparison_png

    write_comparison(folder, comparison, range_mm=range_mm, force=True)
    with atomic_file(folder / "comparison.png") as temporary:
        temporary.write_bytes(comparison_png(comparison, range_mm=range_mm, title=name))


def calibration_u(
    results: MeasurementResults, plan: MeasurementPlan, calibrations: dict[str, Path], scans: dict[str, Path]
) -> dict[str, dict[str, float]]:
    """Volume -> measurand -> standard uncertainty from its calibration; the file without a name serves all others."""
    import tomopose as tp
    from tomopose.errors import InputError
    from tomopose.uncertainty.calibration_share import calibration_shares

    unknown = sorted(({*calibrations, *scans} - {""}) - set(results.volumes))
    if unknown:
        raise InputError(f"no volume is named {', '.join(unknown)}; known: {', '.join(results.volumes)}")
    found = {}
    for name in results.volumes:
        file, scan = (x.get(name, x.get("")) for x in (calibrations, scans))
        if file is not None and scan is not None:
            found[name] = dict(calibration_shares(results, plan, name, tp.read_calibration(file), tp.read_poses(scan)))
    return found


def simulated(
    o: Options, scene: Path, plan: MeasurementPlan, volume: Volume, calibrations: dict[str, Path]
) -> Mapping[str, Simulated]:
    """Errors over virtual scans on the volume's own grid, or a coarser one over the same box."""
    import tomopose as tp
    from tomopose.cli.simulated import run_of
    from tomopose.uncertainty.virtual_scans import simulated_errors

    run = run_of(tp.read_scene(scene), scene)
    file = next(iter(calibrations.values()), None)
    grid = volume.grid
    n_z, n_y, n_x = (max(round(n / o.coarser), 2) for n in grid.shape)
    box = tp.VoxelGrid(shape=(n_z, n_y, n_x), spacing=grid.spacing * o.coarser, centre=grid.centre)
    with o.say.progress("virtual scans") as progress:
        return simulated_errors(
            run,
            plan,
            box,
            draws=o.draws,
            seed=o.seed,
            progress=progress,
            calibration=None if file is None else tp.read_calibration(file),
        )


def told(
    out: Path, results: MeasurementResults, comparisons: Mapping[str, Comparison]
) -> tuple[dict[str, Any], list[str]]:
    """The summary for programs, and its lines for people."""
    from tomopose.measurement.conformity import Decision

    beyond, open_ = results.decided(Decision.NOT_CONFORMING), results.decided(Decision.NOT_DECIDABLE)
    judged = len(beyond) + len(open_) + len(results.decided(Decision.CONFORMING))
    lines = [
        f"{out}: {len(results)} results of {len(results.volumes)} volume(s); "
        + (
            f"of {judged} with a limit {judged - len(beyond) - len(open_)} conform, {len(beyond)} do not and "
            f"{len(open_)} cannot be decided"
            if judged
            else "no limits given"
        )
    ]
    for b in [*beyond[:10], *open_[:10]]:
        scale, unit = (1000.0, "um") if b.unit == "mm" else (1e6, "urad")
        lines.append(
            f"  {b.decision.value if b.decision else ''}: {b.volume} {b.name}: error {scale * (b.error or 0.0):+.2f} "
            f"+- {scale * b.U_error:.2f} {unit}"
        )
    summary = {
        "out": out.name,
        "results": len(results),
        "volumes": list(results.volumes),
        "judged": judged,
        "beyond_limits": [b.name for b in beyond],
        "not_decidable": [b.name for b in open_],
        "scale": dict(results.scale),
        "alignments": {n: a.to_json() for n, a in results.alignments.items()},
        "comparisons": {n: c.to_json() for n, c in comparisons.items()},
    }
    return summary, lines
