"""The drawn deviation map: what is in front is seen, in the colour of its deviation, and its files hold it."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from tomopose.errors import ShapeError
from tomopose.report.figures.deviation_picture import (
    NOT_MEASURED,
    deviation_figure,
    drawn,
    neighbours_filled,
    viewpoint,
    vik,
)
from tomopose.report.figures.png import colour_png
from tomopose.report.page import Figure
from tomopose.report.pages.study_page import figure_png
from tomopose.report.style import axis, layout

matplotlib = pytest.importorskip("matplotlib")

SQUARE = np.array([[-5.0, -5.0, 0.0], [5.0, -5.0, 0.0], [5.0, 5.0, 0.0], [-5.0, 5.0, 0.0]])
POINTS = np.concatenate([SQUARE, SQUARE - [0.0, 0.0, 2.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
"""Two squares that face up, one behind the other."""
NORMALS = np.tile([0.0, 0.0, 1.0], (8, 1))
ABOVE = viewpoint(0.0, 90.0)


def picture(values: np.ndarray) -> np.ndarray:
    return drawn(POINTS, FACES, NORMALS, values, range_um=20.0, R=ABOVE, px_per_mm=2.0, size_mm=(16.0, 14.0))


@pytest.mark.slow
def test_the_near_square_hides_the_far_one_and_has_its_colour():
    values = np.array([10.0] * 4 + [-20.0] * 4)
    found = picture(values)
    assert found.shape == (28, 32, 3)
    assert (found[0] == 255).all()
    shade = found[14, 16] / vik(np.array(0.75)).astype(float)
    np.testing.assert_allclose(shade, shade[0], atol=0.02)
    assert 0.5 < shade[0] <= 1.0
    np.testing.assert_array_equal(found, picture(values))


def test_a_viewpoint_is_a_rotation_with_z_up():
    R = viewpoint(-60.0, 20.0)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[0, 2] == pytest.approx(0.0)
    assert R[1, 2] > 0


@pytest.mark.slow
def test_what_was_not_measured_is_grey_unless_a_neighbour_was():
    grey = picture(np.full(8, np.nan))[14, 16].astype(float)
    np.testing.assert_allclose(grey / grey[0], np.array(NOT_MEASURED) / NOT_MEASURED[0], atol=0.02)
    values = np.array([4.0, np.nan, 8.0, 4.0] + [np.nan] * 4)
    filled = neighbours_filled(values, FACES)
    assert filled[1] == pytest.approx(6.0)
    assert np.isnan(filled[4:]).all()


def test_values_must_fit_the_mesh():
    with pytest.raises(ShapeError, match="8 points"):
        picture(np.zeros(7))


def test_colours_survive_the_file(tmp_path):
    from matplotlib import image

    rows = np.random.default_rng(3).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    path = tmp_path / "x.png"
    path.write_bytes(colour_png(rows))
    np.testing.assert_array_equal(np.round(255 * image.imread(path)[..., :3]).astype(int), rows)
    with pytest.raises(ShapeError, match="colour picture"):
        colour_png(rows[..., 0])


def test_the_figure_holds_a_picture_a_panel_and_is_drawn(tmp_path):
    from matplotlib import image

    figure = deviation_figure(
        {"one": np.full(8, -20.0), "two": np.full(8, 20.0)},
        POINTS,
        FACES,
        NORMALS,
        range_um=20.0,
        title="t",
        meaning="m",
        look_for="l",
        elevation_deg=90.0,
    )
    assert len(figure.layout["images"]) == 2
    assert base64.b64decode(figure.layout["images"][0]["source"].split(",")[1]).startswith(b"\x89PNG")
    figure_png(tmp_path / "map.png", figure)
    found = image.imread(tmp_path / "map.png")[..., :3]
    blue, red = found[..., 2] - found[..., 0] > 0.2, found[..., 0] - found[..., 2] > 0.2
    columns = np.arange(found.shape[1])
    left = found.shape[1] // 3  # the colour bar on the right has both colours
    assert blue[:, :left].any()
    assert not red[:, :left].any()
    middle = (columns > left) & (columns < 0.75 * found.shape[1])
    assert red[:, middle].any()


def test_a_heatmap_takes_its_own_colours_and_leaves_holes(tmp_path):
    from matplotlib import image

    trace = {
        "type": "heatmap",
        "x": [0, 1, 2],
        "y": [0, 1],
        "z": [[0, 0, 0], [0, None, 0]],
        "zmin": -1,
        "zmax": 0,
        "colorscale": [[0.0, "#000000"], [1.0, "rgb(200,0,0)"]],
        "showscale": False,
    }
    figure_png(
        tmp_path / "x.png",
        Figure(title="", meaning="", look_for="", data=[trace], layout=layout(xaxis=axis(), yaxis=axis())),
    )
    found = np.round(255 * image.imread(tmp_path / "x.png")[..., :3]).astype(int).reshape(-1, 3)
    assert ((found == [200, 0, 0]).all(axis=1)).mean() > 0.3
    assert ((found == [255, 255, 255]).all(axis=1)).mean() > 0.15
