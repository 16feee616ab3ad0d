"""Finding, second half: candidates are circles whose rim is complete and of one polarity; the best is the ball.

A candidate from circle_centres is checked along rays from its centre (circle.py), first on the coarse image that it was
found in, then on a finer one of its surroundings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tomopose.detection.finder.circle import STEP, WIDE, check_circle, rim_blur
from tomopose.detection.finder.symmetry_votes import BANDS, LARGEST, SMALLEST, block_mean, circle_centres
from tomopose.detection.settings import FinderSettings
from tomopose.errors import AmbiguousBallError, BallNotFoundError, BallTruncatedError
from tomopose.units import Array

BLUNT = 1.15
"""Ratio beyond a level's radii of circles that are still seen on it; with it one level holds all between
expected_radius / size_ratio and expected_radius size_ratio, for levels follow by 2 and LARGEST / SMALLEST BLUNT^2 >
2 size_ratio^2."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A circle in the image: centre (u, v) and radius in px of the image given, share of rays that agree, contrast.

    bright: whether it is brighter than its surroundings.  visible: share of its rays that reach the rim in the image.
    blur: about the standard deviation of its rim's blur, px.
    """

    u: float
    v: float
    radius: float
    complete: float
    visible: float
    contrast: float
    bright: bool
    blur: float = 0.0
    merit: float = 0.0

    def overlaps(self, other: Candidate) -> bool:
        return math.hypot(self.u - other.u, self.v - other.v) < 0.8 * max(self.radius, other.radius)


def find_ball(
    image: Array,
    expected_radius: float,
    aspect: float = 1.0,
    *,
    near: tuple[float, float] | None = None,
    others: Sequence[float] = (),
    settings: FinderSettings,
) -> tuple[Candidate, tuple[Candidate, ...]]:
    """The ball and all candidates, best first.

    Parameters
    ----------
    image:            [v, u], finite; bad pixels filled.
    expected_radius:  px in u; other radii are found as well, but a ball of about this radius is preferred.
    aspect:           p_v / p_u: a circle on the detector is lower by this factor in rows.
    near:             predicted (u, v): of several candidates the nearest one to it is meant.
    others:           expected radii of other balls in the image, px in u: without a prediction the size decides.

    Raises
    ------
    BallNotFoundError, BallTruncatedError, AmbiguousBallError
    """
    search = _Search(image, expected_radius, aspect, settings)
    candidates = [] if near is None else _predicted(search, near)
    candidates = candidates or _candidates(search, every=bool(others))
    if others and near is None:
        candidates = _of_its_size(candidates, expected_radius, others)
    best = candidates[0]
    likely = [c for c in candidates if _is_alternative(c, best, settings)]
    if near is not None:
        best = min(likely, key=lambda c: math.hypot(c.u - near[0], c.v - near[1]))
    refuse_hidden(best, settings)
    for other in likely if near is None else ():
        if other is not best and not other.overlaps(best):
            raise AmbiguousBallError(
                f"two shapes could be the ball: at ({best.u:.0f}, {best.v:.0f}), radius {best.radius:.0f} px, and at "
                f"({other.u:.0f}, {other.v:.0f}), radius {other.radius:.0f} px; give a predicted position, crop, or "
                "name all balls with their diameters"
            )
    return best, tuple(candidates)


def find_balls(
    image: Array, expected_radius: float, aspect: float = 1.0, *, most: int, settings: FinderSettings
) -> list[Candidate]:
    """All circles of about the expected radius, px in u, best first; an empty list without any.

    most: how many balls there are; image and aspect as in `find_ball`.
    """
    # a ball's rim may give two peaks of votes, and shafts and neighbours give some more
    search = _Search(image, expected_radius, aspect, settings._replace(most=4 * most, peaks=2 * most))
    central, near, _ = _groups(_levels(image.shape), expected_radius, settings.size_ratio)
    means: dict[int, Array] = {}
    coarse: list[Candidate] = []
    for factor in [*central, *near]:
        coarse += _on_level(_level(image, factor, means), factor, search)
    coarse = _distinct(coarse, search)
    widest = math.log(settings.size_ratio)
    return [c for c in _finalists(search, coarse, len(coarse)) if abs(math.log(c.radius / expected_radius)) < widest]


def _of_its_size(found: list[Candidate], expected: float, others: Sequence[float]) -> list[Candidate]:
    """The candidates whose radius is nearer to the expected one than to that of another ball in the image."""

    def off(c: Candidate, radius: float) -> float:
        return abs(math.log(c.radius / radius))

    own = [c for c in found if all(off(c, expected) < off(c, other) for other in others)]
    if not own:
        shown = ", ".join(f"({c.u:.0f}, {c.v:.0f}) radius {c.radius:.0f} px" for c in found[:4])
        raise BallNotFoundError(
            f"no circle is nearer to the expected radius of {expected:.0f} px than to that of another ball; "
            f"found: {shown}"
        )
    return own


def refuse_hidden(best: Candidate, settings: FinderSettings) -> None:
    """BallTruncatedError where too little of the rim is visible."""
    if best.visible < settings.least_visible:
        raise BallTruncatedError(
            f"the ball at ({best.u:.0f}, {best.v:.0f}), radius {best.radius:.0f} px, shows only "
            f"{100 * best.visible:.0f} % of its rim; at least half is needed"
        )


class _Search(NamedTuple):
    image: Array
    expected: float
    aspect: float
    settings: FinderSettings


def _is_alternative(c: Candidate, best: Candidate, settings: FinderSettings) -> bool:
    return c.merit > settings.equal * best.merit and c.contrast > settings.faint * best.contrast


def _predicted(search: _Search, near: tuple[float, float]) -> list[Candidate]:
    """The circle about a predicted centre, if one of about the expected radius is nearly complete there."""
    settings = search.settings
    factor = max(1, int(search.expected / LARGEST))
    found = []
    for bright in (False, True):
        start = Candidate(u=near[0], v=near[1], radius=search.expected, complete=0.0, visible=0.0, contrast=0.0,
                          bright=bright)  # fmt: skip
        c = _checked(search, start, factor, settings.size_ratio - 1, settings.round_coarse)
        c = c and _refined(search, c)
        close = c and math.hypot(c.u - near[0], c.v - near[1]) < c.radius / 2
        if c and close and c.complete > settings.sure and c.contrast > 0:
            found.append(c)
    return _distinct(found, search)


def _candidates(search: _Search, *, every: bool = False) -> list[Candidate]:
    """Round shapes, best first: of about the expected radius, or else of any; BallNotFoundError without one.

    every: look at all levels that may show the expected radius, and refine all candidates.
    """
    means: dict[int, Array] = {}
    coarse: list[Candidate] = []
    settings = search.settings
    for group in _groups(_levels(search.image.shape), search.expected, settings.size_ratio):
        for factor in group:
            coarse += _on_level(_level(search.image, factor, means), factor, search)
        coarse = _distinct(coarse, search)
        if coarse and coarse[0].merit > settings.convincing and not every:
            fine = _finalists(search, coarse, settings.finalists)
            if fine and fine[0].merit > settings.convincing:
                return fine
    if not coarse:
        raise BallNotFoundError(
            "no circle with a complete rim of one polarity; is the ball in view, and its contrast above noise?"
        )
    fine = _finalists(search, coarse, len(coarse) if every else settings.finalists)
    if not fine:
        best = coarse[0]
        raise BallNotFoundError(
            f"nothing in the image is round enough to be a ball; the best shape, at ({best.u:.0f}, {best.v:.0f}) with "
            f"a radius of about {best.radius:.0f} px, agrees with a circle on {100 * best.complete:.0f} % of its rim"
        )
    return fine


def _groups(levels: list[int], expected_radius: float, size_ratio: float) -> tuple[list[int], ...]:
    """The levels in the order of search: the one for the expected radius, others that show it too, all others."""
    low, high = expected_radius / size_ratio, expected_radius * size_ratio
    central = [min((f for f in levels if BLUNT * LARGEST * f >= high), default=levels[-1])]
    near = [f for f in levels if SMALLEST * f < high and LARGEST * f > low and f not in central]
    return central, near, [f for f in levels if f not in central and f not in near]


def _finalists(search: _Search, candidates: list[Candidate], number: int) -> list[Candidate]:
    """The best few candidates, looked at again on finer images."""
    again = [_refined(search, c) for c in candidates[:number]]
    return _distinct([c for c in again if c is not None], search)


def _refined(search: _Search, c: Candidate) -> Candidate | None:
    """The candidate on a finer image of its surroundings, so that the fit starts within a pixel; None if not round.

    A wide blur is reduced to `fine_blur`, and along each ray as many samples are compared as it is wide.
    """
    settings = search.settings
    factor = max(1, int(c.radius / settings.fine_radius))
    level, u, v = _around(search, c, factor, 0.15)
    shift = (factor - 1) / 2
    blur = factor * rim_blur(
        level, (c.u - u - shift) / factor, (c.v - v - shift) / factor, c.radius / factor, search.aspect,
        -1.0 if c.bright else 1.0,
    )  # fmt: skip
    blur = blur if blur > settings.resolved_blur * factor else 0.0
    factor = max(factor, int(blur / settings.fine_blur))
    wide = min(settings.fine_widths * blur, c.radius / 2) / factor
    found = _checked(search, c, factor, max(2.0 * factor / c.radius, 0.15), settings.round_fine, round(wide / STEP))
    return found and replace(found, blur=blur)


def _around(search: _Search, c: Candidate, factor: int, width: float) -> tuple[Array, int, int]:
    """The image about a candidate in blocks of `factor` pixels, and its first pixel (u, v)."""
    reach = (1.35 + width) * c.radius + 8
    u, v = max(int(c.u - reach), 0), max(int(c.v - reach / search.aspect), 0)
    around = search.image[v : int(c.v + reach / search.aspect) + 1, u : int(c.u + reach) + 1]
    return block_mean(np.ascontiguousarray(around, dtype=np.float32), factor), u, v


def _checked(
    search: _Search, c: Candidate, factor: int, width: float, tightness: float, wide: int = WIDE
) -> Candidate | None:  # fmt: skip
    """The candidate where a check in blocks of `factor` pixels leads; None if its rim is no circle's.

    width: share of the radius by which it may differ; wide: samples of a ray that are compared, at least WIDE.
    """
    level, u, v = _around(search, c, factor, width)
    shift, radius = (factor - 1) / 2, c.radius / factor
    yes, x, y, radius, complete, visible, contrast = check_circle(
        level, (c.u - u - shift) / factor, (c.v - v - shift) / factor, radius * (1 - width), radius * (1 + width),
        -1.0 if c.bright else 1.0, search.aspect, 0.0, tightness, max(wide, WIDE), tuple(search.settings.rays),
    )  # fmt: skip
    if not yes or complete < search.settings.complete:
        return None
    return Candidate(u=x * factor + shift + u, v=y * factor + shift + v, radius=radius * factor, complete=complete,
                     visible=visible, contrast=contrast, bright=c.bright, merit=c.merit)  # fmt: skip


def _levels(shape: tuple[int, ...]) -> list[int]:
    """Block factors, finest first: from the smallest radius to circles as large as the image."""
    out = []
    factor = 1
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


def _on_level(level: Array, factor: int, search: _Search) -> list[Candidate]:
    found = []
    settings, rays = search.settings, tuple(search.settings.rays)
    noise, centres = circle_centres(
        level, settings.least_votes, settings.edge_noise, settings.edge_share, settings.most, settings.peaks
    )
    for u, v, band, polarity, _votes in centres.tolist():
        (low, high), sign = BANDS[int(band)], -1.0 if polarity == 1 else 1.0
        yes, x, y, radius, complete, visible, contrast = check_circle(
            level, u, v, 0.75 * low, 1.3 * high, sign, search.aspect, noise, settings.round_coarse, WIDE, rays
        )
        if yes and complete >= settings.complete and contrast > 0:
            shift = (factor - 1) / 2
            found.append(
                Candidate(u=x * factor + shift, v=y * factor + shift, radius=radius * factor, complete=complete,
                          visible=visible, contrast=contrast, bright=polarity == 1)
            )  # fmt: skip
    return found


def _distinct(candidates: list[Candidate], search: _Search) -> list[Candidate]:
    """Candidates with their merit, best first, one of each group that overlaps with a similar radius."""
    if not candidates:
        return []
    ranked = []
    strongest = max(c.contrast for c in candidates)
    for c in candidates:
        off = max(abs(math.log(c.radius / search.expected)) - 0.25, 0.0) / search.settings.size_prior
        merit = c.complete**2 * (0.4 + 0.6 * math.exp(-0.5 * off**2)) * math.sqrt(min(1.0, c.visible + 0.25))
        merit *= (c.contrast / strongest) ** 0.1
        ranked.append(replace(c, merit=merit))
    ranked.sort(key=lambda c: (-c.merit, c.u, c.v, c.radius))
    kept: list[Candidate] = []
    for c in ranked:
        if not any(c.overlaps(k) and abs(math.log(c.radius / k.radius)) < 0.3 for k in kept):
            kept.append(c)
    return kept
