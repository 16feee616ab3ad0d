"""The fit of one rim as a value: every stage takes one and returns the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tomopose.detection.rim_model.cone import followed
from tomopose.detection.rim_model.edge_profile import edge_profile
from tomopose.detection.rim_model.ring import SHELLS, BallWindow, Ring, RingPixels, taken_pixels
from tomopose.detection.rim_model.rows import FIRST_NODE, KAPPA, LOCAL, SHAPE, WHITE, Edge, model_rows
from tomopose.detection.settings import DetectionSettings
from tomopose.units import Array

Indices = npt.NDArray[np.intp]


class Parameters(NamedTuple):
    """shape (7,): see rows.SHAPE; nodes (k, 3): the background; white: what the ball puts in its place."""

    shape: Array
    nodes: Array
    white: float

    @property
    def level(self) -> float:
        """Mean level of the background."""
        return float(self.nodes[:, 0].mean())

    @property
    def blur(self) -> float:
        return float(self.shape[3])

    @property
    def radius(self) -> float:
        return float(self.shape[2])

    @property
    def opaque(self) -> bool:
        return math.isinf(self.shape[KAPPA])


class Priors(NamedTuple):
    """Means and precisions: kappa (its mean, also its standard deviation), ln radius, w, and the precision (3k,) of a,
    about the mean level, and of b and c, about 0."""

    kappa: float
    log_radius: tuple[float, float]
    white: tuple[float, float]
    nodes: Array


class Unknowns(NamedTuple):
    """What is fitted: parameters of the shape by name, and of the background all or (curvature False) all but c."""

    shape: tuple[str, ...] = ()
    curvature: bool = True

    def and_also(self, *names: str) -> Unknowns:
        return Unknowns((*self.shape, *names), self.curvature)


@cache
def active_parameters(unknowns: Unknowns, nodes: int) -> Indices:
    """Indices of the parameters that are fitted."""
    use = np.zeros(FIRST_NODE + 3 * nodes, dtype=bool)
    use[[SHAPE.index(name) for name in unknowns.shape]] = True
    use[WHITE:] = True
    if not unknowns.curvature:
        use[FIRST_NODE + 2 :: 3] = False
    return np.flatnonzero(use)


@cache
def jacobian_rows(unknowns: Unknowns, *, edge: bool) -> Indices:
    """Rows of the Jacobian that count; where the edge is over, its width and height do not."""
    use = np.zeros(LOCAL, dtype=bool)
    use[[SHAPE.index(name) for name in unknowns.shape]] = True
    use[WHITE:] = True
    if not edge:
        use[[3, 5, 6, WHITE]] = False
    return np.flatnonzero(use)


class Noise(NamedTuple):
    """Variance inside and outside; each sector's chi-square outside less 1, and what noise alone lets it vary by.

    rho: autocorrelation of the noise, a delta where it is white.  apart: whether sectors that fit well were enough to
    measure it; otherwise what is left of the holder's edges counts as noise.
    """

    inside: float
    outside: float
    excess: Array
    scatter: float
    rho: Array
    apart: bool

    @property
    def correlated(self) -> bool:
        return bool(np.count_nonzero(self.rho) > 1)

    @property
    def sum_variance(self) -> float:
        """Variance of a sum of pixels over that of as many independent ones."""
        return max(float(self.rho.sum()), 1.0) if self.apart else 1.0


class Anisotropy(NamedTuple):
    """Blur variance by direction, its (cos 2 psi, sin 2 psi) parts (2,), and their covariance (2, 2), px^2."""

    value: Array
    covariance: Array


@dataclass(frozen=True, kw_only=True)
class RimFit:
    """The state between two stages.

    window, ring, pixels: what is fitted; expected: the nominal radius, px.  distance (n,): of each pixel from the rim.
    parameters, model (n,), jacobian (14, n): the present state of the fit.  weight (n,): 1 / variance, 0 for a pixel
    that is left out; shells: how many have any.  unknowns, careful: what is fitted, and whether each step must lower
    the cost.
    floor: least variance of a pixel; spread: standard deviation of the ring's values.  noise, doubt (2, 2), anisotropy:
    what the later stages find; doubt is to be added to the centre's covariance.
    """

    window: BallWindow
    ring: Ring
    pixels: RingPixels
    expected: float
    distance: Array
    parameters: Parameters
    model: Array
    jacobian: Array
    weight: Array
    shells: int
    priors: Priors
    unknowns: Unknowns
    careful: bool
    floor: float
    spread: float
    noise: Noise
    doubt: Array
    anisotropy: Anisotropy
    settings: DetectionSettings

    @property
    def residual(self) -> Array:
        return self.pixels.value - self.model

    @property
    def cost(self) -> float:
        """What a step must lower: weighted squares of the residuals and, with their precisions, of the priors'."""
        p, priors = self.parameters, self.priors
        apart = p.nodes - [p.level, 0.0, 0.0]
        total = float((self.weight * self.residual**2).sum()) + float(priors.nodes @ (apart**2).ravel())
        total += priors.white[1] * float(p.white - priors.white[0]) ** 2
        total += priors.log_radius[1] * (math.log(p.radius) - priors.log_radius[0]) ** 2
        return total if p.opaque else total + (float(p.shape[KAPPA]) / priors.kappa - 1.0) ** 2

    @property
    def edge_shells(self) -> int:
        return self._edge_shells(self.parameters)

    def _edge_shells(self, parameters: Parameters) -> int:
        """Shells in which the edge is felt: the first alone, or all."""
        over = self.ring.edges[0] > self.settings.fit.flat * parameters.blur
        return 1 if over and parameters.opaque else SHELLS

    def with_node_precision(self, nodes: Array) -> RimFit:
        return replace(self, priors=self.priors._replace(nodes=nodes))

    def with_pixels(self, ring: Ring) -> RimFit:
        """The pixels of another ring about the present silhouette, all of equal weight, and the model there."""
        pixels = taken_pixels(self.window, ring, self.parameters.shape, self.settings.ring)
        nodes = self.parameters.nodes
        if len(nodes) != ring.nodes:
            nodes = _turned(nodes, ring.nodes)
        moved = replace(
            self, ring=ring, pixels=pixels, distance=pixels.rim[0], weight=np.ones(pixels.u.size), shells=SHELLS,
            parameters=self.parameters._replace(nodes=nodes),
        )  # fmt: skip
        return moved.at(moved.parameters, (0.0, 0.0, 0.0))

    def at(self, parameters: Parameters, move: tuple[float, float, float] | None = None) -> RimFit:
        """The model and its derivatives for other parameters; move: of centre and radius, px, where that is small.

        Distances follow a small move to first order.
        """
        shape, limits = parameters.shape, self.settings.fit
        pixels, distance, gamma_px = self.pixels, self.distance, self.window.gamma_px
        if move is None or max(map(abs, move)) > limits.linear_move:
            rim = self.window.coordinates(pixels.u, pixels.v, shape)
            pixels, distance = pixels._replace(rim=rim), rim[0]
        elif move != (0.0, 0.0, 0.0):
            distance = followed(distance, pixels.rim, move[0], move[1], move[2] * gamma_px)
        blur, radius = parameters.blur, parameters.radius
        shells = self._edge_shells(parameters)
        high = self.ring.edges[0] if shells == 1 else self.ring.outside
        low = max(-self.ring.inside, -limits.tail * blur) if parameters.opaque else -self.ring.inside
        profile = edge_profile(blur, float(shape[KAPPA]), radius, low - 4.0, min(high, self.ring.outside) + 4.0)
        scanner = self.window.scanner
        # A pixel's box has the variance p_u^2 / 12 along u, of which sigma holds the mean over directions.
        along_u = (scanner.p_u**2 - scanner.p_v**2) / (24 * self.window.pitch**2) + float(shape[5])
        edge = Edge(*profile, radius, blur, gamma_px, along_u, -along_u, float(shape[6]))
        model, jacobian = model_rows(
            distance, pixels.rim, pixels.share, pixels.bounds, shells, parameters.nodes,
            float(parameters.white), tuple(edge),
        )  # fmt: skip
        return replace(self, parameters=parameters, pixels=pixels, distance=distance, model=model, jacobian=jacobian)


def _turned(nodes: Array, number: int) -> Array:
    """The background at another number of nodes, between which it is linear."""
    at = np.arange(number) * len(nodes) / number
    closed = np.vstack([nodes, nodes[:1]])
    return np.stack([np.interp(at, np.arange(len(closed)), closed[:, c]) for c in range(3)], axis=1)
