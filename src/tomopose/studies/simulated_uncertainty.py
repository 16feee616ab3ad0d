"""The uncertainty of measurands by simulation with the virtual CT (JCGM 101:2008).

Each draw is a whole scan of the nominal object: photon noise of its own, matrices from a calibration drawn from its
covariance, reconstruction on a grid shifted by a part of a voxel, since nobody knows where in its voxels a part lies,
and measurement by the plan.  The noiseless images are made once: nothing of this changes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.calibration.parameters import base_name
from tomopose.calibration.residuals import SCANNER_COLUMNS
from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import MeasurementPlan
from tomopose.measurement.results import MeasurementResult
from tomopose.measurement.uncertainty import Simulated, shortest_interval
from tomopose.reconstruction.reconstruct import reconstruct
from tomopose.simulation.detector import expose, reference_images
from tomopose.simulation.run import SimulatedRun, signal
from tomopose.units import Array
from tomopose.volume import Volume, VoxelGrid

LEAST_DRAWS = 3


def simulated_errors(
    run: SimulatedRun,
    plan: MeasurementPlan,
    grid: VoxelGrid,
    *,
    draws: int,
    calibration: Calibration | None = None,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Mapping[str, Simulated]:
    """Measurand -> its error over `draws` virtual scans: mean, u, shortest 95 % interval, mm or rad.

    run:         the virtual scan (of `tomopose.simulate`), poses as believed and as they truly are.
    grid:        of the reconstructions: the real scan's, or a coarser one for a quick look.
    calibration: rigid; its covariance is drawn from, about the run's own mount.  None: the mount is known exactly.
    options:     of `reconstruct`, such as algorithm and iterations.

    The truth is the plan's nominal value (calibrated distances and diameters for a multi-sphere standard); without one
    the error is that from the mean of the draws, and its mean is nan.  Raises InputError for too few draws or for a
    calibration that does not belong to the run's scanner, and what reconstruction and measurement raise.
    """
    if draws < LEAST_DRAWS:
        raise InputError(f"{draws} draws; at least {LEAST_DRAWS} are needed for a standard deviation")
    bare = plan.model_copy(update={"repeats": {}})
    found: dict[str, list[float]] = {}
    truth: dict[str, float | None] = {}
    volumes = virtual_volumes(run, grid, draws=draws, calibration=calibration, seed=seed, options=options)
    for k, volume in enumerate(volumes):
        for r in measure(volume, bare).results:
            found.setdefault(r.name, []).append(r.value)
            truth[r.name] = _truth(plan, r)
        if progress is not None:
            progress(k + 1, draws)
    missing = [name for name, values in found.items() if len(values) != draws]
    if missing:
        raise InputError(f"not every virtual scan shows {', '.join(missing[:5])}; is the scene the plan's object?")
    return {name: _summary(np.array(values), truth[name], seed) for name, values in found.items()}


def virtual_volumes(
    run: SimulatedRun, grid: VoxelGrid, *, draws: int, calibration: Calibration | None = None, seed: int = 0,
    options: Mapping[str, Any] | None = None,
) -> Iterator[Volume]:
    """Reconstructions of the run, each with noise, believed matrices and grid of its own; draw k is always the same."""
    believed = _Believed(run, calibration)
    clean = [signal(run, i).astype(np.float32) for i in range(len(run))]
    for k in range(draws):
        sequence = np.random.SeedSequence([seed, k])
        noise, rng = int(sequence.generate_state(1)[0]), np.random.default_rng(sequence)
        matrices = believed.matrices(rng)
        shifted = replace(grid, centre=grid.centre + grid.spacing * rng.uniform(-0.5, 0.5, 3))
        images = [expose(T.astype(np.float64), run.detector, run.scanner, seed=noise, frame=i)
                  for i, T in enumerate(clean)]
        white, dark = _levels(run, noise)
        yield reconstruct(images, matrices, shifted, images_are="counts", white=white, dark=dark, consistency="off",
                          **dict(options or {}))


def _levels(run: SimulatedRun, seed: int) -> tuple[Any, Any]:
    """White and dark level of a run's grey values."""
    if run.detector.output == "corrected":
        return run.detector.white, 0.0
    dark, flat = reference_images(run.detector, run.scanner, seed)
    return flat, dark


@dataclass(frozen=True)
class _Believed:
    """The matrices that somebody with a drawn calibration would use."""

    run: SimulatedRun
    calibration: Calibration | None

    def __post_init__(self) -> None:
        if self.calibration is None:
            return
        if self.calibration.model != "rigid":
            raise InputError(
                f"the calibration's model is {self.calibration.model}; virtual scans are drawn from rigid ones. Give "
                "the manipulator's errors in the scene instead"
            )
        own, theirs = self.run.scanner, self.calibration.scanner
        for name in ("n_u", "n_v", "p_u", "p_v"):
            a, b = getattr(own, name), getattr(theirs, name)
            if abs(a - b) > 1e-6 * abs(b) and not (name == "p_u" and "pitch_ratio" in self.calibration.tangent):
                raise InputError(f"the scene's detector has {name} = {a:g}, the calibration's {b:g}; simulate the "
                                 "detector that was calibrated (scanner.binning reads it out in blocks)")

    def matrices(self, rng: np.random.Generator) -> ProjectionMatrices:
        run, scanner, T_HT = self.run, self.run.scanner, self.run.T_HT
        if self.calibration is not None:
            values, vectors = np.linalg.eigh(self.calibration.covariance)
            delta = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
            scanner, T_HT = _drawn(scanner, T_HT, self.calibration.tangent, delta)
        alpha = np.zeros(len(run)) if run.poses.alpha is None else run.poses.alpha
        P = eq5_matrices(scanner, T_HT=T_HT, T_MH=run.poses.T_MH, alpha=alpha)
        return ProjectionMatrices(P=P, n_u=scanner.n_u, n_v=scanner.n_v, p_u=scanner.p_u, p_v=scanner.p_v,
                                  pose_id=run.poses.pose_id, scanner=scanner)


def _drawn(
    scanner: Scanner, T_HT: RigidTransform, tangent: tuple[str, ...], delta: Array
) -> tuple[Scanner, RigidTransform]:
    """Scanner and mount after a step delta in the coordinates of a calibration's covariance."""
    T = replace(T_HT, R=exp_rotation(delta[:3]) @ T_HT.R, t=T_HT.t + delta[3:6])
    for name, d in zip(tangent, delta, strict=True):
        base = base_name(name)
        if base == "pitch_ratio":
            scanner = replace(scanner, p_u=scanner.p_u + d * scanner.p_v)
        elif base in SCANNER_COLUMNS:
            scanner = replace(scanner, **{base: getattr(scanner, base) + d})
    return scanner, T


def _truth(plan: MeasurementPlan, result: MeasurementResult) -> float | None:
    """What the nominal object's measurand truly is, mm or rad; None where the plan does not say."""
    for p in plan.measurands:
        if p.name == result.name:
            return p.nominal_mm if p.nominal_deg is None else math.radians(p.nominal_deg)
    return result.reference


def _summary(values: Array, truth: float | None, seed: int) -> Simulated:
    errors = values - (values.mean() if truth is None else truth)
    low, high = shortest_interval(errors)
    return Simulated(mean=math.nan if truth is None else float(errors.mean()), u=float(errors.std(ddof=1)), low=low,
                     high=high, runs=len(errors), stable=False, seed=seed)
