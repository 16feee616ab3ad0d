"""Scanner files as makers write them: values, what is not stated, which reading was taken, and how to proceed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import tomopose as tp
from tomopose.errors import FileError, InputError, InputWarning, UnitError


@pytest.fixture
def write(tmp_path):
    def write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def vendor(shared_data):
    return shared_data / "cases" / "vendor-geometry"


@pytest.mark.parametrize("name", ["part.xtekct", "part.pca", "part_.log", "unireconstruction.xml", "scan.txt"])
def test_each_file_gives_what_it_states(name, vendor):
    expected = json.loads((vendor / "expected.json").read_text())["scanner"][name]
    draft = tp.read_scanner_draft(vendor / name)
    assert dict(draft.values) == pytest.approx(expected)
    assert set(draft.missing) == {"p_u_mm", "p_v_mm", "n_u_px", "n_v_px"} - set(expected)


def test_a_whole_draft_is_a_scanner_with_its_piercing_point_assumed(vendor, tmp_path):
    draft = tp.read_scanner_draft(vendor / "part.xtekct")
    assert draft.assumed == ("u_0_px", "v_0_px")
    (tmp_path / "scanner.json").write_text(json.dumps({"schema": "tomopose/scanner/1", **draft.document()}))
    scanner = tp.read_scanner(tmp_path / "scanner.json")
    assert (scanner.u_0, scanner.v_0) == (999.5, 949.5)
    assert dict(scanner.sigma) == {}


def test_a_draft_with_missing_values_is_refused_by_name(vendor, tmp_path):
    draft = tp.read_scanner_draft(vendor / "unireconstruction.xml")
    (tmp_path / "scanner.json").write_text(json.dumps({"schema": "tomopose/scanner/1", **draft.document()}))
    with pytest.raises(InputError, match=r"p_u_mm, p_v_mm, u_0_px, v_0_px, n_u_px, n_v_px missing"):
        tp.read_scanner(tmp_path / "scanner.json")


def test_the_image_size_of_an_rx_scan_is_that_of_its_projections(vendor, tmp_path):
    shutil.copy(vendor / "unireconstruction.xml", tmp_path)
    (tmp_path / "Proj").mkdir()
    tp.write_tiff(tmp_path / "Proj" / "p_0001.tif", np.ones((7, 11), np.uint16))
    draft = tp.read_scanner_draft(tmp_path / "unireconstruction.xml")
    assert (draft.values["n_u_px"], draft.values["n_v_px"]) == (11, 7)


# -- Nikon ---------------------------------------------------------------------------------------------------------


def test_nikon_angles_are_those_of_the_list_beside_the_file(vendor, tmp_path):
    shutil.copy(vendor / "part.xtekct", tmp_path)
    even = tp.read_scanner_draft(tmp_path / "part.xtekct").angles_deg
    assert len(even) == 1571
    np.testing.assert_allclose(even[:2], [12.5, 12.7291534])
    angles = 12.5 + 0.2291534 * np.arange(1571)
    angles[800:] += 0.5
    lines = [f"{k + 1}\t{a:.4f}\t{k * 0.5:.3f}" for k, a in enumerate(angles)]
    (tmp_path / "part_ctdata.txt").write_text("Projs\tAngle\tTime\n1571\nx\n" + "\n".join(lines))
    draft = tp.read_scanner_draft(tmp_path / "part.xtekct")
    np.testing.assert_allclose(draft.angles_deg, angles, atol=1e-4)
    assert "its steps leave the even ones by up to 0.5 deg" in draft.notes[0]
    (tmp_path / "part.ang").write_text("Proj:\n" + "\n".join(f"{k + 1}: {a:.4f}" for k, a in enumerate(angles[:1000])))
    assert "lists 1000 angles, the .xtekct announces 1571" in tp.read_scanner_draft(tmp_path / "part.xtekct").notes[0]


def test_an_ambiguous_shift_of_the_panel_is_read_and_said(vendor, write):
    text = (vendor / "part.xtekct").read_text().replace("DetectorOffsetX=0", "DetectorOffsetX=1.2")
    draft = tp.read_scanner_draft(write("part.xtekct", text))
    assert draft.values["u_0_px"] == pytest.approx(999.5 - 6)
    assert any("the opposite sign would give 1005.5" in r for r in draft.readings)


def test_exchanged_distances_are_refused(vendor, write):
    text = (vendor / "part.xtekct").read_text().replace("SrcToObject=733.92", "SrcToObject=1733.92")
    with pytest.raises(InputError, match="lies behind the detector"):
        tp.read_scanner_draft(write("part.xtekct", text))


# -- other makers --------------------------------------------------------------------------------------------------

SKYSCAN = """[System]
Scanner=SkyScan2211
Source Type=Xray-Worx
Camera=FlatPanel Sensor
Camera Pixel Size (um)=74.800
[Acquisition]
Number of Files=  601
Number of Rows= 1536
Number of Columns= 3776
Image Pixel Size (um)=   {image}
Object to Source (mm)=151.006
Camera to Source (mm)=282.376
Camera binning={binning}
Rotation Step (deg)=0.600
"""


def test_the_image_pixel_shows_whether_a_skyscan_camera_pixel_is_the_binned_one(write):
    plain = tp.read_scanner_draft(write("a.log", SKYSCAN.format(image=40.0, binning="1x1")))
    assert plain.values["p_u_mm"] == pytest.approx(0.0748)
    assert plain.notes == ()
    binned = tp.read_scanner_draft(write("b.log", SKYSCAN.format(image=80.0, binning="2x2")))
    assert binned.values["p_u_mm"] == pytest.approx(0.1496)
    assert any("149.6 um is taken" in r for r in binned.readings)
    odd = tp.read_scanner_draft(write("c.log", SKYSCAN.format(image=43.0, binning="1x1")))
    assert "the file contradicts itself" in odd.notes[0]


def test_a_skyscan_log_without_the_camera_pixel_takes_it_from_the_image(write):
    lines = SKYSCAN.format(image=40.0, binning="1x1").splitlines(True)
    text = "".join(line for line in lines if "Camera Pixel" not in line)
    assert tp.read_scanner_draft(write("a.log", text)).values["p_u_mm"] == pytest.approx(0.0748, rel=1e-4)


def test_phoenix_values_that_contradict_each_other_are_named(vendor, write):
    text = (vendor / "part.pca").read_text().replace("VoxelSizeX=0.125079035", "VoxelSizeX=0.25")
    draft = tp.read_scanner_draft(write("part.pca", text.replace("Left=0", "Left=24")))
    assert "VoxelSizeX is 0.25, but pixel size, FDD and FOD give 0.125079" in draft.notes[0]
    assert any("a window of the panel (Left 24, Top 0)" in r for r in draft.readings)


def test_north_star_projects(write):
    text = """<North Star Imaging DR-Program 1.0>
<step>
<CT Project Configuration>
<Technique Configuration>
<Setup>
<source to detector distance>853.5
<source to table distance>155.25
</Setup>
<Detector>
<width pixels>1920
<height pixels>1536
<pixel width microns>127.0
<pixel height microns>127.0
<rotation description>0 degrees
</Detector>
</Technique Configuration>
"""
    draft = tp.read_scanner_draft(write("part.nsipro", text))
    assert dict(draft.values) == {
        "d_SD_mm": 853.5, "d_SR_mm": 155.25, "p_u_mm": 0.127, "p_v_mm": 0.127, "n_u_px": 1920, "n_v_px": 1536,
    }  # fmt: skip
    turned = tp.read_scanner_draft(write("b.nsipro", text.replace("0 degrees", "90 degrees")))
    assert "images are turned" in turned.readings[-1]


def test_yxlon_lengths_in_pixels_are_multiplied_and_flips_are_named(write):
    text = """<?xml version="1.0" encoding="utf-8"?>
<ScanParameter xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
 <ConeBeamScanParameter>
  <DetectorOrientation>Original</DetectorOrientation>
  <DetectorFlipDirections>Horizontal</DetectorFlipDirections>
  <PixelSize><Width>0.139</Width><Height>0.139</Height></PixelSize>
  <ProjectionSize><Width>3008</Width><Height>2512</Height></ProjectionSize>
  <ScanTrajectory xsi:type="CircleTrajectory"><PixelPitch>0.139</PixelPitch>
   <Fdd>7000</Fdd><Fod>2000.5</Fod></ScanTrajectory>
  <DejustmentParameter><HorizontalDetectorOffset>2.5</HorizontalDetectorOffset>
   <VerticalDetectorOffset>0</VerticalDetectorOffset><DetectorTiltA>0.1</DetectorTiltA></DejustmentParameter>
 </ConeBeamScanParameter>
</ScanParameter>"""
    draft = tp.read_scanner_draft(write("ScanParameter.xml", text))
    assert draft.values["d_SD_mm"] == pytest.approx(973.0)
    assert draft.values["d_SR_mm"] == pytest.approx(278.0695)
    assert "DetectorFlipDirections is Horizontal" in draft.notes[0]
    assert any("DetectorTiltA = 0.1 deg" in r for r in draft.readings)
    table = "1024\tNumber of Detector Elements \n0.2\t2D-Pixel Size [mm]\n2\tPixelbinning\n300\tFOD [mm]\n"
    table += "1200\tFDD [mm]\n"
    assert tp.read_scanner_draft(write("scan.txt", table)).values["p_u_mm"] == pytest.approx(0.4)


def test_diondo_scans(write):
    text = """<Scan><ScanParameter><HelixMode>true</HelixMode><Laminography>false</Laminography></ScanParameter>
<Recon><ProjectionDimX>3000</ProjectionDimX><ProjectionDimY>2900</ProjectionDimY><ProjectionPixelSizeX>0.139</ProjectionPixelSizeX>
<ProjectionPixelSizeY>0.139</ProjectionPixelSizeY><ProjectionCenterOffsetX>0.3</ProjectionCenterOffsetX></Recon>
<Geometrie><SourceDetectorDist>1100</SourceDetectorDist><SourceObjectDist>250</SourceObjectDist></Geometrie></Scan>"""
    draft = tp.read_scanner_draft(write("scan.xml", text))
    assert (draft.values["d_SD_mm"], draft.values["n_v_px"]) == (1100, 2900)
    assert "HelixMode is true" in draft.notes[0]


def test_own_notes_need_their_units(write):
    with pytest.raises(UnitError, match="'SDD' states no unit; write SDD_mm"):
        tp.read_scanner_draft(write("a.txt", "SDD = 1000\nSOD_mm = 500\nrows = 100\ncolumns = 200\n"))
    text = "fdd_mm: 1000\nfod_mm: 500\nrows: 100\ncolumns: 200\npixel_size_mm: 0.1\nlamp: on\n"
    draft = tp.read_scanner_draft(write("b.txt", text))
    assert draft.missing == ()
    assert "one pitch is stated; square pixels are taken" in draft.readings
    assert draft.unused == ("lamp = on",)


def test_a_robot_scanner_and_a_scenario_give_their_panel(vendor, tmp_path):
    draft = tp.read_scanner_draft(vendor / "view.json")
    assert draft.values["d_SD_mm"] == pytest.approx(948.3317, abs=1e-3)
    assert draft.missing == ("d_SR_mm",)
    scenario = pytest.importorskip("ctsimu").__path__[0]
    file = sorted(Path(scenario).glob("evaluation/scenarios/2D-WE-2*.json"))[0]
    draft = tp.read_scanner_draft(file)
    assert draft.values["d_SD_mm"] == pytest.approx(1000.0)
    assert draft.values["n_u_px"] == 1001


# -- NXtomo and DICOM ----------------------------------------------------------------------------------------------


@pytest.fixture
def nexus(tmp_path):
    """An NXtomo file: three projections between a dark and a flat frame, as nxtomo lays it out."""
    path = tmp_path / "scan.nxs"
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry0000")
        detector = entry.create_group("instrument/detector")
        detector["data"] = np.arange(5 * 6 * 8, dtype=np.uint16).reshape(5, 6, 8)
        detector["image_key"] = [2, 0, 0, 0, 1]
        for name, value in (("x_pixel_size", 0.2e-3), ("y_pixel_size", 0.25e-3), ("distance", 0.9)):
            detector[name] = value
            detector[name].attrs["units"] = "m"
        entry["instrument/source/distance"] = -300.0
        entry["instrument/source/distance"].attrs["units"] = "mm"
        entry["sample/rotation_angle"] = [0.0, 0.0, 90.0, 180.0, 180.0]
        entry["sample/rotation_angle"].attrs["units"] = "degree"
        entry["sample/x_translation"] = [0, 1e-3, 2e-3, 3e-3, 0]
        entry["sample/x_translation"].attrs["units"] = "m"
    return path


def test_nxtomo_gives_scanner_and_poses_with_their_units(nexus):
    draft = tp.read_scanner_draft(nexus)
    assert dict(draft.values) == pytest.approx(
        {"d_SD_mm": 1200, "d_SR_mm": 300, "p_u_mm": 0.2, "p_v_mm": 0.25, "n_u_px": 8, "n_v_px": 6}
    )
    assert draft.angles_deg == (0.0, 90.0, 180.0)
    poses = tp.read_pose_log(nexus).poses()
    np.testing.assert_allclose(poses.T_MH.t, [[1, 0, 0], [2, 0, 0], [3, 0, 0]])
    np.testing.assert_allclose(poses.alpha, [0, np.pi / 2, np.pi])
    assert poses.image == ("scan.nxs[1]", "scan.nxs[2]", "scan.nxs[3]")
    images = tp.open_images(nexus)
    assert tp.pair_images(poses, images).tolist() == [0, 1, 2]


def test_table_angles_that_the_pose_table_contradicts_are_a_warning(nexus):
    poses, images = tp.read_pose_log(nexus).poses(), tp.open_images(nexus)
    tp.pair_images(replace(poses, alpha=0.3 - poses.alpha), images)  # another zero and sense: the same turns
    with pytest.warns(
        InputWarning, match=r"turned by 180 deg from the first image to scan\.nxs\[3\], the pose table 0 deg"
    ):
        tp.pair_images(replace(poses, alpha=np.zeros(3)), images)


def test_a_length_without_unit_is_named_and_not_used(nexus):
    with h5py.File(nexus, "a") as file:
        del file["entry0000/instrument/detector/x_pixel_size"].attrs["units"]
    draft = tp.read_scanner_draft(nexus)
    assert draft.missing == ("p_u_mm",)
    assert "instrument/detector/x_pixel_size (no unit)" in draft.notes[0]


def test_dicom_spacing_and_distances(shared_data):
    draft = tp.read_scanner_draft(shared_data / "cases" / "tiff-orientation" / "pitch.dcm")
    assert draft.values["p_u_mm"] == pytest.approx(0.336)
    assert draft.values["n_u_px"] == 130


# -- Zeiss ---------------------------------------------------------------------------------------------------------


def test_a_zeiss_container_without_its_reader_says_what_to_install(tmp_path, monkeypatch):
    from tomopose.errors import EngineMissingError

    (tmp_path / "a.txrm").write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600))
    monkeypatch.setitem(__import__("sys").modules, "olefile", None)
    with pytest.raises(EngineMissingError, match="olefile"):
        tp.read_scanner_draft(tmp_path / "a.txrm")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("vol.vgi", "{volume1}\n", "VGSTUDIO volume description"),
        ("run.src", "&ACCESS RVP\nDEF A()\nLIN {X 1, Y 2, Z 3, A 4, B 5, C 6}\nEND\n", "its poses: tomopose import"),
        ("geom.csv", "geom;;\nindex;src_x;src_y;src_z;det_x\n", "its geometry: tomopose import-geometry geom.csv"),
        ("notes.txt", "measured on Tuesday\n", "write what you know as lines"),
    ],
)
def test_files_of_other_kinds_are_answered_with_how_to_proceed(name, content, says, write):
    with pytest.raises(FileError, match=says):
        tp.read_scanner_draft(write(name, content))
