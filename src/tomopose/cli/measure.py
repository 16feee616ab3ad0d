"""`tomopose measure`: a measurement plan carried out on volumes, and their comparison with a reference mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tomopose.cli.common import OK, USAGE, ForceOption, JsonOption, QuietOption, Say, arguments

EPILOG = "Example: tomopose measure plan.toml --volume before=scan1.h5 --volume after=scan2.h5 --out measured"


def register(app: typer.Typer) -> None:
    app.command("measure", epilog=EPILOG)(measure)


def measure(
    plan: Annotated[Path, typer.Argument(help="Measurement plan, TOML.")],
    volume: Annotated[list[str], typer.Option("--volume", help="Volume file, or NAME=FILE; may be given repeatedly.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for measurement.json, .csv and report.html.")],
    reference: Annotated[
        Path | None, typer.Option("--reference", help="STL or PLY, mm, watertight: nominal-actual comparison.")
    ] = None,
    fit: Annotated[str, typer.Option("--fit", help="Alignment to the reference: none or best-fit.")] = "none",
    range_um: Annotated[float, typer.Option("--range-um", min=0.001, help="Colours are clipped at +- so much.")] = 25.0,
    search_mm: Annotated[
        float | None, typer.Option("--search-mm", min=0.0, help="How far surface and reference may lie apart.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Measure lengths, form and deviations in one or more volumes, beside calibrated values and permissible errors."""
    from tomopose.errors import InputError
    from tomopose.files import require_absent
    from tomopose.io.volume_files import read_volume
    from tomopose.measurement.comparison import compare
    from tomopose.measurement.measure import measure as carry_out
    from tomopose.measurement.mesh_files import write_comparison
    from tomopose.measurement.meshes import read_mesh
    from tomopose.measurement.plan import read_plan
    from tomopose.measurement.results import write_results
    from tomopose.provenance import provenance
    from tomopose.report.measurement_page import measurement_report
    from tomopose.report.page import write_report

    say = Say(json=as_json, quiet=quiet)
    if fit not in ("none", "best-fit"):
        say.note("--fit is none or best-fit")
        return USAGE
    page = require_absent(out / "report.html", force=force)
    require_absent(out / "measurement.json", force=force)
    wanted = read_plan(plan)
    files: dict[str, Path] = {}
    for item in volume:
        name, separator, path = item.partition("=")
        key, file = (name, Path(path)) if separator else (Path(item).stem, Path(item))
        if key in files:
            raise InputError(f"two volumes are named {key!r}; name them apart with --volume NAME=FILE")
        files[key] = file
    mesh = None if reference is None else read_mesh(reference)
    volumes = {name: read_volume(file) for name, file in files.items()}
    made = provenance(
        inputs=[plan, *files.values(), *([reference] if reference else [])],
        arguments=arguments(fit=fit, range_um=range_um, search_mm=search_mm),
    )
    with say.progress("measuring") as progress:
        results = carry_out(volumes, wanted, provenance=made, progress=progress)
    comparisons = {}
    if mesh is not None:
        for name, one in volumes.items():
            comparisons[name] = compare(one, mesh, fit="best-fit" if fit == "best-fit" else "none", search_mm=search_mm)
            write_comparison(comparisons[name], out / name if len(volumes) > 1 else out, range_mm=range_um / 1000,
                             force=force)
    write_results(results, out, force=force)
    write_report(page, measurement_report(results, comparisons=comparisons, range_mm=range_um / 1000))
    beyond = results.out_of_limits
    judged = sum(r.within is not None for r in results.results)
    lines = [f"{out}: {len(results)} results of {len(results.volumes)} volume(s); "
             + (f"{len(beyond)} of {judged} beyond their limit" if judged else "no limits given")]
    lines += [f"  {r.volume} {r.name}: {r.value:.5f} {r.unit}, error {1000 * (r.error or 0.0):+.2f} um, limit "
              f"{1000 * (r.limit or 0.0):.2f} um" for r in beyond[:10]]
    summary = {"out": out.name, "results": len(results), "volumes": list(results.volumes), "judged": judged,
               "beyond_limits": [r.name for r in beyond], "scale": dict(results.scale),
               "comparisons": {n: c.to_json() for n, c in comparisons.items()}}
    say.result(summary, lines)
    return OK
