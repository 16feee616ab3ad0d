"""The ring of pixels about a rim, the fit's parameters, and one Gauss-Newton step."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt

from tomopose.detection.rim_fit.cholesky import solve
from tomopose.detection.rim_fit.cone import (
    by_sector,
    cone_angle,
    cone_coordinates,
    cone_eccentricity,
    follow,
    thinned_ring,
)
from tomopose.detection.rim_fit.edge_profile import edge_profile
from tomopose.detection.rim_fit.model import FIRST_NODE, KAPPA, N_SHAPE, SHAPE, SHELL_EDGES, SHELLS, WHITE, model_rows
from tomopose.detection.rim_fit.normal_equations import assembled, gradient, sector_blocks, with_priors
from tomopose.errors import BallNotFoundError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

ENOUGH = 1500
"""Pixels that the way from the finder's circle to the fit's neighbourhood is gone with."""
MANY, NEAR = 8000.0, 8.0
"""Of more pixels than this, every second one is left out that lies farther than NEAR px outside the rim."""
LINEAR = 0.02
"""Largest move, px, after which distances are updated to first order: what is left out is LINEAR^2 / 2 radius."""
STAY = (0.0, 0.0, 0.0)
EDGES = np.array(SHELL_EDGES)
FLAT = 5.0
"""Distance from the rim, in widths of the blur, from which the edge is over."""
SMALLEST_BLUR, LARGEST_STEP = 0.25, 2.0
TAIL = 6.0
"""Distance inside the rim, in widths of the blur, beyond which nothing comes through an opaque ball."""


class Rim:
    """Pixels of the ring, parameters, and the normal equations at the current parameters."""

    def __init__(
        self, window: Array, good: Array, origin: tuple[int, int], scanner: Scanner, x_D: Array, radius: float
    ) -> None:
        self.window, self.good, self.origin, self.scanner = window, good, origin, scanner
        self.inverse_K = np.linalg.inv(scanner.K)
        self.p = math.sqrt(scanner.p_u * scanner.p_v)
        self.gamma_px = cone_angle(scanner, x_D, 1.0)
        self.shape = np.array([x_D[0], x_D[1], radius, 0.8, np.inf, 0.0, 0.0])
        self.n_nodes = int(np.clip(round(2 * math.pi * radius / 9.5), 6, 36))
        self.nodes, self.white = np.zeros((self.n_nodes, 3)), 0.0
        self.reach = float(np.clip(0.35 * radius, 5.0, 22.0))
        self.inside = float(min(5.0, radius - 0.5))
        box = np.array([scanner.p_u, scanner.p_v]) ** 2 / (12 * self.p**2)
        self.box_u, self.box_v = box - box.mean()
        self.precision = np.zeros(3 * self.n_nodes)
        self.kappa_start, self.white_prior = 1.0, (0.0, 0.0)
        self.shells, self.turned, self.linear = SHELLS, False, False
        self.margin = 1.6 + cone_eccentricity(scanner, self.shape[:2], radius * self.gamma_px)
        self._sums: tuple[Array, Array, Array] | None = None
        self._blocks: tuple[Array, Array] | None = None
        self.begin()

    def begin(self) -> None:
        """Takes some of the pixels near the rim."""
        self.outside = min(self.reach, 6.0)
        pixels = 2 * math.pi * self.shape[2] * (self.inside + self.outside)
        self.every = 5 if pixels > 5 * ENOUGH else 3 if pixels > 3 * ENOUGH else 1
        self.gather()

    def gather(self) -> None:
        """Takes the pixels of the ring about the current silhouette, one in `every`, and places the angular nodes."""
        many = MANY if self.every == 1 else math.inf
        u, v, value, thinned, rim = self.ring(self.good, -self.inside, self.outside, self.every, many)
        self.u, self.v, self.value, rows, self.left, self.share, self.bounds = by_sector(
            u, v, value, rim, -self.inside, self.outside, NEAR if thinned else self.outside, self.n_nodes, EDGES, 14
        )
        self.rim, self.jacobian = rows[:6], rows[6:]
        self.first = self.bounds[::SHELLS]
        n = self.u.size
        if n < 4 * self.n_nodes:
            at = f"({self.shape[0]:.1f}, {self.shape[1]:.1f})"
            raise BallNotFoundError(f"only {n} usable pixels round the rim at {at}")
        self.model, self.weight = np.empty(n), np.ones(n)
        self.forget()

    def ring(
        self, good: Array, low: float, high: float, every: int, many: float = math.inf
    ) -> tuple[Array, Array, Array, bool, Array]:  # fmt: skip
        """u, v, value (n,) and rim (6, n) of all pixels with s in [low, high], one in `every`, and of some beyond.

        Of more than `many` every second one is left out that lies farther than NEAR px outside; the bool says whether.
        """
        scanner, radius = self.scanner, self.shape[2]
        margin = self.margin + 0.02 * (high - low)
        u, v, value, thinned = thinned_ring(
            self.window, good, self.origin[0], self.origin[1], self.shape[0], self.shape[1], radius + low - margin,
            radius + high + margin, scanner.p_u / self.p, scanner.p_v / self.p, every, many, radius + NEAR + margin,
        )  # fmt: skip
        return u, v, value, thinned, self.coordinates(u, v)

    def whole(self) -> bool:
        """Whether the rim lies in the window, and every pixel of the window is good."""
        u, v, radius = self.shape[:3]
        reach_u = (radius + 2.0 + self.margin) * self.p / self.scanner.p_u
        reach_v = (radius + 2.0 + self.margin) * self.p / self.scanner.p_v
        rows, columns = self.window.shape
        left, below = u - self.origin[0], v - self.origin[1]
        inside = min(left - reach_u, below - reach_v) > 0
        return bool(inside and left + reach_u < columns - 1 and below + reach_v < rows - 1 and self.good.all())

    def coordinates(self, u: Array, v: Array) -> Array:
        s = self.shape
        return np.asarray(
            cone_coordinates(u, v, self.inverse_K, self.scanner.p_u, self.scanner.p_v, s[0], s[1], s[2] * self.gamma_px)
        )

    def evaluate(self, delta: tuple[float, float, float] | None = None) -> None:
        """Model and Jacobian after a move `delta` of centre and radius, where it is known.

        Distances follow a small move to first order, and stay what they are without one (as after `gather`).
        """
        s = self.shape
        if delta is None or max(map(abs, delta)) > LINEAR:
            self.rim = self.coordinates(self.u, self.v)
        elif delta != STAY:
            follow(self.rim, delta[0], delta[1], delta[2] * self.gamma_px)
        near_shells, high = (1, SHELL_EDGES[0]) if self._ends_near() else (SHELLS, self.outside)
        low = max(-self.inside, -TAIL * s[3]) if self._opaque() else -self.inside
        profile, first, step = edge_profile(s[3], s[4], s[2], low - 4.0, min(high, self.outside) + 4.0)
        model_rows(
            self.rim, self.share, self.bounds, near_shells, self.nodes, self.white, profile, self._opaque(), first,
            step, s[3], self.gamma_px, self.box_u, self.box_v, s[5], s[6], self.model, self.jacobian,
        )  # fmt: skip
        self.forget()

    def _opaque(self) -> bool:
        return math.isinf(self.shape[KAPPA])

    def _ends_near(self) -> bool:
        """Whether the edge is over beyond the first shell."""
        return self._opaque() and bool(SHELL_EDGES[0] > FLAT * self.shape[3])

    @property
    def residual(self) -> Array:
        return self.value - self.model

    def use_shells(self, n: int) -> None:
        """Gives the pixels beyond the first n shells no weight."""
        self.shells = n
        self.weight = np.where(self.rim[0] < SHELL_EDGES[n - 1], self.weight, 0.0)

    def columns(self, shell: int) -> npt.NDArray[np.intp]:
        """Rows of the Jacobian that count in a shell: far from the rim an edge's width and height do not."""
        return _columns(self._opaque(), self.turned, self.linear, shell > 0 and self._ends_near())

    def blocks(self, low: int, high: int) -> Array:
        """Each sector's part of the normal equations, without priors, of the shells from low to before high."""
        return np.asarray(sector_blocks(
            self.value, self.model, self.jacobian, self.bounds, self.weight, self.columns(low), low, high
        ))  # fmt: skip

    def all_blocks(self) -> Array:
        """blocks of all shells that have weight; kept until model or weights change."""
        if self._blocks is None or self._blocks[0] is not self.weight:
            near = self.blocks(0, 1)
            far = self.shells > 1 and self.bounds[-1] > 0
            self.keep(near + self.blocks(1, self.shells) if far else near)
        assert self._blocks is not None
        return self._blocks[1]

    def keep(self, blocks: Array) -> None:
        """Takes these for the blocks at the present model and weights."""
        self._blocks, self._sums = (self.weight, blocks), None

    def sums(self) -> tuple[Array, Array]:
        """Normal matrix and right side of all parameters, without priors; kept like the blocks."""
        if self._sums is None or self._sums[0] is not self.weight:
            self._sums = (self.weight, *self.sum_of(self.all_blocks()))
        return self._sums[1], self._sums[2]

    def sum_of(self, blocks: Array, share: Array | None = None) -> tuple[Array, Array]:
        """Normal matrix and right side of the sectors' blocks, each times its share."""
        N, g = assembled(blocks, np.ones(self.n_nodes) if share is None else share)
        return N, g

    def forget(self) -> None:
        """Drops what was kept, after a change of the model or of what counts in it."""
        self._blocks = self._sums = None

    def turn(self) -> None:
        """Lets the blur depend on direction from here on."""
        self.turned = True
        self.forget()

    def normal(self, active: npt.NDArray[np.intp]) -> tuple[Array, Array]:
        """Normal matrix and right side of the active parameters, priors included."""
        return self.with_priors(*self.sums(), active)

    def with_priors(self, N: Array, g: Array, active: npt.NDArray[np.intp]) -> tuple[Array, Array]:
        """Rows and columns `active` of N and g, priors added."""
        part, right = with_priors(
            N, g, active, self.shape, self.white, self.nodes, self.kappa_start, self.white_prior, self.precision
        )
        return part, right

    def polish(self, active: npt.NDArray[np.intp], *, careful: bool) -> None:
        """Steps to the optimum near by; with one normal matrix, only the right side following, unless `careful`."""
        for _ in range(3 if careful else 4):
            N = self.sums()[0]
            if self.step(active, careful=careful) < 1e-4:
                return
            if not careful:
                g = gradient(
                    self.value, self.model, self.jacobian, self.bounds, self.weight, self.columns(0), self.shells
                )
                self._sums = (self.weight, N, g)

    def step(self, active: npt.NDArray[np.intp], *, careful: bool = False) -> float:
        """One Gauss-Newton step, shortened while it makes the fit worse if `careful`.

        Returns the largest move of centre and radius, px.
        """
        N, g = self.normal(active)
        full = np.zeros(FIRST_NODE + 3 * self.n_nodes)
        full[active] = solve(N, g.reshape(-1, 1))[:, 0]
        if not math.isfinite(full.sum()):
            raise BallNotFoundError("the rim does not determine a ball (no finite step)")
        largest = float(np.abs(full[:3]).max())
        if largest > LARGEST_STEP:
            full[:N_SHAPE] *= LARGEST_STEP / largest
        before = (self.shape, self.white, self.nodes)
        cost = self.cost if careful else 0.0
        self._move(full)
        while careful and self.cost > cost and np.abs(full[:3]).max() > 1e-3:
            full = full / 3
            self.shape, self.white, self.nodes = before
            self._move(full)
        return largest

    @property
    def cost(self) -> float:
        return float((self.weight * self.residual**2).sum())

    def _move(self, full: Array) -> None:
        """Adds `full` to the parameters, within their bounds."""
        sigma, kappa = float(self.shape[3]), float(self.shape[KAPPA])
        s = self.shape + full[:N_SHAPE]
        s[3] = min(max(float(s[3]), SMALLEST_BLUR, sigma / 2), sigma * 2, 0.45 * float(s[2]))
        if math.isfinite(kappa):
            s[KAPPA] = min(max(float(s[KAPPA]), kappa / 2, 0.1), kappa * 2, 20.0)
        self.shape = s
        self.white += full[WHITE]
        self.nodes = self.nodes + full[FIRST_NODE:].reshape(-1, 3)
        u, v, radius = full[:3].tolist()
        self.evaluate((u, v, radius))

    def active(self, *shape: str, curvature: bool = True) -> npt.NDArray[np.intp]:
        """Indices of the parameters that are fitted: those of the shape, and all linear ones (`curvature`: c too)."""
        return _active(shape, curvature, self.n_nodes)

    @property
    def level(self) -> float:
        return float(self.nodes[:, 0].mean())


@cache
def _columns(opaque: bool, turned: bool, linear: bool, beyond: bool) -> npt.NDArray[np.intp]:
    use = np.ones(FIRST_NODE + 6, dtype=bool)
    use[KAPPA], use[5:7] = not opaque, turned
    use[:WHITE] &= not linear
    if beyond:
        use[[3, 5, 6, WHITE]] = False
    return np.flatnonzero(use)


@cache
def _active(shape: tuple[str, ...], curvature: bool, n_nodes: int) -> npt.NDArray[np.intp]:
    use = np.zeros(FIRST_NODE + 3 * n_nodes, dtype=bool)
    use[[SHAPE.index(name) for name in shape]] = True
    use[WHITE:] = True
    if not curvature:
        use[FIRST_NODE + 2 :: 3] = False
    return np.flatnonzero(use)
