"""Integrals and their six derivatives in one walk, against differences of a plain Joseph sum in float64."""

from __future__ import annotations

import numpy as np
import pytest

import tomopose as tp
from tomopose.engines.cpu import CpuEngine
from tomopose.geometry.rotations import R_x, R_z
from tomopose.refinement.joint_fit.derivatives import integrals_with_derivatives
from tomopose.refinement.joint_fit.motions import composed, gauge, motions_of, transforms, without_gauge

GRID = tp.VoxelGrid(shape=(23, 21, 26), spacing=[0.9, 1.1, 1.0], centre=[0.7, -0.4, 1.3])


def scan(n=5):
    """Matrices of non-square pixels, an off-centre piercing point and an odd panel, tilted and turned."""
    K = np.array([[900 / 1.1, 0, 19.3], [0, 900 / 0.8, 27.8], [0, 0, 1.0]])
    camera = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    P = []
    for k in range(n):
        R = R_x(0.15 * np.sin(k)) @ R_z(2 * np.pi * k / n + 0.2)
        P.append(K @ np.hstack([camera @ R, (np.array([0.4, -0.7, 410.0]))[:, None]]))
    return tp.ProjectionMatrices(P=np.array(P), n_u=43, n_v=55, p_u=1.1, p_v=0.8, pose_id=tuple("abcde"[:n]))


def volume():
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in GRID.shape), indexing="ij")
    return (np.exp(-2 * (x - 0.2) ** 2 - 1.5 * (y + 0.1) ** 2 - (z - 0.1) ** 2) * (1 + 0.3 * x * z)).astype(np.float32)


def joseph(f, P, u, v):
    """The sum along the ray of pixel (u, v), float64: planes across the steepest axis, bilinear in each."""
    M = np.linalg.inv(P[:, :3])
    s, d = -M @ P[:, 3], M @ [u, v, 1.0]
    s, e = (s - GRID.origin) / GRID.spacing, d / GRID.spacing
    axis = int(np.abs(e).argmax())
    others = [k for k in range(3) if k != axis]
    padded, total = np.pad(f.transpose(2, 1, 0).astype(np.float64), 2), 0.0
    for k in range(GRID.n_xyz[axis]):
        at = s + (k - s[axis]) / e[axis] * e
        if any(not -1 < at[o] < GRID.n_xyz[o] for o in others):
            continue
        low = np.floor(at).astype(int)
        low[axis] = k
        part = at - low
        for a in (0, 1):
            for b in (0, 1):
                index = low.copy()
                index[others[0]] += a
                index[others[1]] += b
                weight = abs(1 - a - part[others[0]]) * abs(1 - b - part[others[1]])
                total += weight * padded[tuple(index + 2)]
    return total * np.linalg.norm(d) / abs(e[axis])


@pytest.mark.slow
@pytest.mark.parametrize("vector", [True, False])
def test_derivatives_are_those_of_the_sum_to_1e_4(vector):
    matrices, f, h = scan(), volume(), 1e-6
    state = CpuEngine(matrices, GRID, threads=1).put(f)
    lines, J = integrals_with_derivatives(state, matrices, GRID, range(5), threads=1, vector=vector)
    rng, found, expected, values = np.random.default_rng(0), [], [], []
    for _ in range(40):
        j, u, v = rng.integers(5), rng.integers(8, 35), rng.integers(8, 47)
        row = []
        for i in range(6):
            q = np.zeros((1, 6))
            q[0, i] = h
            moved = [matrices.P[j] @ transforms(s * q, np.asarray(GRID.centre))[0] for s in (1, -1)]
            row.append((joseph(f, moved[0], u, v) - joseph(f, moved[1], u, v)) / (2 * h))
        found.append(J[j, :, v, u])
        expected.append(row)
        values.append((lines[j, v, u], joseph(f, matrices.P[j], u, v)))
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-4)
    np.testing.assert_allclose(*np.array(values).T, rtol=2e-6)


def test_the_integral_of_the_walk_is_the_engines_own():
    matrices, f = scan(), volume()
    engine = CpuEngine(matrices, GRID, threads=1)
    state = engine.put(f)
    lines, _ = integrals_with_derivatives(state, matrices, GRID, range(5), threads=2)
    np.testing.assert_array_equal(lines, engine.forward(state, range(5)))


def test_motions_compose_as_their_transforms_and_invert():
    rng, centre = np.random.default_rng(1), np.array([3.0, -2.0, 7.0])
    a, b = (rng.normal(size=(4, 6)) * [1, 1, 1, 0.3, 0.3, 0.3] for _ in range(2))
    np.testing.assert_allclose(motions_of(transforms(a, centre), centre), a, atol=1e-12)
    both = transforms(a, centre) @ transforms(b, centre)
    np.testing.assert_allclose(transforms(composed(a, b, centre), centre), both, atol=1e-12)


def test_a_common_motion_and_a_common_size_are_taken_out():
    matrices, centre = scan(), np.asarray(GRID.centre)
    G, precision = gauge(matrices.P, centre), np.eye(30)
    rng = np.random.default_rng(2)
    own = without_gauge(rng.normal(size=(5, 6)), G, precision)
    mixed = own + np.einsum("nij,j->ni", G, [1, -2, 0.5, 0.1, 0.2, -0.3, 1e-3])
    np.testing.assert_allclose(without_gauge(mixed, G, precision), own, atol=1e-9)


def test_the_size_direction_leaves_every_image_of_an_enlarged_object_as_it_was():
    matrices, centre, eps = scan(), np.asarray(GRID.centre), 1e-4
    x = centre + np.random.default_rng(3).normal(size=(6, 3)) * 5
    larger = centre + (1 + eps) * (x - centre)
    q = eps * gauge(matrices.P, centre)[:, :, 6]
    moved = tp.ProjectionMatrices(
        P=matrices.P @ transforms(q, centre), n_u=43, n_v=55, p_u=1.1, p_v=0.8, pose_id=matrices.pose_id
    )
    assert np.abs(moved.project(larger) - matrices.project(x)).max() < 1e-5
