"""Section 6 in pieces: path lengths, radiographs, what is measured, and a tiny run that continues where it stopped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose import Scanner
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.objects.mesh import MeshSolid
from tomopose.simulation.objects.mesh import mesh_paths as embree_paths
from tomopose.simulation.objects.specimen import specimen_mesh
from tomopose.simulation.objects.sphere_standard import (
    BASE_TOP,
    multi_sphere_standard,
    sphere_centres,
    sphere_diameters,
)
from tomopose.simulation.projector.rays import compile_solids, path_lengths
from tomopose.studies.demo import demo_setup
from tomopose.studies.parts.steps import Steps
from tomopose.studies.section6 import study as section6
from tomopose.studies.section6.calibrations import calibrations, planned_run
from tomopose.studies.section6.paths import ball_paths, fine_matrices, mesh_paths
from tomopose.studies.section6.real_beam import circular_matrices
from tomopose.studies.section6.scan import MOUNTED, WHITE, Numbers, Radiographs, grid_of, scan_with, specimen
from tomopose.studies.section6.specimen import (
    as_made,
    cylinder_areas,
    reference,
    reference_error_um,
    true_lengths,
    unseen_by_circle,
)
from tomopose.studies.section6.tables import MPE_A_UM, limit, verdict, waves
from tomopose.studies.section6.volumes import NEAR_MM, cases_of, near
from tomopose.trajectory.completeness import source_path
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle

SCANNER = Scanner(d_SD=1200.0, d_SR=310.0, p_u=2.0, p_v=2.5, u_0=70.3, v_0=66.8, n_u=151, n_v=123)
TINY = Numbers(
    binning={"specimen": 14, "standard": 11},
    views={"specimen": 63, "standard": 42},
    runs={"specimen": (1,), "standard": (1,)},
    edge=2.0,
    samples=1,
    radiographs=False,
)


def views(n: int = 3) -> np.ndarray:
    scan = tilted_scan(n, eq11_triangle)
    return eq5_matrices(SCANNER, T_HT=demo_setup(paper=True).T_HT, T_MH=scan.T_MH, alpha=scan.alpha)


def rays(P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inverse = np.linalg.inv(P[:, :3])
    u, v = np.meshgrid(np.arange(SCANNER.n_u), np.arange(SCANNER.n_v))
    d = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ inverse.T
    return -inverse @ P[:, 3], d / np.linalg.norm(d, axis=1, keepdims=True)


def test_paths_through_a_mesh_are_those_of_the_ray_tracer():
    mesh = specimen_mesh(edge=2.0, segments=60)
    for P in views():
        solid = MeshSolid(mesh=mesh, material="Al", frame=Frame.W)
        found = mesh_paths(P, solid, SCANNER.n_u, SCANNER.n_v)
        expected = embree_paths(solid, *rays(P)).reshape(found.shape)
        assert found.max() > 25.0
        np.testing.assert_allclose(found, expected, atol=1e-6)  # mm


def test_a_mirrored_view_has_the_same_paths():
    mesh = specimen_mesh(edge=2.0, segments=60)
    P = views(1)[0]
    mirrored = np.diag([-1.0, 1.0, 1.0]) @ P + np.outer([SCANNER.n_u - 1, 0, 0], P[2])
    solid = MeshSolid(mesh=mesh, material="Al", frame=Frame.W)
    found = [mesh_paths(p, solid, SCANNER.n_u, SCANNER.n_v) for p in (P, mirrored)]
    np.testing.assert_allclose(found[1][:, ::-1], found[0], atol=1e-6)


@pytest.mark.slow
def test_paths_through_balls_on_shafts_are_those_of_the_solids():
    solids = compile_solids(multi_sphere_standard(base=False))
    bottom = np.full(27, BASE_TOP)
    for P in views():
        source, d = rays(P)
        expected = path_lengths(solids, source, d, {Frame.M: RigidTransform.identity(Frame.M, Frame.W)}).sum(axis=1)
        found = ball_paths(P, sphere_centres(), sphere_diameters() / 2, 1.0, bottom, SCANNER.n_u, SCANNER.n_v)
        np.testing.assert_allclose(found.ravel(), expected, atol=1e-9)


def test_fine_pixels_lie_evenly_within_their_pixel():
    P = views(1)[0]
    x = np.array([3.0, -4.0, 5.0, 1.0])
    coarse, fine = (M @ x for M in (P, fine_matrices(P, 3)))
    np.testing.assert_allclose(fine[:2] / fine[2], 3 * (coarse[:2] / coarse[2] + 0.5) - 0.5, rtol=1e-12)


def test_radiographs_are_the_same_each_time_and_as_noisy_as_said():
    scan = scan_with("standard", "3D", TINY, 5)
    images = Radiographs(scan)
    clear, noisy = images.transmission(2), images[2]
    np.testing.assert_array_equal(noisy, Radiographs(scan)[2])
    assert not np.array_equal(noisy, Radiographs(replace(scan, seed=scan.seed + 1))[2])
    air = clear == 1.0
    assert np.std(noisy[air] / WHITE) == pytest.approx(1 / (200.0 * 11), rel=0.05)
    assert np.mean(noisy[air] / WHITE) == pytest.approx(1.0, abs=1e-4)


def test_kept_frames_are_those_that_are_made(tmp_path, monkeypatch):
    scan = scan_with("standard", "3D", TINY, 5)
    made = Radiographs(scan)[2]
    monkeypatch.setattr("tomopose.studies.section6.scan.MOST_KEPT_BYTES", 1e3)
    kept = Radiographs(scan, tmp_path)
    np.testing.assert_array_equal(kept[2], made)
    again = Radiographs(scan, tmp_path)
    again.transmission = lambda j: pytest.fail("made again")
    np.testing.assert_array_equal(again[2], made)
    assert Radiographs(replace(scan, seed=scan.seed + 1), tmp_path).file != again.file
    again.forget()
    assert not again.file.exists()


@pytest.mark.parametrize("thing", ["specimen", "standard"])
def test_only_voxels_near_the_object_are_found_by_fdk(thing):
    grid = grid_of(thing, TINY)
    mask = near(thing, grid, TINY.edge)
    x = specimen(TINY.edge).vertices @ MOUNTED.T if thing == "specimen" else sphere_centres()
    i = np.rint(grid.indices(x)).astype(int)
    assert mask[tuple(i.T)].all()
    assert mask.mean() < 0.6
    if thing == "standard":
        away = np.flatnonzero(mask)
        z, y, x = (v.astype(float) for v in np.unravel_index(away, mask.shape))
        points = grid.origin + grid.spacing * np.column_stack([x, y, z])
        c = sphere_centres()
        across = np.hypot(points[:, None, 0] - c[:, 0], points[:, None, 1] - c[:, 1])
        assert (across.min(axis=1) < 2.5 + NEAR_MM).all()


@pytest.mark.parametrize("thing", ["specimen", "standard"])
def test_the_grid_holds_the_object(thing):
    grid = grid_of(thing, TINY)
    x = specimen(TINY.edge).vertices @ MOUNTED.T if thing == "specimen" else sphere_centres()
    inside = grid.indices(x)
    assert (inside > 2).all()
    assert (inside < np.array(grid.shape) - 3).all()


def test_true_lengths_differ_from_nominal_ones_by_the_form_only():
    found = true_lengths(TINY.edge)
    nominal = {"L1": 4.0, "L2": 5.5, "L3": 7.0, "L4": 8.5, "L5": 10.0, "L6": 12.0, "L7": 10.0}
    assert found.keys() == nominal.keys()
    for name, value in found.items():
        assert 0 < abs(value - nominal[name]) < 0.06  # mm: 8 um of form, over levers


@pytest.mark.slow
def test_a_circle_sees_upright_walls_and_not_what_faces_up():
    mesh = reference(TINY.edge)
    source = source_path(scan_with("specimen", "circular", TINY, 5).truth)
    unseen = unseen_by_circle(mesh, source)
    assert not unseen[cylinder_areas(mesh)].any()
    up = (mesh.normals @ MOUNTED.T)[:, 2] > 0.9999
    far = np.abs((mesh.points @ MOUNTED.T)[:, 2]) > 10.0
    assert unseen[up & far & ~mesh.on_edge].all()


def test_the_probed_reference_follows_the_part_and_not_the_drawing():
    made = as_made(TINY.edge)
    nominal = specimen_mesh(edge=TINY.edge)
    off = np.einsum("ij,ij->i", nominal.vertices - made.points, made.normals)[~made.on_edge]
    nominal_um = 1e3 * np.sqrt(np.mean(off**2))
    assert reference_error_um(TINY.edge) < min(section6.REFERENCE_UM, 0.5 * nominal_um)


def test_a_real_beam_is_hardened_blurred_and_scattered():
    scan = scan_with("specimen", "circular", TINY, 7)
    ideal = Radiographs(scan)
    real = Radiographs(replace(scan, real_beam=True))
    L = real._paths(0)
    behind = real.transmission(0)
    assert behind.shape == ideal.transmission(0).shape
    # scatter fills the shadow, hardened beam goes further through thick metal than the mean energy says
    assert behind.min() > ideal.transmission(0).min()
    thin, thick = (-np.log(real._beam.transmission(np.array([[x]]))[0]) / x for x in (1.0, float(L.max())))
    assert thick < 0.98 * thin


def test_the_circular_scan_s_own_errors_are_those_of_a_scanner():
    scan = scan_with("specimen", "circular", TINY, 7)
    off = circular_matrices(scan, 7)
    x = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, -20.0]])
    px = np.abs(off.project(x) - scan.truth.project(x)).max() * scan.binning
    assert 0.005 < px < 1.0


def test_waves_and_verdicts():
    phi = np.linspace(0, 2 * np.pi, 700, endpoint=False)
    amplitude = waves(np.where(phi < 0.01, np.nan, 5.0 * np.cos(7 * phi + 0.3)), phi)
    assert amplitude[7] == pytest.approx(5.0, rel=0.01)
    assert amplitude[[3, 6, 8, 14]].max() < 0.05
    assert verdict(10.0, 10.1) == "equal"
    assert "better" in verdict(10.0, 5.0)
    assert "WORSE" in verdict(5.0, 10.0)
    np.testing.assert_allclose(limit([0.0, 50.0]), [MPE_A_UM, MPE_A_UM + 1.0])


def test_our_run_has_as_many_poses_in_view_and_scatters_anew():
    first, second = (planned_run(5.3, 3, number=k) for k in (1, 2))
    assert len(first.poses) == 189
    np.testing.assert_array_equal(first.poses.T_MH.t, second.poses.T_MH.t)
    assert np.abs(first.T_MH.t - second.T_MH.t).max() > 1e-4  # mm
    assert len(set(np.round(np.degrees(first.alpha)))) == 4
    assert (first.x_D > 300).all()  # px: the ball's image is 212 px in radius
    assert (first.x_D < 1750).all()


def test_cases_have_names_of_their_own_and_order_is_looked_at_once():
    cases = [*cases_of("specimen", (1, 2)), *cases_of("standard", (1, 2))]
    assert len({c.name for c in cases}) == len(cases) == 6 + 9
    assert [c.order for c in cases if c.order] == ["sequential", "golden"]


@pytest.mark.slow
def test_a_tiny_run_continues_where_it_stopped(tmp_path, monkeypatch):
    steps = Steps(folder=tmp_path, key={"study": "section6"})
    solved: dict[tuple[float, int], object] = {}

    def once(m, number, **options):
        if (m, number) not in solved:
            solved[m, number] = calibrations(m, number, **options)
        return solved[m, number]

    monkeypatch.setattr(section6, "calibrations", once)
    monkeypatch.setattr("tomopose.studies.section6.standard.POINTS", 80)
    rows, checks, figures, _ = section6.run_with(TINY, 7, steps, lambda done, total: None)
    wave = next(r for r in rows if r.group.startswith("Fig. 12, 3D") and "seven periods" in r.quantity)
    assert wave.best < 0.5 * wave.paper_method
    assert len(figures) == 9
    assert len({c.statement for c in checks}) == len(checks)
    monkeypatch.setattr("tomopose.studies.section6.volumes.reconstruct", lambda *a, **k: pytest.fail("made again"))
    again = section6.run_with(TINY, 7, steps, lambda done, total: None)
    assert again[0] == rows
    assert again[1] == checks
