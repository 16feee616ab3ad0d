"""Parts of the joint fit: smoothing to the grid, the preconditioner, the prior's evidence and its jumps."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.errors import EngineError
from tomopose.refinement.estimate import judged_at, levels_of
from tomopose.refinement.joint_fit.linear import Linear
from tomopose.refinement.joint_fit.measured import Measured, with_held_out
from tomopose.refinement.joint_fit.motions import pixel_jacobian
from tomopose.refinement.joint_fit.precondition import passed_frequencies
from tomopose.refinement.joint_fit.projector import PIECE, Projector, Workers
from tomopose.refinement.joint_fit.pyramid import SHARPEST, level_of, px_per_mm, smoothed
from tomopose.refinement.judge import Evidence, Trial, Verdict, decide
from tomopose.refinement.prior import scatter
from tomopose.refinement.run import jumps
from tomopose.refinement.settings import OPEN_PX
from tomopose.refinement.uncertainty import open_directions, size_sigma

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "refine"))
import objects

PANEL = objects.Panel(n_u=47, n_v=43, p_u=2.8, p_v=2.7, u_0=24.3, v_0=20.2)
GRID = tp.VoxelGrid(shape=(23, 24, 25), spacing=0.8)


def matrices(n=12):
    P = objects.matrices(objects.path("seven", n), np.zeros((n, 3)), PANEL)
    return tp.ProjectionMatrices(P=P, n_u=47, n_v=43, p_u=2.8, p_v=2.7, pose_id=tuple(map(str, range(n))))


def data_of(p):
    m = matrices(len(p))
    ones = np.ones_like(p)
    return Measured(p=p, weight=ones, judge=0 * ones, matrices=m, grid=GRID)


def test_images_are_smoothed_to_the_edge_that_the_grid_holds_less_the_pixels_own():
    data = data_of(np.zeros((12, 47 * 43), dtype=np.float32))
    level = smoothed(data)
    voxel_px = px_per_mm(data) * 0.8
    np.testing.assert_allclose(np.square(level.blur) + 1 / 12, (SHARPEST * voxel_px) ** 2)
    np.testing.assert_allclose(px_per_mm(data), [1200 / 2.8 / 226, 1200 / 2.7 / 226], rtol=0.01)


def test_the_noise_left_by_the_smoothing_is_that_of_smoothed_noise():
    level = smoothed(data_of(np.zeros((12, 47 * 43), dtype=np.float32)))
    noise = np.random.default_rng(1).standard_normal((12, 47 * 43)).astype(np.float32)
    assert np.std(level.smooth(noise)) == pytest.approx(level.noise_left, rel=0.03)


def test_a_held_out_pixel_that_is_mixed_with_others_judges_no_longer():
    p = np.zeros((12, 47, 43), dtype=np.float32)
    judge = p.copy()
    judge[:, 8:16, 8:16] = 1
    level = smoothed(replace(data_of(p.reshape(12, -1)), judge=judge.reshape(12, -1)))
    kept = level.judge.reshape(judge.shape) > 0
    assert kept[:, 9:15, 9:15].all()
    assert kept.sum() == 12 * 36


@pytest.mark.parametrize("levels", [(2, 1), (4, 2, 1), (8, 4)])
def test_pixels_are_left_that_judge_at_every_level(levels):
    P = objects.matrices(objects.path("seven", 12), np.zeros((12, 3)), PANEL)
    m = tp.ProjectionMatrices(P=P, n_u=376, n_v=344, p_u=0.35, p_v=0.3375, pose_id=tuple(map(str, range(12))))
    ones = np.ones((12, 376 * 344), dtype=np.float32)
    grid = tp.VoxelGrid.cube(n=20, spacing=8.0)  # so coarse that every level is smoothed
    data = Measured(p=0 * ones, weight=ones, judge=0 * ones, matrices=m, grid=grid)
    data = with_held_out(data, 0.08, coarsest=levels[0], seed=0)
    assert np.mean(data.judge > 0) == pytest.approx(0.08, abs=0.03)
    assert np.all((data.judge > 0) != (data.weight > 0))
    for factor in levels:
        level = level_of(data, factor)
        assert any(level.blur)
        assert np.mean(level.judge > 0) > 0.01


def test_a_fit_that_no_pixel_judges_is_not_determined():
    n = np.zeros(3)
    silent = Trial(before=n, after=n, pixels=0, gain=-np.inf, residual_before=n, residual_after=n)
    verdict, reasons = decide(Evidence(held_out=silent, chi=1.0, faces=(), left=1.0, edges=(), open_=(), moved=9.0))
    assert verdict is Verdict.UNDETERMINED
    assert "held_out" in reasons[0]


@pytest.mark.parametrize("chi", [1.4, 14.0])
def test_a_correction_kept_beside_residuals_above_noise_says_that_its_uncertainty_does_not_hold(chi):
    n = np.zeros(3)
    gained = Trial(before=n, after=n, pixels=90, gain=8.9, residual_before=n, residual_after=n)
    verdict, reasons = decide(Evidence(held_out=gained, chi=chi, faces=(), left=1.0, edges=(), open_=(), moved=3.4))
    assert verdict is Verdict.REFINED
    assert any("14.0 times the images' noise" in r for r in reasons) is (chi > 2)


def test_preconditioned_turns_come_nearer_to_the_solution_than_as_many_plain_ones():
    m = matrices()
    projector = Workers(threads=1).projector(m, GRID)
    rng = np.random.default_rng(0)
    free = np.zeros([k + 3 for k in (25, 24, 23)], dtype=bool)
    free[1:-2, 1:-2, 1:-2] = True
    truth = np.where(free, rng.standard_normal(free.shape), 0).astype(np.float32)
    n = len(m)
    lines = projector.project(truth)
    J, w = np.ones((n, 1, lines.shape[1]), dtype=np.float32), np.ones_like(lines)

    def left(turns, H):
        linear = Linear.of(projector, free, J, w, 1e6 * np.eye(n), 1.0, H)
        return linear.solve(lines, np.zeros(n), np.zeros_like(truth), turns=turns, tolerance=0)[0]

    best = left(200, None)
    H = passed_frequencies(m, GRID)
    plain, eased = (np.linalg.norm(left(6, each) - best) for each in (None, H))
    assert eased < 0.7 * plain


def test_a_cluster_projects_in_pieces_to_the_bytes_that_this_machine_has():
    distributed = pytest.importorskip("distributed")
    n = 2 * PIECE + 5
    m, rng = matrices(n), np.random.default_rng(3)
    volume = rng.random(GRID.shape).astype(np.float32)
    y = rng.standard_normal((n, 47 * 43)).astype(np.float32)

    def answers(projector: Projector):
        x = projector.put(volume)
        return projector.project(x), *projector.with_derivatives(x), projector.back(y)

    here = answers(Workers(threads=2).projector(m, GRID))
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        there = answers(Workers(threads=1, client=client).projector(m, GRID))
    for own, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(other, own)
    # the adjoint of a projection: <A x, y> = <x, A' y>
    x = Workers(threads=1).projector(m, GRID).put(volume)
    assert np.vdot(here[0].astype(float), y) == pytest.approx(np.vdot(x.astype(float), here[3]), rel=1e-4)


def test_a_cluster_without_workers_is_an_error():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
        pytest.raises(EngineError, match="no workers"),
    ):
        Workers(threads=1, client=client).projector(matrices(), GRID).back(np.zeros((12, 47 * 43), np.float32))


def test_levels_that_do_not_fit_the_memory_or_the_work_are_left_out():
    data = data_of(np.zeros((12, 47 * 43), dtype=np.float32))
    assert levels_of(data, tp.RefineSettings()) == (1,)
    assert levels_of(data, tp.RefineSettings(memory_gib=0.35001)) == (16,)
    large = replace(data, matrices=replace(data.matrices, n_u=512, n_v=500))
    assert levels_of(large, tp.RefineSettings(memory_gib=8)) == (4, 2, 1)
    assert levels_of(large, tp.RefineSettings(memory_gib=0.5)) == (8, 4, 2)


def test_what_judges_is_seen_at_twice_the_finest_binning_where_pixels_remain():
    data = data_of(np.zeros((12, 47 * 43), dtype=np.float32))
    large = replace(data, matrices=replace(data.matrices, n_u=512, n_v=500))
    assert judged_at(large, (8, 4), 4) == 8
    assert judged_at(large, (8, 4), 8) == 8  # a fit that ended at its first level
    assert judged_at(large, (4, 2, 1), 1) == 2
    assert judged_at(large, (16, 8), 8) == 8
    assert judged_at(data, (1,), 1) == 1


def test_evidence_finds_the_size_of_the_scatter_and_leaves_none_where_there_is_none():
    n, rng = 40, np.random.default_rng(3)
    prior = scatter(np.full(n, 0.2), np.full(n, 0.02))
    information = np.kron(np.eye(n), np.diag([1e4] * 3 + [1e6] * 3))
    truth = rng.standard_normal((n, 6)) * np.array([0.1] * 3 + [0.0] * 3)
    seen = truth + rng.standard_normal((n, 6)) * np.array([0.01] * 3 + [0.001] * 3)
    posterior = np.linalg.solve(information + prior.precision, information @ seen.ravel())
    sizes = prior.by_evidence(posterior.reshape(n, 6), information).sizes
    assert sizes[0] == pytest.approx(0.5, rel=0.2)
    assert sizes[1] < 0.03


def test_a_view_that_jumps_gets_a_prior_of_its_own():
    prior = scatter(np.full(9, 0.1), np.full(9, 0.01))
    q = np.zeros((9, 6))
    q[4, 0] = 2.0
    wide = prior.with_jumps(q)
    assert np.sqrt(wide.blocks[4, 0, 0]) == pytest.approx(0.1 * 20 / np.sqrt(6))
    np.testing.assert_array_equal(wide.blocks[3], prior.blocks[3])
    np.testing.assert_array_equal(wide.stated.blocks, prior.blocks)


def test_a_view_is_a_jump_beyond_the_others_and_beyond_its_own_uncertainty():
    moved = 0.01 * np.random.default_rng(0).standard_normal((30, 5, 2))
    moved[4] = 0.5
    assert jumps(moved, np.full((30, 5), 0.02)) == (4,)
    assert jumps(moved, np.full((30, 5), 0.2)) == ()
    moved[4] = 0.01
    assert jumps(moved, np.full((30, 5), 0.001)) == ()


def test_a_turn_that_no_image_shows_is_open_by_what_it_leaves_in_pixels():
    m, points = matrices(), np.array([[8.0, 0, 0], [0, 8, 0], [0, 0, 8]])
    K = pixel_jacobian(m.P, points, np.zeros(3))
    information = np.tile(np.diag([1e6, 1e6, 1e6, 1e8, 1e8, 0.0]), (12, 1, 1))
    (loose,) = open_directions(information, scatter(np.full(12, 0.2), np.full(12, 0.02)), K, 10.0)
    (tight,) = open_directions(information, scatter(np.full(12, 0.2), np.full(12, 0.0002)), K, 10.0)[-1:]
    assert "A turn of the object about z" in loose.words
    assert loose.left_px == pytest.approx(0.02 * np.sqrt(np.mean(K[..., 5] ** 2)))
    assert loose.left_px > OPEN_PX > tight.left_px


def test_the_size_of_the_object_is_as_uncertain_as_the_mean_depth_of_the_views():
    m, centre = matrices(), np.zeros(3)
    sigma = 0.3
    prior = scatter(np.full(12, sigma), np.full(12, 1e-3))
    x = np.array([[8.0, 0, 0], [-8, 0, 0], [0, 8, 0], [0, -8, 0], [0, 0, 8], [0, 0, -8]])
    shared = size_sigma(prior, m.P, x, centre)
    # a depth off by sigma / sqrt(12) of 226 mm; an image of 8 mm is 1200 / 226 / 2.8 px/mm large; seen edge-on as small
    full = sigma / np.sqrt(12) / 226 * 8 * 1200 / 226 / 2.8
    assert 0.3 * full < np.sqrt(np.mean(shared**2)) < full
