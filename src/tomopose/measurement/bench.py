"""One volume on the measuring table: the features of a plan, probed or taken from the surface, and fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.alignment import Alignment, Datum, best_fit, datum, from_datums
from tomopose.measurement.features.feature import Association, Feature
from tomopose.measurement.features.fits import (
    feature_distances,
    fit_circle,
    fit_cone,
    fit_cylinder,
    fit_line,
    fit_plane,
    fit_sphere,
)
from tomopose.measurement.features.sphere_standard import CORRELATION_VOXELS, measure_spheres, scale_factor
from tomopose.measurement.plan import FeaturePlan, MeasurementPlan
from tomopose.measurement.probing import probe
from tomopose.measurement.regions import given, nominal_pattern, surface_region
from tomopose.measurement.surface.edges import EdgeSettings, counts_in_words
from tomopose.measurement.surface.grey_levels import GreyLevels, given_levels, grey_levels
from tomopose.measurement.surface.surface import Surface, surface
from tomopose.measurement.zones.reference_features import associated
from tomopose.units import Array
from tomopose.volume import Volume

ROUNDS = 3
"""Times that an alignment is refined: the features are probed again where it puts them."""


def sphere_name(k: int) -> str:
    """Name of the feature that is sphere k, from 0, of a multi-sphere standard."""
    return f"sphere {k + 1:02d}"


class Bench:
    """One volume on the measuring table: what several features share is worked out once."""

    def __init__(self, volume: Volume, plan: MeasurementPlan, *, reach: float = CORRELATION_VOXELS) -> None:
        """reach: voxels over which the fits look for correlation; at 0 points count as independent, which is faster and
        leaves values as they are, but not their uncertainty."""
        self.volume, self.plan = volume, plan
        self._reach = reach * float(volume.grid.spacing.max())
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
            given_direction = None if p.direction is None else np.asarray(p.direction, dtype=np.float64)
            direction = _outward(p) if p.kind == "plane" else given_direction
            nominal.append(datum(p.kind, p.point, direction))
            along = None if direction is None or f.kind in ("sphere", "calotte") else f.direction
            if along is not None and direction is not None and along @ alignment.directions(direction) < 0:
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
        if plan.kind == "line":
            feature = _signed(feature, alignment.directions(given(plan.normal)))
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
        direction = None if plan.direction is None else alignment.directions(plan.direction)
        held = plan.radius_mm if plan.fixed_radius else None
        return by_reference(
            _fit(plan.kind, points, area, outliers=plan.outliers, reach=self._reach, direction=direction, held=held),
            plan.reference,
        )

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


def _fit(
    kind: str,
    points: Array,
    area: Array | None,
    *,
    outliers: float | None,
    reach: float,
    direction: Array | None,
    held: float | None,
) -> Feature:
    """The least-squares feature of a kind; direction: about along the axis, held: the radius, where one is held."""
    if kind in ("sphere", "calotte"):
        return fit_sphere(points, radius=held, area=area, outliers=outliers, correlation_range=reach)
    if kind in ("cylinder", "cone"):
        fit = fit_cylinder if kind == "cylinder" else fit_cone
        return fit(points, direction=direction, area=area, outliers=outliers, correlation_range=reach)
    simple = {"plane": fit_plane, "line": fit_line, "circle": fit_circle}[kind]
    return simple(points, area=area, outliers=outliers, correlation_range=reach)


def by_reference(feature: Feature, reference: Association) -> Feature:
    """The feature of another criterion through the same points.  InputError as `associated`."""
    if reference == feature.association:
        return feature
    if reference != "least-squares":
        return associated(feature, reference)
    again = _least_squares(feature, feature.points[feature.used])
    return replace(
        again,
        points=feature.points,
        used=feature.used,
        residuals=feature_distances(feature.kind, again.vector, feature.points),
        outlier_rule=feature.outlier_rule,
    )


def refitted(feature: Feature, points: Array) -> Feature:
    """The feature fitted again to points (n, 3) that represent its used ones, about where it was, by its own criterion:
    no outlier rule, no correlation, radius held where it was held."""
    return by_reference(_least_squares(feature, points), feature.association)


def _least_squares(feature: Feature, points: Array) -> Feature:
    held = feature.radius if feature.kind in ("sphere", "calotte") and feature.covariance[6, 6] == 0 else None
    direction = feature.direction if feature.kind in ("cylinder", "cone") else None
    again = _fit(feature.kind, points, None, outliers=None, reach=0.0, direction=direction, held=held)
    if feature.kind in ("plane", "cylinder") and again.direction @ feature.direction < 0:
        again = _turned(again)
    return replace(again, kind=feature.kind)


def _signed(line: Feature, normal: Array) -> Feature:
    """A line whose points were probed along a normal, with its residuals signed along it: they lie in one plane."""
    across = normal - (normal @ line.direction) * line.direction
    return replace(line, residuals=(line.points - line.point) @ (across / np.linalg.norm(across)))


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
