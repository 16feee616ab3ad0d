"""`tomopose reconstruct`: matrices and radiographs to a volume, with pictures of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import (
    OK,
    DarkOption,
    DaskOption,
    DatasetOption,
    FlatOption,
    ForceOption,
    JsonOption,
    QuietOption,
    RawOption,
    RowsOption,
    Say,
    arguments,
    names,
)

EPILOG = (
    "Example: tomopose reconstruct --matrices matrices.npz --images scan/ --images-are transmission --voxel-mm 0.1 "
    "--size 512 --out volume.h5"
)

PICTURES = ("slice_z", "slice_y", "slice_x", "maximum")


def register(app: typer.Typer) -> None:
    app.command("reconstruct", epilog=EPILOG)(reconstruct)


def grid_size(text: str) -> tuple[int, int, int]:
    """`512` or `512,512,300` (x, y, z) as the array's shape (z, y, x)."""
    parts = names(text)
    if len(parts) not in (1, 3) or not all(p.isdigit() and int(p) > 0 for p in parts):
        raise typer.BadParameter(f"{text!r} is neither N nor NX,NY,NZ", param_hint="--size")
    x, y, z = (int(p) for p in (parts * 3 if len(parts) == 1 else parts))
    return z, y, x


def point(text: str) -> tuple[float, float, float]:
    """`X,Y,Z` as numbers."""
    try:
        x, y, z = (float(part) for part in names(text))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not X,Y,Z", param_hint="--centre-mm") from None
    return x, y, z


def polynomial(scene: Path | None, material: str | None, thickness: float | None) -> tuple[float, ...]:
    """Coefficients that take a scene's polychromatic line integrals through a material to monochromatic ones."""
    if scene is None and material is None and thickness is None:
        return ()
    if scene is None or material is None or thickness is None:
        raise typer.BadParameter(
            "beam hardening needs all three of --scene, --material and --thickness-mm", param_hint="--material"
        )
    import tomopose as tp
    from tomopose.reconstruction import beam_hardening_polynomial
    from tomopose.simulation.physics.materials import attenuation
    from tomopose.simulation.scene.build import beam

    spectrum, materials = beam(tp.read_scene(scene))
    mu = attenuation(material, spectrum.energy, materials=materials)
    return beam_hardening_polynomial(spectrum.energy, spectrum.weight, mu, thickness_mm=thickness)


def reconstruct(
    matrices: Annotated[Path, typer.Option("--matrices", help="matrices.npz of the scan.")],
    images: Annotated[str, typer.Option("--images", help="Folder, glob or multi-page file of the scan's images.")],
    voxel: Annotated[float, typer.Option("--voxel-mm", help="Voxel side, mm.")],
    size: Annotated[str, typer.Option("--size", help="Voxels along each axis, N or NX,NY,NZ.")],
    out: Annotated[Path, typer.Option("--out", help="volume.h5 (also .nrrd, .mhd, .tif).")],
    centre: Annotated[str, typer.Option("--centre-mm", help="Middle of the volume in W, X,Y,Z.")] = "0,0,0",
    images_are: Annotated[
        str | None, typer.Option("--images-are", help="counts, transmission or line-integrals; never guessed.")
    ] = None,
    white: Annotated[
        float | None, typer.Option("--white", help="Grey value of the open beam, for counts without --flat.")
    ] = None,
    dark: DarkOption = None,
    flat: FlatOption = None,
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="scanner.json, for the row order and size of the image files.")
    ] = None,
    dataset: DatasetOption = None,
    rows: RowsOption = None,
    raw: RawOption = None,
    engine: Annotated[str, typer.Option("--engine", help="auto, cpu, rtk, astra or reference.")] = "auto",
    algorithm: Annotated[
        str, typer.Option("--algorithm", help="fdk+sart, sart, ossart, fdk, fdk-preview or cgls.")
    ] = "fdk+sart",
    paper: Annotated[bool, typer.Option("--paper", help="As the paper: one SART iteration, relaxation 0.8.")] = False,
    iterations: Annotated[int | None, typer.Option("--iterations", min=1, help="Sweeps over all views.")] = None,
    relaxation: Annotated[float, typer.Option("--relaxation", help="Above 0 and below 2.")] = 0.8,
    order: Annotated[str, typer.Option("--order", help="golden, sequential or random.")] = "golden",
    seed: Annotated[int, typer.Option("--seed", help="Of the random order.")] = 0,
    subset_size: Annotated[int | None, typer.Option("--subset-size", min=1, help="Views in one update.")] = None,
    ring_width: Annotated[
        int | None, typer.Option("--ring-width", min=1, help="Even out pixels that differ from this many neighbours.")
    ] = None,
    bad_pixels: Annotated[
        Path | None, typer.Option("--bad-pixels", help="Image that is not 0 where a pixel is to be left out.")
    ] = None,
    exclude: Annotated[
        bool, typer.Option("--exclude-invalid", help="Leave NaN and dark pixels out of their view, not refuse them.")
    ] = False,
    scene: Annotated[
        Path | None,
        typer.Option(
            "--scene",
            help="scene.toml whose source and detector made the images, with --material: beam hardening is taken out.",
        ),
    ] = None,
    material: Annotated[str | None, typer.Option("--material", help="What the object is made of.")] = None,
    thickness: Annotated[float | None, typer.Option("--thickness-mm", help="Longest way through the object.")] = None,
    mask: Annotated[
        Path | None, typer.Option("--mask", help="Volume on the same grid that is not 0 where there may be material.")
    ] = None,
    nonnegative: Annotated[bool, typer.Option("--nonnegative", help="Keep attenuation at 0 or above.")] = False,
    memory: Annotated[float | None, typer.Option("--memory-gib", help="Keep within this much memory.")] = None,
    scratch: Annotated[
        Path | None, typer.Option("--scratch", help="Folder for the slabs of a volume that does not fit the memory.")
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option("--checkpoint", help="Folder to keep the state in; a second run goes on from there.")
    ] = None,
    dask: DaskOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Reconstruct a scan along any path, on the CPU or through another engine.

    The volume lies in W, object at home.  How well each view agrees with the volume is stated: a wrong trajectory shows
    there without any reference part.
    """
    from dataclasses import replace

    import numpy as np

    import tomopose as tp
    from tomopose.cli.job import executor_of, image_source, open_for
    from tomopose.errors import InputError
    from tomopose.files import atomic_file, require_absent
    from tomopose.provenance import provenance
    from tomopose.reconstruction import PAPER
    from tomopose.report import volume_pictures, volume_report, write_report

    say = Say(json=as_json, quiet=quiet)
    grid = tp.VoxelGrid(shape=grid_size(size), spacing=voxel, centre=np.array(point(centre)))
    coefficients = polynomial(scene, material, thickness)
    target = require_absent(out, force=force)
    shown = {name: require_absent(out.with_name(f"{out.stem}_{name}.png"), force=force) for name in PICTURES}
    page = require_absent(out.with_name(f"{out.stem}.html"), force=force)
    P = tp.read_matrices(matrices)
    known = None if scanner is None else tp.read_scanner(scanner)
    stack = open_for(say, image_source(images), known, None, dark=dark, flat=flat, dataset=dataset, rows=rows, raw=raw)
    bad = None if bad_pixels is None else tp.open_images(bad_pixels, rows=stack.rows)[0] != 0
    support = None
    if mask is not None:
        allowed = tp.read_volume(mask)
        if not allowed.grid.same_as(grid):
            raise InputError(f"{mask}: its grid is not that of the volume to be made ({size} voxels of {voxel:g} mm)")
        support = allowed.values != 0
    choice: dict[str, Any] = {
        "algorithm": algorithm,
        "iterations": iterations,
        "relaxation": relaxation,
        "order": order,
        "subset_size": subset_size,
        "seed": seed,
    }
    if paper:
        choice = {**PAPER, "seed": seed}
    with say.progress("reconstructing") as progress, executor_of(dask) as client:
        volume = tp.reconstruct(
            stack,
            P,
            grid,
            engine=engine,
            nonnegative=nonnegative,
            ring_width=ring_width,
            white=white,
            mask=support,
            bad_pixels=bad,
            invalid="exclude" if exclude else "error",
            beam_hardening=coefficients,
            images_are="transmission" if flat is not None and images_are is None else images_are,
            memory_gib=memory,
            scratch=scratch,
            checkpoint=checkpoint,
            progress=progress,
            client=client,
            **choice,
        )
    made = provenance(
        inputs=[path for path in (matrices, scanner, bad_pixels, mask, scene) if path is not None],
        arguments=arguments(voxel_mm=voxel, size=size, centre_mm=centre, engine=engine, **choice),
    )
    volume = replace(volume, provenance=made)
    tp.write_volume(volume, target, force=force)
    for name, png in volume_pictures(volume).items():
        with atomic_file(shown[name]) as temporary:
            temporary.write_bytes(png)
    write_report(page, volume_report(volume))
    residual = None if volume.view_residual is None else float(np.median(volume.view_residual))
    say.result(
        {
            "out": out.name,
            "shape_zyx": list(grid.shape),
            "voxel_mm": voxel,
            "median_view_residual": residual,
            "notes": list(volume.notes),
            "settings": dict(volume.settings),
        },
        [
            f"{out}: {' x '.join(map(str, grid.n_xyz))} voxels of {voxel:g} mm; pictures and {page.name} beside it",
            *([] if residual is None else [f"  residual of a view's reprojection, median: {residual:.3g}"]),
            *(f"  note: {note}" for note in volume.notes),
        ],
    )
    return OK
