"""The measurement plan: a TOML file of what to measure, checked before anything is measured.

Lengths are mm and angles degrees; names of keys say so.  Coordinates are the part's; `alignment.start` takes them
to frame W of the volume.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tomopose.errors import InputError, SchemaVersionError, UnitError
from tomopose.measurement.features.feature import Association
from tomopose.measurement.features.measurands import Kind, Rule
from tomopose.measurement.result import FORMS
from tomopose.reading import parse_toml, read_text, reader

SCHEMA = "tomopose/measurement-plan/1"
Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Length = Annotated[float, Field(ge=0)]
NEEDS = {
    "plane": ("point", "direction", "u", "v"),
    "sphere": ("point", "radius_mm"),
    "calotte": ("point", "radius_mm", "direction", "cap_deg"),
    "cylinder": ("point", "direction", "radius_mm", "length_mm"),
    "cone": ("point", "direction", "radius_mm", "length_mm", "half_angle_deg"),
    "circle": ("point", "direction", "radius_mm"),
    "line": ("point", "direction", "normal", "length_mm"),
}
PROBED_ONLY = ("circle", "line")
PAIRS = ("distance", "angle")
ANGLES = ("angle", "apex_angle")
SIZED = ("circle", "sphere", "cylinder")
"""Kinds that have a circumscribed and an inscribed feature; of a calotte and a cone these are not bounded."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SurfacePlan(_Strict):
    """How edges are found; see the concept page."""

    method: Literal["esf", "local-50"] = "esf"
    search_distance_mm: Positive | None = None
    window_voxel: Positive | None = None
    contrast_threshold: Annotated[float, Field(ge=0, lt=1)] = 0.2
    sigma_mm: Positive | None = None
    plateau_radius_voxel: Length = 3.0
    curvature_correction: bool = False
    background: float | None = None
    material: float | None = None


class FeaturePlan(_Strict):
    """A feature's nominal geometry (part coordinates) and how its points are chosen.

    source: normals probes along the nominal normals; surface takes vertices of the measured surface.
    inward: the material lies outside, as at a bore.
    reference: the criterion by which the feature is fitted, and about which its form is stated.
    outliers: points farther than so many rms from the least-squares fit are set aside; without it every point counts.
    A circle is probed radially, a line along `normal`, which points from material to air.
    """

    kind: Literal["plane", "line", "circle", "sphere", "calotte", "cylinder", "cone"]
    point: Vector
    direction: Vector | None = None
    normal: Vector | None = None
    radius_mm: Positive | None = None
    length_mm: Positive | None = None
    half_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    u: Vector | None = None
    v: Vector | None = None
    cap_deg: Annotated[float, Field(gt=0, le=180)] | None = None
    inward: bool = False
    source: Literal["normals", "surface"] = "normals"
    n_points: Annotated[int, Field(ge=10)] = 1000
    safety_mm: Length = 0.5
    max_angle_deg: Annotated[float, Field(gt=0, lt=90)] = 15.0
    band_mm: Positive | None = None
    reference: Association = "least-squares"
    outliers: Positive | None = None
    fixed_radius: bool = False

    @model_validator(mode="after")
    def _complete(self) -> FeaturePlan:
        missing = [name for name in NEEDS[self.kind] if getattr(self, name) is None]
        if missing:
            raise ValueError(f"a {self.kind} needs {', '.join(missing)}")
        if self.kind in PROBED_ONLY and self.source != "normals":
            raise ValueError(f'a {self.kind} is probed: source = "normals"')
        require_reference(self.kind, self.reference)
        if self.fixed_radius and self.reference != "least-squares":
            raise ValueError(f"fixed_radius holds the radius of a least-squares feature; reference is {self.reference}")
        return self


def require_reference(kind: str, reference: Association) -> None:
    """ValueError where a kind has no such reference feature."""
    if reference in ("minimum-circumscribed", "maximum-inscribed") and kind not in SIZED:
        raise ValueError(
            f"a {kind} has no {reference} feature; {', '.join(SIZED)} have one, and a {kind} takes least-squares or "
            "minimum-zone"
        )


class LimitPlan(_Strict):
    """Maximum permissible error A + L/K, at most B: A and B in micrometres, L in mm."""

    A_um: Positive
    K: Positive | None = None
    B_um: Positive | None = None


class UncertaintyPlan(_Strict):
    """What no scan shows, as standard uncertainties (VDI/VDE 2630-2.1): u_w of the workpiece and the drift of the
    reference since its calibration; the temperature during the scan and the expansion coefficient act on lengths.

    A term that is not given is not in the interval, and `interval` names those that are.
    """

    u_workpiece_mm: Length | None = None
    u_drift_mm: Length | None = None
    u_temperature_K: Length | None = None
    u_expansion_per_K: Length | None = None


class MeasurandPlan(_Strict):
    """A measurand of one or two features.

    points: all, or kept, of a form deviation: without those that the feature's outlier rule set aside.
    reference: of a form deviation, about another feature than the one that the plan fits for all else.
    u_calibrated_mm (deg): standard uncertainty of the calibrated value; 0 says exact.  Not stated, no conformity is.
    u_drift_mm, u_workpiece_mm: in place of those of [uncertainty].
    """

    name: str
    kind: Kind
    of: tuple[str, ...]
    rule: Rule = "centroid-of-second"
    points: Literal["all", "kept"] = "all"
    reference: Association | None = None
    nominal_mm: float | None = None
    nominal_deg: float | None = None
    nominal_point: Vector | None = None
    calibrated_mm: float | None = None
    calibrated_deg: float | None = None
    u_calibrated_mm: Length | None = None
    u_calibrated_deg: Length | None = None
    u_drift_mm: Length | None = None
    u_drift_deg: Length | None = None
    u_workpiece_mm: Length | None = None
    u_workpiece_deg: Length | None = None
    tolerance_mm: Positive | None = None
    tolerance_deg: Positive | None = None
    mpe: LimitPlan | None = None

    @property
    def of_zero(self) -> bool:
        """Whether the ideal value is zero by definition: form and position deviations."""
        return self.kind in (*FORMS, "position")

    @model_validator(mode="after")
    def _complete(self) -> MeasurandPlan:
        wanted = 2 if self.kind in PAIRS else 1
        if len(self.of) != wanted:
            raise ValueError(f"{self.kind} {self.name!r} is of {wanted} feature(s); got {list(self.of)}")
        if self.kind == "position" and self.nominal_point is None:
            raise ValueError(f"position {self.name!r} needs nominal_point")
        if self.kind not in FORMS and (self.points != "all" or self.reference is not None):
            raise ValueError(f"{self.name!r} is a {self.kind}: points and reference belong to form deviations")
        return self

    @model_validator(mode="after")
    def _limited(self) -> MeasurandPlan:
        if self.tolerance_mm is not None and self.mpe is not None:
            raise ValueError(f"{self.name!r} has both a tolerance and an MPE; give one")
        unit, other = ("deg", "mm") if self.kind in ANGLES else ("mm", "deg")
        keys = ("nominal", "calibrated", "u_calibrated", "u_drift", "u_workpiece", "tolerance")
        wrong = [f"{k}_{other}" for k in keys if getattr(self, f"{k}_{other}") is not None]
        if self.kind in ANGLES and self.mpe is not None:
            wrong.append("mpe")
        if wrong:
            raise ValueError(f"{self.name!r} is a {self.kind} in {unit}: it takes no {', '.join(wrong)}")
        limited = self.mpe is not None or getattr(self, f"tolerance_{unit}") is not None
        if limited and not self.of_zero and self.target is None:
            raise ValueError(
                f"{self.name!r} has a limit and no value that it belongs to: give nominal_{unit} or calibrated_{unit}"
            )
        return self

    @property
    def target(self) -> float | None:
        """The calibrated value, else the nominal one; mm or degrees."""
        unit = "deg" if self.kind in ANGLES else "mm"
        calibrated, nominal = (getattr(self, f"{k}_{unit}") for k in ("calibrated", "nominal"))
        result: float | None = nominal if calibrated is None else calibrated
        return result


class SpheresPlan(_Strict):
    """A multi-sphere standard: calibrated centres (part coordinates of any orientation), diameters and limits."""

    centres: tuple[Vector, ...]
    diameter_mm: Positive
    calibrated_diameters_mm: tuple[float, ...] | None = None
    u_distance_mm: Length | None = None
    u_diameter_mm: Length | None = None
    safety_mm: Length = 0.5
    max_angle_deg: Annotated[float, Field(gt=0, lt=90)] = 15.0
    outliers: Positive | None = None
    tolerance_mm: Positive = 0.3
    scale_correction: bool = False
    mpe_distance: LimitPlan | None = None
    mpe_diameter: LimitPlan | None = None

    @model_validator(mode="after")
    def _complete(self) -> SpheresPlan:
        if len(self.centres) < 4:
            raise ValueError(f"{len(self.centres)} spheres; a constellation needs at least 4")
        if self.calibrated_diameters_mm is not None and len(self.calibrated_diameters_mm) != len(self.centres):
            raise ValueError(f"{len(self.calibrated_diameters_mm)} diameters for {len(self.centres)} centres")
        return self


class AcceptancePlan(_Strict):
    """What the acceptance protocol of a multi-sphere standard needs beside [spheres].

    mpe_E, mpe_SD: of lengths and of sphere distances (mpe_distance of [spheres] unless given); mpe_PS_um, mpe_PF_um: of
    the probing error's size and form;  u_form_mm: standard uncertainty that the spheres' own form leaves in P_F, 0 says
    none;  longest_length_mm: the longest length that the measuring volume holds.
    """

    mpe_E: LimitPlan | None = None
    mpe_SD: LimitPlan | None = None
    mpe_PS_um: Positive | None = None
    mpe_PF_um: Positive | None = None
    u_form_mm: Length | None = None
    longest_length_mm: Positive | None = None
    machine: str = ""
    standard: str = ""
    certificate: str = ""
    operator: str = ""
    place: str = ""

    def header(self) -> dict[str, str]:
        """Who and what, as the plan states it; empty where it does not."""
        return {k: getattr(self, k) for k in ("machine", "standard", "certificate", "operator", "place")}


class AlignmentPlan(_Strict):
    """Where the part lies in W.

    start: rows of (3, 4), part coordinates to W, mm;  kind: none keeps it; datum refines it by three features, 3-2-1;
    best-fit moves it until all features together lie as near to their nominal places as they can.
    """

    kind: Literal["none", "datum", "best-fit"] = "none"
    start: tuple[tuple[float, float, float, float], ...] = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))
    datums: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _complete(self) -> AlignmentPlan:
        if len(self.start) != 3:
            raise ValueError(f"start has {len(self.start)} rows; 3 of 4 numbers are needed")
        if self.kind == "datum" and len(self.datums) != 3:
            raise ValueError(f"datum alignment needs three features in datums; got {list(self.datums)}")
        return self


class MeasurementPlan(_Strict):
    """A whole plan.

    repeats: name of a group -> the volumes that repeat one measurement; volumes of other groups (another trajectory,
    another calibration) are shown beside them, and a volume in no group by itself.
    """

    schema_: Literal["tomopose/measurement-plan/1"] = Field(alias="schema")
    unit: Literal["mm"]
    name: str = "measurement"
    temperature_C: float = 20.0
    expansion_per_K: float = 0.0
    uncertainty: UncertaintyPlan = UncertaintyPlan()
    surface: SurfacePlan = SurfacePlan()
    alignment: AlignmentPlan = AlignmentPlan()
    features: dict[str, FeaturePlan] = {}
    measurands: tuple[MeasurandPlan, ...] = ()
    spheres: SpheresPlan | None = None
    acceptance: AcceptancePlan = AcceptancePlan()
    repeats: dict[str, tuple[str, ...]] = {}

    @model_validator(mode="after")
    def _consistent(self) -> MeasurementPlan:
        known = set(self.features)
        for m in self.measurands:
            unknown = [f for f in m.of if f not in known]
            if unknown:
                raise ValueError(
                    f"measurand {m.name!r} names the unknown feature {', '.join(unknown)}; known: "
                    f"{', '.join(sorted(known)) or 'none'}"
                )
        names = [m.name for m in self.measurands]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"measurands named twice: {', '.join(twice)}")
        wrong = [d for d in self.alignment.datums if d not in known]
        if wrong:
            raise ValueError(f"datums must be features of the plan; it has no {', '.join(wrong)}")
        if self.alignment.kind == "best-fit" and not known:
            raise ValueError("best-fit alignment needs features")
        for m in self.measurands:
            if m.reference is not None:
                require_reference(self.features[m.of[0]].kind, m.reference)
        members = [v for group in self.repeats.values() for v in group]
        shared = sorted({v for v in members if members.count(v) > 1})
        if shared:
            raise ValueError(f"volumes in two groups of repeats: {', '.join(shared)}")
        if not self.measurands and self.spheres is None:
            raise ValueError("the plan measures nothing: give measurands or spheres")
        return self


def plan_from(document: dict[str, object], where: str = "plan") -> MeasurementPlan:
    """A plan from a document as TOML gives it.

    Raises SchemaVersionError for another schema, UnitError without unit = "mm", InputError for anything else wrong.
    """
    if document.get("schema") != SCHEMA:
        raise SchemaVersionError(f"{where}: schema is {document.get('schema')!r}; {SCHEMA!r} is needed", path=where)
    if document.get("unit") != "mm":
        raise UnitError(f'{where}: unit is {document.get("unit")!r}; write unit = "mm" and give lengths in mm')
    try:
        return MeasurementPlan.model_validate(document)
    except ValidationError as error:
        faults = "; ".join(
            f"{'.'.join(str(p) for p in e['loc']) or 'plan'}: {e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        )
        raise InputError(f"{where}: {faults}") from error


@reader("measurement plan")
def read_plan(path: str | Path) -> MeasurementPlan:
    """Read a plan from TOML.  FileError where it is missing or not TOML; otherwise as `plan_from`."""
    path = Path(path)
    document = parse_toml(read_text(path), path)
    return plan_from(document, path.name)


def plan_schema() -> dict[str, Any]:
    """The JSON schema of a plan."""
    return MeasurementPlan.model_json_schema(by_alias=True)
