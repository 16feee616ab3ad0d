"""Balls whose place is known come out where they are, whatever the algorithm, the engine or the path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reconstruction_phantom import Balls, balls, compare, images_of, scan

from tomopose.engines import make_engine
from tomopose.engines.rtk import availability as rtk_availability
from tomopose.errors import InputError, TrajectoryError
from tomopose.geometry.rotations import R_x
from tomopose.reconstruction import (
    FDK,
    OSSART,
    PAPER,
    SART,
    Correction,
    Execution,
    beam_hardening_polynomial,
    reconstruct,
    source_path,
)
from tomopose.reconstruction.fdk.filter import DIRECTIONS, FdkFilter, crossings
from tomopose.reconstruction.settings import algorithm_of, name_of, with_options
from tomopose.trajectory.view_order import subsets, view_order
from tomopose.volume import VoxelGrid

GRID = VoxelGrid(shape=(62, 64, 64), spacing=np.array([0.1, 0.1, 0.1]), centre=np.array([0.05, -0.1, 0.15]))
OBJECTS = balls(GRID, m=5, radius=(0.09, 0.12))


@pytest.fixture(scope="module")
def tilted():
    """Non-square pixels, odd sizes, piercing point off centre."""
    matrices = scan(GRID, n=72, n_u=101, n_v=93, aspect=1.1, field=1.3)
    return matrices, images_of(matrices, OBJECTS)


@pytest.fixture(scope="module")
def circular():
    matrices = scan(GRID, n=72, n_u=101, n_v=93, tilted=False, field=1.3)
    return matrices, images_of(matrices, OBJECTS)


def truth_of(images, matrices, **settings):
    """settings: of `reconstruct`, or of the algorithm `base` and of the cpu engine's options."""
    known = ("algorithm", "engine", "consistency", "mask", "execution")
    options = {name: settings.pop(name) for name in list(settings) if name not in known}
    if options:
        settings["algorithm"] = with_options(algorithm_of(settings.get("algorithm")), options)
    volume = reconstruct(images, matrices, GRID, images_are="line-integrals", **settings)
    return compare(volume.values, GRID, OBJECTS), volume


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"algorithm": PAPER},
        {"algorithm": OSSART(iterations=3)},
        {"algorithm": SART(order="random")},
        {"algorithm": SART(start=FDK(), nonnegative=True), "execution": Execution(engine_options={"kernels": "plain"})},
    ],
    ids=["default", "paper", "ossart", "random order", "plain kernels"],
)
def test_ball_centres_on_a_tilted_path(tilted, settings):
    truth, volume = truth_of(tilted[1], tilted[0], **settings)
    assert truth.centre_error.max() < 0.04  # voxel
    assert np.abs(truth.radius_error).max() < 0.12  # voxel
    assert np.abs(truth.inner - 1).max() < 0.06
    assert volume.values.dtype == np.float32
    assert volume.view_residual.max() < 0.12
    assert volume.provenance.arguments["algorithm"] == name_of(settings.get("algorithm", FDK()))


@pytest.mark.slow
def test_order_decides(tilted):
    spread, _ = truth_of(tilted[1], tilted[0], algorithm=PAPER)
    in_turn, _ = truth_of(tilted[1], tilted[0], algorithm=replace(PAPER, order="sequential"))
    assert np.abs(in_turn.inner - 1).mean() > 3 * np.abs(spread.inner - 1).mean()


@pytest.mark.slow
@pytest.mark.parametrize("path", ["circular", "tilted"])
def test_fdk_follows_the_path(path, request):
    matrices, images = request.getfixturevalue(path)
    truth, _ = truth_of(images, matrices, algorithm="fdk")
    assert truth.centre_error.max() < 0.04
    assert np.abs(truth.inner - 1).max() < 0.03  # the absolute scale of the sum


def test_on_a_circle_the_path_is_crossed_twice_and_the_ramp_is_that_of_rows(circular):
    matrices, images = circular
    path = source_path(matrices)
    assert path.circular
    assert path.smooth
    rays = matrices.decompose()
    axes = np.stack([rays.U, rays.V], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    M = crossings(path, axes)
    level = DIRECTIONS // 2  # along v the plane holds the whole circle
    assert (np.delete(M, level, axis=1) == 2).all()
    by_rows = FdkFilter(matrices, path)(images[3], 3)
    by_path = FdkFilter(matrices, replace(path, circular=False))(images[3], 3)
    np.testing.assert_allclose(by_path, by_rows, atol=1e-3 * np.abs(by_rows).max())


@pytest.mark.slow
def test_fdk_is_refused_where_the_height_jumps_from_view_to_view(circular):
    matrices, _ = circular
    leaning = np.tile(np.eye(4), (len(matrices), 1, 1))
    leaning[::2, :3, :3], leaning[1::2, :3, :3] = R_x(np.radians(8)), R_x(np.radians(-8))
    rings = replace(matrices, P=matrices.P @ leaning, scanner=None)
    images = images_of(rings, OBJECTS)
    with pytest.raises(TrajectoryError, match="jumps"):
        truth_of(images, rings, algorithm="fdk")
    truth, _ = truth_of(images, rings)
    assert truth.centre_error.max() < 0.04


@pytest.mark.slow
def test_cgls_lowers_the_residual_every_time(tilted):
    residual = [
        truth_of(tilted[1], tilted[0], algorithm="cgls", iterations=k, consistency="off")[1].view_residual.mean()
        for k in (1, 3, 8)
    ]
    assert residual[0] > residual[1] > residual[2]
    truth, plain = truth_of(tilted[1], tilted[0], algorithm="cgls", iterations=12, consistency="off")
    assert truth.centre_error.max() < 0.04
    mask = np.zeros(GRID.shape, dtype=bool)
    mask[4:-4, 4:-4, 4:-4] = True
    truth, masked = truth_of(tilted[1], tilted[0], algorithm="cgls", iterations=12, consistency="off", mask=mask)
    assert truth.centre_error.max() < 0.04
    assert not masked.values[~mask].any()
    assert plain.values[~mask].any()


@pytest.mark.slow
def test_nonnegative_and_mask_hold(tilted):
    _z, y, x = np.meshgrid(*(np.arange(n) for n in GRID.shape), indexing="ij")
    mask = np.hypot(x - 31.5, y - 31.5) < 30
    truth, volume = truth_of(tilted[1], tilted[0], nonnegative=True, mask=mask, algorithm="sart")
    assert volume.values.min() >= 0
    assert not volume.values[~mask].any()
    assert truth.centre_error.max() < 0.04
    plain, other = truth_of(tilted[1], tilted[0], algorithm="sart")
    assert other.values.min() < 0
    assert truth.background < plain.background


@pytest.mark.slow
def test_a_short_scan_is_said():
    matrices = scan(GRID, n=60, n_u=81, tilted=False, arc=np.radians(210), field=1.3)
    images = images_of(matrices, OBJECTS)
    truth, volume = truth_of(images, matrices, iterations=2)
    assert any("covers 210 of 360" in note for note in volume.notes)
    assert truth.centre_error.max() < 0.1


def test_truncation_is_said():
    matrices = scan(GRID, n=40, n_u=61, field=0.9)
    _, volume = truth_of(images_of(matrices, OBJECTS), matrices, consistency="off")
    assert any("truncated" in note and "of 40 views" in note for note in volume.notes)


def test_path_is_read_off_the_matrices(tilted, circular):
    path = source_path(circular[0])
    assert path.circular
    assert path.full_turn
    assert abs(abs(path.axis[2]) - 1) < 1e-9
    assert np.abs(path.distance - 300).max() < 1e-6
    assert np.abs(path.weight - 2 * np.pi / 72).max() < 1e-9
    tilts = source_path(tilted[0])
    assert not tilts.circular
    assert abs(np.degrees(np.abs(tilts.elevation).max()) - 8) < 0.5
    assert abs(tilts.weight.sum() - 2 * np.pi) < 1e-9


def test_orders_are_permutations_and_spread():
    for n in (1, 2, 7, 72, 361):
        for order in ("golden", "random", "sequential"):
            assert np.array_equal(np.sort(view_order(n, order)), np.arange(n))
    golden = view_order(360)
    step = np.abs(np.diff(golden))
    assert np.minimum(step, 360 - step).min() > 100  # no two neighbours in sequence
    assert subsets(np.arange(5), 2) == ((0, 1), (2, 3), (4,))
    for bad in ([0, 0, 1], "spiral"):
        with pytest.raises(InputError):
            view_order(3, bad)


def test_polychromatic_data_become_linear():
    energies = np.linspace(40, 160, 60)
    fluence = np.exp(-(((energies - 80) / 30) ** 2))
    mu = 0.05 + 2.0e4 / energies**3  # 1/mm, the shape of a metal's
    c = beam_hardening_polynomial(energies, fluence, mu, thickness_mm=20.0, degree=4)
    length = np.linspace(0, 20, 50)
    p = -np.log(np.exp(-length[:, None] * mu) @ (fluence / fluence.sum()))
    mean = (fluence * energies).sum() / fluence.sum()
    straight = np.interp(mean, energies, mu) * length
    corrected = sum(a * p ** (i + 1) for i, a in enumerate(c))
    assert np.abs(p - straight).max() > 0.05 * straight.max()
    assert np.abs(corrected - straight).max() < 0.005 * straight.max()
    small = VoxelGrid.cube(n=32, spacing=0.2)
    ball = Balls(centres=np.zeros((1, 3)), radii=np.array([2.0]), mu=np.array([0.1]))
    matrices = scan(small, n=40, n_u=48, field=1.4)
    images = images_of(matrices, ball)
    hardened = images - 0.3 * images**2
    found = [
        reconstruct(
            hardened,
            matrices,
            small,
            correction=Correction(images_are="line-integrals", beam_hardening=b),
            consistency="off",
        )
        for b in ((), (1.0, 0.3, 0.18))
    ]
    middle = [v.values[14:18, 14:18, 14:18].mean() for v in found]
    assert abs(middle[1] - 0.1) < 0.3 * abs(middle[0] - 0.1)


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.skipif(not rtk_availability().available, reason="itk-rtk is not installed")
def test_rtk_projectors_give_the_same_sart(tilted):
    """Same order, same relaxation, one sweep: rms difference below 1e-3 of the range of grey values.

    The outermost voxels are kept at zero: RTK lets a ray end at their centres, here it ends at their faces.
    """
    inner = np.zeros(GRID.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    matrices = tilted[0].select(range(0, 72, 3))
    images = tilted[1][::3]
    own, other = (
        reconstruct(
            images,
            matrices,
            GRID,
            images_are="line-integrals",
            algorithm=replace(PAPER, order="golden"),
            engine=name,
            consistency="off",
            mask=inner,
        )
        for name in ("cpu", "rtk")
    )
    span = float(np.ptp(other.values))
    assert np.sqrt(((own.values - other.values) ** 2).mean()) < 1e-3 * span


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.skipif(not rtk_availability().available, reason="itk-rtk is not installed")
@pytest.mark.parametrize("weight", ["sum", "mean", "inverse-square"])
def test_rtk_looks_up_the_same_pixels(tilted, weight, rng):
    matrices = tilted[0].select([3, 17])
    images = rng.random((2, matrices.n_v, matrices.n_u)).astype(np.float32)
    volumes = []
    for name in ("cpu", "rtk"):
        engine = make_engine(name, matrices, GRID)
        x = engine.empty()
        engine.back(images, [0, 1], into=x, weight=weight)
        volumes.append(engine.values(x).copy())
    assert np.abs(volumes[0] - volumes[1]).max() < 1e-5 * np.abs(volumes[0]).max()
