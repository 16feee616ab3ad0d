"""Bad input never gives a number: each fault is refused by a message that says what and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reconstruction_phantom import balls, images_of, scan

from tomopose.engines.cpu import CpuEngine
from tomopose.errors import ConventionError, EngineFailedError, InputError, OutOfViewError
from tomopose.reconstruction import Correction, Execution, LineIntegrals, check_consistency, reconstruct, ring_offset
from tomopose.reconstruction.settings import OF_ALGORITHM, OF_CORRECTION, algorithm_of, with_options
from tomopose.volume import VoxelGrid

GRID = VoxelGrid.cube(n=40, spacing=0.15)
MATRICES = scan(GRID, n=48, n_u=61, n_v=57, field=1.4, shift=(0.8, 4.3))
IMAGES = images_of(MATRICES, balls(GRID, m=5, radius=(0.07, 0.12)), fine=2)
IMAGES.setflags(write=False)


def attempt(images=IMAGES, matrices=MATRICES, grid=GRID, **settings):
    """settings: of `reconstruct`, or those that belong to an algorithm, `Correction` or `Execution`."""
    known = ("images_are", "algorithm", "engine", "consistency", "mask")
    options = {name: settings.pop(name) for name in list(settings) if name not in known}
    algorithm = algorithm_of(settings.pop("algorithm", None))
    images_are = settings.pop("images_are", "line-integrals")
    given = {name: options.pop(name) for name in OF_CORRECTION if name in options}
    swept = {name: options.pop(name) for name in OF_ALGORITHM if name in options}
    return reconstruct(
        images,
        matrices,
        grid,
        algorithm=with_options(algorithm, swept),
        correction=Correction(images_are=images_are, **given),
        execution=Execution(**options),
        **settings,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "message"),
    [
        (IMAGES[:-1], "wrong count: 47 images but 48"),
        (IMAGES[:, :, :-1], r"wrong size: image 0 is \(57, 60\)"),
        (IMAGES.transpose(0, 2, 1), "rows and columns are exchanged"),
        (IMAGES[:, :28, :30], r"binned\(2\)"),
        (IMAGES[:, ::-1], "rows flipped"),
        (IMAGES[:, :, ::-1], "columns mirrored"),
        (IMAGES[:, ::-1, ::-1], "turned by 180 degrees"),
        (IMAGES[::-1], "views in reverse order"),
        (np.zeros_like(IMAGES), "no contrast"),
        (IMAGES.astype(complex), "real numbers"),
        (iter(IMAGES), "an iterator was given"),
    ],
)
def test_images_that_do_not_match_are_named(images, message):
    with pytest.raises(InputError, match=message):
        attempt(images)


@pytest.mark.slow
def test_nan_pixels_are_named_or_excluded():
    broken = IMAGES.copy()
    broken[7, 20:22, 30] = np.nan
    with pytest.raises(InputError, match="image 7: 2 pixels are NaN or infinite, the first at u=30, v=20"):
        attempt(broken)
    mask = np.zeros((57, 61), dtype=bool)
    mask[20:22, 30] = True
    clean = attempt().values
    for settings in ({"invalid": "exclude"}, {"bad_pixels": mask}):
        found = attempt(broken, **settings).values
        assert np.isfinite(found).all()
        assert np.sqrt(((found - clean) ** 2).mean()) < 0.02 * np.ptp(clean)
    broken[8] = np.nan
    with pytest.raises(InputError, match=r"image 8: .* unusable"):
        attempt(broken, invalid="exclude")


def test_what_images_are_is_never_guessed():
    with pytest.raises(ConventionError, match="say what the images hold"):
        attempt(images_are=None)
    with pytest.raises(ConventionError, match="one of transmission"):
        attempt(images_are="absorption")
    with pytest.raises(ConventionError, match="white level"):
        attempt(images_are="counts")
    with pytest.raises(ConventionError, match="white level"):
        attempt(white=100.0)
    with pytest.raises(InputError, match="look like counts"):
        attempt(40000 * np.exp(-IMAGES), images_are="transmission")
    with pytest.raises(InputError, match="not positive"):
        attempt(-IMAGES, images_are="transmission")


@pytest.mark.slow
def test_counts_transmissions_and_line_integrals_agree():
    flat = np.linspace(30000, 40000, 61)[None] * np.ones((57, 1))
    expected = attempt().values
    for images, settings in (
        (np.exp(-IMAGES), {"images_are": "transmission"}),
        (100 + (flat - 100) * np.exp(-IMAGES), {"images_are": "counts", "white": flat, "dark": 100.0}),
    ):
        found = attempt(images, **settings).values
        assert np.abs(found - expected).max() < 1e-4 * np.ptp(expected)


@pytest.mark.slow
def test_a_sequence_that_knows_what_it_holds_needs_no_word():
    class Known(list):
        images_are = "line-integrals"

    assert attempt(Known(IMAGES), images_are=None).view_residual.max() < 0.2
    with pytest.raises(ConventionError, match="says 'line-integrals'"):
        attempt(Known(IMAGES), images_are="transmission")


def test_volumes_out_of_view_are_refused():
    with pytest.raises(OutOfViewError, match="outside the field of view in 48 of 48 views"):
        attempt(grid=replace(GRID, centre=np.array([0.0, 0.0, 60.0])))
    with pytest.raises(OutOfViewError, match="behind the source"):
        attempt(grid=VoxelGrid.cube(n=40, spacing=20.0))


@pytest.mark.slow
def test_too_little_memory_says_what_would_fit():
    with pytest.raises(InputError, match=r"GiB are needed for 400 x 400 x 400 voxels.*\^3 voxels would fit.*scratch"):
        attempt(grid=VoxelGrid.cube(n=400, spacing=0.015), memory_gib=0.5)
    with pytest.raises(InputError, match=r"CGLS needs 0\.3"):
        attempt(memory_gib=0.3, algorithm="cgls")
    with pytest.raises(InputError, match="too little memory: one layer"):
        attempt(memory_gib=0.1)
    with pytest.raises(InputError, match="positive"):
        attempt(memory_gib=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"algorithm": "magic"}, "'magic'"),
        ({"engine": "magic"}, "'magic'"),
        ({"relaxation": 2.5}, "above 0 and below 2"),
        ({"relaxation": [0.8, 0.4]}, "2 relaxation factors but 1"),
        ({"iterations": 0}, "positive whole"),
        ({"subset_size": 0}, "subset_size"),
        ({"mask": np.ones((3, 3, 3), dtype=bool)}, "support is"),
        ({"mask": np.zeros(GRID.shape, dtype=bool)}, "no voxel"),
        ({"consistency": "maybe"}, "'off' is needed"),
        ({"slabs": 3}, "scratch"),
        ({"beam_hardening": (1.0, -5.0)}, "does not rise"),
        ({"bad_pixels": np.ones((57, 61), dtype=bool)}, "hole"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(InputError, match=message):
        attempt(**settings)


@pytest.mark.slow
def test_a_wrong_trajectory_leaves_a_larger_residual():
    """Without any reference part: the same images with poses off by a tilt of 1 degree, or by a lag of one view."""
    right = attempt(iterations=2).view_residual.mean()
    tilt = np.eye(4)
    c, s = np.cos(np.radians(1.0)), np.sin(np.radians(1.0))
    turn = np.where(np.arange(48)[:, None, None] % 2 == 0, np.eye(4), tilt)
    turn[1::2, 1:3, 1:3] = [[c, -s], [s, c]]
    wrong = replace(MATRICES, P=MATRICES.P @ turn)
    lag = replace(MATRICES, P=np.roll(MATRICES.P, 1, axis=0))
    assert attempt(matrices=wrong, iterations=2).view_residual.mean() > 1.25 * right
    assert attempt(matrices=lag, iterations=2, consistency="off").view_residual.mean() > 1.2 * right


def test_one_wrong_view_is_named():
    P = MATRICES.P.copy()
    P[31] = np.diag([1, 1, 1.0]) @ P[31] + np.array([[0, 0, 0, 2.0 * P[31, 2, 3]], [0, 0, 0, 0], [0, 0, 0, 0]])
    volume = attempt(matrices=replace(MATRICES, P=P), consistency="off", iterations=2)
    assert volume.view_residual.argmax() == 31
    assert any("31" in note for note in volume.notes)


def test_consistency_ranks_the_readings():
    scan_ = LineIntegrals(IMAGES, MATRICES, Correction(images_are="line-integrals"))
    result = check_consistency(scan_, GRID)
    assert result.best == "as given"
    assert not result.contradicted
    assert "coarse views leave" in result.message


@pytest.mark.slow
def test_rings_are_taken_out():
    broken = IMAGES.copy()
    broken[:, :, 25] += 0.2
    correction = Correction(images_are="line-integrals")
    offset = ring_offset(LineIntegrals(broken, MATRICES, correction))
    assert abs(np.median(offset[:, 25]) - 0.2) < 0.03
    assert abs(np.median(offset[:, 20])) < 0.03
    clean, ringed = attempt().values, attempt(broken).values
    cured = attempt(broken, ring_width=5).values
    assert np.sqrt(((cured - clean) ** 2).mean()) < 0.4 * np.sqrt(((ringed - clean) ** 2).mean())


@pytest.mark.slow
def test_options_of_the_first_version_still_work_and_say_where_they_belong():
    with pytest.warns(DeprecationWarning, match=r"relaxation=\.\.\.\) belongs to"):
        found = reconstruct(
            IMAGES, MATRICES, GRID, images_are="line-integrals", algorithm="sart", relaxation=0.6, memory_gib=4.0
        )
    expected = attempt(algorithm="sart", relaxation=0.6)
    assert np.array_equal(found.values, expected.values)
    with pytest.raises(TypeError, match="relaxaton"):
        reconstruct(IMAGES, MATRICES, GRID, images_are="line-integrals", relaxaton=0.6)
    with (
        pytest.warns(DeprecationWarning, match="memory_gib"),
        pytest.raises(InputError, match="memory_gib is given beside"),
    ):
        reconstruct(IMAGES, MATRICES, GRID, images_are="line-integrals", execution=Execution(slabs=1), memory_gib=4.0)


def test_an_algorithm_has_its_own_options_only():
    with pytest.raises(InputError, match="fdk has no iterations; it has preview"):
        attempt(algorithm="fdk", iterations=2)
    with pytest.raises(InputError, match="fdk, fdk\\+sart, sart, ossart, cgls"):
        attempt(algorithm="best")
    with pytest.raises(InputError, match="a name, FDK, SART, OSSART or CGLS"):
        attempt(algorithm=0.8)


@pytest.mark.slow
def test_the_coarse_check_uses_the_engine_that_reconstructs_and_refuses_nan(monkeypatch):
    scan_ = LineIntegrals(IMAGES, MATRICES, Correction(images_are="line-integrals"))
    own, plain = (check_consistency(scan_, GRID, engine="cpu", options=o) for o in ({}, {"kernels": "plain"}))
    assert abs(own.residual["as given"] - plain.residual["as given"]) < 1e-4
    monkeypatch.setattr(CpuEngine, "forward", lambda self, state, views: np.full((len(views), 57, 61), np.nan, "f4"))
    with pytest.raises(EngineFailedError, match="not a number"):
        check_consistency(scan_, GRID, engine="cpu")
