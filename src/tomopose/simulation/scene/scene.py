"""The scene file: TOML in, checked model out.  Its keys carry units; docs/formats/scene.md lists them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tomopose.errors import InputError
from tomopose.reading import parse_toml, read_text, reader
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.detector.scatter_glare_mtf import Glare, Scatter

SCHEMA = "tomopose/scene/1"
Vector = tuple[float, float, float]


class Part(BaseModel):
    """Every table of a scene: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ScannerPart(Part):
    d_SD_mm: float
    d_SR_mm: float
    p_u_mm: float
    p_v_mm: float
    u_0_px: float
    v_0_px: float
    n_u_px: int
    n_v_px: int
    eta_rad: float = 0.0
    theta_rad: float = 0.0
    phi_rad: float = 0.0
    image_rows: Literal["top-first", "bottom-first"] = "top-first"
    binning: int = Field(
        1, ge=1, description="the charges of binning x binning pixels are summed; all sizes and px are unbinned"
    )


class FilterPart(Part):
    material: str
    thickness_mm: float


class SpotPart(Part):
    shape: Literal["point", "gaussian", "disc", "rectangle"] = "point"
    size_u_mm: float = 0.0
    size_v_mm: float = 0.0
    method: Literal["convolved", "sampled"] = "convolved"
    points: int = 21


class SourcePart(Part):
    voltage_kV: float | None = None
    anode: str = "W"
    anode_angle_deg: float = 12.0
    spectrum: str | None = Field(None, description="CSV with columns energy_keV, photons, in place of voltage_kV")
    filters: tuple[FilterPart, ...] = ()
    spot: SpotPart = SpotPart()

    @model_validator(mode="after")
    def _one_spectrum(self) -> SourcePart:
        if (self.voltage_kV is None) == (self.spectrum is None):
            raise ValueError("give either voltage_kV or spectrum")
        return self


class ScatterPart(Part):
    constant: float = Scatter.constant
    amount: float = Scatter.amount
    sigma_px: float = Scatter.sigma


class GlarePart(Part):
    share: float = Glare.share
    sigma_px: float = Glare.sigma


class MTFPart(Part):
    frequency_per_px: tuple[float, ...]
    value: tuple[float, ...]


class DetectorPart(Part):
    """The detector's own defaults, in the units of its keys."""

    scintillator: str = "CsI"
    thickness_mm: float = 0.6
    escape: bool = Field(
        False, description="K lines and scattered photons that leave the scintillator carry energy away; needs xraydb"
    )
    response: str | None = Field(
        None, description="CSV with columns energy_keV, response, in place of the scintillator"
    )
    snr: float | None = None
    photons: float | None = None
    averages: int = Detector.averages
    blur_sigma_px: float = Detector.blur_sigma
    mtf: MTFPart | None = None
    noise_sigma_px: float = Detector.noise_sigma
    white: float = Detector.white
    bits: int = Detector.bits
    saturation: float | None = Detector.saturation
    output: Literal["corrected", "raw"] = Detector.output
    dark: float = Detector.dark
    readout_noise: float = Detector.readout_noise
    gain_spread: float = Detector.gain_spread
    dark_spread: float = Detector.dark_spread
    dead_share: float = Detector.dead_share
    flats: int = Detector.flats
    falloff: bool = Detector.falloff
    lag: tuple[float, ...] = Detector.lag
    cells: int = Detector.cells
    scatter: ScatterPart = ScatterPart()
    glare: GlarePart = GlarePart()

    @model_validator(mode="after")
    def _one_dose(self) -> DetectorPart:
        if self.snr is not None and self.photons is not None:
            raise ValueError("give either snr or photons")
        return self


class MaterialPart(Part):
    density_g_cm3: float
    formula: str | None = None
    mass_fractions: dict[str, float] | None = None

    @model_validator(mode="after")
    def _one_composition(self) -> MaterialPart:
        if (self.formula is None) == (self.mass_fractions is None):
            raise ValueError("give either formula or mass_fractions")
        return self


class Placed(Part):
    """Where an object is in its frame: x -> R x + t, R = R_x R_y R_z."""

    name: str = ""
    frame: Literal["M", "H", "T", "W"] = "M"
    t_mm: Vector = (0.0, 0.0, 0.0)
    angles_deg: Vector = (0.0, 0.0, 0.0)


class BallPart(Placed):
    kind: Literal["ball"]
    diameter_mm: float = 8.0
    material: str = "WC-Co"
    holder: bool = True
    holder_axis: Vector = (0.0, 0.0, 1.0)
    tube_diameter_mm: float | None = None
    tube_length_mm: float = 15.0
    extension_diameter_mm: float = 16.0
    extension_length_mm: float = 60.0


class StandardPart(Placed):
    kind: Literal["multi-sphere"]
    shafts: bool = True
    base: bool = True


class SpecimenPart(Placed):
    kind: Literal["specimen"]
    material: str = "EN AW-6082"
    deviations: bool = Field(False, description="as made instead of nominal")


class MeshPart(Placed):
    kind: Literal["mesh"]
    file: str
    material: str
    scale: float = Field(1.0, description="mm per unit of the file")


class ShapePart(Part):
    """One primitive and what is done with it: later shapes join, cut or bound what the earlier ones made."""

    kind: Literal["sphere", "cylinder", "cone", "box", "torus", "half-space"]
    do: Literal["add", "subtract", "intersect"] = "add"
    radius_mm: float | None = None
    radius_top_mm: float | None = None
    length_mm: float | None = None
    tube_radius_mm: float | None = None
    size_mm: Vector | None = None
    axis: Vector = (0.0, 0.0, 1.0)
    t_mm: Vector = (0.0, 0.0, 0.0)


class SolidPart(Placed):
    kind: Literal["solid"]
    material: str
    shapes: tuple[ShapePart, ...] = Field(min_length=1)


ObjectPart = Annotated[BallPart | StandardPart | SpecimenPart | MeshPart | SolidPart, Field(discriminator="kind")]


class MountPart(Part):
    angles_deg: Vector = (0.0, 0.0, 180.0)
    t_mm: Vector = (0.0, 0.0, 0.0)


class ManipulatorPart(Part):
    kind: Literal["ideal", "hexapod", "robot"] = "ideal"
    file: str | None = Field(None, description="hexapod.json or robot.json; without it a machine of the paper's size")
    errors: float = Field(1.0, ge=0, description="factor on the file's standard deviations from which errors are drawn")
    backlash_mm: float = 0.0
    growth_mm: Vector = (0.0, 0.0, 0.0)
    settling_mm: float = Field(0.0, ge=0, description="how far from the set pose the drives stop, 1 sigma")
    settling_rad: float = Field(0.0, ge=0)
    repeatability_mm: float = Field(0.0, ge=0, description="scatter of the real plate that no encoder sees, 1 sigma")
    repeatability_rad: float = Field(0.0, ge=0)


class GridPart(Part):
    n: int = 3
    half_range_mm: float = 10.0
    tilt_deg: float = 5.0
    table_angles_deg: tuple[float, ...] = (0.0,)


class ScanPart(Part):
    n: int
    tilt: Literal["none", "triangle", "sine"] = "none"


class PosesPart(Part):
    file: str | None = None
    grid: GridPart | None = None
    scan: ScanPart | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> PosesPart:
        if sum(x is not None for x in (self.file, self.grid, self.scan)) != 1:
            raise ValueError("give one of file, grid and scan")
        return self


class MotionPart(Part):
    alpha_deg: float = 0.0
    shift_mm: Vector = (0.0, 0.0, 0.0)
    points: int = 7


class Scene(Part):
    """A scene.  `folder` is where its file lies: names of other files are taken from there."""

    schema_: Literal["tomopose/scene/1"] = Field(alias="schema")
    seed: int = Field(ge=0)
    engine: Literal["own", "gvxr"] = "own"
    scanner: ScannerPart
    source: SourcePart
    detector: DetectorPart
    materials: dict[str, MaterialPart] = {}
    objects: tuple[ObjectPart, ...] = Field(min_length=1)
    mount: MountPart = MountPart()
    manipulator: ManipulatorPart = ManipulatorPart()
    poses: PosesPart
    motion: MotionPart = MotionPart()
    folder: str = ""

    @model_validator(mode="after")
    def _one_ball(self) -> Scene:
        if sum(isinstance(x, BallPart) for x in self.objects) > 1:
            raise ValueError('a scene holds at most one ball (kind = "ball"); write further ones as solids')
        return self


def scene_from(document: dict[str, object], *, where: str = "scene", folder: str = "") -> Scene:
    """A scene from a document as TOML gives it; InputError names each key that cannot be used."""
    try:
        return Scene.model_validate({**document, "folder": folder})
    except ValidationError as error:
        found = "; ".join(
            f"{'.'.join(str(k) for k in e['loc']) or 'scene'}: {e['msg']}" for e in error.errors(include_url=False)
        )
        raise InputError(f"{where}: {found}") from error


@reader("scene")
def read_scene(path: str | Path) -> Scene:
    """The scene in a TOML file (docs/formats/scene.md)."""
    path = Path(path)
    document = parse_toml(read_text(path), path)
    if "folder" in document:
        raise InputError(f"{path}: folder: no key of a scene file")
    return scene_from(document, where=str(path), folder=str(path.parent))


def scene_schema() -> dict[str, object]:
    """The JSON schema of scene files."""
    schema = Scene.model_json_schema(by_alias=True)
    del schema["properties"]["folder"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "tomopose scene", **schema}
