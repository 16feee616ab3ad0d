"""Figs. 14 to 16: distances, diameters and sphericities of the 27-sphere standard, against its coordinates file."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from tomopose.measurement.measure import measure
from tomopose.measurement.plan import MeasurementPlan, plan_from
from tomopose.measurement.probing import sphere_pattern
from tomopose.simulation.objects.sphere_standard import sphere_centres, sphere_diameters
from tomopose.studies.section6.blur import blur_of
from tomopose.units import MICROMETRES_PER_MM
from tomopose.volume import Volume

CAP_DEG = 150.0
"""From the top: the shaft of 2 mm takes the last 24 deg, and the safety distance of 0.5 mm comes off the cap."""
POINTS = 400
SEARCH_VOXELS = 2.0
OUTLIERS = 3.0
"""Points beyond so many rms are set aside, in the sphericities too: what a robust evaluation of a surface states."""
FORMS = ("form", "form_95")


def plan_for(search_mm: float, sigma_mm: float) -> MeasurementPlan:
    """All 351 distances, 27 diameters and sphericities; points spread evenly over each ball but its shaft."""
    centres, diameters = sphere_centres(), sphere_diameters()
    features = {
        f"sphere {k + 1:02d}": {
            "kind": "calotte",
            "point": c.tolist(),
            "radius_mm": float(d) / 2,
            "direction": [0, 0, 1],
            "cap_deg": CAP_DEG,
            "safety_mm": 0.5,
            "n_points": POINTS,
            "outliers": OUTLIERS,
        }
        for k, (c, d) in enumerate(zip(centres, diameters, strict=True))
    }
    names = list(features)
    measurands: list[dict[str, Any]] = [
        {
            "name": f"SD {i + 1:02d}-{j + 1:02d}",
            "kind": "distance",
            "of": [names[i], names[j]],
            "calibrated_mm": float(np.linalg.norm(centres[i] - centres[j])),
        }
        for i, j in combinations(range(len(names)), 2)
    ]
    for kind in ("diameter", *FORMS):
        measurands += [
            {
                "name": f"{kind} {k + 1:02d}",
                "kind": kind,
                "of": [name],
                **({"calibrated_mm": float(diameters[k])} if kind == "diameter" else {"points": "kept"}),
            }
            for k, name in enumerate(names)
        ]
    return plan_from(
        {
            "schema": "tomopose/measurement-plan/1",
            "unit": "mm",
            "name": "multi-sphere standard",
            "features": features,
            "measurands": measurands,
            "surface": {
                "method": "esf",
                "search_distance_mm": search_mm,
                "sigma_mm": sigma_mm,
                "curvature_correction": True,
            },
        }
    )


def true_distances() -> list[float]:
    """Of the coordinates file, mm, in the order of the results."""
    c = sphere_centres()
    return [float(np.linalg.norm(c[i] - c[j])) for i, j in combinations(range(len(c)), 2)]


def measure_standard(volume: Volume) -> dict[str, Any]:
    """Errors of distances and diameters, and sphericities, um."""
    search = SEARCH_VOXELS * float(volume.grid.spacing[0])
    patterns = [
        sphere_pattern(c, float(d) / 2, POINTS, cap=float(np.radians(CAP_DEG)))
        for c, d in zip(sphere_centres(), sphere_diameters(), strict=True)
    ]
    points, normals = (np.concatenate(x) for x in zip(*patterns, strict=True))
    results = measure(volume, plan_for(search, blur_of(volume, points, normals, search))).results
    out: dict[str, Any] = {
        f"{kind}_um": [MICROMETRES_PER_MM * (r.error or 0.0) for r in results if r.kind == kind]
        for kind in ("distance", "diameter")
    }
    return out | {f"{kind}_um": [MICROMETRES_PER_MM * r.value for r in results if r.kind == kind] for kind in FORMS}
