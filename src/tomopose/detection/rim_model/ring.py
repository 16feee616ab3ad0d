"""The pixels about a rim: which ones are taken, and in what order.

The ring's width follows the larger of radius and blur.  Round the rim it is divided into sectors, one from each
angular node of the background to the next, and each sector into shells by distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from tomopose.detection.rim_model.cone import cone_angle, cone_coordinates, cone_eccentricity, direction_angle
from tomopose.detection.settings import RingSettings
from tomopose.errors import BallNotFoundError
from tomopose.geometry.scanner import Scanner
from tomopose.kernel_cache import njit
from tomopose.units import Array, float_array

Good: TypeAlias = npt.NDArray[np.bool_]

SHELLS = 4
"""Of a sector, the innermost also counting what lies inside the rim."""


@dataclass(frozen=True, kw_only=True)
class BallWindow:
    """The part of a radiograph that holds one ball.

    values: float64 [v, u]; good: bool, pixels that may be used; origin: D coordinates (u, v) of pixel [0, 0].
    gamma_px: half-angle of the cone for a silhouette of 1 px, rad.  eccentricity: by how much, px, the silhouette may
    differ from a circle.
    """

    values: Array
    good: Good
    origin: tuple[int, int]
    scanner: Scanner
    inverse_K: Array
    gamma_px: float
    eccentricity: float

    @property
    def pitch(self) -> float:
        """Side of a square pixel of the same area, mm."""
        return math.sqrt(self.scanner.p_u * self.scanner.p_v)

    def coordinates(self, u: Array, v: Array, shape: Array) -> Array:
        """(6, n) of cone_coordinates about the silhouette with that centre and radius: shape (u, v, radius, ...)."""
        scanner, gamma = self.scanner, shape[2] * self.gamma_px
        return np.asarray(
            cone_coordinates(u, v, self.inverse_K, scanner.p_u, scanner.p_v, shape[0], shape[1], gamma)
        )  # fmt: skip


def ball_window(
    values: Array, good: Good, origin: tuple[int, int], scanner: Scanner, x_D: Array, radius: float
) -> BallWindow:  # fmt: skip
    """The window about a ball that lies near x_D with about that radius, px."""
    gamma_px = cone_angle(scanner, x_D, 1.0)
    return BallWindow(
        values=values, good=good, origin=origin, scanner=scanner, inverse_K=float_array(np.linalg.inv(scanner.K)),
        gamma_px=gamma_px, eccentricity=cone_eccentricity(scanner, x_D, radius * gamma_px),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Ring:
    """Limits of the ring, px from the rim, and how finely it is divided.

    inside, outside: its width; edges (3,): where shells are cut; thin_from: where pixels may be thinned out.
    nodes: of the background round the rim.  every: one pixel in so many is taken.  blur: that it was made for, px.
    """

    inside: float
    outside: float
    edges: Array
    thin_from: float
    nodes: int
    every: int
    blur: float

    @property
    def sizes(self) -> list[int]:
        """Numbers of shells that make a smaller or equal ring, in order."""
        return [n for n in range(1, SHELLS + 1) if n == 1 or self.outside > self.edges[n - 2]]


def whole_ring(radius: float, blur: float, settings: RingSettings) -> Ring:
    """The ring for a ball of that radius and blur, px, every pixel taken."""
    wider = max(blur / settings.sharp, 1.0)
    outside = min(max(settings.share * radius, settings.narrowest), settings.widest)
    nodes = round(2 * math.pi * radius / (settings.node_distance * wider))
    return Ring(
        inside=min(settings.inside * wider, radius - 0.5),
        outside=max(outside, settings.widths * blur),
        edges=np.array(settings.shells) * wider,
        thin_from=settings.thin_from * wider,
        nodes=min(max(nodes, settings.fewest_nodes), settings.most_nodes),
        every=1,
        blur=blur,
    )


class RingPixels(NamedTuple):
    """u, v, value (n,) of the pixels, by sector and in it by shell.

    sector (n,): which one; share (n,): how far a pixel lies towards its next node, 0 to 1.  bounds: shell i of sector j
    begins at bounds[j SHELLS + i]; rim (6, n): of cone_coordinates, about the silhouette that they were taken for.
    """

    u: Array
    v: Array
    value: Array
    rim: Array
    sector: Array
    share: Array
    bounds: Array


def taken_pixels(window: BallWindow, ring: Ring, shape: Array, settings: RingSettings) -> RingPixels:
    """The good pixels of the ring about the silhouette (u, v, radius, ...); BallNotFoundError where too few."""
    most = settings.most_pixels if ring.every == 1 else math.inf
    u, v, value, thinned, rim = pixels_between(window, window.good, shape, -ring.inside, ring.outside, ring, most)
    thin_from = ring.thin_from if thinned else ring.outside
    pixels = RingPixels(
        *_by_sector(u, v, value, rim, -ring.inside, ring.outside, thin_from, ring.nodes, ring.edges)
    )  # fmt: skip
    if pixels.u.size < 4 * ring.nodes:
        raise BallNotFoundError(
            f"only {pixels.u.size} usable pixels about the rim at ({shape[0]:.1f}, {shape[1]:.1f}); "
            f"{4 * ring.nodes} are needed"
        )
    return pixels


def pixels_between(
    window: BallWindow, good: Good, shape: Array, low: float, high: float, ring: Ring, most: float = math.inf
) -> tuple[Array, Array, Array, bool, Array]:  # fmt: skip
    """u, v, value (n,), whether thinned, and rim (6, n), of the good pixels with s in [low, high] and some beyond.

    Of more than `most` every second one is left out that lies farther than ring.thin_from outside the rim.
    """
    margin = 1.6 + window.eccentricity + 0.02 * (high - low)
    radius = shape[2]
    area = Annulus(
        u=shape[0] - window.origin[0], v=shape[1] - window.origin[1], low=radius + low - margin,
        high=radius + high + margin, ratio_u=window.scanner.p_u / window.pitch,
        ratio_v=window.scanner.p_v / window.pitch,
    )  # fmt: skip
    u, v, value, thinned = thinned_pixels(
        window.values, good, window.origin, tuple(area), ring.every, most, radius + ring.thin_from + margin
    )
    return u, v, value, thinned, window.coordinates(u, v, shape)


class Annulus(NamedTuple):
    """Centre (u, v) in a window, inner and outer radius, px; ratio_u, ratio_v: a pixel's sides, in square ones'."""

    u: float
    v: float
    low: float
    high: float
    ratio_u: float
    ratio_v: float


def annulus_pixels(window: BallWindow, shape: Array, low: float, high: float, every: int = 1) -> Array:
    """Values (n,) of the good pixels at a distance of low to high px from the ball's centre, one in `every`."""
    area = Annulus(
        u=shape[0] - window.origin[0], v=shape[1] - window.origin[1], low=low, high=high,
        ratio_u=window.scanner.p_u / window.pitch, ratio_v=window.scanner.p_v / window.pitch,
    )  # fmt: skip
    return np.asarray(thinned_pixels(window.values, window.good, window.origin, tuple(area), every, math.inf, high)[2])


@njit(cache=True)
def thinned_pixels(window, good, origin, area, every, many, near):  # type: ignore[no-untyped-def]
    """u, v, value (n,) of the good pixels of a window in an Annulus (a plain tuple), and whether they were thinned out.

    every: one pixel in so many is taken, on a lattice that has as large a share in each row and column.  Of more than
    `many` every second one is left out that lies farther than `near` from the centre.
    """
    none = np.empty(0)
    n = _annulus(window, good, origin, area, every, np.inf, none, none, none)
    thinned = n > many
    u, v, value = np.empty(n), np.empty(n), np.empty(n)
    n = _annulus(window, good, origin, area, every, near * near if thinned else np.inf, u, v, value)
    return u[:n], v[:n], value[:n], thinned


@njit(cache=True)
def _annulus(window, good, origin, area, every, near_square, u, v, value):  # type: ignore[no-untyped-def]
    """Number of good pixels in the annulus, of those beyond near_square every second one; u, v, value (n or more) are
    filled where they are not empty."""
    middle_u, middle_v, _, _, ratio_u, ratio_v = area
    u_first, v_first = origin
    fill, n = u.shape[0] > 0, 0
    for j in range(window.shape[0]):
        dv = (j - middle_v) * ratio_v
        for start, stop in _spans(dv * dv, window.shape[1], area):
            for i in range(start + (-start - 2 * j) % every, stop + 1, every):
                du = (i - middle_u) * ratio_u
                far = du * du + dv * dv > near_square and (i + u_first + j + v_first) % 2 == 1
                if far or not good[j, i]:
                    continue
                if fill:
                    u[n], v[n], value[n] = i + u_first, j + v_first, window[j, i]
                n += 1
    return n


@njit(cache=True)
def _spans(dv_square, columns, area):  # type: ignore[no-untyped-def]
    """First and last column on both sides of the hole in a row at that squared distance from the centre; a span ends
    before it begins where there is none."""
    middle_u, _, low, high, ratio_u, _ = area
    rest = high * high - dv_square
    if rest < 0.0:
        return (0, -1), (0, -1)
    reach = math.sqrt(rest) / ratio_u
    first = math.ceil(min(max(middle_u - reach, 0.0), float(columns)))
    last = math.floor(min(max(middle_u + reach, -1.0), columns - 1.0))
    gap = low * low - dv_square if low > 0.0 else -1.0
    if gap <= 0.0:
        return (first, last), (0, -1)
    hole = math.sqrt(gap) / ratio_u
    inner = math.floor(min(max(middle_u - hole, -1.0), columns - 1.0))
    outer = math.ceil(min(max(middle_u + hole, 0.0), float(columns)))
    return (first, min(last, inner)), (max(first, outer), last)


@njit(cache=True, fastmath=True)
def _by_sector(u, v, value, rim, low, high, thin_from, k, edges):  # type: ignore[no-untyped-def]
    """The pixels with s in (low, high) by sector, and in it by shell: the fields of RingPixels.

    Every second pixel with s > thin_from is left out.
    """
    turn, shells = k / (2.0 * math.pi), edges.shape[0] + 1
    cell, part = np.empty(u.shape[0], np.int64), np.empty(u.shape[0])
    for i in range(u.shape[0]):
        angle = direction_angle(rim[4, i], rim[5, i]) * turn
        node = int(min(max(angle, 0.0), k - 1.0))
        cell[i], part[i] = node * shells, angle - node
    first = np.zeros(k * shells + 1, np.int64)
    for i in range(u.shape[0]):
        s = rim[0, i]
        if s > low and s < high and (s < thin_from or (int(u[i]) + int(v[i])) % 2 == 0):
            for edge in edges:
                cell[i] += s > edge
            first[cell[i] + 1] += 1
        else:
            cell[i] = -1
    for j in range(k * shells):
        first[j + 1] += first[j]
    n, place = first[k * shells], first.copy()
    source = np.empty(n, np.int64)
    for i in range(u.shape[0]):
        if cell[i] >= 0:
            source[place[cell[i]]] = i
            place[cell[i]] += 1
    new_u, new_v, new_value, share, sector = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.int64)
    new_rim = np.empty((6, n))
    for at in range(n):
        i = source[at]
        new_u[at], new_v[at], new_value[at], share[at], sector[at] = u[i], v[i], value[i], part[i], cell[i] // shells
    for c in range(6):
        for at in range(n):
            new_rim[c, at] = rim[c, source[at]]
    return new_u, new_v, new_value, new_rim, sector, share, first
