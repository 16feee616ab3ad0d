"""What hides what in a drawing: texts that lie over one another or leave the sheet, a legend over the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tomopose.units import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

TOUCHING = 1.0
"""Pixels by which boxes may overlap: letters do not fill theirs."""


def overlaps(fig: Figure) -> tuple[str, ...]:
    """Each in words; empty where every text is readable and no legend covers the axes.  Matplotlib draws the figure."""
    fig.draw_without_rendering()
    boxes = [(t.get_text(), _corners(t)) for t in _texts(fig)]
    found = [f"{a!r} and {b!r} overlap" for (a, p), (b, q) in combinations(boxes, 2) if _meet(p, q)]
    width, height = fig.canvas.get_width_height()
    for words, corners in boxes:
        if (corners < -TOUCHING).any() or (corners > [width + TOUCHING, height + TOUCHING]).any():
            found.append(f"{words!r} leaves the sheet")
    own = (ax.get_legend() for ax in fig.axes)
    for legend in [*fig.legends, *(one for one in own if one is not None)]:
        for ax in fig.axes:
            if _meet(_rectangle(legend.get_window_extent().extents), _rectangle(ax.get_window_extent().extents)):
                found.append(f"the legend covers the axes {ax.get_title()!r}")
    return tuple(found)


def _texts(fig: Figure) -> list[Text]:
    """The texts that are seen: titles, labels, marks of the axes, words in them, entries of legends."""
    from matplotlib.text import Text

    hidden = {id(t) for ax in fig.axes for t in _hidden(ax)}
    return [
        t
        for t in fig.findobj(Text)
        if isinstance(t, Text) and t.get_visible() and t.get_text().strip() and id(t) not in hidden
    ]


def _hidden(ax: Axes) -> Iterator[Text]:
    """Texts of an axes that are not drawn: of axes that are hidden, and of marks outside of the shown range."""
    for axis in (getattr(ax, f"{letter}axis", None) for letter in "xyz"):
        if axis is None:
            continue
        low, high = sorted(axis.get_view_interval())
        slack = 1e-9 * (high - low)
        shown = ax.get_visible() and axis.get_visible()
        if not shown:
            yield from (axis.label, axis.get_offset_text())
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
            if not shown or not low - slack <= tick.get_loc() <= high + slack:
                yield from (tick.label1, tick.label2)


def _rectangle(extents: Sequence[float] | Array) -> Array:
    """(4, 2) corners of (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = extents
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _corners(t: Text) -> Array:
    """(4, 2) px: the corners of a text's box, turned as the text is."""
    angle = np.radians(t.get_rotation())
    if abs(np.sin(2 * angle)) < 1e-6:
        return _rectangle(t.get_window_extent().extents)
    whole = t.get_window_extent().extents
    middle = np.array([whole[0] + whole[2], whole[1] + whole[3]]) / 2
    turn = t.get_rotation()
    t.set_rotation(0.0)
    level = t.get_window_extent().extents
    t.set_rotation(turn)
    half = np.array([level[2] - level[0], level[3] - level[1]]) / 2
    c, s = np.cos(angle), np.sin(angle)
    flat = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.asarray(flat @ np.array([[c, s], [-s, c]]) + middle)


def _meet(p: Array, q: Array) -> bool:
    """Whether two convex quadrangles (4, 2) overlap by more than TOUCHING: no side separates them."""
    for shape in (p, q):
        sides = np.roll(shape, -1, axis=0) - shape
        normals = np.column_stack([-sides[:, 1], sides[:, 0]])
        normals = normals[np.linalg.norm(normals, axis=1) > 0]
        for n in normals / np.linalg.norm(normals, axis=1)[:, None]:
            a, b = p @ n, q @ n
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= TOUCHING:
                return False
    return True
