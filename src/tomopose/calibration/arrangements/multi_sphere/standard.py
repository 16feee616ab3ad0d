"""A calibrated standard of several balls: where they are, how large, and how well that is known."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from tomopose.errors import InputError, NotObservableError, ShapeError
from tomopose.geometry.point_motion import rigid_motion
from tomopose.units import Array, float_array
from tomopose.values import value

FEWEST_BALLS = 4
"""Three balls leave up to four poses of an object (Hartley & Zisserman, Multiple View Geometry, sec. 7)."""
DEFAULT_SIGMA_MM = 0.001
"""Standard uncertainty of a coordinate that nobody stated: certificates of multi-sphere standards state U (k = 2) of
about 1 to 2 um for the distances."""


THINNEST = 1e-3
"""Spread of the balls beside their line over that along it.  Centres known to 1e-5 of the length (a micrometre in 100
mm) leave the turn about the line uncertain by 1e-5 / THINNEST = 10 mrad, which moves a point as far beside the line as
the object is long by a hundredth of its length: no scan can use that."""


def require_not_in_line(centres: Array) -> None:
    """NotObservableError where balls (m, 3), mm, are so nearly in a line that no image shows a turn about it."""
    spread = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    if spread[1] < THINNEST * spread[0]:
        raise NotObservableError(
            "the balls lie in a line: a turn about it moves none of them",
            direction="turn about the balls' line",
            singular_values=spread.tolist(),
        )


@value
class SphereStandard:
    """Balls of a calibrated object, in its own frame M.

    names:     m words, as in the certificate.
    centres:   (m, 3) mm.
    diameters: (m,) mm.
    sigma:     standard uncertainty of each coordinate, mm: (m,), or None where nobody stated one: DEFAULT_SIGMA_MM.
    """

    names: tuple[str, ...]
    centres: Array
    diameters: Array
    sigma: Array | None = None

    def __post_init__(self) -> None:
        x, d = float_array(self.centres), float_array(self.diameters)
        m = len(self.names)
        if x.shape != (m, 3) or d.shape != (m,):
            raise ShapeError(f"{m} balls need centres ({m}, 3) and diameters ({m},); got {x.shape} and {d.shape}")
        if len(set(self.names)) != m:
            raise InputError("two balls of the standard have the same name")
        if m < FEWEST_BALLS:
            raise InputError(f"the standard has {m} balls; a pose needs at least {FEWEST_BALLS}")
        if not np.isfinite(x).all() or not (np.isfinite(d).all() and (d > 0).all()):
            raise InputError("coordinates and diameters of the standard must be finite, diameters above 0")
        require_not_in_line(x)
        for i, j in combinations(range(m), 2):
            apart = float(np.linalg.norm(x[i] - x[j]))
            if apart < (d[i] + d[j]) / 2:
                raise InputError(
                    f"balls {self.names[i]} and {self.names[j]} are {apart:.4g} mm apart and {d[i]:g} and {d[j]:g} mm "
                    "thick: they would overlap; are the coordinates in mm?"
                )
        object.__setattr__(self, "centres", x)
        object.__setattr__(self, "diameters", d)
        if self.sigma is not None:
            s = float_array(self.sigma)
            if s.shape != (m,) or not (np.isfinite(s).all() and (s >= 0).all()):
                raise InputError(f"sigma of the standard needs {m} numbers of mm, none below 0")
            object.__setattr__(self, "sigma", s)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma_mm(self) -> Array:
        """(m,) standard uncertainty of each coordinate, stated or assumed."""
        return np.full(len(self), DEFAULT_SIGMA_MM) if self.sigma is None else self.sigma

    def require_asymmetric(self, tolerance: float) -> None:
        """InputError where a turn brings the standard onto itself to `tolerance`, mm: its balls have no identity."""
        x, d = self.centres, self.diameters
        D = np.linalg.norm(x[:, None] - x[None], axis=2)
        a, b, c = _widest_triple(x)
        for i, j in np.argwhere(np.abs(D - D[a, b]) < tolerance):
            for k in np.flatnonzero((np.abs(D[i] - D[a, c]) < tolerance) & (np.abs(D[j] - D[b, c]) < tolerance)):
                if [i, j, k] == [a, b, c] or len({i, j, k}) < 3:
                    continue
                R, t = rigid_motion(x[[a, b, c]], x[[i, j, k]])
                apart = np.linalg.norm((x @ R.T + t)[:, None] - x[None], axis=2)
                onto = apart.argmin(axis=1)
                same = len(set(onto.tolist())) == len(x) and np.allclose(d[onto], d, rtol=0.05)
                if same and float(apart.min(axis=1).max()) < tolerance and (onto != np.arange(len(x))).any():
                    first = int(np.flatnonzero(onto != np.arange(len(x)))[0])
                    raise InputError(
                        f"the standard is symmetric: a turn brings every ball onto another one to {tolerance:.3g} mm "
                        f"({self.names[first]} onto {self.names[int(onto[first])]}), so that nothing identifies its "
                        "balls; use a standard whose distances differ"
                    )


def _widest_triple(x: Array) -> tuple[int, int, int]:
    """The three points that span the largest triangle."""
    best = max(
        combinations(range(len(x)), 3), key=lambda t: np.linalg.norm(np.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]]))
    )
    return best[0], best[1], best[2]
