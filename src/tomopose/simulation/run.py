"""A simulated run: everything that fixes its images, and image i as a pure function of it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.kept import Key, key_of
from tomopose.manipulator.poses import PoseSequence
from tomopose.provenance import package_version
from tomopose.simulation.detector.blur import margin, to_pixels
from tomopose.simulation.detector.detector import Detector, expose
from tomopose.simulation.detector.scatter_glare_mtf import with_glare, with_mtf, with_scatter
from tomopose.simulation.objects.ball import ball_in_holder, ball_positions, silhouette_centre
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.objects.shapes import Solid
from tomopose.simulation.physics.materials import MATERIALS, Material
from tomopose.simulation.physics.spectrum import Beam, Spectrum, condense, tube_spectrum
from tomopose.simulation.projector.analytic import add_transmission
from tomopose.simulation.projector.cells import HELD
from tomopose.simulation.projector.focal_spot import FocalSpot, Motion
from tomopose.simulation.projector.gvxr import add_gvxr_transmission
from tomopose.simulation.projector.meshes import add_mesh_transmission
from tomopose.simulation.projector.rays import Compiled, compile_solids
from tomopose.simulation.projector.view import View, enclosing, shadow
from tomopose.units import Array, float_array
from tomopose.values import require_types, value


@value
class SimulatedRun:
    """A run of the virtual scanner, picklable: `render(run, i)` makes frame i anywhere, always with the same bytes.

    scanner, poses: as they would be recorded (poses hold encoder and set values).
    T_HT:           the true mount.  T_MH: the true poses, which differ from `poses.T_MH` where the manipulator errs.
    t:              the ball's centre in M, mm, or None where no ball is imaged; ball_diameter, mm.
    solids, spectrum, detector: what is imaged, the spectrum as the detector weighs it, and the detector.
    spot, motion:   focal spot, and movement during one exposure.
    meshes:         solids given by triangles; they must not overlap each other or the other solids.
                    Without solids and meshes the images are those of the empty beam.
    materials:      what the names of materials mean.
    engine:         "own", or "gvxr" to let gVirtualXray cast the rays.
    seed:           of all random numbers.
    """

    scanner: Scanner
    poses: PoseSequence
    T_HT: RigidTransform
    T_MH: RigidTransform
    solids: tuple[Solid, ...]
    spectrum: Spectrum
    detector: Detector
    seed: int
    spot: FocalSpot = field(default_factory=FocalSpot)
    motion: Motion = field(default_factory=Motion)
    meshes: tuple[MeshSolid, ...] = ()
    materials: Mapping[str, Material] = field(default_factory=lambda: MATERIALS)
    engine: Literal["own", "gvxr"] = "own"
    t: Array | None = None
    ball_diameter: float | None = None

    def __post_init__(self) -> None:
        self.T_HT.require(Frame.H, Frame.T)
        if len(self.T_MH.require(Frame.M, Frame.H)) != len(self.poses):
            raise ShapeError(f"{len(self.poses)} poses but {len(self.T_MH)} true poses")
        if self.t is not None:
            object.__setattr__(self, "t", float_array(np.reshape(self.t, 3)))

    def __len__(self) -> int:
        return len(self.poses)

    def __reduce__(self) -> tuple[object, tuple[dict[str, Any]]]:
        # Mapping proxies cannot be pickled, and what is cached here is cheap to make again in another process.
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return _run, ({**values, "materials": dict(self.materials)},)

    @functools.cached_property
    def compiled(self) -> Compiled | None:
        return compile_solids(self.solids) if self.solids else None

    @functools.cached_property
    def beam_materials(self) -> tuple[str, ...]:
        """The beam's columns: materials of the solids, then of the meshes."""
        return tuple(dict.fromkeys([s.material for s in self.solids] + [m.material for m in self.meshes]))

    @functools.cached_property
    def beam(self) -> Beam:
        longest = dict.fromkeys(self.beam_materials, 0.0)
        for solid in self.solids:
            longest[solid.material] += 2 * solid.shape.bound()[1]
        for mesh in self.meshes:
            longest[mesh.material] += float(np.linalg.norm(mesh.corners[-1] - mesh.corners[0]))
        return condense(self.spectrum, self.beam_materials, list(longest.values()), self.materials)

    @functools.cached_property
    def tessellated(self) -> list[tuple[TriangleMesh, str, Frame]]:
        """(mesh, material, frame) of all that is imaged, for engines that know only triangles."""
        from tomopose.simulation.objects.tessellate import tessellate

        return [*tessellate(self.solids), *((m.mesh, m.material, m.frame) for m in self.meshes)]

    def frames(self, i: int, moment: float = 0.0) -> dict[Frame, RigidTransform]:
        """Each frame's transform to W at pose i, by the true poses, at a moment between -1/2 and 1/2 of the
        exposure."""
        moved = RigidTransform(R=np.eye(3), t=moment * np.array(self.motion.shift), source=Frame.W, target=Frame.W)
        T_TW = moved @ self.scanner.T_TW(float(np.asarray(self.poses.alpha)[i]) + moment * self.motion.alpha)
        T_HW = T_TW @ self.T_HT
        return {
            Frame.W: RigidTransform.identity(Frame.W),
            Frame.T: T_TW,
            Frame.H: T_HW,
            Frame.M: T_HW @ self.T_MH[i],
        }

    def image(self, i: int, *, threads: int = 1) -> Any:
        """Radiograph i, uint16, [v, u] with row index = v."""
        return render(self, i, threads=threads)

    def __iter__(self) -> Iterator[Any]:
        return (self.image(i) for i in range(len(self)))

    def truth(self) -> dict[str, Any]:
        """What the images were made from, as truth.json holds it."""
        document: dict[str, Any] = {
            "T_HT": {"matrix": self.T_HT.matrix, "phi_rad": self.T_HT.angles, "t_mm": self.T_HT.t},
            "seed": self.seed,
        }
        if self.t is not None and self.ball_diameter is not None:
            true: dict[str, Any] = {"T_HT": self.T_HT, "T_MH": self.T_MH, "t": self.t, "alpha": self.poses.alpha}
            x_D = project_ball(self.scanner, **true)
            ellipse = silhouette_centre(self.scanner, ball_positions(self.scanner, **true), self.ball_diameter / 2)
            document |= {
                "t_mm": self.t,
                "ball_diameter_mm": self.ball_diameter,
                "poses": [
                    {"pose_id": name, "u_px": x[0], "v_px": x[1], "u_ellipse_px": e[0], "v_ellipse_px": e[1]}
                    for name, x, e in zip(self.poses.pose_id, x_D.tolist(), ellipse.tolist(), strict=True)
                ],
            }
        return document


def run_key(run: SimulatedRun, *, form: str) -> Key:
    """Everything that the bytes of a run's images depend on, and the form of the files ("tiff", "hdf5")."""
    engine = package_version("gvxr") if run.engine == "gvxr" else None
    return key_of("simulated-run", form=form, gvxr=engine, **{f.name: getattr(run, f.name) for f in fields(run)})


def _run(values: dict[str, Any]) -> SimulatedRun:
    return SimulatedRun(**values)


def transmission(run: SimulatedRun, i: int, *, threads: int = 1) -> Array:
    """Image (n_v, n_u) of pose i as a share of the empty beam: geometry, spectrum, focal spot, motion, unsharpness."""
    scanner, detector, spot, motion = run.scanner, run.detector, run.spot, run.motion
    if not (run.solids or run.meshes):
        return np.ones(scanner.shape)
    frames = run.frames(i)
    depth = float(scanner.T_WS.apply(frames[Frame.M].t)[2])
    spot_u, spot_v = spot.blur(scanner.d_SD / depth, scanner.p_u, scanner.p_v)
    sigma_u, sigma_v = math.hypot(detector.blur_sigma, spot_u), math.hypot(detector.blur_sigma, spot_v)
    moments, sources = motion.moments(), spot.sources()
    views = [(View.of(scanner, shift), run.frames(i, moment)) for moment in moments for shift in sources]
    border = margin(max(sigma_u, sigma_v)) + 1
    outlines = [(s.frame, s.shape.corners()) for s in run.solids] + [(m.frame, m.corners) for m in run.meshes]
    window = enclosing([shadow(outlines, view, T_FW, scanner, border) for view, T_FW in views])
    out = np.ones(scanner.shape)
    if window is None:
        return out
    f = detector.cells
    cells = np.zeros((HELD, window.n_v * f, window.n_u * f), dtype=np.float32)
    for view, T_FW in views:
        share: dict[str, Any] = {"f": f, "weight": 1 / len(views), "threads": threads}
        if run.engine == "gvxr":
            add_gvxr_transmission(
                cells, window, run.tessellated, run.beam_materials, run.beam, view, T_FW, f=f, weight=1 / len(views)
            )
        elif run.meshes:
            add_mesh_transmission(
                cells, window, run.compiled, run.meshes, run.beam_materials, run.beam, view, T_FW, **share
            )
        else:
            assert run.compiled is not None
            add_transmission(cells, window, run.compiled, run.beam, view, T_FW, **share)
    pixels = to_pixels(cells, f=f, sigma_u=sigma_u, sigma_v=sigma_v, threads=threads)
    v_0, u_0 = max(window.v_0, 0), max(window.u_0, 0)
    v_1, u_1 = min(window.v_0 + window.n_v, scanner.n_v), min(window.u_0 + window.n_u, scanner.n_u)
    out[v_0:v_1, u_0:u_1] = pixels[v_0 - window.v_0 : v_1 - window.v_0, u_0 - window.u_0 : u_1 - window.u_0]
    return out


def signal(run: SimulatedRun, i: int, *, threads: int = 1) -> Array:
    """What reaches the detector's electronics at pose i, without noise: transmission, MTF, scatter, glare, lag."""
    detector = run.detector

    def alone(k: int) -> Array:
        T = transmission(run, k, threads=threads)
        if detector.mtf is not None:
            T = with_mtf(T, detector.mtf)
        return with_glare(with_scatter(T, detector.scatter), detector.glare)

    now = alone(i)
    if not detector.lag:
        return now
    # Before the first frame the detector saw what it sees in the first.
    before = [share * (alone(i - k) if i >= k else now) for k, share in enumerate(detector.lag, start=1)]
    return np.asarray((1 - sum(detector.lag)) * now + np.sum(before, axis=0))


def render(run: SimulatedRun, i: int, *, threads: int = 1) -> Any:
    """Radiograph i of a run, uint16 (n_v, n_u), row index = v.  The bytes do not depend on `threads`."""
    if not 0 <= i < len(run):
        raise InputError(f"frame {i} does not exist; the run has {len(run)} frames, from 0")
    return expose(signal(run, i, threads=threads), run.detector, run.scanner, seed=run.seed, frame=i, threads=threads)


def ball_spectrum(voltage: float = 120.0, copper: float = 0.5) -> Spectrum:
    """Tungsten anode at that voltage, kV, copper filter, mm, absorbed in 0.6 mm of CsI."""
    return tube_spectrum(voltage).filtered("Cu", copper).absorbed_energy("CsI", 0.6)


@require_types
def simulate_ball_run(
    scanner: Scanner,
    *,
    T_HT: RigidTransform,
    t: ArrayLike,
    poses: PoseSequence,
    ball_diameter: float = 8.0,
    snr: float = 200.0,
    blur_sigma: float = 0.7,
    seed: int = 0,
    T_MH: RigidTransform | None = None,
    spectrum: Spectrum | None = None,
    white: float = 45000.0,
    solids: tuple[Solid, ...] | None = None,
) -> SimulatedRun:
    """A calibration run: one ball in its holder, flat-corrected 16-bit images with photon noise.

    Parameters
    ----------
    scanner:       intrinsic geometry.
    T_HT, t:       true mount and ball position (mm in M): what a calibration has to find.
    poses:         poses as recorded; T_MH: the true ones (default: the recorded ones).
    ball_diameter: mm.  snr: of the empty beam, one pixel.  blur_sigma: px.  white: grey value of the empty beam.
    spectrum:      absorbed energy by photon energy; the default is `ball_spectrum()`.
    solids:        other solids than `ball_in_holder`.
    """
    return SimulatedRun(
        scanner=scanner,
        poses=poses,
        T_HT=T_HT,
        T_MH=poses.T_MH if T_MH is None else T_MH,
        t=np.asarray(t, dtype=np.float64),
        ball_diameter=ball_diameter,
        solids=ball_in_holder(t=t, ball_diameter=ball_diameter) if solids is None else solids,
        spectrum=ball_spectrum() if spectrum is None else spectrum,
        detector=Detector(snr=snr, blur_sigma=blur_sigma, white=white),
        seed=seed,
    )


def render_all(
    run: SimulatedRun, *, threads: int = 1, progress: Callable[[int, int], None] | None = None
) -> Iterator[Any]:
    """All radiographs in order, one at a time."""
    for i in range(len(run)):
        yield render(run, i, threads=threads)
        if progress is not None:
            progress(i + 1, len(run))
