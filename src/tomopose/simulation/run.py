"""A simulated run: everything that fixes its images, and image i as a pure function of it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.simulation.ball import ball_in_holder, ball_positions, silhouette_centre
from tomopose.simulation.detector import Detector, expose
from tomopose.simulation.projector import View, add_transmission, shadow
from tomopose.simulation.blur import margin, to_pixels
from tomopose.simulation.rays import Compiled, compile_solids
from tomopose.simulation.shapes import Solid
from tomopose.simulation.spectrum import Beam, Spectrum, condense, tube_spectrum
from tomopose.units import Array, float_array


@dataclass(frozen=True, kw_only=True)
class SimulatedRun:
    """A run of the virtual scanner, picklable: `render(run, i)` makes frame i anywhere, always with the same bytes.

    scanner, poses: as they would be recorded (poses hold encoder and set values).
    T_HT:           the true mount.  T_MH: the true poses, which differ from `poses.T_MH` where the manipulator errs.
    t:              the ball's centre in M, mm, or None where no ball is imaged; ball_diameter, mm.
    solids, spectrum, detector: what is imaged, the spectrum as the detector weighs it, and the detector.
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

    @functools.cached_property
    def compiled(self) -> Compiled:
        return compile_solids(self.solids)

    @functools.cached_property
    def beam(self) -> Beam:
        longest = np.zeros(len(self.compiled.materials))
        np.add.at(longest, self.compiled.material, 2 * self.compiled.radius)
        return condense(self.spectrum, self.compiled.materials, longest)

    def frames(self, i: int) -> dict[Frame, RigidTransform]:
        """Each frame's transform to W at pose i, by the true poses."""
        T_TW = self.scanner.T_TW(self.poses.alpha[i])
        T_HW = T_TW @ self.T_HT
        return {
            Frame.W: RigidTransform.identity(Frame.W), Frame.T: T_TW, Frame.H: T_HW, Frame.M: T_HW @ self.T_MH[i],
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
            chain = {"T_HT": self.T_HT, "T_MH": self.T_MH, "t": self.t, "alpha": self.poses.alpha}
            x_D = project_ball(self.scanner, **chain)
            ellipse = silhouette_centre(self.scanner, ball_positions(self.scanner, **chain), self.ball_diameter / 2)
            document |= {
                "t_mm": self.t,
                "ball_diameter_mm": self.ball_diameter,
                "poses": [
                    {"pose_id": name, "u_px": x[0], "v_px": x[1], "u_ellipse_px": e[0], "v_ellipse_px": e[1]}
                    for name, x, e in zip(self.poses.pose_id, x_D.tolist(), ellipse.tolist(), strict=True)
                ],
            }
        return document


def transmission(run: SimulatedRun, i: int, *, threads: int = 1) -> Array:
    """The noiseless image (n_v, n_u) of pose i as a share of the empty beam: geometry, spectrum, unsharpness."""
    scanner, detector = run.scanner, run.detector
    view, T_FW = View.of(scanner), run.frames(i)
    sigma_u, sigma_v = detector.blur_sigma, detector.blur_sigma
    border = margin(max(sigma_u, sigma_v)) + 1
    window = shadow(run.compiled, view, T_FW, scanner, border)
    out = np.ones(scanner.shape)
    if window is None:
        return out
    f = detector.cells
    cells = np.zeros((4, window.n_v * f, window.n_u * f), dtype=np.float32)
    add_transmission(cells, window, run.compiled, run.beam, view, T_FW, f=f, threads=threads)
    pixels = to_pixels(cells, f=f, sigma_u=sigma_u, sigma_v=sigma_v, threads=threads)
    v_0, u_0 = max(window.v_0, 0), max(window.u_0, 0)
    v_1, u_1 = min(window.v_0 + window.n_v, scanner.n_v), min(window.u_0 + window.n_u, scanner.n_u)
    out[v_0:v_1, u_0:u_1] = pixels[v_0 - window.v_0 : v_1 - window.v_0, u_0 - window.u_0 : u_1 - window.u_0]
    return out


def render(run: SimulatedRun, i: int, *, threads: int = 1) -> Any:
    """Radiograph i of a run, uint16 (n_v, n_u), row index = v.  The bytes do not depend on `threads`."""
    if not 0 <= i < len(run):
        raise InputError(f"frame {i} does not exist; the run has {len(run)} frames, from 0")
    return expose(transmission(run, i, threads=threads), run.detector, seed=run.seed, frame=i, threads=threads)


def simulate_ball_run(
    scanner: Scanner, *, T_HT: RigidTransform, t: Any, poses: PoseSequence, ball_diameter: float = 8.0,
    snr: float = 200.0, blur_sigma: float = 0.7, seed: int = 0, T_MH: RigidTransform | None = None,
    voltage: float = 120.0, copper: float = 0.5, white: float = 45000.0, solids: tuple[Solid, ...] | None = None,
) -> SimulatedRun:
    """A calibration run: one ball in its holder, flat-corrected 16-bit images with photon noise.

    Parameters
    ----------
    scanner:       intrinsic geometry.
    T_HT, t:       true mount and ball position (mm in M): what a calibration has to find.
    poses:         poses as recorded; T_MH: the true ones (default: the recorded ones).
    ball_diameter: mm.  snr: of the empty beam, one pixel.  blur_sigma: px.  white: grey value of the empty beam.
    voltage, copper: tube voltage (kV, tungsten anode) and copper filter (mm); the detector is 0.6 mm of CsI.
    solids:        other solids than `ball_in_holder`.
    """
    spectrum = tube_spectrum(voltage).filtered("Cu", copper).absorbed_energy("CsI", 0.6)
    return SimulatedRun(
        scanner=scanner, poses=poses, T_HT=T_HT, T_MH=poses.T_MH if T_MH is None else T_MH, t=t,
        ball_diameter=ball_diameter, solids=ball_in_holder(t=t, ball_diameter=ball_diameter) if solids is None else solids,
        spectrum=spectrum, detector=Detector(snr=snr, blur_sigma=blur_sigma, white=white), seed=seed,
    )


def render_all(run: SimulatedRun, *, threads: int = 1, progress: Callable[[int, int], None] | None = None) -> Iterator[Any]:
    """All radiographs in order, one at a time."""
    for i in range(len(run)):
        yield render(run, i, threads=threads)
        if progress is not None:
            progress(i + 1, len(run))
