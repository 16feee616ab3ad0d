"""Figures and values as a notebook shows them."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import plotly.graph_objects as go
import pytest

import tomopose as tp
from tomopose.errors import EngineMissingError, InputError, ShapeError


@pytest.mark.parametrize("by", ["pose", "detector", "sequence", "coordinate", "histogram", "quantiles"])
def test_residuals_are_drawn_in_every_way(sample, by):
    calibration, observations, poses = sample()
    figure = tp.plot_residuals(calibration, by=by, observations=observations, poses=poses)
    assert isinstance(figure, go.Figure)
    assert figure.layout.title.text
    if by == "pose":
        d = np.concatenate([t.y for t in figure.data if t.mode == "markers"])
        np.testing.assert_allclose(np.sort(d), np.sort(calibration.d))


def test_without_plotly_the_line_that_installs_it_is_said(sample, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(EngineMissingError, match=r'pip install "tomopose\[notebook\]"'):
        tp.plot_residuals(sample()[0])


def test_what_cannot_be_drawn_is_said(sample):
    calibration, _, _ = sample()
    with pytest.raises(InputError, match="by is 'colour'; one of pose, detector"):
        tp.plot_residuals(calibration, by="colour")
    with pytest.raises(InputError, match="need the pose table"):
        tp.plot_residuals(calibration, by="coordinate")
    with pytest.raises(InputError, match=r"a str was given: read_calibration\(path\) reads it"):
        tp.plot_residuals("calibration.json")
    empty = dataclasses.replace(calibration, pose_id=(), x_D=np.empty((0, 2)), residuals=np.empty((0, 2)))
    with pytest.raises(InputError, match="holds no residuals"):
        tp.plot_residuals(empty)


def test_correlations_and_the_path_of_the_source_are_those_of_the_values(sample, scan):
    calibration, _, _ = sample()
    rho = np.array(tp.plot_observability(calibration).data[0].z)
    u = np.sqrt(np.diag(calibration.covariance))
    np.testing.assert_allclose(rho, calibration.covariance / np.outer(u, u), atol=1e-4)
    path = tp.plot_scan(scan).data[0]
    np.testing.assert_allclose(np.column_stack([path.x, path.y, path.z]), scan.decompose().source)


def test_detections_are_shown_on_the_pixels_that_they_are_of(sample):
    _, observations, _ = sample()
    few = observations.select(range(3))
    images = [np.full((1953, 2049), 7 + k, dtype=np.uint16) for k in range(3)]
    figure = tp.plot_detections(few, images, count=3)
    pictures = [t for t in figure.data if t.type == "heatmap"]
    outlines = [t for t in figure.data if t.type == "scatter" and t.mode == "lines"]
    assert len(pictures) == len(outlines) == 3
    for picture, outline in zip(pictures, outlines, strict=True):
        n_v, n_u = np.shape(picture.z)
        assert picture.x0 < min(outline.x) < max(outline.x) < picture.x0 + n_u * picture.dx
        assert picture.y0 < min(outline.y) < max(outline.y) < picture.y0 + n_v * picture.dy
    with pytest.raises(ShapeError, match="3 observations but 2 images"):
        tp.plot_detections(few, images[:2])


def test_a_calibration_shows_its_verdict_and_its_table(sample):
    calibration, _, _ = sample(verdict="doubtful")
    text = dataclasses.replace(calibration, status="<script>")._repr_html_()
    assert "<b>Doubtful</b>" in text
    assert "&lt;script&gt;" in text
    assert "<script>" not in text
    assert text.count("<tr>") == 1 + len(calibration.parameters)
    assert f"{2 * calibration.parameters[0].u:.2g} rad" in text
