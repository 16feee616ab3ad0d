"""Radiographs in the makers' own containers: Zeiss .xrm and .txrm, Varian .xim, held against other readers."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from ole_container import write_txrm

import tomopose as tp
from tomopose.errors import EngineMissingError, FileError, InputWarning
from tomopose.io.foreign.reading import read_scanner_draft

SCANNER = tp.Scanner(d_SD=90.0, d_SR=30.0, p_u=0.006, p_v=0.006, u_0=30.0, v_0=20.0, n_u=61, n_v=43)
VERSA = {
    "ImageInfo__StoRADistance": np.full(130, -30.0),
    "ImageInfo__DtoRADistance": np.full(130, 60.0),
    "ImageInfo__PixelSize": 2.0,
    "DetAssemblyInfo__CamPixelSize": 13.5,
    "DetAssemblyInfo__OpticalMagnification": 4.0,
    "ImageInfo__Angles": np.arange(130) * 1.5,
}


@pytest.fixture
def images(rng):
    return rng.integers(200, 60000, (130, 43, 61)).astype(np.uint16)


def test_a_txrm_is_a_stack(tmp_path, images):
    pytest.importorskip("olefile")
    write_txrm(tmp_path / "scan.txrm", images, **VERSA)
    stack = tp.open_images(tmp_path / "scan.txrm", SCANNER)
    assert (len(stack), stack.shape, stack.dtype) == (130, (43, 61), np.uint16)
    for k in (0, 99, 100, 129):
        np.testing.assert_array_equal(stack[k], images[k][::-1])
    np.testing.assert_array_equal(stack.region(101, 3, 9, 5, 12), images[101][::-1][3:9, 5:12])
    assert stack.source.angles_deg[2] == 3.0
    draft = read_scanner_draft(tmp_path / "scan.txrm")
    assert draft.values == pytest.approx(
        {"d_SD_mm": 90, "d_SR_mm": 30, "p_u_mm": 0.006, "p_v_mm": 0.006, "n_u_px": 61, "n_v_px": 43}
    )
    assert any("13.5 um behind an optical magnification of 4" in note for note in draft.notes)


def test_another_package_reads_the_same_txrm(tmp_path, images):
    """The container and its streams, by olefile and the layout of txrm2tiff: 100 images a folder, counted from 1."""
    olefile = pytest.importorskip("olefile")
    write_txrm(tmp_path / "scan.txrm", images, **VERSA)
    with olefile.OleFileIO(str(tmp_path / "scan.txrm")) as ole:
        assert ole.exists("ImageData2/Image101")
        read = np.frombuffer(ole.openstream("ImageData2/Image101").read(), np.uint16).reshape(43, 61)
    np.testing.assert_array_equal(read, images[100])


def test_the_reference_image_of_a_txrm_is_its_flat(tmp_path, rng):
    pytest.importorskip("olefile")
    flat = rng.uniform(30000, 40000, (43, 61)).astype(np.float32)
    images = (flat * np.linspace(0.4, 0.9, 3)[:, None, None]).astype(np.float32)
    reference = {"ReferenceData__DataType": 10, "ReferenceData__Image": flat.reshape(-1)}
    write_txrm(tmp_path / "scan.txrm", images, **reference)
    stack = tp.open_images(tmp_path / "scan.txrm")
    assert any("1 flat" in note for note in stack.warnings)
    np.testing.assert_allclose(stack[1], 0.65, rtol=1e-6)


def test_an_xradia_file_is_held_against_the_scanner(tmp_path, images):
    pytest.importorskip("olefile")
    write_txrm(tmp_path / "one.xrm", images[:1], **{k: np.asarray(v).reshape(-1)[:1] for k, v in VERSA.items()})
    other = tp.Scanner(d_SD=90.0, d_SR=30.0, p_u=0.2, p_v=0.2, u_0=30.0, v_0=20.0, n_u=61, n_v=43)
    with pytest.warns(InputWarning, match=r"0\.006 mm, but the scanner's p_u_mm is 0\.2"):
        tp.open_images(tmp_path / "one.xrm", other)


def test_damaged_xradia_files_are_refused(tmp_path, images, monkeypatch):
    pytest.importorskip("olefile")
    path = tmp_path / "scan.txrm"
    write_txrm(path, images[:4], ImageInfo__NoOfImages=9)
    with pytest.raises(FileError, match="states 9 images and lacks ImageData1/Image5"):
        tp.open_images(path)
    write_txrm(path, images[:4], ImageInfo__DataType=10)
    with pytest.raises(FileError, match=r"Image1 has 5246 bytes, which is no image of 61 x 43"):
        tp.open_images(path)
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(FileError, match=r"scan\.txrm"):
        tp.open_images(path)
    monkeypatch.setitem(__import__("sys").modules, "olefile", None)
    with pytest.raises(EngineMissingError, match="olefile"):
        tp.open_images(path)


def write_xim(path, image, *, compressed=True, width_cm=0.0392):
    """By Varian's description, one pixel after the other."""
    rows, columns = image.shape
    out = struct.pack("<8s6i", b"VMS.XI", 1, columns, rows, 32, 4, int(compressed))
    if compressed:
        R = image.reshape(-1).astype(int).tolist()
        flags, packed = [], struct.pack(f"<{columns + 1}i", *R[: columns + 1])
        for k in range(columns + 1, len(R)):
            d = R[k] - R[k - 1] - R[k - columns] + R[k - columns - 1]
            flag, code = next(
                (f, c) for f, c, top in ((0, "b", 127), (1, "h", 32767), (2, "i", 2**31 - 1)) if abs(d) <= top
            )
            flags.append(flag)
            packed += struct.pack("<" + code, d)
        flags += [0] * (-len(flags) % 4)
        table = bytes(sum(flags[k + j] << (2 * j) for j in range(4)) for k in range(0, len(flags), 4))
        out += struct.pack("<i", len(table)) + table + struct.pack("<i", len(packed)) + packed
        out += struct.pack("<i", 4 * len(R))
    else:
        out += struct.pack("<i", 4 * image.size) + image.astype("<i4").tobytes()
    out += struct.pack("<2i", 1, 7)  # a histogram of one bin
    out += struct.pack("<i", 4)
    pitch = struct.pack("<d", width_cm)
    properties = {
        "Bits": (0, struct.pack("<i", 14)),
        "Text": (2, struct.pack("<i", 3) + b"abc"),
        "PixelWidth": (1, pitch),
        "PixelHeight": (1, pitch),
    }
    for name, (kind, value) in properties.items():
        out += struct.pack("<i", len(name)) + name.encode() + struct.pack("<i", kind) + value
    path.write_bytes(out)


@pytest.fixture
def portal(rng):
    """Differences of one, two and four bytes, and a last row that ends inside a byte of the table."""
    image = rng.integers(900, 1000, (43, 61))
    image[5:9, 7:30] += 20000
    image[20, 20] += 3_000_000
    return image.astype(np.int32)


@pytest.mark.parametrize("compressed", [True, False])
def test_a_xim_holds_the_stored_counts(tmp_path, portal, compressed):
    write_xim(tmp_path / "a.xim", portal, compressed=compressed)
    stack = tp.open_images(tmp_path / "a.xim")
    np.testing.assert_array_equal(stack[0], portal[::-1])
    assert stack.source.stated.values == pytest.approx({"p_u_mm": 0.392, "p_v_mm": 0.392})


def test_damaged_xim_files_are_refused(tmp_path, portal):
    path = tmp_path / "a.xim"
    write_xim(path, portal)
    good = path.read_bytes()
    path.write_bytes(good[:1200])
    with pytest.raises(FileError, match=r"a\.xim is truncated"):
        tp.open_images(path)
    path.write_bytes(good[:12] + struct.pack("<ii", 90000, 90000) + good[20:])
    with pytest.raises(FileError, match="90000 x 90000 pixels do not fit"):
        tp.open_images(path)
    path.write_bytes(good[:36] + b"\xff" * 20 + good[56:])
    with pytest.raises(FileError, match="table of sizes does not fit"):
        tp.open_images(path)
    path.write_bytes(b"no image")
    with pytest.raises(FileError, match="does not begin with VMS"):
        tp.open_images(path)
