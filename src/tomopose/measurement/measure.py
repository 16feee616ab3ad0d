"""A measurement plan carried out on one or more volumes: edges, features, measurands, beside their references."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.alignment import Alignment, Datum, best_fit, datum, from_datums
from tomopose.measurement.features import measurands as m
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.features.fits import fit_circle, fit_cone, fit_cylinder, fit_line, fit_plane, fit_sphere
from tomopose.measurement.features.sphere_standard import CORRELATION_VOXELS, measure_spheres, scale_factor
from tomopose.measurement.plan import FeaturePlan, LimitPlan, MeasurandPlan, MeasurementPlan, SpheresPlan
from tomopose.measurement.probing import probe
from tomopose.measurement.regions import nominal_pattern, surface_region
from tomopose.measurement.results import MeasurementResult, MeasurementResults
from tomopose.measurement.surface.edges import EdgeSettings, counts_in_words
from tomopose.measurement.surface.grey_levels import GreyLevels, given_levels, grey_levels
from tomopose.measurement.surface.surface import Surface, surface
from tomopose.provenance import Provenance
from tomopose.units import Array
from tomopose.volume import Volume

ROUNDS = 3
"""Times that an alignment is refined: the features are probed again where it puts them."""


def measure(
    volumes: Volume | Mapping[str, Volume],
    plan: MeasurementPlan,
    *,
    provenance: Provenance | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MeasurementResults:
    """Carry out a plan.

    volumes: one, or several by name: repeat scans, trajectories or calibrations side by side.

    Raises InputError, with the feature's name, where a region holds no points, points are degenerate or no edge is
    found; EngineMissingError where a surface is needed and VTK is missing.
    """
    named = {"volume": volumes} if isinstance(volumes, Volume) else dict(volumes)
    if not named:
        raise InputError("there is no volume to measure")
    absent = sorted({v for group in plan.repeats.values() for v in group} - set(named))
    if absent:
        raise InputError(f"the plan's repeats name the volumes {', '.join(absent)}; given: {', '.join(named)}")
    results: list[MeasurementResult] = []
    features: dict[str, Mapping[str, Feature]] = {}
    notes: dict[str, tuple[str, ...]] = {}
    scale: dict[str, float] = {}
    alignments: dict[str, Alignment] = {}
    for done, (name, volume) in enumerate(named.items()):
        one = _Bench(volume, plan)
        alignments[name] = one.alignment()
        found = one.features(alignments[name])
        if plan.spheres is not None:
            balls, scale[name] = one.spheres()
            found = {**found, **balls}
        results += [replace(r, volume=name) for r in evaluate(plan, found, alignments[name], scale.get(name, 1.0))]
        features[name], notes[name] = found, tuple(one.notes)
        if progress is not None:
            progress(done + 1, len(named))
    return MeasurementResults(
        plan_name=plan.name,
        results=tuple(results),
        features=features,
        notes=notes,
        scale=scale,
        alignments=alignments,
        groups=plan.repeats,
        spacing_mm={n: float(v.grid.spacing.max()) for n, v in named.items()},
        provenance=provenance,
    )


def evaluate(
    plan: MeasurementPlan, features: Mapping[str, Feature], alignment: Alignment, scale: float = 1.0
) -> list[MeasurementResult]:
    """All measurands of a plan from its fitted features (those of a multi-sphere standard by `sphere_name`)."""
    rows = [_row(plan, p, features, alignment) for p in plan.measurands]
    return rows if plan.spheres is None else rows + _sphere_rows(plan, plan.spheres, features, scale)


def refitted(feature: Feature, points: Array) -> Feature:
    """The feature fitted again to points (n, 3) that stand for its used ones, about where it was: no outlier rule, no
    correlation, radius held where it was held."""
    held = feature.radius if feature.kind in ("sphere", "calotte") and feature.covariance[6, 6] == 0 else None
    if feature.kind in ("sphere", "calotte"):
        again = fit_sphere(points, radius=held)
    elif feature.kind in ("cylinder", "cone"):
        again = (fit_cylinder if feature.kind == "cylinder" else fit_cone)(points, direction=feature.direction)
    else:
        again = {"plane": fit_plane, "line": fit_line, "circle": fit_circle}[feature.kind](points)
    if feature.kind in ("plane", "cylinder") and again.direction @ feature.direction < 0:
        again = _turned(again)
    return replace(again, kind=feature.kind)


def sphere_name(k: int) -> str:
    """Name of the feature that is sphere k, from 0, of a multi-sphere standard."""
    return f"sphere {k + 1:02d}"


class _Bench:
    """One volume on the measuring table: what several features share is worked out once."""

    def __init__(self, volume: Volume, plan: MeasurementPlan) -> None:
        self.volume, self.plan = volume, plan
        self.notes: list[str] = []
        s = plan.surface
        if (s.background is None) != (s.material is None):
            raise InputError("surface: background and material levels are given together or not at all")
        self.levels: GreyLevels = (
            given_levels(s.background, s.material)
            if s.background is not None and s.material is not None
            else grey_levels(volume)[-1]
        )
        unit = float(volume.grid.spacing.min())
        search = EdgeSettings().search_distance if s.search_distance_mm is None else s.search_distance_mm / unit
        self.settings = EdgeSettings(
            search_distance=search,
            window=s.window_voxel,
            contrast_threshold=s.contrast_threshold,
            method=s.method,
            sigma=s.sigma_mm,
            plateau_radius=s.plateau_radius_voxel,
        )
        self._surface: Surface | None = None

    def surface(self) -> Surface:
        if self._surface is None:
            self._surface = surface(
                self.volume,
                levels=self.levels,
                method=self.plan.surface.method,
                edges=self.settings,
                curvature_correction=self.plan.surface.curvature_correction,
            )
            self.notes += [f"surface: {n}" for n in self._surface.notes]
        return self._surface

    def features(self, alignment: Alignment) -> dict[str, Feature]:
        """All features of the plan by name."""
        return {name: self._feature(name, p, alignment) for name, p in self.plan.features.items()}

    def alignment(self) -> Alignment:
        """From part coordinates to W: the plan's start, refined by the datum planes where it says so."""
        a = self.plan.alignment
        rows = np.array(a.start, dtype=np.float64)
        alignment = Alignment(R=rows[:, :3], t=rows[:, 3], rule="given")
        if a.kind == "none":
            return alignment
        for _ in range(ROUNDS):
            alignment = self._by_datums(alignment) if a.kind == "datum" else self._by_all(alignment)
        self.notes.append(
            f"alignment {alignment.rule}: R = {np.round(alignment.R, 8).tolist()}, t = "
            f"{np.round(alignment.t, 5).tolist()} mm"
        )
        return alignment

    def _by_datums(self, alignment: Alignment) -> Alignment:
        """3-2-1, datums measured where the alignment puts them."""
        nominal: list[Datum] = []
        measured: list[Datum] = []
        for name in self.plan.alignment.datums:
            p = self.plan.features[name]
            f = self._feature(name, p, alignment)
            direction = _outward(p) if p.kind == "plane" else p.direction
            nominal.append(datum(p.kind, p.point, direction))
            along = None if direction is None or f.kind in ("sphere", "calotte") else f.direction
            if along is not None and along @ alignment.directions(direction) < 0:
                along = -along
            measured.append(datum(p.kind, f.point, along))
        return from_datums((nominal[0], nominal[1], nominal[2]), (measured[0], measured[1], measured[2]))

    def _by_all(self, alignment: Alignment) -> Alignment:
        """One step of the best fit of all features to their nominal geometry."""
        patterns = [nominal_pattern(p, alignment) for p in self.plan.features.values()]
        x, n = (np.concatenate([p[k] for p in patterns]) for k in (0, 1))
        found = probe(self.volume, x, n, settings=self.settings, contrast=self.levels.contrast)
        good = found.good
        return best_fit(
            alignment, (x[good] - alignment.t) @ alignment.R, n[good] @ alignment.R, found.edges.offset[good]
        )

    def _feature(self, name: str, plan: FeaturePlan, alignment: Alignment) -> Feature:
        try:
            points, normals, sigma, area = self._points(plan, alignment)
            feature = self._fitted(plan, alignment, points, area)
        except InputError as error:
            raise InputError(f"feature {name!r}: {error}") from error
        if plan.kind == "plane" and feature.direction @ normals.mean(axis=0) < 0:
            feature = _turned(feature)
        if plan.source == "normals" and self.plan.surface.curvature_correction:
            feature = _curvature_corrected(feature, sigma)
        return replace(feature, kind=plan.kind)

    def _points(self, plan: FeaturePlan, alignment: Alignment) -> tuple[Array, Array, float, Array | None]:
        """Measured points (n, 3) of a feature, their normals, the blur, mm, and the areas of a surface's points."""
        if plan.source == "surface":
            s = self.surface()
            region = surface_region(plan, alignment, s.points, s.normals)
            chosen = region & s.good
            if not chosen.any():
                without = f" with an edge, {int(region.sum())} without ({counts_in_words(s.flags[region])})"
                raise InputError(
                    f"its region holds no surface points{without if region.any() else ''}; check point, band_mm, "
                    "safety_mm and the alignment against the volume"
                )
            return s.points[chosen], s.normals[chosen], s.sigma, s.areas[chosen]
        x, n = nominal_pattern(plan, alignment)
        # Shared plateaus make points quieter, not lengths, and errors common to a whole small feature do not show in
        # its residuals: each point keeps its own.
        own = replace(self.settings, plateau_radius=0.0)
        found = probe(self.volume, x, n, settings=own, contrast=self.levels.contrast)
        lost = int((~found.good).sum())
        if lost:
            self.notes.append(f"{lost} of {len(x)} probed points of a {plan.kind} met no good edge")
        return found.points[found.good], found.normals[found.good], found.edges.sigma, None

    def _fitted(self, plan: FeaturePlan, alignment: Alignment, points: Array, area: Array | None) -> Feature:
        options: dict[str, Any] = {
            "area": area,
            "outliers": plan.outliers,
            "correlation_range": CORRELATION_VOXELS * float(self.volume.grid.spacing.max()),
        }
        simple = {"plane": fit_plane, "line": fit_line, "circle": fit_circle}
        if plan.kind in simple:
            return simple[plan.kind](points, **options)
        if plan.kind in ("sphere", "calotte"):
            held = plan.radius_mm if plan.fixed_radius else None
            return fit_sphere(points, radius=held, **options)
        fit = fit_cylinder if plan.kind == "cylinder" else fit_cone
        return fit(points, direction=alignment.directions(plan.direction), **options)

    def spheres(self) -> tuple[dict[str, Feature], float]:
        """The multi-sphere standard: its spheres by name, and the factor on its lengths."""
        plan = self.plan.spheres
        if plan is None:
            raise InputError("the plan has no spheres")
        calibrated = np.array(plan.centres)
        fits, which = measure_spheres(
            self.surface(),
            calibrated,
            plan.diameter_mm,
            tolerance=plan.tolerance_mm,
            safety=plan.safety_mm,
            max_angle=float(np.radians(plan.max_angle_deg)),
            outliers=plan.outliers,
        )
        numbers = sorted(fits)
        factor = scale_factor(np.array([fits[k].point for k in numbers]), calibrated[numbers])
        self.notes += [
            f"spheres: {len(numbers)} of {len(calibrated)} found and identified, rms {which.rms * 1000:.1f} um",
            f"scale factor from centre distances: {factor:.8f}, "
            f"{'applied' if plan.scale_correction else 'not applied'}",
        ]
        missing = [k + 1 for k in range(len(calibrated)) if k not in fits]
        if missing:
            self.notes.append(f"spheres not found: {missing}")
        return {sphere_name(k): fits[k] for k in numbers}, factor if plan.scale_correction else 1.0


def _sphere_rows(
    plan: MeasurementPlan, spheres: SpheresPlan, features: Mapping[str, Feature], scale: float
) -> list[MeasurementResult]:
    """Distances, diameters and form deviations of the spheres that were found; lengths times `scale`."""
    calibrated = np.array(spheres.centres)
    fits = {k: features[sphere_name(k)] for k in range(len(calibrated)) if sphere_name(k) in features}

    def row(
        name: str,
        kind: str,
        found: m.Measured,
        reference: float | None,
        u_reference: float = 0.0,
        limit: LimitPlan | None = None,
    ) -> MeasurementResult:
        scaled = replace(found, value=found.value * scale, u=found.u * scale)
        return _result(plan, name, kind, scaled, reference, u_reference, _mpe(limit, reference), "MPE")

    rows = []
    for i, j in combinations(fits, 2):
        true = float(np.linalg.norm(calibrated[i] - calibrated[j]))
        rows.append(
            row(
                f"SD {i + 1:02d}-{j + 1:02d}",
                "distance",
                m.distance(fits[i], fits[j]),
                true,
                spheres.u_distance_mm,
                spheres.mpe_distance,
            )
        )
    diameters = spheres.calibrated_diameters_mm or (spheres.diameter_mm,) * len(calibrated)
    for k, f in fits.items():
        rows.append(
            row(f"D {k + 1:02d}", "diameter", m.diameter(f), diameters[k], spheres.u_diameter_mm, spheres.mpe_diameter)
        )
    for which_form in ("form", "form_95", "form_25"):
        rows += [row(f"{which_form} {k + 1:02d}", which_form, m.form(f, which_form), None) for k, f in fits.items()]
    return rows


def _outward(plan: FeaturePlan) -> Array:
    n = np.asarray(plan.direction, dtype=np.float64)
    return n / np.linalg.norm(n) * (-1.0 if plan.inward else 1.0)


def _turned(plane: Feature) -> Feature:
    """The same plane with its normal the other way round, and its residuals with it."""
    flip = np.array([1, 1, 1, -1, -1, -1, 1, 1.0])
    return replace(
        plane,
        vector=plane.vector * flip,
        covariance=plane.covariance * np.outer(flip, flip),
        residuals=-plane.residuals,
    )


def _curvature_corrected(feature: Feature, sigma: float) -> Feature:
    """A ball's radius plus sigma^2 / R, a cylinder's, a cone's or a circle's plus half of that: blur moves a curved
    surface towards its centre, whichever side the material is on."""
    share = {"sphere": 1.0, "calotte": 1.0, "cylinder": 0.5, "cone": 0.5, "circle": 0.5}.get(feature.kind)
    if share is None:
        return feature
    vector = np.array(feature.vector)
    vector[6] += share * sigma**2 / vector[6]
    return replace(feature, vector=vector)


def _row(
    plan: MeasurementPlan, p: MeasurandPlan, features: Mapping[str, Feature], alignment: Alignment
) -> MeasurementResult:
    one, two = features[p.of[0]], features[p.of[-1]]
    try:
        if p.kind == "distance":
            found = m.distance(one, two, rule=p.rule)
        elif p.kind == "angle":
            found = m.angle(one, two)
        elif p.kind == "diameter":
            found = m.diameter(one)
        elif p.kind == "apex_angle":
            found = m.apex_angle(one)
        elif p.kind == "position":
            found = m.position(one, alignment.points(p.nominal_point))
        elif p.kind in ("form", "form_95", "form_25"):
            found = m.form(one, p.kind)
        else:
            found = m.coordinate(one, p.kind)
    except InputError as error:
        raise InputError(f"measurand {p.name!r}: {error}") from error
    if p.kind in m.UNITS:
        reference = p.calibrated_deg if p.calibrated_deg is not None else p.nominal_deg
        degree = math.radians(1.0)
        return _result(
            plan,
            p.name,
            p.kind,
            found,
            None if reference is None else reference * degree,
            p.u_calibrated_deg * degree,
            None if p.tolerance_deg is None else p.tolerance_deg * degree,
            "tolerance",
        )
    length = p.calibrated_mm if p.calibrated_mm is not None else p.nominal_mm
    limit, rule = (_mpe(p.mpe, length), "MPE") if p.mpe is not None else (p.tolerance_mm, "tolerance")
    return _result(plan, p.name, p.kind, found, length, p.u_calibrated_mm, limit, rule)


def _mpe(limit: LimitPlan | None, length: float | None) -> float | None:
    if limit is None or length is None:
        return None
    return m.maximum_permissible_error(length, limit.A_um, limit.K, limit.B_um) / 1000.0


def _result(
    plan: MeasurementPlan,
    name: str,
    kind: str,
    found: m.Measured,
    reference: float | None,
    u_reference: float,
    limit: float | None,
    rule: str,
) -> MeasurementResult:
    if found.unit == "mm" and plan.temperature_C != m.REFERENCE_TEMPERATURE_C and plan.expansion_per_K:
        found = m.at_reference_temperature(found, plan.temperature_C, plan.expansion_per_K)
    return MeasurementResult(
        name=name,
        kind=kind,
        value=found.value,
        u=found.u,
        dof=found.dof,
        unit=found.unit,
        method=found.method,
        direction=found.direction,
        reference=reference,
        u_reference=u_reference,
        limit=limit,
        limit_rule=rule if limit is not None else "",
        contributions={"fit": found.u},
    )
