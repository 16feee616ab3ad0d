"""A measurement plan carried out on one or more volumes: edges, features, measurands, beside their references."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.bench import Bench, by_reference, sphere_name
from tomopose.measurement.features import measurands as m
from tomopose.measurement.features.feature import Feature, noise_range
from tomopose.measurement.plan import ANGLES, LimitPlan, MeasurandPlan, MeasurementPlan, SpheresPlan
from tomopose.measurement.regions import given
from tomopose.measurement.result import FORMS, MeasurementResult
from tomopose.measurement.results import MeasurementResults
from tomopose.provenance import Provenance
from tomopose.values import require_types
from tomopose.volume import Volume


@require_types
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
        one = Bench(volume, plan)
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


@dataclass(frozen=True, kw_only=True)
class _Target:
    """What a value is held against, mm or rad: reference with its standard uncertainty (nan: not stated), limit."""

    reference: float | None = None
    calibrated: bool = False
    u: float = 0.0
    limit: float | None = None
    rule: str = ""
    workpiece: float | None = None
    drift: float | None = None


def _sphere_rows(
    plan: MeasurementPlan, spheres: SpheresPlan, features: Mapping[str, Feature], scale: float
) -> list[MeasurementResult]:
    """Distances, diameters and form deviations of the spheres that were found; lengths times `scale`."""
    calibrated = np.array(spheres.centres)
    fits = {k: features[sphere_name(k)] for k in range(len(calibrated)) if sphere_name(k) in features}

    def row(name: str, kind: m.Kind, found: m.Measured, of: tuple[Feature, ...], target: _Target) -> MeasurementResult:
        scaled = replace(found, value=found.value * scale, u=found.u * scale)
        return _result(plan, name, kind, scaled, of, target)

    def target_of(true: float, u: float | None, limit: LimitPlan | None) -> _Target:
        u_true, drift = math.nan if u is None else u, plan.uncertainty.u_drift_mm
        return _Target(reference=true, calibrated=True, u=u_true, limit=_mpe(limit, true), rule="MPE", drift=drift)

    rows = []
    for i, j in combinations(fits, 2):
        true = float(np.linalg.norm(calibrated[i] - calibrated[j]))
        target = target_of(true, spheres.u_distance_mm, spheres.mpe_distance)
        pair = fits[i], fits[j]
        rows.append(row(f"SD {i + 1:02d}-{j + 1:02d}", "distance", m.distance(*pair), pair, target))
    diameters = spheres.calibrated_diameters_mm or (spheres.diameter_mm,) * len(calibrated)
    for k, f in fits.items():
        target = target_of(diameters[k], spheres.u_diameter_mm, spheres.mpe_diameter)
        rows.append(row(f"D {k + 1:02d}", "diameter", m.diameter(f), (f,), target))
    for which in FORMS:
        rows += [row(f"{which} {k + 1:02d}", which, m.form(f, which), (f,), _Target()) for k, f in fits.items()]
    return rows


def _row(
    plan: MeasurementPlan, p: MeasurandPlan, features: Mapping[str, Feature], alignment: Alignment
) -> MeasurementResult:
    used = tuple(features[name] for name in p.of)
    try:
        if p.reference is not None:
            used = (by_reference(used[0], p.reference),)
        found = _evaluated(p, used, alignment)
    except InputError as error:
        raise InputError(f"measurand {p.name!r}: {error}") from error
    return _result(plan, p.name, p.kind, found, used, _target(plan, p))


def _evaluated(p: MeasurandPlan, features: tuple[Feature, ...], alignment: Alignment) -> m.Measured:
    one, two = features[0], features[-1]
    if p.kind == "distance":
        return m.distance(one, two, rule=p.rule)
    if p.kind == "angle":
        return m.angle(one, two)
    if p.kind == "diameter":
        return m.diameter(one)
    if p.kind == "apex_angle":
        return m.apex_angle(one)
    if p.kind == "position":
        return m.position(one, alignment.points(given(p.nominal_point)))
    if p.kind in FORMS:
        return m.form(one, p.kind, all_points=p.points == "all")
    return m.coordinate(one, p.kind)


def _target(plan: MeasurementPlan, p: MeasurandPlan) -> _Target:
    """Reference, limit and stated terms of a measurand, in mm or rad."""
    unit, factor = ("deg", math.radians(1.0)) if p.kind in ANGLES else ("mm", 1.0)

    def scaled(name: str) -> float | None:
        value = getattr(p, f"{name}_{unit}")
        return None if value is None else float(value) * factor

    calibrated, u = scaled("calibrated"), scaled("u_calibrated")
    reference = scaled("nominal") if calibrated is None else calibrated
    limit, rule = (_mpe(p.mpe, reference), "MPE") if p.mpe is not None else (scaled("tolerance"), "tolerance")
    if reference is None and p.of_zero and limit is not None:
        reference = 0.0
    terms = plan.uncertainty
    workpiece, drift = scaled("u_workpiece"), scaled("u_drift")
    if unit == "mm":
        workpiece = terms.u_workpiece_mm if workpiece is None else workpiece
        drift = terms.u_drift_mm if drift is None else drift
    return _Target(
        reference=reference,
        calibrated=calibrated is not None,
        u=0.0 if calibrated is None else math.nan if u is None else u,
        limit=limit,
        rule=rule,
        workpiece=workpiece,
        drift=drift if calibrated is not None else None,
    )


def _mpe(limit: LimitPlan | None, length: float | None) -> float | None:
    if limit is None or length is None:
        return None
    return m.maximum_permissible_error(length, limit.A_um, limit.K, limit.B_um) / 1000.0


def _result(
    plan: MeasurementPlan, name: str, kind: m.Kind, found: m.Measured, features: tuple[Feature, ...], target: _Target
) -> MeasurementResult:
    if found.unit == "mm" and plan.temperature_C != m.REFERENCE_TEMPERATURE_C and plan.expansion_per_K:
        found = m.at_reference_temperature(found, plan.temperature_C, plan.expansion_per_K)
    terms = {
        "workpiece": target.workpiece,
        "temperature": _u_temperature(plan, found.value) if found.unit == "mm" and kind not in FORMS else None,
        "drift": target.drift,
    }
    return MeasurementResult(
        name=name,
        kind=kind,
        value=found.value,
        u=found.u,
        dof=found.dof,
        unit=found.unit,
        method=found.method,
        direction=found.direction,
        reference=target.reference,
        calibrated=target.calibrated,
        u_reference=target.u,
        limit=target.limit,
        limit_rule=target.rule if target.limit is not None else "",
        association=" and ".join(sorted({f.association for f in features})),
        n_points=sum(len(f.points) for f in features),
        n_set_aside=sum(f.n_set_aside for f in features),
        noise=noise_range(features[0]) if kind in FORMS else 0.0,
        stated={k: u for k, u in terms.items() if u is not None},
        contributions={"fit": found.u},
    )


def _u_temperature(plan: MeasurementPlan, length: float) -> float | None:
    """Standard uncertainty of a length, mm, from those of temperature and expansion: L sqrt((a u_T)^2 + (dT u_a)^2)."""
    terms = plan.uncertainty
    if terms.u_temperature_K is None and terms.u_expansion_per_K is None:
        return None
    away = plan.temperature_C - m.REFERENCE_TEMPERATURE_C
    return abs(length) * math.hypot(
        plan.expansion_per_K * (terms.u_temperature_K or 0.0), away * (terms.u_expansion_per_K or 0.0)
    )
