"""The measurement plan: a TOML file of what to measure, checked before anything is measured.

Lengths are mm and angles degrees; names of keys say so.  Coordinates are the part's; `alignment.start` takes them
to frame W of the volume.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tomopose.errors import InputError, SchemaVersionError, UnitError
from tomopose.measurement.features.measurands import Kind, Rule
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
    outliers: Positive | None = 3.0
    fixed_radius: bool = False

    @model_validator(mode="after")
    def _complete(self) -> FeaturePlan:
        missing = [name for name in NEEDS[self.kind] if getattr(self, name) is None]
        if missing:
            raise ValueError(f"a {self.kind} needs {', '.join(missing)}")
        if self.kind in PROBED_ONLY and self.source != "normals":
            raise ValueError(f'a {self.kind} is probed: source = "normals"')
        return self


class LimitPlan(_Strict):
    """Maximum permissible error A + L/K, at most B: A and B in micrometres, L in mm."""

    A_um: Positive
    K: Positive | None = None
    B_um: Positive | None = None


class MeasurandPlan(_Strict):
    """A measurand of one or two features."""

    name: str
    kind: Kind
    of: tuple[str, ...]
    rule: Rule = "centroid-of-second"
    nominal_mm: float | None = None
    nominal_deg: float | None = None
    nominal_point: Vector | None = None
    calibrated_mm: float | None = None
    calibrated_deg: float | None = None
    u_calibrated_mm: Length = 0.0
    u_calibrated_deg: Length = 0.0
    tolerance_mm: Positive | None = None
    tolerance_deg: Positive | None = None
    mpe: LimitPlan | None = None

    @model_validator(mode="after")
    def _complete(self) -> MeasurandPlan:
        wanted = 2 if self.kind in PAIRS else 1
        if len(self.of) != wanted:
            raise ValueError(f"{self.kind} {self.name!r} is of {wanted} feature(s); got {list(self.of)}")
        if self.kind == "position" and self.nominal_point is None:
            raise ValueError(f"position {self.name!r} needs nominal_point")
        if self.tolerance_mm is not None and self.mpe is not None:
            raise ValueError(f"{self.name!r} has both a tolerance and an MPE; give one")
        return self


class SpheresPlan(_Strict):
    """A multi-sphere standard: calibrated centres (part coordinates of any orientation), diameters and limits."""

    centres: tuple[Vector, ...]
    diameter_mm: Positive
    calibrated_diameters_mm: tuple[float, ...] | None = None
    u_distance_mm: Length = 0.0
    u_diameter_mm: Length = 0.0
    safety_mm: Length = 0.5
    max_angle_deg: Annotated[float, Field(gt=0, lt=90)] = 15.0
    outliers: Positive | None = 3.0
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
    another calibration) stand beside them, and a volume in no group stands alone.
    """

    schema_: Literal["tomopose/measurement-plan/1"] = Field(alias="schema")
    unit: Literal["mm"]
    name: str = "measurement"
    temperature_C: float = 20.0
    expansion_per_K: float = 0.0
    surface: SurfacePlan = SurfacePlan()
    alignment: AlignmentPlan = AlignmentPlan()
    features: dict[str, FeaturePlan] = {}
    measurands: tuple[MeasurandPlan, ...] = ()
    spheres: SpheresPlan | None = None
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
            raise ValueError(f"datums must be features of the plan; {', '.join(wrong)} is none")
        if self.alignment.kind == "best-fit" and not known:
            raise ValueError("best-fit alignment needs features")
        members = [v for group in self.repeats.values() for v in group]
        shared = sorted({v for v in members if members.count(v) > 1})
        if shared:
            raise ValueError(f"volumes in two groups of repeats: {', '.join(shared)}")
        if not self.measurands and self.spheres is None:
            raise ValueError("the plan measures nothing: give measurands or spheres")
        return self


def plan_from(document: dict[str, Any], where: str = "plan") -> MeasurementPlan:
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
    """Read a plan from TOML.  FileError where it is missing or no TOML; otherwise as `plan_from`."""
    path = Path(path)
    document = parse_toml(read_text(path), path)
    return plan_from(document, path.name)


def plan_schema() -> dict[str, Any]:
    """The JSON schema of a plan."""
    return MeasurementPlan.model_json_schema(by_alias=True)
