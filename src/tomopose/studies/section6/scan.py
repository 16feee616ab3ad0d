"""The measurement scans of sec. 6: which object is where, which views are taken, and what the detector counts."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from scipy.ndimage import gaussian_filter

from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.rotations import R_y
from tomopose.geometry.scanner import Scanner
from tomopose.kept import Key, key_of
from tomopose.manipulator.poses import PoseSequence
from tomopose.simulation.detector.scatter_glare_mtf import Scatter, with_scatter
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.objects.specimen import specimen_mesh
from tomopose.simulation.objects.sphere_standard import BASE_TOP, SHAFT_DIAMETER, sphere_centres, sphere_diameters
from tomopose.simulation.physics.materials import attenuation
from tomopose.simulation.physics.spectrum import Beam, condense, tube_spectrum
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.parts.steps import sources
from tomopose.studies.parts.virtual_hexapod import real_T_MH, scan_of
from tomopose.studies.section6.paths import ball_paths, fine_matrices, mesh_paths
from tomopose.trajectory.scan import circular_scan
from tomopose.units import Array
from tomopose.volume import VoxelGrid

Object = Literal["specimen", "standard"]
Path = Literal["circular", "3D"]
MAGNIFICATION: Mapping[Object, float] = MappingProxyType({"specimen": 5.3, "standard": 2.7})

MOUNTED = R_y(np.radians(42.0))
"""The specimen "was mounted in an already tilted orientation" (sec. 6.1).  The angle is ours, none is printed: at 42
degrees flanks of the thread lie where no source of a circular scan sees along them; the paper's thread suffers so
(sec. 6.3)."""
MARGIN_MM = 2.0
"""Air around the object in the volume."""
SNR_UNBINNED, WHITE = 200.0, 50000.0
"""Of an unattenuated pixel before binning, and what it counts."""
BLUR_PX = 0.73
"""Unbinned pixels, standard deviation: 0.7 px of the detector, as for the ball's radiographs, and a focal spot of 10 um
(standard deviation) seen 4.3 times larger."""
SCATTER_CONSTANT, SCATTER_AMOUNT, SCATTER_PX = 0.01, 0.1, 200.0
"""Shares of the open beam and width, unbinned pixels: of the order that scatter has behind 60 mm of aluminium; none of
it is printed."""
LONGEST_MM = 80.0
MOST_KEPT_BYTES = 6e8
"""Frames of smaller scans stay in memory; those of larger ones are kept in a file, where there is a folder for it."""


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """How large the study is.

    binning: of the 2048 x 2048 detector, by object; a voxel is one binned pixel at the axis.  views: by object.
    runs:    calibration runs used, by object: 1 before the scan, 2 after it.
    edge:    longest side of a triangle of the specimen, mm.  samples: rays a side of a binned pixel.
    radiographs: whether calibration centres are measured in simulated radiographs (n x n x n x 7 poses each run), or
             projected and given the paper's detection error.
    """

    binning: Mapping[Object, int]
    views: Mapping[Object, int]
    runs: Mapping[Object, tuple[int, ...]]
    edge: float
    samples: int
    radiographs: bool


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One scan: recorded poses, true matrices (binned), the scanner (binned), and the seed of its noise.

    real_beam: polychromatic, with focal spot, detector blur and scatter; else monochromatic and sharp.
    """

    thing: Object
    path: Path
    poses: PoseSequence
    truth: ProjectionMatrices
    scanner: Scanner
    binning: int
    samples: int
    edge: float
    seed: int
    real_beam: bool = False


def specimen(edge: float) -> TriangleMesh:
    """The specimen as made, part coordinates."""
    return specimen_mesh(deviations=True, edge=edge)


def scan_with(thing: Object, path: Path, numbers: Numbers, seed: int) -> Scan:
    """A scan of an object by the erring hexapod, which a circular scan does not move."""
    m, binning, views = MAGNIFICATION[thing], numbers.binning[thing], numbers.views[thing]
    full, setup = paper_scanner(m), demo_setup(paper=True)
    poses = scan_of(m, views) if path == "3D" else circular_scan(views)
    motion, noise = np.random.SeedSequence([seed, 6, round(10 * m), path == "3D"]).spawn(2)
    T_MH = real_T_MH(poses, m, np.random.default_rng(motion)) if path == "3D" else poses.T_MH
    truth = ProjectionMatrices(
        P=eq5_matrices(full, T_HT=setup.T_HT, T_MH=T_MH, alpha=poses.alpha),
        n_u=full.n_u,
        n_v=full.n_v,
        p_u=full.p_u,
        p_v=full.p_v,
        pose_id=poses.pose_id,
        scanner=full,
    ).binned(binning)
    return Scan(
        thing=thing,
        path=path,
        poses=poses,
        truth=truth,
        scanner=full.binned(binning),
        binning=binning,
        samples=numbers.samples,
        edge=numbers.edge,
        seed=int(noise.generate_state(1)[0]),
    )


def grid_of(thing: Object, numbers: Numbers) -> VoxelGrid:
    """Voxels as wide as a binned pixel at the axis, around the object at home."""
    scanner = paper_scanner(MAGNIFICATION[thing]).binned(numbers.binning[thing])
    if thing == "specimen":
        x = specimen(numbers.edge).vertices @ MOUNTED.T
    else:
        reach = sphere_diameters()[:, None] / 2
        x = np.concatenate([sphere_centres() - reach, sphere_centres() + reach])
    low, high = x.min(axis=0) - MARGIN_MM, x.max(axis=0) + MARGIN_MM
    side = float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification
    n = np.ceil((high - low) / side).astype(int)
    return VoxelGrid(shape=(int(n[2]), int(n[1]), int(n[0])), spacing=side, centre=(low + high) / 2)


@functools.cache
def attenuation_of(thing: Object) -> float:
    """1/mm: of the specimen behind 0.25 mm of copper and of ruby without a filter, at the mean energy of 180 kV."""
    tube = tube_spectrum(180.0)
    material, beam = ("EN AW-6082", tube.filtered("Cu", 0.25)) if thing == "specimen" else ("ruby", tube)
    return float(attenuation(material, np.array([beam.mean_energy]))[0])


@functools.cache
def beam_of(thing: Object) -> Beam:
    """The tube's spectrum behind its filter, condensed for the object's material."""
    tube = tube_spectrum(180.0)
    material, spectrum = ("EN AW-6082", tube.filtered("Cu", 0.25)) if thing == "specimen" else ("ruby", tube)
    return condense(spectrum, (material,), [LONGEST_MM])


def path_maker(scan: Scan) -> Callable[[int], Array]:
    """j -> path lengths in view j, finely sampled: (samples n_v, samples n_u), mm."""
    P = fine_matrices(scan.truth.P, scan.samples)
    n_u, n_v = scan.samples * scan.truth.n_u, scan.samples * scan.truth.n_v
    if scan.thing == "specimen":
        mesh = specimen(scan.edge)
        solid = MeshSolid(
            mesh=TriangleMesh(vertices=mesh.vertices @ MOUNTED.T, faces=mesh.faces),
            material="EN AW-6082",
            frame=Frame.W,
        )
        return lambda j: mesh_paths(P[j], solid, n_u, n_v)
    centres = sphere_centres()
    bottom = np.full(len(centres), BASE_TOP)
    return lambda j: ball_paths(P[j], centres, sphere_diameters() / 2, SHAFT_DIAMETER / 2, bottom, n_u, n_v)


class Radiographs(Sequence[Any]):
    """The frames of a scan, uint16 [v, u], made when they are first asked for; the same frame is always the same.

    folder: where the frames of a large scan are kept between volumes and runs.
    """

    images_are = "counts"

    def __init__(self, scan: Scan, folder: FilePath | None = None) -> None:
        self.scan, self._paths = scan, path_maker(scan)
        self._mu = attenuation_of(scan.thing)
        self._beam = beam_of(scan.thing) if scan.real_beam else None
        self._seeds = np.random.SeedSequence(scan.seed).generate_state(len(scan.poses))
        shape = (len(scan.poses), scan.truth.n_v, scan.truth.n_u)
        large = 2 * np.prod(shape) > MOST_KEPT_BYTES
        self.file = (
            folder / f"frames-{scan.thing}-{scan.path}-{frames_key(scan).digest[:16]}.npy" if folder and large else None
        )
        self._kept: Any = None if large else np.zeros(shape, dtype=np.uint16)
        if self.file is not None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            mode: Any = "r+" if self.file.exists() else "w+"
            self._kept = np.lib.format.open_memmap(self.file, mode, dtype=np.uint16, shape=shape)

    def __len__(self) -> int:
        return len(self.scan.poses)

    def transmission(self, j: int) -> Array:
        """Without noise (n_v, n_u): exp(-mu L) averaged over each pixel, or what a real beam makes of it."""
        s, (n_v, n_u) = self.scan.samples, (self.scan.truth.n_v, self.scan.truth.n_u)
        L = self._paths(j)
        if self._beam is None:
            return np.asarray(np.exp(-self._mu * L).reshape(n_v, s, n_u, s).mean(axis=(1, 3)))
        fine = self._beam.transmission(L.reshape(-1, 1)).reshape(L.shape)
        blurred = gaussian_filter(fine, BLUR_PX * s / self.scan.binning, mode="nearest")
        mean = blurred.reshape(n_v, s, n_u, s).mean(axis=(1, 3))
        return with_scatter(mean, Scatter(
            constant=SCATTER_CONSTANT, amount=SCATTER_AMOUNT, sigma=SCATTER_PX / self.scan.binning
        ))  # fmt: skip

    def __getitem__(self, j: int) -> Any:  # type: ignore[override]  # frames are asked for one by one
        # A frame counts 1 at least, and its last pixel is written last: 0 there says that it has not been made.
        if self._kept is not None and self._kept[j, -1, -1]:
            return self._kept[j]
        T = self.transmission(int(j))
        noise = np.random.default_rng(self._seeds[int(j)]).standard_normal(T.shape)
        counts = WHITE * (T + np.sqrt(T) / (SNR_UNBINNED * self.scan.binning) * noise)
        frame = np.clip(np.rint(counts), 1, 65535).astype(np.uint16)
        if self._kept is not None:
            self._kept[j] = frame
        return frame

    def forget(self) -> None:
        """Remove the kept frames: they are not needed any more."""
        self._kept = None
        if self.file is not None:
            self.file.unlink(missing_ok=True)


def frames_key(scan: Scan) -> Key:
    """Of all that a scan's frames depend on."""
    return key_of("study-frames", scan=scan, mu=attenuation_of(scan.thing), sources=sources(__name__))
