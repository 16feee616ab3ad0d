"""Other packages read what we write, and say where the points fall: ctsimu, itk-rtk, astra-toolbox.

In continuous integration (CI set) a missing package is a failure, elsewhere a skip with its name.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from exports_cases import TOLERANCE_PX, circular_matrices, matrices_of, pixels, points, random_matrices
from scipy.spatial.transform import Rotation

from tomopose.exports import export, read_geometry
from tomopose.exports.ctsimu_scenario import from_ctsimu
from tomopose.exports.panel import Given

pytestmark = [
    pytest.mark.authority,
    # SWIG and Cython modules of itk and astra, on their first import
    pytest.mark.filterwarnings("ignore:builtin type .* has no __module__ attribute:DeprecationWarning"),
]

X = points(m=15)


def package(name):
    try:
        return importlib.import_module(name)
    except ImportError:
        if os.environ.get("CI"):
            pytest.fail(f"{name} is not installed; it must be in continuous integration")
        pytest.skip(f"{name} is not installed")


@pytest.fixture(params=["views all around", "circle", "one view", "moving panel"])
def matrices(request):
    return {
        "views all around": lambda: random_matrices(1, n=7, fixed=True),
        "circle": lambda: circular_matrices(9),
        "one view": lambda: random_matrices(2, n=1),
        "moving panel": lambda: random_matrices(3, n=6),
    }[request.param]()


@pytest.fixture
def folder(matrices, tmp_path):
    export(matrices, tmp_path / "out")
    return tmp_path / "out"


def ctsimu_matrices(scenario, mode="CERA"):
    """As a reconstruction sees the scenario: ctsimu's own projection matrices, (n, 3, 4)."""
    P = []
    for frame in range(scenario.n_frames()):
        scenario.set_frame(frame, reconstruction=True)
        P.append(np.array(scenario.current_geometry().projection_matrix(mode=mode).value, dtype=float))
    return np.array(P)


# -- ctsimu ----------------------------------------------------------------------------------------------------------


def test_ctsimu_reads_our_scenario(matrices, folder):
    scenario = package("ctsimu.scenario").Scenario(str(folder / "ctsimu.json"))
    assert scenario.n_frames() == len(matrices)
    np.testing.assert_allclose(pixels(ctsimu_matrices(scenario), X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


def test_our_cera_and_openct_matrices_are_those_of_ctsimu(matrices, folder):
    """What ctsimu derives from our scenario equals, up to scale, what we wrote for CERA and openCT ourselves."""
    scenario = package("ctsimu.scenario").Scenario(str(folder / "ctsimu.json"))
    ours = np.array(json.loads((folder / "openct.json").read_text())["projections"]["matrices"])
    np.testing.assert_allclose(pixels(ours, X), pixels(ctsimu_matrices(scenario, "OpenCT"), X), rtol=0, atol=1e-7)
    cera = read_geometry(folder, format="cera").P
    np.testing.assert_allclose(pixels(cera, X), pixels(ctsimu_matrices(scenario, "CERA"), X), rtol=0, atol=TOLERANCE_PX)


def test_we_read_what_ctsimu_writes_for_cera_and_openct(matrices, folder, tmp_path):
    ctsimu = package("ctsimu.geometry")
    scenario = package("ctsimu.scenario").Scenario(str(folder / "ctsimu.json"))
    scenario.set_frame(0, reconstruction=True)
    start = scenario.current_geometry()

    def as_matrices(mode):
        primitives = package("ctsimu.primitives")
        return [primitives.Matrix(values=P.tolist()) for P in ctsimu_matrices(scenario, mode)]

    theirs = tmp_path / "theirs"
    theirs.mkdir()
    ctsimu.create_CERA_config(
        geo=start,
        projection_file_pattern="p_%04d.tif",
        basename="scan",
        save_dir=str(theirs),
        n_projections=len(matrices),
        matrices=as_matrices("CERA"),
    )
    ctsimu.create_OpenCT_config(
        geo=start,
        filename=str(theirs / "scan.json"),
        projection_files=[f"{k}.tif" for k in range(len(matrices))],
        matrices=as_matrices("OpenCT"),
    )
    for name in ("scan.config", "scan.json"):
        back = read_geometry(theirs / name)
        assert (back.n_u, back.n_v) == (matrices.n_u, matrices.n_v)
        np.testing.assert_allclose([back.p_u, back.p_v], [matrices.p_u, matrices.p_v], rtol=1e-12)
        np.testing.assert_allclose(back.project(X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


def quantity(value, unit="mm", *drifts):
    return {"value": value, "unit": unit, "drifts": [*drifts]}


def drift(values, unit="mm", known=True):
    return {"value": values, "unit": unit, "known_to_reconstruction": known}


def general_scenario(direction, final, n=11):
    """A scenario nothing of which is ours: a turning stage, tilted parts, pivots, drifts of every length."""

    def xyz(x, y, z):
        return {k: {"value": v} for k, v in zip("xyz", (x, y, z), strict=True)}

    def position(x, y, z, *drifts):
        return {"x": quantity(x, "mm", *drifts), "y": quantity(y, "mm"), "z": quantity(z / 10, "cm")}

    def turn(axis, degrees, *drifts, pivot=None, known=True):
        d = {
            "type": "rotation",
            "axis": axis,
            "amount": quantity(degrees, "deg", *drifts),
            "known_to_reconstruction": known,
        }
        return d if pivot is None else {**d, "pivot": pivot}

    def shift(axis, mm, *drifts):
        return {
            "type": "translation",
            "axis": axis,
            "amount": quantity(mm, "mm", *drifts),
            "known_to_reconstruction": True,
        }

    world_pivot = {k: quantity(v) for k, v in zip("xyz", (30.0, -4.0, 2.0), strict=True)}
    own_pivot = {k: quantity(v) for k, v in zip("uvw", (3.0, 5.0, -2.0), strict=True)}
    return {
        "file": {"file_type": "CTSimU Scenario", "file_format_version": {"major": 1, "minor": 2}},
        "geometry": {
            "detector": {
                "center": position(900, 11, -6, drift([0.0, 0.5, -0.2])),
                "vector_u": xyz(0, -1, 0),
                "vector_w": xyz(1, 0, 0),
                "deviations": [turn("u", 0.7), turn("z", -1.1, drift([0, 0.3], "deg"), pivot=own_pivot)],
            },
            "source": {
                "center": position(0.3, -0.2, 0.1),
                "vector_u": xyz(0, -1, 0),
                "vector_w": xyz(1, 0, 0),
                "deviations": [shift("y", 0.4, drift([0.1] * n)), shift("w", 1.5), turn("x", 2.0, pivot=world_pivot)],
            },
            "stage": {
                "center": position(250, 1.5, -2.5, drift([0, 1, -1, 2]), drift([5.0] * n, "mm", False)),
                "vector_u": xyz(2, 0, 0),
                "vector_w": xyz(0, 0, 3),
                "deviations": [
                    turn("v", 3.0, drift([-0.5, 0.25, 0.5, 0.1], "deg")),
                    turn({k: {"value": v} for k, v in zip("uvw", (1, 0.5, -0.2), strict=True)}, -2.0, pivot=own_pivot),
                    turn({k: {"value": v} for k, v in zip("xyz", (0.1, 1, 0.4), strict=True)}, 1.2, pivot=world_pivot),
                    shift("z", -1.3, drift([0, 2000], "um")),
                    turn("w", 45.0, known=False),
                ],
            },
        },
        "source": {"model": "any"},
        "detector": {
            "type": "ideal",
            "columns": {"value": 301},
            "rows": {"value": 257},
            "pixel_pitch": {"u": quantity(0.2), "v": quantity(250, "um")},
        },
        "acquisition": {
            "start_angle": quantity(10, "deg"),
            "stop_angle": quantity(370, "deg"),
            "direction": direction,
            "scan_mode": "stop+go",
            "number_of_projections": n,
            "include_final_angle": final,
        },
        "samples": [],
        "materials": [],
    }


@pytest.mark.parametrize("direction", ["CCW", "CW"])
@pytest.mark.parametrize("final", [True, False])
def test_we_read_scenarios_as_ctsimu_does(direction, final, tmp_path):
    content = general_scenario(direction, final)
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps(content))
    theirs = ctsimu_matrices(package("ctsimu.scenario").Scenario(str(path)))
    ours = read_geometry(path)
    np.testing.assert_allclose(ours.project(X), pixels(theirs, X), rtol=0, atol=TOLERANCE_PX)
    assert from_ctsimu(content, Given()).P.shape == (11, 3, 4)


# -- itk-rtk ---------------------------------------------------------------------------------------------------------


def rtk_module():
    package("itk")
    return importlib.import_module("itk").RTK


def rtk_axes(folder):
    side = json.loads((folder / "rtk.json").read_text())
    A = np.array([[side["spacing"][0], 0, side["origin"][0]], [0, side["spacing"][1], side["origin"][1]], [0, 0, 1]])
    R = np.eye(4)
    R[:3, :3] = side["world_to_rtk"]
    return A, R


@pytest.mark.slow
def test_rtk_reads_our_xml(matrices, folder):
    rtk, itk = rtk_module(), package("itk")
    reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
    reader.SetFilename(str(folder / "rtk.xml"))
    reader.GenerateOutputInformation()
    geometry = reader.GetOutputObject()
    assert len(geometry.GetGantryAngles()) == len(matrices)
    M = np.array([itk.array_from_matrix(geometry.GetMatrix(k)) for k in range(len(matrices))])
    A, R = rtk_axes(folder)
    # RTK's own sign has w < 0 in front of the source.
    np.testing.assert_allclose(pixels(-np.linalg.inv(A) @ M @ R, X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


@pytest.mark.slow
def test_rtk_finds_the_same_nine_parameters(matrices, folder):
    """AddProjection decomposes the matrix itself; it answers False, and drops the view, where it cannot."""
    rtk, itk = rtk_module(), package("itk")
    A, R = rtk_axes(folder)
    theirs = rtk.ThreeDCircularProjectionGeometry.New()
    for P in matrices.P:
        assert theirs.AddProjection(itk.matrix_from_array(np.ascontiguousarray(A @ P @ R.T))) is True
    reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
    reader.SetFilename(str(folder / "rtk.xml"))
    reader.GenerateOutputInformation()
    ours = reader.GetOutputObject()
    for name in (
        "SourceToIsocenterDistances",
        "SourceToDetectorDistances",
        "SourceOffsetsX",
        "SourceOffsetsY",
        "ProjectionOffsetsX",
        "ProjectionOffsetsY",
    ):
        a, b = (np.array(getattr(g, f"Get{name}")()) for g in (ours, theirs))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8, err_msg=name)
    for name in ("GantryAngles", "OutOfPlaneAngles", "InPlaneAngles"):
        a, b = (np.exp(1j * np.array(getattr(g, f"Get{name}")())) for g in (ours, theirs))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_we_read_what_rtk_writes(matrices, folder, tmp_path):
    rtk, itk = rtk_module(), package("itk")
    A, R = rtk_axes(folder)
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for P in matrices.P:
        assert geometry.AddProjection(itk.matrix_from_array(np.ascontiguousarray(A @ P @ R.T))) is True
    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetObject(geometry)
    writer.SetFilename(str(tmp_path / "theirs.xml"))
    writer.WriteFile()
    back = read_geometry(tmp_path / "theirs.xml", side=folder / "rtk.json")
    np.testing.assert_allclose(back.project(X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


@pytest.mark.slow
def test_rtk_draws_a_sphere_where_the_matrices_put_it(tmp_path):
    """Through RTK's own ray tracer: origin, spacing, axes and row order of rtk.json, not only the matrices."""
    rtk, itk = rtk_module(), package("itk")
    rng = np.random.default_rng(4)
    matrices = matrices_of(
        Rotation.random(4, random_state=rng).as_matrix(),
        np.tile([400.0, 1000.0], (4, 1)),
        np.hstack([rng.uniform(-3, 3, (4, 2)), rng.uniform(-5, 5, (4, 2))]),
        n_u=61,
        n_v=55,
        p_u=1.0,
        p_v=1.25,
    )
    export(matrices, tmp_path / "out", formats="rtk")
    side = json.loads((tmp_path / "out" / "rtk.json").read_text())
    reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
    reader.SetFilename(str(tmp_path / "out" / "rtk.xml"))
    reader.GenerateOutputInformation()
    stack = itk.image_from_array(np.zeros((len(matrices), matrices.n_v, matrices.n_u), np.float32))
    stack.SetOrigin([*side["origin"], 0.0])
    stack.SetSpacing([*side["spacing"], 1.0])
    centre, radius = np.array([2.0, -1.0, 3.0]), 3.0
    draw = rtk.RayEllipsoidIntersectionImageFilter.New(stack)
    draw.SetGeometry(reader.GetOutputObject())
    draw.SetDensity(1.0)
    draw.SetAxis([radius] * 3)
    draw.SetCenter([float(x) for x in np.array(side["world_to_rtk"]) @ centre])
    draw.Update()
    shadow = itk.array_from_image(draw.GetOutput())
    v, u = np.mgrid[: matrices.n_v, : matrices.n_u]
    middle = np.stack([(u * shadow).sum((1, 2)), (v * shadow).sum((1, 2))], axis=-1) / shadow.sum((1, 2))[:, None]
    # The centroid of a round shadow of some 20 pixels; a slip of half a pixel or a wrong row order cannot hide here.
    np.testing.assert_allclose(middle, matrices.project(centre[None])[:, 0], rtol=0, atol=0.1)


# -- astra-toolbox ---------------------------------------------------------------------------------------------------


class AstraCone:
    """libastra's own projectPoint of a cone_vec geometry, called by its symbol; needs no GPU.

    A std::vector is three pointers; the constructor takes its buffer over and nothing is destroyed, so that the buffer
    stays ours.
    """

    def __init__(self, vectors, rows, cols):
        folder = Path(package("astra").__file__).parent
        library = ctypes.CDLL(str(next(folder.glob("libastra.so*"))))
        name = "_ZN5astra28CConeVecProjectionGeometry3DC1EiiiOSt6vectorINS_15SConeProjectionESaIS2_EE"
        make = getattr(library, name)
        make.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_void_p]
        make.restype = None
        self._project = library._ZNK5astra28CConeVecProjectionGeometry3D12projectPointEdddiRdS1_
        self._project.argtypes = [ctypes.c_void_p, *[ctypes.c_double] * 3, ctypes.c_int, *[ctypes.c_void_p] * 2]
        self._project.restype = None
        # ASTRA keeps the corner of the panel; it makes it from the centre like this when it reads the vectors.
        S, C, U, V = np.split(np.asarray(vectors, dtype=np.float64), 4, axis=1)
        self._table = np.ascontiguousarray(np.hstack([S, C - rows / 2 * V - cols / 2 * U, U, V]))
        begin = self._table.ctypes.data
        vector = (ctypes.c_void_p * 3)(begin, begin + self._table.nbytes, begin + self._table.nbytes)
        self._object = ctypes.create_string_buffer(4096)
        make(self._object, len(S), rows, cols, vector)

    def project(self, x):
        out = np.empty((len(self._table), len(x), 2))
        u, v = ctypes.c_double(), ctypes.c_double()
        for k in range(len(self._table)):
            for j, point in enumerate(x):
                self._project(self._object, *map(float, point), k, ctypes.byref(u), ctypes.byref(v))
                out[k, j] = u.value, v.value
        return out


@pytest.mark.parametrize("rows", ["bottom", "top"])
def test_astra_projects_our_vectors(matrices, tmp_path, rows):
    export(matrices, tmp_path / "out", formats="astra", rows=rows)
    cone = AstraCone(np.load(tmp_path / "out" / "astra.npy"), matrices.n_v, matrices.n_u)
    px = cone.project(X)
    if rows == "top":
        px[..., 1] = matrices.n_v - 1 - px[..., 1]
    np.testing.assert_allclose(px, matrices.project(X), rtol=0, atol=TOLERANCE_PX)


def test_astra_takes_the_geometry_and_keeps_its_corner_rule(matrices, tmp_path):
    """Through ASTRA's own C++ object and back: it moves to the corner and returns to the centre by the rule above."""
    astra = package("astra")
    export(matrices, tmp_path / "out", formats="astra")
    vectors = np.load(tmp_path / "out" / "astra.npy")
    geometry = astra.create_proj_geom("cone_vec", matrices.n_v, matrices.n_u, vectors)
    data = astra.data3d.create("-proj3d", geometry)
    try:
        assert astra.data3d.get(data).shape == (matrices.n_v, len(matrices), matrices.n_u)
        kept = astra.data3d.get_geometry(data)["Vectors"]
    finally:
        astra.data3d.delete(data)
    np.testing.assert_allclose(kept, vectors, rtol=0, atol=1e-10)
    back = read_geometry(tmp_path / "out" / "astra.npy")
    np.testing.assert_allclose(back.project(X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)
