r"""Balls on the object whose places nobody knows: points that move with it, seen beside its images.

A ball k at X_k (W, at home) is seen in view j at z_jk = pi(P_j T(q_j) X_k) with covariance S_jk.  Its place is
eliminated:

    b(q) = min_X sum |z - pi(P T(q) X)|^2_{S^-1},     B = N_qq - N_qX N_XX^-1 N_Xq,

and B joins the precision of the motions, b the joint cost.  A common motion of the object and its size stay as open as
they were: nobody knows the places.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.geometry.object_pose import pixels_and_jacobian
from tomopose.geometry.rotations import skew
from tomopose.least_squares import least_squares
from tomopose.refinement.joint_fit.motions import transforms
from tomopose.units import Array

STEPS, STILL = 30, 1e-10
"""Steps at the most in which the places are found; relative step that ends them."""


@dataclass(frozen=True, kw_only=True)
class Balls:
    """P: (n, 3, 4) of the whole images, before any motion; centre: (3,) of the motions.  z: (n, k, 2) px, 0 where not
    seen; root: (n, k, 2, 2), R with R'R the inverse covariance, 0 where not seen; radius_mm: (k,)."""

    P: Array
    centre: Array
    z: Array
    root: Array
    radius_mm: Array

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(n, k)."""
        return np.asarray(self.root.any(axis=(2, 3)))

    def of_views(self, rows: npt.NDArray[np.int_]) -> Balls:
        """The same balls in some views."""
        return replace(self, P=self.P[rows], z=self.z[rows], root=self.root[rows])

    def places(self, q: Array) -> Array:
        """X (k, 3), mm in W, of least squares under motions q (n, 6)."""
        P = self.P @ transforms(q, self.centre)
        k = self.z.shape[1]
        index = np.arange(k)

        def rows(X: Array) -> tuple[Array, Array]:
            r, G = self._whitened(P, X)
            J = np.zeros((*r.shape, k, 3))
            J[:, index, :, index] = G.transpose(1, 0, 2, 3)
            return r.ravel(), J.reshape(r.size, 3 * k)

        start = np.stack([self._seen_from_two_sides(P, ball) for ball in range(k)])
        return least_squares(rows, lambda X, s: X + s.reshape(k, 3), start, steps=STEPS, tolerance=STILL).state

    def cost(self, q: Array) -> float:
        """b(q)."""
        r, _ = self._whitened(self.P @ transforms(q, self.centre), self.places(q))
        return float(np.vdot(r, r))

    def reduced(self, q: Array) -> tuple[Array, Array]:
        """B (6n, 6n) and g (6n,): after a step dq from q the cost is b(q) - 2 g'dq + dq'B dq."""
        n, k = self.z.shape[:2]
        X = self.places(q)
        r, G = self._whitened(self.P @ transforms(q, self.centre), X)
        J = np.concatenate([G, -G @ skew(X - self.centre)], axis=3)
        coupled = np.einsum("jkac,jkad->jckd", J, G).reshape(6 * n, 3 * k)
        own = np.zeros((k, 3, k, 3))
        own[np.arange(k), :, np.arange(k)] = np.einsum("jkac,jkad->kcd", G, G)
        B = np.zeros((n, 6, n, 6))
        B[np.arange(n), :, np.arange(n)] = np.einsum("jkac,jkad->jcd", J, J)
        held = np.linalg.solve(own.reshape(3 * k, 3 * k), coupled.T)
        return B.reshape(6 * n, 6 * n) - coupled @ held, np.einsum("jkac,jka->jc", J, r).ravel()

    def blocks(self, q: Array) -> Array:
        """(n, 6, 6): B of each view alone."""
        n = len(q)
        return np.asarray(self.reduced(q)[0].reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)])

    def misfit(self, q: Array) -> float:
        """Rms residual over the stated standard uncertainty, the places taken off the count: near 1, and below where
        the poses follow the balls, whose numbers are not taken off."""
        free = 2 * np.count_nonzero(self.seen) - 3 * self.z.shape[1]
        return float(np.sqrt(self.cost(q) / max(free, 1)))

    def _whitened(self, P: Array, X: Array) -> tuple[Array, Array]:
        """r (n, k, 2) and derivatives by the places (n, k, 2, 3), in standard deviations; 0 where not seen."""
        u, G = pixels_and_jacobian(P, X)
        return np.einsum("jkab,jkb->jka", self.root, self.z - u), self.root @ G

    def _seen_from_two_sides(self, P: Array, ball: int) -> Array:
        """X (3,): the linear least squares of u (P_3 x) = P_1 x and its like, in all views that see the ball."""
        rows = np.flatnonzero(self.seen[:, ball])
        A = P[rows, :2] - self.z[rows, ball, :, None] * P[rows, 2:]
        A = A.reshape(-1, 4)
        return np.asarray(np.linalg.lstsq(A[:, :3], -A[:, 3], rcond=None)[0])
