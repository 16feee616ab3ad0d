"""The numbers of figs. 12 to 16, each beside what the paper prints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.measurement.features.measurands import maximum_permissible_error
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.studies.parts.result import StudyRow
from tomopose.studies.section6.specimen import azimuth, cuboid_areas, cylinder_areas, unseen_by_circle
from tomopose.studies.section6.standard import true_distances
from tomopose.units import Array

PERIODS = 7
MPE_A_UM, MPE_K = 9.0, 50.0
"""The user's limit, A + L/K in um with L in mm; the paper draws its supplier's but prints no numbers."""
# Sec. 6.3 on fig. 12, 3D scan: largest surface error of the cylinder areas and of the six cuboids, um.
PRINTED_CYLINDER_UM, PRINTED_CUBOID_UM = 90.0, 18.0
SAME = 1.05
"""Numbers within this factor count as equal."""
ORDERS = ("sequential", "golden")
LEAST_UNSEEN = 30
"""Vertices from which an rms over the places that a circle does not see is given."""

Case = Mapping[str, Any]
"""What was measured in one volume."""
Found = Mapping[str, Case]
"""By the case's name."""


def verdict(theirs: float, ours: float) -> str:
    """In words, for numbers of which the smaller is better."""
    ratio = ours / theirs
    if 1 / SAME <= ratio <= SAME:
        return "equal"
    return f"ours is better, {1 / ratio:.2g} x smaller" if ratio < 1 else f"OURS IS WORSE, {ratio:.2g} x larger"


def rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(values, dtype=np.float64) ** 2)))


def largest(values: ArrayLike) -> float:
    return float(np.nanmax(np.abs(np.asarray(values, dtype=np.float64))))


def deviations(found: Found, name: str) -> Array:
    """(n,), um; nan where no edge was measured."""
    return deviations_of(found[name])


def deviations_of(case: Case) -> Array:
    """(n,), um; nan where no edge was measured."""
    return np.array([np.nan if d is None else d for d in case["deviation_um"]], dtype=np.float64)


def waves(deviation: Array, phi: Array, n: int = 20) -> Array:
    """Amplitudes (n + 1,), um, of the parts with 0 ... n periods a turn."""
    good = np.isfinite(deviation)
    phase = np.exp(-1j * np.outer(np.arange(n + 1), phi[good]))
    return np.asarray(2 * np.abs(phase @ deviation[good]) / good.sum())


def limit(length: ArrayLike) -> Array:
    """MPE, um, at lengths (n,), mm."""
    return np.array([maximum_permissible_error(float(x), MPE_A_UM, MPE_K, None) for x in np.atleast_1d(length)])


def row(group: str, quantity: str, theirs: float | None, ours: float, *, unit: str = "um", **more: Any) -> StudyRow:
    """A row whose note begins with the verdict, where there are two numbers to judge."""
    judged = "" if theirs is None else verdict(theirs, ours)
    note = "; ".join(x for x in (judged, more.pop("note", "")) if x)
    return StudyRow(group=group, quantity=quantity, unit=unit, paper_method=theirs, best=ours, note=note, **more)


class Pair:
    """What was measured by the paper's method, None where it was not, and by our best."""

    def __init__(self, found: Found, thing: str, path: str, run: int) -> None:
        theirs, ours = (f"{thing}-{path}-{method}-run{run}" for method in ("paper", "best"))
        self.theirs, self.ours = found.get(theirs), found[ours]

    def of(self, measure: Callable[[Case], float]) -> tuple[float | None, float]:
        return None if self.theirs is None else measure(self.theirs), measure(self.ours)


def scans(runs: tuple[int, ...]) -> list[tuple[str, int]]:
    """(path, run) of all scans, the circular one first."""
    return [("circular", 0), *(("3D", run) for run in runs)]


def specimen_rows(found: Found, mesh: Mesh, source: Array, runs: tuple[int, ...]) -> list[StudyRow]:
    """Figs. 12 and 13."""
    cylinder, cuboid, unseen = cylinder_areas(mesh), cuboid_areas(mesh), unseen_by_circle(mesh, source)
    phi = azimuth(mesh)
    rows = []
    for path, run in scans(runs):
        both = Pair(found, "specimen", path, run)
        first = (path, run) == ("3D", 1)
        group = f"Fig. 12, {path} scan" + (f", calibration run {run}" if run else "")
        rows += [
            row(
                group,
                "cylinder areas, largest deviation",
                *both.of(lambda c: largest(deviations_of(c)[cylinder])),
                source="sec. 6.3" if first else "",
                printed=PRINTED_CYLINDER_UM if first else None,
                note="printed: around" if first else "",
            ),
            row(group, "cylinder areas, rms", *both.of(lambda c: rms(deviations_of(c)[cylinder]))),
            row(
                group,
                "cylinder areas, part with seven periods",
                *both.of(lambda c: float(waves(deviations_of(c)[cylinder], phi[cylinder])[PERIODS])),
                source="sec. 6.3" if first else "",
                note="printed: periodic, no figure" if first else "",
            ),
            row(
                group,
                "six cuboids, largest deviation",
                *both.of(lambda c: largest(deviations_of(c)[cuboid])),
                source="sec. 6.3" if first else "",
                printed=PRINTED_CUBOID_UM if first else None,
                note="printed: roughly" if first else "",
            ),
            row(group, "whole surface, rms", *both.of(lambda c: rms(deviations_of(c)[~unseen]))),
        ]
        known = [np.isfinite(deviations_of(c)[unseen]).sum() for c in (both.theirs, both.ours) if c is not None]
        if min(known) >= LEAST_UNSEEN:
            rows.append(
                row(
                    group,
                    "where a circle does not see the surface, rms",
                    *both.of(lambda c: rms(deviations_of(c)[unseen])),
                )
            )
        group = group.replace("Fig. 12", "Fig. 13")
        rows += [
            row(group, f"errors of L1 to L7, {name}", *both.of(lambda c, f=f: f(list(c["length_um"].values()))))  # type: ignore[misc]
            for name, f in (("rms", rms), ("largest", largest))
        ]
    return rows


def standard_rows(found: Found, runs: tuple[int, ...]) -> list[StudyRow]:
    """Figs. 14 to 16; what the true matrices would give, and the order of the views, where these were looked at."""
    mpe = limit(true_distances())
    rows = []
    for path, run in scans(runs):
        both = Pair(found, "standard", path, run)
        scan = f"{path} scan" + (f", calibration run {run}" if run else "")
        rows += [
            row(f"Fig. 14, {scan}", "errors of 351 distances, rms", *both.of(lambda c: rms(c["distance_um"]))),
            row(f"Fig. 14, {scan}", "errors of 351 distances, largest", *both.of(lambda c: largest(c["distance_um"]))),
            row(
                f"Fig. 14, {scan}",
                "largest share of the MPE",
                *both.of(lambda c: float(np.max(np.abs(c["distance_um"]) / mpe))),
                unit="1",
                source="sec. 6.3",
                note="printed: below the MPE",
            ),
            row(f"Fig. 15, {scan}", "errors of 27 diameters, rms", *both.of(lambda c: rms(c["diameter_um"]))),
            row(f"Fig. 15, {scan}", "scatter of 27 diameters", *both.of(lambda c: float(np.std(c["diameter_um"])))),
            row(
                f"Fig. 16, {scan}",
                "sphericity, mean of 27",
                *both.of(lambda c: float(np.mean(c["form_um"]))),
                note="all points of a ball",
            ),
            row(
                f"Fig. 16, {scan}",
                "sphericity of 95 %, mean of 27",
                *both.of(lambda c: float(np.mean(c["form_95_um"]))),
            ),
        ]
    if true := found.get("standard-3D-best-run0"):
        rows += [
            StudyRow(
                group="3D scan of the standard with the true matrices",
                quantity=name,
                unit="um",
                best=value,
                note="what path, views and voxels leave",
            )
            for name, value in (
                ("errors of 351 distances, rms", rms(true["distance_um"])),
                ("scatter of 27 diameters", float(np.std(true["diameter_um"]))),
                ("sphericity, mean of 27", float(np.mean(true["form_um"]))),
            )
        ]
    for order in ORDERS:
        if case := found.get(f"standard-3D-best-run1-{order}"):
            rows += [
                StudyRow(
                    group="One iteration of SART, 3D scan, our matrices",
                    unit="um",
                    quantity=f"{name}, views in {order} order",
                    best=value,
                )
                for name, value in (
                    ("errors of 351 distances, rms", rms(case["distance_um"])),
                    ("sphericity, mean of 27", float(np.mean(case["form_um"]))),
                )
            ]
    return rows


def calibration_rows(
    residuals: Mapping[tuple[float, int], tuple[float, float]], errors: Mapping[tuple[float, int], tuple[float, float]]
) -> list[StudyRow]:
    """Residual (px) and error of the 3D scan's matrices (um) of each run, by both methods."""
    rows = []
    for (m, run), pair in residuals.items():
        rows += [
            row(f"Calibration at M {m}", f"d_rms_opt, run {run}", *pair, unit="px"),
            row(
                f"Calibration at M {m}",
                f"error of the 3D scan, run {run}",
                *errors[m, run],
                note="rms at the object's corners, rigid pose removed",
            ),
        ]
    return rows
