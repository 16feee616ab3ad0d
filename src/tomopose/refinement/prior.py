r"""What is known of the views' motions before the images are asked, and how large they are by the evidence.

The covariance of all motions q (6 n) is a sum of parts, each of a known pattern and an unknown size:

    C = sum_i s_i^2 K_i.

Without a calibration the parts are the scatter of the views, translations and turns apart; with one, its own shared
part (correlated over all views) joins them.  The sizes follow from the data by the fixed point of the evidence (MacKay,
Neural Computation 4 (1992) 415): s_i^2 is the mean square of the motions in part i plus what the images leave of it
unknown.  A part whose motions the images find no larger than their own uncertainty shrinks: a right geometry stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.units import Array

LEAST = 5e-3
"""Smallest size of a part, relative to where it began: of 1 px it leaves less than the images' own uncertainty, and the
covariance of slow parts keeps an inverse."""
SHARED = "shared by all views, of the calibration"
JUMP = 3.0
"""Rms of a view's six coordinates, in standard deviations of the prior, from which it is one of its own: of a right
prior one view in 10^9 is beyond."""
LARGEST = 10.0
"""Largest: what was stated is not exceeded tenfold by evidence alone."""


@dataclass(frozen=True, kw_only=True)
class Prior:
    """parts: name -> pattern K_i (6n, 6n), at the size that was stated; sizes: s_i, relative to it; widths: (6n,)
    factors on the standard deviations, above 1 for views that jump."""

    names: tuple[str, ...]
    parts: tuple[Array, ...]
    sizes: Array
    widths: Array

    @property
    def covariance(self) -> Array:
        """C (6n, 6n)."""
        C: Array = sum((s**2 * K for s, K in zip(self.sizes, self.parts, strict=True)), np.zeros_like(self.parts[0]))
        return np.asarray(self.widths[:, None] * C * self.widths)

    @property
    def precision(self) -> Array:
        """C^-1 (6n, 6n)."""
        return np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    @property
    def blocks(self) -> Array:
        """C of each view alone (n, 6, 6)."""
        C = self.covariance
        n = len(C) // 6
        return np.asarray(C.reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)])

    @property
    def stated(self) -> Prior:
        """The prior at the sizes that were stated."""
        return replace(self, sizes=np.ones(len(self.sizes)), widths=np.ones(len(self.widths)))

    def size_px(self, K: Array) -> float:
        """Rms standard uncertainty, px per coordinate, where K (n, m, 2, 6) is px per motion."""
        return float(np.sqrt(np.mean(np.einsum("nmic,ncd,nmid->nmi", K, self.blocks, K))))

    def of_views(self, rows: npt.NDArray[np.int_]) -> Prior:
        """The prior of some views alone."""
        at = (6 * np.asarray(rows)[:, None] + np.arange(6)).ravel()
        return replace(self, parts=tuple(K[np.ix_(at, at)] for K in self.parts), widths=self.widths[at])

    def with_jumps(self, q: Array) -> Prior:
        """Views whose motion (n, 6) is beyond `JUMP` standard deviations get a prior as wide as it."""
        blocks = self.blocks
        z = np.sqrt(np.einsum("nc,ncd,nd->n", q, np.linalg.inv(blocks), q) / q.shape[1])
        return replace(self, widths=self.widths * np.repeat(np.where(z > JUMP, z, 1.0), q.shape[1]))

    def by_evidence(self, q: Array, information: Array, *, most: float = np.inf, turns: int = 20) -> Prior:
        """The sizes that explain motions q (n, 6) best, given the images' information N (6n, 6n) about them.

        most: factor by which a size may change.  Once sizes are small, C^-1 q magnifies what the fit has not yet
        reached, so that a later look corrects the first one but does not replace it.
        """
        prior, flat = self, q.ravel()
        right = information @ flat + self.precision @ flat  # the estimate is where N q_data = this
        for _ in range(turns):
            C = prior.covariance
            precision = np.linalg.inv(C)
            posterior = np.linalg.inv(information + precision)
            mean = posterior @ right
            pull = precision @ mean
            spread = precision - precision @ posterior @ precision
            sizes = []
            pull, spread = pull * self.widths, self.widths[:, None] * spread * self.widths
            for s, K in zip(prior.sizes, prior.parts, strict=True):
                explained = float(pull @ K @ pull)
                expected = float(np.einsum("ij,ji->", spread, K))
                ratio = explained / expected if expected > 0 else 1.0
                sizes.append(s * np.clip(ratio, 0.1, 10.0) ** 0.5)
            new = np.clip(np.clip(sizes, self.sizes / most, self.sizes * most), LEAST, LARGEST)
            done = np.all(np.abs(np.log(new / prior.sizes)) < 0.01)
            prior = replace(prior, sizes=new)
            if done:
                break
        return prior


def with_shared_errors(prior: Prior, L: Array, C: Array) -> Prior:
    """The prior with errors that all views share: L (n, 6, c) motions by each parameter, C (c, c) their covariance."""
    flat = L.reshape(-1, L.shape[2])
    return replace(
        prior,
        names=(*prior.names, SHARED),
        parts=(*prior.parts, flat @ C @ flat.T),
        sizes=np.append(prior.sizes, 1.0),
    )


def scatter(sigma_mm: Array, sigma_rad: Array) -> Prior:
    """Independent views: standard uncertainties (n,) of each coordinate's translation, mm, and turn, rad."""
    n = len(sigma_mm)
    parts = []
    for column, sigma in ((slice(0, 3), sigma_mm), (slice(3, 6), sigma_rad)):
        variance = np.zeros((n, 6))
        variance[:, column] = np.asarray(sigma)[:, None] ** 2
        parts.append(np.diag(variance.ravel()))
    return Prior(
        names=("shift from view to view", "turn from view to view"),
        parts=tuple(parts),
        sizes=np.ones(2),
        widths=np.ones(6 * n),
    )
