"""The uncertainty of measurands by simulation with the virtual CT (JCGM 101:2008).

Each draw is a whole scan of the nominal object: photon noise of its own, matrices from a calibration drawn from its
covariance, reconstruction and measurement by the plan.

Nobody knows where within voxels and pixels a part lies, nor its two ends against each other.  In each draw the object
therefore lies up to half a voxel elsewhere, and is up to 2 % smaller or larger in voxels and pixels: over 25 voxels
that moves one end by half a voxel against the other.  (Another grid on the same images would not do: how voxels lie to
the rows of the detector matters too, and is the same in all scans.)  It is the scanner with its voxels that is moved
and made larger or smaller, so that the plan and its nominal values stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS
from tomopose.calibration.model.parameters import base_name
from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.object_pose import object_pose, pixels
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform, moved
from tomopose.manipulator.error_models import RigidErrors, correction
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import MeasurementPlan
from tomopose.measurement.result import MeasurementResult
from tomopose.measurement.uncertainty import Simulated, shortest_interval
from tomopose.reconstruction.line_integrals import Correction
from tomopose.reconstruction.run import reconstruct
from tomopose.simulation.detector.detector import expose, reference_images
from tomopose.simulation.run import SimulatedRun, signal
from tomopose.units import Array
from tomopose.volume import Volume, VoxelGrid

LEAST_DRAWS = 3
SIZE_SPREAD = 0.02
"""Share by which the object is smaller or larger at most, in voxels."""


def simulated_errors(
    run: SimulatedRun,
    plan: MeasurementPlan,
    grid: VoxelGrid,
    *,
    draws: int,
    calibration: Calibration | None = None,
    seed: int = 0,
    options: Mapping[str, object] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Mapping[str, Simulated]:
    """Measurand -> its error over `draws` virtual scans: mean, u, shortest 95 % interval, mm or rad.

    run:         the virtual scan (of `tomopose.simulate`), poses as believed and as they truly are.
    grid:        of the reconstructions: the real scan's, or a coarser one for a quick look.
    calibration: its covariance is drawn from, about the run's own mount and poses.  None: both are known exactly.
    options:     of `reconstruct`, such as algorithm and iterations.

    Where the calibration holds errors of the manipulator, their covariance is drawn too.  Where the scene's manipulator
    errs, its plate is then taken to be where the calibration puts it, otherwise where it was commanded.

    The truth is the plan's nominal value (calibrated distances and diameters for a multi-sphere standard); without one
    the error is that from the mean of the draws, and its mean is nan.  Raises InputError for too few draws or for a
    calibration that does not belong to the run's scanner, and what reconstruction and measurement raise.
    """
    if draws < LEAST_DRAWS:
        raise InputError(f"{draws} draws; at least {LEAST_DRAWS} are needed for a standard deviation")
    bare = plan.model_copy(update={"repeats": {}})
    found: dict[str, list[MeasurementResult]] = {}
    volumes = virtual_volumes(run, grid, draws=draws, calibration=calibration, seed=seed, options=options)
    for k, volume in enumerate(volumes):
        for r in measure(volume, bare).results:
            found.setdefault(r.name, []).append(r)
        if progress is not None:
            progress(k + 1, draws)
    missing = [name for name, values in found.items() if len(values) != draws]
    if missing:
        raise InputError(f"not every virtual scan shows {', '.join(missing[:5])}; is the scene the plan's object?")
    return {name: _summary(rows, _truth(plan, rows[0]), seed, calibration is not None) for name, rows in found.items()}


def virtual_volumes(
    run: SimulatedRun,
    grid: VoxelGrid,
    *,
    draws: int,
    calibration: Calibration | None = None,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
) -> Iterator[Volume]:
    """Reconstructions of the run, each with noise, place, size in voxels and believed matrices of its own; draw k is
    always the same."""
    for k in range(draws):
        sequence = np.random.SeedSequence([seed, k])
        noise, rng = int(sequence.generate_state(1)[0]), np.random.default_rng(sequence)
        found = drawn_matrices(run, grid, calibration, rng)
        size = 1 + SIZE_SPREAD * rng.uniform(-1, 1)
        shift = grid.spacing / size * rng.uniform(-0.5, 0.5, 3)
        placed = _placed(run, size, shift)
        # What the scanner saw at size (x + shift) it sees at x, being so much smaller and the object moved.
        motion = np.diag([size, size, size, 1.0])
        motion[:3, 3] = size * shift
        matrices = replace(
            found,
            P=found.P @ motion,
            p_u=found.p_u / size,
            p_v=found.p_v / size,
            scanner=None if found.scanner is None else _smaller(found.scanner, size),
        )
        box = replace(grid, centre=grid.centre / size - shift, spacing=grid.spacing / size)
        images = [expose(signal(placed, i), run.detector, run.scanner, seed=noise, frame=i) for i in range(len(run))]
        white, dark = _levels(run, noise)
        levels = Correction(images_are="counts", white=white, dark=dark)
        yield reconstruct(images, matrices, box, correction=levels, consistency="off", **dict(options or {}))


def _placed(run: SimulatedRun, size: float, shift: Array) -> SimulatedRun:
    """The run on a scanner smaller by `size`, the object of the same size moved by shift (3,), mm along W at home."""
    shift_M = run.T_HT.R.T @ run.scanner.T_TW(0.0).R.T @ shift
    T_MH = replace(run.T_MH, t=run.T_MH.t / size + run.T_MH.R @ shift_M)
    return replace(run, scanner=_smaller(run.scanner, size), T_HT=replace(run.T_HT, t=run.T_HT.t / size), T_MH=T_MH)


def _smaller(scanner: Scanner, size: float) -> Scanner:
    lengths = ("d_SD", "d_SR", "p_u", "p_v", "axis_y")
    return replace(scanner, **{name: getattr(scanner, name) / size for name in lengths})


def _levels(run: SimulatedRun, seed: int) -> tuple[Any, Any]:
    """White and dark level of a run's grey values."""
    if run.detector.output == "corrected":
        return run.detector.white, 0.0
    dark, flat = reference_images(run.detector, run.scanner, seed)
    return flat, dark


def drawn_matrices(
    run: SimulatedRun, grid: VoxelGrid, calibration: Calibration | None, rng: np.random.Generator
) -> ProjectionMatrices:
    """The matrices that somebody with a calibration drawn from its covariance would use; the run's own without one.

    The object's pose under them is the true one as nearly as it can be, over `grid`.  Errors as `simulated_errors`.
    """
    scanner = run.scanner
    alpha = run.poses.alpha
    if calibration is None:
        P = eq5_matrices(scanner, T_HT=run.T_HT, T_MH=run.poses.T_MH, alpha=alpha)
    else:
        _require_same_detector(scanner, calibration)
        values, vectors = np.linalg.eigh(calibration.covariance)
        delta = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        scanner, T_HT = _drawn(scanner, run.T_HT, calibration.tangent, delta)
        drawn = eq5_matrices(scanner, T_HT=T_HT, T_MH=_drawn_poses(run, calibration, delta), alpha=alpha)
        P = _object_held(drawn, eq5_matrices(run.scanner, T_HT=run.T_HT, T_MH=run.T_MH, alpha=alpha), grid)
    return ProjectionMatrices(
        P=P,
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=run.poses.pose_id,
        scanner=scanner,
    )


def _require_same_detector(own: Scanner, calibration: Calibration) -> None:
    for name in ("n_u", "n_v", "p_u", "p_v"):
        a, b = getattr(own, name), getattr(calibration.scanner, name)
        if abs(a - b) > 1e-6 * abs(b) and not (name == "p_u" and "pitch_ratio" in calibration.tangent):
            raise InputError(
                f"the scene's detector has {name} = {a:g}, the calibration's {b:g}; simulate the "
                "detector that was calibrated (scanner.binning reads it out in blocks)"
            )


def _drawn_poses(run: SimulatedRun, calibration: Calibration, delta: Array) -> RigidTransform:
    """Where the plate is taken to be, after a step delta in the manipulator's errors."""
    if isinstance(calibration.errors, RigidErrors):
        return run.poses.T_MH
    fixed = correction(calibration.errors, run.poses)
    errs = not np.allclose(run.T_MH.matrix, run.poses.T_MH.matrix, atol=1e-9)
    T = fixed.poses.T_MH if errs else run.poses.T_MH
    R, t = moved(T.R, T.t, fixed.J @ delta[[calibration.tangent.index(name) for name in fixed.names]])
    return replace(T, R=R, t=t)


def _object_held(P: Array, P_true: Array, grid: VoxelGrid) -> Array:
    """Matrices P (n, 3, 4) after the motion of the object that brings its images nearest to those under P_true.

    Drawn errors may move the object as a whole, on which no length depends, out of reach of the plan's nominal places.
    """
    corners = grid.centre + BOX_CORNERS * (grid.spacing * np.array(grid.n_xyz) / 4)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = object_pose(P, pixels(P_true, corners), corners)
    return np.asarray(P @ motion)


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


def _summary(rows: list[MeasurementResult], truth: float | None, seed: int, calibrated: bool) -> Simulated:
    values = np.array([r.value for r in rows])
    errors = values - (values.mean() if truth is None else truth)
    low, high = shortest_interval(errors)
    return Simulated(
        mean=math.nan if truth is None else float(errors.mean()),
        u=float(errors.std(ddof=1)),
        low=low,
        high=high,
        runs=len(errors),
        stable=False,
        seed=seed,
        u_fit=float(np.sqrt(np.mean([r.u**2 for r in rows]))),
        dof_fit=float(np.sum([r.dof for r in rows])),
        with_calibration=calibrated,
    )
