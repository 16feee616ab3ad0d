"""The joint fit on one level: Gauss-Newton steps for volume and poses until neither lowers the joint cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.linear import Linear, normal_blocks
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.refinement.joint_fit.motions import composed, gauge, transforms, without_gauge
from tomopose.refinement.joint_fit.precondition import passed_frequencies
from tomopose.refinement.joint_fit.projector import Projector, Workers
from tomopose.units import Array, Floats

LEVEL_SIGMA = 0.01
"""Prior standard deviation of an image's level (ln of the open beam): a tube drifts by about one per cent in a scan."""
ROBUST = 4.0
"""Residuals beyond this many rms are pulled back to it (Huber): scatter and dead pixels, one in 16,000 of noise."""
SHORTEST_STEP = 0.05
"""Part of a step at which the line search ends."""
SETTLED = 2e-3
"""Relative gain of the joint cost below which a level has reached its minimum."""

Tell = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class State:
    """volume: [z, y, x]; q: (n, 6) motions; offset: (n,) levels of the images; chi: rms residual over noise of the fit;
    steps: taken so far; settled: whether the last level ended in a minimum; information: (n, 6, 6) J'WJ of each view,
    the volume held, weights scaled to the residual."""

    volume: np.ndarray
    q: Array
    offset: Array
    chi: float = float("nan")
    steps: int = 0
    settled: bool = False
    information: Array | None = None


def matrices_of(data: Measured, q: Array) -> ProjectionMatrices:
    """The matrices of a level with the motions q."""
    m = data.matrices
    P = m.P @ transforms(q, np.asarray(data.grid.centre))
    return ProjectionMatrices(P=P, n_u=m.n_u, n_v=m.n_v, p_u=m.p_u, p_v=m.p_v, pose_id=m.pose_id, in_front=m.in_front)


def residual_of(data: Measured, lines: Floats, offset: Array) -> Floats:
    """Measured minus projected line integrals (n, N), the images' levels taken off, float32."""
    return data.p - lines - offset[:, None].astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """A level's data at a state.

    projector: of its matrices;  x: its volume as the projector holds it;  J: (n, 7, N) derivatives by each view's
    motion and level, (n, 1, N) with the motions held;  r: (n, N) residual.
    """

    projector: Projector
    x: np.ndarray
    J: Floats
    r: Floats

    @property
    def motions(self) -> Floats:
        """(n, 6, N): derivatives by the motions alone."""
        return self.J[:, :6]

    def weighed(self, data: Measured) -> Floats:
        """The robust weights (n, N) of the residual."""
        return robust_weights(self.r, data, first=False)[0]


def linearised(data: Measured, state: State, *, workers: Workers, held: bool = False) -> Linearised:
    """The data's residual and derivatives at a state; held: by the images' levels alone."""
    projector = workers.projector(matrices_of(data, state.q), data.grid)
    x = projector.put(state.volume)
    ones = np.ones((len(data.p), 1, data.p.shape[1]), dtype=np.float32)
    if held:
        lines, J = projector.project(x), ones
    else:
        lines, slopes = projector.with_derivatives(x)
        J = np.concatenate([slopes, ones], axis=1)
    return Linearised(projector=projector, x=x, J=J, r=residual_of(data, lines, state.offset))


def ridge_of(volume: np.ndarray, chi: float) -> float:
    """lambda: the inverse mean square of the material's voxels, as much smaller as the weights are (chi: the residual
    over the noise): a volume that does not fit yet must not be drawn to zero for it."""
    return 1.0 / max(float(np.mean(volume[volume > 0] ** 2)), 1e-30) / max(chi, 1.0) ** 2


def with_levels(precision: Array) -> Array:
    """The precision (7n, 7n) of motions, (6n, 6n), and levels of all views."""
    n = len(precision) // 6
    whole, at = np.eye(7 * n) / LEVEL_SIGMA**2, motions_among_levels(n)
    whole[np.ix_(at, at)] = precision
    return whole


def motions_among_levels(n: int) -> npt.NDArray[np.int_]:
    """(6n,): where the motions are among the seven unknowns of each view."""
    return np.asarray((7 * np.arange(n)[:, None] + np.arange(6)).ravel())


def with_balls(precision: Array, pull: Array, balls: Balls | None, q: Array) -> tuple[Array, Array]:
    """The precision (7n, 7n) and the pull (7n,) of motions and levels, with what the balls say at motions q."""
    if balls is None:
        return precision, pull
    B, g = balls.reduced(q)
    at, precision, pull = motions_among_levels(len(q)), precision.copy(), pull.copy()
    precision[np.ix_(at, at)] += B
    pull[at] -= g
    return precision, pull


def blank(data: Measured) -> State:
    """Nothing known: an empty volume and no motion."""
    n = len(data.p)
    return State(volume=np.zeros(data.grid.shape, dtype=np.float32), q=np.zeros((n, 6)), offset=np.zeros(n))


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How a level is fitted.

    precision: (6n, 6n) of the motions' prior, or None to hold the poses and fit the volume and the images' levels.
    steps, turns: as in the settings.  workers: who calculates.  balls: points that move with the object, or None.
    """

    precision: Array | None
    steps: int
    turns: int
    workers: Workers
    balls: Balls | None = None

    def __call__(self, data: Measured, start: State) -> State:
        """Steps from `start` to a minimum of the joint cost, or until they are used up."""
        state = start
        if not state.volume.any():
            state = self._step(data, state, None, held=True)[0]
        H = passed_frequencies(data.matrices, data.grid)
        settled, taken = False, 0
        while taken < self.steps and not settled:
            taken += 1
            state, gain = self._step(data, state, H, held=self.precision is None)
            settled = gain < SETTLED
        return replace(state, steps=start.steps + taken, settled=settled)

    def _step(self, data: Measured, state: State, H: Floats | None, *, held: bool) -> tuple[State, float]:
        """One step with its line search, and the relative gain of the joint cost; H: of the preconditioner, if any."""
        n = len(data.p)
        first = not state.volume.any()
        here = linearised(data, state, workers=self.workers, held=held)
        projector, x, r = here.projector, here.x, here.r
        w, chi = robust_weights(r, data, first=first)
        precision = self._precision(n, held=held)
        unknown = np.concatenate([state.q, state.offset[:, None]], axis=1)[:, 6 if held else 0 :]
        free = self._free(projector, x, w * r, first=first)
        ridge = 0.0 if first else ridge_of(state.volume, chi)
        balls = None if held else self.balls
        system, pull = with_balls(precision, precision @ unknown.ravel(), balls, state.q)
        linear = Linear.of(projector, free, here.J, w, system, ridge, H)
        dx, dq = linear.solve(r, pull, x, turns=2 * self.turns if first else self.turns)

        def cost(volume: np.ndarray, values: Array, residual: Floats) -> float:
            own = float(values.ravel() @ precision @ values.ravel()) + ridge * float(np.vdot(volume, volume))
            own += 0.0 if balls is None else balls.cost(values[:, :6])
            return float(np.einsum("np,np,np->", w, residual, residual, dtype=np.float64)) + own

        information = None if held else normal_blocks(here.motions, w)
        before, part = cost(x, unknown, r), 1.0
        while part > SHORTEST_STEP:
            trial, values = self._tried(data, state, projector, x, (part, dx, dq), held=held)
            at = projector if held else self.workers.projector(matrices_of(data, trial.q), data.grid)
            residual = residual_of(data, at.project(values), trial.offset)
            own = np.concatenate([trial.q, trial.offset[:, None]], axis=1)[:, 6 if held else 0 :]
            after = cost(values, own, residual)
            if after < before or first:
                return replace(trial, chi=chi, information=information), (before - after) / max(before, 1e-30)
            part /= 2
        return replace(state, chi=chi, information=information), 0.0

    def _tried(
        self,
        data: Measured,
        state: State,
        projector: Projector,
        x: np.ndarray,
        step: tuple[float, np.ndarray, Array],
        *,
        held: bool,
    ) -> tuple[State, np.ndarray]:
        """The state after part of a step, and its volume as the projector holds it."""
        part, dx, dq = step
        values = np.maximum(x + np.float32(part) * dx, 0)
        offset, q = state.offset + part * dq[:, -1], state.q
        if not held:
            assert self.precision is not None
            centre = np.asarray(data.grid.centre)
            q = composed(q, part * dq[:, :6], centre)
            q = without_gauge(q, gauge(data.matrices.P, centre), self.precision)
        return replace(state, volume=np.array(projector.values(values)), q=q, offset=offset), values

    def _precision(self, n: int, *, held: bool) -> Array:
        """Of the unknowns of all views, (d n, d n): motions by the prior, levels by their own."""
        if held:
            return np.eye(n) / LEVEL_SIGMA**2
        assert self.precision is not None
        return with_levels(self.precision)

    def _free(self, projector: Projector, x: np.ndarray, pulled: Array, *, first: bool) -> np.ndarray:
        """Voxels that may move: inside the grid, and not held at zero by the bound."""
        free = np.zeros(x.shape, dtype=bool)
        free[1:-2, 1:-2, 1:-2] = True
        if first:
            return free
        return free & ((x > 0) | (projector.back(pulled) > 0))


def robust_weights(r: Floats, data: Measured, *, first: bool) -> tuple[Floats, float]:
    """Weights (n, N) that fit the residual's own size, and that size over the noise (rms of the pixels in use).

    The residual holds what voxels, scatter and hardening leave besides noise: where it is larger than the noise, the
    noise's weights would let the images outvote the prior.
    """
    weight, noise = data.weight, data.noise_left
    used = max(int(np.count_nonzero(weight)), 1)
    chi = float(np.sqrt(np.einsum("np,np,np->", weight, r, r, dtype=np.float64) / used)) / noise
    if first:
        return weight, chi
    size = max(chi, 1.0)
    z = np.sqrt(weight) * np.abs(r) / np.float32(size * noise)
    w = weight * np.minimum(1.0, ROBUST / np.maximum(z, 1e-12)).astype(np.float32) / np.float32(size**2)
    return np.asarray(w, dtype=np.float32), chi
