"""Pixels that took no part in the fit decide whether the correction is kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from tomopose.refinement.joint_fit.fit import Fit, State, blank, matrices_of, residual_of
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.refinement.joint_fit.projector import Workers
from tomopose.refinement.settings import MISFIT, MISFIT_SHARE, OWN_SIGMA, SIGNIFICANCE
from tomopose.units import Array, Floats


class Verdict(Enum):
    """What became of the correction."""

    REFINED = "refined"
    UNCHANGED = "unchanged"
    UNDETERMINED = "undetermined"

    @property
    def trustworthy(self) -> bool:
        """Whether the matrices may be used as they are returned."""
        return self is not Verdict.UNDETERMINED


@dataclass(frozen=True, kw_only=True)
class Trial:
    """before, after: (n,) rms residual of each view's held-out pixels over their noise, with the input's geometry and
    with the refined one, each with a volume fitted to the same other pixels.

    pixels: how many judged.  gain: mean gain of the views' chi square in standard errors; residual_before,
    residual_after: (n,) rms over all pixels, relative to the view's line integrals.
    """

    before: Array
    after: Array
    pixels: int
    gain: float
    residual_before: Array
    residual_after: Array


def trial(data: Measured, refined: State, fit: Fit) -> tuple[Trial, State, State]:
    """Refit the volume under both geometries, from nothing and with the same number of steps, and compare.

    Returns the comparison, and both states (volumes for the pictures).
    """
    volume_only = replace(fit, precision=None)
    states, squares, residuals = [], [], []
    for q in (np.zeros_like(refined.q), refined.q):
        state = volume_only(data, replace(blank(data), q=q))
        r = residual(data, state, workers=fit.workers)
        squares.append(np.einsum("np,np,np->n", data.judge, r, r, dtype=np.float64))
        size = np.sqrt(np.einsum("np,np->n", data.p, data.p, dtype=np.float64))
        residuals.append(np.sqrt(np.einsum("np,np->n", r, r, dtype=np.float64)) / np.maximum(size, 1e-30))
        states.append(state)
    pixels = (data.judge > 0).sum(axis=1)
    count = np.maximum(pixels, 1)
    return (
        Trial(
            before=np.sqrt(squares[0] / count) / data.noise_left,
            after=np.sqrt(squares[1] / count) / data.noise_left,
            pixels=int(pixels.sum()),
            gain=gain_of(squares[0] / count, squares[1] / count, count) if pixels.any() else -np.inf,
            residual_before=residuals[0],
            residual_after=residuals[1],
        ),
        states[0],
        states[1],
    )


def gain_of(before: Array, after: Array, count: Array) -> float:
    """The gain, in standard errors, from the views' mean squares (n,) over `count` pixels each.

    One view that jumps is a gain although the spread over the views is as large: its own pixels say so.
    """
    gains = before - after
    error = float(np.std(gains, ddof=1)) / np.sqrt(len(gains)) if len(gains) > 1 else float("inf")
    mean = float(np.mean(gains))
    noise = np.sqrt(2 * np.mean(after) ** 2 * 2 / count)
    single = float(np.max(gains / noise)) - 2.0
    return max(mean / max(error, 1e-30), min(single, 1e3) if mean > 0 else -np.inf)


def residual(data: Measured, state: State, *, workers: Workers) -> Floats:
    """Measured minus projected line integrals (n, N)."""
    projector = workers.projector(matrices_of(data, state.q), data.grid)
    return residual_of(data, projector.project(projector.put(state.volume)), state.offset)


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the verdict is made from.

    held_out: the pixels that took no part.  chi: rms residual over noise of the fit.  faces: of the grid that the
    object crosses; left: share of the rays that do not meet what lies beyond them.  edges: of the images that the
    object crosses.  open_: directions that the images do not determine and that
    matter, as sentences.  moved: rms correction over its
    rms standard uncertainty.  balls: residual of the balls over their stated uncertainty, or None.
    """

    held_out: Trial
    chi: float
    faces: tuple[str, ...]
    left: float
    edges: tuple[str, ...]
    open_: tuple[str, ...]
    moved: float
    balls: float | None = None


def decide(e: Evidence) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict and its reasons, as sentences."""
    reasons: list[str] = []
    misfit = float(np.median(e.held_out.residual_after))
    if e.faces:
        reasons.append(
            f"The object reaches beyond the grid ({', '.join(e.faces)}); {100 * e.left:.0f} % of the rays do not meet "
            "what lies there. Use a grid that holds the whole object"
        )
    if e.edges:
        reasons.append(
            f"The object reaches beyond the images ({', '.join(e.edges)}): what lies there changes from view to view "
            "and looks like motion. Use a scan that shows the whole object"
        )
    if e.chi > MISFIT and misfit > MISFIT_SHARE:
        reasons.append(
            f"The residual is {e.chi:.1f} times the images' noise ({100 * misfit:.1f} % of the line integrals): the "
            "volume does not explain the images (object cut by the view or the grid, scatter, or wrong matrices)"
        )
    if e.balls is not None and e.balls > MISFIT:
        reasons.append(
            f"The balls' images are off by {e.balls:.1f} times their stated uncertainty: they do not move with the "
            "object, or one was taken for another"
        )
    if not e.held_out.pixels:
        reasons.append(
            "No pixels were kept out of the fit that could judge it. Keep a larger share of them out (held_out)"
        )
    reasons += e.open_
    if reasons:
        return Verdict.UNDETERMINED, tuple(reasons)
    gain = f"held-out pixels gain {e.held_out.gain:.1f} standard errors, {SIGNIFICANCE:g} are needed"
    if e.held_out.gain < SIGNIFICANCE:
        return Verdict.UNCHANGED, (f"Nothing is gained by a correction: {gain}",)
    if e.moved < OWN_SIGMA:
        return Verdict.UNCHANGED, (
            f"The correction is {e.moved:.1f} times its own standard uncertainty, {OWN_SIGMA:g} are needed: it would "
            "add as much error as it removes",
        )
    finer = (
        f"The residual is {e.chi:.1f} times the images' noise: the images show more than these voxels can hold. That "
        "moves poses too, which neither the stated uncertainty nor the two halves know: compare a length or an edge in "
        "both volumes before you use the matrices"
    )
    return Verdict.REFINED, (
        f"Pixels kept out of the fit agree: they gain {e.held_out.gain:.1f} standard errors",
        f"The correction is {e.moved:.1f} times its own standard uncertainty",
        *((finer,) if e.chi > MISFIT else ()),
    )
