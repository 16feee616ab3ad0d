"""What image files say about themselves is used, compared or named: Orientation, copies, pitch, time."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tifffile

import tomopose as tp
from tomopose.errors import ConventionError, InputError, InputWarning
from tomopose.io.images.formats.tiff import date_time

PICTURE = np.arange(35, dtype=np.uint16).reshape(5, 7)
STORED = {
    1: PICTURE,
    2: PICTURE[:, ::-1],
    3: PICTURE[::-1, ::-1],
    4: PICTURE[::-1],
    5: PICTURE.T,
    6: np.rot90(PICTURE),
    7: PICTURE[::-1, ::-1].T,
    8: np.rot90(PICTURE, -1),
}
"""How a picture is stored so that each Orientation shows it upright (TIFF 6.0)."""


def save(path, pixels, orientation, **more):
    tag = [(274, "H", 1, orientation, True)] if orientation else []
    tifffile.imwrite(path, np.ascontiguousarray(pixels), photometric="minisblack", metadata=None, extratags=tag, **more)
    return path


@pytest.mark.parametrize("orientation", list(STORED))
@pytest.mark.parametrize("compression", [None, "deflate"])
def test_every_orientation_shows_the_same_picture(orientation, compression, tmp_path):
    images = tp.open_images(save(tmp_path / "a.tif", STORED[orientation], orientation, compression=compression))
    assert images.shape == (5, 7)
    np.testing.assert_array_equal(images[0], PICTURE[::-1])
    np.testing.assert_array_equal(images.region(0, 1, 4, 2, 6), PICTURE[::-1][1:4, 2:6])
    said = [w for w in images.warnings if "Orientation" in w]
    assert len(said) == (orientation != 1)


def test_images_that_lie_differently_are_refused(tmp_path):
    save(tmp_path / "a.tif", STORED[1], 1)
    save(tmp_path / "b.tif", STORED[3], 3)
    with pytest.raises(InputError, match=r"b\.tif has the Orientation 3, .*a\.tif 1"):
        tp.open_images(tmp_path)
    with pytest.raises(InputError, match="the Orientation is 9; TIFF knows 1 to 8"):
        tp.open_images(save(tmp_path / "c.tif", PICTURE, 9))


def test_rows_said_to_be_bottom_first_are_not_turned_twice(tmp_path):
    image = tp.open_images(save(tmp_path / "a.tif", STORED[4], 4), rows="bottom-first")[0]
    np.testing.assert_array_equal(image, PICTURE[::-1])
    with pytest.raises(ConventionError, match="says that the first stored row is the top, but the rows are said to be"):
        tp.open_images(save(tmp_path / "b.tif", STORED[2], 2), rows="bottom-first")


def test_smaller_copies_of_a_page_are_passed_over_and_said(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as tif:
        tif.write(PICTURE, photometric="minisblack", metadata=None)
        tif.write(PICTURE[::2, ::2].astype(np.uint8), photometric="minisblack", metadata=None, subfiletype=1)
        tif.write(PICTURE + 1, photometric="minisblack", metadata=None)
    images = tp.open_images(tmp_path / "a.tif")
    assert images.names == ("a.tif[0]", "a.tif[1]")
    np.testing.assert_array_equal(images[1], PICTURE[::-1] + 1)
    assert any("NewSubfileType" in w for w in images.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["orient1.tif", "orient2.tif", "orient3.tif", "orient4.tif", "thumbnail16.tif"])
def test_a_ball_is_found_in_one_place_however_its_image_is_stored(name, shared_data):
    folder = shared_data / "cases" / "tiff-orientation"
    expected = json.loads((folder / "expected.json").read_text())
    scanner = tp.read_scanner(folder / "scanner.json")
    found = tp.detect(tp.open_images(folder / name, scanner), scanner, ball_diameter=expected["ball_diameter_mm"])
    np.testing.assert_allclose(found.x_D[0], [expected["u_px"], expected["v_px"]], atol=expected["tolerance_px"])


def test_a_header_that_contradicts_the_scanner_is_a_warning_with_both_numbers(shared_data):
    folder = shared_data / "cases" / "tiff-orientation"
    scanner = tp.read_scanner(folder / "scanner.json")
    with pytest.warns(InputWarning, match=r"ImagerPixelSpacing = 0\.336 mm, but the scanner's p_v_mm is 0\.2"):
        tp.open_images(folder / "pitch.dcm", scanner)


def test_the_time_of_an_image_is_that_of_its_tag(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, PICTURE, photometric="minisblack", metadata=None, datetime="2026:03:03 10:20:30")
    assert date_time(path) == "2026-03-03 10:20:30"
    assert date_time(save(tmp_path / "b.tif", PICTURE, 0)) is None
