"""What detection says about one image."""

from __future__ import annotations

from tomopose.detection.finder.find import Candidate
from tomopose.units import Array
from tomopose.values import value


@value
class BallImage:
    """The ball in one radiograph; positions in D, px.

    x_D, covariance:   projection of the ball's centre (2,), and (2, 2) px^2.
    radius, sigma_radius:  of the silhouette, mean over directions, px.
    x_ellipse, semi_major, semi_minor, angle:  the silhouette's ellipse (px, px, rad from u).
    snr:               contrast over the background's standard deviation.
    blur:              standard deviation of the edge's blur, pixel included, px.
    kappa:             total attenuation along the diameter; inf for a ball that counts as opaque.
    visible, lost:     share of the rim inside the image; share of its pixels that were bad.
    misfit:            share of the rim along which a holder's edge is not described by the background's model.
    anisotropy, anisotropy_covariance:  blur variance by direction, (cos 2 psi, sin 2 psi) parts, px^2.
    correlated:        whether neighbouring pixels' noise is correlated (and the covariance says so).
    level, white:      background and ball level, in the image's values.
    flags:             see flags.FLAGS; status: "ok" or the flags in words.
    candidates:        what else looked like a ball, best first (positions in D).
    """

    x_D: Array
    covariance: Array
    radius: float
    sigma_radius: float
    x_ellipse: Array
    semi_major: float
    semi_minor: float
    angle: float
    snr: float
    blur: float
    kappa: float
    visible: float
    lost: float
    misfit: float
    anisotropy: Array
    anisotropy_covariance: Array
    correlated: bool
    level: float
    white: float
    flags: tuple[str, ...]
    candidates: tuple[Candidate, ...]

    @property
    def status(self) -> str:
        return "; ".join(self.flags) if self.flags else "ok"
