"""From a scene to a run: solids, spectrum, detector, poses that were set, read and reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_from_angles
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.reading import read_text, require_file
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.detector.scatter_glare_mtf import MTF, Glare, Scatter
from tomopose.simulation.objects.ball import ball_in_holder
from tomopose.simulation.objects.shapes import (
    Shape,
    Solid,
    box,
    cone,
    cylinder,
    half_space,
    sphere,
    torus,
)
from tomopose.simulation.physics.materials import MATERIALS, Material, from_formula
from tomopose.simulation.physics.spectrum import Spectrum, tube_spectrum
from tomopose.simulation.projector.focal_spot import FocalSpot, Motion
from tomopose.simulation.run import SimulatedRun
from tomopose.simulation.scene import scene as S
from tomopose.units import Array
from tomopose.values import require_types

SETTLING, MACHINE = 11, 12
"""Streams of random numbers: how the drives stop, and which errors the machine has."""


@require_types
def simulate(scene: S.Scene, *, poses: PoseSequence | None = None) -> SimulatedRun:
    """The run that a scene describes; its images are made when they are asked for (`run.image(i)`).

    poses: in place of the scene's own, and needed where it names a pose file, which the reader of pose tables reads.
    """
    scanner = _scanner(scene.scanner)
    T_HT = _placement(scene.mount.angles_deg, scene.mount.t_mm, Frame.H, Frame.T)
    spectrum, materials = beam(scene)
    solids, meshes, ball = _objects(scene, materials)
    set_poses = _poses(scene) if poses is None else poses
    recorded, real = _manipulate(scene, set_poses)
    return SimulatedRun(
        scanner=scanner,
        poses=recorded,
        T_HT=T_HT,
        T_MH=real,
        solids=solids,
        meshes=meshes,
        materials=materials,
        spectrum=spectrum,
        detector=_detector(scene.detector, scene.scanner.binning),
        seed=scene.seed,
        spot=FocalSpot(**_without_units(scene.source.spot)),
        motion=Motion(
            alpha=float(np.radians(scene.motion.alpha_deg)), shift=scene.motion.shift_mm, points=scene.motion.points
        ),
        t=None if ball is None else np.array(ball.t_mm),
        ball_diameter=None if ball is None else ball.diameter_mm,
        engine=scene.engine,
    )


def beam(scene: S.Scene) -> tuple[Spectrum, Mapping[str, Material]]:
    """The spectrum as the scene's detector weighs it, and what the names of materials mean there."""
    materials = {**MATERIALS, **{name: _material(part) for name, part in scene.materials.items()}}
    return _spectrum(scene, materials), materials


def _without_units(part: S.Part) -> dict[str, Any]:
    """A part's values by their names inside: `size_u_mm` becomes `size_u`."""
    units = ("_mm", "_px", "_rad")
    return {
        next((key.removesuffix(u) for u in units if key.endswith(u)), key): value
        for key, value in part.model_dump().items()
    }


def _scanner(part: S.ScannerPart) -> Scanner:
    values = _without_units(part)
    binning = values.pop("binning")
    full = Scanner(**values)
    return full if binning == 1 else full.binned(binning)


def _placement(angles_deg: S.Vector, t_mm: S.Vector, source: Frame, target: Frame) -> RigidTransform:
    return RigidTransform.from_angles(np.radians(angles_deg), t_mm, source=source, target=target)


def _material(part: S.MaterialPart) -> Material:
    if part.formula is not None:
        return from_formula(part.formula, part.density_g_cm3)
    return Material(density=part.density_g_cm3, fractions=part.mass_fractions or {})


def _table(scene: S.Scene, name: str, column: str) -> tuple[Array, Array]:
    """Energies (keV) and values of a CSV file with the columns energy_keV and `column`."""
    path = Path(scene.folder) / name
    require_file(path, "table")
    lines = [x for x in read_text(path).splitlines() if x.strip() and not x.startswith("#")]
    if not lines or [x.strip() for x in lines[0].split(",")] != ["energy_keV", column]:
        raise InputError(f"{path}: the first line must name the columns energy_keV,{column}")
    try:
        values = np.array([[float(x) for x in line.split(",")] for line in lines[1:]]).reshape(-1, 2)
    except ValueError as error:
        raise InputError(f"{path}: a row does not hold two numbers: {error}") from error
    if len(values) < 2 or (np.diff(values[:, 0]) <= 0).any():
        raise InputError(f"{path}: at least two rows of rising energy are needed")
    return values[:, 0], values[:, 1]


def _spectrum(scene: S.Scene, materials: Mapping[str, Material]) -> Spectrum:
    source, detector = scene.source, scene.detector
    if source.spectrum is not None:
        energy, photons = _table(scene, source.spectrum, "photons")
        spectrum = Spectrum(energy=energy, weight=photons)
    else:
        assert source.voltage_kV is not None
        spectrum = tube_spectrum(source.voltage_kV, anode=source.anode, anode_angle_deg=source.anode_angle_deg)
    for part in source.filters:
        spectrum = spectrum.filtered(part.material, part.thickness_mm, materials)
    if detector.response is not None:
        energy, response = _table(scene, detector.response, "response")
        if spectrum.energy[0] < energy[0] or spectrum.energy[-1] > energy[-1]:
            raise InputError(
                f"{detector.response}: the response covers {energy[0]:g} to {energy[-1]:g} keV, the spectrum "
                f"{spectrum.energy[0]:g} to {spectrum.energy[-1]:g} keV"
            )
        return replace(spectrum, weight=spectrum.weight * np.interp(spectrum.energy, energy, response))
    return spectrum.absorbed_energy(detector.scintillator, detector.thickness_mm, materials, escape=detector.escape)


def _detector(part: S.DetectorPart, b: int) -> Detector:
    """The detector; a scene gives lengths in the unbinned detector's pixels, `Detector` takes most in the image's."""
    values = _without_units(part)
    for name in ("scintillator", "thickness", "escape", "response"):
        del values[name]
    if values["snr"] is None:
        values["snr"] = 200.0
    frequency = () if part.mtf is None else tuple(b * f for f in part.mtf.frequency_per_px)
    changed = {
        "blur_sigma": part.blur_sigma_px / b,
        "mtf": None if part.mtf is None else MTF(frequency=frequency, value=part.mtf.value),
        "scatter": Scatter(constant=part.scatter.constant, amount=part.scatter.amount, sigma=part.scatter.sigma_px / b),
        "glare": Glare(share=part.glare.share, sigma=part.glare.sigma_px / b),
    }
    return Detector(**{**values, **changed, "binning": b})


def _objects(
    scene: S.Scene, materials: Mapping[str, Material]
) -> tuple[tuple[Solid, ...], tuple[Any, ...], S.BallPart | None]:
    from tomopose.simulation.objects.mesh import MeshSolid, read_mesh
    from tomopose.simulation.objects.specimen import specimen_mesh
    from tomopose.simulation.objects.sphere_standard import multi_sphere_standard

    solids: list[Solid] = []
    meshes: list[MeshSolid] = []
    ball = None
    for part in scene.objects:
        frame = Frame[part.frame]
        where = {"R": rotation_from_angles(np.radians(part.angles_deg)), "t": np.array(part.t_mm)}
        if isinstance(part, S.BallPart):
            if part.frame != "M":
                raise InputError(f"the ball is fixed to frame {part.frame}; it moves with the manipulator (M)")
            ball = part
            made = ball_in_holder(
                t=part.t_mm,
                ball_diameter=part.diameter_mm,
                axis=part.holder_axis,
                tube_diameter=part.tube_diameter_mm,
                tube_length=part.tube_length_mm,
                extension_diameter=part.extension_diameter_mm,
                extension_length=part.extension_length_mm,
            )
            solids += (
                [replace(made[-1], material=part.material)]
                if not part.holder
                else [*made[:-1], replace(made[-1], material=part.material)]
            )
        elif isinstance(part, S.StandardPart):
            solids += [
                replace(s, shape=s.shape.placed(**where), frame=frame)
                for s in multi_sphere_standard(shafts=part.shafts, base=part.base)
            ]
        elif isinstance(part, S.SpecimenPart):
            mesh = specimen_mesh(deviations=part.deviations, seed=scene.seed)
            meshes.append(MeshSolid(mesh=mesh.placed(**where), material=part.material, frame=frame, name=part.name))
        elif isinstance(part, S.MeshPart):
            mesh = read_mesh(Path(scene.folder) / part.file, scale=part.scale)
            meshes.append(MeshSolid(mesh=mesh.placed(**where), material=part.material, frame=frame, name=part.name))
        else:
            solids.append(
                Solid(shape=_shape(part.shapes).placed(**where), material=part.material, frame=frame, name=part.name)
            )
    for name in [s.material for s in solids] + [m.material for m in meshes]:
        if name not in materials:
            raise InputError(f"material {name!r} is unknown; known are {', '.join(sorted(materials))}")
    return tuple(solids), tuple(meshes), ball


def _shape(parts: tuple[S.ShapePart, ...]) -> Shape:
    shape: Shape | None = None
    for part in parts:
        new = _primitive(part).along(part.axis, t=part.t_mm)
        if shape is None:
            if part.do != "add":
                raise InputError(f'the first shape of a solid cannot {part.do}; it begins with do = "add"')
            shape = new
        else:
            shape = shape | new if part.do == "add" else (shape - new if part.do == "subtract" else shape & new)
    assert shape is not None
    return shape


def _primitive(part: S.ShapePart) -> Shape:
    def need(name: str) -> Any:
        value = getattr(part, name)
        if value is None:
            raise InputError(f"a {part.kind} needs {name}")
        return value

    if part.kind == "sphere":
        return sphere(need("radius_mm"))
    if part.kind == "cylinder":
        return cylinder(need("radius_mm"), 0.0, need("length_mm"))
    if part.kind == "cone":
        return cone(need("radius_mm"), need("radius_top_mm"), 0.0, need("length_mm"))
    if part.kind == "box":
        return box(*need("size_mm"))
    if part.kind == "torus":
        return torus(need("radius_mm"), need("tube_radius_mm"))
    return half_space()


def _poses(scene: S.Scene) -> PoseSequence:
    from tomopose.trajectory.pose_grid import pose_grid
    from tomopose.trajectory.scan import circular_scan, tilted_scan
    from tomopose.trajectory.tilt import eq11_triangle, sine_tilt

    part = scene.poses
    if part.grid is not None:
        return pose_grid(
            part.grid.n,
            half_range=part.grid.half_range_mm,
            tilt=float(np.radians(part.grid.tilt_deg)),
            table_angles=np.radians(part.grid.table_angles_deg).tolist(),
        )
    if part.scan is not None:
        if part.scan.tilt == "none":
            return circular_scan(part.scan.n)
        return tilted_scan(part.scan.n, eq11_triangle if part.scan.tilt == "triangle" else sine_tilt)
    raise InputError(f"the scene takes its poses from {part.file}; read them and give them to simulate(poses=...)")


def _manipulate(scene: S.Scene, set_poses: PoseSequence) -> tuple[PoseSequence, RigidTransform]:
    """(poses as recorded, real poses): the drives stop near the set pose, and the machine errs from there."""
    from tomopose.manipulator.files import read_manipulator
    from tomopose.manipulator.real_poses import Repeatability
    from tomopose.manipulator.virtual import (
        Disturbance,
        encoder_readout,
        real_motion,
        typical_hexapod,
        typical_robot,
    )

    part = scene.manipulator
    recorded = set_poses
    if part.settling_mm or part.settling_rad:
        rng = np.random.default_rng(np.random.SeedSequence([scene.seed, 0, SETTLING]))
        settling = Repeatability(t_mm=part.settling_mm, w_rad=part.settling_rad)
        recorded = encoder_readout(set_poses, settling=settling, rng=rng)
    if part.kind == "ideal":
        return recorded, recorded.T_MH
    if part.file is not None:
        machine = read_manipulator(Path(scene.folder) / part.file)
        if machine.kind != {"hexapod": "hexapod", "robot": "serial"}[part.kind]:
            raise InputError(f"{part.file} describes a {machine.kind} manipulator; the scene says {part.kind}")
    else:
        machine = typical_hexapod() if part.kind == "hexapod" else typical_robot()
    rng = np.random.default_rng(np.random.SeedSequence([scene.seed, 0, MACHINE]))
    errors = part.errors * np.asarray(machine.sigma) * rng.standard_normal(len(machine.sigma))
    scatter = Repeatability(t_mm=part.repeatability_mm, w_rad=part.repeatability_rad)
    disturbance = Disturbance(backlash_mm=part.backlash_mm, growth_mm=part.growth_mm, scatter=scatter)
    return recorded, real_motion(machine, recorded, errors, disturbance=disturbance, rng=rng).T_MH
