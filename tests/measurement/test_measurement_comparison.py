"""Nominal-actual comparison of blurred shapes with meshes whose deviation is known."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from blurred_shapes import as_volume
from scipy.special import ndtr

from tomopose.errors import FileError, InputError, UnitError
from tomopose.geometry.rotations import exp_rotation
from tomopose.measurement.alignment import Alignment, from_points
from tomopose.measurement.mesh.cmm_correction import corrected_reference, read_probed_points
from tomopose.measurement.mesh.comparison import compare
from tomopose.measurement.mesh.comparison_files import FILES, write_comparison
from tomopose.measurement.mesh.mesh import Mesh, signed_distances
from tomopose.measurement.mesh.mesh_files import read_mesh
from tomopose.measurement.mesh.refine import refined
from tomopose.volume import VoxelGrid

V, SIGMA = 0.1, 0.1
HALF = np.array([1.5, 1.3, 1.7])


def box(half, n):
    """A closed box of 6 n^2 squares cut in two; vertices on edges are shared."""
    t = np.linspace(-1, 1, n + 1)
    corners, faces = [], []
    for axis in range(3):
        for side in (-1, 1):
            a, b = np.meshgrid(t, t, indexing="ij")
            x = np.zeros((n + 1, n + 1, 3))
            x[..., axis], x[..., (axis + 1) % 3], x[..., (axis + 2) % 3] = side, a, b
            base = sum(len(c) for c in corners)
            corners.append(x.reshape(-1, 3))
            k = base + (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
            quads = np.column_stack([k, k + n + 1, k + n + 2, k + 1])
            triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
            faces.append(triangles if side > 0 else triangles[:, ::-1])
    points, inverse = np.unique(np.round(np.concatenate(corners), 12), axis=0, return_inverse=True)
    return Mesh(points=points * half, faces=inverse[np.concatenate(faces)])


@pytest.fixture(scope="module")
def block():
    """A blurred box that is 0.02 mm too long at +x."""
    grid = VoxelGrid(shape=(50, 42, 47), spacing=np.full(3, V))
    high = HALF + [0.02, 0, 0]
    x, y, z = (
        ndtr((s + h) / SIGMA) - ndtr((s - g) / SIGMA)
        for s, h, g in zip((grid.origin[a] + V * np.arange(grid.n_xyz[a]) for a in range(3)), HALF, high, strict=True)
    )
    return as_volume(z[:, None, None] * y[None, :, None] * x[None, None, :], grid)


@pytest.fixture(scope="module")
def mesh():
    return box(HALF, 12)


def inner(mesh, axis, side):
    """Vertices of one face that keep away from its edges."""
    near = np.abs(mesh.points / HALF)
    others = np.delete(near, axis, axis=1).max(axis=1) < 0.7
    return others & (np.abs(mesh.points[:, axis] - side * HALF[axis]) < 1e-9)


def test_the_deviation_of_each_face(block, mesh):
    found = compare(block, mesh)
    assert found.deviation[inner(mesh, 0, 1)] == pytest.approx(0.02, abs=3e-4 * V)
    for axis, side in ((0, -1), (1, 1), (1, -1), (2, 1), (2, -1)):
        assert found.deviation[inner(mesh, axis, side)] == pytest.approx(0.0, abs=3e-4 * V)
    assert np.isnan(found.deviation[mesh.on_edge]).all()


def test_best_fit_finds_a_moved_part_and_says_by_how_much(block, mesh):
    turn, shift = exp_rotation(np.array([0.01, -0.008, 0.012])), np.array([0.05, -0.04, 0.03])
    moved = Mesh(points=mesh.points @ turn.T + shift, faces=mesh.faces)
    found = compare(block, moved, fit="best-fit", search_mm=0.3)
    assert found.moved_mm == pytest.approx(np.linalg.norm(shift), abs=0.02)
    assert found.turned_rad == pytest.approx(np.linalg.norm([0.01, -0.008, 0.012]), rel=0.05)
    # The box is longer by 0.02 along x: a rigid motion can only share that between both faces.
    across = [np.nanmean(found.deviation[inner(mesh, 0, s)]) for s in (1, -1)]
    assert sum(across) == pytest.approx(0.02, abs=5e-4)


def test_alignment_by_points_recovers_a_motion(rng):
    x = rng.normal(size=(9, 3))
    turn, shift = exp_rotation(np.array([0.4, -1.0, 2.0])), np.array([3.0, -2.0, 1.0])
    found = from_points(x, x @ turn.T + shift)
    assert np.abs(found.R - turn).max() < 1e-12
    assert np.abs(found.t - shift).max() < 1e-12
    with pytest.raises(InputError, match="on a line"):
        from_points(np.outer(np.arange(4.0), [1, 2, 3]), x[:4])


def test_signed_distances_are_exact(rng):
    mesh = box(np.array([1.0, 1.0, 1.0]), 4)
    x = rng.uniform(-2, 2, (4000, 3))
    q = np.abs(x) - 1
    truth = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    assert np.abs(signed_distances(x, mesh) - truth).max() < 1e-6


def test_the_sign_is_right_at_sharp_corners_too(rng):
    """A thin spike: its tip and edges are nearest for many points; VTK's own distances as the other opinion."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkDoubleArray, vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

    points = np.array([[0.0, 0, 5], [0.3, 0, 0], [-0.2, 0.3, 0], [-0.2, -0.3, 0]])
    mesh = Mesh(points=points, faces=[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]).require_closed()
    x = rng.uniform([-1, -1, -1], [1, 1, 7], (3000, 3))
    found = signed_distances(x, mesh)
    corners, cells, data, out = vtkPoints(), vtkCellArray(), vtkPolyData(), vtkDoubleArray()
    corners.SetDataTypeToDouble()
    corners.SetData(numpy_to_vtk(points, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(mesh.faces.astype(np.int64).ravel(), deep=True))
    data.SetPoints(corners)
    data.SetPolys(cells)
    function = vtkImplicitPolyDataDistance()
    function.SetInput(data)
    function.FunctionValue(numpy_to_vtk(x, deep=True), out)
    assert np.abs(found - vtk_to_numpy(out)).max() < 1e-12
    n = mesh.face_normals / np.linalg.norm(mesh.face_normals, axis=1)[:, None]
    inside = (np.einsum("nfj,fj->nf", x[:, None] - points[mesh.faces[:, 0]], n) < 0).all(axis=1)
    assert ((found < 0) == inside).all()
    with pytest.raises(InputError, match="not finite"):
        signed_distances(np.full((2, 3), np.nan), mesh)


def test_elements_and_edges_of_a_box(mesh):
    assert len(np.unique(mesh.elements)) == 6
    assert mesh.on_edge.sum() == 12 * 11 + 8
    assert mesh.open_edges == 0


def test_the_reference_follows_probed_points_but_not_at_edges(mesh, rng):
    face = inner(mesh, 0, 1)
    probed = mesh.points[face] + [0.011, 0, 0]
    after = corrected_reference(mesh, probed)
    moved = after.points - mesh.points
    on_top = (np.abs(mesh.points[:, 0] - HALF[0]) < 1e-9) & ~mesh.on_edge
    assert moved[on_top] == pytest.approx(np.broadcast_to([0.011, 0, 0], (on_top.sum(), 3)), abs=1e-12)
    assert not moved[~on_top].any()


@pytest.mark.parametrize("interpolation", ["cells", "natural"])
def test_each_probed_point_moves_its_own_cell_or_blends_with_its_neighbours(mesh, interpolation):
    """Four points on the top face, one of them high: what happens at the points, between them and on other faces."""
    top = HALF[2]
    probed = np.array([[-0.75, -0.65, top], [0.75, -0.65, top], [-0.75, 0.65, top], [0.75, 0.65, top + 0.012]])
    moved = corrected_reference(mesh, probed, interpolation=interpolation).points - mesh.points
    on_top = (np.abs(mesh.points[:, 2] - top) < 1e-9) & ~mesh.on_edge
    assert not moved[~on_top].any()
    shift = moved[on_top, 2]
    x = mesh.points[on_top]
    at = [np.argmin(np.linalg.norm(x[:, :2] - p[:2], axis=1)) for p in probed]
    assert shift[at] == pytest.approx([0, 0, 0, 0.012], abs=1e-9)
    middle = (np.abs(x[:, :2]) < 0.3).all(axis=1) & (np.abs(x[:, :2]) > 1e-9).all(axis=1)
    assert set(np.round(shift, 9)) == {0.0, 0.012} if interpolation == "cells" else 0.0 < shift[middle].mean() < 0.012


def test_probed_points_from_a_table(tmp_path):
    path = tmp_path / "cmm.csv"
    path.write_text("# part coordinates\nx_mm,y_mm,z_mm\n1,2,3\n-1.5,0,2e-3\n", encoding="utf-8")
    assert read_probed_points(path).tolist() == [[1, 2, 3], [-1.5, 0, 0.002]]
    path.write_text("x,y,z\n1,2,3\n", encoding="utf-8")
    with pytest.raises(UnitError, match="x_mm"):
        read_probed_points(path)
    path.write_text("x_mm,y_mm,z_mm\n1,2\n", encoding="utf-8")
    with pytest.raises(FileError):
        read_probed_points(path)


@pytest.mark.slow
def test_smaller_triangles_lie_on_the_same_surface():
    coarse = box(np.array([1.0, 0.4, 0.7]), 1)
    fine = refined(coarse, 0.13)
    fine.require_closed()
    ends = fine.points[fine.faces]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max() <= 0.13
    assert np.abs(signed_distances(fine.points, coarse)).max() < 1e-12
    area = [0.5 * np.linalg.norm(m.face_normals, axis=1).sum() for m in (coarse, fine)]
    assert area[0] == pytest.approx(area[1], rel=1e-12)
    assert len(np.unique(fine.elements)) == 6
    with pytest.raises(InputError, match="triangles"):
        refined(coarse, 1e-5)


def write_stl(path, mesh):
    record = np.zeros(len(mesh.faces), dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    record["v"] = mesh.points[mesh.faces]
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(record)) + record.tobytes())


def test_files_round_trip(block, mesh, tmp_path):
    found = compare(block, mesh)
    write_comparison(tmp_path, found, range_mm=0.025)
    assert all((tmp_path / f).stat().st_size > 100 for f in FILES)
    again = read_mesh(tmp_path / "comparison.ply")
    assert again.points == pytest.approx(found.points)
    assert (again.faces == mesh.faces).all()
    glb = (tmp_path / "comparison.glb").read_bytes()
    assert glb[:4] == b"glTF"
    assert struct.unpack_from("<I", glb, 8)[0] == len(glb)
    summary = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert summary["on_edge"] == mesh.on_edge.sum()
    with pytest.raises(FileError, match="exists"):
        write_comparison(tmp_path, found, range_mm=0.025)
    write_stl(tmp_path / "box.stl", mesh)
    stl = read_mesh(tmp_path / "box.stl")
    assert stl.open_edges == 0
    assert len(stl.points) == len(mesh.points)


def test_vtk_reads_the_vtp(block, mesh, tmp_path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    found = compare(block, mesh)
    write_comparison(tmp_path, found, range_mm=0.025)
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "comparison.vtp"))
    reader.Update()
    data = reader.GetOutput()
    assert data.GetNumberOfPolys() == len(mesh.faces)
    shown = vtk_to_numpy(data.GetPointData().GetArray("deviation_um"))
    assert shown[np.isfinite(shown)] == pytest.approx(found.measured * 1000)


def test_colours_are_clipped_and_grey_where_nothing_was_measured(block, mesh):
    found = compare(block, mesh)
    colours = found.colours(0.01)
    assert (colours[mesh.on_edge] == 150).all()
    assert len(np.unique(colours[inner(mesh, 0, 1)], axis=0)) == 1


class TestBadReference:
    def test_open(self, block, mesh):
        with pytest.raises(InputError, match="watertight"):
            compare(block, Mesh(points=mesh.points, faces=mesh.faces[1:]))

    def test_inside_out(self, block, mesh):
        with pytest.raises(InputError, match="inside out"):
            compare(block, Mesh(points=mesh.points, faces=mesh.faces[:, ::-1]))

    def test_metres(self, block, mesh):
        with pytest.raises(UnitError, match="metres"):
            compare(block, Mesh(points=mesh.points / 1000, faces=mesh.faces))

    def test_far_probed_points(self, mesh):
        with pytest.raises(InputError, match="off the reference"):
            corrected_reference(mesh, mesh.points[:5] * 3)

    def test_a_mirrored_alignment(self):
        with pytest.raises(InputError, match="no rotation"):
            Alignment(R=np.diag([1.0, 1.0, -1.0]), t=np.zeros(3))

    def test_damaged_files(self, tmp_path):
        for name, content in (("a.stl", b"solid"), ("a.ply", b"ply\n"), ("a.obj", b"v 0 0 0")):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(FileError):
                read_mesh(tmp_path / name)
        with pytest.raises(FileError, match="does not exist"):
            read_mesh(tmp_path / "none.stl")
