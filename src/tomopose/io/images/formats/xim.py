"""Varian .xim: 32-bit counts, stored plainly or as differences of neighbours in 1, 2 or 4 bytes.

Header (little-endian): "VMS.XI" in 8 bytes, version, width, height, bits, bytes a pixel, compressed (int32 each).
Compressed: table of 2-bit sizes (0, 1, 2 for 1, 2, 4 bytes; four pixels a byte, lowest bits first), then row 0 and
the first pixel of row 1 as int32, then for every further pixel k the difference d of

    R[k] = R[k - 1] + R[k - w] - R[k - w - 1] + d

so that R[k] - R[k - w] is a running sum of d, and R a running sum of those along columns. After the pixels come a
histogram and named properties.  Source: Varian's description of the format, as pylinac and RTK read it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError
from tomopose.io.images.frames import Band, Image, require_one_kind
from tomopose.io.images.stated import Stated
from tomopose.reading import reading, require_plausible

MAGIC = b"VMS.XI"
HEADER = struct.Struct("<8s6i")
SIZES = np.array([1, 2, 4, 0])
"""Bytes of a difference by its 2-bit flag; flag 3 does not occur."""
CM = 10.0
MOST_PROPERTIES = 10_000


@dataclass(frozen=True, kw_only=True)
class XimSource:
    """One frame a file.  See FrameSource."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    paths: tuple[Path, ...]
    stated: Stated | None = None

    def read(self, index: int, band: Band) -> Image:
        r0, r1, c0, c1 = band
        return read_xim(self.paths[index])[0][r0:r1, c0:c1]


def open_xim(paths: list[Path], names: list[str]) -> XimSource:
    """The frames of .xim files; shapes come from their headers."""
    shapes = [_header(path)[:2] for path in paths]
    require_one_kind([(str(p), s, np.dtype(np.int32)) for p, s in zip(paths, shapes, strict=True)])
    _, properties = read_xim(paths[0])
    pitch = {f"p_{a}_mm": CM * properties[n] for a, n in (("u", "PixelWidth"), ("v", "PixelHeight")) if n in properties}
    stated = Stated(
        values={k: v for k, v in pitch.items() if np.isfinite(v) and v > 0},
        fields={"p_u_mm": "PixelWidth", "p_v_mm": "PixelHeight"},
        readings=("PixelWidth and PixelHeight are in cm",),
    )
    return XimSource(names=tuple(names), shape=shapes[0], dtype=np.dtype(np.int32), paths=tuple(paths), stated=stated)


def _header(path: Path) -> tuple[int, int, int, int]:
    """(rows, columns, bytes a pixel, compressed)."""
    with reading(path, "Varian image"), open(path, "rb") as stream:
        head = stream.read(HEADER.size)
    if len(head) < HEADER.size or not head.startswith(MAGIC):
        raise FileError(f"{path} is no Varian .xim image: it does not begin with VMS.XI", path=path)
    _, _, columns, rows, _, size, compressed = HEADER.unpack(head)
    if min(columns, rows) < 2 or size not in (1, 2, 4):
        raise FileError(f"{path} claims {columns} x {rows} pixels of {size} bytes", path=path)
    # At best a difference of one byte and a quarter of a byte of the table belong to a pixel.
    claimed = columns * rows if compressed else columns * rows * size
    if claimed > path.stat().st_size:
        raise FileError(f"{path} is truncated: {columns} x {rows} pixels do not fit into its length", path=path)
    require_plausible(path, f"an image of {columns} x {rows} pixels", 4 * columns * rows, path.stat().st_size)
    return rows, columns, size, compressed


def read_xim(path: Path) -> tuple[Image, dict[str, float]]:
    """(image (rows, columns) int32 as stored, the properties that are single numbers)."""
    rows, columns, size, compressed = _header(path)
    with reading(path, "Varian image"):
        data = path.read_bytes()
        at = HEADER.size
        if compressed:
            (table_size,) = struct.unpack_from("<i", data, at)
            table = np.frombuffer(data, np.uint8, table_size, at + 4)
            (packed_size,) = struct.unpack_from("<i", data, at + 4 + table_size)
            begin = at + 8 + table_size
            if packed_size < 0 or begin + packed_size > len(data):
                raise FileError(f"{path} is truncated: its pixels end behind the file", path=path)
            image = _unpacked(np.frombuffer(data, np.uint8, packed_size, begin), table, rows, columns, path)
            at = begin + packed_size + 4
        else:
            (stored,) = struct.unpack_from("<i", data, at)
            image = np.frombuffer(data, f"<i{size}", rows * columns, at + 4).astype(np.int32).reshape(rows, columns)
            at += 4 + stored
        return image, _properties(data, at)


def _unpacked(packed: np.ndarray, table: np.ndarray, rows: int, columns: int, path: Path) -> Image:
    known = columns + 1
    n = rows * columns - known
    flags = (table[:, None] >> np.array([0, 2, 4, 6])) & 3
    sizes = SIZES[flags.reshape(-1)[:n]]
    begin = 4 * known + np.concatenate([[0], np.cumsum(sizes)])
    if len(sizes) < n or not sizes.all() or begin[-1] > len(packed):
        raise FileError(f"{path}: its table of sizes does not fit its {len(packed)} bytes of pixels", path=path)
    d = np.empty(n, dtype=np.int64)
    for size in (1, 2, 4):
        of = np.flatnonzero(sizes == size)
        parts = packed[begin[of][:, None] + np.arange(size)]
        d[of] = np.ascontiguousarray(parts).view(f"<i{size}").reshape(-1)
    R = np.empty(rows * columns, dtype=np.int64)
    R[:known] = packed[: 4 * known].view("<i4")
    R[columns:] = R[columns] - R[0] + np.concatenate([[0], np.cumsum(d)])
    return np.cumsum(R.reshape(rows, columns), axis=0).astype(np.int32)


def _properties(data: bytes, at: int) -> dict[str, float]:
    """Properties that are one number; types 0 int, 1 double, 2 text, 4 doubles, 5 ints."""

    def integer(at: int) -> int:
        return int(struct.unpack_from("<i", data, at)[0])

    if at + 4 > len(data):
        return {}
    at += 4 + 4 * integer(at)
    found: dict[str, float] = {}
    count = integer(at) if at + 4 <= len(data) else 0
    at += 4
    for _ in range(min(count, MOST_PROPERTIES)):
        length = integer(at)
        name = data[at + 4 : at + 4 + length].decode("latin-1")
        kind = integer(at + 4 + length)
        at += 8 + length
        if kind == 0:
            found[name], at = float(integer(at)), at + 4
        elif kind == 1:
            found[name], at = float(struct.unpack_from("<d", data, at)[0]), at + 8
        elif kind in (2, 4, 5):
            at += 4 + integer(at)
        else:
            break
    return found
