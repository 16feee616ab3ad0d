"""The numbers of figs. 12 to 16, each beside what the paper prints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.measurement.measurands import maximum_permissible_error
from tomopose.measurement.meshes import Mesh
from tomopose.studies.result import StudyRow
from tomopose.studies.section6_specimen import azimuth, cuboid_areas, cylinder_areas, unseen_by_circle
from tomopose.studies.section6_standard import true_distances
from tomopose.units import Array

PERIODS = 7
MPE_A_UM, MPE_K = 9.0, 50.0
"""The user's limit, A + L/K in um with L in mm; the paper draws its supplier's but prints no numbers."""
# Sec. 6.3 on fig. 12, 3D scan: largest surface error of the cylinder areas and of the six cuboids, um.
PRINTED_CYLINDER_UM, PRINTED_CUBOID_UM = 90.0, 18.0
SAME = 1.05
"""Numbers within this factor count as equal."""
LEAST_UNSEEN = 30
"""Vertices from which an rms over the places that a circle does not see is given."""

Found = Mapping[str, Mapping[str, Any]]
"""Name of a case -> what was measured."""


def verdict(theirs: float, ours: float) -> str:
    """In words, for numbers of which the smaller is better."""
    ratio = ours / theirs
    if 1 / SAME <= ratio <= SAME:
        return "equal"
    return f"ours is better, {1 / ratio:.2g} x smaller" if ratio < 1 else f"OURS IS WORSE, {ratio:.2g} x larger"


def rms(values: Any) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(values, dtype=np.float64) ** 2)))


def largest(values: Any) -> float:
    return float(np.nanmax(np.abs(np.asarray(values, dtype=np.float64))))


def deviations(found: Found, name: str) -> Array:
    """(n,), um; nan where no edge was measured."""
    return np.array([np.nan if d is None else d for d in found[name]["deviation_um"]], dtype=np.float64)


def waves(deviation: Array, phi: Array, n: int = 20) -> Array:
    """Amplitudes (n + 1,), um, of the parts with 0 ... n periods a turn."""
    good = np.isfinite(deviation)
    phase = np.exp(-1j * np.outer(np.arange(n + 1), phi[good]))
    return np.asarray(2 * np.abs(phase @ deviation[good]) / good.sum())


def limit(length: Any) -> Array:
    """MPE, um, at lengths (n,), mm."""
    return np.array([maximum_permissible_error(float(x), MPE_A_UM, MPE_K, None) for x in np.atleast_1d(length)])


def row(group: str, quantity: str, theirs: float, ours: float, *, unit: str = "um", **more: Any) -> StudyRow:
    """A row whose note begins with the verdict."""
    note = "; ".join(x for x in (verdict(theirs, ours), more.pop("note", "")) if x)
    return StudyRow(group=group, quantity=quantity, unit=unit, paper_method=theirs, best=ours, note=note, **more)


def specimen_rows(found: Found, mesh: Mesh, source: Array, runs: tuple[int, ...]) -> list[StudyRow]:
    """Figs. 12 and 13."""
    cylinder, cuboid, unseen = cylinder_areas(mesh), cuboid_areas(mesh), unseen_by_circle(mesh, source)
    phi = azimuth(mesh)
    rows = []
    for path, run in (("circular", 0), *(("3D", run) for run in runs)):
        theirs, ours = (deviations(found, f"specimen-{path}-{m}-run{run}") for m in ("paper", "best"))
        first = (path, run) == ("3D", 1)
        group = f"Fig. 12, {path} scan" + (f", calibration run {run}" if run else "")
        rows += [
            row(group, "cylinder areas, largest deviation", largest(theirs[cylinder]), largest(ours[cylinder]),
                source="sec. 6.3" if first else "", printed=PRINTED_CYLINDER_UM if first else None,
                note="printed: around" if first else ""),
            row(group, "cylinder areas, rms", rms(theirs[cylinder]), rms(ours[cylinder])),
            row(group, "cylinder areas, part with seven periods", *(
                float(waves(d[cylinder], phi[cylinder])[PERIODS]) for d in (theirs, ours)),
                source="sec. 6.3" if first else "", note="printed: periodic, no figure" if first else ""),
            row(group, "six cuboids, largest deviation", largest(theirs[cuboid]), largest(ours[cuboid]),
                source="sec. 6.3" if first else "", printed=PRINTED_CUBOID_UM if first else None,
                note="printed: roughly" if first else ""),
            row(group, "whole surface, rms", rms(theirs[~unseen]), rms(ours[~unseen])),
        ]
        if np.isfinite(theirs[unseen]).sum() >= LEAST_UNSEEN and np.isfinite(ours[unseen]).sum() >= LEAST_UNSEEN:
            rows.append(row(group, "where a circle does not see the surface, rms", rms(theirs[unseen]),
                            rms(ours[unseen])))
        lengths = [np.array(list(found[f"specimen-{path}-{m}-run{run}"]["length_um"].values()))
                   for m in ("paper", "best")]
        group = group.replace("Fig. 12", "Fig. 13")
        rows += [row(group, "errors of L1 to L7, rms", rms(lengths[0]), rms(lengths[1])),
                 row(group, "errors of L1 to L7, largest", largest(lengths[0]), largest(lengths[1]))]
    return rows


def standard_rows(found: Found, runs: tuple[int, ...]) -> list[StudyRow]:
    """Figs. 14 to 16, what the true matrices would give, and the order of the views."""
    mpe = limit(true_distances())
    rows = []
    for path, run in (("circular", 0), *(("3D", run) for run in runs)):
        theirs, ours = (found[f"standard-{path}-{m}-run{run}"] for m in ("paper", "best"))
        scan = f"{path} scan" + (f", calibration run {run}" if run else "")
        distance = [np.array(m["distance_um"]) for m in (theirs, ours)]
        rows += [
            row(f"Fig. 14, {scan}", "errors of 351 distances, rms", rms(distance[0]), rms(distance[1])),
            row(f"Fig. 14, {scan}", "errors of 351 distances, largest", largest(distance[0]), largest(distance[1])),
            row(f"Fig. 14, {scan}", "largest share of the MPE", *(float(np.max(np.abs(d) / mpe)) for d in distance),
                unit="1", source="sec. 6.3", note="printed: below the MPE"),
            row(f"Fig. 15, {scan}", "errors of 27 diameters, rms", rms(theirs["diameter_um"]),
                rms(ours["diameter_um"])),
            row(f"Fig. 15, {scan}", "scatter of 27 diameters", float(np.std(theirs["diameter_um"])),
                float(np.std(ours["diameter_um"]))),
            row(f"Fig. 16, {scan}", "sphericity, mean of 27", float(np.mean(theirs["form_um"])),
                float(np.mean(ours["form_um"])), note="all points of a ball"),
            row(f"Fig. 16, {scan}", "sphericity of 95 %, mean of 27", float(np.mean(theirs["form_95_um"])),
                float(np.mean(ours["form_95_um"]))),
        ]
    true = found["standard-3D-best-run0"]
    rows += [
        StudyRow(group="3D scan of the standard with the true matrices", quantity=name, unit="um", best=value,
                 note="what path, views and voxels leave")
        for name, value in (("errors of 351 distances, rms", rms(true["distance_um"])),
                            ("scatter of 27 diameters", float(np.std(true["diameter_um"]))),
                            ("sphericity, mean of 27", float(np.mean(true["form_um"]))))
    ]
    for order in ("sequential", "golden"):
        case = found[f"standard-3D-best-run1-{order}"]
        rows += [
            StudyRow(group="One iteration of SART, 3D scan, our matrices", unit="um",
                     quantity=f"{name}, views in {order} order", best=value)
            for name, value in (("errors of 351 distances, rms", rms(case["distance_um"])),
                                ("sphericity, mean of 27", float(np.mean(case["form_um"]))))
        ]
    return rows


def calibration_rows(residuals: Mapping[tuple[float, int], tuple[float, float]],
                     errors: Mapping[tuple[float, int], tuple[float, float]]) -> list[StudyRow]:
    """Residual (px) and error of the 3D scan's matrices (um) of each run, by both methods."""
    rows = []
    for (m, run), pair in residuals.items():
        rows += [row(f"Calibration at M {m}", f"d_rms_opt, run {run}", *pair, unit="px"),
                 row(f"Calibration at M {m}", f"error of the 3D scan, run {run}", *errors[m, run],
                     note="rms at the object's corners, rigid pose removed")]
    return rows
