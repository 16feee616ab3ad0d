"""TIFF's Orientation (tag 274): how stored rows and columns lie in the picture, and frames turned so that they lie
right.

Source: TIFF 6.0, Orientation: where row 0 and column 0 lie in the picture as it is to be seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.io.images.frames import Band, FrameSource, Image

UPRIGHT = 1


@dataclass(frozen=True)
class Turn:
    """Stored pixels to the picture: transposed first where rows are columns, then rows and columns turned round."""

    words: str
    transposed: bool
    rows_reversed: bool
    columns_reversed: bool
    row_0: str


TURNS: Mapping[int, Turn] = {
    1: Turn("as stored", False, False, False, "top"),
    2: Turn("mirrored left to right", False, False, True, "top"),
    3: Turn("turned by 180 deg", False, True, True, "bottom"),
    4: Turn("mirrored top to bottom", False, True, False, "bottom"),
    5: Turn("rows and columns exchanged", True, False, False, "left"),
    6: Turn("turned by 90 deg clockwise", True, False, True, "right"),
    7: Turn("rows and columns exchanged, turned by 180 deg", True, True, True, "right"),
    8: Turn("turned by 90 deg anticlockwise", True, True, False, "left"),
}
"""row_0: where the first stored row lies in the picture."""


@dataclass(frozen=True, kw_only=True)
class UprightSource:
    """Frames of another source as their Orientation wants them to be seen.  See FrameSource."""

    stored: FrameSource
    orientation: int
    warnings: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return self.stored.names

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.stored.dtype

    @property
    def shape(self) -> tuple[int, int]:
        rows, columns = self.stored.shape
        return (columns, rows) if TURNS[self.orientation].transposed else (rows, columns)

    def read(self, index: int, band: Band) -> Image:
        turn, (n_rows, n_columns) = TURNS[self.orientation], self.shape
        r0, r1, c0, c1 = band
        if turn.rows_reversed:
            r0, r1 = n_rows - r1, n_rows - r0
        if turn.columns_reversed:
            c0, c1 = n_columns - c1, n_columns - c0
        part = (
            self.stored.read(index, (c0, c1, r0, r1)).T
            if turn.transposed
            else self.stored.read(index, (r0, r1, c0, c1))
        )
        part = part[::-1] if turn.rows_reversed else part
        return part[:, ::-1] if turn.columns_reversed else part


def upright(stored: FrameSource, orientation: int) -> UprightSource:
    """The frames of a source turned as the tag says, with a remark that says so."""
    turn = TURNS[orientation]
    remark = f"{stored.names[0]}: the file's Orientation is {orientation}: its pixels were {turn.words} to be upright"
    return UprightSource(stored=stored, orientation=orientation, warnings=(*getattr(stored, "warnings", ()), remark))
