"""How fast radiographs are read, beside the raw read of the same bytes in the same run.

Process time, page cache warm, best of five rounds over ten frames of 2048 x 2048 uint16.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tifffile

from tomopose.io import RawLayout, open_images, write_hdf5, write_tiff

N, SHAPE = 10, (2048, 2048)


def cost(read: Callable[[int], object]) -> float:
    """Milliseconds of process time a frame."""
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        for k in range(N):
            read(k)
        best = min(best, time.process_time() - start)
    return 1e3 * best / N


def main() -> None:
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(N):
            write_tiff(folder / "tiff" / f"{k}.tif", rng.normal(40000, 200, SHAPE).astype(np.uint16))
        plain = open_images(folder / "tiff")
        write_hdf5(folder / "stack.h5", plain)
        (folder / "stack.raw").write_bytes(b"".join(np.ascontiguousarray(i[::-1]).tobytes() for i in plain))
        files = [folder / "tiff" / n for n in plain.names]
        offset = files[0].stat().st_size - 2 * SHAPE[0] * SHAPE[1]
        hdf5 = open_images(folder / "stack.h5")
        raw = open_images(folder / "stack.raw", raw_layout=RawLayout(shape=SHAPE, dtype="<u2"))
        rows: list[tuple[str, Callable[[int], object]]] = [
            ("bytes of the file", lambda k: files[k].read_bytes()),
            ("numpy.memmap, copied", lambda k: np.array(np.memmap(files[k], np.uint16, "r", offset, SHAPE))),
            ("tifffile.imread", lambda k: tifffile.imread(files[k])),
            ("images[k], TIFF", lambda k: plain[k]),
            ("images[k], RAW", lambda k: raw[k]),
            ("images[k], HDF5", lambda k: hdf5[k]),
            ("region 200 x 200, TIFF", lambda k: plain.region(k, 900, 1100, 900, 1100)),
            ("region 200 x 200, RAW", lambda k: raw.region(k, 900, 1100, 900, 1100)),
            ("region 200 x 200, HDF5", lambda k: hdf5.region(k, 900, 1100, 900, 1100)),
            ("open_images of 10 files", lambda k: open_images(folder / "tiff")),
        ]
        for what, read in rows:
            print(f"{what:26s} {cost(read):7.3f} ms")


if __name__ == "__main__":
    main()
