"""Every image that must not be measured, with its message; and pairing of images with poses."""

from __future__ import annotations

import os

import numpy as np
import pytest
import tifffile

from tomopose import PoseSequence, Scanner
from tomopose.errors import FileError, InputError, ShapeError, UnitError
from tomopose.io import RawLayout, open_images, pair_images, write_hdf5, write_tiff
from tomopose.trajectory.pose_grid import pose_grid

SHAPE = (40, 50)


def ramp(shape=SHAPE, dtype=np.uint16) -> np.ndarray:
    v, u = np.indices(shape)
    return (30000 + 10 * v + u).astype(dtype)


@pytest.fixture
def folder(tmp_path):
    for k in range(4):
        write_tiff(tmp_path / "im" / f"pose_{k}.tif", ramp())
    return tmp_path / "im"


def scanner(n_u: int, n_v: int) -> Scanner:
    return Scanner(d_SD=1000.0, d_SR=200.0, p_u=0.2, p_v=0.25, u_0=3.0, v_0=4.0, n_u=n_u, n_v=n_v)


def test_mixed_shapes_name_the_first_offender(folder):
    write_tiff(folder / "pose_2.tif", ramp((40, 51)), force=True)
    with pytest.raises(InputError, match=r"pose_2.tif is 51 x 40 pixels \(columns x rows\), .*pose_0.tif is 50 x 40"):
        open_images(folder)


def test_mixed_types_name_the_first_offender(folder):
    write_tiff(folder / "pose_3.tif", ramp(dtype=np.float32), force=True)
    with pytest.raises(InputError, match=r"pose_3.tif holds float32, .*pose_0.tif uint16"):
        open_images(folder)


@pytest.mark.parametrize("samples", [3, 4, 2])
def test_colour_and_alpha_are_refused(tmp_path, samples):
    image = np.zeros((*SHAPE, samples), np.uint16)
    kind = "rgb" if samples > 2 else "minisblack"
    tifffile.imwrite(tmp_path / "c.tif", image, photometric=kind, planarconfig="contig")
    with pytest.raises(InputError, match=f"has {samples} values a pixel"):
        open_images(tmp_path)


def test_palettes_are_refused(tmp_path):
    tifffile.imwrite(
        tmp_path / "p.tif", np.zeros(SHAPE, np.uint8), photometric="palette", colormap=np.zeros((3, 256), np.uint16)
    )
    with pytest.raises(InputError, match="is a colour image"):
        open_images(tmp_path)


def test_complex_pixels_are_refused(tmp_path):
    tifffile.imwrite(tmp_path / "c.tif", np.zeros(SHAPE, np.complex64), photometric="minisblack")
    with pytest.raises(InputError, match="pixels of type complex64"):
        open_images(tmp_path)


def test_eight_bits_are_read_with_a_note(tmp_path):
    write_tiff(tmp_path / "a.tif", ramp().astype(np.uint8))
    assert "8 bits a pixel" in open_images(tmp_path).warnings[0]


def test_eight_bits_in_sixteen_are_noted(tmp_path):
    write_tiff(tmp_path / "a.tif", (ramp().astype(np.uint8).astype(np.uint16) << 8))
    assert "only 8 of 16 bits" in open_images(tmp_path).warnings[0]


def test_zero_is_white_is_noted(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ramp(), photometric="miniswhite")
    assert "0 is white" in open_images(tmp_path).warnings[0]


def test_lossy_compression_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ramp().astype(np.uint8), compression="jpeg")
    with pytest.raises(InputError, match=r"compressed with JPEG, which may change grey values; .* none, LZW"):
        open_images(tmp_path)


def test_pictures_are_refused(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match="is a JPEG picture"):
        open_images(tmp_path)
    with pytest.raises(InputError, match="is a JPEG picture"):
        open_images(tmp_path / "a.jpg")


def test_an_empty_file_is_named(folder):
    (folder / "pose_1.tif").write_bytes(b"")
    with pytest.raises(FileError, match=r"pose_1.tif is empty \(0 bytes\)") as caught:
        open_images(folder)
    assert caught.value.path == folder / "pose_1.tif"


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.95])
def test_a_truncated_file_is_named(folder, compression, part):
    noise = np.random.default_rng(1).integers(0, 60000, SHAPE).astype(np.uint16)
    for k in range(4):
        tifffile.imwrite(folder / f"pose_{k}.tif", ramp() if k != 2 else noise, compression=compression)
    whole = (folder / "pose_2.tif").read_bytes()
    (folder / "pose_2.tif").write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(FileError, match=r"pose_2.tif .*truncated"):
        open_images(folder)


def test_a_file_that_shrinks_after_opening_is_named(folder):
    images = open_images(folder)
    os.truncate(folder / "pose_3.tif", 900)
    with pytest.raises(FileError, match=r"pose_3.tif is truncated: it ends \d+ bytes too early"):
        images[3]


def test_a_file_that_vanishes_after_opening_is_named(folder):
    images = open_images(folder)
    (folder / "pose_3.tif").unlink()
    with pytest.raises(FileError, match=r"pose_3.tif does not exist"):
        images[3]


def test_damaged_compressed_data_are_named(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ramp(), compression="zlib")
    with tifffile.TiffFile(tmp_path / "a.tif") as tif:
        offset, count = tif.pages[0].dataoffsets[0], tif.pages[0].databytecounts[0]
    raw = bytearray((tmp_path / "a.tif").read_bytes())
    raw[offset : offset + count] = b"\x55" * count
    (tmp_path / "a.tif").write_bytes(bytes(raw))
    with pytest.raises(FileError, match=r"a.tif, page 0 is damaged"):
        open_images(tmp_path)


def test_a_file_that_is_no_tiff_is_named(folder):
    (folder / "pose_1.tif").write_text("this is no image, whatever its name says")
    with pytest.raises(FileError, match=r"pose_1.tif is no readable TIFF"):
        open_images(folder)


def test_missing_and_empty_places_are_named(tmp_path):
    with pytest.raises(FileError, match="nowhere does not exist"):
        open_images(tmp_path / "nowhere")
    with pytest.raises(FileError, match="no file matches"):
        open_images(str(tmp_path / "*.tif"))
    with pytest.raises(FileError, match="list of images is empty"):
        open_images([])
    with pytest.raises(FileError, match=r"holds no images .* there is nothing"):
        open_images(tmp_path)
    (tmp_path / "poses.csv").write_text("")
    with pytest.raises(FileError, match=r"there is poses.csv"):
        open_images(tmp_path)
    with pytest.raises(FileError, match=r"none.tif does not exist"):
        open_images([tmp_path / "none.tif"])
    (tmp_path / "unknown.xyz").write_text("?")
    with pytest.raises(FileError, match=r"unknown.xyz is of no known image format"):
        open_images(tmp_path / "unknown.xyz")


def test_two_formats_in_one_place_are_refused(folder):
    (folder / "x.dcm").write_bytes(b"0" * 200)
    with pytest.raises(InputError, match=r"pose_0.tif is TIFF, .*x.dcm is DICOM"):
        open_images(folder)


def test_one_image_twice_is_refused(folder):
    with pytest.raises(InputError, match="appears more than once"):
        open_images([folder / "pose_0.tif", folder / "pose_0.tif"])


@pytest.mark.parametrize(
    ("n_u", "n_v", "message"),
    [
        (40, 50, "are n_u_px and n_v_px exchanged"),
        (100, 80, "the images are binned by 2"),
        (101, 80, "the images are binned by 2"),
        (25, 20, "the scanner is that of images binned by 2"),
        (70, 60, "is this a read-out window"),
        (30, 200, "does not belong to these images"),
    ],
)
def test_a_shape_that_is_not_the_scanners_is_explained(folder, n_u, n_v, message):
    with pytest.raises(ShapeError, match=rf"50 x 40 pixels \(u x v\), the scanner {n_u} x {n_v}.*{message}"):
        open_images(folder, scanner(n_u, n_v))
    assert len(open_images(folder, scanner(50, 40))) == 4


def test_exchanged_bytes_are_noticed(tmp_path, rng):
    image = rng.normal(30000, 150, SHAPE).astype("<u2")
    (tmp_path / "a.raw").write_bytes(image.tobytes())
    with pytest.raises(InputError, match="bytes of each pixel look exchanged"):
        open_images(tmp_path, raw_layout=RawLayout(shape=SHAPE, dtype=">u2"))
    assert open_images(tmp_path, raw_layout=RawLayout(shape=SHAPE, dtype="<u2")).warnings == ()


@pytest.mark.parametrize("level", [20, 3000, 60000])
def test_images_of_any_level_do_not_look_exchanged(tmp_path, rng, level):
    write_tiff(tmp_path / "a.tif", rng.poisson(level, SHAPE).astype(np.uint16))
    assert open_images(tmp_path).warnings == ()


def test_raw_needs_a_layout_with_endianness_that_fits(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"\0" * (2 * 40 * 50 + 64))
    with pytest.raises(InputError, match="raw_layout=RawLayout"):
        open_images(tmp_path)
    with pytest.raises(UnitError, match="does not say its endianness"):
        RawLayout(shape=SHAPE, dtype="u2")
    with pytest.raises(UnitError, match="does not say its endianness"):
        RawLayout(shape=SHAPE, dtype="uint16")
    with pytest.raises(InputError, match="not positive"):
        RawLayout(shape=(0, 3), dtype="<u2")
    with pytest.raises(FileError, match=r"has 4064 bytes; .* need 4000 \(64 bytes of header would fit\)"):
        open_images(tmp_path, raw_layout=RawLayout(shape=SHAPE, dtype="<u2"))


def test_files_that_are_not_hdf5_or_dicom_are_named(tmp_path):
    (tmp_path / "a.h5").write_text("no HDF5")
    with pytest.raises(FileError, match=r"a.h5 is no readable HDF5 file"):
        open_images(tmp_path / "a.h5")
    (tmp_path / "a.dcm").write_text("no DICOM at all, just a text that is long enough to be taken for one" * 5)
    with pytest.raises(FileError, match=r"a.dcm is no (readable )?DICOM"):
        open_images(tmp_path / "a.dcm")
    (tmp_path / "b.dcm").write_bytes(b"")
    with pytest.raises(FileError, match=r"b.dcm is empty"):
        open_images(tmp_path / "b.dcm")


def test_truncated_dicom_is_named(shared_data, tmp_path):
    whole = (shared_data / "ball-radiographs-epid" / "coll0.dcm").read_bytes()
    (tmp_path / "a.dcm").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=r"a.dcm"):
        open_images(tmp_path / "a.dcm")


def test_writers_refuse_what_is_no_image(tmp_path):
    with pytest.raises(InputError, match=r"\[v, u\]"):
        write_tiff(tmp_path / "a.tif", np.zeros((2, 3, 4)))
    with pytest.raises(InputError, match="image 1 has shape"):
        write_hdf5(tmp_path / "a.h5", [np.zeros((2, 3)), np.zeros((3, 2))])
    with pytest.raises(InputError, match="no images to write"):
        write_hdf5(tmp_path / "a.h5", [])
    assert list(tmp_path.iterdir()) == []


# -- pairing -----------------------------------------------------------------------------------------------------------


def poses(ids=None, image=None) -> PoseSequence:
    ids = ids or [str(k) for k in range(12)]
    grid = pose_grid(2).select(range(len(ids)))
    return PoseSequence(T_MH=grid.T_MH, pose_id=tuple(ids), image=image)


NAMES = [f"pose_{k}.tif" for k in range(12)]
LEXICAL = sorted(NAMES)


def test_images_pair_by_name_in_any_order():
    wanted = tuple(reversed(NAMES[:5]))
    assert pair_images(poses(list("abcde"), image=wanted), NAMES).tolist() == [4, 3, 2, 1, 0]
    with_folder = tuple(f"D:\\data\\{name}" for name in wanted)
    assert pair_images(poses(list("abcde"), image=with_folder), NAMES).tolist() == [4, 3, 2, 1, 0]


def test_images_that_are_not_there_are_listed():
    with pytest.raises(InputError, match=r"1 of 2 images of the pose table are not there: pose_12.tif; there are 12"):
        pair_images(poses(["a", "b"], image=("pose_3.tif", "pose_12.tif")), NAMES)


def test_lexical_order_is_undone():
    assert LEXICAL[2] == "pose_10.tif"
    order = pair_images(poses(), LEXICAL)
    assert [LEXICAL[k] for k in order] == NAMES
    letters = [f"p{k}" for k in range(1, 13)]
    assert [LEXICAL[k] for k in pair_images(poses(letters), LEXICAL)] == NAMES


def test_shuffled_rows_pair_by_number():
    ids = [str(k) for k in (3, 1, 2, 0)]
    assert pair_images(poses(ids), NAMES[:4]).tolist() == [3, 1, 2, 0]


def test_counts_that_disagree_list_what_is_unmatched():
    with pytest.raises(InputError, match=r"12 poses but 10 images; poses without image: 10, 11"):
        pair_images(poses(), NAMES[:10])
    with pytest.raises(InputError, match=r"10 poses but 12 images; images without pose: pose_10.tif, pose_11.tif"):
        pair_images(poses([str(k) for k in range(10)]), NAMES)
    with pytest.raises(InputError, match=r"3 poses but 4 images; counted in order, images without partner: pose_3.tif"):
        pair_images(poses(["a", "b", "c"]), NAMES[:4])


def test_a_gap_in_the_numbering_is_refused_unless_the_ids_have_it_too():
    names = [n for n in NAMES if n != "pose_5.tif"]
    letters = [f"p{k}" for k in range(11)]
    with pytest.raises(InputError, match="numbering leaves out 5, so which pose they belong to is not certain"):
        pair_images(poses(letters), names)
    ids = [str(k) for k in range(12) if k != 5]
    assert pair_images(poses(ids), names).tolist() == list(range(11))


def test_times_in_names_are_no_running_number():
    names = [f"im_2026112210{k:04d}.tif" for k in (3, 10, 17, 4000)]
    assert pair_images(poses(["a", "b", "c", "d"]), names).tolist() == [0, 1, 2, 3]


def test_a_gap_in_a_folder_is_noted(folder):
    (folder / "pose_2.tif").unlink()
    assert "leaves out 1 numbers, the first is 2" in open_images(folder).warnings[0]


def test_rows_out_of_order_that_do_not_number_the_images_are_refused():
    with pytest.raises(InputError, match=r"row 1 is 'c'"):
        pair_images(poses(["c", "a", "b"]), NAMES[:3])


def test_a_sequence_can_be_put_in_pose_order(folder):
    images = open_images(folder)
    table = poses(["a", "b"], image=("pose_3.tif", "pose_1.tif"))
    assert images.select(pair_images(table, images)).names == ("pose_3.tif", "pose_1.tif")
