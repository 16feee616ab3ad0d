"""What governs a refinement: each threshold beside its reason."""

from __future__ import annotations

from dataclasses import dataclass

from tomopose.errors import InputError

DEFAULT_SIGMA_PX = 1.0
"""Standard uncertainty of a view, px, where neither the calibration nor the matrices state one: a robot's scatter of
20 to 100 um at a magnification of 5 and pixels of 0.2 mm.  The evidence changes it."""

SIGNIFICANCE = 3.0
"""Standard errors by which the blocks kept out of the fit must gain before a correction is taken.  On benchmarks/refine
right geometries gain -1.1 to 1.2 (with beam hardening too), one view that jumps by 0.7 px gains 12, scatter hundreds:
flat from 1.5 to 12."""

OWN_SIGMA = 2.0
"""Rms correction over its own standard uncertainty from which it is taken.  A correction q of uncertainty sigma
replaces an error of mean square q^2 - sigma^2 by one of sigma^2: it gains from sqrt(2) on."""

MISFIT = 2.0
"""Residual over noise beyond which the model does not hold, where the residual is also larger than `MISFIT_SHARE`.  On
the scans of benchmarks/refine honest cases end at 0.91 to 1.02 (binned by 2 or with beam hardening: up to 1.4), the
object that the view cuts on all sides at 174.  Beyond it a kept correction says that its uncertainty does not hold:
benchmarks/section6/refined.py ends at 14, with an error of 6 times the stated one."""
MISFIT_SHARE = 0.02
"""Rms residual over the rms line integral below which no misfit is large: finer than any voxel grid models an edge."""

LEAST_PIXELS = 40
"""Pixels of an image, along its shorter side, below which no level is fitted: at 27 pixels the steps of a step cylinder
led away from its minimum."""
MOST_SAMPLES = 2e9
"""Samples along all rays of a scan up to which a level is fitted: about a minute for each conjugate gradient on two
processors.  Images of more pixels hold little more about the poses than those binned to this size."""

MODEL_ERROR = 1.6
"""Factor on the stated standard uncertainty for what neither noise nor the residual shows: the volume takes up errors
that its own grid makes.  Tuned on benchmarks/refine (white scatter): without it the errors are 0.98 (balls), 1.55 (step
cylinder) and 2.20 (ellipsoids of low contrast) times what is stated."""

IMAGE_COPIES = 22
"""float32 images alive for each view of a level: seven derivatives, six of them once more while they are put together,
and the data, weights, residuals and projections."""
VOLUME_COPIES = 12
"""float32 volumes of a level: unknown, step, directions, their transforms, masks."""

UNDETERMINED = 0.6
"""Posterior over prior standard uncertainty from which a direction counts as not determined by the images: the images
then hold less than twice the information that the prior had."""

OPEN_PX = 0.1
"""Px that an open direction leaves uncertain from which the correction is refused.  Less keeps the prior's value: a
view's depth, which hardly moves a pixel, is open in most scans."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """How the images are matched.

    levels:    binning of images and grid, coarse to fine; None: 4, 2, 1 where 40 pixels remain and the work allows it.
    steps:     most Gauss-Newton steps on a level.
    turns:     conjugate gradients in a step.
    held_out:  share of the pixels, in blocks, that judges the result and takes no part in the fit.
    sigma_px:  prior standard uncertainty of a view where nothing states one; None: what the matrices state, else 1 px.
    samples:   draws of noise from which the uncertainty with the volume unknown is estimated.
    threads:   processors to use; None for all.
    client:    a dask.distributed client: its workers take the projections, with the same bytes.
    seed:      of the held-out blocks and the draws.
    memory_gib: memory to keep within, by leaving out levels that are too fine for it; what is free unless given.
    """

    levels: tuple[int, ...] | None = None
    steps: int = 8
    turns: int = 12
    held_out: float = 0.08
    sigma_px: float | None = None
    samples: int = 4
    threads: int | None = None
    client: object | None = None
    seed: int = 0
    memory_gib: float | None = None

    def __post_init__(self) -> None:
        if self.levels is not None and (not self.levels or any(int(f) != f or f < 1 for f in self.levels)):
            raise InputError(f"levels are {self.levels!r}; positive whole binning factors are needed")
        if not 0.01 <= self.held_out <= 0.5:
            raise InputError(f"held_out is {self.held_out!r}; a share from 0.01 to 0.5 is needed")
        if self.sigma_px is not None and not 0 < self.sigma_px < float("inf"):
            raise InputError(f"sigma_px is {self.sigma_px!r}; a positive number of pixels is needed")
        for name, least in (("steps", 1), ("turns", 1), ("samples", 4)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)!r}; at least {least} is needed")
