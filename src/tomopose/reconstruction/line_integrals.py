"""From images as they come to line integrals of the attenuation, one view at a time, with every fault named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import ArrayLike

from tomopose.errors import ConventionError, InputError, ShapeError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.values import Images, value

ImagesAre = Literal["transmission", "line-integrals", "counts"]
KINDS = ("transmission", "line-integrals", "counts")
LARGEST_HOLE = 25
"""Widest window, px, in which good neighbours of a bad pixel are looked for."""


@value
class Correction:
    """How an image becomes line integrals.

    images_are:   "transmission" I/I_0, "line-integrals" -ln(I/I_0), or "counts" I with white level and dark; None where
                  the image sequence says it.
    white, dark:  counts without object and without beam: numbers or images (n_v, n_u).
    bad_pixels:   (n_v, n_u) bool: pixels without a say, in every view.
    invalid:      what to do with NaN, infinite and non-positive pixels elsewhere: "error", or "exclude" them from
                  their view as if they were bad.
    beam_hardening: coefficients c_1, c_2 ... of p' = c_1 p + c_2 p^2 + ..., rising over the data.
    ring_width:   window (px, odd) of `ring_offset`, by which rings are found; None for none.
    rings:        (n_v, n_u) offset that is subtracted from every view, as `ring_offset` finds it; None for none.
    """

    images_are: ImagesAre | None = None
    white: Any = None
    dark: Any = 0.0
    bad_pixels: Any = None
    invalid: Literal["error", "exclude"] = "error"
    beam_hardening: tuple[float, ...] = ()
    ring_width: int | None = None
    rings: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.images_are is not None and self.images_are not in KINDS:
            raise ConventionError(f"images_are is {self.images_are!r}; one of {', '.join(KINDS)} is needed")
        if self.images_are is not None and (self.images_are == "counts") != (self.white is not None):
            raise ConventionError(
                "a white level is needed where images are counts, and only there "
                f"(images_are={self.images_are!r}, white level {'given' if self.white is not None else 'missing'})"
            )
        if self.invalid not in ("error", "exclude"):
            raise InputError(f"invalid is {self.invalid!r}; 'error' or 'exclude' is needed")
        object.__setattr__(self, "beam_hardening", tuple(float(c) for c in self.beam_hardening))

    @property
    def described(self) -> dict[str, object]:
        """In words and numbers, for a volume's settings."""
        return {
            "images_are": self.images_are,
            "invalid": self.invalid,
            "beam_hardening": list(self.beam_hardening),
            "ring_width": self.ring_width,
        }


def images_kind(images: Any, images_are: ImagesAre | None) -> ImagesAre:
    """What the images are: as said, or as the sequence itself says; never guessed."""
    own = getattr(images, "images_are", None)
    if images_are is None and own is None:
        raise ConventionError(
            'say what the images hold: images_are="transmission" (I/I_0), "line-integrals" (-ln I/I_0) or "counts" '
            "(with white=...)"
        )
    if images_are is not None and own is not None and images_are != own:
        raise ConventionError(f"images_are is {images_are!r} but the image sequence says {own!r}")
    return images_are if images_are is not None else own  # type: ignore[return-value]


def hole_filler(bad: np.ndarray) -> Any:
    """(n_bad, n_pixels): each bad pixel as the mean of the good ones in the smallest window that holds at least three.

    InputError where a hole is wider than `LARGEST_HOLE`.
    """
    n_v, n_u = bad.shape
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    for i, (v, u) in enumerate(np.argwhere(bad)):
        for half in range(1, LARGEST_HOLE // 2 + 1):
            window = np.s_[max(0, v - half) : v + half + 1, max(0, u - half) : u + half + 1]
            good = np.argwhere(~bad[window]) + [window[0].start, window[1].start]
            if len(good) >= 3:
                break
        else:
            raise InputError(
                f"around pixel u={u}, v={v} a hole of more than {LARGEST_HOLE} bad pixels has no good neighbour; "
                "crop the images or correct the bad-pixel map"
            )
        rows += [i] * len(good)
        columns += [int(a) * n_u + int(b) for a, b in good]
        values += [1 / len(good)] * len(good)
    operator: Any = scipy.sparse.coo_matrix(
        (np.array(values), (np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp))),
        shape=(int(bad.sum()), n_u * n_v),
    )
    return operator.tocsr().astype(np.float32)


class LineIntegrals:
    """The views of a scan as line integrals, (n_v, n_u) float32, read and checked when they are asked for.

    Every fault is an InputError that names the view, how many pixels, and what to do.
    """

    def __init__(self, images: Images, matrices: ProjectionMatrices, correction: Correction) -> None:
        if not hasattr(images, "__len__"):
            raise InputError("the images need a length; give a list, an array (n, n_v, n_u) or open_images(...)")
        if len(images) != len(matrices):
            raise InputError(
                f"wrong count: {len(images)} images but {len(matrices)} projection matrices; every view needs one of "
                "each, in the same order (matrices.select(...) leaves views out)"
            )
        self._images, self.matrices, self.correction = images, matrices, correction
        shape = (matrices.n_v, matrices.n_u)
        self._white = None if correction.white is None else self._level("white level", correction.white, shape)
        self._dark = self._level("dark level", correction.dark, shape)
        bad = correction.bad_pixels
        self._bad = np.zeros(shape, dtype=bool) if bad is None else np.asarray(bad)
        if self._bad.shape != shape or self._bad.dtype != np.bool_:
            raise ShapeError(f"bad_pixels are {self._bad.dtype} {self._bad.shape}; bool {shape} (n_v, n_u) is needed")
        self._fill = hole_filler(self._bad)
        if correction.rings is not None and correction.rings.shape != shape:
            raise ShapeError(f"the ring offset is {correction.rings.shape}; {shape} (n_v, n_u) is needed")

    def __len__(self) -> int:
        return len(self.matrices)

    @staticmethod
    def _level(name: str, value: object, shape: tuple[int, int]) -> np.ndarray:
        level = np.asarray(value, dtype=np.float32)
        if level.shape not in ((), shape):
            raise ShapeError(f"the {name} is {level.shape}; a number or an image {shape} (n_v, n_u) is needed")
        if not np.isfinite(level).all():
            raise InputError(f"the {name} holds {np.count_nonzero(~np.isfinite(level))} values that are not finite")
        return level

    def raw(self, j: int) -> np.ndarray:
        """Image j as it is, its shape checked."""
        image = np.asarray(self._images[j])
        expected = (self.matrices.n_v, self.matrices.n_u)
        if image.shape != expected:
            hint = ""
            if image.shape == expected[::-1]:
                hint = "; rows and columns are exchanged: image[v, u] is needed"
            else:
                factors = [f for f in range(2, 9) if image.shape == (expected[0] // f, expected[1] // f)]
                hint = f"; the images look binned: use matrices.binned({factors[0]})" if factors else ""
            raise ShapeError(
                f"wrong size: image {j} is {image.shape}, the matrices are for {expected} (n_v, n_u){hint}"
            )
        if image.dtype.kind not in "uif":
            raise InputError(f"image {j} holds {image.dtype}; real numbers are needed")
        return image

    def view(self, j: int) -> tuple[np.ndarray, np.ndarray, Any]:
        """(line integrals, which pixels have no say, the operator that fills those from their neighbours)."""
        image = self.raw(j).astype(np.float32)
        kind = self.correction.images_are
        if kind == "counts":
            with np.errstate(divide="ignore", invalid="ignore"):
                image = (image - self._dark) / (np.asarray(self._white) - self._dark)
        valid = np.isfinite(image) if kind == "line-integrals" else np.isfinite(image) & (image > 0)
        bad, fill = self._bad, self._fill
        wrong = ~valid & ~bad
        if wrong.any():
            if self.correction.invalid == "error":
                v, u = np.argwhere(wrong)[0]
                what = "NaN or infinite" if not np.isfinite(image[v, u]) else "not positive"
                raise InputError(
                    f"image {j}: {np.count_nonzero(wrong)} pixels are {what}, the first at u={u}, v={v}; name them in "
                    'bad_pixels, or pass invalid="exclude" to leave them out of their view'
                )
            bad = bad | wrong
            if bad.mean() > 0.5:
                raise InputError(f"image {j}: {np.count_nonzero(bad)} of {bad.size} pixels are unusable")
            fill = hole_filler(bad)
        if bad.any():
            image[bad] = 1.0
        p = image if kind == "line-integrals" else -np.log(image)
        if self.correction.rings is not None:
            p = p - self.correction.rings
        if self.correction.beam_hardening:
            p = linearised(p, self.correction.beam_hardening, j)
        if bad.any():
            p[bad] = fill @ np.where(bad, 0, p).ravel()
        return p, bad, fill

    def __getitem__(self, j: int) -> np.ndarray:
        return self.view(j)[0]

    def contrast(self, j: int) -> float:
        """Range of view j between its 1st and 99.5th percentile."""
        low, high = np.percentile(self[j][::2, ::2], [1.0, 99.5])
        return float(high - low)


def require_contrast(scan: LineIntegrals, probe: Sequence[int]) -> None:
    """InputError where none of a few views shows anything: blank images, or open beam only."""
    ranges = [scan.contrast(j) for j in probe]
    if max(ranges) < 1e-3:
        raise InputError(
            f"no contrast: line integrals vary by {max(ranges):.2g} at most over {len(ranges)} views looked at; are "
            "these radiographs of an object, and is images_are right?"
        )
    if scan.correction.images_are == "transmission":
        darkest = max(float(-np.percentile(scan[j][::2, ::2], 0.5)) for j in probe)
        if darkest > np.log(10.0):
            raise InputError(
                f"transmissions reach {np.exp(darkest):.4g}, above 10: these look like counts; pass "
                'images_are="counts" with white=...'
            )


def linearised(p: np.ndarray, coefficients: Sequence[float], j: int) -> np.ndarray:
    """p' = c_1 p + c_2 p^2 + ...; InputError where the polynomial does not rise over the view's range."""
    grid = np.linspace(min(float(p.min()), 0.0), float(p.max()), 200)
    slope = sum((i + 1) * c * grid**i for i, c in enumerate(coefficients))
    if not (np.asarray(slope) > 0).all():
        raise InputError(
            f"the beam-hardening polynomial does not rise over the line integrals of view {j} ({grid[0]:.3g} to "
            f"{grid[-1]:.3g}); fit it over the object's whole thickness"
        )
    result = np.zeros_like(p)
    for c in reversed(coefficients):
        result = (result + np.float32(c)) * p
    return result


def beam_hardening_polynomial(
    energies_keV: ArrayLike,
    fluence: ArrayLike,
    attenuation_per_mm: ArrayLike,
    *,
    thickness_mm: float,
    reference_keV: float | None = None,
    degree: int = 3,
) -> tuple[float, ...]:
    """Coefficients c_1 ... of the polynomial that takes polychromatic line integrals of one material to monochromatic.

    energies_keV, fluence, attenuation_per_mm: (m,), the spectrum as the detector weights it and the material's
    attenuation coefficient.  Fitted by least squares up to `thickness_mm`; the reference energy is the mean of the
    unfiltered spectrum unless given, so that the result is mu(reference) times the length (Herman, Phys. Med. Biol. 24
    (1979) 81, for the idea).
    """
    energies, fluence, mu = (np.asarray(a, dtype=np.float64) for a in (energies_keV, fluence, attenuation_per_mm))
    if not energies.shape == fluence.shape == mu.shape or energies.ndim != 1:
        raise ShapeError(f"spectrum and attenuation differ: {energies.shape}, {fluence.shape}, {mu.shape}")
    if not (thickness_mm > 0 and degree >= 1 and fluence.sum() > 0 and (mu > 0).all()):
        raise InputError("positive thickness, degree, fluence and attenuation are needed")
    weights = fluence / fluence.sum()
    reference = float((weights * energies).sum()) if reference_keV is None else reference_keV
    mu_reference = float(np.interp(reference, energies, mu))
    length = np.linspace(0, thickness_mm, 400)[1:]
    p = -np.log(np.exp(-length[:, None] * mu) @ weights)
    powers = p[:, None] ** np.arange(1, degree + 1)
    coefficients, *_ = np.linalg.lstsq(powers, mu_reference * length, rcond=None)
    return tuple(float(c) for c in coefficients)


def ring_offset(scan: LineIntegrals, *, width: int = 15) -> np.ndarray:
    """(n_v, n_u): what each pixel reads too high on average over all views, against a median over `width` pixels.

    A fault of a pixel stays in place on the detector while the object moves, so that it shows in the mean of all views.
    """
    if width < 3 or width % 2 == 0:
        raise InputError(f"the ring filter's width is {width}; an odd number of pixels from 3 on is needed")
    mean = np.zeros((scan.matrices.n_v, scan.matrices.n_u))
    for j in range(len(scan)):
        mean += scan[j]
    mean /= len(scan)
    return np.asarray(mean - scipy.ndimage.median_filter(mean, size=(1, width)), dtype=np.float32)
