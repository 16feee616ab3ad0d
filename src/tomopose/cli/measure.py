"""`tomopose measure`: a measurement plan carried out on volumes, and their comparison with a reference mesh."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import OK, USAGE, ForceOption, JsonOption, QuietOption, Say, arguments

EPILOG = "Example: tomopose measure plan.toml --volume before=scan1.h5 --volume after=scan2.h5 --out measured"
FITS = ("none", "datum", "best-fit")
BETWEEN = ("cells", "natural")


def register(app: typer.Typer) -> None:
    app.command("measure", epilog=EPILOG)(measure)


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


def measure(
    plan: Annotated[Path, typer.Argument(help="Measurement plan, TOML.")],
    volume: Annotated[list[str], typer.Option("--volume", help="Volume file, or NAME=FILE; may be given repeatedly.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for measurement.json, .csv and report.html.")],
    reference: Annotated[
        Path | None, typer.Option("--reference", help="STL, PLY or STEP, mm, watertight: nominal-actual comparison.")
    ] = None,
    fit: Annotated[
        str, typer.Option("--fit", help="Alignment to the reference: none (as the plan says), datum or best-fit.")
    ] = "none",
    edge_mm: Annotated[
        float | None, typer.Option("--edge-mm", min=0.0, help="Divide the reference's triangles to edges this short.")
    ] = None,
    probed: Annotated[
        Path | None, typer.Option("--cmm-points", help="CSV x_mm,y_mm,z_mm: shift the reference to probed points.")
    ] = None,
    between: Annotated[
        str,
        typer.Option("--cmm-interpolation", help="Between probed points: cells (Voronoi) or natural (blended cells)."),
    ] = "cells",
    range_um: Annotated[float, typer.Option("--range-um", min=0.001, help="Colours are clipped at +- so much.")] = 25.0,
    search_mm: Annotated[
        float | None, typer.Option("--search-mm", min=0.0, help="How far surface and reference may lie apart.")
    ] = None,
    calibration: Annotated[
        list[str] | None,
        typer.Option("--calibration", help="calibration.json, or VOLUME=FILE: its share in the uncertainty."),
    ] = None,
    poses: Annotated[
        list[str] | None, typer.Option("--poses", help="The scan's poses.csv, or VOLUME=FILE; with --calibration.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option("--simulate", help="scene.toml of the nominal object's scan: uncertainty by draws.")
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=3, help="Virtual scans for --simulate.")] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the virtual scans.")] = 0,
    coarser: Annotated[
        float, typer.Option("--simulate-voxel", min=1.0, help="Voxels of virtual scans, in those of the volume.")
    ] = 1.0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Measure lengths, form and deviations in one or more volumes, beside calibrated values and permissible errors.

    The uncertainty comes from the fit, from repeats that the plan names, from a calibration's covariance and from
    virtual scans, each told apart and together.
    """
    from dataclasses import replace

    from tomopose.files import atomic_folder, require_absent
    from tomopose.io.volume_files import read_volume
    from tomopose.measurement.measure import measure as carry_out
    from tomopose.measurement.mesh.comparison_files import FILES
    from tomopose.measurement.plan import read_plan
    from tomopose.measurement.results import write_results
    from tomopose.provenance import provenance
    from tomopose.report.page import write_report
    from tomopose.report.pages.measurement_page import measurement_report

    say = Say(json=as_json, quiet=quiet)
    if fit not in FITS:
        say.note(f"--fit is {', '.join(FITS)}")
        return USAGE
    if between not in BETWEEN:
        say.note(f"--cmm-interpolation is {', '.join(BETWEEN)}")
        return USAGE
    if bool(calibration) != bool(poses):
        say.note("--calibration and --poses belong together")
        return USAGE
    for name in ("report.html", "measurement.json"):
        require_absent(out / name, force=force)
    wanted = read_plan(plan)
    files = named_files(volume, "volume")
    mesh = None if reference is None else reference_of(reference, edge_mm, probed, between)
    volumes = {name: read_volume(file) for name, file in files.items()}
    calibrations, scans = (
        named_files(x or (), w, default="") for x, w in ((calibration, "calibration"), (poses, "poses"))
    )
    given = [plan, *files.values(), *calibrations.values(), *scans.values()]
    made = provenance(
        inputs=[*given, *(p for p in (reference, probed, scene) if p is not None)],
        seed=seed if scene else None,
        arguments=arguments(
            fit=fit,
            range_um=range_um,
            search_mm=search_mm,
            edge_mm=edge_mm,
            cmm_interpolation=between if probed else None,
            draws=draws if scene else None,
            simulate_voxel=coarser if scene else None,
        ),
    )
    with say.progress("measuring") as progress:
        results = carry_out(volumes, wanted, provenance=made, progress=progress)
    if calibrations:
        results = replace(results, calibration_u=calibration_u(results, wanted, calibrations, scans))
    if scene is not None:
        with say.progress("virtual scans") as progress:
            drawn = simulated(
                scene,
                wanted,
                next(iter(volumes.values())),
                calibrations,
                draws=draws,
                seed=seed,
                coarser=coarser,
                progress=progress,
            )
        results = replace(results, simulated=drawn)
    comparisons = {}
    old = (*FILES, "comparison.png", "report.html", "measurement.json", "measurement.csv", "uncertainty.csv")
    with atomic_folder(out, force=force, stale=old) as folder:
        if mesh is not None:
            for name, one in volumes.items():
                comparisons[name] = compared(one, mesh, results.alignments[name], fit=fit, search_mm=search_mm)
                place = folder / name if len(volumes) > 1 else folder
                write_comparison_to(place, comparisons[name], range_um / 1000, name)
        write_results(results, folder, force=True)
        page = measurement_report(results, comparisons=comparisons, range_mm=range_um / 1000)
        write_report(folder / "report.html", page)
    say.result(*told(out, results, comparisons))
    return OK


def reference_of(path: Path, edge_mm: float | None, probed: Path | None, between: str) -> Any:
    """The reference mesh, of smaller triangles and corrected by probed points where that is asked for."""
    from tomopose.measurement.mesh.cmm_correction import corrected_reference, read_probed_points
    from tomopose.measurement.mesh.mesh import read_mesh
    from tomopose.measurement.mesh.refine import refined

    mesh = read_mesh(path)
    if edge_mm is not None:
        mesh = refined(mesh, edge_mm)
    if probed is None:
        return mesh
    return corrected_reference(mesh, read_probed_points(probed), interpolation=between)  # type: ignore[arg-type]


def compared(volume: Any, mesh: Any, alignment: Any, *, fit: str, search_mm: float | None) -> Any:
    """The comparison, from the alignment that the plan gave."""
    from tomopose.errors import InputError
    from tomopose.measurement.mesh.comparison import compare

    if fit == "datum" and not alignment.rule.startswith("datum"):
        raise InputError('--fit datum needs a plan with [alignment] kind = "datum" and three datums')
    return compare(
        volume, mesh, alignment=alignment, fit="best-fit" if fit == "best-fit" else "none", search_mm=search_mm
    )


def write_comparison_to(folder: Path, comparison: Any, range_mm: float, name: str) -> None:
    """Mesh files, tables and the picture of one comparison, into a folder that is being made."""
    from tomopose.files import atomic_file
    from tomopose.measurement.mesh.comparison_files import write_comparison
    from tomopose.report.figures.measurement_png import comparison_png

    write_comparison(comparison, folder, range_mm=range_mm, force=True)
    with atomic_file(folder / "comparison.png") as temporary:
        temporary.write_bytes(comparison_png(comparison, range_mm=range_mm, title=name))


def calibration_u(
    results: Any, plan: Any, calibrations: dict[str, Path], scans: dict[str, Path]
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
    scene: Path,
    plan: Any,
    volume: Any,
    calibrations: dict[str, Path],
    *,
    draws: int,
    seed: int,
    coarser: float,
    progress: Any,
) -> Any:
    """Errors over virtual scans on the volume's own grid, or a coarser one over the same box."""
    import tomopose as tp
    from tomopose.cli.simulated import run_of
    from tomopose.uncertainty.virtual_scans import simulated_errors

    run = run_of(tp.read_scene(scene), scene)
    file = next(iter(calibrations.values()), None)
    grid = volume.grid
    shape = tuple(max(round(n / coarser), 2) for n in grid.shape)
    box = tp.VoxelGrid(shape=shape, spacing=grid.spacing * coarser, centre=grid.centre)
    return simulated_errors(
        run,
        plan,
        box,
        draws=draws,
        seed=seed,
        progress=progress,
        calibration=None if file is None else tp.read_calibration(file),
    )


def told(out: Path, results: Any, comparisons: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The summary for programs, and its lines for people."""
    beyond = results.out_of_limits
    judged = sum(r.within is not None for r in results.results)
    lines = [
        f"{out}: {len(results)} results of {len(results.volumes)} volume(s); "
        + (f"{len(beyond)} of {judged} beyond their limit" if judged else "no limits given")
    ]
    lines += [
        f"  {r.volume} {r.name}: {r.value:.5f} {r.unit}, error {1000 * (r.error or 0.0):+.2f} um, limit "
        f"{1000 * (r.limit or 0.0):.2f} um"
        for r in beyond[:10]
    ]
    summary = {
        "out": out.name,
        "results": len(results),
        "volumes": list(results.volumes),
        "judged": judged,
        "beyond_limits": [r.name for r in beyond],
        "scale": dict(results.scale),
        "alignments": {n: a.to_json() for n, a in results.alignments.items()},
        "comparisons": {n: c.to_json() for n, c in comparisons.items()},
    }
    return summary, lines
