r"""A second opinion that needs no truth: two disjoint sets of views, refined apart and compared.

Every second view makes set A, the others set B; each is refined from the input geometry, with a volume of its own.  The
views of B are then matched to the volume of A, held as it is, and the poses that this gives are compared with those
that B found itself; and the other way round.  Common motions, which no image shows, are removed from the differences.
They hold what two independent volumes lead the views apart; each view's own noise is in both poses and is added from
its information with the volume known.  Balls on the object take no part: it is the images' opinion alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy.linalg

from tomopose.refinement.joint_fit.fit import Fit, State, blank, linearised
from tomopose.refinement.joint_fit.linear import normal_blocks
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.refinement.joint_fit.motions import composed, gauge, motions_of, pixel_jacobian, transforms, without_gauge
from tomopose.refinement.joint_fit.projector import Workers
from tomopose.refinement.prior import Prior
from tomopose.units import Array

FEWEST_VIEWS = 16
"""Views below which a half is too few to refine."""
MATCHES = 3
"""Gauss-Newton steps of views to a volume that is held: they begin at poses a fraction of a pixel off."""


def halves_px(data: Measured, prior: Prior, fit: Fit, K: Array, known_px: float) -> float:
    """Standard uncertainty of a view, px per coordinate, by two halves; K (n, m, 2, 6) px per motion; known_px: with
    the volume known.  NaN for fewer than 16 views.

    A volume of n/2 views leads its views astray by the variance V each, two volumes by 2 V, one of n views by V/2.
    """
    squares = differences(data, prior, fit, K)
    return float(np.sqrt(known_px**2 + squares / 4))


def differences(data: Measured, prior: Prior, fit: Fit, K: Array) -> float:
    """Mean square difference, px^2 per coordinate, of the views' poses by their own half and by the other one."""
    n = len(data.p)
    if n < FEWEST_VIEWS:
        return float("nan")
    rows = [np.arange(start, n, 2) for start in (0, 1)]
    parts = [views_of(data, half) for half in rows]
    precisions = [prior.of_views(half).precision for half in rows]
    found = [
        replace(fit, precision=precision, balls=None)(part, blank(part))
        for part, precision in zip(parts, precisions, strict=True)
    ]
    squares, count = 0.0, 0
    for own, other in ((0, 1), (1, 0)):
        part, state = parts[own], found[own]
        matched = matched_to(part, replace(state, volume=found[other].volume), precisions[own], fit.workers)
        moved = np.einsum("nmic,nc->nmi", K[rows[own]], difference(part, matched.q, state.q))
        squares, count = squares + float(np.sum(moved**2)), count + moved.size
    return squares / count


def views_of(data: Measured, rows: npt.NDArray[np.int_]) -> Measured:
    """The data of some views."""
    return replace(
        data, p=data.p[rows], weight=data.weight[rows], judge=data.judge[rows], matrices=data.matrices.select(rows)
    )


def matched_to(data: Measured, state: State, precision: Array, workers: Workers) -> State:
    """The motions and levels of views matched to a volume that is held as it is."""
    centre = np.asarray(data.grid.centre)
    prior = np.stack([precision[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] for j in range(len(data.p))])
    for _ in range(MATCHES):
        here = linearised(data, state, workers=workers)
        w = here.weighed(data)
        M = normal_blocks(here.J, w)
        right = np.einsum("ndp,np->nd", here.J, w * here.r).astype(np.float64)
        M[:, :6, :6] += prior
        M[:, 6, 6] += 1e-9 * np.trace(M, axis1=1, axis2=2)
        right[:, :6] -= np.einsum("ncd,nd->nc", prior, state.q)
        step = np.stack([scipy.linalg.solve(m, b, assume_a="pos") for m, b in zip(M, right, strict=True)])
        state = replace(state, q=composed(state.q, step[:, :6], centre), offset=state.offset + step[:, 6])
    return state


def difference(data: Measured, q: Array, other: Array) -> Array:
    """Motions (n, 6) that take the views from `other` to q, the common ones removed as pixels see them."""
    centre = np.asarray(data.grid.centre)
    e = motions_of(np.linalg.inv(transforms(other, centre)) @ transforms(q, centre), centre)
    box = centre + (data.grid.corners - centre) / 2
    K = pixel_jacobian(data.matrices.P, box, centre).reshape(len(q), -1, 6)
    metric = np.einsum("npc,npd->ncd", K, K)
    metric += 1e-9 * np.trace(metric, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    return without_gauge(e, gauge(data.matrices.P, centre), scipy.linalg.block_diag(*metric))
