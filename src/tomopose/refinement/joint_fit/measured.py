"""The images as the fit takes them: line integrals, their noise, the blocks of pixels that judge it, and the rays that
meet what lies beyond the grid."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.optimize

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.line_integrals import LineIntegrals
from tomopose.units import Array, Floats
from tomopose.volume import VoxelGrid

BLOCK = 4
"""Side of a held-out block, in pixels of the coarsest level, by which it may be judged: wider than the projector's and
the detector's blur, with pixels in its middle that the level's smoothing does not mix with others."""
LEAST_COARSE = 2
"""The coarsest binning is counted as this at least: a block of 8 px is wider than the blur of a detector too."""
LEAST_NOISE = 2e-4
"""Standard deviation of a pixel, relative to the largest line integral, that no image falls below: what a projector of
voxels leaves of an exact line integral's rounding."""

MATTER = 0.2
"""Share of the dense values (99.9 %) of the volume, or of the images, from which its outermost layers hold matter.  On
five objects (benchmarks/refine/edges.py) the right edges are named from 0.1 to 0.3."""
CROSSED = 0.05
"""Share of a face's voxels, or of an image edge's pixels and of the views, from which the object crosses it: noise and
streaks fill less.  Flat from 0.02 to 0.2 in the same scan."""
FACES = ("-x", "+x", "-y", "+y", "-z", "+z")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """One level of the images' pyramid.

    p: (n, N) line integrals, pixels as [u, v], float32.  weight: (n, N), 1/variance; 0 for bad and for held-out pixels.
    judge: (n, N), the same for held-out pixels alone.  matrices, grid: binned to the same level.
    blur: standard deviations, px along u and v, of the Gaussian that p was smoothed with; the weights stay those of the
    unsmoothed noise, which is what the low frequencies have.
    """

    p: Floats
    weight: Floats
    judge: Floats
    matrices: ProjectionMatrices
    grid: VoxelGrid
    blur: tuple[float, float] = (0.0, 0.0)

    def smooth(self, lines: Floats) -> Floats:
        """Lines (n, N) smoothed as `p` was."""
        if not any(self.blur):
            return lines
        m = self.matrices
        images = lines.reshape(-1, m.n_u, m.n_v)
        return np.asarray(scipy.ndimage.gaussian_filter(images, (0.0, *self.blur), mode="nearest")).reshape(lines.shape)

    @property
    def noise_left(self) -> float:
        """Standard deviation of white noise after the smoothing, relative to before."""
        left = 1.0
        for sigma in self.blur:
            delta = np.zeros(2 * int(4 * sigma + 1) + 1)
            delta[len(delta) // 2] = 1.0
            left *= float(np.sum(scipy.ndimage.gaussian_filter1d(delta, sigma) ** 2)) if sigma else 1.0
        return math.sqrt(left)


def measured(scan: LineIntegrals, grid: VoxelGrid) -> Measured:
    """The scan at full resolution; no pixel judges yet."""
    m, n = scan.matrices, len(scan)
    p = np.empty((n, m.n_u, m.n_v), dtype=np.float32)
    good = np.empty(p.shape, dtype=bool)
    for j in range(n):
        image, bad, _ = scan.view(j)
        p[j], good[j] = image.T, ~bad.T
    variance = noise_variance(p, good)
    weight = np.where(good, 1 / variance, 0).astype(np.float32)
    weight = weight.reshape(n, -1)
    return Measured(p=p.reshape(n, -1), weight=weight, judge=np.zeros_like(weight), matrices=m, grid=grid)


def with_held_out(data: Measured, share: float, *, coarsest: int, seed: int) -> Measured:
    """The data with whole blocks of pixels, drawn by chance, about `share` of all, that judge and are not fitted.

    coarsest: binning of the coarsest level at which they may judge.
    """
    n_u, n_v, side = data.matrices.n_u, data.matrices.n_v, BLOCK * max(coarsest, LEAST_COARSE)
    drawn = np.random.default_rng([seed, 20]).random((len(data.p), -(-n_u // side), -(-n_v // side))) < share
    apart = drawn.repeat(side, axis=1).repeat(side, axis=2)[:, :n_u, :n_v].reshape(data.p.shape)
    zero = np.float32(0)
    return replace(data, weight=np.where(apart, zero, data.weight), judge=np.where(apart, data.weight, zero))


def noise_variance(p: Floats, good: npt.NDArray[np.bool_]) -> Floats:
    """Variance of each pixel of (n, n_u, n_v), found from the images: a + b e^p, of counts and
    of what does not depend on them.

    The difference of a pixel and the mean of its two neighbours along u has 1.5 times the variance of a pixel; its
    median absolute deviation, in classes of p, does not see edges.  p is smoothed for the law, so that a pixel's weight
    does not depend on its own noise.
    """
    smooth = scipy.ndimage.uniform_filter(p, size=(1, 3, 3), mode="nearest")
    keep = good[:, 1:-1] & good[:, :-2] & good[:, 2:]
    d = (p[:, 1:-1] - 0.5 * (p[:, :-2] + p[:, 2:]))[keep]
    at = smooth[:, 1:-1][keep]
    step = max(1, d.size // 2_000_000)
    d, at = d[::step], at[::step]
    ends = np.unique(np.quantile(at, np.linspace(0, 1, 13)))
    floor = (LEAST_NOISE * float(np.quantile(p, 0.999))) ** 2
    centre, found = [], []
    for low, high in itertools.pairwise(ends):
        inside = d[(at >= low) & (at <= high)]
        if inside.size >= 50:
            centre.append(0.5 * (low + high))
            found.append((MAD_TO_SIGMA * np.median(np.abs(inside - np.median(inside)))) ** 2 / 1.5)
    if not found:
        return np.full(p.shape, max(floor, float(np.var(d)) / 1.5 if d.size else floor), dtype=np.float32)
    level = np.maximum(found, floor)
    columns = np.stack([np.ones(len(centre)), np.exp(centre)], axis=1) / level[:, None]
    law, _ = scipy.optimize.nnls(columns, np.ones(len(centre)))
    return np.asarray(np.maximum(law[0] + law[1] * np.exp(smooth), floor), dtype=np.float32)


def crossed_faces(volume: np.ndarray) -> tuple[str, ...]:
    """Faces of the grid through which the object [z, y, x] leaves it."""
    dense = float(np.quantile(volume, 0.999))
    if dense <= 0:
        return ()
    faces = []
    for axis, name in ((2, "x"), (1, "y"), (0, "z")):
        layers = np.moveaxis(volume, axis, 0)
        for sign, outer in (("-", layers[:2]), ("+", layers[-2:])):
            if float(np.mean(outer.mean(axis=0) > MATTER * dense)) > CROSSED:
                faces.append(sign + name)
    return tuple(sorted(faces, key=FACES.index))


def crossed_edges(data: Measured) -> tuple[str, ...]:
    """Edges of the images at which the object leaves the view: matter there in more than a few views."""
    m = data.matrices
    images = data.p.reshape(len(data.p), m.n_u, m.n_v)
    dense = float(np.quantile(images, 0.999))
    if dense <= 0:
        return ()
    edges = {"-u": images[:, :2], "+u": images[:, -2:], "-v": images[:, :, :2], "+v": images[:, :, -2:]}
    found = []
    for name, pixels in edges.items():
        matter = pixels.mean(axis=1 if name[1] == "u" else 2) > MATTER * dense
        if float(np.mean(matter.mean(axis=1) > CROSSED)) > CROSSED:
            found.append(name)
    return tuple(found)


def rays_through(data: Measured, faces: tuple[str, ...]) -> Array:
    """bool (n, N): rays that enter or leave the grid through one of the faces."""
    m, grid = data.matrices, data.grid
    low, high = grid.corners.min(axis=0), grid.corners.max(axis=0)
    u, v = np.meshgrid(np.arange(m.n_u), np.arange(m.n_v), indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    result = np.zeros(data.p.shape, dtype=bool)
    for j, P in enumerate(m.P):
        M_inv = np.linalg.inv(P[:, :3])
        s, d = -M_inv @ P[:, 3], (M_inv @ pixels).T
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        t_low, t_high = (low - s) / d, (high - s) / d
        near, far = np.minimum(t_low, t_high), np.maximum(t_low, t_high)
        enter, leave = near.argmax(axis=1), far.argmin(axis=1)
        meets = near.max(axis=1) < far.min(axis=1)
        for face in faces:
            axis, up = "xyz".index(face[1]), face[0] == "+"
            inwards = (d[:, axis] < 0) == up
            result[j] |= meets & (((enter == axis) & inwards) | ((leave == axis) & ~inwards))
    return result
