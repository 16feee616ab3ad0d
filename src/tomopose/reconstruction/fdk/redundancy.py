r"""How much each pixel counts where a line is measured more than once, or not in every view.

A line of the plane of a circular path is met by the source at the angle beta under the fan angle gamma, and again at

    beta' = beta + pi + 2 gamma   under   gamma' = -gamma

(gamma counts about the axis as beta does, from the ray to the axis).  The weights m of the two have to add up to 1;
over a full turn that a centred panel sees whole both are 1/2.  Here

    m = a / (a + a'),   a = c(beta) d(gamma),

where c falls smoothly to 0 at both ends of a short scan (Noo, Defrise, Clackdoyle and Kudo, Phys. Med. Biol. 47 (2002)
2525, sec. 4; Parker, Med. Phys. 9 (1982) 254), and d rises smoothly over what both sides of a laterally displaced panel
see (Cho, Rudd and Johnson, Comput. Med. Imaging Graph. 20 (1996) 49; Wang, Med. Phys. 29 (2002) 1634).  Rays beside the
plane are weighted by their projection on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.fdk.path import SourcePath
from tomopose.units import Array

TAPER = math.radians(10.0)
"""Over which c rises at the ends of a short scan: ten views of 360, so that no single view is cut off sharply.
Chosen, not tuned."""


def fan_angles(matrices: ProjectionMatrices, path: SourcePath, j: int, u: Array, v: Array) -> Array:
    """Fan angles, rad, of pixels (u, v), broadcast against one another, in view j: about the path's axis."""
    M_inv = np.linalg.inv(matrices.P[j, :, :3])
    inwards = -(path.arm[j] - (path.arm[j] @ path.axis) * path.axis)
    inwards /= np.linalg.norm(inwards)
    across = np.cross(path.axis, inwards)
    along, side = M_inv.T @ inwards, M_inv.T @ across
    return np.asarray(np.arctan2(side[0] * u + side[1] * v + side[2], along[0] * u + along[1] * v + along[2]))


@dataclass(frozen=True, kw_only=True)
class Fan:
    """What the panel sees on either side of the axis, in every row of every view.

    low, high:  rad, how far fan angles reach below and above 0; negative where the panel does not see the axis.
    first_low:  whether column 0 lies on the low side.
    """

    low: float
    high: float
    first_low: bool

    @property
    def overlap(self) -> float:
        """Fan angle up to which both sides see, rad."""
        return min(self.low, self.high)


def fan_of(matrices: ProjectionMatrices, path: SourcePath) -> Fan:
    """The fan angles that every view sees."""
    u = np.array([0.0, matrices.n_u - 1.0])[:, None]
    v = np.array([0.0, matrices.n_v - 1.0])
    ends = np.stack([fan_angles(matrices, path, j, u, v) for j in range(len(matrices))])
    first_low = bool(np.median(ends[:, 0]) < np.median(ends[:, 1]))
    low, high = (ends[:, 0], ends[:, 1]) if first_low else (ends[:, 1], ends[:, 0])
    return Fan(low=float(-low.max()), high=float(high.min()), first_low=first_low)


def smooth_step(x: Array) -> Array:
    """0 below 0, 1 above 1, a quarter of a sine's period squared between."""
    return np.asarray(np.sin(np.pi / 2 * np.clip(x, 0.0, 1.0)) ** 2)


@dataclass(frozen=True, kw_only=True)
class Redundancy:
    """Weights m of a scan's pixels.

    displaced: whether the panel sees one side of the object only; fan: what it sees.  A short scan is one whose path
    has a hole.

    The ramp spreads what a displaced panel sees beyond its short side, where the voxels of that side look it up:
    `beyond` columns are added there (below column 0, above the last).
    """

    matrices: ProjectionMatrices
    path: SourcePath
    fan: Fan
    displaced: bool

    @property
    def constant(self) -> bool:
        """Whether every line is measured twice: all weights are 1/2."""
        return self.path.full_turn and not self.displaced

    @property
    def beyond(self) -> tuple[int, int]:
        """Columns (below, above) by which filtered images are wider than the panel."""
        if not self.displaced:
            return 0, 0
        long = max(self.fan.low, self.fan.high)
        per_column = (self.fan.low + self.fan.high) / (self.matrices.n_u - 1)
        added = math.ceil((long - self.fan.overlap) / per_column) + 2
        return (added, 0) if (self.fan.high > self.fan.low) == self.fan.first_low else (0, added)

    def _by_source(self, beta: Array) -> Array:
        """c: where the source is."""
        if self.path.full_turn:
            return np.ones_like(beta)
        start = float(self.path.holes[0].sum())
        covered = 2 * math.pi - float(self.path.holes[0, 1])
        since = np.mod(beta - start, 2 * math.pi)
        return smooth_step(since / TAPER) * smooth_step((covered - since) / TAPER)

    def _by_side(self, gamma: Array) -> Array:
        """d: which side of the axis the ray passes; 1 on the panel's long side."""
        if not self.displaced:
            return np.ones_like(gamma)
        towards = gamma if self.fan.high > self.fan.low else -gamma
        return smooth_step(0.5 * (1 + towards / self.fan.overlap))

    def weights(self, j: int) -> Array:
        """(n_v, n_u) of view j, 0 to 1."""
        u, v = np.arange(self.matrices.n_u, dtype=np.float64), np.arange(self.matrices.n_v, dtype=np.float64)
        gamma = fan_angles(self.matrices, self.path, j, u, v[:, None])
        beta = np.full_like(gamma, self.path.angle[j])
        own = self._by_source(beta) * self._by_side(gamma)
        other = self._by_source(beta + math.pi + 2 * gamma) * self._by_side(-gamma)
        total = own + other
        return np.asarray(np.divide(own, total, out=np.ones_like(own), where=total > 0))


def lines_missing(path: SourcePath, reach: float) -> bool:
    """Whether a path with holes misses lines within the fan angle `reach`: less than half a turn and twice that."""
    return path.coverage < math.pi + 2 * reach


def reach_of(path: SourcePath, fan: Fan, corners: Array) -> float:
    """Fan angle, rad, that a grid with these corners (8, 3), mm, asks for, or what the panel sees, if that is less."""
    off = corners - path.centre
    radius = float(np.linalg.norm(off - np.outer(off @ path.axis, path.axis), axis=1).max())
    nearest = float(np.linalg.norm(path.arm - np.outer(path.arm @ path.axis, path.axis), axis=1).min())
    return min(math.asin(min(radius / nearest, 1.0)), max(fan.low, fan.high))
