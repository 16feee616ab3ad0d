"""A circle in a coarse image, checked along rays from its centre: the strongest edge of one polarity on each ray, a
circle through the edges that agree, and the share of the visible rays that do.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.detection.order_statistics import median
from tomopose.units import Array

RAYS = 72
COS, SIN = np.cos(2 * np.pi * np.arange(RAYS) / RAYS), np.sin(2 * np.pi * np.arange(RAYS) / RAYS)
STEP = 0.5
"""Of the samples along a ray, px."""
WIDE = 2
"""Samples on either side of an edge that are compared where nothing is known of its blur: 1 px."""
TURNS, ROBUST_TURNS = 5, 8
STILL = 0.002
"""Move, px, below which a circle counts as fitted: the rays' edges are no better than a tenth."""


@njit(cache=True, error_model="numpy")
def check_circle(image, u, v, low, high, sign, aspect, noise, tightness, wide, rays):  # type: ignore[no-untyped-def]
    """(found, u, v, radius, complete, visible) of the circle near (u, v) with radius in [low, high].

    sign: +1 for a ball darker than its surroundings, -1 for a brighter one.  noise: standard deviation of a pixel.
    tightness: deviation from the circle, in radii, up to which a ray agrees.  wide: samples on either side of an edge
    that are compared.  rays: RaySettings as a plain tuple.
    """
    significant, fewest, most_hidden, weak, least_tolerance, least_agreeing = rays
    nothing = (False, 0.0, 0.0, 0.0, 0.0, 0.0)
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
    return True, u, v, radius, complete, n_seen / RAYS


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


def disc_contrast(image: Array, u: float, v: float, radius: float, sign: float, aspect: float) -> float:
    """How much darker (sign +1) the middle is than the surroundings; not positive for a ring or a hole."""
    r = np.array([[0.25 * radius], [0.5 * radius], [radius + max(0.15 * radius, 2.0)]])
    x, y = u + r * COS, v + r * SIN / aspect
    seen = (x >= -0.5) & (x < image.shape[1] - 0.5) & (y >= -0.5) & (y < image.shape[0] - 0.5)
    if not (seen[:2].any() and seen[2].any()):
        return 0.0
    i, j = np.rint(np.where(seen, x, 0.0)).astype(np.int64), np.rint(np.where(seen, y, 0.0)).astype(np.int64)
    values = image[j, i].astype(np.float64)
    return sign * float(np.median(values[2][seen[2]]) - np.median(values[:2][seen[:2]]))


def rim_blur(image: Array, u: float, v: float, radius: float, aspect: float, sign: float) -> float:
    """Standard deviation, px, of the blur of a circle's rim, from the steepest slope of the mean profile across it.

    A step of height h blurred by sigma has the slope h / (sqrt(2 pi) sigma); it is taken over half of the blur on
    either side.  0 where there is no slope.
    """
    n = int(2.0 * radius) + 9
    x, y = u + np.outer(COS, np.arange(n)), v + np.outer(SIN, np.arange(n)) / aspect
    ray, q = np.nonzero((x >= 0.0) & (x < image.shape[1] - 1.0) & (y >= 0.0) & (y < image.shape[0] - 1.0))
    x, y = x[ray, q], y[ray, q]
    i, j = x.astype(np.int64), y.astype(np.int64)
    before = image[j, i] + (x - i) * (image[j, i + 1] - image[j, i])
    after = image[j + 1, i] + (x - i) * (image[j + 1, i + 1] - image[j + 1, i])
    total, count = np.bincount(q, before + (y - j) * (after - before), n), np.bincount(q, minlength=n)
    deep, far = int(0.3 * radius) + 1, int(1.5 * radius)
    profile = total / np.maximum(count, 1)
    inside, outside = float(profile[:deep].sum()) / min(deep, n), float(total[far:].sum()) / max(count[far:].sum(), 1)
    height, blur, apart = sign * (outside - inside), 0.0, 1
    for _ in range(3):
        at = np.arange(max(int(0.5 * radius), apart), min(n - apart, int(1.5 * radius) + 3))
        at = at[(count[at - apart] > 0) & (count[at + apart] > 0)]
        steepest = float((sign * 0.5 / apart * (profile[at + apart] - profile[at - apart])).max(initial=0.0))
        if not (steepest > 0.0 and height > 0.0):
            return blur
        blur = height / (math.sqrt(2.0 * math.pi) * steepest)
        if apart >= max(int(0.5 * blur), 1):
            break
        apart = int(0.5 * blur)
    return blur
