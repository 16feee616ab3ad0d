"""Calibration poses by optimal design: as few images as the wanted accuracy needs, within the machine's limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.assumed import taken_as_known
from tomopose.calibration.model.ball_projection import projection_blocks, whiteners
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.rigid.fit import tangent_names
from tomopose.calibration.rigid.pose_noise import PoseNoise, expected_scatter, total_covariance
from tomopose.errors import InputError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import Repeatability
from tomopose.planning.exchange import Chosen, Criterion, exchange
from tomopose.planning.limits import PlanLimits, candidates
from tomopose.planning.order import ordered, rows_of, run_time
from tomopose.planning.resolve import Resolvability, exact_problem, resolvability, telling
from tomopose.planning.target import ScanTarget, scan_target
from tomopose.trajectory.pose_grid import pose_grid
from tomopose.trajectory.tilt import R_HT_MOUNTED
from tomopose.units import Array
from tomopose.values import require_types, value

SIGMA_PX = 0.0207 / np.sqrt(2.0)
"""Standard uncertainty of a coordinate of a centre: the paper's d_rms of 0.0207 px counts both (eq. 8)."""

BALL_MM = (10.0, -8.0, 16.0)
"""A ball 20 mm off the pivot in no special direction: on the pivot, rotations could not be distinguished from one
another."""

TRADED = 0.5
"""Share of the largest weight in an undetermined direction from which a coordinate is named: the coordinates that trade
with one another have equal weights once each is scaled by its own information."""

MOST_IMAGES = 400
RESOLVING_ROUNDS = 8


@value
class PosePlan:
    """Poses to image, in order, the first repeated at the end.

    predicted:   scan reprojection error, px rms, that the calibration from these poses will cause, with everything that
                 it assumes: scanner values that nobody stated, the scatter of the poses.
    exact:       the same if those scanner values were exact.
    reference:   the same (`predicted`) of the paper's 189 poses under the same noise, table still.
    u:           predicted standard uncertainties by coordinate of the calibration's tangent (mm, rad, px).
    covariance:  (m, m) of all.
    resolved:    which alternative conventions these poses would show, or None where it was not asked for.
    duration:    s.
    """

    poses: PoseSequence
    predicted: float
    exact: float
    reference: float
    u: Mapping[str, float]
    covariance: Array
    resolved: Resolvability | None
    duration: float

    def __len__(self) -> int:
        return len(self.poses)


def nominal_mount() -> RigidTransform:
    """R_z(pi), no translation: the paper's mount before it is calibrated."""
    return RigidTransform(R=R_HT_MOUNTED, t=np.zeros(3), source=Frame.H, target=Frame.T)


def pose_information(
    scanner: Scanner,
    poses: PoseSequence,
    *,
    T_HT: RigidTransform,
    t: Array,
    sigma: float,
    free: FreeParameters | None = None,
    scatter: PoseNoise | None = None,
) -> Array:
    """(n, 2, m): whitened Jacobian of every pose by w_HT, t_HT, t and the freed parameters; sigma: px, a coordinate."""
    b = projection_blocks(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    parts = [b.J_mount, b.J_t]
    if free is not None and len(free):
        parts.append(b.J_scanner[:, :, free.cols] * free.factor)
    J = np.concatenate(parts, axis=2)
    if scatter is None:
        return J / sigma
    detection = np.broadcast_to(sigma**2 * np.eye(2), (len(J), 2, 2))
    return np.asarray(whiteners(total_covariance(detection, b, scatter)) @ J)


def prior_information(free: FreeParameters) -> Array:
    N = np.zeros((9 + len(free), 9 + len(free)))
    N[9:, 9:] = np.diag(free.information)
    return N


def predicted_covariance(
    scanner: Scanner,
    poses: PoseSequence,
    *,
    T_HT: RigidTransform,
    t: ArrayLike,
    sigma: float = SIGMA_PX,
    free: FreeParameters | None = None,
    scatter: PoseNoise | None = None,
) -> Array:
    """(m, m): covariance of a calibration from these poses, before a single image is taken."""
    ball = np.asarray(t, dtype=np.float64)
    L = pose_information(scanner, poses, T_HT=T_HT, t=ball, sigma=sigma, free=free, scatter=scatter)
    N = np.einsum("kia,kib->ab", L, L)
    return inverse_information(N if free is None else N + prior_information(free))


def _largest_affordable(limits: PlanLimits) -> int:
    """Images that fit in the time if every move takes its least time."""
    if limits.total_time is None:
        return MOST_IMAGES
    return min(MOST_IMAGES, int(limits.total_time // (limits.image_time + limits.settle)))


@value
class DesignSettings:
    """How a plan is searched.

    sigma:     expected standard uncertainty of a centre's coordinate, px.
    maker:     the manipulator's repeatability, from which a calibration assumes the scatter of the poses.
    criterion: "A": the scan reprojection error itself;  "D": the volume of the confidence region.
    resolve:   also see to it that the poses show every alternative convention that the limits let them show, by 5
               sigma, and find which they would not.
    seed:      of the exchange's starts.
    """

    sigma: float = SIGMA_PX
    maker: Repeatability = Repeatability()
    criterion: Criterion = "A"
    resolve: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.sigma > 0:
            raise InputError(f"sigma is {self.sigma}; a positive number of pixels is needed")


@dataclass(frozen=True, kw_only=True)
class _Search:
    """All that a choice of poses rests on.

    pool: candidates; L (n, 2, m): whitened rows of each; prior (m, m); T_HT, t: nominal mount and ball; goal: scan
    reprojection error, px rms, to reach with as few images as possible, where n, the number of images, is None.
    counts: (m,) bool, coordinates that the goal counts: all of them, or all but the scanner values that are assumed.
    """

    scanner: Scanner
    T_HT: RigidTransform
    t: Array
    limits: PlanLimits
    settings: DesignSettings
    target: ScanTarget
    pool: PoseSequence
    L: Array
    prior: Array
    n: int | None
    goal: float
    counts: Any

    def rms(self, index: Any) -> float:
        """Scan reprojection error, px rms, of the candidates `index` by the coordinates that count, others exact."""
        return _rms(self.target, self.L[index], self.prior, self.counts)

    def choose(self, k: int, must: list[int]) -> Chosen:
        """k images, those of `must` among them (half of k at most), one pose twice: the first, which ends the run."""
        how: dict[str, Any] = {
            "M": self.target.M, "N_0": self.prior, "criterion": self.settings.criterion, "seed": self.settings.seed,
            "fixed": must[: k // 2],
        }  # fmt: skip
        best = exchange(self.L, k, **how)
        if len(np.unique(best.index)) < k:
            return best
        fewer = exchange(self.L, k - 1, **how)
        index = np.append(fewer.index, fewer.index[0])
        N = np.einsum("kia,kib->ab", self.L[index], self.L[index]) + self.prior
        return Chosen(index=index, covariance=inverse_information(N), value=np.nan)

    def design(self, must: list[int]) -> tuple[PoseSequence, Chosen]:
        """Poses in the order in which they are driven, within the time allowed."""
        most = _largest_affordable(self.limits)
        least = int((np.diag(self.prior) == 0).sum())
        if self.n is not None:
            chosen = self.choose(_checked(self.n, most), must)
        else:
            chosen = _fewest(lambda k: self.choose(k, must), self.rms, self.goal, most, least)
        poses = ordered(rows_of(self.pool, chosen.index), self.limits)
        allowed = self.limits.total_time
        while allowed is not None and run_time(poses, self.limits) > allowed and len(poses) > least:
            chosen = self.choose(len(poses) - max(1, len(poses) // 20), must)
            poses = ordered(rows_of(self.pool, chosen.index), self.limits)
        return poses, chosen

    def resolving(self, poses: PoseSequence, chosen: Chosen) -> tuple[PoseSequence, Resolvability]:
        """Poses that show more alternative conventions, from those given, and what they show."""
        must: list[int] = []
        given: dict[str, Any] = {"T_HT": self.T_HT, "t": self.t, "sigma": self.settings.sigma}
        resolved = resolvability(self.scanner, poses, **given)
        everything = exact_problem(self.scanner, self.pool, **given)
        for _ in range(RESOLVING_ROUNDS):
            more = telling(everything, chosen.index, resolved.unresolved, max(2, len(poses) // 8))
            if not more or 2 * len(must) > len(poses):
                break
            must += more
            other, other_chosen = self.design(must)
            better = resolvability(self.scanner, other, **given)
            # poses forced in for an alternative that they do not help against only cost accuracy
            if better.score <= resolved.score and _least(better) <= 1.1 * _least(resolved):
                break
            poses, chosen, resolved = other, other_chosen, better
        return poses, resolved


@require_types
def plan_poses(
    scanner: Scanner,
    *,
    T_HT: RigidTransform | None = None,
    t: ArrayLike = BALL_MM,
    n: int | None = None,
    goal: float | None = None,
    limits: PlanLimits | None = None,
    scan: PoseSequence | None = None,
    points: ArrayLike | None = None,
    free: Iterable[str] = (),
    priors: Mapping[str, float] | None = None,
    settings: DesignSettings | None = None,
) -> PosePlan:
    """The best calibration poses for a scan.

    Parameters
    ----------
    T_HT, t:   nominal mount (default R_z(pi)) and ball centre in M, mm: roughly is enough.  A ball on the pivot hides
               mistakes; the default is 20 mm off.
    n, goal:   number of images (the repeated first one included), or the scan reprojection error, px rms, to reach with
               as few as possible, everything assumed included.  Default: what the paper's 189 poses reach where the
               scanner's values are exact, in the share of mount and ball.
    limits:    travel, table angles, field of view, magnification, boxes, time.
    scan, points: what the calibration is for: the scan's poses and the object's points (p, 3) in W, mm
               (default: the paper's tilted scan, eq. (11), and a box of +-15, +-15, +-30 mm).
    free, priors: scanner parameters to be estimated too, as in `calibrate`.
    settings:  expected noise, criterion, search.

    Raises
    ------
    InputError, OutOfReachError, NotObservableError (a goal or parameter that no allowed poses reach).
    """
    T_HT = nominal_mount() if T_HT is None else T_HT.require(Frame.H, Frame.T)
    ball = np.asarray(t, dtype=np.float64).reshape(3)
    limits = PlanLimits() if limits is None else limits
    settings = DesignSettings() if settings is None else settings
    assumed, _, freed = taken_as_known((scanner,), free=free, priors=priors)
    target = scan_target(scanner, T_HT=T_HT, scan=scan, points=points, free=freed)
    pool = candidates(scanner, T_HT=T_HT, t=ball, limits=limits)
    noise: dict[str, Any] = {
        "T_HT": T_HT, "t": ball, "sigma": settings.sigma, "free": freed, "scatter": expected_scatter(settings.maker)
    }  # fmt: skip
    L = pose_information(scanner, pool, **noise)
    prior = prior_information(freed)
    _require_determined(L, prior, target)
    defaults = {a.name for a in assumed if a.source == "default"}
    exact = np.array([True] * 9 + [name not in defaults for name in freed.names])
    paper = pose_information(scanner, pose_grid(3), **noise)
    search = _Search(
        scanner=scanner, T_HT=T_HT, t=ball, limits=limits, settings=settings, target=target, pool=pool, L=L,
        prior=prior, n=n, goal=_rms(target, paper, prior, np.arange(len(prior)) < 9) if goal is None else goal,
        counts=exact if goal is None else np.ones(len(prior), dtype=bool),
    )  # fmt: skip
    poses, chosen = search.design([])
    resolved = None
    if settings.resolve:
        poses, resolved = search.resolving(poses, chosen)
    covariance = predicted_covariance(scanner, poses, **noise)
    return PosePlan(
        poses=poses,
        predicted=target.rms(covariance),
        exact=_rms(target, pose_information(scanner, poses, **noise), prior, exact),
        reference=target.rms(predicted_covariance(scanner, pose_grid(3), **noise)),
        u=dict(zip(tangent_names((0,), freed), np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        covariance=covariance,
        resolved=resolved,
        duration=run_time(poses, limits),
    )


def _least(resolved: Resolvability) -> float:
    """The smallest rise of chi2 by an alternative that these poses do not show."""
    return min((h.delta for h in resolved.unresolved), default=np.inf)


def _checked(n: int, most: int) -> int:
    if int(n) != n or n < 6:
        raise InputError(f"{n!r} images are asked for; a whole number from 6 is needed")
    if n > most:
        raise InputError(f"{n} images are asked for, but time allows at most {most}")
    return int(n)


def _require_determined(L: Array, prior: Array, target: ScanTarget) -> None:
    """All candidates together must determine every coordinate."""
    N = np.einsum("kia,kib->ab", L, L) + prior
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    value, V = np.linalg.eigh(N * scale[:, None] * scale)
    if value[0] < 1e-12:
        weight = np.abs(V[:, 0])
        # Coordinates that trade with one another have weights that rounding alone orders: all of them are named.
        shared = [n for n, w in zip(target.names, weight, strict=True) if w > TRADED * weight.max()]
        raise NotObservableError(
            f"no poses within these limits determine {', '.join(shared)}; allow more table angles or travel, or give "
            "one of them a prior",
            direction=", ".join(shared),
            singular_values=np.sqrt(np.maximum(value[::-1], 0.0)).tolist(),
        )


def _rms(target: ScanTarget, L: Array, prior: Array, counts: Any) -> float:
    """Scan error, px rms, of poses with the rows L (n, 2, m) by the coordinates that count, others exact."""
    N = np.einsum("kia,kib->ab", L, L) + prior
    part = np.ix_(counts, counts)
    return float(np.sqrt(max(np.trace(target.M[part] @ inverse_information(N[part])), 0.0)))


def _fewest(choose: Any, rms: Any, wanted: float, most: int, m: int) -> Chosen:
    """The smallest design that reaches the goal: doubling, then bisection."""
    low, high = max(6, m // 2 + 2), max(12, m)
    design = choose(min(high, most))
    while rms(design.index) > wanted:
        if high >= most:
            raise NotObservableError(
                f"{most} images reach {rms(design.index):.3g} px, not the {wanted:.3g} px asked for; allow more table "
                "angles or travel, state the sigmas of the scanner's values, or lower the goal",
            )
        low, high = high, min(2 * high, most)
        design = choose(high)
    while high - low > 1:
        middle = (low + high) // 2
        trial = choose(middle)
        if rms(trial.index) <= wanted:
            high, design = middle, trial
        else:
            low = middle
    result: Chosen = design
    return result
