"""Every threshold of detection, beside where it comes from.

"Tuned" values are those that `benchmarks/detection/thresholds.py` scans: error / bound and the variance of normalised
errors for several values of each.  "Flat" says that on its 60 images at SNR 50 and 800 (magnification 2.7) error /
bound changes by 3 % at most; it is 1.22 and 1.48 there with the values below, the variance 1.07 and 1.14.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class RaySettings(NamedTuple):
    """A circle's check along rays from its centre."""

    significant: float = 4.0
    """Least median step across the rim, in standard deviations of the noise."""
    fewest: float = 12.0
    most_hidden: float = 0.4
    """Rays of 72 with an edge of the right polarity that a circle requires, and the least share of the visible ones."""
    weak: float = 0.2
    """Step on a ray, in median steps, from which it counts."""
    tolerance: float = 0.6
    """Least deviation from the circle, px of the level, up to which a ray agrees: half a pixel and its noise."""
    least_agreeing: float = 0.35
    """Share of the visible rays that must lie within twice the tolerance for another turn."""


class FinderSettings(NamedTuple):
    """The search for circles."""

    rays: RaySettings = RaySettings()

    complete: float = 0.62
    """Least share of the visible rim that must agree with a circle: a holder may hide a third of it."""
    faint: float = 0.4
    """Share of the best candidate's contrast below which another one is not an alternative."""
    equal: float = 0.75
    """Share of the best candidate's merit from which another one makes the image ambiguous."""
    round_coarse: float = 0.08
    """Deviation from a circle, in radii, that a ray may show on a coarse image: half a pixel of the smallest radius."""
    round_fine: float = 0.03
    """The same on the fine image: a hexagonal nut deviates by 0.07."""
    finalists: int = 4
    """Candidates that are checked again on a finer image."""
    sure: float = 0.85
    """Least share of the rim of a circle at a predicted place that makes further search needless."""
    convincing: float = 0.6
    """Merit from which a candidate ends the search."""
    size_ratio: float = 1.6
    """Ratio to the expected radius, either way, of a ball that is looked for first."""
    size_prior: float = 0.25
    """Width of the preference for the nominal radius, in log radius: loose, for magnification varies with the pose."""
    fine_radius: float = 40.0
    """Radius, px, to which a larger circle is reduced for the check on the fine image: half a pixel there is 1 %."""
    fine_blur: float = 1.5
    """Blur, px, to which a wider one is reduced for that check: noise then moves a ray's edge by a tenth of a pixel of
    the reduced image at an SNR of 50."""
    resolved_blur: float = 2.0
    """Blur, px of that image, from which its estimate means more than the pixels and the circle's own deviation."""
    fine_widths: float = 1.5
    """Widths of the blur on either side of an edge that are compared on a ray: about the filter of least noise."""
    least_visible: float = 0.4
    """Least visible share of a candidate's rim; the fit then requires half."""
    least_votes: float = 0.3
    """Share of a circle's rim that must point to its centre."""
    edge_noise: float = 6.0
    """Gradient of an edge pixel in standard deviations of the noise: by chance in 1e-8 of pixels."""
    edge_share: float = 0.0045
    """And in the largest gradient: a ball 200 times fainter than a collimator's edge is still found."""
    most: int = 10
    """Centres of a level that are looked at, those with most votes."""
    peaks: int = 3
    """How many of them one range of radii and one polarity can give."""


class RingSettings(NamedTuple):
    """The ring of pixels about the rim, px; for a blur above `sharp` all lengths grow in proportion."""

    share: float = 0.35
    narrowest: float = 5.0
    widest: float = 22.0
    """Width outside the rim: this share of the radius, within these limits.  Tuned; share flat from 0.25 to 0.5."""
    widths: float = 10.0
    """Least width outside, in widths of the blur.  The background's level and slope must be known apart from the edge:
    with both free at every node the centre's standard deviation is 1.67, 1.34, 1.22 and 1.15 times that with a known
    background for a width of 4, 6, 8 and 10."""
    slopes_from: float = 15.0
    """Width outside, in widths of the blur, from which the background's slopes need no prior: a wider ring determines
    them, and a prior would be too narrow beside a holder (variance of the normalised errors 1.26 instead of 1.02 at
    magnification 2.7 and SNR 800, whose ring has 27 widths)."""
    inside: float = 5.0
    """Width inside: with `sharp`, 3.8 widths of the blur, beyond which an opaque ball shows nothing."""
    sharp: float = 1.3
    """Blur up to which the lengths here hold: the first shell then ends 5.4 widths from the rim: the edge is over."""
    shells: tuple[float, float, float] = (7.0, 10.0, 14.0)
    """Where the ring is cut, for the comparison of smaller rings.  Tuned; 2 px nearer the rim costs
    8 % at SNR 800, 2 px farther gains 3 %."""
    node_distance: float = 9.5
    fewest_nodes: int = 6
    most_nodes: int = 36
    """Distance of the background's angular nodes along the rim: a holder's wall is as wide; and their number."""
    thin_from: float = 8.0
    most_pixels: float = 8000.0
    """Of more pixels than this, every second one beyond this distance is left out: costs 1 % of sigma, saves a third of
    the time."""
    enough_pixels: int = 1500
    """Number of pixels used while converging from the initial circle."""


class FitSettings(NamedTuple):
    """Steps, noise and background of the fit."""

    start_blur: float = 0.8
    """Least blur, px, that the fit begins with."""
    least_blur: float = 0.25
    """A pixel's box alone has 0.29."""
    most_blur: float = 1.0
    """In radii: beyond, radius and blur cannot be distinguished."""
    largest_step: float = 2.0
    """Of centre and radius, px: the finder's circle is good to about that."""
    linear_move: float = 0.02
    """Largest move, px, after which distances are updated to first order; what is left out is move^2 / 2 radius."""
    flat: float = 5.0
    """Distance from the rim, in widths of the blur, from which the edge is over: its tail is 3e-7 there."""
    tail: float = 6.0
    """Distance inside the rim, in widths of the blur, from which nothing passes an opaque ball (1e-9)."""
    wider_ring: float = 1.25
    """Ratio of the fitted blur to the ring's, either way, from which the ring is made anew."""
    transparent: float = 0.01
    """Share of the contrast by which a ball must grow darker towards its middle to count as one that X-rays pass."""
    transparent_sigma: float = 6.0
    """And the standard deviations by which it must."""
    open_from: float = 0.1
    """Blur, in radii, from which the attenuation is always fitted: the middle differs from the region inside the rim by
    less than 1 % of the contrast for a total attenuation of 4, and an opaque model would be 4 % small."""
    kappa_starts: tuple[float, ...] = (0.3, 1.0, 3.0, 8.0)
    """Total attenuations along the diameter from which such a ball is fitted; below the first the shape of the profile
    no longer depends on it."""
    size_prior: float = 0.25
    """Standard deviation of the logarithm of the radius about the nominal one where the blur exceeds `size_from` radii:
    there radius, blur and attenuation compensate each other.  The centre does not depend on them."""
    size_from: float = 0.15
    outlier: float = 6.0
    """Residual in standard deviations from which a single pixel counts as bad: by chance in 2e-9 of pixels."""
    misfit: float = 4.0
    """Standard deviations by which a sector's chi-square must exceed 1 for its background to count as badly fitted."""
    steepest: float = 6.0
    """Prior: the background changes over the ring by no more than this many standard deviations of the ring's values.
    Tuned; flat from 3 to 12."""
    few_bent: float = 0.1
    bent: float = 10.0
    """Prior share of nodes where the background is curved, and its curvature there, in variances of the estimate.
    Tuned; flat from 0.03 to 0.2 and from 4 to 25."""
    least_curvature: float = 1e-3
    """Least variance of the curvature's prior, in variances of the estimate: keeps the matrix regular."""
    gross: float = 0.1
    """Share of the contrast from which a residual can spoil a least-squares start."""
    line: int = 6
    """Pixels with gross residuals from which a row or column may be a dead one."""
    most_lines: int = 6
    """Times that dead lines are looked for."""
    rim_clear: float = 3.0
    """Distance from the rim, in px or widths of the blur, within which a residual may be the edge's own."""
    moved: float = 30.0
    """Chi-square, two degrees of freedom, from which the blur depends on direction (3e-7 by chance)."""
    anisotropic: float = 0.1
    """Share of the blur's variance that it must have to be fitted."""


class NoiseSettings(NamedTuple):
    """Noise as the image shows it."""

    reach: int = 5
    """Lag, px, at which noise no longer counts as correlated: a scintillator's or an interpolation's ends before."""
    significant: float = 3.5
    """Standard deviations by which a neighbour's correlation must differ from 0 before noise counts as correlated."""
    smallest: float = 0.06
    """Correlation of neighbours below which noise counts as white: a holder leaves some in the residuals too.
    Tuned; flat from 0.04 to 0.09."""
    leak: int = 3
    leak_pixels: int = 50
    """Distance from the rim, px, within which noise is measured px by px, and the pixels that this takes."""
    clipped: float = 0.25
    """Share of the lower quartile below which a sector's variance is that of a saturated background."""
    kept: float = 1.5
    """Standard deviations above their mean up to which sectors' variances count as noise: chance cuts 7 %."""
    enough_quiet: int = 200
    """Pixels in sectors that fit well from which noise is taken from them alone."""
    fewest_pixels: int = 60
    """Pixels below which the noise's correlation cannot be measured."""
    rare: float = 0.1
    """Prior share of sets of residuals that hold more than noise.  Tuned; flat from 0.03 to 0.3."""


class RingTestSettings(NamedTuple):
    """The comparison with smaller rings."""

    implausible: float = 4.0
    """Chi-square of the difference by its two degrees of freedom from which a ring is too large: 2 % by chance."""
    remaining: float = 0.5
    """Share of D D' that is added to the smaller ring's covariance, for what its own background leaves out.
    Tuned; flat from 0.25 to 1."""


class SectorTestSettings(NamedTuple):
    """The comparison with a fit that gives misfitting sectors less weight."""

    cell: float = 3.0
    """Height of a cell, px from the rim (times blur / sharp), the distance over which an edge is felt."""
    parts: int = 3
    """Cells that share a sector's width."""
    trusted: float = 0.6
    """Where every sector keeps this share of its weight, there is no second fit.  Tuned; flat from 0.4 to 0.8."""
    turns: int = 2
    """A sector that misfits spoils its neighbours: they are judged once more without it."""
    negligible: float = 0.02
    """Share of the first covariance, added to V, below which a D D' proves nothing."""


class FlagSettings(NamedTuple):
    """When a row gets a warning, or is refused."""

    whole_rim: float = 0.985
    """Visible share of the rim below which it is truncated: the bins of 2 degrees are filled by chance to 0.99."""
    lost: float = 0.01
    """Share of the rim's pixels that may be left out without a word."""
    most_lost: float = 0.5
    saturated: float = 0.02
    mostly_saturated: float = 0.3
    """Share of the background along the rim that is clipped, for a word and for a refusal."""
    noise_free: float = 1e-4
    """Noise, in contrasts, below which an image counts as calculated without noise."""
    few: float = 15.0
    """Contrast over noise below which photons are few: the finder's limit is near 5."""
    doubted: float = 0.4
    """Share of the centre's variance from which edges at the rim are reported."""
    off_nominal: float = 0.2
    """Relative deviation from the nominal radius in one image: magnification varies with the pose."""
    motion: float = 0.5
    """Shortest motion that is reported, px: a uniform motion by L adds L^2 / 12 to the blur's variance along it."""
    motion_widths: float = 0.7
    """And in widths of the blur: a shorter one adds less than 2 % to its variance, which corrections of pixels and
    scintillators do as well."""
    worst_sigma: float = 0.5
    """A centre less certain than this, px, is not a measurement."""
    worst_rim: float = 0.3
    """Residual on the rim, in contrasts, of what still counts as a ball."""
    least_visible: float = 0.5
    """Share of the rim that must be visible."""


class RunSettings(NamedTuple):
    """Rules that need the whole run."""

    enough: int = 5
    """From this many measured images on, one is compared with the others."""
    other_size: float = 1.5
    """Ratio to the run's median radius from which a shape is not the ball: magnification does not vary that much."""
    most_unusable: float = 0.05
    """Share of images that cannot be read or are not valid, above which a run stops; one in a short run is accepted."""
    off: float = 0.02
    far_off: float = 0.2
    """Relative distance of the nominal radius from all that the run shows, from which it is flagged, or wrong."""
    lag_significant: float = 6.0
    """Standard deviations from which the previous ball counts as visible."""
    lag_smallest: float = 0.002
    """Share of the contrast below which the previous ball has no effect."""


@dataclass(frozen=True, kw_only=True)
class DetectionSettings:
    """All of them; the defaults are what the documentation's figures were measured with."""

    finder: FinderSettings = field(default_factory=FinderSettings)
    ring: RingSettings = field(default_factory=RingSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    ring_test: RingTestSettings = field(default_factory=RingTestSettings)
    sector_test: SectorTestSettings = field(default_factory=SectorTestSettings)
    flags: FlagSettings = field(default_factory=FlagSettings)
    run: RunSettings = field(default_factory=RunSettings)


DEFAULT = DetectionSettings()
