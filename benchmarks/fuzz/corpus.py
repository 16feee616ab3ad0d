"""Sound files of every kind that is read, written by the package or here, and how each is read."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tifffile

import tomopose as tp
from tomopose.calibration.records.history import read_history
from tomopose.exports.folder import export
from tomopose.exports.reading import read_geometry
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.io.foreign.pi_gcs import read_gcs_log
from tomopose.io.images.writing import write_hdf5
from tomopose.io.volume_files import read_volume, write_volume
from tomopose.manipulator.files import read_manipulator, write_manipulator
from tomopose.manipulator.twin_file import read_twin
from tomopose.measurement.mesh.cmm_correction import read_probed_points
from tomopose.measurement.mesh.mesh_files import read_mesh
from tomopose.measurement.plan import read_plan
from tomopose.reading import parse_json, read_text
from tomopose.simulation.objects.mesh import read_mesh as read_simulated_mesh
from tomopose.simulation.scene.scene import read_scene

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class Seed:
    """A sound file and its reader.  beside: files that must lie beside it."""

    kind: str
    path: Path
    read: Callable[[Path], object]
    beside: tuple[Path, ...] = ()


def all_images(path: Path) -> None:
    """Every pixel of every image."""
    images = tp.open_images(path)
    for i in range(len(images)):
        images[i]


def raw_images(path: Path) -> None:
    images = tp.open_images(path, raw_layout=tp.RawLayout(shape=(9, 11), dtype="<u2", header=16))
    images[len(images) - 1]


def with_side(path: Path) -> None:
    read_geometry(path.parent / "rtk.xml", side=path, n_u=301, n_v=257)


def sized(path: Path) -> None:
    read_geometry(path, n_u=31, n_v=25, p_u=0.2, p_v=0.25, rows="bottom")


def scenario(path: Path) -> None:
    tp.run_from_ctsimu(parse_json(read_text(path), path))


def volume(path: Path) -> None:
    np.asarray(read_volume(path).values).sum()


def matrices(scanner: tp.Scanner) -> ProjectionMatrices:
    alpha = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    T_HT = tp.RigidTransform.from_angles([0.02, -0.03, 0.1], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)
    T_MH = tp.RigidTransform(R=np.stack([np.eye(3)] * 5), t=np.zeros((5, 3)), source=Frame.M, target=Frame.H)
    return ProjectionMatrices(
        P=eq5_matrices(scanner, T_HT=T_HT, T_MH=T_MH, alpha=alpha),
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=tuple(f"p{k}" for k in range(5)),
        scanner=scanner,
    )


GROUPS = ("tables", "geometry", "machines", "images", "volumes", "meshes", "texts")


def corpus(folder: Path, groups: tuple[str, ...] = GROUPS) -> list[Seed]:
    """The seeds of these groups, written into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    scanner = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=15.4, v_0=11.7, n_u=31, n_v=25)
    made: dict[str, Callable[[Path], Iterator[Seed]]] = {
        "tables": lambda place: _tables(place, scanner),
        "geometry": lambda place: _geometry(place, scanner),
        "machines": _machines,
        "images": _images,
        "volumes": _volumes,
        "meshes": _meshes,
        "texts": _texts,
    }
    return [seed for group in groups for seed in made[group](folder / group)]


def _tables(folder: Path, scanner: tp.Scanner) -> Iterator[Seed]:
    folder.mkdir()
    tp.write_scanner(folder / "scanner.json", scanner)
    yield Seed(kind="scanner", path=folder / "scanner.json", read=tp.read_scanner)
    poses = tp.pose_grid(2)
    tp.write_poses(folder / "poses.csv", poses)
    yield Seed(kind="poses", path=folder / "poses.csv", read=tp.read_poses)
    run = tp.simulate_ball_run(
        scanner,
        T_HT=tp.RigidTransform.from_angles([0.02, -0.03, 0.1], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T),
        t=[1.0, 20.0, 3.0],
        poses=poses,
    )
    rng = np.random.default_rng(1)
    centres = np.array([[p["u_px"], p["v_px"]] for p in run.truth()["poses"]])
    wide = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=700.4, v_0=611.7, n_u=1501, n_v=1203)
    centres += [wide.u_0 - scanner.u_0, wide.v_0 - scanner.v_0]
    observations = tp.BallObservations(
        x_D=centres + rng.normal(0, 0.01, centres.shape),
        covariance=np.tile(np.eye(2) * 1e-4, (len(centres), 1, 1)),
        pose_id=poses.pose_id,
    )
    tp.write_observations(folder / "observations.csv", observations)
    yield Seed(kind="observations", path=folder / "observations.csv", read=tp.read_observations)
    calibration = tp.calibrate(wide, poses, observations)
    tp.write_calibration(folder / "calibration.json", calibration)
    yield Seed(kind="calibration", path=folder / "calibration.json", read=tp.read_calibration)
    for _ in range(1):
        tp.append_history(folder / "history.jsonl", calibration)
    yield Seed(kind="history", path=folder / "history.jsonl", read=read_history)


def _geometry(folder: Path, scanner: tp.Scanner) -> Iterator[Seed]:
    folder.mkdir()
    views = matrices(scanner)
    tp.write_matrices(folder / "matrices.npz", views)
    yield Seed(kind="matrices", path=folder / "matrices.npz", read=tp.read_matrices)
    export(views, folder / "out")
    files = tuple(p for p in sorted(folder.glob("out/*")) if p.is_file())
    yield Seed(kind="manifest", path=folder / "out/manifest.json", read=read_geometry, beside=files)
    bare = tuple(p for p in files if p.name != "manifest.json")
    view = next(iter(sorted(folder.glob("out/thd/*.json"))), None)
    if view is not None:
        yield Seed(kind="geometry thd", path=view, read=lambda path: read_geometry(path.parent))
    for path in bare:
        if path.name == "rtk.json":
            yield Seed(kind="rtk side", path=path, read=with_side, beside=bare)
        else:
            yield Seed(kind=f"geometry {path.name}", path=path, read=sized, beside=bare)
            if path.name == "ctsimu.json":
                yield Seed(kind="scenario", path=path, read=scenario)


def _machines(folder: Path) -> Iterator[Seed]:
    folder.mkdir()
    write_manipulator(folder / "hexapod.json", _hexapod())
    yield Seed(kind="hexapod", path=folder / "hexapod.json", read=read_manipulator)
    joint = {"a_mm": 300.0, "alpha_deg": 90.0, "d_mm": 100.0, "theta_offset_deg": 0.0, "sigma": {"a_mm": 0.1}}
    robot = {"schema": "tomopose/serial/1", "convention": "dh", "joints": [joint] * 6, "tool": np.eye(4).tolist()}
    (folder / "robot.json").write_text(json.dumps(robot))
    yield Seed(kind="robot", path=folder / "robot.json", read=read_manipulator)
    twin = {
        "schema": "tomopose/twin/1",
        "detector": "robot.json",
        "source": robot,
        "base": {"t_mm": [1500, 0, 0], "angles_deg": [0, 0, 180], "sigma_t_mm": 20, "sigma_deg": 1.1},
        "focus_mm": [0, 0, 120],
        "focus_sigma_mm": 5,
        "panel": {"origin_mm": [0, 0, 100], "u_axis": [1, 0, 0], "v_axis": [0, -1, 0]},
    }
    (folder / "twin.json").write_text(json.dumps(twin))
    yield Seed(kind="twin", path=folder / "twin.json", read=read_twin, beside=(folder / "robot.json",))


def _hexapod() -> tp.Hexapod:
    angles = np.radians([[10, 110, 130, 230, 250, 350], [50, 70, 170, 190, 290, 310]])
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    base, plate = circle[0] * 160 - [0, 0, 450.0], circle[1] * 90 - [0, 0, 200.0]
    return tp.Hexapod(base_joints=base, platform_joints=plate)


def _images(folder: Path) -> Iterator[Seed]:
    folder.mkdir()
    stack = np.random.default_rng(2).integers(100, 60000, (3, 19, 23), dtype=np.uint16)
    for name, data, options in (
        ("plain", stack[0], {}),
        ("pages", stack, {"metadata": None}),
        ("imagej", stack, {"imagej": True}),
        ("zlib", stack, {"compression": "zlib", "metadata": None, "rowsperstrip": 4}),
        ("tiled", stack[0], {"tile": (16, 16), "compression": "zlib"}),
        ("big", stack[0], {"bigtiff": True, "byteorder": ">"}),
        ("float", stack[0].astype(np.float32), {}),
    ):
        tifffile.imwrite(folder / f"{name}.tif", data, photometric="minisblack", **options)
        yield Seed(kind=f"tiff {name}", path=folder / f"{name}.tif", read=all_images)
    write_hdf5(folder / "stack.h5", stack)
    yield Seed(kind="hdf5 stack", path=folder / "stack.h5", read=all_images)
    with h5py.File(folder / "nxtomo.h5", "w") as file:
        group = file.create_group("entry/instrument/detector")
        group.create_dataset("data", data=stack, chunks=(1, 8, 8), compression="gzip")
        group["image_key"] = np.array([0, 1, 0])
        file["entry"].attrs["NX_class"] = "NXentry"
    yield Seed(kind="hdf5 nxtomo", path=folder / "nxtomo.h5", read=all_images)
    _dicom(folder / "one.dcm", stack[0])
    yield Seed(kind="dicom", path=folder / "one.dcm", read=all_images)
    (folder / "frames.raw").write_bytes(b"h" * 16 + stack[:, :9, :11].tobytes())
    yield Seed(kind="raw", path=folder / "frames.raw", read=raw_images)


def _dicom(path: Path, image: np.ndarray) -> None:
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = "1.2.840.10008.5.1.4.1.1.7", "1.2.3"
    data = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    data.Rows, data.Columns = image.shape
    data.BitsAllocated = data.BitsStored = 16
    data.HighBit, data.SamplesPerPixel, data.PixelRepresentation = 15, 1, 0
    data.PhotometricInterpretation = "MONOCHROME2"
    data.RescaleSlope, data.RescaleIntercept, data.NumberOfFrames = "1", "0", "1"
    data.PixelData = image.tobytes()
    data.save_as(path)


def _volumes(folder: Path) -> Iterator[Seed]:
    folder.mkdir()
    grid = tp.VoxelGrid(shape=(5, 6, 7), spacing=0.1)
    values = np.random.default_rng(3).normal(size=grid.shape).astype(np.float32)
    one = tp.Volume(values=values, grid=grid, view_residual=np.zeros(4))
    for suffix in ("h5", "tif", "nrrd", "mhd"):
        write_volume(folder / f"v.{suffix}", one)
    for suffix in ("h5", "tif", "nrrd"):
        yield Seed(kind=f"volume {suffix}", path=folder / f"v.{suffix}", read=volume)
    yield Seed(kind="volume mhd", path=folder / "v.mhd", read=volume, beside=(folder / "v.raw",))


def _meshes(folder: Path) -> Iterator[Seed]:
    folder.mkdir()
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) * 10
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [(a, b, c) for a, b, c, d in quads for a, b, c in ((a, b, c), (a, c, d))]
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(f)].ravel(), 0) for f in faces)
    (folder / "b.stl").write_bytes(b"box".ljust(80) + struct.pack("<I", len(faces)) + records)
    vertices = "\n".join(
        "outer loop\n" + "\n".join("vertex {} {} {}".format(*corners[i]) for i in f) + "\nendloop" for f in faces
    )
    (folder / "a.stl").write_text(f"solid box\n{vertices}\nendsolid box\n")
    head = f"element vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face {len(faces)}\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    rows = "\n".join([" ".join(map(str, c)) for c in corners] + ["3 " + " ".join(map(str, f)) for f in faces])
    (folder / "a.ply").write_text(f"ply\nformat ascii 1.0\n{head}{rows}\n")
    body = corners.astype("<f4").tobytes() + b"".join(struct.pack("<B3i", 3, *f) for f in faces)
    (folder / "b.ply").write_bytes(f"ply\nformat binary_little_endian 1.0\n{head}".encode() + body)
    obj = [f"v {x} {y} {z}" for x, y, z in corners] + ["f {} {} {}".format(*(i + 1 for i in f)) for f in faces]
    (folder / "a.obj").write_text("\n".join(obj) + "\n")
    for name in ("b.stl", "a.stl", "a.ply", "b.ply"):
        yield Seed(kind=f"mesh {name}", path=folder / name, read=read_mesh)
    for name in ("b.stl", "b.ply", "a.obj"):
        yield Seed(kind=f"simulated mesh {name}", path=folder / name, read=read_simulated_mesh)


GCS = """*IDN?
(c)2015 Physik Instrumente (PI) GmbH & Co. KG, C-887, 0, 1.2
SPI?
R=0.0
S=0.0
T=10.0
POS?
X=1.0
Y=2.0
Z=-3.0
U=1.5
V=-2.5
W=7.0
POS?
X=-4.0
Y=2.5
Z=3.0
U=-5.0
V=4.5
W=-2.0
"""


def _texts(folder: Path) -> Iterator[Seed]:
    folder.mkdir()
    (folder / "gcs.log").write_text(GCS)
    yield Seed(kind="log of a controller", path=folder / "gcs.log", read=read_gcs_log)
    points = "x_mm,y_mm,z_mm\n" + "\n".join(f"{k}.5,{2 * k},0.25" for k in range(9)) + "\n"
    (folder / "points.csv").write_text(points)
    yield Seed(kind="probed points", path=folder / "points.csv", read=read_probed_points)
    for source, kind, read in (
        (ROOT / "examples/scenes/small.toml", "scene", read_scene),
        (next(iter(sorted((ROOT / "examples").rglob("*plan*.toml"))), None), "plan", read_plan),
    ):
        if source is not None:
            shutil.copy(source, folder / source.name)
            yield Seed(kind=kind, path=folder / source.name, read=read)
