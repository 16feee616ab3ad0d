"""What each file of an export folder says, read with NumPy, JSON and XML alone, after the formats' own definitions.

Every function returns pixels (n, m, 2) in D (origin: centre of the bottom-left pixel, v up) of points (m, 3) in W.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET

import numpy as np
from exports_cases import pixels
from scipy.spatial.transform import Rotation


def manifest(folder):
    return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))


def row0(folder, name):
    return manifest(folder)["formats"][name]["row0"]


def upwards(px, folder, name):
    """Array rows to v by the row order that the manifest states."""
    if row0(folder, name) == "top":
        px = px.copy()
        px[..., 1] = manifest(folder)["n_v_px"] - 1 - px[..., 1]
    return px


def on_panel(S, C, U, V, x, n_u, n_v):
    """Where the ray from S through x meets the panel, in steps U, V from pixel (0, 0); C is the panel's middle."""
    out = np.empty((len(S), len(x), 2))
    for k in range(len(S)):
        normal = np.cross(U[k], V[k])
        for j, point in enumerate(x):
            ray = point - S[k]
            hit = S[k] + ray * (normal @ (C[k] - S[k])) / (normal @ ray) - C[k]
            out[k, j] = (
                hit @ U[k] / (U[k] @ U[k]) + (n_u - 1) / 2,
                hit @ V[k] / (V[k] @ V[k]) + (n_v - 1) / 2,
            )
    return out


def size(folder):
    m = manifest(folder)
    return m["n_u_px"], m["n_v_px"]


def astra(folder, x):
    v = np.load(folder / "astra.npy")
    assert v.dtype == np.float64
    assert v.shape[1] == 12
    return upwards(on_panel(v[:, :3], v[:, 3:6], v[:, 6:9], v[:, 9:], x, *size(folder)), folder, "astra")


def leap(folder, x):
    a = np.load(folder / "leap.npz")
    assert set(a.files) == {
        "source_positions",
        "module_centers",
        "row_vectors",
        "col_vectors",
        "pixel_height",
        "pixel_width",
    }
    for name in ("row_vectors", "col_vectors"):
        np.testing.assert_allclose(np.linalg.norm(a[name], axis=1), 1, atol=1e-9)
    U, V = a["pixel_width"] * a["col_vectors"], a["pixel_height"] * a["row_vectors"]
    return upwards(on_panel(a["source_positions"], a["module_centers"], U, V, x, *size(folder)), folder, "leap")


def cil(folder, x):
    a = np.load(folder / "cil.npz")
    assert set(a.files) == {"source", "detector", "direction_x", "direction_y", "pixel_size", "num_pixels", "origin"}
    U, V = a["pixel_size"][0] * a["direction_x"], a["pixel_size"][1] * a["direction_y"]
    # CIL negates the vertical step for origin 'top-left'; the manifest's row order must say the same.
    step = {"bottom-left": 1, "top-left": -1}[str(a["origin"])]
    assert (step == -1) == (row0(folder, "cil") == "top")
    return upwards(on_panel(a["source"], a["detector"], U, step * V, x, *a["num_pixels"]), folder, "cil")


def tigre(folder, x):
    a = np.load(folder / "tigre.npz")
    assert set(a.files) == {
        "DSO",
        "DSD",
        "angles",
        "offDetector",
        "rotDetector",
        "nDetector",
        "dDetector",
        "offOrigin",
        "COR",
    }
    assert row0(folder, "tigre") == "bottom"
    assert not a["offOrigin"].any()
    assert not a["COR"].any()
    Rw = Rotation.from_euler("ZYZ", a["angles"]).as_matrix()
    panel = Rw @ Rotation.from_euler("ZYX", a["rotDetector"][:, ::-1]).as_matrix()
    S = Rw @ np.stack([a["DSO"], 0 * a["DSO"], 0 * a["DSO"]], axis=1)[..., None]
    C = Rw @ np.stack([-(a["DSD"] - a["DSO"]), a["offDetector"][:, 1], a["offDetector"][:, 0]], axis=1)[..., None]
    U, V = a["dDetector"][1] * panel[:, :, 1], a["dDetector"][0] * panel[:, :, 2]
    return on_panel(S[..., 0], C[..., 0], U, V, x, a["nDetector"][1], a["nDetector"][0])


def pyronn(folder, x):
    P = np.load(folder / "pyronn.npz")["projection_matrices"]
    np.testing.assert_allclose(np.linalg.norm(P[:, 2, :3], axis=1), 1, atol=1e-12)
    return upwards(pixels(P, x), folder, "pyronn")


def rtk_side(folder):
    side = json.loads((folder / "rtk.json").read_text(encoding="utf-8"))
    (ox, oy), (pu, pv) = side["origin"], side["spacing"]
    assert row0(folder, "rtk") == "bottom"
    assert side.get("direction", [1, 1]) == [1, 1]
    return np.array([[pu, 0, ox], [0, pv, oy], [0, 0, 1.0]]), np.array(side["world_to_rtk"])


def rtk(folder, x):
    """By the stored matrices."""
    A, R = rtk_side(folder)
    views = ET.parse(folder / "rtk.xml").getroot().findall("Projection")
    M = np.array([np.array(v.find("Matrix").text.split(), dtype=float).reshape(3, 4) for v in views])
    return pixels(np.linalg.inv(A) @ -M, x @ R.T)


def rtk_params(folder, x):
    """By the nine parameters, composed as RTK composes them."""
    A, R = rtk_side(folder)
    out = []
    for v in ET.parse(folder / "rtk.xml").getroot().findall("Projection"):
        p = {e.tag: float(e.text) for e in v if e.tag != "Matrix"}
        sid, sdd = p["SourceToIsocenterDistance"], p["SourceToDetectorDistance"]
        assert sid > 0
        assert sdd > 0
        angles = -np.array([p["InPlaneAngle"], p["OutOfPlaneAngle"], p["GantryAngle"]])
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        shift = np.eye(4)
        shift[:2, 3] = -p["SourceOffsetX"], -p["SourceOffsetY"]
        K = np.array([[-sdd, 0, 0, 0], [0, -sdd, 0, 0], [0, 0, 1, -sid]])
        back = np.eye(3)
        back[:2, 2] = p["SourceOffsetX"] - p["ProjectionOffsetX"], p["SourceOffsetY"] - p["ProjectionOffsetY"]
        out.append(-(back @ K @ shift @ T))
    return pixels(np.linalg.inv(A) @ np.array(out), x @ R.T)


def cera(folder, x):
    config = dict(re.findall(r"^(\w+) = (.*)$", (folder / "cera.config").read_text(), flags=re.M))
    assert (config["FlipV"] == "true") == (row0(folder, "cera") == "top")
    assert config["FlipU"] == "false"
    assert (int(config["NumChannelsPerRow"]), int(config["NumRows"])) == size(folder)
    lines = (folder / config["ProjectionMatrixFilename"]).read_text().splitlines()
    assert lines[0] == "projtable.txt version 3"
    assert lines[1].strip()
    assert lines[2] == ""
    assert lines[3] == "# format: angle / entries of projection matrices"
    n = int(lines[4])
    assert n == int(config["NumProjections"])
    P = []
    for k in range(n):
        block = lines[5 + 6 * k : 11 + 6 * k]
        assert block[0] == f"@{k + 1}"
        assert block[1] == "0.0 0.0"
        assert block[5:] in ([""], [])
        P.append([[float(s) for s in line.split()] for line in block[2:5]])
    return pixels(P, x)


def openct(folder, x):
    d = json.loads((folder / "openct.json").read_text(encoding="utf-8"))
    projections, geometry = d["projections"], d["geometry"]
    assert d["OpenCTJSON"]["variant"] == "FreeTrajectoryCBCTScan"
    assert projections["detectorCoordinateFrame"] == "OriginAtDetectorCenter.VerticalAxisRunningDownwards"
    assert projections["detectorCoordinateDimension"] == "Length"
    assert geometry["mirrorDetectorAxis"] == ""
    n_u, n_v = geometry["detectorPixel"]
    p_u, p_v = geometry["detectorSize"][0] / n_u, geometry["detectorSize"][1] / n_v
    P = np.array(projections["matrices"])
    assert projections["numProjections"] == len(P)
    np.testing.assert_allclose(P[:, 2, 3], 1)
    px = pixels(P, x)
    return np.stack([px[..., 0] / p_u + (n_u - 1) / 2, (n_v - 1) / 2 - px[..., 1] / p_v], axis=-1)


def ctsimu(folder, x):
    """The frames of a scenario as this project writes it: no turn of the stage, deviations about w, v, u, drifts."""
    d = json.loads((folder / "ctsimu.json").read_text(encoding="utf-8"))
    assert d["file"]["file_type"] == "CTSimU Scenario"
    assert d["file"]["file_format_version"] == {"major": 1, "minor": 2}
    acquisition, geometry, detector = d["acquisition"], d["geometry"], d["detector"]
    assert acquisition["start_angle"]["value"] == acquisition["stop_angle"]["value"] == 0
    n = acquisition["number_of_projections"]

    def values(q):
        total = np.full(n, float(q["value"]))
        for drift in q.get("drifts", []):
            assert len(drift["value"]) == n
            assert drift["known_to_reconstruction"] is True
            total += drift["value"]
        return total

    def vector(v):
        return np.stack([values(v[k]) for k in "xyz"], axis=1)

    stage, panel = geometry["stage"], geometry["detector"]
    assert [e["axis"] for e in stage["deviations"]] == ["w", "v", "u"]
    assert {e["amount"]["unit"] for e in stage["deviations"]} == {"rad"}
    angles = np.stack([values(e["amount"]) for e in stage["deviations"]], axis=1)
    u, w = vector(stage["vector_u"]), vector(stage["vector_w"])
    axes = np.stack([u, np.cross(w, u), w], axis=-1) @ Rotation.from_euler("ZYX", angles).as_matrix()
    # the reconstruction's volume is the stage turned by 180 degrees about its w axis
    volume = axes @ np.diag([-1.0, -1.0, 1.0])

    def to_volume(point):
        return (np.swapaxes(volume, 1, 2) @ (point - vector(stage["center"]))[..., None])[..., 0]

    du, dw = vector(panel["vector_u"]), vector(panel["vector_w"])
    dv = np.cross(dw, du)
    S, C = to_volume(vector(geometry["source"]["center"])), to_volume(vector(panel["center"]))
    pitch = [detector["pixel_pitch"][k]["value"] for k in "uv"]
    U = (np.swapaxes(volume, 1, 2) @ du[..., None])[..., 0] * pitch[0]
    V = (np.swapaxes(volume, 1, 2) @ -dv[..., None])[..., 0] * pitch[1]  # the panel's own v points down
    return on_panel(S, C, U, V, x, detector["columns"]["value"], detector["rows"]["value"])


def thd(folder, x):
    """Focal spot, detector centre and the detector's axes as columns of its quaternion (x, y, z, w)."""
    views = [json.loads(p.read_text()) for p in sorted((folder / "thd").glob("*.json"), key=lambda p: p.name)]
    geometry = [v["projection_geometry"] for v in views]
    R = Rotation.from_quat([g["detector_center_orientation_quat"] for g in geometry]).as_matrix()
    panel = views[0]["detector"]
    n_u, n_v = panel["image_width_px"], panel["image_height_px"]
    S = np.array([g["focal_spot_position_mm"] for g in geometry])
    C = np.array([g["detector_center_position_mm"] for g in geometry])
    U, V = panel["pixel_pitch_width_mm"] * R[:, :, 0], panel["pixel_pitch_height_mm"] * R[:, :, 1]
    return on_panel(S, C, U, V, x, n_u, n_v)


def rx(folder, x):
    """`top` and `right` are half the panel's height and width away from its centre, as readers for CIL take them."""
    t = np.loadtxt(folder / "geom.csv", delimiter=";", skiprows=2, usecols=range(1, 13), ndmin=2)
    n_u, n_v = size(folder)
    U, V = (t[:, 9:12] - t[:, 3:6]) / n_u * 2, (t[:, 6:9] - t[:, 3:6]) / n_v * 2
    return on_panel(t[:, :3], t[:, 3:6], U, V, x, n_u, n_v)


DEFINITIONS = {f.__name__: f for f in (astra, rtk, rtk_params, leap, tigre, cil, cera, openct, ctsimu, pyronn, thd, rx)}
