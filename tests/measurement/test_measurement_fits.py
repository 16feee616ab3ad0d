"""Fits beyond the reference pairs: covariance, outliers, effective points, degenerate points."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import exp_rotation
from tomopose.measurement.features import measurands as m
from tomopose.measurement.features.correlation import independence
from tomopose.measurement.features.feature import narrowest_shell, patch_means
from tomopose.measurement.features.fits import fit_circle, fit_cone, fit_cylinder, fit_line, fit_plane, fit_sphere
from tomopose.measurement.probing import cylinder_pattern, plane_pattern, sphere_pattern

AXIS = [0.2, -0.3, 1]
FITS = {
    "plane": (lambda: plane_pattern([1, 2, 3], [0.2, -0.3, 1], [2, 0, -0.4], [0, 1, 0.3], 60), fit_plane),
    "sphere": (lambda: sphere_pattern([1, 2, 3], 2.5, 80, axis=(0.3, 0.1, 1), cap=1.9), fit_sphere),
    "cylinder": (lambda: cylinder_pattern([1, 2, 3], AXIS, 1.5, 4, 90), partial(fit_cylinder, direction=AXIS)),
    "cone": (lambda: cylinder_pattern([1, 2, 3], AXIS, 2.5, 4, 120, half_angle=0.4), partial(fit_cone, direction=AXIS)),
}
RUNS = 300


@pytest.mark.slow
@pytest.mark.parametrize("kind", FITS)
def test_the_covariance_is_that_of_repeated_fits(kind):
    """Noise along the normals, many times: spread of every parameter over its stated uncertainty."""
    pattern, fit = FITS[kind]
    points, normals = pattern()
    rng = np.random.default_rng(1)
    found = [fit(points + 0.003 * rng.standard_normal((len(points), 1)) * normals) for _ in range(RUNS)]
    vectors = np.array([f.vector for f in found])
    stated = np.mean([np.diag(f.covariance) for f in found], axis=0)
    spread = np.var(vectors, axis=0, ddof=1)
    fixed = stated > 1e-12
    # A cone's radius is given next to the centroid, which noise along the normals moves along the axis.
    fixed[6] &= kind != "cone"
    assert np.sqrt(spread[fixed] / stated[fixed]) == pytest.approx(np.ones(fixed.sum()), abs=4 / np.sqrt(2 * RUNS))


@pytest.mark.slow
def test_the_covariance_of_lines_and_circles():
    rng = np.random.default_rng(2)
    t = np.linspace(-2, 3, 40)
    turn = exp_rotation(np.array([0.3, -0.5, 0.2]))
    line = np.outer(t, turn[2]) + [4, 5, 6]
    angle = np.linspace(0, 4.0, 40)
    circle = (np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), 0 * angle])) @ turn.T + [4, 5, 6]
    for points, fit in ((line, fit_line), (circle, fit_circle)):
        # Noise along a line moves its centroid in a direction that no distance measures.
        across = np.eye(3) - (np.outer(turn[2], turn[2]) if fit is fit_line else 0)
        found = [fit(points + 0.002 * rng.standard_normal(points.shape) @ across) for _ in range(RUNS)]
        stated = np.mean([np.diag(f.covariance) for f in found], axis=0)
        spread = np.var([f.vector for f in found], axis=0, ddof=1)
        fixed = stated > 1e-14
        assert np.sqrt(spread[fixed] / stated[fixed]) == pytest.approx(np.ones(fixed.sum()), abs=0.17)


def test_a_held_radius_frees_the_centre_of_a_calotte():
    points, normals = sphere_pattern([0, 0, 0], 2.5, 200, cap=0.5)
    noisy = points + 0.003 * np.random.default_rng(3).standard_normal((200, 1)) * normals
    free, held = fit_sphere(noisy), fit_sphere(noisy, radius=2.5)
    assert held.u[2] < 0.2 * free.u[2]
    assert held.radius == 2.5
    assert held.u[6] == 0


def test_outliers_are_dropped_and_masked():
    points, _ = sphere_pattern([0, 0, 0], 2.5, 300)
    points = points + 0.001 * np.random.default_rng(4).standard_normal(points.shape)
    points[:5] *= 1.1
    found = fit_sphere(points, outliers=4.0)
    assert not found.used[:5].any()
    assert found.n_used >= 290
    assert found.radius == pytest.approx(2.5, abs=3e-4)
    assert fit_sphere(points).used.all()


def test_known_uncertainties_weigh():
    points, _ = plane_pattern([0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], 50)
    sigma = np.where(np.arange(len(points)) % 2, 1e-4, 1.0)
    points[::2, 2] += 0.5
    assert abs(fit_plane(points, sigma=sigma).point[2]) < 1e-6


def correlated_height(length, runs, rng, reach=2.0):
    """Ratio of the scatter of a plane's height to its stated u, mean effective number and the true one, for errors that
    are correlated over `length` mm."""
    points, _ = plane_pattern([0, 0, 0], [0, 0, 1], [4, 0, 0], [0, 4, 0], 900)
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    C = np.exp(-((d / length) ** 2)) + 1e-9 * np.eye(len(points))
    L = np.linalg.cholesky(C)
    fits = []
    for _ in range(runs):
        moved = points.copy()
        moved[:, 2] += 0.01 * L @ rng.standard_normal(len(points))
        fits.append(fit_plane(moved, correlation_range=reach))
    height, u = np.array([f.point[2] for f in fits]), np.array([np.sqrt(f.covariance[2, 2]) for f in fits])
    return (
        np.std(height) / np.sqrt(np.mean(u**2)),
        np.mean([f.n_effective for f in fits]),
        len(points) ** 2 / C.sum(),
        fits,
    )


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.05, 0.4, 0.7])
def test_common_errors_of_neighbours_widen_the_uncertainty_by_what_they_cost(length):
    runs = 60
    ratio, found, truth, fits = correlated_height(length, runs, np.random.default_rng(5))
    assert ratio == pytest.approx(1.0, abs=3 / np.sqrt(2 * runs))
    assert found == pytest.approx(truth, rel=0.25)
    stated = np.array([f.covariance[2, 2] for f in fits])
    # Degrees of freedom say how well the variance itself is known: its relative variance is 2 / dof.
    assert np.std(stated) / np.mean(stated) < 1.5 * np.sqrt(2 / np.median([f.dof for f in fits]))


@pytest.mark.slow
@pytest.mark.parametrize("correlated", [True, False])
def test_points_weigh_by_the_areas_they_represent(correlated):
    """Half of the points crowd together.  The stated uncertainty is that of the mean weighed by areas, w' C w; where
    neighbours share errors it is quieter than the mean of all points."""
    rng = np.random.default_rng(9)
    even, _ = plane_pattern([0, 0, 0], [0, 0, 1], [4, 0, 0], [0, 4, 0], 625)
    crowds = rng.choice(even, 60)[rng.integers(0, 60, 625)] + np.array([0.1, 0.1, 0]) * rng.uniform(-1, 1, (625, 3))
    points = np.concatenate([even, crowds])
    fine, _ = plane_pattern([0, 0, 0], [0, 0, 1], [4.16, 0, 0], [0, 4.16, 0], 250_000)
    area = np.maximum(np.bincount(cKDTree(points).query(fine)[1], minlength=len(points)), 0.1).astype(float)
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    C = (np.exp(-((d / 0.4) ** 2)) if correlated else np.zeros(d.shape)) + (1e-9 if correlated else 1) * np.eye(len(d))
    root, w = np.linalg.cholesky(C), area / area.sum()
    truth = 1e-4 * w @ C @ w
    assert not correlated or truth < 0.7e-4 * C.mean()
    stated = []
    for _ in range(30):
        moved = points + np.outer(root @ rng.standard_normal(len(points)), [0, 0, 0.01])
        found = fit_plane(moved, area=area, correlation_range=2.0)
        stated.append(found.covariance[2, 2])
        assert np.allclose(found.point, w @ moved, atol=1e-9)
    assert np.mean(stated) == pytest.approx(truth, rel=0.15)
    with pytest.raises(InputError, match="area"):
        fit_plane(points, area=area[1:])


@pytest.mark.slow
def test_differing_neighbours_narrow_it():
    """Interpolation makes neighbours differ: errors that are differences add up to less."""
    points, _ = plane_pattern([0, 0, 0], [0, 0, 1], [4, 0, 0], [0, 4, 0], 1600)
    rng = np.random.default_rng(6)
    heights, stated = [], []
    for _ in range(60):
        e = rng.standard_normal((42, 42))
        e = e[1:-1, 1:-1] + 0.5 * (e[2:, 1:-1] + e[1:-1, 2:]) - 0.3 * (e[:-2, 1:-1] + e[1:-1, :-2])
        moved = points.copy()
        moved[:, 2] += 0.01 * e.ravel()
        f = fit_plane(moved, correlation_range=1.2)
        heights.append(f.point[2])
        stated.append(f.covariance[2, 2])
    assert np.std(heights) / np.sqrt(np.mean(stated)) == pytest.approx(1.0, abs=3 / np.sqrt(2 * 60))


def test_independent_points_stay_independent():
    rng = np.random.default_rng(7)
    points, _ = plane_pattern([0, 0, 0], [0, 0, 1], [5, 0, 0], [0, 5, 0], 2500)
    J = np.column_stack([-np.ones(len(points)), points[:, :2]])[None]
    noise = rng.standard_normal((1, len(points)))
    assert independence(points, noise, J, 1.2).n_effective > 0.75 * len(points)
    assert independence(points, noise, J, 0.0).n_effective == len(points)
    assert independence(points, noise, J, 0.0).dof == len(points) - 3
    with pytest.raises(InputError, match="correlation_range"):
        independence(points, noise, J, -1.0)


def test_both_components_of_a_line_count():
    """A line's residuals are unsigned distances; its correlation is that of the two components across it."""
    rng = np.random.default_rng(8)
    t = np.linspace(0, 10, 400)
    found = [
        fit_line(np.column_stack([0.01 * rng.standard_normal((400, 2)), t]), correlation_range=0.3) for _ in range(30)
    ]
    assert np.mean([f.n_effective for f in found]) == pytest.approx(400, rel=0.25)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-50, 50)] * 3))
def test_a_motion_moves_the_feature_and_nothing_else(w, shift):
    turn, shift = exp_rotation(np.array(w)), np.array(shift)
    points, normals = cylinder_pattern([1, 2, 3], [0.2, -0.3, 1], 1.5, 4, 60)
    points = points + 0.01 * np.sin(7 * points[:, :1]) * normals
    one, two = fit_cylinder(points), fit_cylinder(points @ turn.T + shift)
    assert two.radius == pytest.approx(one.radius, abs=1e-9)
    assert np.linalg.norm(np.cross(two.direction, turn @ one.direction)) < 1e-8
    assert two.rms == pytest.approx(one.rms, abs=1e-10)


def test_form_deviations():
    assert narrowest_shell(np.array([0.0, 1, 2, 3, 100]), 0.8) == 3
    points, normals = sphere_pattern([0, 0, 0], 2.5, 3000)
    found = fit_sphere(points + 0.01 * normals * np.sign(points[:, 2:3] * points[:, :1]))
    assert found.form == pytest.approx(0.02, rel=0.02)
    assert len(patch_means(found.points, found.residuals, 25)) == 25
    assert found.form_25 <= found.form + 1e-12


DENTED = {
    "plane": (lambda n: plane_pattern([0, 0, 0], [0, 0, 1], [4, 0, 0], [0, 3, 0], n), fit_plane),
    "sphere": (lambda n: sphere_pattern([0, 0, 0], 5.0, n), fit_sphere),
    "cylinder": (lambda n: cylinder_pattern([0, 0, 0], [0, 0, 1], 4.0, 8.0, n), fit_cylinder),
}


@pytest.mark.parametrize("outliers", [None, 3.0])
@pytest.mark.parametrize("n", [400, 4000])
@pytest.mark.parametrize("kind", DENTED)
def test_a_dent_on_2_percent_of_the_points_is_the_form(kind, n, outliers):
    pattern, fit = DENTED[kind]
    points, normals = pattern(n)
    dent = np.argsort(np.linalg.norm(points - points[n // 3], axis=1))[: round(0.02 * len(points))]
    points[dent] -= 0.05 * normals[dent]
    points += 0.0002 * np.random.default_rng(n).standard_normal((len(points), 1)) * normals
    found = fit(points, outliers=outliers)
    assert found.form == pytest.approx(0.05, rel=0.05)
    assert found.n_set_aside == (0 if outliers is None else len(points) - found.n_used)
    assert (found.n_set_aside >= len(dent)) == (outliers is not None)
    assert f"range of {len(points)} points" in m.form(found, "form").method


class TestMeasurands:
    def plane(self, z, up):
        points, normals = plane_pattern([0, 0, z], [0, 0, up], [1, 0, 0], [0, 1, 0], 60)
        f = fit_plane(points + 0.001 * np.random.default_rng(6).standard_normal(points.shape))
        from tomopose.measurement.bench import _turned

        return f if f.direction @ normals[0] > 0 else _turned(f)

    def test_steps_and_thicknesses_are_distinguished(self):
        assert m.distance(self.plane(0, 1), self.plane(3, 1)).direction == "unidirectional"
        assert m.distance(self.plane(0, -1), self.plane(3, 1)).direction == "bidirectional"

    def test_both_rules_for_planes(self):
        a, b = self.plane(0, -1), self.plane(3, 1)
        for rule in ("centroid-of-second", "symmetric"):
            found = m.distance(a, b, rule=rule)
            assert found.value == pytest.approx(3, abs=1e-3)
            assert found.u == pytest.approx(0.001 * np.sqrt(2 / 60), rel=0.3)

    def test_centres_axes_and_angles(self):
        ball = fit_sphere(sphere_pattern([3, 0, 0], 1.0, 60)[0])
        rod = fit_cylinder(cylinder_pattern([0, 0, 1], [0, 0, 1], 1.0, 4, 60)[0])
        tilted = fit_cylinder(cylinder_pattern([0, 5, 0], [0, np.sin(0.3), np.cos(0.3)], 1.0, 4, 60)[0])
        assert m.distance(ball, rod).value == pytest.approx(3, abs=1e-9)
        assert m.angle(rod, tilted).value == pytest.approx(0.3, abs=1e-9)
        assert m.angle(rod, self.plane(0, 1)).value == pytest.approx(np.pi / 2, abs=1e-3)
        assert m.position(ball, [3, 0, 0.1]).value == pytest.approx(0.2, abs=1e-9)
        cone = fit_cone(cylinder_pattern([0, 0, 0], [0, 0, 1], 2.0, 2, 90, half_angle=0.4)[0])
        assert m.apex_angle(cone).value == pytest.approx(0.8, abs=1e-9)

    def test_permissible_errors_are_the_users(self):
        assert m.maximum_permissible_error(100.0, 4.5, 50.0) == pytest.approx(6.5)
        assert m.maximum_permissible_error(100.0, 4.5, 50.0, 6.0) == pytest.approx(6.0)
        with pytest.raises(InputError):
            m.maximum_permissible_error(100.0, -1.0)

    def test_a_pair_without_a_rule(self):
        with pytest.raises(InputError, match="no rule"):
            m.distance(self.plane(0, 1), fit_cylinder(cylinder_pattern([0, 0, 1], [0, 0, 1], 1.0, 4, 60)[0]))


class TestBadPoints:
    t = np.linspace(0, 1, 20)
    on_a_line = np.outer(t, [1.0, 2.0, 3.0])

    @pytest.mark.parametrize("fit", [fit_plane, fit_circle, fit_sphere, fit_cylinder, fit_cone])
    def test_all_on_a_line(self, fit):
        with pytest.raises(InputError):
            fit(self.on_a_line)

    def test_a_sphere_of_points_in_one_plane(self):
        flat = np.column_stack([np.cos(6 * self.t), np.sin(6 * self.t), 0 * self.t])
        with pytest.raises(InputError, match="do not determine"):
            fit_sphere(flat)

    @pytest.mark.parametrize("fit", [fit_plane, fit_line, fit_circle, fit_sphere, fit_cylinder, fit_cone])
    def test_too_few_coinciding_not_finite_or_misshapen(self, fit):
        with pytest.raises(InputError, match="needs at least"):
            fit(np.zeros((1, 3)))
        with pytest.raises(InputError):
            fit(np.ones((30, 3)))
        with pytest.raises(InputError, match="not finite"):
            fit(np.full((30, 3), np.nan))
        with pytest.raises(ShapeError):
            fit(np.zeros((30, 2)))

    def test_a_cylinder_is_no_cone(self):
        with pytest.raises(InputError):
            fit_cone(cylinder_pattern([0, 0, 0], [0, 0, 1], 1.0, 4, 60)[0])
