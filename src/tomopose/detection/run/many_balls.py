"""Radiographs that show several balls: all of them found and measured, not yet identified."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import partial

from tomopose.detection.finder.find import Candidate, find_balls, refuse_hidden
from tomopose.detection.flags import expected_radius
from tomopose.detection.image import checked_diameter, measured_ball
from tomopose.detection.reading import Image, Mask, Pixels, checked_shape, read_pixels
from tomopose.detection.result import BallImage
from tomopose.detection.run.executors import ordered_map
from tomopose.detection.run.rows import LazyImage
from tomopose.detection.settings import DEFAULT, DetectionSettings
from tomopose.errors import DetectionError, InputError, TomoposeError
from tomopose.geometry.scanner import Scanner
from tomopose.values import require_types

CLEAR_PX = 6.0
"""Width of the ring outside a rim that the fit needs free of another ball: the blur's width on either side and the
nodes of its background; tuned on simulated standards, flat from 4 to 10 px."""
SAME_SIZE = math.log(1.05)


@dataclass(frozen=True, kw_only=True)
class BallsInImage:
    """What one radiograph shows.

    balls:    those measured.
    left_out: a sentence for each circle that was found and not measured: overlapping, truncated, not a ball.
    fault:    why the image could not be read; "" where it could.
    """

    balls: tuple[BallImage, ...]
    left_out: tuple[str, ...] = ()
    fault: str = ""


@require_types
def detect_balls(
    images: Iterable[Image],
    scanner: Scanner,
    *,
    ball_diameters: Sequence[float],
    mask: Mask = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    settings: DetectionSettings = DEFAULT,
) -> list[BallsInImage]:
    """All balls of an object in each radiograph.

    Parameters
    ----------
    images:         arrays [v, u], or a lazy sequence as of `detect`.
    scanner:        intrinsic geometry; its magnification gives the radii that are looked for.
    ball_diameters: nominal, mm, of all balls of the object.
    mask:           bool [v, u], true for bad pixels.
    workers:        processes.

    Balls whose images overlap, or come nearer to one another than CLEAR_PX, are left out, both: their rims are not
    whole.  Which ball is which is not decided here.

    Raises InputError where no image can be read.
    """
    diameters = [checked_diameter(float(d)) for d in ball_diameters]
    if not diameters:
        raise InputError("ball_diameters is empty; give the diameter of each ball of the object")
    total = len(images) if isinstance(images, Sized) else 0

    def tasks() -> Iterator[tuple[Image]]:
        if hasattr(images, "region") and total:
            yield from ((LazyImage(images, i),) for i in range(total))
        else:
            yield from ((image,) for image in images)

    found: list[BallsInImage] = []
    work = partial(balls_of, scanner=scanner, diameters=diameters, mask=mask, settings=settings)
    for _, balls in ordered_map(work, tasks(), workers=workers):
        found.append(balls)
        if progress is not None:
            progress(len(found), total)
    if found and all(f.fault for f in found):
        raise InputError(f"none of {len(found)} images can be used; the first: {found[0].fault}")
    return found


def balls_of(
    image: Image, *, scanner: Scanner, diameters: Sequence[float], mask: Mask, settings: DetectionSettings
) -> BallsInImage:
    """The balls of one radiograph."""
    try:
        shape = checked_shape(image, scanner, (0, 0))
        pixels = read_pixels(image, (0, shape[0], 0, shape[1]), mask, (0, 0))
    except (TomoposeError, OSError, ValueError, EOFError) as error:
        return BallsInImage(balls=(), fault=str(error))
    candidates = _candidates(pixels, scanner, diameters, settings)
    aspect = scanner.p_v / scanner.p_u
    balls, left_out = [], []
    for c in candidates:
        neighbour = next((o for o in candidates if o is not c and _touch(c, o, aspect)), None)
        place = f"the ball at ({c.u:.0f}, {c.v:.0f})"
        if neighbour is not None:
            left_out.append(f"{place} overlaps with the one at ({neighbour.u:.0f}, {neighbour.v:.0f})")
            continue
        try:
            refuse_hidden(c, settings.finder)
            balls.append(
                measured_ball(
                    pixels, scanner, c, (), expected=expected_radius(scanner, diameters[0]), settings=settings
                )
            )
        except DetectionError as error:
            left_out.append(str(error))
    return BallsInImage(balls=tuple(balls), left_out=tuple(left_out))


def _candidates(
    pixels: Pixels, scanner: Scanner, diameters: Sequence[float], settings: DetectionSettings
) -> list[Candidate]:
    """Circles of every size that the object's balls have, each once."""
    aspect = scanner.p_v / scanner.p_u
    sizes: list[float] = []
    for d in sorted(set(diameters)):
        if not sizes or math.log(d / sizes[-1]) > SAME_SIZE:
            sizes.append(d)
    found: list[Candidate] = []
    for d in sizes:
        radius = expected_radius(scanner, d) * math.sqrt(aspect)
        for c in find_balls(pixels.values, radius, aspect, most=len(diameters), settings=settings.finder):
            if not any(c.overlaps(k) for k in found):
                found.append(c)
    return found


def _touch(a: Candidate, b: Candidate, aspect: float) -> bool:
    return math.hypot(a.u - b.u, (a.v - b.v) * aspect) < a.radius + b.radius + CLEAR_PX
