"""From radiographs and matrices to a volume, its pictures and its page."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.projection import eq5_matrices
from tomopose.simulation.physics.materials import attenuation

SCENE = """
schema = "tomopose/scene/1"
seed = 1
detector = { snr = 100 }
source = { voltage_kV = 100.0 }
objects = [{ kind = "ball", t_mm = [0, 0, 0] }]
mount = { angles_deg = [0, 0, 180], t_mm = [0, 0, 0] }
poses = { grid = { n = 2 } }

[scanner]
d_SD_mm = 600
d_SR_mm = 200
p_u_mm = 1.4
p_v_mm = 1.6
u_0_px = 31
v_0_px = 26
n_u_px = 61
n_v_px = 55
"""
CENTRE, RADIUS, MU = np.array([3.0, -2.0, 1.5]), 4.0, 0.05


@pytest.fixture
def scan(tmp_path):
    """A tilted scan of one ball, transmission without noise, 48 views of 61 x 55 pixels."""
    scanner = tp.Scanner(d_SD=600.0, d_SR=200.0, p_u=1.4, p_v=1.6, u_0=31.2, v_0=26.3, n_u=61, n_v=55)
    poses = tp.tilted_scan(48, lambda a: np.radians(5.0) * np.sin(3 * a))
    mount = tp.RigidTransform.from_angles([0, 0, np.pi], [0, 0, 0], source=tp.Frame.H, target=tp.Frame.T)
    P = eq5_matrices(scanner, T_HT=mount, T_MH=poses.T_MH, alpha=poses.alpha)
    matrices = tp.ProjectionMatrices(
        P=P, n_u=scanner.n_u, n_v=scanner.n_v, p_u=scanner.p_u, p_v=scanner.p_v, pose_id=poses.pose_id
    )
    tp.write_matrices(tmp_path / "matrices.npz", matrices)
    g = matrices.decompose()
    u, v = np.meshgrid(np.arange(61), np.arange(55))
    for j in range(len(P)):
        pixel = g.centre[j] + (u - 30.0)[..., None] * g.U[j] + (v - 27.0)[..., None] * g.V[j]
        ray = pixel - g.source[j]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        to_ball = CENTRE - g.source[j]
        b2 = to_ball @ to_ball - (ray @ to_ball) ** 2
        chord = 2 * np.sqrt(np.maximum(RADIUS**2 - b2, 0.0))
        tp.write_tiff(tmp_path / "scan" / f"{j:03d}.tif", np.exp(-MU * chord).astype(np.float32))
    return tmp_path


def words(folder, *more):
    given = ["reconstruct", "--matrices", folder / "matrices.npz", "--images", folder / "scan", "--voxel-mm", 0.6]
    return [*map(str, [*given, "--size", 45, "--out", folder / "volume.h5", *more])]


@pytest.mark.slow
def test_the_ball_lies_where_it_was(scan, capsys):
    assert run(words(scan, "--images-are", "transmission", "--json")) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["shape_zyx"] == [45, 45, 45]
    volume = tp.read_volume(scan / "volume.h5")
    inside = volume.values > MU / 2
    index = np.argwhere(inside).astype(float)
    assert_allclose(volume.grid.points(index).mean(axis=0), CENTRE, atol=0.1)
    assert_allclose(volume.values[inside].mean(), MU, rtol=0.1)
    for name in ("slice_z", "slice_y", "slice_x", "maximum"):
        assert (scan / f"volume_{name}.png").read_bytes().startswith(b"\x89PNG")
    page = (scan / "volume.html").read_text(encoding="utf-8")
    assert "Residual by view" in page
    assert "Maximum along y" in page


def test_what_a_pixel_holds_is_never_guessed(scan, capsys):
    assert run(words(scan)) == 1
    assert "transmission" in capsys.readouterr().err
    assert not (scan / "volume.h5").exists()


def test_wrong_number_of_images_is_named(scan, capsys):
    (scan / "scan" / "047.tif").unlink()
    assert run(words(scan, "--images-are", "transmission")) == 1
    assert "47" in capsys.readouterr().err
    assert not (scan / "volume.h5").exists()


@pytest.mark.parametrize("size", ["0", "10,10", "ten"])
def test_sizes_that_are_not_sizes_are_refused(scan, size, capsys):
    assert run(words(scan, "--size", size)) == 2
    assert "--size" in capsys.readouterr().err


def test_cgls_refuses_what_it_does_not_serve(scan, capsys):
    more = ["--images-are", "transmission", "--algorithm", "cgls", "--checkpoint", str(scan / "state")]
    assert run(words(scan, *more)) == 1
    assert "checkpoint" in capsys.readouterr().err


@pytest.mark.slow
def test_the_middle_of_the_volume_may_lie_anywhere(scan):
    assert run(words(scan, "--images-are", "transmission", "--centre-mm", "3,-2,1.5", "--quiet")) == 0
    volume = tp.read_volume(scan / "volume.h5")
    assert_allclose(volume.grid.centre, CENTRE)
    assert_allclose(np.argwhere(volume.values > MU / 2).mean(axis=0), 22.0, atol=0.2)


@pytest.mark.slow
def test_a_mask_keeps_the_rest_empty_and_must_lie_on_the_grid(scan, capsys):
    grid = tp.VoxelGrid.cube(n=45, spacing=0.6)
    allowed = np.zeros(grid.shape, dtype=np.float32)
    allowed[10:-10, 10:-10, 10:-10] = 1
    tp.write_volume(scan / "allowed.h5", tp.Volume(values=allowed, grid=grid))
    assert run(words(scan, "--images-are", "transmission", "--mask", scan / "allowed.h5", "--quiet")) == 0
    assert not tp.read_volume(scan / "volume.h5").values[allowed == 0].any()
    tp.write_volume(scan / "other.h5", tp.Volume(values=allowed, grid=tp.VoxelGrid.cube(n=45, spacing=0.61)))
    assert run(words(scan, "--images-are", "transmission", "--mask", scan / "other.h5", "--force")) == 1
    assert "other.h5: its grid is not" in capsys.readouterr().err


@pytest.mark.slow
def test_bad_pixels_are_left_out(scan, capsys):
    bad = np.zeros((55, 61), dtype=np.uint8)
    bad[20, 30:32] = 1
    for path in sorted((scan / "scan").iterdir()):
        image = tp.open_images(path)[0].copy()
        image[20, 30:32] = np.nan
        tp.write_tiff(path, image, force=True)
    assert run(words(scan, "--images-are", "transmission")) == 1
    assert "NaN" in capsys.readouterr().err
    tp.write_tiff(scan / "bad.tif", bad)
    assert run(words(scan, "--images-are", "transmission", "--bad-pixels", scan / "bad.tif", "--quiet")) == 0
    assert np.isfinite(tp.read_volume(scan / "volume.h5").values).all()


@pytest.mark.slow
def test_beam_hardening_of_a_known_material_is_taken_out(scan, capsys):
    scene = scan / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    beam = tp.simulate(tp.read_scene(scene))
    mu = attenuation("Al", beam.spectrum.energy, materials=beam.materials)
    weight = beam.spectrum.weight / beam.spectrum.weight.sum()
    for path in sorted((scan / "scan").iterdir()):
        chord = -np.log(tp.open_images(path)[0]) / MU
        tp.write_tiff(path, (np.exp(-chord[..., None] * mu) @ weight).astype(np.float32), force=True)

    def spread(*more):
        assert run(words(scan, "--images-are", "transmission", "--force", "--quiet", *more)) == 0
        volume = tp.read_volume(scan / "volume.h5")
        z, y, x = np.meshgrid(*(np.arange(n) for n in volume.grid.shape), indexing="ij")
        r = np.linalg.norm(volume.grid.points(np.stack([z, y, x], axis=-1)) - CENTRE, axis=-1)
        return volume.values[r < 0.4 * RADIUS].mean() / volume.values[(r > 0.6 * RADIUS) & (r < 0.75 * RADIUS)].mean()

    cupped = spread()
    flat = spread("--scene", scene, "--material", "Al", "--thickness-mm", 8)
    assert abs(flat - 1) < 0.4 * abs(cupped - 1)
    assert run(words(scan, "--images-are", "transmission", "--force", "--material", "Al")) == 2
    assert "--scene" in capsys.readouterr().err


@pytest.mark.slow
def test_voxels_may_have_three_sides(scan, capsys):
    more = ["--voxel-mm", "0.6,0.6,0.9", "--size", "45,45,30", "--images-are", "transmission", "--json"]
    given = ["reconstruct", "--matrices", scan / "matrices.npz", "--images", scan / "scan", "--out", scan / "volume.h5"]
    assert run([*map(str, given), *more]) == 0
    assert json.loads(capsys.readouterr().out)["voxel_mm"] == [0.6, 0.6, 0.9]
    volume = tp.read_volume(scan / "volume.h5")
    assert_allclose(volume.grid.spacing, [0.6, 0.6, 0.9])
    assert_allclose(
        volume.grid.points(np.argwhere(volume.values > MU / 2).astype(float)).mean(axis=0), CENTRE, atol=0.1
    )
    assert run([*map(str, given), "--size", "45", "--voxel-mm", "0.6,0.6", "--images-are", "transmission"]) == 2
    assert "--voxel-mm" in capsys.readouterr().err


@pytest.mark.slow
def test_the_algorithm_chosen_is_said_and_kept(scan, capsys):
    assert run(words(scan, "--images-are", "transmission")) == 0
    choice = "fdk: the source makes a smooth full turn of 48 views"
    assert f"note: {choice}" in capsys.readouterr().out
    volume = tp.read_volume(scan / "volume.h5")
    assert volume.provenance.arguments["choice"] == choice
    assert choice in (scan / "volume.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("more", "option"),
    [
        (["--paper", "--relaxation", "0.5"], "--relaxation"),
        (["--paper", "--iterations", "2"], "--iterations"),
        (["--paper", "--order", "golden"], "--order"),
        (["--paper", "--algorithm", "fdk"], "--algorithm"),
        (["--paper", "--nonnegative"], "--nonnegative"),
        (["--algorithm", "fdk", "--iterations", "2"], "--iterations"),
    ],
)
def test_options_that_contradict_one_another_are_usage_errors(scan, more, option, capsys):
    assert run(words(scan, "--images-are", "transmission", *more)) == 2
    assert option in capsys.readouterr().err
    assert not (scan / "volume.h5").exists()


@pytest.mark.slow
def test_the_paper_may_be_said_twice(scan, capsys):
    more = ["--paper", "--relaxation", "0.8", "--algorithm", "sart", "--seed", "3", "--json"]
    assert run(words(scan, "--images-are", "transmission", *more)) == 0
    settings = json.loads(capsys.readouterr().out)["settings"]
    assert (settings["algorithm"], settings["order"], settings["seed"]) == ("sart", "random", 3)


@pytest.mark.slow
def test_a_volume_that_contradicts_its_views_ends_with_3_and_names_them(scan, capsys):
    images = sorted((scan / "scan").iterdir())
    stack = [tp.open_images(path)[0].copy() for path in images]
    for path, k in zip(images, np.random.default_rng(1).permutation(len(images)), strict=True):
        tp.write_tiff(path, stack[k], force=True)
    assert run(words(scan, "--images-are", "transmission")) == 3
    said = capsys.readouterr().out
    assert "not trustworthy: the volume contradicts" in said
    assert "(pose " in said
    assert not tp.read_volume(scan / "volume.h5").trustworthy


@pytest.mark.slow
def test_a_checkpoint_of_other_images_starts_anew_in_words(scan, capsys):
    state = scan / "state"
    more = ["--images-are", "transmission", "--checkpoint", str(state), "--force"]
    assert run(words(scan, *more)) == 0
    expected = tp.read_volume(scan / "volume.h5").values.copy()
    state.mkdir(exist_ok=True)
    (state / "state.json").write_text("{}", encoding="utf-8")
    capsys.readouterr()
    assert run(words(scan, *more)) == 0
    assert "starts anew" in capsys.readouterr().err
    assert np.array_equal(tp.read_volume(scan / "volume.h5").values, expected)
