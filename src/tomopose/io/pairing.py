"""Which image belongs to which pose."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from tomopose.errors import InputError, InputWarning
from tomopose.files import natural_key
from tomopose.io.images.frames import missing_numbers, numbers_in_names
from tomopose.io.images.sequence import ImageSequence
from tomopose.manipulator.poses import PoseSequence
from tomopose.values import require_types

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]
SHOWN = 5
TABLE_TOLERANCE_RAD = np.radians(0.1)
"""Turns of the table that differ by more are no positioning error of a rotary table but another column."""


@require_types
def pair_images(poses: PoseSequence, images: ImageSequence | Sequence[str]) -> Indices:
    """For each pose the index (n,) of its image: `images.select(pair_images(poses, images))` is in pose order.

    With an `image` column images are picked by name, and images that no row names are left out.  Without it the counts
    must agree, and they pair

    - by number, where the pose ids are whole numbers and the same ones number the images;
    - else row k with image k in natural order, if the numbering has no gap and the rows are in natural order too.

    Raises InputError, listing what has no partner.
    """
    names = tuple(images.names if isinstance(images, ImageSequence) else images)
    found = _paired(poses, names)
    if isinstance(images, ImageSequence):
        _warn_if_the_table_differs(poses, images, found)
    return found


def _warn_if_the_table_differs(poses: PoseSequence, images: ImageSequence, found: Indices) -> None:
    """InputWarning where the images' file states table angles (NXtomo) that the pose table contradicts.

    Zero and sense of the two may differ, so turns from the first image are compared, in either sense.
    """
    stated = getattr(images.source, "angles_deg", None)
    if stated is None or len(found) < 2:
        return
    theirs = np.radians([stated[images.index[int(k)]] for k in found])
    turn, ours = theirs - theirs[0], poses.alpha - poses.alpha[0]
    off = min((np.abs(np.angle(np.exp(1j * (ours - sense * turn)))) for sense in (1, -1)), key=lambda d: float(d.max()))
    if off.max() > TABLE_TOLERANCE_RAD:
        k = int(np.argmax(off))
        warnings.warn(
            f"the images' file says that the table turned by {np.degrees(turn[k]):.4g} deg from the first image to "
            f"{images.names[int(found[k])]}, the pose table {np.degrees(ours[k]):.4g} deg; the pose table's is used",
            InputWarning,
            stacklevel=3,
        )


def _paired(poses: PoseSequence, names: tuple[str, ...]) -> Indices:
    if poses.image is not None:
        return _by_name(poses.image, names)
    numbers = numbers_in_names(names)
    by_id = _by_number(poses.pose_id, numbers) if numbers is not None else None
    if by_id is not None:
        return by_id
    if len(names) != len(poses):
        raise InputError(
            f"{len(poses)} poses but {len(names)} images; {_unmatched(poses, names, numbers)}. "
            "Add an image column to the pose table, or the missing ones"
        )
    gaps = missing_numbers(names)
    if gaps:
        raise InputError(
            f"the images' numbering leaves out {_some(gaps)}, so which pose they belong to is not certain; add an "
            "image column to the pose table"
        )
    in_order = sorted(poses.pose_id, key=natural_key)
    if list(poses.pose_id) != in_order:
        k = next(k for k, p in enumerate(poses.pose_id) if p != in_order[k])
        raise InputError(
            f"the rows of the pose table are not in natural order (row {k + 1} is {poses.pose_id[k]!r}) and their ids "
            "do not number the images; add an image column"
        )
    order = sorted(range(len(names)), key=lambda k: natural_key(names[k]))
    return np.array(order, dtype=np.intp)


def _by_name(wanted: Sequence[str], names: Sequence[str]) -> Indices:
    full = {name: k for k, name in enumerate(names)}
    tail_counts = Counter(PurePath(name).name for name in names)
    tails = {PurePath(name).name: k for k, name in enumerate(names) if tail_counts[PurePath(name).name] == 1}
    found = [full.get(w, tails.get(PurePath(w.replace("\\", "/")).name)) for w in wanted]
    missing = [w for w, k in zip(wanted, found, strict=True) if k is None]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(wanted)} images of the pose table are not there: {_some(missing)}; there are "
            f"{len(names)} images, {names[0]} to {names[-1]}"
        )
    return np.array(found, dtype=np.intp)


def _by_number(pose_id: Sequence[str], numbers: Sequence[int]) -> Indices | None:
    if not all(p.isdigit() for p in pose_id):
        return None
    where = {number: k for k, number in enumerate(numbers)}
    ids = [int(p) for p in pose_id]
    if set(ids) != set(where) or len(where) != len(numbers) or len(set(ids)) != len(ids):
        return None
    return np.array([where[i] for i in ids], dtype=np.intp)


def _unmatched(poses: PoseSequence, names: Sequence[str], numbers: Sequence[int] | None) -> str:
    ids = {int(p): p for p in poses.pose_id if p.isdigit()}
    if numbers is None or len(ids) != len(poses):
        more = names[len(poses) :] or poses.pose_id[len(names) :]
        what = "images" if len(names) > len(poses) else "poses"
        return f"counted in order, {what} without partner: {_some(more)}"
    without_image = [ids[i] for i in sorted(set(ids) - set(numbers))]
    without_pose = [name for name, number in zip(names, numbers, strict=True) if number not in ids]
    parts = [f"poses without image: {_some(without_image)}"] if without_image else []
    parts += [f"images without pose: {_some(without_pose)}"] if without_pose else []
    return "; ".join(parts)


def _some(items: Sequence[object]) -> str:
    return ", ".join(str(i) for i in items[:SHOWN]) + (f" ... ({len(items)} in all)" if len(items) > SHOWN else "")
