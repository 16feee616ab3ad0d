"""Real portal images: a faint ball of about 9 px inside a field that is darker than its surroundings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_laplace, map_coordinates

from tomopose import Scanner
from tomopose.detection import detect
from tomopose.observations import BallObservations
from tomopose.units import Array

SCANNER = Scanner(d_SD=1500.0, d_SR=1000.0, p_u=0.784, p_v=0.784, u_0=255.5, v_0=191.5, n_u=512, n_v=384)
RADIUS = 2.5 * 1.5 / 0.784
"""Of the 5 mm ball, px."""
CENTRAL = 12
"""The ball lies at the isocentre within a few mm: the search covers so many px either way of the image's middle."""
TOLERANCE = 0.5
"""px.  What the independent estimate is worth where the couch's edge runs past the ball at less than 2 radii and no
plane describes the surroundings (gantry at 45, 135, 225 and 315 degrees).  Anything else in these images (edge, middle
or corner of the field) lies several pixels away."""
CLEAR, CLEAR_TOLERANCE = 13, 0.05
"""In so many images nothing else lies near the ball; there half-height crossings are good to so many px."""


def brightest_blob(image: Array) -> Array:
    """(u, v) of the Laplacian-of-Gaussian's extremum in the image's middle; its width is a disc's, r / sqrt(2)."""
    response = -gaussian_laplace(image, RADIUS / np.sqrt(2))
    v_0, u_0 = image.shape[0] // 2, image.shape[1] // 2
    middle = response[v_0 - CENTRAL : v_0 + CENTRAL + 1, u_0 - CENTRAL : u_0 + CENTRAL + 1]
    v, u = np.unravel_index(np.argmax(middle), middle.shape)
    assert 0 < min(v, u) <= max(v, u) < 2 * CENTRAL, "no extremum inside the image's middle"
    around = middle[v - 1 : v + 2, u - 1 : u + 2]
    peak = [(a - c) / (a - 2 * b + c) / 2 for a, b, c in (around[1], around[:, 1])]
    return np.array([u + u_0 - CENTRAL + peak[0], v + v_0 - CENTRAL + peak[1]])


def half_height_centre(image: Array) -> Array:
    """(u, v) of the circle through the half-height crossings on 72 rays from the blob's peak, above a plane."""
    u, v = brightest_blob(image)
    rows, columns = np.indices(image.shape)
    away = np.hypot(columns - u, rows - v) / RADIUS
    ring = (away > 1.35) & (away < 1.7)
    plane = np.stack([np.ones_like(image), columns - u, rows - v])
    level = np.linalg.lstsq(plane[:, ring].T, image[ring], rcond=None)[0]
    above = image - np.tensordot(level, plane, 1)
    half = np.median(above[away < 0.5]) / 2
    distance = np.arange(0.0, 1.4 * RADIUS, 0.02)
    rim = []
    for turn in np.radians(np.arange(0, 360, 5)):
        ray = map_coordinates(above, [v + distance * np.sin(turn), u + distance * np.cos(turn)], order=3)
        assert ray.min() < half
        reach = distance[np.argmax(ray < half)]
        rim.append([u + reach * np.cos(turn), v + reach * np.sin(turn)])
    points = np.array(rim)
    design = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0][:2])


@pytest.fixture(scope="module")
def images(shared_data: Path) -> list[Array]:
    import pydicom

    out = []
    for file in sorted((shared_data / "ball-radiographs-epid").glob("*.dcm")):
        dataset = pydicom.dcmread(file, force=True)
        dataset.file_meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian
        out.append(dataset.pixel_array[::-1])
    assert len(out) == 17
    return out


@pytest.fixture(scope="module")
def observations(images: list[Array]) -> BallObservations:
    return detect(images, SCANNER, ball_diameter=5.0)


@pytest.mark.slow
def test_every_ball_is_found_and_none_is_wrong(images: list[Array], observations: BallObservations) -> None:
    assert observations.seen.all()
    independent = np.array([half_height_centre(np.asarray(image, dtype=np.float64)) for image in images])
    difference = observations.x_D - independent
    assert np.abs(difference).max() < TOLERANCE
    assert np.sum(np.abs(difference).max(axis=1) < CLEAR_TOLERANCE) >= CLEAR


@pytest.mark.slow
def test_rows_say_what_the_images_are(observations: BallObservations) -> None:
    assert all("bright ball" in s for s in observations.status or ())
    assert observations.sigma.max() < 0.2
