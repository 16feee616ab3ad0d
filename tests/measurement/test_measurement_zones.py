"""Minimum-zone, minimum circumscribed and maximum inscribed features against sets whose solution is known."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from known_zones import known_set, pairs_set

from tomopose.errors import InputError
from tomopose.measurement.features import measurands as m
from tomopose.measurement.features.fits import (
    feature_distances,
    fit_circle,
    fit_cone,
    fit_cylinder,
    fit_line,
    fit_plane,
    fit_sphere,
)
from tomopose.measurement.features.measurands import form
from tomopose.measurement.probing import circle_pattern, plane_pattern, sphere_pattern
from tomopose.measurement.zones.reference_features import associated

FITS = {
    "line": fit_line,
    "plane": fit_plane,
    "circle": fit_circle,
    "sphere": fit_sphere,
    "cylinder": fit_cylinder,
    "cone": fit_cone,
}
SIZED = ("circle", "sphere", "cylinder")
CASES = [(kind, "minimum-zone") for kind in FITS] + [
    (kind, c) for kind in SIZED for c in ("minimum-circumscribed", "maximum-inscribed")
]
SETS = 60
RIGHT = 1e-8


def least_squares(kind, known):
    fit = FITS[kind]
    # The direction of an axis is given roughly, as a plan gives it: searching for it is not what is tested here.
    if kind in ("cylinder", "cone"):
        fit = partial(fit, direction=known.direction + 0.02)
    return fit(known.points)


def errors(kind, feature, known):
    """Errors of place, direction, radius, half angle and zone, mm and rad."""
    offset = feature.point - known.point
    out = {"zone": feature.form - 2 * known.half}
    if kind == "plane":
        out["place"] = float(offset @ known.direction)
    elif kind in ("circle", "sphere"):
        out["place"] = float(np.linalg.norm(offset))
    else:
        out["place"] = float(np.linalg.norm(np.cross(offset, known.direction)))
    if kind not in ("sphere", "circle"):
        out["direction"] = float(np.linalg.norm(np.cross(feature.direction, known.direction)))
    if kind in SIZED:
        out["radius"] = feature.radius - known.radius
    if kind == "cone":
        along = float(offset @ known.direction)
        out["radius"] = feature.radius - (known.radius + along * np.tan(known.half_angle))
        out["half angle"] = feature.half_angle - known.half_angle
    return out


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "criterion"), CASES)
def test_the_solution_is_right_where_it_is_known_by_construction(kind, criterion):
    worst = {}
    for seed in range(SETS):
        known = known_set(kind, criterion, seed)
        found = associated(least_squares(kind, known), criterion)
        assert len(found.contacts) == known.contacts
        for name, error in errors(kind, found, known).items():
            worst[name] = max(worst.get(name, 0.0), abs(error))
    assert max(worst.values()) < RIGHT, worst


@pytest.mark.parametrize("kind", ["circle", "sphere"])
def test_two_opposite_points_hold_the_smallest_circle_and_sphere(kind):
    """Fewer contacts than a circle or sphere has changes: what bounds the others is curvature."""
    for seed in range(SETS):
        known = pairs_set(kind, seed)
        found = associated(least_squares(kind, known), "minimum-circumscribed")
        assert len(found.contacts) == known.contacts
        assert max(map(abs, errors(kind, found, known).values())) < RIGHT


def test_a_large_cloud_has_the_solution_of_its_few_contacts():
    known = known_set("cylinder", "minimum-zone", 3, n=20_000)
    found = associated(least_squares("cylinder", known), "minimum-zone")
    assert max(map(abs, errors("cylinder", found, known).values())) < RIGHT
    assert np.abs(found.residuals[list(found.contacts)]) == pytest.approx(np.full(6, known.half), abs=1e-10)


@pytest.mark.parametrize(("kind", "criterion"), CASES)
def test_no_small_change_of_the_feature_is_better(kind, criterion):
    """Noise has no known solution: move the feature a little, many times, and none is better."""
    known = known_set(kind, criterion, 1)
    rng = np.random.default_rng(5)
    points = known.points + 0.003 * rng.standard_normal(known.points.shape)
    if kind == "circle":
        points -= np.outer((points - known.point) @ known.direction, known.direction)
    found = associated(FITS[kind](points), criterion)
    bound = {"minimum-zone": found.form}.get(criterion, found.vector[6])
    for size in (1e-3, 1e-5):
        for _ in range(300):
            vector = np.array(found.vector)
            vector[:6] += size * rng.standard_normal(6)
            if kind == "circle":
                vector[3:6] = found.vector[3:6]
            vector[3:6] /= np.linalg.norm(vector[3:6])
            if kind == "cone":
                vector[7] += size * rng.standard_normal()
            d = feature_distances(kind, vector, points)
            if kind == "line":
                assert 2 * d.max() > bound - 1e-12
            elif criterion == "minimum-zone":
                assert np.ptp(d) > bound - 1e-12
            elif criterion == "minimum-circumscribed":
                assert vector[6] + d.max() > bound - 1e-12
            else:
                assert vector[6] + d.min() < bound + 1e-12


def test_points_without_form_have_a_zone_of_nothing():
    points, _ = sphere_pattern([1, 2, 3], 2.5, 200)
    found = associated(fit_sphere(points), "minimum-zone")
    assert found.form < 1e-12
    assert found.radius == pytest.approx(2.5, abs=1e-12)


def test_points_on_a_line_have_a_zone_of_nothing():
    points = np.outer(np.linspace(-2, 3, 40), [0.6, 0.0, 0.8]) + [4, 5, 6]
    assert associated(fit_line(points), "minimum-zone").form < 1e-12


def test_points_in_a_grid_tie_and_are_solved():
    """A regular plate with opposite corners bent: many points lie equally far, and the zone is that of the bend."""
    points, _ = plane_pattern([0, 0, 0], [0, 0, 1], [2, 0, 0], [0, 2, 0], 400)
    points[:, 2] = np.round(0.01 * points[:, 0] * points[:, 1], 3)
    found = associated(fit_plane(points), "minimum-zone")
    assert found.form == pytest.approx(np.ptp(points[:, 2]), abs=1e-12)


class TestWhatIsNotKnown:
    def test_extreme_points_have_no_standard_uncertainty(self):
        known = known_set("cylinder", "minimum-circumscribed", 0)
        found = associated(least_squares("cylinder", known), "minimum-circumscribed")
        measured = m.diameter(found)
        assert np.isnan(measured.u)
        assert measured.method == "minimum-circumscribed"
        assert "minimum-circumscribed cylinder" in form(found, "form").method

    @pytest.mark.parametrize("kind", ["plane", "line", "cone"])
    def test_kinds_without_a_size_have_no_inscribed_feature(self, kind):
        with pytest.raises(InputError, match="no maximum-inscribed"):
            associated(least_squares(kind, known_set(kind, "minimum-zone", 0)), "maximum-inscribed")

    def test_a_short_arc_bounds_no_inscribed_circle(self):
        points, normals = circle_pattern([0, 0, 0], [0, 0, 1], 2.0, 400)
        arc = points[:60] + 0.001 * np.sin(np.arange(60.0))[:, None] * normals[:60]
        with pytest.raises(InputError, match=r"unbounded|not certified"):
            associated(fit_circle(arc), "maximum-inscribed")
