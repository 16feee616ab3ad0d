"""Radiographs from every format: pixels, row order, regions, corrections."""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose import Scanner
from tomopose.errors import ConventionError, InputError
from tomopose.io import RawLayout, open_images, write_hdf5, write_tiff

N, N_V, N_U = 12, 37, 53


@pytest.fixture
def stack() -> np.ndarray:
    """Smooth images [i, v, u] with a different pixel everywhere, no two rows or columns alike."""
    i, v, u = np.meshgrid(np.arange(N), np.arange(N_V), np.arange(N_U), indexing="ij")
    return (20000 + 1000 * i + 20 * v + u).astype(np.uint16)


@pytest.fixture
def folder(tmp_path, stack):
    """A folder of single TIFFs, numbered without leading zeros."""
    for k, image in enumerate(stack):
        write_tiff(tmp_path / "radiographs" / f"pose_{k}.tif", image)
    return tmp_path / "radiographs"


def check(images, stack) -> None:
    assert len(images) == len(stack)
    assert images.shape == (N_V, N_U)
    assert images.dtype == stack.dtype
    for k in range(len(stack)):
        image = images[k]
        assert image.flags.c_contiguous
        assert image.dtype.isnative
        np.testing.assert_array_equal(image, stack[k])
        np.testing.assert_array_equal(images.region(k, 5, 19, 7, 40), stack[k, 5:19, 7:40])


# -- formats -----------------------------------------------------------------------------------------------------------


def test_a_folder_is_read_in_natural_order(folder, stack):
    images = open_images(folder)
    assert images.names == tuple(f"pose_{k}.tif" for k in range(N))  # pose_10 after pose_2
    check(images, stack)
    assert images.warnings == ()


def test_the_first_row_of_a_tiff_is_the_top(folder, stack):
    np.testing.assert_array_equal(tifffile.imread(folder / "pose_3.tif"), stack[3, ::-1])
    np.testing.assert_array_equal(open_images(folder, rows="bottom-first")[3], stack[3, ::-1])


def test_the_row_order_is_the_scanners_if_nothing_else_is_said(folder, stack):
    values = {"d_SD": 1000.0, "d_SR": 200.0, "p_u": 0.2, "p_v": 0.25, "u_0": 20.0, "v_0": 18.0, "n_u": N_U, "n_v": N_V}
    up = Scanner(**values, image_rows="bottom-first")
    np.testing.assert_array_equal(open_images(folder, up)[0], stack[0, ::-1])
    np.testing.assert_array_equal(open_images(folder, up, rows="top-first")[0], stack[0])
    np.testing.assert_array_equal(open_images(folder, Scanner(**values))[0], stack[0])


def test_a_pattern_a_list_and_one_file_are_read(folder, stack):
    check(open_images(str(folder / "pose_*.tif")), stack)
    chosen = open_images([folder / "pose_7.tif", folder / "pose_2.tif"])
    check(chosen, stack[[7, 2]])
    check(open_images(folder / "pose_4.tif"), stack[4:5])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True},
        {"compression": "lzw"},
        {"rowsperstrip": 5},
        {"tile": (16, 32)},
        {"tile": (16, 16), "compression": "zlib"},
        {"rowsperstrip": 7, "compression": "zlib"},
        {"imagej": True},
        {"compression": "packbits"},
        {"compression": "zstd"},
    ],
)
@pytest.mark.parametrize("single", [True, False])
def test_every_lossless_tiff_is_read_alike(tmp_path, stack, options, single):
    if options.get("imagej") and single:
        options = {"software": "a detector"}
    if single:
        for k, image in enumerate(stack[:3]):
            tifffile.imwrite(tmp_path / f"{k}.tif", image[::-1], **options)
        check(open_images(tmp_path), stack[:3])
    else:
        tifffile.imwrite(tmp_path / "stack.tif", stack[:, ::-1], photometric="minisblack", **options)
        images = open_images(tmp_path / "stack.tif")
        assert images.names[:2] == ("stack.tif[0]", "stack.tif[1]")
        check(images, stack)


def test_all_frames_behind_one_header_are_read(tmp_path, stack):
    tifffile.imwrite(tmp_path / "stack.tif", stack[:, ::-1], photometric="minisblack", contiguous=True, truncate=True)
    check(open_images(tmp_path / "stack.tif"), stack)


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint32"])
def test_other_pixel_types_are_kept(tmp_path, stack, dtype):
    typed = stack.astype(dtype)
    for k in range(3):
        write_tiff(tmp_path / f"{k}.tif", typed[k])
    check(open_images(tmp_path), typed[:3])


@pytest.mark.parametrize(("dtype", "header"), [("<u2", 0), (">u2", 0), ("<u2", 4096), ("<f4", 13)])
def test_raw_is_read_as_declared(tmp_path, stack, dtype, header):
    typed = stack.astype(np.dtype(dtype))
    for k in range(3):
        (tmp_path / f"im{k}.raw").write_bytes(b"h" * header + typed[k, ::-1].tobytes())
    images = open_images(tmp_path, raw_layout=RawLayout(shape=(N_V, N_U), dtype=dtype, header=header))
    check(images, typed[:3].astype(np.dtype(dtype).newbyteorder("=")))
    (tmp_path / "all.bin").write_bytes(b"h" * header + typed[:, ::-1].tobytes())
    images = open_images(tmp_path / "all.bin", raw_layout=RawLayout(shape=(N_V, N_U), dtype=dtype, header=header))
    check(images, typed.astype(np.dtype(dtype).newbyteorder("=")))


@pytest.mark.parametrize("rows", ["top-first", "bottom-first"])
def test_hdf5_says_its_row_order(tmp_path, stack, rows):
    assert write_hdf5(tmp_path / "s.h5", stack, rows=rows) == N
    check(open_images(tmp_path / "s.h5"), stack)
    other = "bottom-first" if rows == "top-first" else "top-first"
    with pytest.raises(ConventionError, match=f"its rows are {rows}, rows='{other}' contradicts"):
        open_images(tmp_path / "s.h5", rows=other)


def test_a_named_dataset_is_read(tmp_path, stack):
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["a/first"], file["a/second"] = stack[:, ::-1], stack[:3, ::-1]
    check(open_images(tmp_path / "s.h5", dataset="/a/second"), stack[:3])
    with pytest.raises(InputError, match=r"holds 2 stacks of images \(a/first, a/second\); name one with dataset="):
        open_images(tmp_path / "s.h5")
    with pytest.raises(InputError, match="no dataset 'b'; stacks are: a/first, a/second"):
        open_images(tmp_path / "s.h5", dataset="b")
    with pytest.raises(InputError, match=r"a stack \[frame, row, column\] is needed"):
        open_images(tmp_path / "s.h5", dataset="a")


def nxtomo(path, stack, keys) -> None:
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = stack[:, ::-1]
        detector["image_key"] = keys
        file["entry/data/data"] = h5py.SoftLink("/entry/instrument/detector/data")


def test_nxtomo_gives_its_projections(tmp_path, stack):
    nxtomo(tmp_path / "s.nxs", stack, [0, 0, 3, 0] + [0] * 8)
    images = open_images(tmp_path / "s.nxs")
    assert images.names[2] == "s.nxs[3]"
    check(images, stack[[0, 1, *range(3, 12)]])


def test_nxtomo_brings_its_own_flats_and_darks(tmp_path):
    frames = np.empty((6, N_V, N_U), np.float32)
    dark, flat = np.full((N_V, N_U), 100.0), 1000 + 5 * np.arange(N_V)[:, None] + np.arange(N_U)
    frames[0], frames[1], frames[2], frames[3] = dark - 1, dark + 1, flat - 2, flat + 2
    frames[4:] = dark + 0.25 * (flat - dark)
    nxtomo(tmp_path / "s.nxs", frames, [2, 2, 1, 1, 0, 0])
    images = open_images(tmp_path / "s.nxs")
    assert images.dtype == np.float32
    np.testing.assert_allclose(images[1], 0.25, rtol=1e-6)
    assert images.warnings == ("2 flat and 2 dark frames of the file were used",)


def test_real_dicom_images_are_read(shared_data):
    images = open_images(shared_data / "ball-radiographs-epid")
    assert len(images) == 17
    assert images.shape == (384, 512)
    assert images.dtype == np.uint16
    import pydicom
    from pydicom.uid import ImplicitVRLittleEndian

    data = pydicom.dcmread(shared_data / "ball-radiographs-epid" / "gantry90.dcm", force=True)
    data.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian
    k = images.names.index("gantry90.dcm")
    np.testing.assert_array_equal(images[k], data.pixel_array[::-1])
    np.testing.assert_array_equal(images.region(k, 100, 300, 7, 9), images[k][100:300, 7:9])


def test_the_third_party_radiographs_are_read(shared_data):
    from tomopose.io import pair_images, read_poses, read_scanner

    data = shared_data / "ball-radiographs-gvxr"
    scanner = read_scanner(data / "scanner.json")
    images = open_images(data / "radiographs", scanner)
    assert len(images) == 56
    assert images.shape == (701, 701)
    top_first = tifffile.imread(data / "radiographs" / "pose_0007.tif")
    np.testing.assert_array_equal(images[7], top_first[::-1])
    np.testing.assert_array_equal(images.region(7, 100, 400, 33, 200), top_first[::-1][100:400, 33:200])
    assert pair_images(read_poses(data / "poses.csv"), images).tolist() == list(range(56))


def test_folders_may_have_umlauts_and_blanks(tmp_path, stack):
    place = tmp_path / "Prüf körper [1]"
    write_tiff(place / "größe 1.tif", stack[0])
    write_hdf5(place / "ü.h5", stack[:2])
    check(open_images(place / "ü.h5"), stack[:2])
    (place / "ü.h5").unlink()
    check(open_images(place), stack[:1])


def test_files_without_suffix_are_known_by_their_content(tmp_path, stack):
    write_tiff(tmp_path / "a.tif", stack[0])
    (tmp_path / "a.tif").rename(tmp_path / "a")
    check(open_images([tmp_path / "a"]), stack[:1])


# -- sequences ---------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_region_is_that_part_of_the_image(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "region.tif"
    image = np.random.default_rng(3).integers(0, 99, (N_V, N_U)).astype(np.uint16)
    if not path.exists():
        tifffile.imwrite(path, image[::-1], compression="zlib", rowsperstrip=6)
    v0, v1 = sorted(data.draw(st.tuples(st.integers(0, N_V), st.integers(0, N_V))))
    u0, u1 = sorted(data.draw(st.tuples(st.integers(0, N_U), st.integers(0, N_U))))
    np.testing.assert_array_equal(open_images(path).region(0, v0, v1, u0, u1), image[v0:v1, u0:u1])


def test_regions_outside_the_image_are_refused(folder):
    with pytest.raises(InputError, match=r"region v -1:5, u 0:5 is not inside an image of 53 x 37 pixels"):
        open_images(folder).region(0, -1, 5, 0, 5)


def test_sequences_are_sliced_selected_and_iterated(folder, stack):
    images = open_images(folder)
    check(images[2:9:3], stack[2:9:3])
    check(images.select([5, 1]), stack[[5, 1]])
    check(images.select(np.arange(N) % 2 == 0), stack[::2])
    np.testing.assert_array_equal(np.stack(list(images)), stack)
    np.testing.assert_array_equal(images[-1], stack[-1])
    with pytest.raises(IndexError):
        images[N]


def mean_of(images, k: int) -> float:
    return float(images[k].mean())


@pytest.mark.slow
def test_worker_processes_can_read(folder, tmp_path, stack):
    write_hdf5(tmp_path / "s.h5", stack)
    for images in (open_images(folder), open_images(tmp_path / "s.h5")):
        again = pickle.loads(pickle.dumps(images))
        np.testing.assert_array_equal(again[3], stack[3])
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(mean_of, [images] * 3, range(3)))
    assert found == [float(stack[k].mean()) for k in range(3)]


# -- corrections -------------------------------------------------------------------------------------------------------


def test_dark_and_flat_give_transmission(folder, stack):
    dark = 100.0 + np.arange(N_V)[:, None] + np.zeros(N_U)
    flat = 40000.0 + 10 * np.arange(N_U) + np.zeros((N_V, 1))
    images = open_images(folder, dark=dark, flat=flat)
    assert images.dtype == np.float32
    expected = (stack[4] - dark) / (flat - dark)
    np.testing.assert_allclose(images[4], expected, rtol=3e-7)
    np.testing.assert_allclose(images.region(4, 3, 9, 20, 31), expected[3:9, 20:31], rtol=3e-7)
    assert not images.mask.any()


def test_dark_and_flat_files_are_averaged_and_turned_like_the_images(folder, tmp_path, stack):
    for k in (0, 1):
        write_tiff(tmp_path / "dark" / f"d{k}.tif", (stack[0] // 40 + 2 * k).astype(np.uint16))
        write_tiff(tmp_path / "flat" / f"f{k}.tif", stack[11] + np.uint16(2000 * k))
    images = open_images(folder, dark=tmp_path / "dark", flat=str(tmp_path / "flat" / "*.tif"))
    D, F = stack[0] // 40 + 1.0, stack[11] + 1000.0
    np.testing.assert_allclose(images[2], (stack[2] - D) / (F - D), rtol=3e-7)


def test_pixels_without_flat_signal_are_masked(folder):
    flat, dark = np.full((N_V, N_U), 1000.0), np.zeros((N_V, N_U))
    flat[3, 5], dark[4, 6], flat[7, 8] = 0, 1000, np.nan
    bad = np.zeros((N_V, N_U), bool)
    bad[30, 2] = True
    images = open_images(folder, dark=dark, flat=flat, bad_pixels=bad)
    assert sorted(map(tuple, np.argwhere(images.mask))) == [(3, 5), (4, 6), (7, 8), (30, 2)]
    np.testing.assert_array_equal(np.isnan(images[0]), images.mask)


def test_a_mask_alone_leaves_the_counts(folder, stack):
    bad = np.zeros((N_V, N_U), bool)
    bad[1, 2] = True
    images = open_images(folder, bad_pixels=bad)
    np.testing.assert_array_equal(images[0], stack[0])
    assert images.mask[1, 2]
    with pytest.raises(InputError, match="bool of shape"):
        open_images(folder, bad_pixels=bad.T)


def test_dark_and_flat_exchanged_are_noticed(folder):
    low, high = np.full((N_V, N_U), 100.0), np.full((N_V, N_U), 40000.0)
    with pytest.raises(InputError, match="were dark and flat exchanged"):
        open_images(folder, dark=high, flat=low)


def test_correcting_twice_is_refused(tmp_path):
    write_tiff(tmp_path / "t.tif", np.full((N_V, N_U), 0.97, np.float32))
    with pytest.raises(InputError, match="look flat-corrected already"):
        open_images(tmp_path, flat=np.full((N_V, N_U), 40000.0))


def test_a_flat_of_another_shape_is_refused(folder):
    with pytest.raises(InputError, match=r"the flat image is \(53, 37\)"):
        open_images(folder, flat=np.ones((N_U, N_V)))
