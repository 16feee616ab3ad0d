"""Where one frame looks from, which pixels the object can shade, and work in bands of rows."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import OutOfViewError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array

Arrays = tuple[Any, ...]
"""What kernels take as one value: arrays, and tuples of arrays, of mixed types.  numba infers each."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Where one frame looks from: source (3,), pixel (0, 0)'s centre O, pixel steps U and V (3,), in W, mm."""

    source: Array
    O: Array
    U: Array
    V: Array

    @classmethod
    def of(cls, scanner: Scanner, source_shift: ArrayLike = (0.0, 0.0, 0.0)) -> View:
        """The scanner's view; source_shift (3,) mm moves the source in S against the panel (focal spot)."""
        U, V, O = scanner.panel
        T_SW = scanner.T_WS.inv
        return cls(
            source=T_SW.apply(np.asarray(source_shift, dtype=np.float64)), O=T_SW.apply(O), U=T_SW.R @ U, V=T_SW.R @ V
        )

    @classmethod
    def of_matrix(cls, P: Array) -> View:
        """The view of a projection matrix (3, 4) that gives points before the source a positive third coordinate."""
        inverse = np.asarray(np.linalg.inv(P[:, :3]), dtype=np.float64)
        source = -inverse @ P[:, 3]
        return cls(source=source, O=source + inverse[:, 2], U=inverse[:, 0], V=inverse[:, 1])

    def project(self, x: Array) -> Array:
        """Pixels (m, 2) of points (m, 3) of W; OutOfViewError where one lies behind the source."""
        h = np.linalg.solve(np.column_stack([self.U, self.V, self.O - self.source]), (x - self.source).T)
        if (h[2] <= 0).any():
            raise OutOfViewError("the object reaches behind the source; move it away from it or make it smaller")
        return np.asarray((h[:2] / h[2]).T)


def in_bands(work: Callable[[int, int], None], n: int, threads: int) -> None:
    """work(lo, hi) over [0, n) in bands of rows, on that many threads (the kernels release the interpreter's lock)."""
    if threads <= 1 or n < 2 * threads:
        work(0, n)
        return
    step = max(1, n // (8 * threads))
    starts = range(0, n, step)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda lo: work(lo, min(lo + step, n)), starts))


@dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle of pixels: u from u_0 to u_0 + n_u, v likewise."""

    u_0: int
    v_0: int
    n_u: int
    n_v: int


def shadow(
    outlines: list[tuple[Frame, Array]],
    view: View,
    T_FW: dict[Frame, RigidTransform],
    scanner: Scanner,
    margin: int,
) -> Window | None:
    """The pixels that convex hulls of points (k, 3) in their frames can shade, with a margin, cut `margin` outside
    the detector; None where no ball is seen."""
    boxes = shadow_boxes(outlines, view, T_FW)
    lo, hi = np.floor(boxes[:, 0].min(axis=0)) - margin, np.ceil(boxes[:, 1].max(axis=0)) + margin
    size = np.array([scanner.n_u, scanner.n_v])
    u_0, v_0 = (int(x) for x in np.clip(lo, -margin, size + margin))
    u_1, v_1 = (int(x) for x in np.clip(hi + 1, -margin, size + margin))
    seen = u_1 > max(u_0, 0) and v_1 > max(v_0, 0) and u_0 < scanner.n_u and v_0 < scanner.n_v
    return Window(u_0=u_0, v_0=v_0, n_u=u_1 - u_0, n_v=v_1 - v_0) if seen else None


def enclosing(windows: list[Window | None]) -> Window | None:
    """The smallest window that holds them all."""
    some = [w for w in windows if w is not None]
    if not some:
        return None
    u_0, v_0 = min(w.u_0 for w in some), min(w.v_0 for w in some)
    u_1, v_1 = max(w.u_0 + w.n_u for w in some), max(w.v_0 + w.n_v for w in some)
    return Window(u_0=u_0, v_0=v_0, n_u=u_1 - u_0, n_v=v_1 - v_0)


def shadow_boxes(outlines: list[tuple[Frame, Array]], view: View, T_FW: dict[Frame, RigidTransform]) -> Array:
    """(m, 2, 2): lowest and highest (u, v) of each outline."""
    boxes = np.empty((len(outlines), 2, 2))
    for k, (frame, corners) in enumerate(outlines):
        x = view.project(T_FW[frame].apply(corners))
        boxes[k] = x.min(axis=0), x.max(axis=0)
    return boxes
