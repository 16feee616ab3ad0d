"""Balls on the object whose places nobody knows join the fit as points with the same poses."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import tomopose as tp
from tomopose.cli.main import run
from tomopose.refinement.joint_fit.balls_seen import balls_of, without_shadows
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.refinement.joint_fit.motions import composed, gauge, transforms

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "refine"))
import objects

PANEL = objects.Panel(n_u=47, n_v=43, p_u=2.8, p_v=2.7, u_0=24.3, v_0=20.2)
GRID = tp.VoxelGrid(shape=(32, 32, 32), spacing=0.63, centre=(0.3, -0.2, 0.1))
PLACES = np.array([[10.6, 0.4, 4.0], [-7.0, 7.9, -5.0], [0.5, -10.5, 6.0], [6.0, 5.0, -7.5]])
SIGMA = 0.01


def scan(n=24, seed=0):
    """P as calibrated, P true, and what is seen of each ball: true projections with noise."""
    P = objects.matrices(objects.path("seven", n), np.zeros((n, 3)), PANEL)
    truth = objects.moved(P, objects.errors("white", n, seed, PANEL))
    ids = tuple(f"p{j}" for j in range(n))
    matrices = tp.ProjectionMatrices(P=P, n_u=47, n_v=43, p_u=2.8, p_v=2.7, pose_id=ids)
    u = objects.pixels(truth, PLACES) + SIGMA * np.random.default_rng(5).standard_normal((n, len(PLACES), 2))
    seen = [tp.BallObservations.from_sigma(u[:, k], SIGMA, pose_id=ids, ball_diameter=1.2) for k in range(len(PLACES))]
    return matrices, truth, seen


def test_the_places_that_nobody_knows_are_eliminated_as_differences_of_the_cost_say():
    matrices, _, seen = scan(8)
    balls = balls_of([each.select(np.arange(1, 8)) if k == 1 else each for k, each in enumerate(seen)], matrices,
                     GRID.centre)  # fmt: skip
    q = 0.02 * np.random.default_rng(0).standard_normal((8, 6)) * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    B, g = balls.reduced(q)
    eye = 1e-4 * np.random.default_rng(1).standard_normal((6, 48))
    base = balls.cost(q)
    for dq in eye:
        ahead, behind = (balls.cost(composed(q, s * dq.reshape(8, 6), GRID.centre)) for s in (1, -1))
        assert (ahead - behind) / 2 == pytest.approx(-2 * g @ dq, rel=1e-3)
        assert (ahead + behind) / 2 - base == pytest.approx(dq @ B @ dq, rel=0.05)


def test_a_common_motion_and_the_size_of_the_object_stay_as_open_as_without_balls():
    matrices, _, seen = scan(8)
    balls = balls_of(seen, matrices, GRID.centre)
    B, _ = balls.reduced(np.zeros((8, 6)))
    G = gauge(matrices.P, GRID.centre).reshape(48, 7)
    G = G / np.linalg.norm(G, axis=0)
    typical = np.sqrt(np.trace(B) / 48)
    assert np.all(np.einsum("ij,ik,kj->j", G, B, G) < 1e-6 * typical**2)


def test_with_balls_alone_steps_to_the_minimum_bring_the_views_back():
    matrices, truth, seen = scan()
    balls, q = balls_of(seen, matrices, GRID.centre), np.zeros((24, 6))
    weak = np.diag(np.tile([1 / 0.5**2] * 3 + [1 / 0.01**2] * 3, 24))
    for _ in range(5):
        B, g = balls.reduced(q)
        q = q + np.linalg.solve(B + weak, g - weak @ q.ravel()).reshape(24, 6)
    after = objects.error_px(matrices.P @ transforms(q, GRID.centre), truth)
    assert objects.error_px(matrices.P, truth) > 1
    assert after < 0.08
    assert 0.4 < balls.misfit(q) < 0.6  # 192 numbers, 137 of them for poses: sqrt(43 / 180)


def test_shadows_neither_fit_nor_judge_also_where_a_ball_was_not_seen():
    matrices, _, seen = scan(8)
    hidden = replace(seen[0], seen=np.arange(8) != 3)
    balls = balls_of([hidden, *seen[1:]], matrices, GRID.centre)
    ones = np.ones((8, 47 * 43), dtype=np.float32)
    data = Measured(p=ones, weight=ones, judge=ones, matrices=matrices, grid=GRID)
    out = without_shadows(data, balls)
    left = out.weight.reshape(8, 47, 43) > 0
    assert np.array_equal(left, out.judge.reshape(8, 47, 43) > 0)
    expected = matrices.project(balls.places(np.zeros((8, 6))))[3, 0]
    for u, v in (*seen[1].x_D,):
        assert not left[:, round(u), round(v)].all()
    assert not left[3, round(expected[0]), round(expected[1])]
    share = 1 - left.mean()
    radius = 0.6 * 1200 / 226 / 2.75 + 3
    assert 0.5 < share / (4 * np.pi * radius**2 / (47 * 43)) < 1.1


def test_balls_of_other_views_too_few_views_or_no_size_are_refused():
    matrices, _, seen = scan(8)
    with pytest.raises(tp.TomoposeError, match="which is no view of the matrices"):
        balls_of([replace(seen[0], pose_id=tuple("abcdefgh"))], matrices, GRID.centre)
    with pytest.raises(tp.TomoposeError, match="ball 2 is seen in 2 views"):
        balls_of([seen[0], seen[1].select([0, 4])], matrices, GRID.centre)
    with pytest.raises(tp.TomoposeError, match="how large ball 1 is"):
        balls_of([replace(seen[0], ball_diameter=None)], matrices, GRID.centre)


def test_the_command_takes_a_table_for_each_ball_and_refuses_one_of_other_views(tmp_path, capsys):
    matrices, truth, seen = scan(8)
    tp.write_matrices(tmp_path / "m.npz", matrices)
    p = objects.line_integrals(truth, objects.balls(), PANEL)
    tifffile.imwrite(tmp_path / "scan.tif", np.exp(-p)[:, ::-1].astype(np.float32))
    tp.write_observations(tmp_path / "first.csv", replace(seen[0], semi_major=np.full(8, 1.2)))
    tp.write_observations(tmp_path / "second.csv", replace(seen[1], pose_id=tuple("abcdefgh")))
    words = f"refine --matrices {tmp_path}/m.npz --images {tmp_path}/scan.tif --images-are transmission --voxel-mm 0.63"
    code = run(
        f"{words} --size 32 --balls {tmp_path}/first.csv --balls {tmp_path}/second.csv --out {tmp_path}/o".split()
    )
    assert code == 1
    assert "ball 2 was observed in 'a' (8 such ids)" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_a_body_of_revolution_needs_the_balls_on_it():
    matrices, truth, seen = scan()
    body = [
        objects.Solid(kind="ellipsoid", centre=(0.0, 0.0, -1.0), half=(5.0, 5.0, 6.0), mu=0.04),
        objects.Solid(kind="ellipsoid", centre=(0.0, 0.0, 2.0), half=(2.0, 2.0, 2.0), mu=-0.02),
    ]
    balls = [objects.Solid(kind="ellipsoid", centre=tuple(x), half=(0.6,) * 3, mu=0.3) for x in PLACES]
    p = objects.line_integrals(truth, body + balls, PANEL)
    images = np.random.default_rng(2).poisson(np.exp(-p) / 0.004**2) * 0.004**2
    result = tp.refine(
        images, matrices, GRID, balls=seen, images_are="transmission", settings=tp.RefineSettings(threads=1)
    )
    assert result.verdict == "refined"
    assert objects.error_px(np.asarray(result.matrices), truth) < 0.05
    assert 0.3 < result.balls_misfit < 1.2
    apart = np.linalg.norm(result.balls[:, None] - result.balls, axis=2)
    expected = np.linalg.norm(PLACES[:, None] - PLACES, axis=2)
    np.testing.assert_allclose(apart, expected, atol=0.02)
    alone = objects.line_integrals(truth, body, PANEL)
    images = np.random.default_rng(2).poisson(np.exp(-alone) / 0.004**2) * 0.004**2
    without = tp.refine(images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(threads=1))
    # 0.018 px with the balls, 0.212 px without
    assert objects.error_px(np.asarray(without.matrices), truth) > 5 * objects.error_px(
        np.asarray(result.matrices), truth
    )
