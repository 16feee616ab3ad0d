"""Runs of the virtual scanner written as CTSimU scenarios, format 1.2: geometry, meshes, tube, filters, detector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.ctsimu import to_ctsimu
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.objects.mesh import TriangleMesh
from tomopose.simulation.physics.materials import Material, from_formula
from tomopose.simulation.physics.spectrum import Spectrum
from tomopose.simulation.projector.focal_spot import FWHM_PER_SIGMA
from tomopose.simulation.run import SimulatedRun
from tomopose.simulation.scene.ctsimu import STAGE_TO_M, resolution_of
from tomopose.values import require_types

ANODE_DENSITY = 10.0
"""g/cm3 of an anode whose material is not in the table: no spectrum depends on it."""


@require_types
def run_to_ctsimu(run: SimulatedRun) -> tuple[dict[str, object], dict[str, TriangleMesh]]:
    """(scenario content, mesh files by name): geometry by the true poses, meshes in M, tessellated where analytic.

    Tube, filters and scintillator are named where the run knows them; a spectrum from a table has its highest energy
    for a voltage, and a response from a table is left out.
    """
    home = eq5_matrices(run.scanner, T_HT=run.T_HT, T_MH=run.T_MH, alpha=np.asarray(run.poses.alpha))
    matrices = ProjectionMatrices(
        P=home,
        n_u=run.scanner.n_u,
        n_v=run.scanner.n_v,
        p_u=run.scanner.p_u,
        p_v=run.scanner.p_v,
        pose_id=run.poses.pose_id,
        scanner=run.scanner,
    )
    content = to_ctsimu(matrices)
    # The scan's volume is fixed to W at home; the bodies are fixed to M.
    T_MW = run.scanner.T_TW(0.0) @ run.T_HT @ RigidTransform.identity(Frame.M, Frame.H)
    files: dict[str, TriangleMesh] = {}
    samples = []
    for k, (mesh, material, frame) in enumerate(run.tessellated):
        if frame is not Frame.M:
            raise InputError(f"a body is fixed to frame {frame.name}; a CTSimU stage carries bodies fixed to M alone")
        file = f"body-{k}.stl"
        files[file] = mesh.placed(R=STAGE_TO_M @ T_MW.R, t=STAGE_TO_M @ T_MW.t)
        axes = {f"vector_{n}": {a: {"value": float(a == b)} for a in "uvw"} for n, b in (("r", "u"), ("t", "w"))}
        x = files[file].vertices
        middle = (x.min(axis=0) + x.max(axis=0)) / 2  # CTSimU places the centre of the bounding box
        centre = {a: {"value": float(m), "unit": "mm"} for a, m in zip("uvw", middle, strict=True)}
        samples.append(
            {
                "name": file,
                "file": file,
                "unit": "mm",
                "material_id": material,
                "position": {"center": centre, **axes, "deviations": []},
            }
        )
    content["samples"] = samples
    materials = {name: run.materials[name] for name in run.beam_materials}
    source, scintillator = _source_entry(run.spectrum, run.materials, materials)
    content["source"] |= source
    content["materials"] = [_material_entry(name, material) for name, material in materials.items()]
    if run.spot.shape == "gaussian":
        content["source"]["spot"] = {
            "sigma": {
                "u": {"value": run.spot.size_u / FWHM_PER_SIGMA, "unit": "mm"},
                "v": {"value": run.spot.size_v / FWHM_PER_SIGMA, "unit": "mm"},
            }
        }
    d = run.detector
    content["detector"] |= {
        "type": "real",
        **scintillator,
        "bit_depth": {"value": d.bits},
        "image_lag": {"value": sum(d.lag)},
        "gray_value": {"imin": {"value": d.dark}, "imax": {"value": d.dark + d.white}},
        "noise": {"snr_at_imax": {"value": None if math.isinf(d.snr) else d.snr}},
        "unsharpness": {
            "basic_spatial_resolution": {"value": run.scanner.p_u * resolution_of(d.blur_sigma), "unit": "mm"}
        },
    }
    return content, files


def _source_entry(
    spectrum: Spectrum, known: Mapping[str, Material], named: dict[str, Material]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """(source, scintillator) of a scenario; what they are made of joins `named`."""

    def plate(part: tuple[Material | str, float]) -> dict[str, Any]:
        material, thickness = part
        name = material if isinstance(material, str) else f"material-{len(named)}"
        named[name] = known[name] if isinstance(material, str) else material
        return {"material_id": name, "thickness": {"value": thickness, "unit": "mm"}}

    voltage = float(spectrum.energy[-1]) if spectrum.tube is None else spectrum.tube.voltage
    source: dict[str, Any] = {
        "voltage": {"value": voltage, "unit": "kV"},
        "spectrum": {"monochromatic": False, "file": None},
        "filters": [plate(part) for part in spectrum.filters],
    }
    if spectrum.tube is not None:
        anode = spectrum.tube.anode
        named[anode] = known[anode] if anode in known else from_formula(anode, ANODE_DENSITY)
        angle = {"emission": {"value": spectrum.tube.anode_angle_deg, "unit": "deg"}}
        source["target"] = {"type": "reflection", "material_id": anode, "angle": angle}
    part = spectrum.scintillator
    return source, {} if part is None else {"scintillator": plate(part)}


def _material_entry(name: str, material: Material) -> dict[str, Any]:
    return {
        "id": name,
        "name": name,
        "density": {"value": material.density, "unit": "g/cm^3"},
        "composition": [
            {"formula": {"value": e}, "mass_fraction": {"value": f}} for e, f in material.fractions.items()
        ],
    }
