"""Grey levels of background and material, from the histogram of a volume.

ISO-50: Otsu's threshold (IEEE Trans. Syst. Man Cybern. 9 (1979) 62) parts two classes, the mode of each is a level, and
the start surface lies midway.  Where a class has no mode of its own, Otsu's threshold itself is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tomopose.errors import InputError
from tomopose.volume import Volume

BINS = 2048
SAMPLES = 8_000_000
SMOOTHING = 0.01
"""Width of the Gaussian over the histogram, as a share of its range: wider than binning noise, narrower than modes."""
INVERTED_SHARE = 0.6
PROMINENT = 0.2
"""Share of its own height by which a mode must exceed its surroundings."""


@dataclass(frozen=True, kw_only=True)
class GreyLevels:
    """background, material: grey levels; threshold: of the start surface; rule: iso-50 | otsu | given."""

    background: float
    material: float
    threshold: float
    rule: str

    @property
    def contrast(self) -> float:
        return self.material - self.background


def given_levels(background: float, material: float) -> GreyLevels:
    """Levels that the user knows, for example the means of two regions.  InputError where contrast is inverted."""
    if not (np.isfinite(background) and np.isfinite(material) and material > background):
        raise InputError(
            f"material level {material} is not above background level {background}: the contrast is inverted; "
            "exchange them or negate the volume"
        )
    return GreyLevels(background=background, material=material, threshold=0.5 * (background + material), rule="given")


def grey_levels(volume: Volume, materials: int = 1) -> tuple[GreyLevels, ...]:
    """Levels of each material against the next darker one, brightest last.

    Raises InputError where the volume is one grey, not finite, has fewer modes than asked for, or its faces are mostly
    brighter than the threshold (inverted contrast).
    """
    if materials < 1:
        raise InputError(f"{materials} materials; one at least is needed")
    values = _sample(volume)
    low, high = np.percentile(values, [0.05, 99.95])
    low, high = float(min(low, values.mean())), float(max(high, values.max() if high <= low else high))
    if not high > low:
        raise InputError(f"the volume is one grey, {low:g}: there is no surface in it")
    count, edges = np.histogram(values, bins=BINS, range=(low, high))
    centres = 0.5 * (edges[1:] + edges[:-1])
    smooth = _smoothed(count)
    found = _two_levels(count, smooth, centres) if materials == 1 else _modes(smooth, centres, materials + 1)
    _require_bright_material(volume, found[0].threshold)
    return found


def _sample(volume: Volume) -> np.ndarray:
    """At most SAMPLES voxels on a regular grid whose steps differ by axis, so that no pattern is met in phase."""
    stride = max(int(np.ceil((volume.grid.size / SAMPLES) ** (1 / 3))), 1)
    values = np.asarray(volume.values[::stride, ::stride, ::stride], dtype=np.float64).ravel()
    if not np.isfinite(values).all():
        raise InputError(f"{int((~np.isfinite(values)).sum())} of {values.size} voxels looked at are not finite")
    return values


def _smoothed(count: np.ndarray) -> np.ndarray:
    width = SMOOTHING * len(count)
    k = np.arange(-int(4 * width), int(4 * width) + 1)
    kernel = np.exp(-0.5 * (k / width) ** 2)
    padded = np.concatenate([np.zeros(len(k) // 2), count, np.zeros(len(k) // 2)])
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def otsu(count: np.ndarray, centres: np.ndarray) -> int:
    """Index of the first bin above Otsu's threshold."""
    weight = np.cumsum(count)
    moment = np.cumsum(count * centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (moment[-1] * weight / weight[-1] - moment) ** 2 / (weight * (weight[-1] - weight))
    between = np.where(np.isfinite(between), between, -np.inf)
    best = np.flatnonzero(between >= between.max() * (1 - 1e-12))
    return int(best[len(best) // 2]) + 1


def _two_levels(count: np.ndarray, smooth: np.ndarray, centres: np.ndarray) -> tuple[GreyLevels, ...]:
    cut = otsu(count, centres)
    dark, bright = int(np.argmax(smooth[:cut])), cut + int(np.argmax(smooth[cut:]))
    margin = int(3 * SMOOTHING * len(count))
    if bright - cut < margin or cut - dark < margin:
        below, above = (float(np.average(centres[p], weights=count[p])) for p in (slice(0, cut), slice(cut, None)))
        return (GreyLevels(background=below, material=above, threshold=float(centres[cut]), rule="otsu"),)
    background, material = float(centres[dark]), float(centres[bright])
    middle = 0.5 * (background + material)
    return (GreyLevels(background=background, material=material, threshold=middle, rule="iso-50"),)


def _modes(smooth: np.ndarray, centres: np.ndarray, wanted: int) -> tuple[GreyLevels, ...]:
    from scipy.signal import find_peaks

    padded = np.concatenate([[0.0], smooth, [0.0]])
    peaks, facts = find_peaks(padded, prominence=0, distance=int(3 * SMOOTHING * len(smooth)))
    stands_out = facts["prominences"] > PROMINENT * padded[peaks]
    peaks, prominence = peaks[stands_out], facts["prominences"][stands_out]
    if len(peaks) < wanted:
        raise InputError(
            f"the histogram has {len(peaks)} modes where {wanted} are needed (background and {wanted - 1} materials); "
            "give the levels"
        )
    # A small part may fill little of the volume: modes are ranked by prominence against their own height.
    rank = prominence / padded[peaks] * np.log1p(padded[peaks])
    level = np.sort(centres[np.sort(peaks[np.argsort(rank)[-wanted:]]) - 1])
    return tuple(
        GreyLevels(background=float(d), material=float(b), threshold=float(0.5 * (d + b)), rule="iso-50")
        for d, b in pairwise(level)
    )


def _require_bright_material(volume: Volume, threshold: float) -> None:
    v = volume.values
    faces = [v[0], v[-1], v[:, 0], v[:, -1], v[:, :, 0], v[:, :, -1]]
    bright = sum(int(np.count_nonzero(np.asarray(f) > threshold)) for f in faces)
    share = bright / sum(f.size for f in faces)
    if share > INVERTED_SHARE:
        raise InputError(
            f"{100 * share:.0f} % of the volume's faces are brighter than the threshold {threshold:g}: the contrast is "
            "inverted, or the part fills the volume; negate the volume, or give the levels of background and material"
        )
