"""Projections of the virtual CT in the files that the CTSimU toolbox evaluates: 16-bit TIFF and a metadata file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from ctsimu.helpers import json_from_pkg, pkg_scenario

from tomopose import PoseSequence, RigidTransform, Scanner
from tomopose.geometry.frames import Frame
from tomopose.simulation.detector.detector import Detector, expose
from tomopose.simulation.objects.mesh import TriangleMesh, write_stl
from tomopose.simulation.objects.shapes import Solid
from tomopose.simulation.physics.materials import MATERIALS, Material, from_formula
from tomopose.simulation.physics.spectrum import Spectrum
from tomopose.simulation.run import SimulatedRun, render
from tomopose.simulation.scene.ctsimu import run_from_ctsimu

WHITE = 60000.0
"""Grey value of the empty beam that all tests ask for."""
ABSORBER = 1e4
"""Factor on the density of a sample that the test calls an ideal absorber: 10 um of tungsten alone let 86 % through."""


def scenario(name: str) -> dict[str, Any]:
    """A scenario of the toolbox; its spectrum file is not part of it, so the tube's spectrum is calculated."""
    content: dict[str, Any] = json_from_pkg(pkg_scenario(name))
    content["source"]["spectrum"]["file"] = None
    return content


def run_of(
    content: Mapping[str, Any], folder: Path, mesh: TriangleMesh | None = None, *, moved: bool = False
) -> SimulatedRun:
    """The scenario's run; its sample's mesh goes through the STL file that the scenario names.

    moved: whether the sample's centre is set to that of the mesh's box, for a mesh given in the stage's axes.
    """
    content = json.loads(json.dumps(content))
    if mesh is not None:
        sample = content["samples"][0]
        write_stl(folder / sample["file"]["value"], mesh)
        if moved:
            middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
            sample["position"]["center"] = {
                a: {"value": float(x), "unit": "mm"} for a, x in zip("uvw", middle, strict=True)
            }
    return run_from_ctsimu(content, folder=folder, seed=1)


def opaque(content: dict[str, Any]) -> dict[str, Any]:
    """The scenario with its sample's material as an ideal absorber."""
    wanted = content["samples"][0]["material_id"]
    for material in content["materials"]:
        if material["id"] == wanted:
            material["density"]["value"] *= ABSORBER
    return content


BAND = (430, 585)
"""Columns of the panel that are imaged in the wedge tests; beside them the beam is empty."""


def wedge_scanner() -> Scanner:
    """1000 x 1000 pixels; the wedge tests depend on no distance, as all rays of a step meet the same thickness."""
    return Scanner(d_SD=1000.0, d_SR=500.0, p_u=0.4, p_v=0.4, u_0=499.5, v_0=499.5, n_u=1000, n_v=1000)


def wedge_run(solids: tuple[Solid, ...], spectrum: Spectrum, *, cells: int = 2) -> SimulatedRun:
    still = PoseSequence.from_table([[0, 0, 0]], [[0, 0, 0]])
    return SimulatedRun(
        scanner=wedge_scanner().cropped(u=BAND[0], v=0, n_u=BAND[1] - BAND[0], n_v=1000),
        poses=still,
        T_HT=RigidTransform.identity(Frame.H, Frame.T),
        T_MH=still.T_MH,
        solids=solids,
        spectrum=spectrum,
        detector=Detector(snr=math.inf, blur_sigma=0.0, white=WHITE, cells=cells),
        materials=wedge_materials(),
        seed=1,
    )


def wedge_materials() -> dict[str, Material]:
    """Densities as the toolbox's documentation gives them."""
    formulas = {"Al": 2.6989, "Ti": 4.506, "Fe": 7.874, "Cu": 8.92, "CsI": 4.51, "Gd2O2S": 7.32}
    return {**MATERIALS, **{name: from_formula(name, density) for name, density in formulas.items()}}


def write(
    folder: Path, name: str, run: SimulatedRun, *, flat: bool = True, threads: int = 1, whole: Scanner | None = None
) -> str:
    """The metadata file of a run's only projection, written beside it and its noise-free flat image.

    whole: the panel of which the run images the columns `BAND`; the others see the empty beam.
    """
    image = render(run, 0, threads=threads)
    if whole is not None:
        image, part = np.full(whole.shape, round(run.detector.white), image.dtype), image
        image[:, BAND[0] : BAND[1]] = part
        run = replace(run, scanner=whole)
    tifffile.imwrite(folder / f"{name}.tif", image[::-1])
    if flat:
        quiet = replace(run.detector, snr=math.inf)
        empty = expose(np.ones(run.scanner.shape), quiet, run.scanner, seed=run.seed, frame=0)
        tifffile.imwrite(folder / f"{name}_flat.tif", empty[::-1])
    return write_metadata(folder, name, run.scanner, flat=flat)


def write_drawn(folder: Path, name: str, scanner: Scanner, share: np.ndarray) -> str:
    """The metadata file of an image that no simulator made; share: of the empty beam, rows from the top."""
    tifffile.imwrite(folder / f"{name}.tif", np.rint(WHITE * share).astype(np.uint16))
    tifffile.imwrite(folder / f"{name}_flat.tif", np.full(scanner.shape, round(WHITE), np.uint16))
    return write_metadata(folder, name, scanner, flat=True)


def write_metadata(folder: Path, name: str, scanner: Scanner, *, flat: bool) -> str:
    """The toolbox's description of NAME.tif and NAME_flat.tif; its path."""
    metadata = {
        "file": {"file_type": "CTSimU Metadata", "file_format_version": {"major": 1, "minor": 2}},
        "output": {
            "projections": {
                "filename": f"{name}.tif",
                "number": 1,
                "datatype": "uint16",
                "byteorder": "little",
                "headersize": {"file": 0, "image": 0},
                "dimensions": {
                    "x": {"value": scanner.n_u, "unit": "px"},
                    "y": {"value": scanner.n_v, "unit": "px"},
                },
                "max_intensity": WHITE,
                "dark_field": {"number": 0, "filename": None, "projections_corrected": False},
                "flat_field": {
                    "number": int(flat),
                    "filename": f"{name}_flat.tif" if flat else None,
                    "projections_corrected": False,
                },
            }
        },
    }
    path = folder / f"{name}_metadata.json"
    path.write_text(json.dumps(metadata, indent=1))
    return str(path)
