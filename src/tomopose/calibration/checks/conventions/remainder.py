"""What fits of readings leave in all rows, and where they place the balls: of many readings at once.

A reading has only some hundred rows, so that what is calculated of one takes as long as of all of them together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import BELONGING, BELONGING_MEAN
from tomopose.calibration.checks.placement import Placement
from tomopose.calibration.model.covariance import medians
from tomopose.calibration.model.parameters import FreeParameters, scanner_vectors_at, scanners_can_be
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import Cameras, outlines_of
from tomopose.calibration.rigid.fit import Fit
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Remainder:
    """What a fit leaves.

    chi2: of all rows, with the priors; not finite where a ball is behind the source.
    d_rms: px;  sigmas: rms residual of a coordinate in stated standard uncertainties, of the 80 % of the centres that
    fit best;  share: d_rms over the rms spread of the centres.
    placed: where the balls are on the beam, by the scanner as declared.
    size_ratio: measured size of the silhouettes over the calculated one; NaN where it is not known.
    """

    chi2: float
    d_rms: float
    sigmas: float
    share: float
    placed: Placement
    size_ratio: float


def remainders(
    problems: Sequence[Problem], cameras: Sequence[Cameras], fits: Sequence[Fit], free: FreeParameters
) -> list[Remainder]:
    """Of each fit (with all that `free` names among its deltas) of a problem, in order."""
    together: dict[int, list[int]] = {}
    for k, one in enumerate(cameras):
        together.setdefault(id(one), []).append(k)
    found: dict[int, Remainder] = {}
    for members in together.values():
        some = _of_one_table([problems[k] for k in members], cameras[members[0]], [fits[k] for k in members], free)
        found.update(zip(members, some, strict=True))
    return [found[k] for k in range(len(problems))]


def _of_one_table(
    problems: list[Problem], cameras: Cameras, fits: list[Fit], free: FreeParameters
) -> Iterator[Remainder]:
    """The same of problems that are seen by the same cameras, row by row."""
    first, n, which = problems[0], len(problems[0]), cameras.which
    s = scanner_vectors_at(first.s_0, free, np.array([f.delta for f in fits]))
    P = cameras.seen_by(s)
    x_T = _balls_in_table(problems, fits, s[:, first.run, -1])
    y = np.einsum("anij,anj->ani", np.take(P, which, axis=1), x_T)
    x_D = np.array([one.x_D for one in problems])
    r = x_D - y[..., :2] / np.where(y[..., 2:] > 0.0, y[..., 2:], np.nan)
    r_white = np.einsum("anij,anj->ani", np.array([one.W for one in problems]), r)
    d2 = np.einsum("ani,ani->an", r_white, r_white)
    kept = np.sort(d2, axis=1)[:, : max(1, int(np.ceil(BELONGING * n)))]
    d_rms = np.sqrt(np.einsum("ani,ani->a", r, r) / n)
    x_D -= x_D.mean(axis=1, keepdims=True)
    spread = np.sqrt(np.einsum("ani,ani->a", x_D, x_D) / n)
    z = np.einsum("ni,ani->an", cameras.beam, x_T)
    M = P[..., :3]
    sizes = _size_ratios(problems, np.take(M @ np.swapaxes(M, -1, -2), which, axis=1), y)
    columns = (
        d2.sum(axis=1) + [float(free.information @ f.delta**2) for f in fits],
        d_rms,
        np.sqrt(kept.mean(axis=1) / BELONGING_MEAN),
        np.divide(d_rms, spread, out=np.zeros_like(spread), where=spread > 0),
        z.min(axis=1),
        medians(z),
        z.max(axis=1),
        # a wrong reading may end at a scanner that cannot be
        np.where(scanners_can_be(s), sizes, np.nan),
    )
    d_SD, d_SR = min(one.d_SD for one in first.scanners), first.scanners[first.run[0]].d_SR
    for chi2, rms, sigmas, share, nearest, middle, farthest, size in zip(*(c.tolist() for c in columns), strict=True):
        placed = Placement(nearest=nearest, median=middle, farthest=farthest, d_SD=d_SD, d_SR=d_SR)
        yield Remainder(chi2=chi2, d_rms=rms, sigmas=sigmas, share=share, placed=placed, size_ratio=size)


def _balls_in_table(problems: list[Problem], fits: list[Fit], scale: Array) -> Array:
    """(a, n, 4) mm: where fits place the ball of each row in T, homogeneous; scale (a, n): of the translations."""
    t = np.array([f.t[p.ball] for f, p in zip(fits, problems, strict=True)])
    R, t_MH = np.array([p.R_MH for p in problems]), np.array([p.t_MH for p in problems])
    R_HT, t_HT = np.array([f.R_HT for f in fits]), np.array([f.t_HT for f in fits])
    x_H = np.einsum("anij,anj->ani", R, t) + scale[..., None] * t_MH
    x_T = np.ones((*scale.shape, 4))
    np.add(x_H @ np.swapaxes(R_HT, 1, 2), t_HT[:, None], out=x_T[..., :3])
    return x_T


def _size_ratios(problems: list[Problem], MM: Array, y: Array) -> Array:
    """(a,): measured size of the silhouettes over the calculated one, NaN where it is not known; MM (a, n, 3, 3), y
    (a, n, 3): as of `outlines_of`."""
    diameter, outline = problems[0].ball_diameter, problems[0].outline
    known = np.zeros(0, dtype=bool) if outline is None else np.isfinite(outline)
    if diameter is None or not known.any():
        return np.full(len(problems), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.array([one.outline for one in problems]) / outlines_of(MM, y, diameter)
        return np.sqrt(medians(ratios if known.all() else ratios[:, known]))
