"""Figs. 11 to 13: what is measured of the multi-feature specimen, against the mesh as it was made."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.features.fits import fit_plane, fit_sphere
from tomopose.measurement.features.measurands import distance
from tomopose.measurement.measure import measure
from tomopose.measurement.mesh.cmm_correction import corrected_reference
from tomopose.measurement.mesh.comparison import compare
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import MeasurementPlan, plan_from
from tomopose.measurement.regions import surface_region
from tomopose.measurement.surface.edges import EdgeSettings
from tomopose.simulation.objects.specimen import (
    CALOTTE_DISTANCE,
    CALOTTE_RADIUS,
    CUBOID_HEIGHTS,
    CUBOID_SIDE,
    FLANGE_LENGTH,
    FLANGE_RADIUS,
    FLAT,
    LENGTH,
    specimen_mesh,
)
from tomopose.studies.section6.blur import blur_of
from tomopose.studies.section6.scan import MOUNTED, specimen
from tomopose.units import MICROMETRES_PER_MM, Array
from tomopose.volume import Volume

OUTLIERS = 3.0
"""Points beyond so many rms are set aside."""
RIM_MM = 1.0
"""Kept from the rims of the cylinder areas."""
THREAD_Y_MM = 8.0
"""The slice of fig. 11 runs along the part's axis through the threaded hole."""
LARGEST_SLICE = 320
SEARCH_MM, SEARCH_VOXELS = 0.2, 2.0
PROBE_SPACING_MM, PROBING_SIGMA_MM, PROBING_SEED = 1.0, 0.0005, 21
"""Of the coordinate measuring machine: the paper's two machines agree to 0.3 um in the lengths that it keeps."""


@functools.lru_cache(maxsize=2)
def as_made(edge: float) -> Mesh:
    """The specimen as made, part coordinates: what nobody knows."""
    mesh = specimen(edge)
    return Mesh(points=mesh.vertices, faces=mesh.faces)


@functools.lru_cache(maxsize=2)
def reference(edge: float) -> Mesh:
    """The nominal mesh shifted to what a coordinate measuring machine probed of the specimen, part coordinates [21].

    Edges cannot be probed and stay nominal.
    """
    nominal, made = specimen_mesh(edge=edge), as_made(edge)
    mesh = Mesh(points=nominal.vertices, faces=nominal.faces)
    rng = np.random.default_rng(PROBING_SEED)
    smooth = np.flatnonzero(~made.on_edge)
    step = max(int(PROBE_SPACING_MM / edge), 1) ** 2
    chosen = rng.choice(smooth, len(smooth) // step, replace=False)
    noise = PROBING_SIGMA_MM * rng.standard_normal(len(chosen))
    return corrected_reference(
        mesh, made.points[chosen] + noise[:, None] * made.normals[chosen], interpolation="natural"
    )


def reference_error_um(edge: float) -> float:
    """um, rms over the smooth vertices: the reference less the specimen as made, along the normals."""
    mesh, made = reference(edge), as_made(edge)
    off = np.einsum("ij,ij->i", mesh.points - made.points, made.normals)[~made.on_edge]
    return float(MICROMETRES_PER_MM * np.sqrt(np.mean(off**2)))


def cylinder_areas(mesh: Mesh) -> np.ndarray:
    """(n,) True for vertices on the two flanges' cylinders, off their rims."""
    x = mesh.points
    inner, outer = LENGTH / 2 - FLANGE_LENGTH + RIM_MM, LENGTH / 2 - RIM_MM
    height = np.abs(x[:, 2])
    on = np.abs(np.hypot(x[:, 0], x[:, 1]) - FLANGE_RADIUS) < 0.1
    return np.asarray(on & (height > inner) & (height < outer) & ~mesh.on_edge)


def cuboid_areas(mesh: Mesh) -> np.ndarray:
    """(n,) True for vertices on the outer planes of the six cuboids, off their edges."""
    out = np.zeros(len(mesh.points), dtype=bool)
    for name, plan in plan_for(Alignment.none()).features.items():
        if name.startswith("cuboid"):
            out |= surface_region(plan, Alignment.none(), mesh.points, mesh.normals)
    result: np.ndarray = out & ~mesh.on_edge
    return result


def unseen_by_circle(mesh: Mesh, source: Array) -> np.ndarray:
    """(n,) True for vertices whose tangent plane no view's source (m, 3), mm in W, lies on or crosses: what Tuy's
    condition misses there rules the surface (Tuy, SIAM J. Appl. Math. 43 (1983) 546)."""
    n, x = mesh.normals @ MOUNTED.T, mesh.points @ MOUNTED.T
    side = n @ source.T - np.einsum("ij,ij->i", n, x)[:, None]
    return np.asarray(((side > 0).all(axis=1) | (side < 0).all(axis=1)) & ~mesh.on_edge)


def azimuth(mesh: Mesh) -> Array:
    """(n,), rad: direction about the rotation axis in which each vertex's normal points."""
    n = mesh.normals @ MOUNTED.T
    return np.asarray(np.arctan2(n[:, 1], n[:, 0]))


def plan_for(alignment: Alignment, search_mm: float | None = None, sigma_mm: float | None = None) -> MeasurementPlan:
    """L1 to L6 between a cuboid's outer plane and its flat, L7 between the calottes' centres."""
    features: dict[str, Any] = {}
    measurands: list[dict[str, Any]] = []
    for k, height in enumerate(CUBOID_HEIGHTS):
        angle, side = np.radians(60.0 * k), 1.0 if k % 2 else -1.0
        e, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        z = np.array([0.0, 0.0, 1.0])
        plane = {"kind": "plane", "direction": e.tolist(), "n_points": 400, "outliers": OUTLIERS}
        features[f"flat {k + 1}"] = {
            **plane,
            "point": (FLAT * e - 6.0 * side * z).tolist(),
            "u": (3.0 * across).tolist(),
            "v": (8.0 * z).tolist(),
        }
        features[f"cuboid {k + 1}"] = {
            **plane,
            "point": ((FLAT + height) * e + 9.0 * side * z).tolist(),
            "u": (0.3 * CUBOID_SIDE * across).tolist(),
            "v": (0.5 * CUBOID_SIDE * z).tolist(),
            "safety_mm": 0.8,
        }
        measurands.append({"name": f"L{k + 1}", "kind": "distance", "of": [f"flat {k + 1}", f"cuboid {k + 1}"]})
    for k, x in enumerate((-CALOTTE_DISTANCE / 2, CALOTTE_DISTANCE / 2)):
        features[f"calotte {k + 1}"] = {
            "kind": "calotte",
            "point": [x, 0.0, -LENGTH / 2],
            "radius_mm": CALOTTE_RADIUS,
            "direction": [0, 0, 1],
            "cap_deg": 80.0,
            "inward": True,
            "n_points": 400,
            "outliers": OUTLIERS,
        }
    measurands.append({"name": "L7", "kind": "distance", "of": ["calotte 1", "calotte 2"]})
    start = np.column_stack([alignment.R, alignment.t]).tolist()
    return plan_from(
        {
            "schema": "tomopose/measurement-plan/1",
            "unit": "mm",
            "name": "multi-feature specimen",
            "features": features,
            "measurands": measurands,
            "alignment": {"start": start},
            "surface": {"method": "esf", "search_distance_mm": search_mm, "sigma_mm": sigma_mm},
        }
    )


@functools.lru_cache(maxsize=2)
def true_lengths(edge: float) -> Mapping[str, float]:
    """L1 to L7 of the specimen as made, mm: features fitted to its vertices, each weighted by the area around it."""
    mesh, plan = as_made(edge), plan_for(Alignment.none())
    area = np.bincount(mesh.faces.ravel(), np.repeat(np.linalg.norm(mesh.face_normals, axis=1), 3), len(mesh.points))
    fits: dict[str, Feature] = {}
    for name, p in plan.features.items():
        mine = surface_region(p, Alignment.none(), mesh.points, mesh.normals) & ~mesh.on_edge
        fit = fit_plane if p.kind == "plane" else fit_sphere
        fits[name] = fit(mesh.points[mine], sigma=1 / np.sqrt(area[mine]))
    return {m.name: distance(*(fits[f] for f in m.of)).value for m in plan.measurands}


def measure_specimen(volume: Volume, edge: float) -> dict[str, Any]:
    """Deviation (um) at each vertex of the reference (None without one); errors of the lengths (um); a
    slice."""
    mesh = reference(edge)
    start = Alignment(R=MOUNTED, t=np.zeros(3), rule="given")
    search = max(SEARCH_MM, SEARCH_VOXELS * float(volume.grid.spacing[0]))
    smooth = ~mesh.on_edge
    sigma = blur_of(volume, start.points(mesh.points[smooth]), start.directions(mesh.normals[smooth]), search)
    found = compare(volume, mesh, alignment=start, fit="best-fit", search_mm=search, settings=EdgeSettings(sigma=sigma))
    lengths = measure(volume, plan_for(found.alignment, search, sigma))
    true = true_lengths(edge)
    deviation = np.round(MICROMETRES_PER_MM * found.deviation, 2)
    iy = int(np.clip(round(float(volume.grid.indices([0.0, THREAD_Y_MM, 0.0])[1])), 0, volume.grid.shape[1] - 1))
    values = volume.values[:, iy]
    step = -(-max(values.shape) // LARGEST_SLICE)
    return {
        "deviation_um": [None if np.isnan(d) else float(d) for d in deviation],
        "length_um": {r.name: MICROMETRES_PER_MM * (r.value - true[r.name]) for r in lengths.results},
        "slice": np.round(np.asarray(values[::step, ::step], dtype=np.float64), 5).tolist(),
        "slice_side_mm": step * float(volume.grid.spacing[0]),
        "blur_mm": sigma,
        "moved_um": MICROMETRES_PER_MM * found.moved_mm,
        "turned_urad": 1e6 * found.turned_rad,
    }
