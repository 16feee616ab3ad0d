"""From circles in the radiographs of a calibrated standard to the pose of every view of a path.  Paper ref. [8]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.identify import Circles, identify, overlapping
from tomopose.calibration.arrangements.multi_sphere.mount import find_mount
from tomopose.calibration.arrangements.multi_sphere.path import BallView, PathSolution, freed_of, solve_path
from tomopose.calibration.arrangements.multi_sphere.result import MultiSphereCalibration
from tomopose.calibration.arrangements.multi_sphere.standard import FEWEST_BALLS, SphereStandard
from tomopose.calibration.arrangements.multi_sphere.view_pose import pose_from_balls, view_rows
from tomopose.calibration.checks.verdict import Finding
from tomopose.calibration.model.assumed import assumed_for
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import Repeatability
from tomopose.units import Array
from tomopose.values import require_types

FAR = 5.0
"""Standard uncertainties beyond which a centre is set aside: by chance one in 3e5."""
MOST_ASIDE = 3
"""Of a view.  More than that, and it is the view that is wrong."""
MISFIT = 2.0
"""chi2/dof from which the stated uncertainties do not hold: with the some hundred centres of a short path its own
scatter is below 0.1."""
MISFIT_REJECTED = 25.0
MOST_LOST = 0.1
"""Share of views without a pose from which the path is rejected."""
MOVED_SIGMAS = 4.0
SYMMETRY_MM = 0.3
"""Distances that differ by less do not identify a ball in a view: 0.3 mm are some pixels at any magnification."""


@dataclass(frozen=True, kw_only=True)
class _Found:
    """One view: what was used, its own pose, and the words about what was not."""

    view: BallView
    T_MW: RigidTransform
    left_out: tuple[str, ...]


@require_types
def calibrate_multi_sphere(
    scanner: Scanner,
    poses: PoseSequence,
    circles: Sequence[Circles],
    standard: SphereStandard,
    *,
    left_out: Sequence[Sequence[str]] | None = None,
    fix: Sequence[str] = (),
    repeatability: Repeatability | None = None,
) -> MultiSphereCalibration:
    """The pose of the standard in every view, each alone and all along the path, and what they share.

    Parameters
    ----------
    scanner:  intrinsic geometry; values with a standard uncertainty are estimated along the path with it as prior.
    poses:    the table of the path: names of the views, and where the plate and the table were.  It gives the home of
              the matrices and is compared with what was found; no pose follows from it.
    circles:  what was measured in each view, in the order of `poses`; not identified.
    standard: the calibrated balls.
    left_out: words about circles that detection did not measure, by view.
    fix:      scanner values to hold although they have a standard uncertainty.
    repeatability: of the manipulator between this scan and the one on the same path that is reconstructed.

    Raises
    ------
    InputError          where counts disagree, the standard is symmetric, or no view gives a pose.
    NotConvergedError   where the path has no optimum.
    """
    if len(circles) != len(poses):
        raise InputError(f"{len(poses)} poses but {len(circles)} views; one for each pose is needed")
    standard.require_asymmetric(SYMMETRY_MM)
    words = [()] * len(poses) if left_out is None else left_out
    found: dict[str, _Found] = {}
    lost: dict[str, str] = {}
    before: list[RigidTransform] = []
    for name, view, told in zip(poses.pose_id, circles, words, strict=True):
        try:
            here = _view_of(scanner, view, standard, tuple(told), before)
        except (InputError, NotConvergedError, NotObservableError) as error:
            lost[name] = str(error)
            continue
        found[name] = here
        before = [_ahead(before, here.T_MW), here.T_MW] if before else [here.T_MW]
    if not found:
        first, why = next(iter(lost.items()))
        raise InputError(f"the standard's pose was found in none of {len(poses)} views; view {first!r}: {why}")
    assumed = assumed_for(scanner, free=(), fix=fix, priors={})
    views, starts = [f.view for f in found.values()], [f.T_MW for f in found.values()]
    path = solve_path(scanner, views, standard.centres, starts, sigma=standard.sigma_mm, freed=freed_of(assumed))
    middle = standard.centres.mean(axis=0)
    rows = poses.select(poses.index_of(list(found)))
    mount = find_mount(path.scanner, rows, path.T_MW, middle)
    return MultiSphereCalibration(
        scanner=path.scanner,
        given=scanner,
        standard=standard,
        pose_id=tuple(found),
        views=tuple(views),
        path=path,
        home=path.scanner.T_TW(0.0) @ mount.T_HT @ RigidTransform.identity(Frame.M, Frame.H) @ mount.X,
        alone=np.array([_apart(a, b, middle) for a, b in zip(starts, path.T_MW, strict=True)]),
        manipulator_errors=mount.errors,
        assumed=assumed,
        lost=lost,
        left_out={name: f.left_out for name, f in found.items() if f.left_out},
        checks=_findings(path, standard, scanner, found, lost, assumed_sigma={a.name: a.sigma for a in assumed}),
        repeatability=repeatability,
    )


def _view_of(
    scanner: Scanner,
    circles: Circles,
    standard: SphereStandard,
    told: tuple[str, ...],
    before: Sequence[RigidTransform],
) -> _Found:
    """One view alone.  Raises where it has no pose."""
    # the newest pose continued, then the newest itself
    which = identify(scanner, circles, standard, near=before)
    hidden = overlapping(scanner, standard, which.T_MW)
    words = list(told)
    kept = []
    for c, ball in enumerate(which.ball.tolist()):
        if ball < 0:
            u, v = circles.x_D[c]
            words.append(f"the circle at ({u:.0f}, {v:.0f}) is no ball of the standard")
        elif ball in hidden:
            words.append(f"ball {standard.names[ball]} overlaps with ball {standard.names[hidden[ball]]}")
        else:
            kept.append(c)
    if len(kept) < FEWEST_BALLS:
        raise InputError(f"{len(kept)} of {len(standard)} balls can be used; at least {FEWEST_BALLS} are needed")
    view = BallView(ball=which.ball[kept], x_D=circles.x_D[kept], covariance=circles.covariance[kept])
    T = which.T_MW
    for aside in range(MOST_ASIDE + 1):
        _, _, G, _ = view_rows(scanner, T, standard.centres[view.ball])
        C = view.covariance + standard.sigma_mm[view.ball, None, None] ** 2 * (G @ np.swapaxes(G, 1, 2))
        pose = pose_from_balls(scanner, view.x_D, standard.centres[view.ball], covariance=C, start=T)
        T = pose.T_MW
        z2 = np.einsum("ki,kij,kj->k", pose.residuals, np.linalg.inv(C), pose.residuals)
        worst = int(np.argmax(z2))
        # the median of chi2 with two degrees of freedom is 2 ln 2
        scale = max(1.0, float(np.median(z2)) / (2 * np.log(2)))
        if z2[worst] <= FAR**2 * scale or aside == MOST_ASIDE or len(view.ball) <= FEWEST_BALLS:
            break
        words.append(
            f"ball {standard.names[view.ball[worst]]} is {np.linalg.norm(pose.residuals[worst]):.3g} px, "
            f"{np.sqrt(z2[worst]):.3g} standard uncertainties, from where the others place it"
        )
        rest = np.arange(len(view.ball)) != worst
        view = BallView(ball=view.ball[rest], x_D=view.x_D[rest], covariance=view.covariance[rest])
    return _Found(view=view, T_MW=T, left_out=tuple(words))


def _ahead(before: Sequence[RigidTransform], here: RigidTransform) -> RigidTransform:
    """Where the object would be next if it went on as from the view before."""
    last = before[-1]
    # by way of its logarithm a rotation stays one, however long the path is
    turn = exp_rotation(log_rotation(here.R @ last.R.T))
    return replace(here, R=turn @ here.R, t=2 * here.t - last.t)


def _apart(alone: RigidTransform, along: RigidTransform, middle: Array) -> Array:
    return np.concatenate([log_rotation(alone.R @ along.R.T), alone.apply(middle) - along.apply(middle)])


def _findings(
    path: PathSolution,
    standard: SphereStandard,
    given: Scanner,
    found: dict[str, _Found],
    lost: dict[str, str],
    *,
    assumed_sigma: dict[str, float],
) -> tuple[Finding, ...]:
    """What the path's own numbers say about it."""
    out = []
    n, share = len(found) + len(lost), len(lost) / (len(found) + len(lost))
    if lost:
        named = ", ".join(list(lost)[:5]) + (" ..." if len(lost) > 5 else "")
        out.append(Finding(
            rule="views without a pose", value=share, limit=MOST_LOST,
            words=f"{len(lost)} of {n} views have no pose ({named}); their matrices are missing",
            remedy="look at these images; leave the same views out of the scan that is reconstructed",
            verdict="rejected" if share > MOST_LOST else "doubtful",
        ))  # fmt: skip
    ratio = path.chi2 / path.dof if path.dof > 0 else float("nan")
    if not ratio <= MISFIT:
        out.append(Finding(
            rule="residuals", value=ratio, limit=MISFIT,
            words=f"the centres miss their places by {np.sqrt(ratio):.3g} times what their uncertainties explain",
            remedy="check the standard's coordinates, their uncertainty and the scanner's stated values",
            verdict="rejected" if not ratio <= MISFIT_REJECTED else "doubtful",
        ))  # fmt: skip
    moved = np.abs(path.centres - standard.centres).max(axis=1) / np.maximum(standard.sigma_mm, 1e-6)
    if moved.max() > MOVED_SIGMAS:
        k = int(np.argmax(moved))
        out.append(Finding(
            rule="coordinates of the standard", value=float(moved.max()), limit=MOVED_SIGMAS,
            words=f"ball {standard.names[k]} is {1e3 * np.abs(path.centres - standard.centres)[k].max():.3g} um from "
            f"its calibrated place, {moved[k]:.2g} times the standard uncertainty",
            remedy="state the coordinates' uncertainty, or have the standard calibrated again", verdict="doubtful",
        ))  # fmt: skip
    for name in path.shared.scanner_names:
        off = abs(getattr(path.scanner, name) - getattr(given, name)) / assumed_sigma[name]
        if off > MOVED_SIGMAS:
            out.append(Finding(
                rule="scanner's values", value=off, limit=MOVED_SIGMAS,
                words=f"{name} is {getattr(path.scanner, name):.7g}, {off:.2g} standard uncertainties from the stated "
                f"{getattr(given, name):.7g}",
                remedy=f"check {name} in scanner.json or state its sigma", verdict="doubtful",
            ))  # fmt: skip
    return tuple(out)
