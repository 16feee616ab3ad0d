"""`tomopose reconstruct`: matrices and radiographs to a volume, with pictures of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, DaskOption, arguments, names
from tomopose.cli.options import ImageFileOptions, WritingOptions, add_command

if TYPE_CHECKING:
    import numpy as np

    from tomopose import Correction, Volume, VoxelGrid
    from tomopose.io.images.sequence import Rows
    from tomopose.reconstruction.settings import Algorithm

EPILOG = (
    "Example: tomopose reconstruct --matrices matrices.npz --images scan/ --images-are transmission --voxel-mm 0.1 "
    "--size 512 --out volume.h5"
)

PICTURES = ("slice_z", "slice_y", "slice_x", "maximum")
SWEEPS = ("iterations", "relaxation", "order", "subset_size", "nonnegative")
"""Options that belong to an algorithm, except for the seed, which the paper does not state."""


def register(app: typer.Typer) -> None:
    add_command(app, "reconstruct", reconstruct, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """How images become line integrals."""

    images_are: Annotated[
        str | None, typer.Option("--images-are", help="counts, transmission or line-integrals; never guessed.")
    ] = None
    white: Annotated[
        float | None, typer.Option("--white", help="Grey value of the open beam, for counts without --flat.")
    ] = None
    ring_width: Annotated[
        int | None, typer.Option("--ring-width", min=1, help="Even out pixels that differ from this many neighbours.")
    ] = None
    bad_pixels: Annotated[
        Path | None, typer.Option("--bad-pixels", help="Image that is not 0 where a pixel is to be left out.")
    ] = None
    exclude: Annotated[
        bool, typer.Option("--exclude-invalid", help="Leave NaN and dark pixels out of their view, not refuse them.")
    ] = False
    scene: Annotated[
        Path | None,
        typer.Option(
            "--scene",
            help="scene.toml whose source and detector made the images, with --material: beam hardening is taken out.",
        ),
    ] = None
    material: Annotated[str | None, typer.Option("--material", help="What the object is made of.")] = None
    thickness: Annotated[
        float | None, typer.Option("--thickness-mm", help="Longest path of a ray through the object.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class CorrectedImages(CorrectionOptions, ImageFileOptions):
    """Image files, and how they become line integrals."""


@dataclass(frozen=True, kw_only=True)
class AlgorithmOptions:
    """What is calculated, and by which engine."""

    engine: Annotated[str, typer.Option("--engine", help="auto, cpu, rtk, astra or reference.")] = "auto"
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            help="auto, fdk, fdk+sart, sart, ossart, cgls or fdk-preview.  auto (the default): fdk on smooth full "
            "turns of 36 views and more, fdk+sart or sart elsewhere; the choice is said.",
        ),
    ] = None
    paper: Annotated[
        bool, typer.Option("--paper", help="As the paper: one SART iteration from zero, relaxation 0.8.")
    ] = False
    iterations: Annotated[
        int | None, typer.Option("--iterations", min=1, help="Sweeps over all views; 1 unless given (cgls: 20).")
    ] = None
    relaxation: Annotated[
        float | None, typer.Option("--relaxation", help="Relaxation, above 0 and below 2; 0.8 unless given.")
    ] = None
    order: Annotated[str | None, typer.Option("--order", help="golden (unless given), sequential or random.")] = None
    seed: Annotated[int | None, typer.Option("--seed", help="Random seed for the random order.")] = None
    subset_size: Annotated[
        int | None, typer.Option("--subset-size", min=1, help="Views in one update; 1 unless given (ossart: 5).")
    ] = None
    nonnegative: Annotated[bool, typer.Option("--nonnegative", help="Keep attenuation at 0 or above.")] = False


@dataclass(frozen=True, kw_only=True)
class KeptOptions:
    """Where the state of unfinished work is kept."""

    checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--checkpoint",
            help="Folder to keep the state in; a second run with the same images and settings continues from there.",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class ExecutionOptions(KeptOptions):
    """Where and within what it runs."""

    memory: Annotated[float | None, typer.Option("--memory-gib", help="Keep within this much memory.")] = None
    scratch: Annotated[
        Path | None, typer.Option("--scratch", help="Folder for the slabs of a volume that does not fit the memory.")
    ] = None
    dask: DaskOption = None


@dataclass(frozen=True, kw_only=True)
class ScanAndGrid:
    """A scan with its matrices, and the voxels that are wanted."""

    matrices: Annotated[Path, typer.Option("--matrices", help="matrices.npz of the scan.")]
    images: Annotated[str, typer.Option("--images", help="Folder, glob or multi-page file of the scan's images.")]
    voxel: Annotated[str, typer.Option("--voxel-mm", help="Side of a voxel, mm: one number, or X,Y,Z.")]
    size: Annotated[str, typer.Option("--size", help="Voxels along each axis, N or NX,NY,NZ.")]
    centre: Annotated[str, typer.Option("--centre-mm", help="Middle of the volume in W, X,Y,Z.")] = "0,0,0"
    scanner: Annotated[
        Path | None, typer.Option("--scanner", help="scanner.json, for the row order and size of the image files.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class Options(ScanAndGrid, CorrectedImages, AlgorithmOptions, ExecutionOptions, WritingOptions):
    """The options of `tomopose reconstruct`."""

    out: Annotated[Path, typer.Option("--out", help="volume.h5 (also .nrrd, .mhd, .tif).")]
    mask: Annotated[
        Path | None, typer.Option("--mask", help="Volume on the same grid that is not 0 where there may be material.")
    ] = None


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


def spacing(text: str) -> tuple[float, float, float]:
    """`0.1` or `0.1,0.1,0.2` (x, y, z), mm."""
    parts = names(text)
    try:
        x, y, z = (float(part) for part in (parts * 3 if len(parts) == 1 else parts))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is neither a length nor X,Y,Z", param_hint="--voxel-mm") from None
    return x, y, z


def grid_from(*, voxel: str, size: str, centre: str) -> VoxelGrid:
    """The grid that --size, --voxel-mm and --centre-mm describe."""
    import numpy as np

    import tomopose as tp

    return tp.VoxelGrid(shape=grid_size(size), spacing=np.array(spacing(voxel)), centre=np.array(point(centre)))


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


def algorithm_from(o: AlgorithmOptions) -> Algorithm | None:
    """The algorithm that the options ask for; None for the default.  What contradicts --paper is a usage error."""
    from dataclasses import fields, replace

    from tomopose.reconstruction.settings import PAPER, algorithm_of, name_of, with_options

    given = {name: getattr(o, name) for name in (*SWEEPS, "seed") if getattr(o, name) not in (None, False)}
    if o.paper:
        for name, value in given.items():
            if name != "seed" and value != getattr(PAPER, name):
                option = "--" + name.replace("_", "-")
                raise typer.BadParameter(
                    f"contradicts --paper, which is {name} = {getattr(PAPER, name)}", param_hint=option
                )
        if o.algorithm not in (None, "sart"):
            raise typer.BadParameter(f"{o.algorithm} contradicts --paper, which is sart", param_hint="--algorithm")
        return replace(PAPER, seed=o.seed or 0)
    asked = algorithm_of(o.algorithm)
    for name in given:
        if asked is not None and name not in [f.name for f in fields(asked)]:
            raise typer.BadParameter(f"{name_of(asked)} has no such option", param_hint="--" + name.replace("_", "-"))
    return with_options(asked, given)


def correction_from(o: CorrectedImages, rows: Rows) -> Correction:
    """How the images become line integrals; rows: the order of rows that the images were opened with."""
    import tomopose as tp

    bad = None if o.bad_pixels is None else tp.open_images(o.bad_pixels, rows=rows)[0] != 0
    kind: Any = "transmission" if o.flat is not None and o.images_are is None else o.images_are
    return tp.Correction(
        images_are=kind,
        white=o.white,
        bad_pixels=bad,
        invalid="exclude" if o.exclude else "error",
        beam_hardening=polynomial(o.scene, o.material, o.thickness),
        ring_width=o.ring_width,
    )


def support_from(o: Options, grid: VoxelGrid) -> np.ndarray | None:
    """Where --mask allows material; InputError where it lies on another grid."""
    import tomopose as tp
    from tomopose.errors import InputError

    if o.mask is None:
        return None
    allowed = tp.read_volume(o.mask)
    if not allowed.grid.same_as(grid):
        raise InputError(f"{o.mask}: its grid is not that of the volume to be made ({o.size} voxels of {o.voxel} mm)")
    support: np.ndarray = allowed.values != 0
    return support


def reconstruct(options: Options) -> int:
    """Reconstruct a scan along any path, on the CPU or through another engine.

    The volume lies in W, object at home, in 1/mm.  How well each view agrees with the volume is stated: a wrong
    trajectory shows there without any reference part, and where views contradict the volume the exit code is 3.
    """
    from dataclasses import replace

    import tomopose as tp
    from tomopose.cli.job import executor_of, image_source, open_for
    from tomopose.files import require_absent
    from tomopose.provenance import provenance

    o, say = options, options.say
    grid, algorithm = grid_from(voxel=o.voxel, size=o.size, centre=o.centre), algorithm_from(o)
    target = require_absent(o.out, force=o.force)
    for name in (*(f"{o.out.stem}_{picture}.png" for picture in PICTURES), f"{o.out.stem}.html"):
        require_absent(o.out.with_name(name), force=o.force)
    P = tp.read_matrices(o.matrices)
    known: Any = None if o.scanner is None else tp.read_scanner(o.scanner)
    stack = open_for(
        say,
        image_source(o.images),
        known,
        None,
        dark=o.dark,
        flat=o.flat,
        dataset=o.dataset,
        rows=o.rows,
        raw=o.raw,
    )
    correction, support = correction_from(o, stack.rows), support_from(o, grid)
    with say.progress("reconstructing") as progress, executor_of(o.dask) as client:
        volume = tp.reconstruct(
            stack,
            P,
            grid,
            algorithm=algorithm,
            engine=o.engine,
            correction=correction,
            execution=tp.Execution(memory_gib=o.memory, scratch=o.scratch, checkpoint=o.checkpoint, client=client),
            mask=support,
            progress=progress,
        )
    inputs = [path for path in (o.matrices, o.scanner, o.bad_pixels, o.mask, o.scene) if path is not None]
    asked = arguments(voxel_mm=o.voxel, size=o.size, centre_mm=o.centre, paper=o.paper, **volume.settings)
    volume = replace(volume, provenance=provenance(inputs=inputs, arguments=asked))
    tp.write_volume(target, volume, force=o.force)
    write_beside(o, volume)
    said(o, volume)
    return OK if volume.trustworthy else NOT_TRUSTWORTHY


def write_beside(o: Options, volume: Volume) -> None:
    """The pictures and the page, beside the volume."""
    from tomopose.files import atomic_file
    from tomopose.report import volume_pictures, volume_report, write_report

    for name, png in volume_pictures(volume).items():
        with atomic_file(o.out.with_name(f"{o.out.stem}_{name}.png")) as temporary:
            temporary.write_bytes(png)
    write_report(o.out.with_name(f"{o.out.stem}.html"), volume_report(volume))


def said(o: Options, volume: Volume) -> None:
    """The result in words, or as JSON."""
    import numpy as np

    grid = volume.grid
    residual = None if volume.view_residual is None else float(np.median(volume.view_residual))
    sides = " x ".join(f"{s:g}" for s in (grid.spacing[:1] if np.ptp(grid.spacing) == 0 else grid.spacing))
    o.say.result(
        {
            "out": o.out.name,
            "shape_zyx": list(grid.shape),
            "voxel_mm": float(grid.spacing[0]) if np.ptp(grid.spacing) == 0 else grid.spacing.tolist(),
            "median_view_residual": residual,
            "trustworthy": volume.trustworthy,
            "contradicted_views": list(volume.contradicted),
            "notes": list(volume.notes),
            "settings": dict(volume.settings),
        },
        [
            f"{o.out}: {' x '.join(map(str, grid.n_xyz))} voxels of {sides} mm; pictures and {o.out.stem}.html beside "
            "it",
            *([] if residual is None else [f"  residual of a view's reprojection, median: {residual:.3g}"]),
            *(f"  note: {note}" for note in volume.notes),
        ],
    )
