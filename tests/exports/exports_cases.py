"""Geometries for the tests of exports: panels anywhere, built here without the library's mathematics."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tomopose import ProjectionMatrices

TOLERANCE_PX = 1e-6


def matrices_of(rotation, distances, offsets, *, n_u, n_v, p_u, p_v):
    """Columns of rotation (n, 3, 3): U, V and their cross product towards the source; distances (n, 2): origin and
    panel from the source along the normal, mm; offsets (n, 4): of the source (mm) and of the panel's centre (px)."""
    U, V, normal = (rotation[:, :, k] for k in range(3))
    S = offsets[:, :1] * U + offsets[:, 1:2] * V + distances[:, :1] * normal
    C = S - distances[:, 1:] * normal + offsets[:, 2:3] * p_u * U + offsets[:, 3:] * p_v * V
    O = C - (n_u - 1) / 2 * p_u * U - (n_v - 1) / 2 * p_v * V
    M = np.linalg.inv(np.stack([p_u * U, p_v * V, O - S], axis=-1))
    P = np.concatenate([M, -M @ S[..., None]], axis=-1)
    return ProjectionMatrices(
        P=P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, pose_id=tuple(f"scan-{k}" for k in range(len(P)))
    )


def random_matrices(seed, *, n=3, n_u=301, n_v=257, p_u=0.2, p_v=0.25, orientation="any", fixed=False):
    """Views with sources all around; `fixed`: one distance and piercing point for all, as of a real scanner."""
    rng = np.random.default_rng(seed)
    if orientation == "any":
        R = Rotation.random(n, random_state=rng).as_matrix()
    else:
        quarter = Rotation.from_euler("xyz", 90 * rng.integers(0, 4, (n, 3)), degrees=True)
        tilt = 0.0 if orientation == "aligned" else 10.0 ** rng.uniform(-14, -5)
        R = (quarter * Rotation.from_rotvec(tilt * rng.normal(size=(n, 3)))).as_matrix()
    rows = 1 if fixed else n
    SID = rng.uniform(150, 800, (n, 1))
    SDD = np.broadcast_to(rng.uniform(820, 1600, (rows, 1)), (n, 1))
    source = rng.uniform(-40, 40, (n, 2))
    panel = np.broadcast_to(rng.uniform(-30, 30, (rows, 2)), (n, 2))
    return matrices_of(R, np.hstack([SID, SDD]), np.hstack([source, panel]), n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)


@st.composite
def geometries(draw):
    """Odd and even sizes, non-square pixels, one or more views, any pose, gimbal locks and their surroundings."""
    return random_matrices(
        draw(st.integers(0, 2**32 - 1)),
        n=draw(st.integers(1, 5)),
        n_u=draw(st.integers(2, 2100)),
        n_v=draw(st.integers(2, 2100)),
        p_u=draw(st.floats(0.05, 0.5)),
        p_v=draw(st.floats(0.05, 0.5)),
        orientation=draw(st.sampled_from(["any", "aligned", "nearly aligned"])),
        fixed=draw(st.booleans()),
    )


def points(seed=0, m=25, reach=20.0):
    """(m, 3), mm, around the origin of W."""
    return np.random.default_rng(seed).uniform(-reach, reach, (m, 3))


def pixels(P, x):
    """(n, m, 2), px, of matrices (n, 3, 4); w must be positive."""
    h = np.einsum("nij,mj->nmi", np.asarray(P)[..., :3], x) + np.asarray(P)[:, None, :, 3]
    assert (h[..., 2] > 0).all(), "points must lie in front of the source"
    return h[..., :2] / h[..., 2:]


def circular_matrices(n=12, *, n_u=301, n_v=257, p_u=0.2, p_v=0.25):
    """An aligned circular scan with the source at +x at angle 0: every gimbal lock of every format at once."""
    alpha = 2 * np.pi * np.arange(n) / n
    c, s, o, i = np.cos(alpha), np.sin(alpha), np.zeros(n), np.ones(n)
    # The object turns by alpha, so the source turns by -alpha about it: U, V, normal at angle -alpha.
    R = np.stack([np.stack([s, c, o], -1), np.stack([o, o, i], -1), np.stack([c, -s, o], -1)], axis=-1)
    return matrices_of(
        R, np.tile([310.0, 1200.0], (n, 1)), np.tile([0.0, 0.0, 12.3, -7.9], (n, 1)), n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v
    )
