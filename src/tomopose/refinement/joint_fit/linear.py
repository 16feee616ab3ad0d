r"""One Gauss-Newton step for the volume and all poses together.

Unknown are the volume x >= 0 and, for each view, d numbers q: six of a motion and the level of the image.  With the
residual r, weights W, the projector A and the views' derivatives J the step minimises

    |W^(1/2) (r - A dx - J dq)|^2  +  (q + dq)' C^-1 (q + dq)  +  lambda |x + dx|^2.

dq is eliminated exactly, with the whole precision C^-1, correlated over views:  M = J'WJ + C^-1 (Cholesky); the volume
is found by preconditioned conjugate gradients on the Schur complement  A'WA - A'WJ M^-1 J'WA + lambda, over the voxels
that are free to move (`free`: not held at zero by the bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from tomopose.refinement.joint_fit.precondition import Preconditioner
from tomopose.refinement.joint_fit.projector import Projector
from tomopose.units import Array, Floats


@dataclass(frozen=True, kw_only=True)
class Linear:
    """The linearised problem.

    projector: of the current matrices.  free: bool, as its state; voxels that may move.
    J:        (n, d, N) derivatives of each view's N pixels.  w: (n, N) weights.
    factor:   Cholesky factor of M (n d, n d).  ridge: lambda.
    H:        what of each frequency the views see, or None: plain conjugate gradients.  Without a ridge a few plain
              turns are the regularisation, so that a first volume is made with them.
    """

    projector: Projector
    free: np.ndarray
    J: Floats
    w: Floats
    factor: tuple[Array, bool]
    ridge: float
    H: Floats | None = None

    @classmethod
    def of(
        cls,
        projector: Projector,
        free: np.ndarray,
        J: Floats,
        w: Floats,
        precision: Array,
        ridge: float,
        H: Floats | None = None,
    ) -> Linear:
        """Factorise M = J'WJ + precision (n d, n d)."""
        d = J.shape[1]
        M = precision.copy()
        for j, block in enumerate(normal_blocks(J, w)):
            M[j * d : j * d + d, j * d : j * d + d] += block
        return cls(projector=projector, free=free, J=J, w=w, factor=scipy.linalg.cho_factor(M), ridge=ridge, H=H)

    def back(self, y: Floats) -> np.ndarray:
        """A' y over the free voxels."""
        return np.where(self.free, self.projector.back(y), np.float32(0))

    def poses(self, y: Floats, pull: Array | float = 0.0) -> Array:
        """M^-1 (J'W y - pull), (n, d)."""
        right = np.einsum("ndp,np->nd", self.J, self.w * y).ravel() - pull
        return np.asarray(scipy.linalg.cho_solve(self.factor, right)).reshape(len(self.w), -1)

    def moved(self, q: Array) -> Floats:
        """J q, (n, N), float32."""
        return np.asarray(np.einsum("ndp,nd->np", self.J, q.astype(np.float32)))

    def preconditioner(self) -> Preconditioner | None:
        """Scaled by what one random volume over the free voxels shows."""
        if self.H is None:
            return None
        probe = np.random.default_rng(0).standard_normal(self.free.shape, dtype=np.float32)
        probe = np.where(self.free, probe, np.float32(0))
        lines = self.projector.project(probe)
        energy = float(np.einsum("np,np,np->", self.w, lines, lines, dtype=np.float64))
        return Preconditioner.of(self.H, self.free, probe, energy, self.ridge)

    def solve(
        self, r: Floats, pull: Array, x: np.ndarray, *, turns: int, tolerance: float = 1e-3
    ) -> tuple[np.ndarray, Array]:
        """(dx, dq) for the residual r (n, N); pull: C^-1 q, flat; x: the volume, for the ridge."""

        def reduced(y: Floats) -> Floats:
            """W (1 - J M^-1 J'W) y."""
            return self.w * (y - self.moved(self.poses(y)))

        ridge = np.float32(self.ridge)
        start = self.w * (r - self.moved(self.poses(r, pull)))
        residual = self.back(start) - ridge * np.where(self.free, x, 0)
        even = self.preconditioner()
        eased = residual if even is None else even(residual)
        dx, direction = np.zeros_like(residual), eased.copy()
        size = first = float(np.vdot(residual, eased))
        for _ in range(turns):
            if size <= tolerance**2 * first or size == 0:
                break
            response = self.back(reduced(self.projector.project(direction))) + ridge * direction
            curvature = float(np.vdot(direction, response))
            if not curvature > 0:
                break
            alpha = np.float32(size / curvature)
            dx += alpha * direction
            residual -= alpha * response
            eased = residual if even is None else even(residual)
            new = float(np.vdot(residual, eased))
            direction = eased + np.float32(new / size) * direction
            size = new
        return dx, self.poses(r - self.projector.project(dx), pull)


def normal_blocks(J: Floats, w: Floats) -> Array:
    """J'WJ of each view, (n, d, d), float64."""
    return np.stack([(Jj * wj) @ Jj.T for Jj, wj in zip(J, w, strict=True)]).astype(np.float64)
