"""CTSimU scenarios (format 1.0 to 1.2) as runs of the virtual scanner; runs as scenarios are in ctsimu_writing.py.

Read: geometry of every frame (drift files too), voltage or spectrum file, filters, windows, spot, scintillator, grey
values, SNR, unsharpness, lag, mesh samples on the stage, materials with a formula or mass fractions.  What else a
scenario asks for is named in `NOT_READ` and refused, never passed over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.exports.ctsimu_scenario import from_ctsimu, sample_pose
from tomopose.exports.panel import Given
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.scanner import R_WS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.reading import reading
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.objects.mesh import MeshSolid, read_mesh
from tomopose.simulation.physics.materials import MATERIALS, Material, from_formula
from tomopose.simulation.physics.spectrum import Spectrum, tube_spectrum
from tomopose.simulation.projector.focal_spot import FWHM_PER_SIGMA, FocalSpot
from tomopose.simulation.run import SimulatedRun
from tomopose.values import require_types

STEADY_MM, STEADY_PX = 1e-6, 1e-6
"""How far the intrinsic geometry may change from frame to frame; the virtual scanner's does not move."""
STAGE_TO_M = np.diag([-1.0, -1.0, 1.0])
"""The stage's axes are W's turned by 180 degrees about w."""
SIGMA_PER_RESOLUTION = 0.70
"""Standard deviation of all unsharpness, the pixel's own area included, over the basic spatial resolution b: two round
wires of diameter b, b apart, then show a dip of 20 % between them, which is how b is measured (ISO 19232-5, ASTM
E2597).  0.707 for wires that let most of the beam through, 0.691 for opaque ones."""
NOT_READ = (
    ("source", "spot", "intensity_map", "file"),
    ("detector", "unsharpness", "mtf"),
    ("detector", "noise", "noise_characteristics_file"),
    ("detector", "bad_pixel_map", "file"),
    ("detector", "gray_value", "intensity_characteristics_file"),
    ("detector", "gray_value", "efficiency_characteristics_file"),
)


def _get(content: Any, *keys: str) -> Any:
    """A nested entry, None where any step is missing or null; a parameter without number or unit gives its value."""
    for key in keys:
        if not isinstance(content, Mapping) or content.get(key) is None:
            return None
        content = content[key]
    if isinstance(content, Mapping) and content.keys() <= {"value", "unit"} and content.get("value") is None:
        return None
    return content


def _word(content: Any, *keys: str) -> str | None:
    """A text parameter, written bare or as {"value": ...}; None where it is missing, null or empty."""
    entry = _get(content, *keys)
    entry = entry.get("value") if isinstance(entry, Mapping) else entry
    return str(entry) if entry not in (None, "", False) else None


def _number(content: Any, *keys: str, default: float | None = None) -> float | None:
    """A parameter's value; units are those that the format takes as native (mm, kV), others are refused."""
    entry = _get(content, *keys)
    if entry is None:
        return default
    if not isinstance(entry, Mapping):
        return float(entry)
    if entry.get("value") is None:
        return default
    scale = {None: 1.0, "mm": 1.0, "um": 1e-3, "kV": 1.0, "V": 1e-3, "deg": 1.0, "px": 1.0, "g/cm^3": 1.0}
    if entry.get("unit") not in scale:
        raise InputError(f"CTSimU: {'.'.join(keys)} has the unit {entry['unit']!r}, which is not read here")
    if entry.get("drifts"):
        raise InputError(f"CTSimU: {'.'.join(keys)} drifts; only geometry may drift here")
    return float(entry["value"]) * scale[entry.get("unit")]


@require_types
def run_from_ctsimu(content: Mapping[str, object], *, folder: str | Path = ".", seed: int = 0) -> SimulatedRun:
    """The run that a scenario's JSON content describes; files that it names are taken from `folder`.

    InputError for what the virtual scanner does not read, FileError for content that is no scenario.
    """
    with reading("the content", "CTSimU scenario"):
        if not isinstance(content, Mapping):
            raise InputError(f"a CTSimU scenario is a JSON object; this is a {type(content).__name__}")
        return _run(content, Path(folder), seed)


def _run(content: Mapping[str, Any], folder: Path, seed: int) -> SimulatedRun:
    for path in NOT_READ:
        name = _word(content, *path)
        if name is not None:
            raise InputError(f"CTSimU: {'.'.join(path)} ({name}) is not read by the virtual scanner")
    # Images show the scanner as it is, not as a reconstruction knows it.
    content = _all_known(content)
    scanner, T_MH = _geometry(from_ctsimu(content, Given(folder=folder)))
    materials = dict(MATERIALS)
    for entry in content.get("materials") or ():
        # A vacuum (density 0, often without a formula) fills what is empty anyway.
        if _number(entry, "density") != 0:
            materials[str(entry["id"])] = _material(entry)
    poses = PoseSequence(T_MH=T_MH, pose_id=tuple(str(k) for k in range(len(T_MH))), source="set")
    meshes = tuple(_sample(entry, folder) for entry in content.get("samples") or ())
    for mesh in meshes:
        if mesh.material not in materials:
            raise InputError(
                f"CTSimU: sample {mesh.name!r} is of material {mesh.material!r}, which is not defined "
                "with a density above 0"
            )
    return SimulatedRun(
        scanner=scanner,
        poses=poses,
        T_HT=RigidTransform.identity(Frame.H, Frame.T),
        T_MH=T_MH,
        solids=(),
        meshes=meshes,
        materials=materials,
        spectrum=_spectrum(content, materials, folder),
        detector=_detector(content, scanner),
        seed=seed,
        spot=_spot(content),
    )


def _all_known(part: Any) -> Any:
    """The same JSON with every deviation and drift in force, whether a reconstruction knows it or not."""
    if isinstance(part, list):
        return [_all_known(p) for p in part]
    if not isinstance(part, Mapping):
        return part
    return {k: True if k == "known_to_reconstruction" and v is False else _all_known(v) for k, v in part.items()}


def _geometry(matrices: ProjectionMatrices) -> tuple[Scanner, RigidTransform]:
    """One scanner, and each frame's object pose in it: P = K [R | t], x_S = R x_M + t."""
    g = matrices.decompose()
    for name, values, steady in (("d_SD", g.d_SD, STEADY_MM), ("u_0", g.u_0, STEADY_PX), ("v_0", g.v_0, STEADY_PX)):
        if np.ptp(values) > steady:
            raise InputError(f"CTSimU: {name} changes by {np.ptp(values):g} over the scan; source or panel moves")
    d_SD, u_0, v_0 = float(g.d_SD[0]), float(g.u_0[0]), float(g.v_0[0])
    d_SR = float(np.median(np.einsum("ni,ni->n", -g.source, g.normal)))
    scanner = Scanner(
        d_SD=d_SD, d_SR=d_SR, p_u=matrices.p_u, p_v=matrices.p_v, u_0=u_0, v_0=v_0, n_u=matrices.n_u, n_v=matrices.n_v
    )
    E = np.linalg.inv(scanner.K) @ matrices.P
    R, t = R_WS.T @ E[:, :, :3], (E[:, :, 3] - [0.0, 0.0, d_SR]) @ R_WS
    return scanner, RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H)


def _material(entry: Mapping[str, Any]) -> Material:
    """A material with its composition: a formula, or entries with mass fractions."""
    density = _number(entry, "density")
    composition = entry.get("composition")
    if density is None or composition is None:
        raise InputError(f"CTSimU: material {entry.get('id')!r} has no density or no composition")
    if isinstance(composition, str):
        return from_formula(composition, density)
    fractions: dict[str, float] = {}
    parts = [
        (from_formula(str(c["formula"]["value"]), 1.0).fractions, _number(c, "mass_fraction", default=1.0) or 0.0)
        for c in composition
    ]
    total = sum(share for _, share in parts)
    for elements, share in parts:
        for element, f in elements.items():
            fractions[element] = fractions.get(element, 0.0) + f * share / total
    return Material(density=density, fractions=fractions)


def _sample(entry: Mapping[str, Any], folder: Path) -> MeshSolid:
    """A mesh in M: the centre of its bounding box, not its file's origin, comes to the sample's centre."""
    name = str(entry.get("name", ""))
    file = _word(entry, "file")
    if not file:
        raise InputError(f"CTSimU: sample {name!r} names no mesh file")
    unit = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0}.get(str(entry.get("unit", "mm")))
    scale = [_number(entry, "scaling_factor", k, default=1.0) for k in "rst"]
    if unit is None or len(set(scale)) != 1:
        raise InputError(f"CTSimU: sample {name!r} has the unit {entry.get('unit')!r} and scaling {scale}; not read")
    centre, axes = sample_pose(entry.get("position") or {}, f"CTSimU: sample {name!r}")
    mesh = read_mesh(folder / PureWindowsPath(file).as_posix(), scale=unit * float(scale[0] or 1.0))
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    R = STAGE_TO_M @ axes
    return MeshSolid(
        mesh=mesh.placed(R=R, t=STAGE_TO_M @ centre - R @ middle), material=str(entry.get("material_id")), name=name
    )


def _spectrum(content: Mapping[str, Any], materials: Mapping[str, Material], folder: Path) -> Spectrum:
    source, detector = content.get("source") or {}, content.get("detector") or {}
    voltage = _number(source, "voltage")
    file = _word(source, "spectrum", "file")
    if voltage is None and file is None:
        raise InputError("CTSimU: source.voltage is missing")
    monochromatic = _get(source, "spectrum", "monochromatic")
    if file is not None:
        # The format gives a file precedence over `monochromatic`; it holds the tube's spectrum behind its window.
        spectrum = _spectrum_file(folder / PureWindowsPath(file).as_posix())
        source = {**source, "window": None}
    elif monochromatic:
        spectrum = Spectrum(energy=np.array([voltage]), weight=np.ones(1))
    else:
        assert voltage is not None
        angle = _number(source, "target", "angle", "emission", default=12.0)
        spectrum = tube_spectrum(
            voltage, anode=str(_get(source, "target", "material_id") or "W"), anode_angle_deg=float(angle or 12.0)
        )
    plates = [
        *(source.get("window") or ()),
        *(source.get("filters") or ()),
        *((_get(detector, "window", "front")) or ()),
        *((_get(detector, "filters", "front")) or ()),
    ]
    for plate in plates:
        spectrum = spectrum.filtered(str(plate["material_id"]), _number(plate, "thickness") or 0.0, materials)
    scintillator, thickness = (
        _get(detector, "scintillator", "material_id"),
        _number(detector, "scintillator", "thickness"),
    )
    if scintillator is None or not thickness:
        # The format's ideal detector counts all energy that arrives.
        return Spectrum(energy=spectrum.energy, weight=spectrum.weight * spectrum.energy)
    return spectrum.absorbed_energy(str(scintillator), thickness, materials)


def _spectrum_file(path: Path) -> Spectrum:
    """Energy (keV) and photons, two columns with comment lines, as CTSimU's spectrum files have them."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"CTSimU: the spectrum file {path} cannot be read: {error}", path=path) from error
    rows = [re.split(r"[\s,;]+", line.strip())[:2] for line in lines if line.strip() and line.lstrip()[0] not in "#%"]
    try:
        table = np.array([[float(word) for word in row] for row in rows if not row[0][:1].isalpha()])
    except ValueError as error:
        raise InputError(f"CTSimU: {path} is not a spectrum of energy (keV) and photons: {error}") from error
    if table.ndim != 2 or table.shape[1] != 2:
        raise InputError(f"CTSimU: {path} holds no two columns, energy (keV) and photons")
    table = table[table[:, 0] > 0]
    return Spectrum(energy=table[:, 0], weight=table[:, 1])


def _spot(content: Mapping[str, Any]) -> FocalSpot:
    u, v = (_number(content, "source", "spot", "sigma", k, default=0.0) or 0.0 for k in "uv")
    if u > 0 and v > 0:
        return FocalSpot(shape="gaussian", size_u=u * FWHM_PER_SIGMA, size_v=v * FWHM_PER_SIGMA)
    u, v = (_number(content, "source", "spot", "size", k, default=0.0) or 0.0 for k in "uv")
    return FocalSpot(shape="rectangle", size_u=u, size_v=v, method="sampled") if u > 0 and v > 0 else FocalSpot()


def blur_of(resolution: float) -> float:
    """Gaussian blur, px, of a panel with that basic spatial resolution, px; 0 where the pixels alone exceed it."""
    return math.sqrt(max((SIGMA_PER_RESOLUTION * resolution) ** 2 - 1 / 12, 0.0))


def resolution_of(blur: float) -> float:
    """Basic spatial resolution, px, of a panel with that Gaussian blur, px; 0, which states none, without blur."""
    return math.sqrt(blur**2 + 1 / 12) / SIGMA_PER_RESOLUTION if blur > 0 else 0.0


def _detector(content: Mapping[str, Any], scanner: Scanner) -> Detector:
    part = content.get("detector") or {}
    snr = _number(part, "noise", "snr_at_imax")
    white = _number(part, "gray_value", "imax", default=60000.0) or 60000.0
    dark = _number(part, "gray_value", "imin", default=0.0) or 0.0
    if not 0 <= dark < white:
        raise InputError(f"CTSimU: detector.gray_value.imin is {dark:g} and imax {white:g}; 0 <= imin < imax is needed")
    # Without a statement about the correction, images are taken as corrected, as a run is written.
    raw = _get(content, "acquisition", "flat_field", "correction") is False
    resolution = _number(part, "unsharpness", "basic_spatial_resolution", default=0.0) or 0.0
    lag = _number(part, "image_lag", default=0.0) or 0.0
    return Detector(
        snr=math.inf if snr is None else snr,
        white=white - dark,
        dark=dark,
        output="raw" if raw else "corrected",
        falloff=raw,
        bits=int(_number(part, "bit_depth", default=16.0) or 16),
        blur_sigma=blur_of(resolution / scanner.p_u),
        lag=(lag,) if lag else (),
    )
