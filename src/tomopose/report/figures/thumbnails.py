"""Crops of radiographs with the silhouette that was found, drawn as a picture with a vector overlay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import ShapeError
from tomopose.observations import BallObservations
from tomopose.report.figures.png import data_uri, grey_levels, grey_png
from tomopose.report.words import number
from tomopose.units import Array, float_array
from tomopose.values import Images

OUTLINE_POINTS = 120
MARGIN = 0.35
"""Width of the surroundings shown, in semi-major axes."""
FALLBACK_HALF_WIDTH = 60
LARGEST_PICTURE = 220
"""Longest side of an embedded picture, px; larger crops are thinned."""


@dataclass(frozen=True, kw_only=True)
class Thumbnail:
    """One detection as a picture.

    crop:    image[v, u], row 0 at the *bottom* like everywhere in the package.
    origin:  (u, v) of crop[0, 0], px in D.
    outline: (m, 2) px in D, the silhouette found; empty where none was.
    centre:  (u, v) of the ball's projected centre, or None.
    """

    pose_id: str
    crop: Array
    origin: tuple[float, float]
    outline: Array
    status: str = "ok"
    text: str = ""
    centre: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        crop = np.array(self.crop)
        if crop.ndim != 2 or crop.size == 0:
            raise ShapeError(f"thumbnail of pose {self.pose_id!r}: a crop [v, u] is needed; got shape {crop.shape}")
        crop.setflags(write=False)
        object.__setattr__(self, "crop", crop)
        object.__setattr__(self, "outline", float_array(np.reshape(self.outline, (-1, 2))))


def ellipse_outline(centre: ArrayLike, semi_major: float, semi_minor: float, angle: float) -> Array:
    """Points (m, 2), px, of an ellipse whose major axis makes `angle` (rad) with the u axis, closed."""
    phase = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS)
    major = np.array([np.cos(angle), np.sin(angle)])
    minor = np.array([-major[1], major[0]])
    result: Array = (
        np.asarray(centre, dtype=np.float64)
        + semi_major * np.cos(phase)[:, None] * major
        + semi_minor * np.sin(phase)[:, None] * minor
    )
    return result


def thumbnail(observations: BallObservations, k: int, image: ArrayLike, *, text: str = "") -> Thumbnail:
    """The thumbnail of row k from its image [v, u] (whole frame, row index = v).

    Without a silhouette in the observations the crop is centred on the observed ball, or is the whole image.
    """
    image = np.asarray(image)
    if image.ndim != 2:
        raise ShapeError(f"image of pose {observations.pose_id[k]!r} has shape {image.shape}; image[v, u] is needed")
    centre, x_D = _row(observations.x_ellipse, k), observations.x_D[k]
    middle = x_D if centre is None or not np.isfinite(centre).all() else centre
    a, b, angle = (
        float("nan") if column is None else float(column[k])
        for column in (observations.semi_major, observations.semi_minor, observations.angle)
    )
    found = bool(np.isfinite(middle).all() and np.isfinite([a, b]).all())
    outline = ellipse_outline(middle, a, b, angle if np.isfinite(angle) else 0.0) if found else np.empty((0, 2))
    n_v, n_u = image.shape
    u_low, u_high, v_low, v_high = 0, n_u, 0, n_v
    if np.isfinite(middle).all():
        half = a * (1.0 + MARGIN) if found else FALLBACK_HALF_WIDTH
        u_low, u_high = _span(middle[0], half, n_u)
        v_low, v_high = _span(middle[1], half, n_v)
    status = observations.status[k] if observations.status is not None else "ok"
    return Thumbnail(
        pose_id=observations.pose_id[k],
        crop=image[v_low:v_high, u_low:u_high],
        origin=(u_low, v_low),
        outline=outline,
        status=status,
        text=text,
        centre=(float(x_D[0]), float(x_D[1])) if np.isfinite(x_D).all() else None,
    )


def _row(column: Array | None, k: int) -> Array | None:
    return None if column is None else column[k]


def _span(middle: float, half: float, n: int) -> tuple[int, int]:
    """A range of pixels inside 0 .. n that holds at least one pixel."""
    low = int(np.clip(np.floor(middle - half), 0, n - 1))
    return low, int(np.clip(np.ceil(middle + half) + 1, low + 1, n))


def worst_first(d: ArrayLike, seen: ArrayLike) -> list[int]:
    """Row indices: those without a measurement first, then by falling d (px)."""
    d = np.where(np.asarray(seen, dtype=bool), np.nan_to_num(np.asarray(d, dtype=np.float64), nan=0.0), np.inf)
    return [int(i) for i in np.argsort(-d, kind="stable")]


def worst_thumbnails(
    observations: BallObservations,
    images: Images,
    *,
    residuals: Mapping[str, float] | None = None,
    count: int = 12,
) -> tuple[Thumbnail, ...]:
    """Pictures of the worst detections, worst first.

    images:    image[v, u] of each row of `observations`; only those shown are read.
    residuals: d_k in px by pose id; without them the largest uncertainty counts as worst.
    """
    if len(images) != len(observations):
        raise ShapeError(f"{len(observations)} observations but {len(images)} images")
    sigma = np.linalg.norm(observations.sigma, axis=1)
    if residuals is None:
        order = worst_first(sigma, observations.seen)
    else:
        order = worst_first([residuals.get(p, np.inf) for p in observations.pose_id], observations.seen)
    made = []
    for k in order[:count]:
        d = None if residuals is None else residuals.get(observations.pose_id[k])
        known = "" if not np.isfinite(sigma[k]) else f"σ = {number(sigma[k])} px"
        text = known if d is None else f"d = {number(d)} px"
        made.append(thumbnail(observations, k, images[k], text=text))
    return tuple(made)


def _path(points: Array) -> str:
    return "M" + "L".join(f"{x:.2f},{y:.2f}" for x, y in points) + "Z"


def thumbnail_svg(thumbnail: Thumbnail) -> str:
    """The picture with its overlay: pixel (u, v) becomes x = u - u_origin + 1/2 from the left, with v upwards."""
    height, width = thumbnail.crop.shape
    step = max(1, -(-max(height, width) // LARGEST_PICTURE))
    rows = grey_levels(thumbnail.crop[::step, ::step])[::-1]
    # The thinned picture covers whole steps, so the topmost one may reach above the crop.
    covered_v, covered_u = rows.shape[0] * step, rows.shape[1] * step

    def place(points: Sequence[Sequence[float]] | Array) -> Array:
        x = np.asarray(points, dtype=np.float64) - thumbnail.origin
        return np.column_stack([x[:, 0] + 0.5, covered_v - 0.5 - x[:, 1]])

    stroke = max(covered_u, covered_v) / 160.0
    parts = [
        f'<svg viewBox="0 0 {covered_u} {covered_v}" role="img" aria-label="radiograph of pose">',
        f'<image href="{data_uri(grey_png(rows))}" width="{covered_u}" height="{covered_v}" '
        'preserveAspectRatio="none"/>',
    ]
    if len(thumbnail.outline):
        parts.append(f'<path class="outline" d="{_path(place(thumbnail.outline))}" stroke-width="{stroke:.2f}"/>')
    if thumbnail.centre is not None:
        x, y = place([thumbnail.centre])[0]
        arm = 5.0 * stroke
        parts.append(
            f'<path class="centre" d="M{x - arm:.2f},{y:.2f}H{x + arm:.2f}M{x:.2f},{y - arm:.2f}V{y + arm:.2f}" '
            f'stroke-width="{stroke:.2f}"/>'
        )
    return "".join([*parts, "</svg>"])
