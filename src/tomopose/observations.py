"""Observations of the ball: where its centre is projected in each radiograph, with its uncertainty, or why not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array, float_array, rows_at
from tomopose.values import Column, Rows, value

OUTSIDE = 1.0
"""Of the panel's side.  Simulated centres may leave the panel, by a third of it in practice; a mistyped number, or a
column of another kind, leaves it by more."""
OPTIONAL_COLUMNS = ("snr", "semi_major", "semi_minor", "angle")


@value
class BallObservations(Rows):
    """One row per image.

    x_D:        (n, 2) px in D, projection of the ball's *centre*; NaN where not seen.
    covariance: (n, 2, 2) px^2.
    pose_id:    n different names.
    seen:       (n,) bool: measured and fit for use.
    status:     n short words: "ok", or why the row is not to be used or is to be used with care.
    image:      n file names, or None.
    snr, semi_major, semi_minor, angle: (n,) background SNR, silhouette ellipse (px, px, rad), NaN where unknown.
    x_ellipse:  (n, 2) px, centre of the silhouette's ellipse: *not* the projected centre (paper ref. [19]).
    ball_id:    (n,) whole numbers from 0: which ball each row is of, or None where the pose table alone says so.
    ball_diameter: mm, of every ball here, or None; with the semi axes it is a gauge of the calibrated magnification.
    """

    x_D: Array
    covariance: Array
    pose_id: tuple[str, ...]
    seen: Any = None
    status: tuple[str, ...] | None = None
    image: tuple[str, ...] | None = None
    snr: Array | None = None
    semi_major: Array | None = None
    semi_minor: Array | None = None
    angle: Array | None = None
    x_ellipse: Array | None = None
    ball_id: Any = None
    ball_diameter: float | None = None

    def __post_init__(self) -> None:
        x_D, covariance = float_array(self.x_D), float_array(self.covariance)
        n = len(x_D)
        if x_D.shape != (n, 2) or covariance.shape != (n, 2, 2):
            raise ShapeError(
                f"observations need x_D (n, 2) and covariance (n, 2, 2); got {x_D.shape} and {covariance.shape}"
            )
        ids = tuple(str(i) for i in self.pose_id)
        if len(ids) != n:
            raise ShapeError(f"{n} observations but {len(ids)} pose ids")
        twice = [i for i, count in Counter(ids).items() if count > 1]
        if twice:
            raise InputError(
                f"pose_id {twice[0]!r} is observed more than once ({len(twice)} ids repeat); two balls in one image "
                "have two rows, with different ids, in the pose table, too"
            )
        finite = np.isfinite(x_D).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
        seen = finite.copy() if self.seen is None else np.array(self.seen, dtype=bool)
        if seen.shape != (n,):
            raise ShapeError(f"seen has shape {seen.shape}; one value for each of {n} observations is needed")
        bad = np.flatnonzero(seen & ~finite)
        if bad.size:
            raise InputError(f"observation of pose {ids[bad[0]]!r} counts as seen but is not a finite number")
        variance = np.einsum("nii->ni", covariance)
        bad = np.flatnonzero(
            seen
            & ((variance <= 0).any(axis=1) | (np.linalg.det(np.where(seen[:, None, None], covariance, np.eye(2))) <= 0))
        )
        if bad.size:
            raise InputError(f"observation of pose {ids[bad[0]]!r}: its covariance is not positive definite")
        seen.setflags(write=False)
        status = tuple("ok" if s else "not seen" for s in seen) if self.status is None else tuple(self.status)
        if len(status) != n:
            raise ShapeError(f"{n} observations but {len(status)} status words")
        object.__setattr__(self, "x_D", x_D)
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "pose_id", ids)
        object.__setattr__(self, "seen", seen)
        object.__setattr__(self, "status", status)
        if self.image is not None:
            if len(self.image) != n:
                raise ShapeError(f"{n} observations but {len(self.image)} image names")
            object.__setattr__(self, "image", tuple(self.image))
        if self.ball_id is not None:
            ball_id = np.array(self.ball_id, dtype=np.int64)
            if ball_id.shape != (n,):
                raise ShapeError(f"{n} observations but ball_id has shape {ball_id.shape}")
            ball_id.setflags(write=False)
            object.__setattr__(self, "ball_id", ball_id)
        if self.ball_diameter is not None and not (np.isfinite(self.ball_diameter) and self.ball_diameter > 0):
            raise InputError(f"ball_diameter is {self.ball_diameter}; a diameter above 0 in mm is needed")
        for name in (*OPTIONAL_COLUMNS, "x_ellipse"):
            column = getattr(self, name)
            if column is not None:
                array = float_array(column)
                if len(array) != n:
                    raise ShapeError(f"{n} observations but {len(array)} values of {name}")
                object.__setattr__(self, name, array)

    @classmethod
    def from_sigma(
        cls, x_D: ArrayLike, sigma: ArrayLike, *, pose_id: Iterable[object] | None = None, **columns: Any
    ) -> BallObservations:
        """From centres (n, 2) and standard uncertainties (a number, (n,) or (n, 2)), px, without correlation."""
        x_D = np.asarray(x_D, dtype=np.float64)
        s = np.asarray(sigma, dtype=np.float64)
        s = np.broadcast_to(s[:, None] if s.ndim == 1 else s, x_D.shape)
        covariance = np.zeros((len(x_D), 2, 2))
        covariance[:, 0, 0], covariance[:, 1, 1] = s[:, 0] ** 2, s[:, 1] ** 2
        ids = range(len(x_D)) if pose_id is None else pose_id
        return cls(x_D=x_D, covariance=covariance, pose_id=tuple(str(i) for i in ids), **columns)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> Array:
        return np.array(self.x_D, dtype=dtype)

    def columns(self) -> dict[str, Column]:
        """The columns of observations.csv, angles in rad."""
        sigma = self.sigma
        columns: dict[str, Column] = {
            "u_px": self.x_D[:, 0], "v_px": self.x_D[:, 1], "sigma_u_px": sigma[:, 0], "sigma_v_px": sigma[:, 1],
            "seen": self.seen, "status": self.status or (),
        }  # fmt: skip
        units = {"snr": "snr", "semi_major": "semi_major_px", "semi_minor": "semi_minor_px", "angle": "angle_rad"}
        given = {units[name]: getattr(self, name) for name in OPTIONAL_COLUMNS} | {"ball_id": self.ball_id}
        return columns | {name: held for name, held in given.items() if held is not None}

    @property
    def sigma(self) -> Array:
        """(n, 2) standard uncertainties of u and v, px."""
        result: Array = np.sqrt(np.einsum("nii->ni", self.covariance))
        return result

    def select(self, index: object) -> BallObservations:
        """The rows with those indices (or that mask or slice), in that order."""
        i = rows_at(len(self), index)

        def of(column: Any) -> Any:
            return None if column is None else column[i]

        return replace(
            self,
            x_D=self.x_D[i],
            covariance=self.covariance[i],
            pose_id=tuple(self.pose_id[k] for k in i),
            seen=self.seen[i],
            status=tuple(self.status[k] for k in i) if self.status is not None else None,
            image=None if self.image is None else tuple(self.image[k] for k in i),
            **{name: of(getattr(self, name)) for name in (*OPTIONAL_COLUMNS, "x_ellipse", "ball_id")},
        )

    def with_ball_diameter(self, ball_diameter: float | None) -> BallObservations:
        """The same observations of balls of that diameter, mm; None leaves what is known."""
        return self if ball_diameter is None else replace(self, ball_diameter=float(ball_diameter))

    @property
    def outline(self) -> Array | None:
        """(n,) px^2: product of the semi axes of the silhouette, NaN where unknown; None where none is known."""
        if self.semi_major is None or self.semi_minor is None:
            return None
        return np.asarray(self.semi_major * self.semi_minor, dtype=np.float64)

    def require_on_panel(self, scanner: Scanner, where: str) -> BallObservations:
        """The observations, if all that are used lie on the scanner's panel; InputError names the first that does not.

        Centres may lie outside by `OUTSIDE` of the panel's side.
        """
        sides = np.array([scanner.n_u, scanner.n_v])
        low, high = -0.5 - OUTSIDE * sides, sides - 0.5 + OUTSIDE * sides
        off = self.seen & ~((self.x_D >= low) & (self.x_D <= high)).all(axis=1)
        if off.any():
            k = int(np.flatnonzero(off)[0])
            u, v = self.x_D[k]
            raise InputError(
                f"{where}: row {k + 1} (pose {self.pose_id[k]!r}) is at u {u:.6g}, v {v:.6g} px, off the panel of "
                f"{scanner.n_u} x {scanner.n_v} pixels ({int(off.sum())} of {len(self)} rows are): are these pixels of "
                "this scanner, unbinned?"
            )
        return self

    @property
    def used(self) -> BallObservations:
        """Only the rows that are seen."""
        return self.select(self.seen)
