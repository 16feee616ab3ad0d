"""Runs: exact centres, edges against oversampling, focal spot and motion, the same bytes everywhere."""

from __future__ import annotations

import importlib.util
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tomopose import PoseSequence, RigidTransform, Scanner
from tomopose.errors import InputError, OutOfViewError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.simulation.detector.blur import pixel_kernel
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.detector.scatter_glare_mtf import (
    MTF,
    Glare,
    Scatter,
    wide_blur,
    with_glare,
    with_mtf,
    with_scatter,
)
from tomopose.simulation.objects.ball import silhouette_centre
from tomopose.simulation.objects.shapes import Solid, sphere
from tomopose.simulation.projector.focal_spot import FocalSpot, Motion
from tomopose.simulation.run import render, signal, simulate_ball_run, transmission

ROOT = Path(__file__).resolve().parents[2]
SMALL = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=71.3, v_0=58.7, n_u=141, n_v=123, eta=0.01, theta=0.02)
T_HT = RigidTransform.from_angles([0.007, 0.005, 3.126], [-0.9, 0.6, 0.4], source=Frame.H, target=Frame.T)
POSES = PoseSequence.from_table([[0, 0, 0], [0.7, -1.2, 0.9]], [[0, 0, 0], [5, 0, 0]], alpha=np.array([0.0, 0.3]))
T_BALL = np.array([0.25, 0.55, -0.65])


def bare_ball(scanner=SMALL, *, diameter=4.0, **detector):
    solids = (Solid(shape=sphere(diameter / 2).placed(t=T_BALL), material="WC-Co"),)
    run = simulate_ball_run(scanner, T_HT=T_HT, t=T_BALL, poses=POSES, ball_diameter=diameter, solids=solids, seed=3)
    return replace(run, detector=Detector(**{"snr": math.inf, **detector}))


@pytest.fixture(scope="module")
def oversampling():
    spec = importlib.util.spec_from_file_location("oversampling", ROOT / "benchmarks/simulation/oversampling.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_centre_and_edge_against_oversampling(oversampling):
    run = bare_ball(blur_sigma=0.7)
    T = transmission(run, 1)
    x = run.truth()["poses"][1]
    window = (int(x["u_px"]) - 28, int(x["v_px"]) - 24, 57, 49)
    reference = oversampling.ball_image(run, 1, window, n=96, sigma=0.7)
    mine = T[window[1] : window[1] + window[3], window[0] : window[0] + window[2]]
    assert np.abs(oversampling.shift_between(mine, reference)).max() < 1e-4
    assert oversampling.edge_error(mine, reference) < 0.002


def test_a_ball_on_the_axis_gives_a_symmetric_image(oversampling):
    scanner = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.4, u_0=50.0, v_0=50.0, n_u=101, n_v=101)
    mount = RigidTransform.identity(Frame.H, Frame.T)
    solids = (Solid(shape=sphere(2.0), material="WC-Co"),)
    run = simulate_ball_run(scanner, T_HT=mount, t=np.zeros(3), poses=POSES.select([0]), solids=solids)
    T = transmission(run, 0)
    for mirrored in (T[::-1], T[:, ::-1]):
        assert np.abs(oversampling.shift_between(T, mirrored)).max() / 2 < 2e-5


def test_truth_is_eq6_and_the_ellipse_lies_outward():
    run = bare_ball()
    x_D = project_ball(SMALL, T_HT=T_HT, T_MH=POSES.T_MH, t=T_BALL, alpha=POSES.alpha)
    truth = run.truth()["poses"]
    np.testing.assert_allclose([[p["u_px"], p["v_px"]] for p in truth], x_D, atol=1e-12)
    on_axis = silhouette_centre(SMALL, [0.0, 0.0, 200.0], 2.0)
    straight = replace(SMALL, eta=0.0, theta=0.0)
    np.testing.assert_allclose(silhouette_centre(straight, [0.0, 0.0, 200.0], 2.0)[0], [71.3, 58.7], atol=1e-9)
    assert np.linalg.norm(on_axis[0] - [71.3, 58.7]) < 0.05
    with pytest.raises(OutOfViewError):
        silhouette_centre(SMALL, [0.0, 0.0, 1.0], 2.0)


def test_the_silhouette_is_an_ellipse_with_that_centre():
    c, r = np.array([-12.0, 9.0, 195.0]), 4.0
    rng = np.random.default_rng(0)
    # Points where rays from the source touch the ball, projected, lie on a conic whose centre is fitted here.
    axis = c / np.linalg.norm(c)
    a = np.linalg.svd(axis[None])[2][1:]
    k = math.sqrt(1 - r * r / (c @ c)) * np.linalg.norm(c)
    rho = r * k / np.linalg.norm(c)
    angle = rng.uniform(0, 2 * np.pi, 60)
    x = axis * k * k / np.linalg.norm(c) + rho * (np.cos(angle)[:, None] * a[0] + np.sin(angle)[:, None] * a[1])
    h = x @ SMALL.K.T
    p = h[:, :2] / h[:, 2:]
    q = p - p.mean(axis=0)
    A = np.column_stack([q[:, 0] ** 2, q[:, 0] * q[:, 1], q[:, 1] ** 2, q])
    A2, B, C, D, E = np.linalg.lstsq(A, np.ones(len(q)), rcond=None)[0]
    centre = np.linalg.solve([[2 * A2, B], [B, 2 * C]], [-D, -E]) + p.mean(axis=0)
    np.testing.assert_allclose(silhouette_centre(SMALL, c, r)[0], centre, atol=1e-7)


def test_the_same_bytes_from_any_worker_and_thread():
    run = simulate_ball_run(SMALL, T_HT=T_HT, t=T_BALL, poses=POSES, ball_diameter=4.0, seed=11)
    image = run.image(1)
    assert image.dtype == np.uint16
    assert image.shape == SMALL.shape
    assert (render(pickle.loads(pickle.dumps(run)), 1, threads=3) == image).all()
    assert (replace(run, seed=12).image(1) != image).any()
    assert [a.sum() for a in run] == [run.image(0).sum(), image.sum()]
    with pytest.raises(InputError, match="frame 2"):
        run.image(2)


@pytest.mark.slow
def test_a_sampled_spot_blurs_as_the_convolved_one_does():
    run = bare_ball(blur_sigma=0.6, cells=2)
    size = 0.15
    convolved = replace(run, spot=FocalSpot(shape="gaussian", size_u=size, size_v=size))
    sampled = replace(run, spot=FocalSpot(shape="gaussian", size_u=size, size_v=size, method="sampled", points=61))
    a, b, sharp = (transmission(r, 0) for r in (convolved, sampled, run))
    assert np.abs(a - sharp).max() > 0.05
    assert np.abs(a - b).max() < 0.006


@pytest.mark.parametrize("shape", ["disc", "rectangle", "gaussian"])
def test_spots_are_centred_and_have_their_variance(shape):
    x = FocalSpot(shape=shape, size_u=0.2, size_v=0.1, method="sampled", points=40).sources()
    variance = {"disc": 1 / 16, "rectangle": 1 / 12, "gaussian": 1 / (8 * math.log(2))}[shape]
    np.testing.assert_allclose(x.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(x[:, :2].var(axis=0), variance * np.array([0.04, 0.01]), rtol=1e-9)


def test_motion_smears_along_its_direction():
    run = bare_ball(blur_sigma=0.5)
    moved = transmission(replace(run, motion=Motion(shift=(0.0, 0.4, 0.0), points=9)), 0)
    still = transmission(run, 0)
    widths = [(1 - T).sum(axis=0) for T in (still, moved)]
    spread = [np.average((np.arange(141) - np.average(np.arange(141), weights=w)) ** 2, weights=w) for w in widths]
    # A uniform smear of 0.4 mm at magnification 4 is 4 px wide and adds 4^2 / 12.
    assert spread[1] - spread[0] == pytest.approx((0.4 * 800 / 200 / 0.4) ** 2 / 12, rel=0.03)
    np.testing.assert_allclose((1 - still).sum(), (1 - moved).sum(), rtol=1e-3)


def test_a_frame_without_the_object_in_view_is_empty():
    away = POSES.select([0])
    away = replace(away, T_MH=RigidTransform(R=np.eye(3)[None], t=[[0, 100, 0]], source=Frame.M, target=Frame.H))
    run = replace(bare_ball(), poses=away, T_MH=away.T_MH)
    assert (transmission(run, 0) == 1).all()


def test_the_pixel_kernel_has_the_blur_s_variance():
    for sigma, f in ((0.7, 2), (0.6, 1), (1.5, 3)):
        half = 10
        k = pixel_kernel(sigma, f, half)[0]
        x = (np.arange(len(k)) + 0.5) / f - half - 0.5
        # Sheppard's correction: sums over cells of width 1 / f exceed the integral by 1 / (12 f^2).
        assert (k * x**2).sum() - 1 / (12 * f * f) == pytest.approx(sigma**2 + 1 / 12, rel=2e-3)
    np.testing.assert_allclose(pixel_kernel(0.0, 3, 1)[0], [0, 0, 0, 1 / 3, 1 / 3, 1 / 3, 0, 0, 0], atol=1e-15)


def test_scatter_glare_and_mtf(rng):
    T = rng.random((64, 80))
    even = np.full((64, 80), 0.4)
    np.testing.assert_allclose(with_glare(even, Glare(share=0.1, sigma=20)), 0.4)
    assert with_glare(T, Glare(share=0.1, sigma=20)).std() < T.std()
    expected = 0.4 + 0.2 * -0.4 * math.log(0.4) + 0.03
    np.testing.assert_allclose(with_scatter(even, Scatter(constant=0.03, amount=0.2, sigma=9)), expected)
    np.testing.assert_allclose(wide_blur(even, 30.0), 0.4)
    u = np.arange(80)
    wave = 0.5 + 0.3 * np.cos(2 * np.pi * 0.25 * u)[None] * np.ones((64, 1))
    mtf = MTF(frequency=(0.0, 0.25, 0.5), value=(1.0, 0.6, 0.2))
    np.testing.assert_allclose(with_mtf(wave, mtf)[20:40, 20:60] - 0.5, 0.6 * (wave - 0.5)[20:40, 20:60], atol=5e-3)
    # Behind an opaque edge the veil falls as the Gaussian's integral: a half at the edge, 15.9 % one sigma behind it.
    half_plane = np.broadcast_to(np.where(np.arange(600) < 300, 1.0, 0.0), (200, 600))
    veil = with_glare(half_plane, Glare(share=0.1, sigma=40))[100]
    np.testing.assert_allclose([veil[300], veil[340], veil[590]], [0.05, 0.0159, 0.0], atol=1e-3)
    np.testing.assert_allclose(veil[10], 1.0, atol=1e-3)
    with pytest.raises(InputError):
        MTF(frequency=(0.1, 0.2), value=(1.0, 0.5))
    with pytest.raises(InputError):
        Glare(share=1.0)


def test_lag_shows_the_frame_before():
    run = bare_ball(lag=(0.1,))
    sharp = bare_ball()
    a, b = transmission(sharp, 0), transmission(sharp, 1)
    np.testing.assert_allclose(signal(run, 1), 0.9 * b + 0.1 * a)
    np.testing.assert_allclose(signal(run, 0), a)
