"""The reference pairs of NIST (shared/data/nist-l2): parameters to 1e-8 mm and 1e-8 rad."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.measurement.features import fits
from tomopose.measurement.features.nist import read_reference_pair, reference_pairs

LENGTH_MM, ANGLE_RAD = 1e-8, 1e-8
NUMBER_OF_PAIRS = 12


def angle(a, b):
    """Angle between two undirected lines, rad; the cross product keeps its digits near zero."""
    return float(np.linalg.norm(np.cross(a, b)))


def from_axis(point, feature):
    """Distance of a point from a feature's axis, mm."""
    return float(np.linalg.norm(np.cross(point - feature.point, feature.direction)))


def test_every_pair_is_there(shared_data):
    assert len(reference_pairs(shared_data / "nist-l2")) == NUMBER_OF_PAIRS


@pytest.mark.parametrize(
    "name",
    ["pla7", "pla26", "lin8", "cir7", "sph11", "sph14", "sph16", "sph20", "cyl4", "cyl23", "cyl25", "con17"],
)
def test_reference_pair(shared_data, name):
    pair = read_reference_pair(reference_pairs(shared_data / "nist-l2")[name])
    feature = getattr(fits, f"fit_{pair.kind}")(pair.points)
    if pair.kind in ("circle", "sphere"):
        assert np.linalg.norm(feature.point - pair.point) < LENGTH_MM
        assert abs(feature.diameter - pair.diameter) < LENGTH_MM
    if pair.kind in ("cylinder", "cone", "line"):
        assert from_axis(pair.point, feature) < LENGTH_MM
    if pair.kind == "cylinder":
        assert abs(feature.diameter - pair.diameter) < LENGTH_MM
    if pair.kind == "plane":
        assert abs((pair.point - feature.point) @ feature.direction) < LENGTH_MM
    if pair.kind != "sphere":
        assert angle(feature.direction, pair.direction) < ANGLE_RAD
    if pair.kind == "cone":
        assert abs(2 * feature.half_angle - pair.apex_angle) < ANGLE_RAD
        assert np.linalg.norm(feature.apex - pair.apex) < LENGTH_MM
