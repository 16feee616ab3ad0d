"""Balls on the object: from their observations to points of the fit, and their shadows out of the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.object_pose import pixels_and_jacobian
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.observations import BallObservations
from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.units import Array

FEWEST_VIEWS = 3
"""Views of a ball below which its place takes up all that it says."""
MARGIN_PX = 3.0
"""Px around a ball's shadow that are left out too: the panel's blur."""
RIM_PX = 3.0
"""Width, px, of the ring around it whose mean fills the shadow: smoothing mixes it with pixels that count."""


def balls_of(observations: Sequence[BallObservations], matrices: ProjectionMatrices, centre: Array) -> Balls:
    """The balls as points of the fit; one table of observations for each ball, its pose ids those of the matrices.

    InputError where an id is not a view's, a ball is seen in fewer than 3 views, or nothing says how large it is.
    """
    n, k = len(matrices), len(observations)
    row = {name: j for j, name in enumerate(matrices.pose_id)}
    z, root, radius = np.zeros((n, k, 2)), np.zeros((n, k, 2, 2)), np.zeros(k)
    views = []
    for ball, seen in enumerate(observations):
        strange = [name for name in seen.pose_id if name not in row]
        if strange:
            raise InputError(
                f"ball {ball + 1} was observed in {strange[0]!r} ({len(strange)} such ids), which is no view of the "
                "matrices; each ball needs a table whose pose ids are those of the matrices"
            )
        at = np.array([row[name] for name, good in zip(seen.pose_id, seen.seen, strict=True) if good], dtype=np.intp)
        views.append(at)
        if len(at) < FEWEST_VIEWS:
            raise InputError(f"ball {ball + 1} is seen in {len(at)} views; at least {FEWEST_VIEWS} are needed")
        z[at, ball] = seen.x_D[seen.seen]
        root[at, ball] = np.linalg.cholesky(np.linalg.inv(seen.covariance[seen.seen])).transpose(0, 2, 1)
    balls = Balls(P=matrices.P, centre=centre, z=z, root=root, radius_mm=radius)
    per_mm = magnification(balls, balls.places(np.zeros((n, 6))))
    for ball, (seen, at) in enumerate(zip(observations, views, strict=True)):
        if seen.ball_diameter is not None:
            radius[ball] = seen.ball_diameter / 2
        elif seen.semi_major is not None and np.isfinite(seen.semi_major[seen.seen]).any():
            radius[ball] = np.nanmax(seen.semi_major[seen.seen] / per_mm[at, ball])
        else:
            raise InputError(
                f"nothing says how large ball {ball + 1} is, so that its shadow cannot be left out of the images; its "
                "observations need the silhouette's semi axes or a ball diameter"
            )
    return replace(balls, radius_mm=radius)


def magnification(balls: Balls, X: Array) -> Array:
    """(n, k) px for a millimetre across the beam, the larger of u and v, at the places X (k, 3)."""
    _, G = pixels_and_jacobian(balls.P, X)
    return np.asarray(np.linalg.norm(G, axis=3).max(axis=2))


def without_shadows(data: Measured, balls: Balls) -> Measured:
    """Images at full resolution in which the balls' shadows neither fit nor judge: their rims are points of the fit.

    Where a ball was not seen (another one before it, say) its shadow is where its place says.
    """
    m = data.matrices
    X = balls.places(np.zeros((len(m), 6)))
    expected, _ = pixels_and_jacobian(balls.P, X)
    centre = np.where(balls.seen[:, :, None], balls.z, expected)
    radius = magnification(balls, X) * balls.radius_mm + MARGIN_PX
    u, v = np.meshgrid(np.arange(m.n_u), np.arange(m.n_v), indexing="ij")
    p, weight, judge = (a.reshape(-1, m.n_u, m.n_v).copy() for a in (data.p, data.weight, data.judge))
    for j in range(len(m)):
        away = np.full((m.n_u, m.n_v), np.inf)
        for (c_u, c_v), r in zip(centre[j], radius[j], strict=True):
            away = np.minimum(away, np.hypot(u - c_u, v - c_v) - r)
        shadow, rim = away <= 0, (away > 0) & (away <= RIM_PX)
        weight[j][shadow], judge[j][shadow] = 0, 0
        if shadow.any() and rim.any():
            p[j][shadow] = p[j][rim].mean()
    flat = data.p.shape
    return replace(data, p=p.reshape(flat), weight=weight.reshape(flat), judge=judge.reshape(flat))
