"""Finding, second half: candidates are circles whose rim is complete and of one polarity; the best is the ball.

A candidate from circle_centres is checked along rays from its centre: the strongest edge of its polarity on each ray,
a circle through the edges that agree, and the share of the visible rays that do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from tomopose.detection.pyramid import LARGEST, SMALLEST, block_mean, circle_centres
from tomopose.errors import AmbiguousBallError, BallNotFoundError, BallTruncatedError
from tomopose.units import Array

RAYS = 72
COMPLETE = 0.62
"""Least share of the visible rim that must agree with a circle."""
SIGNIFICANT = 4.0
"""Least median step across the rim, in standard deviations of the noise."""
FAINT = 0.4
"""A candidate with less than this share of the best one's contrast is no rival."""
EQUAL = 0.75
"""A second candidate with this share of the best one's merit makes the image ambiguous."""
ROUND, FINE_ROUND = 0.08, 0.03
"""Deviation from a circle, in radii, that a ray may show on a coarse and on the fine level: a hexagon has 0.07."""
FINALISTS = 4
STILL = 0.002
"""Move, px, below which a circle counts as fitted: the rays' edges are no better than a tenth."""
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
    image: Array, expected_radius: float, aspect: float = 1.0, *, smallest: float = 3.5,
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
    levels = _levels(image.shape, smallest)
    first = [f for f in levels if SMALLEST * f < 1.6 * expected_radius and LARGEST * f > expected_radius / 1.6]
    candidates: list[Candidate] = []
    means: dict[int, Array] = {}
    for group in (first, [f for f in levels if f not in first]):
        for factor in group:
            candidates += _on_level(_level(image, factor, means), factor, aspect)
        candidates = _distinct(candidates, expected_radius)
        if candidates and candidates[0].merit > 0.6:
            break
    if not candidates:
        raise BallNotFoundError(
            "no circle with a complete rim of one polarity; is the ball in view, and its contrast above noise?"
        )
    candidates = _finalists(image, candidates, aspect, expected_radius)
    if not candidates:
        raise BallNotFoundError("nothing in the image is round enough to be a ball")
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


def _finalists(image: Array, candidates: list[Candidate], aspect: float, expected_radius: float) -> list[Candidate]:
    """The best few candidates, looked at again on finer images."""
    again = [_refined(image, c, aspect) for c in candidates[:FINALISTS]]
    return _distinct([c for c in again if c is not None], expected_radius)


def _refined(image: Array, c: Candidate, aspect: float) -> Candidate | None:
    """The candidate on a finer image of its surroundings, so that the fit starts within a pixel; None if not round."""
    factor = max(1, int(c.radius / 40))
    reach = 1.5 * c.radius + 8
    u, v = max(int(c.u - reach), 0), max(int(c.v - reach / aspect), 0)
    level = block_mean(image[v : int(c.v + reach / aspect) + 1, u : int(c.u + reach) + 1], factor)
    shift = (factor - 1) / 2
    sign = -1.0 if c.bright else 1.0
    radius = c.radius / factor
    half = max(2.0, 0.15 * radius)
    yes, x, y, radius, complete, visible, contrast = check_circle(
        level, (c.u - u - shift) / factor, (c.v - v - shift) / factor, radius - half, radius + half, sign, aspect, 0.0,
        FINE_ROUND,
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
    for u, v, low, high, polarity in centres:
        sign = -1.0 if polarity == 1 else 1.0
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


@njit(cache=True)
def check_circle(image, u, v, low, high, sign, aspect, noise, tightness):  # type: ignore[no-untyped-def]
    """(found, u, v, radius, complete, visible, contrast) of the circle near (u, v) with radius in [low, high].

    sign: +1 for a ball darker than its surroundings, -1 for a brighter one.  noise: standard deviation of a pixel.
    tightness: deviation from the circle, in radii, up to which a ray agrees.
    """
    nothing = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    turns = 5
    x, y, good, deviation = np.zeros(RAYS), np.zeros(RAYS), np.zeros(RAYS, np.bool_), np.zeros(RAYS)
    radius, tolerance, n_seen = 0.0, 0.0, 0
    for turn in range(turns):
        edge, strength, seen = ray_edges(image, u, v, max(low, 1.0), high, sign, aspect, RAYS)
        n_seen = int(np.sum(seen))
        good = seen & (strength > 0)
        if np.sum(good) < max(12, 0.4 * n_seen):
            return nothing
        strong = np.median(strength[good])
        if strong < SIGNIFICANT * noise:
            return nothing
        good = good & (strength > 0.2 * strong)
        for k in range(RAYS):
            x[k] = edge[k] * math.cos(2 * math.pi * k / RAYS)
            y[k] = edge[k] * math.sin(2 * math.pi * k / RAYS)
        cx, cy, radius = _robust_circle(x, y, good, np.median(edge[good]))
        if not (0.5 * low < radius < 2.0 * high) or math.hypot(cx, cy) > 0.8 * high:
            return nothing
        tolerance = max(tightness * radius, 0.6)
        agree = 0
        for k in range(RAYS):
            deviation[k] = abs(math.hypot(x[k] - cx, y[k] - cy) - radius)
            agree += good[k] and deviation[k] < 2.0 * tolerance
        if agree < 0.35 * n_seen:
            return nothing
        u, v = u + cx, v + cy / aspect
        if not (-radius < u < image.shape[1] + radius and -radius < v < image.shape[0] + radius):
            return nothing
        half = max(2.5, 0.2 * radius) / (turn + 1) + 0.1 * radius
        low, high = max(radius - half, 1.0), radius + half
        if turn >= 2 and math.hypot(cx, cy) < 0.1:
            break
    complete = float(np.sum(good & (deviation < tolerance))) / max(n_seen, 1)
    if np.median(deviation[good]) > 0.5 * tolerance:
        complete *= 0.5
    return True, u, v, radius, complete, n_seen / RAYS, _disc_contrast(image, u, v, radius, sign, aspect)


@njit(cache=True)
def _robust_circle(x, y, good, start):  # type: ignore[no-untyped-def]
    """(u, v, radius) through most of the points: least squares, points that disagree given less weight (Cauchy)."""
    cx, cy, radius = 0.0, 0.0, start
    deviation, weight = np.zeros(x.shape[0]), np.zeros(x.shape[0])
    for turn in range(8):
        for k in range(x.shape[0]):
            deviation[k] = math.hypot(x[k] - cx, y[k] - cy) - radius
        scale = 2.0 * max(np.median(np.abs(deviation[good])), 0.05)
        total, mx, my, ms = 0.0, 0.0, 0.0, 0.0
        for k in range(x.shape[0]):
            weight[k] = 0.0
            if good[k]:
                w = 1.0 / (1.0 + (deviation[k] / scale) ** 2)
                weight[k] = w if turn == 0 else w * w
                total += weight[k]
                mx += weight[k] * x[k]
                my += weight[k] * y[k]
                ms += weight[k] * (x[k] ** 2 + y[k] ** 2)
        mx, my, ms = mx / total, my / total, ms / total
        xx, xy, yy, xs, ys = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(x.shape[0]):
            dx, dy, ds = x[k] - mx, y[k] - my, x[k] ** 2 + y[k] ** 2 - ms
            xx += weight[k] * dx * dx
            xy += weight[k] * dx * dy
            yy += weight[k] * dy * dy
            xs += weight[k] * dx * ds
            ys += weight[k] * dy * ds
        determinant = xx * yy - xy * xy
        if not determinant > 1e-12 * total * total:
            return 0.0, 0.0, -1.0
        before_x, before_y = cx, cy
        cx, cy = 0.5 * (yy * xs - xy * ys) / determinant, 0.5 * (xx * ys - xy * xs) / determinant
        radius = math.sqrt(max(ms - 2 * (cx * mx + cy * my) + cx * cx + cy * cy, 0.0))
        if turn > 0 and abs(cx - before_x) + abs(cy - before_y) < STILL:
            break
    return cx, cy, radius


@njit(cache=True)
def _disc_contrast(image, u, v, radius, sign, aspect):  # type: ignore[no-untyped-def]
    """How much darker (sign +1) the middle is than the surroundings; not positive for a ring or a hole."""
    disc, around = np.empty(37), np.empty(64)
    n_disc, n_around = 0, 0
    outer = 1.0 + max(0.15, 2.0 / radius)
    for r, n in ((0.0, 1), (0.25, 12), (0.5, 24), (outer, 64)):
        for k in range(n):
            i = round(u + r * radius * math.cos(2 * math.pi * k / n))
            j = round(v + r * radius * math.sin(2 * math.pi * k / n) / aspect)
            if 0 <= i < image.shape[1] and 0 <= j < image.shape[0]:
                if r < 1.0:
                    disc[n_disc] = image[j, i]
                    n_disc += 1
                else:
                    around[n_around] = image[j, i]
                    n_around += 1
    if n_disc == 0 or n_around == 0:
        return 0.0
    return sign * (np.median(around[:n_around]) - np.median(disc[:n_disc]))


@njit(cache=True)
def ray_edges(image, u, v, low, high, sign, aspect, rays):  # type: ignore[no-untyped-def]
    """Radius and strength of the steepest edge of polarity `sign` on each ray, and whether it stays in the image."""
    step = 0.5
    d = np.zeros(int((high - low) / step) + 5)
    n = int((high - low) / step) + 1
    edge, strength, inside = np.zeros(rays), np.zeros(rays), np.zeros(rays, np.bool_)
    profile = np.empty(n + 4)
    rows, columns = image.shape
    for k in range(rays):
        c, s = math.cos(2 * math.pi * k / rays), math.sin(2 * math.pi * k / rays) / aspect
        reached = 0
        for q in range(n + 4):
            r = low + (q - 2) * step
            x, y = u + r * c, v + r * s
            i, j = math.floor(x), math.floor(y)
            if i < 0 or j < 0 or i >= columns - 1 or j >= rows - 1:
                break
            fx, fy = x - i, y - j
            profile[q] = (1 - fy) * ((1 - fx) * image[j, i] + fx * image[j, i + 1]) + fy * (
                (1 - fx) * image[j + 1, i] + fx * image[j + 1, i + 1]
            )
            reached = q + 1
        inside[k] = reached >= (n + 4) // 2 + 1
        best, at = 0.0, 0
        for q in range(2, reached - 2):
            d[q] = sign * (profile[q + 2] - profile[q - 2])
            if d[q] > best:
                best, at = d[q], q
        strength[k] = best
        edge[k] = low + (at - 2) * step
        if 2 < at < reached - 3:
            bend = d[at - 1] - 2 * d[at] + d[at + 1]
            if bend < 0:
                edge[k] += step * 0.5 * (d[at - 1] - d[at + 1]) / bend
    return edge, strength, inside
