"""What a panel and a path leave out: weighted where FDK is defined, refused by name where it is not, said in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reconstruction_phantom import Balls, compare, images_of

from tomopose.errors import TrajectoryError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import R_y, R_z
from tomopose.geometry.scanner import Scanner
from tomopose.reconstruction import FDK, SART, reconstruct
from tomopose.reconstruction.fdk.path import source_path
from tomopose.reconstruction.fdk.redundancy import Redundancy, fan_angles, fan_of
from tomopose.volume import VoxelGrid

GRID = VoxelGrid(shape=(40, 64, 64), spacing=0.1 * np.ones(3))
PARTS = Balls(
    centres=np.array([[0.2, -0.1, 0.0], [1.6, 0.6, 0.3], [-1.2, -1.5, -0.4], [0.1, 2.3, 0.2]]),
    radii=np.array([0.9, 0.5, 0.6, 0.4]),
    mu=np.full(4, 0.1),
)
WIDE, NARROW = 1.35, 0.98
"""Width of the panel at the axis over the grid's; a narrow one holds the parts where it is displaced only."""


def matrices_of(n, *, arc=360.0, first=0.4, shift=0.0, width=WIDE, tilt=0.0, backwards=False):
    """A cone of 16 degrees on non-square pixels; shift: of the piercing point, in widths of the panel."""
    n_u, n_v = round(81 * width), 70
    p_u = 6.4 * 5 * width / n_u
    scanner = Scanner(
        d_SD=150.0,
        d_SR=30.0,
        p_u=p_u,
        p_v=1.1 * p_u,
        u_0=(n_u - 1) / 2 + shift * n_u,
        v_0=(n_v - 1) / 2 - 0.2,
        n_u=n_u,
        n_v=n_v,
    )
    alpha = first + np.arange(n) * np.radians(arc) / n * (-1 if backwards else 1)
    moved = np.zeros((n, 4, 4))
    moved[:, :3, :3], moved[:, 3, 3] = R_y(tilt * np.sin(3 * alpha)) @ R_z(alpha), 1.0
    P = scanner.P_S @ (scanner.T_WS.matrix @ moved)
    return ProjectionMatrices(
        P=P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=1.1 * p_u, pose_id=tuple(f"p{j:03d}" for j in range(n))
    )


def made(matrices, images=None, **settings):
    images = images_of(matrices, PARTS, fine=2) if images is None else images
    return reconstruct(images, matrices, GRID, **{"images_are": "line-integrals", "consistency": "off", **settings})


def densities(volume):
    """Found over true attenuation in the middle of each part, minus 1."""
    return compare(volume.values, GRID, PARTS, rays=600).inner - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"shift": 0.25},
        {"shift": -0.25},
        {"shift": 0.4},
        {"shift": 0.3, "backwards": True},
        {"shift": 0.25, "tilt": 0.14},
    ],
    ids=["right", "left", "far", "backwards", "tilted"],
)
def test_a_displaced_panel_gives_the_right_densities_over_a_full_turn(settings):
    """Without weights they are 9 % too low outside and 22 % too high inside."""
    volume = made(matrices_of(180, width=NARROW, **settings), algorithm="fdk")
    assert np.abs(densities(volume)).max() < 0.005
    assert compare(volume.values, GRID, PARTS, rays=600).centre_error.max() < 0.03


@pytest.mark.slow
def test_a_displaced_panel_is_found_and_said():
    volume = made(matrices_of(120, width=NARROW, shift=0.25))
    assert "laterally displaced panel" in volume.settings["choice"]
    assert volume.settings["algorithm"] == "fdk"
    centred = made(matrices_of(120))
    assert "displaced" not in centred.settings["choice"]


@pytest.mark.slow
@pytest.mark.parametrize("arc", [200, 210, 240, 300, 345])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_short_scan_gives_the_right_densities(arc, backwards):
    volume = made(matrices_of(arc // 2, arc=arc, first=2.4, backwards=backwards), algorithm="fdk")
    assert np.abs(densities(volume)).max() < 0.005
    assert any(f"covers {arc} of 360 degrees" in note for note in volume.notes)


@pytest.mark.parametrize("shift", [0.0, 0.25])
@pytest.mark.parametrize("arc", [220.0, 360.0])
def test_the_two_weights_of_a_line_add_up_to_one(shift, arc):
    matrices = matrices_of(round(arc), arc=arc, shift=shift, width=NARROW)
    path = source_path(matrices)
    weights = Redundancy(matrices=matrices, path=path, fan=fan_of(matrices, path), displaced=shift != 0)
    middle = np.array([(matrices.n_v - 1) / 2 - 0.2])
    gamma = [fan_angles(matrices, path, j, np.arange(matrices.n_u), middle) for j in range(len(matrices))]
    beta = np.mod(path.angle, 2 * np.pi)
    pairs = 0
    for j in (30, 100, 190):
        for u in (20, 39, 55):
            twin = np.mod(path.angle[j] + np.pi + 2 * gamma[j][u], 2 * np.pi)
            k = int(np.abs(np.angle(np.exp(1j * (beta - twin)))).argmin())
            if abs(np.angle(np.exp(1j * (beta[k] - twin)))) > 0.01 or np.abs(gamma[k] + gamma[j][u]).min() > 0.002:
                continue
            w = int(np.abs(gamma[k] + gamma[j][u]).argmin())
            row = round(float(middle[0]))
            assert abs(weights.weights(j)[row, u] + weights.weights(k)[row, w] - 1) < 0.06  # half a pixel, half a view
            pairs += 1
    assert pairs >= 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"n": 2, "arc": 180.0}, "2 views do not determine a path"),
        ({"n": 8}, "8 views are too few"),
        ({"n": 80, "arc": 160.0}, "covers 160 degrees, and every line through the grid is measured from 19"),
        ({"n": 105, "arc": 210.0, "tilt": 0.14}, "leaves the plane of its path"),
        ({"n": 120, "arc": 240.0, "shift": 0.25, "width": NARROW}, "one side of the object only"),
        ({"n": 120, "width": 0.5}, "reaches beyond the panel on both sides"),
        ({"n": 120, "width": NARROW, "shift": 0.52}, "does not see the axis"),
    ],
)
@pytest.mark.parametrize("algorithm", ["fdk", "fdk+sart"])
def test_everything_else_is_refused_by_name(settings, words, algorithm):
    matrices = matrices_of(**settings)
    images = images_of(matrices, PARTS, fine=1)
    with pytest.raises(TrajectoryError, match=words):
        made(matrices, images, algorithm=algorithm)
    volume = made(matrices, images)
    assert volume.settings["algorithm"] == "sart"
    assert words[:12] in volume.settings["choice"]
    assert np.isfinite(volume.values).all()


@pytest.mark.slow
def test_a_turn_with_two_holes_is_refused_by_name():
    whole = matrices_of(180)
    matrices = whole.select([j for j in range(180) if not (20 <= j < 50 or 110 <= j < 140)])
    with pytest.raises(TrajectoryError, match="2 stretches without views, 12"):
        made(matrices, algorithm="fdk")
    assert any("Missing angles" in note for note in made(matrices).notes)


@pytest.mark.parametrize(
    ("n", "words"), [(1, "depth and density are not determined"), (2, "densities are far too low")]
)
def test_one_and_two_views_are_said(n, words):
    volume = made(matrices_of(n, arc=90.0 * n), consistency="error")
    assert any(words in note for note in volume.notes)
    assert volume.values.min() > -0.02


@pytest.mark.slow
@pytest.mark.parametrize(("n", "algorithm"), [(120, "fdk"), (36, "fdk"), (24, "fdk+sart"), (12, "sart")])
def test_the_default_is_chosen_and_said(n, algorithm):
    volume = made(matrices_of(n))
    assert volume.settings["algorithm"] == algorithm
    assert volume.settings["choice"].startswith(f"{algorithm}: ")
    assert volume.notes[0] == volume.settings["choice"]
    assert volume.provenance.arguments["choice"] == volume.settings["choice"]


@pytest.mark.slow
def test_fdk_places_parts_and_densities_as_well_as_sart_after_it():
    matrices = matrices_of(72)
    images = images_of(matrices, PARTS, fine=2)
    fdk, swept = (made(matrices, images, algorithm=a) for a in (FDK(), SART(start=FDK())))
    assert np.abs(densities(fdk)).max() < 0.5 * np.abs(densities(swept)).max()
    assert compare(fdk.values, GRID, PARTS, rays=600).centre_error.max() < 0.015


def test_a_grid_wider_than_the_field_of_view_is_said():
    matrices = matrices_of(48)
    grid = replace(GRID, shape=(20, 120, 120))
    volume = reconstruct(
        images_of(matrices, PARTS, fine=1), matrices, grid, images_are="line-integrals", consistency="off"
    )
    note = next(note for note in volume.notes if "wider than the field of view" in note)
    assert "48 of 48 views" in note
    assert "stay 0" in note
    assert volume.trustworthy


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [None, "sart", "cgls"])
def test_images_of_another_scan_are_contradicted_with_the_views_named(algorithm):
    matrices = matrices_of(48)
    other = replace(PARTS, centres=PARTS.centres[:, [1, 2, 0]] * [0.8, -1.0, 1.3])
    images = np.roll(images_of(matrices_of(48, backwards=True), other, fine=1), 7, axis=0)
    rng = np.random.default_rng(3)
    volume = made(matrices, images[rng.permutation(48)], algorithm=algorithm, consistency="error")
    assert not volume.trustworthy
    assert len(volume.contradicted) > 24
    note = volume.notes[-1]
    assert note.startswith("not trustworthy: the volume contradicts")
    assert f"(pose p{volume.contradicted[0]:03d})" in note
    assert made(matrices, images_of(matrices, PARTS, fine=1), algorithm=algorithm).trustworthy


@pytest.mark.slow
def test_no_remedy_is_given_that_does_not_make_the_residual_right():
    matrices = matrices_of(48)
    images = images_of(matrices, PARTS, fine=1)
    shuffled = images[np.random.default_rng(3).permutation(48)]
    volume = made(matrices, shuffled, consistency="error")
    words = " ".join(volume.notes)
    assert "no other reading of the images that was tried is right" in words
    assert "mirror the images" not in words
