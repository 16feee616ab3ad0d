"""Projection matrices: canonical scale, decomposition, binning, and what has no panel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tomopose import PoseSequence, ProjectionMatrices
from tomopose.errors import FrameMismatchError, InputError, OutOfViewError, ShapeError
from tomopose.geometry.projection import canonical, compose, eq5_matrices, project_ball, row_flip

PIXEL = 1e-8


@pytest.fixture
def matrices(scanner, T_HT, rng):
    s = replace(scanner, eta=0.01, theta=0.02, phi=-0.015)
    n = 9
    poses = PoseSequence.from_table(
        rng.uniform(-9, 9, (n, 3)), rng.uniform(-20, 20, (n, 3)), alpha=rng.uniform(-3, 3, n)
    )
    P = eq5_matrices(s, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    return ProjectionMatrices(P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=poses.pose_id, scanner=s)


def test_decomposition_finds_the_scanner_again(matrices):
    s, g = matrices.scanner, matrices.decompose()
    U, V, O = s.panel
    normal = np.cross(V, U) / np.linalg.norm(np.cross(V, U))
    assert_allclose(np.linalg.norm(g.U, axis=1), s.p_u)
    assert_allclose(np.linalg.norm(g.V, axis=1), s.p_v)
    assert_allclose(g.d_SD, abs(normal @ O), rtol=1e-11)
    assert_allclose(np.linalg.norm(g.normal, axis=1), 1)
    assert (np.einsum("ni,ni->n", g.normal, g.centre - g.source) > 0).all()
    # the piercing point is where the panel's normal through the source meets it
    assert_allclose(matrices.project(g.source[3:4] + 1.0 * g.normal[3:4])[3, 0], [g.u_0[3], g.v_0[3]], atol=PIXEL)


def test_composition_is_the_inverse_of_decomposition(matrices, rng):
    g = matrices.decompose()
    back = compose(g.source, g.centre, g.U, g.V, n_u=matrices.n_u, n_v=matrices.n_v)
    x = rng.uniform(-20, 20, (25, 3))
    assert_allclose(replace(matrices, P=back).project(x), matrices.project(x), atol=PIXEL)


def test_scale_and_sign_are_made_canonical(matrices):
    assert_allclose(canonical(-2.5 * matrices.P), matrices.P, rtol=1e-12, atol=1e-12)
    assert_allclose(replace(matrices, P=-3 * matrices.P).P, matrices.P, rtol=1e-12, atol=1e-12)


def test_row_flip_is_its_own_inverse_and_mirrors_v(matrices, rng):
    x = rng.uniform(-5, 5, (4, 3))
    F = row_flip(matrices.n_v)
    assert_allclose(F @ F, np.eye(3), atol=0)
    flipped = replace(matrices, P=matrices.top_first()).project(x)
    assert_allclose(flipped[..., 1], matrices.n_v - 1 - matrices.project(x)[..., 1], atol=PIXEL)
    assert_allclose(flipped[..., 0], matrices.project(x)[..., 0], atol=PIXEL)


def test_binned_matrices_are_those_of_the_binned_scanner(scanner, T_HT, rng):
    poses = PoseSequence.from_table(rng.uniform(-9, 9, (3, 3)), rng.uniform(-5, 5, (3, 3)))
    P, P_2 = (eq5_matrices(s, T_HT=T_HT, T_MH=poses.T_MH) for s in (scanner, scanner.binned(2)))
    m = ProjectionMatrices(
        P=P, n_u=scanner.n_u, n_v=scanner.n_v, p_u=scanner.p_u, p_v=scanner.p_v, pose_id=poses.pose_id, scanner=scanner
    )
    assert_allclose(m.binned(2).P, P_2, atol=1e-9)
    assert m.binned(2).scanner == scanner.binned(2)


def test_millimetres_to_metres_leave_the_pixels(scanner, T_HT, rng):
    poses = PoseSequence.from_table(rng.uniform(-9, 9, (3, 3)), rng.uniform(-5, 5, (3, 3)))
    t = rng.uniform(-5, 5, 3)
    k = 1e-3
    small = replace(scanner, d_SD=scanner.d_SD * k, d_SR=scanner.d_SR * k, p_u=scanner.p_u * k, p_v=scanner.p_v * k)
    assert_allclose(
        project_ball(small, T_HT=replace(T_HT, t=T_HT.t * k), T_MH=replace(poses.T_MH, t=poses.T_MH.t * k), t=t * k),
        project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t),
        atol=PIXEL,
    )


def test_points_behind_the_source_have_no_pixel(matrices):
    behind = matrices.decompose().source[0] * 1.2
    assert np.isnan(matrices.project(behind[None])[0]).all()
    with pytest.raises(OutOfViewError, match="behind the source") as caught:
        matrices.require_in_front(behind[None])
    assert 0 in caught.value.indices


def test_wrong_pitch_and_skew_have_no_panel(matrices):
    with pytest.raises(InputError, match="aspect ratio"):
        replace(matrices, p_u=0.21).decompose()
    skewed = np.array([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]) @ matrices.P
    with pytest.raises(InputError, match="view 0: skew"):
        replace(matrices, P=skewed, p_v=np.hypot(matrices.p_v, 0.01 * matrices.p_u)).decompose()


def test_wrong_frames_are_named(scanner, T_HT):
    with pytest.raises(FrameMismatchError, match="T_MH is needed"):
        project_ball(scanner, T_HT=T_HT, T_MH=T_HT, t=np.zeros(3))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"P": np.zeros((0, 3, 4)), "pose_id": ()}, InputError, "no projection matrices"),
        ({"P": np.zeros((9, 3, 4))}, InputError, "third row"),
        ({"P": np.full((9, 3, 4), np.nan)}, InputError, "not finite"),
        ({"P": np.zeros((9, 4, 4))}, ShapeError, r"\(n, 3, 4\)"),
        ({"pose_id": ("a",)}, InputError, "9 matrices but 1 pose ids"),
        ({"p_u": -0.1}, InputError, "p_u"),
        ({"n_v": 0}, InputError, "n_v"),
    ],
)
def test_what_are_no_projection_matrices(matrices, change, error, message):
    with pytest.raises(error, match=message):
        replace(matrices, **change)


def test_views_can_be_selected(matrices):
    part = matrices.select([4, 1])
    assert part.pose_id == (matrices.pose_id[4], matrices.pose_id[1])
    assert_allclose(part.P[0], matrices.P[4])
