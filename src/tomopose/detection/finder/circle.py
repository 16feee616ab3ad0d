"""A circle in a coarse image, checked along rays from its centre: the strongest edge of one polarity on each ray, a
circle through the edges that agree, and the share of the visible rays that do.
"""

from __future__ import annotations

import math

import numpy as np

from tomopose.detection.order_statistics import median
from tomopose.kernel_cache import njit

RAYS = 72
COS, SIN = np.cos(2 * np.pi * np.arange(RAYS) / RAYS), np.sin(2 * np.pi * np.arange(RAYS) / RAYS)
STEP = 0.5
"""Of the samples along a ray, px."""
WIDE = 2
"""Samples on either side of an edge that are compared where nothing is known of its blur: 1 px."""
TURNS, ROBUST_TURNS = 5, 8
STILL = 0.002
"""Move, px, below which a circle counts as fitted: the rays' edges are no better than a tenth."""


@njit(cache=True)
def check_circle(image, u, v, low, high, sign, aspect, noise, tightness, wide, rays):  # type: ignore[no-untyped-def]
    """(found, u, v, radius, complete, visible, contrast) of the circle near (u, v) with radius in [low, high].

    sign: +1 for a ball darker than its surroundings, -1 for a brighter one.  noise: standard deviation of a pixel.
    tightness: deviation from the circle, in radii, up to which a ray agrees.  wide: samples on either side of an edge
    that are compared.  rays: RaySettings as a plain tuple.
    """
    significant, fewest, most_hidden, weak, least_tolerance, least_agreeing = rays
    nothing = (False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    edge, strength, seen = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS, np.bool_)
    x, y, deviation, part = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS), np.empty(RAYS)
    radius, tolerance, n, n_seen = 0.0, 0.0, 0, 0
    for turn in range(TURNS):
        n_seen = ray_edges(image, u, v, (max(low, 1.0), high), sign, aspect, wide, edge, strength, seen)
        m = 0
        for k in range(RAYS):
            if seen[k] and strength[k] > 0.0:
                part[m] = strength[k]
                m += 1
        if m < max(fewest, most_hidden * n_seen):
            return nothing
        strong = median(part[:m])
        if strong < significant * noise:
            return nothing
        n = 0
        for k in range(RAYS):
            if seen[k] and strength[k] > weak * strong:
                x[n], y[n], part[n] = edge[k] * COS[k], edge[k] * SIN[k], edge[k]
                n += 1
        cx, cy, radius = _robust_circle(x[:n], y[:n], median(part[:n]))
        if not (0.5 * low < radius < 2.0 * high) or math.sqrt(cx * cx + cy * cy) > 0.8 * high:
            return nothing
        tolerance = max(tightness * radius, least_tolerance)
        agree = 0
        for k in range(n):
            deviation[k] = abs(math.sqrt((x[k] - cx) ** 2 + (y[k] - cy) ** 2) - radius)
            agree += deviation[k] < 2.0 * tolerance
        if agree < least_agreeing * n_seen:
            return nothing
        u, v = u + cx, v + cy / aspect
        if not (-radius < u < image.shape[1] + radius and -radius < v < image.shape[0] + radius):
            return nothing
        half = max(2.5, 0.2 * radius) / (turn + 1) + 0.1 * radius
        low, high = max(radius - half, 1.0), radius + half
        if turn >= 2 and math.sqrt(cx * cx + cy * cy) < 0.1:
            break
    agree = 0
    for k in range(n):
        agree += deviation[k] < tolerance
    complete = agree / max(n_seen, 1)
    if median(deviation[:n]) > 0.5 * tolerance:
        complete *= 0.5
    return True, u, v, radius, complete, n_seen / RAYS, _disc_contrast(image, u, v, radius, sign, aspect)


@njit(cache=True)
def ray_edges(image, u, v, limits, sign, aspect, wide, edge, strength, seen):  # type: ignore[no-untyped-def]
    """Fills radius and strength of the steepest edge of polarity `sign` on each ray, and whether the ray stays in the
    image long enough; returns how many do.

    limits: least and largest radius.  wide: an edge is the difference of the means of so many samples on either side.
    """
    low, high = limits
    n = int((high - low) / STEP) + 1 + 2 * wide
    profile, d = np.empty(n), np.zeros(n)
    rows, columns = image.shape
    n_seen = 0
    for k in range(RAYS):
        c, s = COS[k], SIN[k] / aspect
        reached = 0
        for q in range(n):
            r = low + (q - wide) * STEP
            x, y = u + r * c, v + r * s
            if not (0.0 <= x < columns - 1.0 and 0.0 <= y < rows - 1.0):
                break
            profile[q] = _between_pixels(image, x, y)
            reached = q + 1
        seen[k] = reached >= n // 2 + 1
        n_seen += seen[k]
        best, at, across = 0.0, 0, 0.0
        for m in range(1, min(wide, (reached - 1) // 2) + 1):
            across += profile[wide + m] - profile[wide - m]
        for q in range(wide, reached - wide):
            d[q] = sign * across / wide
            if d[q] > best:
                best, at = d[q], q
            if q + wide + 1 < reached:
                across += profile[q + wide + 1] - profile[q + 1] - profile[q] + profile[q - wide]
        strength[k] = best
        edge[k] = low + (at - wide) * STEP
        if wide < at < reached - wide - 1:
            bend = d[at - 1] - 2 * d[at] + d[at + 1]
            if bend < 0:
                edge[k] += STEP * 0.5 * (d[at - 1] - d[at + 1]) / bend
    return n_seen


@njit(cache=True, inline="always")
def _between_pixels(image, x, y):  # type: ignore[no-untyped-def]
    """The image at (x, y), linear between pixels."""
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    before = image[j, i] + fx * (image[j, i + 1] - image[j, i])
    after = image[j + 1, i] + fx * (image[j + 1, i + 1] - image[j + 1, i])
    return before + fy * (after - before)


@njit(cache=True)
def _robust_circle(x, y, start):  # type: ignore[no-untyped-def]
    """(u, v, radius) through most of the points: least squares, points that disagree given less weight (Cauchy)."""
    n, cx, cy, radius = x.shape[0], 0.0, 0.0, start
    deviation, size = np.empty(n), np.empty(n)
    for turn in range(ROBUST_TURNS):
        for k in range(n):
            deviation[k] = math.sqrt((x[k] - cx) ** 2 + (y[k] - cy) ** 2) - radius
            size[k] = abs(deviation[k])
        per_scale = 0.5 / max(median(size), 0.05)
        total, mx, my, ms, xx, xy, yy, xs, ys = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            w = 1.0 / (1.0 + (deviation[k] * per_scale) ** 2)
            if turn > 0:
                w *= w
            s = x[k] * x[k] + y[k] * y[k]
            total += w
            mx += w * x[k]
            my += w * y[k]
            ms += w * s
            size[k] = w
        mx, my, ms = mx / total, my / total, ms / total
        for k in range(n):
            w, dx, dy, ds = size[k], x[k] - mx, y[k] - my, x[k] * x[k] + y[k] * y[k] - ms
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            xs += w * dx * ds
            ys += w * dy * ds
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
    sample, n_disc, n_around = np.empty((2, 2 * RAYS)), 0, 0
    for r in (0.25 * radius, 0.5 * radius, radius + max(0.15 * radius, 2.0)):
        for k in range(RAYS):
            x, y = u + r * COS[k], v + r * SIN[k] / aspect
            if not (-0.5 <= x < image.shape[1] - 0.5 and -0.5 <= y < image.shape[0] - 0.5):
                continue
            i, j = round(x), round(y)
            if r < radius:
                sample[0, n_disc] = image[j, i]
                n_disc += 1
            else:
                sample[1, n_around] = image[j, i]
                n_around += 1
    if n_disc == 0 or n_around == 0:
        return 0.0
    return sign * (median(sample[1, :n_around]) - median(sample[0, :n_disc]))


@njit(cache=True)
def rim_blur(image, u, v, radius, aspect, sign):  # type: ignore[no-untyped-def]
    """Standard deviation, px, of the blur of a circle's rim, from the steepest slope of the mean profile across it.

    A step of height h blurred by sigma has the slope h / (sqrt(2 pi) sigma); it is taken over half of the blur on
    either side.  0 where there is no slope.
    """
    n = int(2.0 * radius) + 9
    total, count = np.zeros(n), np.zeros(n)
    for k in range(RAYS):
        for q in range(n):
            x, y = u + q * COS[k], v + q * SIN[k] / aspect
            if 0.0 <= x < image.shape[1] - 1.0 and 0.0 <= y < image.shape[0] - 1.0:
                total[q] += _between_pixels(image, x, y)
                count[q] += 1.0
    deep, far = int(0.3 * radius) + 1, int(1.5 * radius)
    inside, outside, n_outside = 0.0, 0.0, 0.0
    for q in range(n):
        if q >= far:
            outside += total[q]
            n_outside += count[q]
        total[q] /= max(count[q], 1.0)
        if q < deep:
            inside += total[q]
    height = sign * (outside / max(n_outside, 1.0) - inside / min(deep, n))
    blur, apart = 0.0, 1
    for _ in range(3):
        steepest = 0.0
        for q in range(max(int(0.5 * radius), apart), min(n - apart, int(1.5 * radius) + 3)):
            if count[q - apart] > 0.0 and count[q + apart] > 0.0:
                steepest = max(steepest, sign * 0.5 / apart * (total[q + apart] - total[q - apart]))
        if not (steepest > 0.0 and height > 0.0):
            return blur
        blur = height / (math.sqrt(2.0 * math.pi) * steepest)
        if apart >= max(int(0.5 * blur), 1):
            break
        apart = int(0.5 * blur)
    return blur
