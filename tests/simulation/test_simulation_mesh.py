"""Meshes: paths against the analytic ball, parity at shared edges, the specimen, and images of meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose import PoseSequence, RigidTransform, Scanner
from tomopose.errors import EngineFailedError, FileError, InputError
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh, mesh_paths, read_mesh, write_stl
from tomopose.simulation.objects.shapes import Solid, box, cone, cylinder, half_space, sphere, torus
from tomopose.simulation.objects.specimen import LENGTH, measurands, specimen_mesh
from tomopose.simulation.objects.tessellate import tessellate
from tomopose.simulation.projector.raster import mesh_path_image
from tomopose.simulation.projector.rays import path_lengths
from tomopose.simulation.projector.view import View, Window
from tomopose.simulation.run import simulate_ball_run, transmission

pytest.importorskip("embreex")
pytest.importorskip("manifold3d")

CUBE = TriangleMesh(
    vertices=np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float),
    faces=np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    ),
)


def ball(times):
    """An octahedron's faces cut in four `times` times, all corners on the sphere of radius 2.5 mm."""
    v = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    f = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    mesh = TriangleMesh(vertices=v, faces=f)
    for _ in range(times):
        mesh = mesh.refined()
        mesh = TriangleMesh(
            vertices=mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True), faces=mesh.faces
        )
    return TriangleMesh(vertices=2.5 * mesh.vertices, faces=mesh.faces)


def aimed(rng, n, reach):
    o = np.array([283.5, 1.3, -2.1])
    target = rng.uniform(-reach, reach, (n, 3))
    target[:, 0] = 0
    return o, target - o


@pytest.mark.slow
def test_a_ball_of_131k_triangles_against_the_analytic_one(rng):
    mesh = ball(7)
    assert len(mesh.faces) == 131072
    o, d = aimed(rng, 100_000, 2.7)
    error = mesh_paths(MeshSolid(mesh=mesh, material="Al"), o, d)
    error -= path_lengths([Solid(shape=sphere(2.5), material="Al")], o, d)[:, 0]
    assert error.std() < 1e-3
    # Only rays that graze the rim can be far off, and by no more than the chord of the missing cap.
    sagitta = 2.5 * (np.pi / 2 / 2**7) ** 2 / 2
    assert np.abs(error).max() < 2 * np.sqrt(2 * 2.5 * 2 * sagitta)


@pytest.mark.slow
def test_rays_through_edges_and_corners_of_a_cube(rng):
    o = np.array([50.0, 0.0, 0.0])
    inside = np.array([[0, 0, 0], [0, 0.5, 0.5], [0, -0.25, 0.25], [0, 0.999, 0.0]])
    L = mesh_paths(MeshSolid(mesh=CUBE, material="Al"), o, inside - o)
    exact = path_lengths([Solid(shape=box(2, 2, 2), material="Al")], o, inside - o)[:, 0]
    np.testing.assert_allclose(L, exact, atol=2e-4)
    o, d = aimed(rng, 20_000, 1.2)
    L = mesh_paths(MeshSolid(mesh=CUBE, material="Al"), o, d)
    exact = path_lengths([Solid(shape=box(2, 2, 2), material="Al")], o, d)[:, 0]
    np.testing.assert_allclose(L, exact, atol=2e-3)
    assert np.abs(L - exact)[exact > 0.1].max() < 1e-6


def test_drawn_triangles_are_the_rays_paths(rng):
    scanner = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=41.0, v_0=38.0, n_u=83, n_v=77, eta=0.1, theta=0.05)
    view, window = View.of(scanner), Window(u_0=-3, v_0=2, n_u=81, n_v=70)
    u, v = np.meshgrid(window.u_0 + np.arange(81), window.v_0 + np.arange(70))
    d = (view.O + u[..., None] * view.U + v[..., None] * view.V - view.source).reshape(-1, 3)
    # Straight in the beam, the cube's sides meet the principal ray's row and column exactly.
    for turn in (
        RigidTransform.from_angles([0.3, -0.5, 1.1], [1.0, 0.7, -0.4], source=Frame.M, target=Frame.W),
        RigidTransform.identity(Frame.M, Frame.W),
    ):
        for mesh in (CUBE, ball(4)):
            solid = MeshSolid(mesh=mesh, material="Al")
            image = mesh_path_image((solid,), view, {Frame.M: turn}, window, threads=2)
            back = turn.inv
            L = mesh_paths(solid, back.apply(view.source), d @ back.R.T).reshape(70, 81)
            assert image.max() > 1.9
            # No ray slips through: none ends negative or as long as the way to the object.
            assert image.min() > -1e-9
            assert (np.abs(image - L) > 1e-7).mean() < 0.002
            assert np.abs(image - L).max() < 0.1


def test_rays_through_corners_of_a_mesh_never_slip_through():
    # Every sample of the grid lies on an edge or a corner of a mesh whose corners are the grid's own.
    view = View(source=np.zeros(3), O=np.array([-4.0, -4.0, 8.0]), U=np.array([1.0, 0, 0]), V=np.array([0, 1.0, 0]))
    x, y = np.meshgrid(np.arange(9.0) - 4, np.arange(9.0) - 4)
    low = np.stack([x, y, np.full_like(x, 8.0)], axis=-1).reshape(-1, 3)
    a = np.arange(72).reshape(8, 9)[:, :8].ravel()
    quads = np.stack([a, a + 1, a + 10, a + 9], axis=1)
    rim = [*range(9), *range(17, 81, 9), *range(79, 71, -1), *range(63, 0, -9)]
    near = np.concatenate([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    walls = [[p, q, q + 81] for p, q in zip(rim, rim[1:] + rim[:1], strict=True)]
    walls += [[p, q + 81, p + 81] for p, q in zip(rim, rim[1:] + rim[:1], strict=True)]
    mesh = TriangleMesh(
        vertices=np.concatenate([low, 1.25 * low]), faces=np.concatenate([near, near[:, ::-1] + 81, walls])
    )
    image = mesh_path_image(
        (MeshSolid(mesh=mesh, material="Al", frame=Frame.W),),
        view,
        {Frame.W: RigidTransform.identity(Frame.W)},
        Window(u_0=0, v_0=0, n_u=9, n_v=9),
    )
    exact = 0.25 * np.linalg.norm(low, axis=1).reshape(9, 9)
    np.testing.assert_allclose(image[1:-1, 1:-1], exact[1:-1, 1:-1], rtol=1e-12)
    on_rim = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert ((on_rim == 0) | (on_rim > 1.9)).all()


@pytest.mark.slow
def test_the_edge_of_a_mesh_lies_where_the_shape_s_does():
    scanner = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=61.3, v_0=48.7, n_u=121, n_v=97)
    mount = RigidTransform.from_angles([0.1, 0.2, 3.0], [0.2, 0.1, 0.3], source=Frame.H, target=Frame.T)
    solids = (Solid(shape=box(7, 6, 5), material="WC-Co"),)
    run = simulate_ball_run(
        scanner, T_HT=mount, t=np.zeros(3), poses=PoseSequence.from_table([[0, 0, 0]], [[0, 0, 0]]), solids=solids
    )
    ((mesh, material, frame),) = tessellate(solids)
    meshed = replace(run, solids=(), meshes=(MeshSolid(mesh=mesh, material=material, frame=frame),))
    a, b = transmission(run, 0), transmission(meshed, 0)
    slope = np.hypot(*np.gradient(a))
    steep = slope > 0.25 * slope.max()
    assert (np.abs(a - b) / np.maximum(slope, 1e-12))[steep].max() < 0.004
    assert np.sqrt(((a - b)[steep] / slope[steep] @ ((a - b)[steep] / slope[steep])) / steep.sum()) < 0.0007


def test_open_and_inverted_meshes_are_refused():
    with pytest.raises(InputError, match="not closed"):
        MeshSolid(mesh=TriangleMesh(vertices=CUBE.vertices, faces=CUBE.faces[:-1]), material="Al")
    with pytest.raises(InputError, match="inwards"):
        MeshSolid(mesh=TriangleMesh(vertices=CUBE.vertices, faces=CUBE.faces[:, ::-1]), material="Al")
    with pytest.raises(InputError):
        TriangleMesh(vertices=CUBE.vertices, faces=np.array([[0, 1, 99]]))
    # Unequal numbers of entries and exits never become a path.
    solid = MeshSolid(mesh=CUBE, material="Al")
    solid.tracer.normal[:] = np.abs(solid.tracer.normal)
    with pytest.raises(EngineFailedError):
        mesh_paths(solid, [50.0, 0.1, 0.2], [[-1.0, 0, 0]])


def test_stl_there_and_back(tmp_path):
    pytest.importorskip("trimesh")
    write_stl(tmp_path / "cube.stl", CUBE)
    mesh = read_mesh(tmp_path / "cube.stl", scale=2.0)
    assert mesh.volume == pytest.approx(64.0)
    with pytest.raises(FileError):
        read_mesh(tmp_path / "none.stl")


def test_a_mesh_file_that_was_written_anew_is_read_anew(tmp_path):
    pytest.importorskip("trimesh")
    path = tmp_path / "part.stl"
    write_stl(path, CUBE)
    assert read_mesh(path).volume == pytest.approx(8.0)
    write_stl(path, TriangleMesh(vertices=1.5 * CUBE.vertices, faces=CUBE.faces))
    assert read_mesh(path).volume == pytest.approx(27.0)


def test_the_specimen_is_closed_and_as_long_as_the_paper_s():
    mesh = specimen_mesh(edge=3.0, segments=60).require_closed()
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(LENGTH)
    lengths = [m.length for m in measurands()]
    assert len(lengths) == 7
    assert min(lengths) == 4.0
    assert max(lengths) == 12.0
    for m in measurands():
        assert np.linalg.norm(m.a - m.b) == pytest.approx(m.length)
    made = specimen_mesh(deviations=True, edge=3.0, segments=60, seed=4).require_closed()
    moved = np.linalg.norm(made.vertices - mesh.vertices, axis=1)
    assert 0.001 < moved.max() < 0.04
    assert (moved == 0).mean() > 0.1


def test_tessellated_shapes_have_their_volume():
    solids = (
        Solid(shape=cylinder(3, -2, 5) - cylinder(1, -3, 6), material="Al"),
        Solid(shape=cone(3, 1, 0, 4).placed(t=[20, 0, 0]), material="Al"),
        Solid(shape=torus(4, 1).placed(t=[40, 0, 0]), material="Al"),
        Solid(shape=box(2, 3, 4).placed(t=[60, 0, 0]) & half_space().placed(t=[60, 0, 0]), material="Al"),
        Solid(shape=sphere(2).placed(t=[80, 0, 0]), material="Al"),
    )
    pi = np.pi
    exact = [7 * pi * 8, pi * 4 / 3 * 13, 2 * pi**2 * 4, 12.0, 4 / 3 * pi * 8]
    for (mesh, _, _), volume in zip(tessellate(solids, segments=200), exact, strict=True):
        assert mesh.volume == pytest.approx(volume, rel=2e-3)


@pytest.mark.slow
def test_the_image_of_a_mesh_is_that_of_the_shape():
    scanner = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=41.3, v_0=38.7, n_u=81, n_v=77)
    mount = RigidTransform.from_angles([0.1, 0.2, 3.0], [0.2, 0.1, 0.3], source=Frame.H, target=Frame.T)
    poses = PoseSequence.from_table([[0, 0, 0]], [[0, 0, 0]])
    solids = (Solid(shape=sphere(2.5), material="Al"),)
    run = simulate_ball_run(scanner, T_HT=mount, t=np.zeros(3), poses=poses, ball_diameter=5.0, solids=solids)
    meshed = replace(run, solids=(), meshes=(MeshSolid(mesh=ball(6), material="Al"),))
    a, b = transmission(run, 0), transmission(meshed, 0)
    assert a.min() < 0.9
    # 32,768 triangles: facets lie up to 0.4 um inside the sphere, 13 um of path at the rim.
    np.testing.assert_allclose(a, b, atol=1e-3)
