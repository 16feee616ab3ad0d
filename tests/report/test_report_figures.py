"""What the figures draw is what the numbers say."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from matplotlib import image

from tomopose import BallObservations, PoseSequence
from tomopose.errors import ShapeError
from tomopose.report.figures.coverage_figures import correlation
from tomopose.report.figures.png import grey_levels, grey_png
from tomopose.report.figures.residual_figures import by_pose, quantiles, quiver, rotation_table
from tomopose.report.figures.scene_figures import ball_in_world, panel_corners
from tomopose.report.figures.thumbnails import Thumbnail, ellipse_outline, thumbnail, thumbnail_svg, worst_thumbnails
from tomopose.report.gather import join, minutes, rotation_groups
from tomopose.report.words import cell, decimals, heading, meaning, number, small_unit, symbol


def decode_png(png: bytes) -> np.ndarray:
    """Another library's reading of an 8-bit grey PNG."""
    return np.round(255 * image.imread(io.BytesIO(png))).astype(np.uint8)


def test_png_holds_the_grey_values_row_by_row(rng):
    rows = rng.integers(0, 256, size=(7, 13), dtype=np.uint8)
    np.testing.assert_array_equal(decode_png(grey_png(rows)), rows)
    smooth = np.add.outer(np.arange(256), np.arange(256)).astype(np.uint8)
    np.testing.assert_array_equal(decode_png(grey_png(smooth)), smooth)
    assert len(grey_png(smooth)) < 0.1 * smooth.size
    with pytest.raises(ShapeError):
        grey_png(rows.astype(np.float64))


def test_grey_levels_span_the_image_and_survive_bad_pixels():
    image = np.linspace(0.0, 1000.0, 1001).reshape(77, 13)
    image[3, 3] = np.nan
    grey = grey_levels(image)
    assert grey.min() == 0
    assert grey.max() == 255
    assert grey[3, 3] == 0
    assert not grey_levels(np.full((3, 4), np.nan)).any()
    assert grey_levels(np.full((3, 4), 7.0)).shape == (3, 4)


def test_thumbnail_has_row_zero_at_the_bottom_and_the_outline_on_the_rim():
    n_v, n_u, centre, radius = 121, 151, (70.25, 41.5), 20.0
    v, u = np.mgrid[0:n_v, 0:n_u]
    image = np.where(np.hypot(u - centre[0], v - centre[1]) < radius, 100.0, 1000.0)
    image[30, 60] = 5000.0  # a marker left of and below the centre, inside the ball
    observations = BallObservations.from_sigma(
        [centre], 0.01, semi_major=[radius], semi_minor=[radius], angle=[0.0], x_ellipse=[centre]
    )
    picture = thumbnail(observations, 0, image)
    assert picture.crop.shape[0] < n_v
    svg = thumbnail_svg(picture)
    png = decode_png(base64.b64decode(re.search(r'base64,([^"]+)"', svg)[1]))
    height = picture.crop.shape[0]
    top_row = height - 1 - (30 - picture.origin[1])
    assert png[int(top_row), int(60 - picture.origin[0])] == 255
    points = np.array(
        [[float(x) for x in p.split(",")] for p in re.search(r'class="outline" d="M([^"Z]+)Z', svg)[1].split("L")]
    )
    middle = np.array([centre[0] - picture.origin[0] + 0.5, height - 0.5 - (centre[1] - picture.origin[1])])
    np.testing.assert_allclose(np.linalg.norm(points - middle, axis=1), radius, atol=0.02)
    assert png[height - 1 - int(top_row), int(60 - picture.origin[0])] < 255


def test_thumbnails_of_balls_without_a_measurement_show_the_whole_image():
    observations = BallObservations.from_sigma([[np.nan, np.nan]], np.nan, status=["no ball found"])
    picture = thumbnail(observations, 0, np.zeros((5, 9)))
    assert picture.crop.shape == (5, 9)
    assert len(picture.outline) == 0
    assert "outline" not in thumbnail_svg(picture)
    with pytest.raises(ShapeError, match=r"image\[v, u\]"):
        thumbnail(observations, 0, np.zeros((5, 9, 3)))
    with pytest.raises(ShapeError):
        Thumbnail(pose_id="a", crop=np.zeros((0, 3)), origin=(0, 0), outline=np.empty((0, 2)))


def test_large_crops_are_thinned_and_small_ones_are_not():
    whole = Thumbnail(pose_id="a", crop=np.zeros((901, 700)), origin=(0, 0), outline=np.empty((0, 2)))
    png = decode_png(base64.b64decode(re.search(r'base64,([^"]+)"', thumbnail_svg(whole))[1]))
    assert max(png.shape) <= 220
    assert 'viewBox="0 0 700 905"' in thumbnail_svg(whole)  # 181 rows of 5 pixels


def test_worst_thumbnails_come_first_and_only_they_are_read():
    observations = BallObservations.from_sigma(
        [[5.0, 5.0], [6.0, 6.0], [np.nan, np.nan], [7.0, 7.0]], [0.1, 0.1, np.nan, 0.1], pose_id=list("abcd")
    )
    read = []

    class Images:
        def __len__(self):
            return 4

        def __getitem__(self, k):
            read.append(k)
            return np.zeros((12, 12))

    made = worst_thumbnails(observations, Images(), residuals={"a": 0.1, "b": 0.3, "d": 0.2}, count=3)
    assert [m.pose_id for m in made] == ["c", "b", "d"]
    assert read == [2, 1, 3]
    assert made[1].text == "d = 0.300 px"


def test_ellipse_outline_obeys_its_equation():
    angle = 0.4
    x = ellipse_outline((10.0, -3.0), 5.0, 2.0, angle) - [10.0, -3.0]
    along = x @ [np.cos(angle), np.sin(angle)]
    across = x @ [-np.sin(angle), np.cos(angle)]
    np.testing.assert_allclose((along / 5.0) ** 2 + (across / 2.0) ** 2, 1.0, atol=1e-12)


def test_rotation_groups_name_axis_and_sign(sample):
    poses = sample()[2]
    assert rotation_groups(poses)[:7] == ("none", "+x", "−x", "+y", "−y", "+z", "−z")
    compound = PoseSequence.from_table(np.zeros((2, 3)), [[5.0, 5.0, 0.0], [0.0, 0.0, 0.0]])
    assert rotation_groups(compound) == ("compound", "none")
    # Encoder noise of a few microdegrees is no rotation.
    noisy = PoseSequence.from_table(np.zeros((2, 3)), [[5.0, 3e-6, -2e-6], [1e-6, 0.0, -4e-6]])
    assert rotation_groups(noisy) == ("+x", "none")


def test_residuals_are_normalised_by_the_full_covariance(sample):
    calibration, observations, poses = sample()
    joined = join(calibration, observations=observations, poses=poses)
    assert joined.predicted
    assert np.sum(joined.z**2) == pytest.approx(calibration.chi2)
    alone = join(calibration, observations=None, poses=None)
    assert not alone.predicted
    assert np.sqrt(np.mean(alone.z**2)) == pytest.approx(1.0)
    # A pose table of another run counts as not given.
    other = PoseSequence.from_table(np.zeros((1, 3)), np.zeros((1, 3)), pose_id=["other"])
    assert join(calibration, observations=None, poses=other).poses is None


def test_figure_8_shows_every_pose_once_in_its_rotations_colour(sample):
    calibration, observations, poses = sample()
    joined = join(calibration, observations=observations, poses=poses)
    traces = [t for t in by_pose(joined).data if t["mode"] == "markers"]
    assert [t["name"] for t in traces] == [f"rotation {g}" for g in ("none", "+x", "−x", "+y", "−y", "+z", "−z")]
    drawn = np.concatenate([t["y"] for t in traces])
    np.testing.assert_allclose(np.sort(drawn), np.sort(calibration.d))
    assert len({t["marker"]["color"] for t in traces}) == 7


def test_arrows_begin_at_the_ball_and_follow_the_residual(sample):
    calibration, observations, poses = sample()
    joined = join(calibration, observations=observations, poses=poses)
    figure = quiver(calibration, joined)
    scale = float(re.search(r"drawn at ([\d.e+]+) times", figure.meaning)[1])
    u, v = figure.data[0]["x"], figure.data[0]["y"]
    base, tip = np.array([u[0], v[0]]), np.array([u[1], v[1]])
    np.testing.assert_allclose(base, calibration.x_D[0])
    np.testing.assert_allclose((tip - base) / scale, calibration.residuals[0])


def test_rotation_table_gives_the_rms_of_each_group(sample):
    calibration, observations, poses = sample()
    joined = join(calibration, observations=observations, poses=poses)
    table = rotation_table(calibration, joined)
    assert sum(row[1] for row in table.rows) == len(calibration.pose_id)
    k = np.array(joined.group) == "+y"
    row = next(r for r in table.rows if r[0] == "+y")
    assert float(row[2]) == pytest.approx(np.sqrt(np.mean(calibration.d[k] ** 2)), abs=5e-5)


def test_quantiles_of_normal_numbers_lie_on_the_line(sample):
    calibration, observations, poses = sample()
    figure = quantiles(join(calibration, observations=observations, poses=poses))
    expected, found = figure.data[1]["x"], figure.data[1]["y"]
    assert np.polyfit(expected, found, 1)[0] == pytest.approx(1.0, abs=0.06)


def test_ball_in_world_projects_to_where_it_was_seen(sample):
    calibration, observations, poses = sample()
    joined = join(calibration, observations=observations, poses=poses)
    s = calibration.scanner
    x = ball_in_world(calibration, joined)
    h = np.c_[x, np.ones(len(x))] @ (s.P_S @ s.T_WS.matrix).T
    np.testing.assert_allclose(h[:, :2] / h[:, 2:], calibration.x_D - calibration.residuals, atol=1e-9)


def test_panel_corners_project_to_the_panels_edge(sample):
    s = sample()[0].scanner
    h = np.c_[panel_corners(s), np.ones(5)] @ (s.P_S @ s.T_WS.matrix).T
    edge = [[-0.5, -0.5], [s.n_u - 0.5, -0.5], [s.n_u - 0.5, s.n_v - 0.5], [-0.5, s.n_v - 0.5], [-0.5, -0.5]]
    np.testing.assert_allclose(h[:, :2] / h[:, 2:], edge, atol=1e-9)


def test_correlation_of_a_known_covariance():
    rho = correlation([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(rho[:2, :2], [[1.0, 0.5], [0.5, 1.0]])
    assert np.isnan(rho[2]).all()


def test_minutes_since_the_first_pose():
    np.testing.assert_allclose(minutes(("2026-01-01T10:00:00Z", "2026-01-01T10:01:30Z")), [0.0, 1.5])
    assert minutes(("yesterday", "today")) is None
    assert minutes(None) is None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1.23456, "1.23"),
        (123456.7, "123457"),
        (0.00012345, "0.000123"),
        (9.1e6, "9.1e+06"),
        (float("nan"), "not determinable"),
        (-42.55, "-42.5"),
        (1e-9, "1e-09"),
    ],
)
def test_numbers_have_three_figures(value, text):
    assert number(value) == text


@pytest.mark.parametrize(("rms", "digits"), [(308.0, 0), (2.0, 2), (0.0268, 4), (0.000423, 6), (0.0, 3)])
def test_columns_show_three_figures_of_their_rms(rms, digits):
    assert decimals([rms, -rms, rms]) == digits


def test_words_for_names_and_units():
    assert symbol("phi_HT_x") == "φ<sub>HT,x</sub>"
    assert symbol("d_SR") == "d<sub>SR</sub>"
    assert symbol("eta") == "η"
    assert "about z" in meaning("w_HT_z")
    assert meaning("t[2]_y") == "ball centre on the moved plate, along y (ball 2)"
    assert meaning("unheard_of") == ""
    assert small_unit(1.5e-3, "mm") == "1.50 µm"
    assert small_unit(2e-6, "rad") == "2.00 µrad"
    assert small_unit(float("inf"), "mm") == "not determinable"
    assert heading("d_rms_um") == "d rms / µm"
    assert cell([1, 2.5, None, True]) == "1, 2.50, –, yes"
    assert cell({"a": 1}) == "a: 1"
