"""TIFF: its directories are walked before tifffile reads them, so that a damaged one neither loops nor fills memory.

A TIFF file is a chain of directories (one a page) of entries (tag, type, count, value or the value's place).  Each
place must lie in the file, no directory may come twice, and a page may not claim more pixels than its bytes can hold.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from tomopose.errors import FileError
from tomopose.reading.memory import require_held, require_plausible

WIDTH, LENGTH, BITS, SAMPLES, TILE_WIDTH, TILE_LENGTH = 256, 257, 258, 277, 322, 323
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Bytes of each type of value."""
MOST_ENTRIES = 1000
LARGEST_SIDE = 1 << 20
WHOLE = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}


@dataclass(frozen=True, kw_only=True)
class _Form:
    """How a file writes its numbers: byte order, and the sizes of classic or big TIFF."""

    order: str
    first: int
    count: str
    entry: str
    place: str


def require_sound_tiff(path: Path) -> None:
    """FileError where the structure of a TIFF file is damaged."""
    size = path.stat().st_size
    with open(path, "rb") as stream:
        form = _form(stream, path)
        seen: set[int] = set()
        claimed = 0
        place = _number(stream, form, form.place, path)
        while place:
            if place in seen:
                raise FileError(f"{path} is damaged: its pages lead in a circle (page {len(seen)})", path=path)
            if place >= size:
                break  # the pages before are whole; tifffile says what is missing
            seen.add(place)
            stream.seek(place)
            claimed += _page_bytes(stream, form, path, size, len(seen) - 1)
            require_held(path, f"{len(seen)} pages", claimed, size)
            place = _number(stream, form, form.place, path)


def _form(stream: BinaryIO, path: Path) -> _Form:
    head = stream.read(4)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    version = struct.unpack(f"{order}H", head[2:4])[0] if order and len(head) == 4 else 0
    if order and version == 43:
        stream.read(4)
        return _Form(order=order, first=16, count="Q", entry="HHQ8s", place="Q")
    if order and version == 42:
        return _Form(order=order, first=8, count="H", entry="HHI4s", place="I")
    raise FileError(f"{path} is no readable TIFF: it begins with {head!r}", path=path)


def _number(stream: BinaryIO, form: _Form, kind: str, path: Path) -> int:
    needed = struct.calcsize(form.order + kind)
    content = stream.read(needed)
    if len(content) < needed:
        raise FileError(f"{path} is truncated: a directory of a page ends too early; copy it again", path=path)
    return int(struct.unpack(form.order + kind, content)[0])


def _page_bytes(stream: BinaryIO, form: _Form, path: Path, size: int, page: int) -> int:
    """The bytes of the pixels that one directory claims, once its entries lie in the file and its pixels can."""
    count = _number(stream, form, form.count, path)
    step = struct.calcsize(form.order + form.entry)
    if count > MOST_ENTRIES:
        raise FileError(f"{path} is damaged: page {page} claims {count} entries; an image has about 20", path=path)
    content = stream.read(count * step)
    if len(content) < count * step:
        raise FileError(f"{path} is truncated: the directory of page {page} ends too early; copy it again", path=path)
    found: dict[int, int] = {}
    for tag, kind, number, value in struct.iter_unpack(form.order + form.entry, content):
        needed = SIZES.get(kind, 0) * number
        if needed > size:
            raise FileError(f"{path} is damaged: entry {tag} of page {page} claims {needed} of {size} bytes", path=path)
        if kind in WHOLE and number == 1:
            found[tag] = int(struct.unpack_from(form.order + WHOLE[kind], value)[0])
    sides = [found.get(tag, 1) for tag in (WIDTH, LENGTH, TILE_WIDTH, TILE_LENGTH)]
    if max(sides) > LARGEST_SIDE or found.get(SAMPLES, 1) > 65535:
        raise FileError(f"{path} is damaged: page {page} claims a side of {max(sides)} pixels", path=path)
    if min(sides) < 1:
        raise FileError(f"{path} is damaged: page {page} claims a side of {min(sides)} pixels", path=path)
    width, length, tile_width, tile_length = sides
    bits = max(found.get(BITS, 16), 8) * max(found.get(SAMPLES, 1), 1)
    require_plausible(path, f"page {page} of {width} x {length} pixels", width * length * bits // 8, size)
    require_plausible(path, f"a tile of page {page}", tile_width * tile_length * bits // 8, size)
    return width * length * bits // 8
