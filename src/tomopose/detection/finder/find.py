"""Finding, second half: candidates are circles whose rim is complete and of one polarity; the best is the ball.

A candidate from circle_centres is checked along rays from its centre (circle.py), first on the coarse image that it was
found in, then on a finer one of its surroundings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tomopose.detection.finder.circle import check_circle
from tomopose.detection.finder.symmetry_votes import BANDS, LARGEST, SMALLEST, block_mean, circle_centres
from tomopose.errors import AmbiguousBallError, BallNotFoundError, BallTruncatedError
from tomopose.units import Array

COMPLETE = 0.62
"""Least share of the visible rim that must agree with a circle."""
FAINT = 0.4
"""A candidate with less than this share of the best one's contrast is no rival."""
EQUAL = 0.75
"""A second candidate with this share of the best one's merit makes the image ambiguous."""
ROUND, FINE_ROUND = 0.08, 0.03
"""Deviation from a circle, in radii, that a ray may show on a coarse and on the fine level: a hexagon has 0.07."""
FINALISTS = 4
SURE = 0.85
"""Least share of the rim of a circle at a predicted place that makes further search needless."""
CONVINCING = 0.6
"""Merit from which a candidate ends the search."""
SIZES = 1.6
"""Ratio to the expected radius, either way, of a ball that is looked for first."""
BLUNT = 1.15
"""Ratio beyond a level's radii of circles that are still seen on it; with it one level holds all between
expected_radius / SIZES and expected_radius SIZES, for levels follow by 2 and LARGEST / SMALLEST BLUNT^2 > 2 SIZES^2."""
PRIOR = 0.25
"""Width of the preference for the nominal radius, in log radius: loose, for magnification varies with the pose."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A circle in the image: centre (u, v) and radius in px of the image given, share of rays that agree, contrast.

    bright: whether it is brighter than its surroundings.  visible: share of its rays that reach the rim in the image.
    """

    u: float
    v: float
    radius: float
    complete: float
    visible: float
    contrast: float
    bright: bool
    merit: float = 0.0

    def overlaps(self, other: Candidate) -> bool:
        return math.hypot(self.u - other.u, self.v - other.v) < 0.8 * max(self.radius, other.radius)


def find_ball(
    image: Array,
    expected_radius: float,
    aspect: float = 1.0,
    *,
    smallest: float = 3.5,
    near: tuple[float, float] | None = None,
) -> tuple[Candidate, tuple[Candidate, ...]]:
    """The ball and all candidates, best first.

    Parameters
    ----------
    image:            [v, u], finite; bad pixels filled.
    expected_radius:  px in u; other radii are found as well, but a ball of about this radius is preferred.
    aspect:           p_v / p_u: a circle on the detector is lower by this factor in rows.
    near:             predicted (u, v): of several candidates the one nearest to it is meant.

    Raises
    ------
    BallNotFoundError, BallTruncatedError, AmbiguousBallError
    """
    candidates = [] if near is None else _predicted(image, near, expected_radius, aspect)
    candidates = candidates or _candidates(image, expected_radius, aspect, smallest)
    best = candidates[0]
    if near is not None:
        likely = [c for c in candidates if c.merit > EQUAL * best.merit and c.contrast > FAINT * best.contrast]
        best = min(likely, key=lambda c: math.hypot(c.u - near[0], c.v - near[1]))
    if best.visible < 0.4:
        raise BallTruncatedError(
            f"the ball at ({best.u:.0f}, {best.v:.0f}), radius {best.radius:.0f} px, shows only "
            f"{100 * best.visible:.0f} % of its rim; at least half is needed"
        )
    for other in candidates:
        if near is not None or other is best:
            continue
        if other.merit > EQUAL * best.merit and other.contrast > FAINT * best.contrast and not other.overlaps(best):
            raise AmbiguousBallError(
                f"two shapes could be the ball: at ({best.u:.0f}, {best.v:.0f}), radius {best.radius:.0f} px, and at "
                f"({other.u:.0f}, {other.v:.0f}), radius {other.radius:.0f} px; give a predicted position or crop"
            )
    return best, tuple(candidates)


def _predicted(
    image: Array, near: tuple[float, float], expected_radius: float, aspect: float
) -> list[Candidate]:  # fmt: skip
    """The circle about a predicted centre, if one of about the expected radius is nearly complete there."""
    factor = max(1, int(expected_radius / LARGEST))
    found = []
    for bright in (False, True):
        start = Candidate(u=near[0], v=near[1], radius=expected_radius, complete=0.0, visible=0.0, contrast=0.0,
                          bright=bright)  # fmt: skip
        c = _checked(image, start, aspect, factor, SIZES - 1, ROUND)
        c = c and _refined(image, c, aspect)
        if c and c.complete > SURE and c.contrast > 0 and math.hypot(c.u - near[0], c.v - near[1]) < c.radius / 2:
            found.append(c)
    return _distinct(found, expected_radius)


def _candidates(image: Array, expected_radius: float, aspect: float, smallest: float) -> list[Candidate]:
    """Round shapes, best first: of about the expected radius, or else of any; BallNotFoundError without one."""
    means: dict[int, Array] = {}
    coarse: list[Candidate] = []
    fine: list[Candidate] = []
    for group in _groups(_levels(image.shape, smallest), expected_radius):
        for factor in group:
            coarse += _on_level(_level(image, factor, means), factor, aspect)
        coarse = _distinct(coarse, expected_radius)
        if coarse and coarse[0].merit > CONVINCING:
            fine = _finalists(image, coarse, aspect, expected_radius)
            if fine and fine[0].merit > CONVINCING:
                return fine
    if not coarse:
        raise BallNotFoundError(
            "no circle with a complete rim of one polarity; is the ball in view, and its contrast above noise?"
        )
    fine = _finalists(image, coarse, aspect, expected_radius)
    if not fine:
        raise BallNotFoundError("nothing in the image is round enough to be a ball")
    return fine


def _groups(levels: list[int], expected_radius: float) -> tuple[list[int], ...]:
    """The levels in the order of search: the one for the expected radius, others that show it too, all others."""
    low, high = expected_radius / SIZES, expected_radius * SIZES
    central = [min((f for f in levels if BLUNT * LARGEST * f >= high), default=levels[-1])]
    near = [f for f in levels if SMALLEST * f < high and LARGEST * f > low and f not in central]
    return central, near, [f for f in levels if f not in central and f not in near]


def _finalists(image: Array, candidates: list[Candidate], aspect: float, expected_radius: float) -> list[Candidate]:
    """The best few candidates, looked at again on finer images."""
    again = [_refined(image, c, aspect) for c in candidates[:FINALISTS]]
    return _distinct([c for c in again if c is not None], expected_radius)


def _refined(image: Array, c: Candidate, aspect: float) -> Candidate | None:
    """The candidate on a finer image of its surroundings, so that the fit starts within a pixel; None if not round."""
    factor = max(1, int(c.radius / 40))
    return _checked(image, c, aspect, factor, max(2.0 * factor / c.radius, 0.15), FINE_ROUND)


def _checked(
    image: Array, c: Candidate, aspect: float, factor: int, width: float, tightness: float
) -> Candidate | None:  # fmt: skip
    """The candidate where a check in blocks of `factor` pixels leads; None if its rim is no circle's.

    width: share of the radius by which it may differ.
    """
    reach = (1.35 + width) * c.radius + 8
    u, v = max(int(c.u - reach), 0), max(int(c.v - reach / aspect), 0)
    around = image[v : int(c.v + reach / aspect) + 1, u : int(c.u + reach) + 1]
    level = block_mean(np.ascontiguousarray(around, dtype=np.float32), factor)
    shift, radius = (factor - 1) / 2, c.radius / factor
    yes, x, y, radius, complete, visible, contrast = check_circle(
        level, (c.u - u - shift) / factor, (c.v - v - shift) / factor, radius * (1 - width), radius * (1 + width),
        -1.0 if c.bright else 1.0, aspect, 0.0, tightness,
    )  # fmt: skip
    if not yes or complete < COMPLETE:
        return None
    return Candidate(u=x * factor + shift + u, v=y * factor + shift + v, radius=radius * factor, complete=complete,
                     visible=visible, contrast=contrast, bright=c.bright, merit=c.merit)  # fmt: skip


def _levels(shape: tuple[int, ...], smallest: float) -> list[int]:
    """Block factors, finest first: from the smallest radius to circles as large as the image."""
    out = []
    factor = max(1, 2 ** int(math.log2(max(smallest / SMALLEST, 1.0))))
    while min(shape) / factor >= 12:
        out.append(factor)
        if LARGEST * factor > max(shape):
            break
        factor *= 2
    return out or [1]


def _level(image: Array, factor: int, means: dict[int, Array]) -> Array:
    """The image's mean over blocks, from a finer level where there is one: `means`, to which it is added."""
    finer = max((f for f in means if f <= factor), default=0)
    means[factor] = block_mean(means[finer], factor // finer) if finer else block_mean(image, factor)
    return means[factor]


def _on_level(level: Array, factor: int, aspect: float) -> list[Candidate]:
    found = []
    noise, centres = circle_centres(level)
    for u, v, band, polarity, _votes in centres.tolist():
        (low, high), sign = BANDS[int(band)], -1.0 if polarity == 1 else 1.0
        yes, x, y, radius, complete, visible, contrast = check_circle(
            level, u, v, 0.75 * low, 1.3 * high, sign, aspect, noise, ROUND
        )
        if yes and complete >= COMPLETE and contrast > 0:
            shift = (factor - 1) / 2
            found.append(
                Candidate(u=x * factor + shift, v=y * factor + shift, radius=radius * factor, complete=complete,
                          visible=visible, contrast=contrast, bright=polarity == 1)
            )  # fmt: skip
    return found


def _distinct(candidates: list[Candidate], expected_radius: float) -> list[Candidate]:
    """Candidates with their merit, best first, one of each group that overlaps with a similar radius."""
    if not candidates:
        return []
    ranked = []
    strongest = max(c.contrast for c in candidates)
    for c in candidates:
        off = max(abs(math.log(c.radius / expected_radius)) - 0.25, 0.0) / PRIOR
        merit = c.complete**2 * (0.4 + 0.6 * math.exp(-0.5 * off**2)) * math.sqrt(min(1.0, c.visible + 0.25))
        merit *= (c.contrast / strongest) ** 0.1
        ranked.append(Candidate(**{**c.__dict__, "merit": merit}))
    ranked.sort(key=lambda c: (-c.merit, c.u, c.v, c.radius))
    kept: list[Candidate] = []
    for c in ranked:
        if not any(c.overlaps(k) and abs(math.log(c.radius / k.radius)) < 0.3 for k in kept):
            kept.append(c)
    return kept
