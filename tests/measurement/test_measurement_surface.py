"""The surface of blurred balls in closed form, lengths in voxels unless said otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from blurred_shapes import as_volume, balls_on_a_lattice, balls_volume, blurred_ball, grid_of
from scipy.spatial import cKDTree
from scipy.special import ndtr
from scipy.stats import t

from tomopose.errors import InputError, ShapeError
from tomopose.measurement.features.fits import fit_plane, fit_sphere
from tomopose.measurement.probing import plane_pattern, probe, sphere_pattern
from tomopose.measurement.surface.edges import EdgeFlag, EdgeSettings
from tomopose.measurement.surface.grey_levels import given_levels, grey_levels
from tomopose.measurement.surface.plateaus import shared_plateaus
from tomopose.measurement.surface.surface import surface, surfaces
from tomopose.volume import Volume, VoxelGrid

V = 0.1482
R, SIGMA = 12.3, 1.0


@pytest.fixture(scope="module")
def balls():
    rng = np.random.default_rng(11)
    grid = VoxelGrid(shape=(78, 74, 75), spacing=np.full(3, V), centre=np.array([3.0, -2.0, 5.0]))
    return grid, balls_on_a_lattice(rng, grid, 2, R)


def errors(found, grid, centres, radius=R):
    """Errors of centres (n, 3) and radii (n,), voxels."""
    near = np.argmin(np.linalg.norm(found.points[:, None] - centres, axis=2), axis=1)
    fits = [fit_sphere(found.points[(near == k) & found.good]) for k in range(len(centres))]
    v = grid.spacing[0]
    return (np.array([f.point for f in fits]) - centres) / v, np.array([f.radius for f in fits]) / v - radius


@pytest.fixture(scope="module")
def clean(balls):
    grid, centres = balls
    return as_volume(balls_volume(grid, centres, np.full(8, R * V), SIGMA * V), grid)


@pytest.fixture(scope="module")
def drifting(balls):
    grid, centres = balls
    rng = np.random.default_rng(5)
    values = balls_volume(grid, centres, np.full(8, R * V), SIGMA * V, 1 + 0.13 * rng.uniform(-1, 1, 8))
    values += np.linspace(-0.1, 0.1, grid.shape[2]) + 0.05 * rng.standard_normal(grid.shape)
    return as_volume(values, grid)


def test_the_blurred_ball_is_one_inside_and_zero_outside():
    assert blurred_ball(0.0, 10.0, 1.0) == pytest.approx(1.0, abs=1e-9)
    assert blurred_ball(20.0, 10.0, 1.0) == pytest.approx(0.0, abs=1e-9)


def test_clean_centres_and_the_known_curvature_bias(balls, clean):
    grid, centres = balls
    found = surface(clean)
    centre, radius = errors(found, grid, centres)
    assert np.sqrt(np.mean(centre**2)) < 1e-4
    assert radius == pytest.approx(-(SIGMA**2) / R, abs=2e-3)
    assert found.sigma / V == pytest.approx(SIGMA, abs=0.01)
    assert not found.corrected


@pytest.mark.slow
def test_the_correction_removes_the_curvature_bias_and_says_so(balls, clean):
    grid, centres = balls
    found = surface(clean, curvature_correction=True)
    assert np.abs(errors(found, grid, centres)[1]).max() < 2e-3
    assert found.corrected
    assert found.settings["curvature_correction"] is True


@pytest.mark.slow
def test_drift_spoils_the_fixed_level_but_not_the_local_edge(balls, drifting):
    grid, centres = balls
    fixed = errors(surface(drifting, method="iso-50"), grid, centres)[1]
    local = errors(surface(drifting), grid, centres)[1]
    assert np.std(fixed) > 0.05
    assert np.std(local) < 0.006


@pytest.mark.slow
def test_shared_plateaus_scatter_less_than_a_fixed_level_where_grey_drifts(balls, drifting):
    """D95 of the balls, mean: quieter than ISO-50, and than edges with plateaus of their own."""
    _, centres = balls

    def form(found):
        near = np.argmin(np.linalg.norm(found.points[:, None] - centres, axis=2), axis=1)
        return np.mean([fit_sphere(found.points[(near == k) & found.good]).form_95 for k in range(len(centres))])

    fixed, own, shared = (
        form(surface(drifting, method=m, edges=e))
        for m, e in (("iso-50", None), ("esf", EdgeSettings(plateau_radius=0.0)), ("esf", None))
    )
    assert shared < 0.97 * fixed
    assert shared < 0.85 * own


def test_longer_plateaus_make_places_quieter():
    """A face with noise, means over patches of 10 x 10 voxels: theory says 4.6 to 6.4 in squares, windows 8 and 4."""
    grid = VoxelGrid(shape=(40, 120, 120), spacing=np.ones(3))
    z = grid.origin[2] + np.arange(40)
    rng = np.random.default_rng(7)
    volume = as_volume(ndtr(-z)[:, None, None] + 0.05 * rng.standard_normal(grid.shape), grid)
    x, n = plane_pattern([0, 0, 0], [0, 0, 1], [50, 0, 0], [0, 50, 0], 15625)
    patch = (np.floor(x[:, 0] / 10) * 100 + np.floor(x[:, 1] / 10)).astype(int)
    patch = np.unique(patch, return_inverse=True)[1]
    scatter = []
    for window in (None, 4.0):
        edges = probe(volume, x, n, settings=EdgeSettings(sigma=1.0, window=window)).edges
        assert (edges.longer > 0.99 * len(x)) is (window is None)
        good = edges.good
        scatter.append(np.std(np.bincount(patch[good], edges.offset[good]) / np.bincount(patch[good])))
    assert 0.75 < scatter[0] / scatter[1] < 0.95


@pytest.mark.parametrize("half", [3.4, 4.2, 4.9, 5.6, 6.3])
def test_a_near_wall_keeps_plateaus_short(half):
    """A slab so thick that the usual window fits but the longer one meets the other side: the face is at its place."""
    grid = grid_of(40, 1.0, (0, 0, 0))
    z = grid.origin[2] + np.arange(40)
    profile = ndtr(z + half) - ndtr(z - half)
    volume = as_volume(np.broadcast_to(profile[:, None, None], grid.shape), grid)
    x, n = plane_pattern([0, 0, half], [0, 0, 1], [8, 0, 0], [0, 8, 0], 400)
    found = probe(volume, x, n, settings=EdgeSettings(sigma=1.0))
    assert found.edges.longer == (0 if half < 5 else 400)
    assert found.good.all()
    assert np.abs(found.edges.offset).max() < 1e-3


def test_cupping_keeps_plateaus_short(balls):
    """Grey that falls from the rim inwards: levels are taken near the edge."""
    grid, centres = balls
    values = balls_volume(grid, centres, np.full(8, R * V), SIGMA * V)
    x = np.stack(np.meshgrid(*(grid.origin[2 - a] + V * np.arange(grid.shape[a]) for a in range(3)), indexing="ij"), -1)
    depth = R - np.min([np.linalg.norm(x[..., ::-1] - c, axis=-1) for c in centres], axis=0) / V
    found = surface(as_volume(values * (1 - 0.02 * np.clip(depth, 0, 8)), grid))
    assert "longer" not in found.notes[-1]


def test_the_areas_of_the_vertices_are_those_of_the_balls(clean, balls):
    grid, centres = balls
    found = surface(clean)
    v = grid.spacing[0]
    assert found.areas.sum() == pytest.approx(len(centres) * 4 * np.pi * ((R - SIGMA**2 / R) * v) ** 2, rel=2e-3)
    assert (found.areas > 0).all()


def test_plateaus_are_shared_on_one_side_of_a_wall_and_not_at_its_rim():
    """Both sides of a thin wall, a grid of points each, with noisy plateaus of 1 and 5."""
    rng = np.random.default_rng(3)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(21.0), np.arange(21.0)))
    points = np.concatenate([np.column_stack([x, y, 0 * x]), np.column_stack([x, y, 0 * x + 0.1])])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], 441, axis=0)
    own = np.repeat([1.0, 5.0], 441)[:, None] + 0.1 * rng.standard_normal((882, 2))
    shared, count = shared_plateaus(points, normals, own, 3.0)
    inside = np.tile((np.abs(x - 10) < 8) & (np.abs(y - 10) < 8), 2)
    rim = np.tile((np.abs(x - 10) == 10) | (np.abs(y - 10) == 10), 2)
    assert (shared[rim] == own[rim]).all()
    assert np.median(count[inside]) >= 20
    assert np.std(shared[inside] - np.repeat([1.0, 5.0], 441)[inside, None]) < 0.05


def test_sharing_plateaus_leaves_the_rim_of_a_face_where_it_is():
    """A blurred box is exact along normals up to its edges, since its profiles factorise: no rim may appear."""
    grid, half = grid_of(40, 0.1, (0, 0, 0)), 1.43
    t = grid.origin[0] + 0.1 * np.arange(40)
    row = ndtr((t + half) / 0.1) - ndtr((t - half) / 0.1)
    u = np.linspace(-half + 0.05, half - 0.05, 40)
    points = np.array([[a, b, half] for a in u for b in u])
    up = np.tile([0.0, 0, 1], (1600, 1))
    found = probe(as_volume(row[:, None, None] * row[None, :, None] * row, grid), points, up)
    assert np.abs(found.edges.offset[found.good]).max() < 1e-4


@pytest.mark.slow
def test_the_local_half_agrees_with_the_fitted_step_on_clean_data(balls, clean):
    grid, centres = balls
    half, step = (errors(surface(clean, method=m), grid, centres) for m in ("local-50", "esf"))
    assert half[1] == pytest.approx(step[1], abs=2e-3)


@pytest.mark.slow
def test_slabs_change_memory_not_result(clean):
    whole, slabs = surface(clean, layers=500), surface(clean, layers=17)
    assert len(whole) == len(slabs)
    assert len(whole.faces) == len(slabs.faces)
    apart = cKDTree(whole.points).query(slabs.points)[0]
    assert np.quantile(apart, 0.999) < 1e-5 * V
    # Whether an edge takes its neighbours' plateaus is a choice, and may turn on the last digit.
    assert apart.max() < 1e-3 * V


def test_the_mesh_is_closed_and_its_triangles_look_outwards(clean, balls):
    found = surface(clean)
    a, b, c = (found.points[found.faces[:, k]] - balls[0].centre for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(8 * 4 / 3 * np.pi * ((R - SIGMA**2 / R) * V) ** 3, rel=5e-3)
    edges = np.sort(np.concatenate([found.faces[:, [0, 1]], found.faces[:, [1, 2]], found.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_axes_are_not_mixed_up_with_voxels_of_three_sizes():
    grid = VoxelGrid(shape=(61, 50, 43), spacing=np.array([0.13, 0.11, 0.09]), centre=np.array([1.0, 2.0, -3.0]))
    centre = np.array([1.2, 1.7, -2.9])
    volume = as_volume(balls_volume(grid, [centre], [1.6], 0.13), grid)
    found = surface(volume)
    fit = fit_sphere(found.points[found.good])
    assert np.linalg.norm(fit.point - centre) < 2e-5
    assert fit.radius == pytest.approx(1.6 - 0.13**2 / 1.6, abs=3e-4)


@pytest.mark.slow
def test_two_materials_give_two_surfaces():
    grid = grid_of(60, 0.1, (0, 0, 0))
    values = 0.5 * balls_volume(grid, [[0, 0, 0]], [2.2], 0.1) + 0.5 * balls_volume(grid, [[0, 0, 0]], [1.2], 0.1)
    outer, inner = surfaces(as_volume(values, grid), materials=2)
    assert fit_sphere(outer.points[outer.good]).radius == pytest.approx(2.2 - 0.01 / 2.2, abs=2e-3)
    assert fit_sphere(inner.points[inner.good]).radius == pytest.approx(1.2 - 0.01 / 1.2, abs=2e-3)


def wall(thickness):
    grid = grid_of(48, 0.1, (0, 0, 0))
    x = grid.origin[0] + 0.1 * np.arange(48)
    row = ndtr((x + thickness / 2) / 0.1) - ndtr((x - thickness / 2) / 0.1)
    return as_volume(np.broadcast_to(row, grid.shape).copy(), grid)


def test_a_thin_wall_is_flagged():
    with pytest.raises(InputError, match="THIN"):
        surface(wall(0.35), levels=given_levels(0.0, 1.0))


def test_a_thick_wall_is_measured_at_its_place():
    found = surface(wall(2.0), levels=given_levels(0.0, 1.0))
    assert np.abs(found.points[found.good, 0]) == pytest.approx(1.0, abs=1e-4)
    inside = found.flags & EdgeFlag.BORDER > 0
    near_the_border = np.abs(found.points[:, 1:]).max(axis=1) > 2.2
    assert (near_the_border | ~inside).all()


def test_probing_finds_the_ball_without_a_mesh(balls, clean):
    centres = balls[1]
    points, normals = sphere_pattern(centres[3] + 0.4 * V, (R + 0.5) * V, 400)
    found = probe(clean, points, normals)
    fit = fit_sphere(found.points[found.good])
    assert found.good.mean() > 0.99
    assert np.linalg.norm(fit.point - centres[3]) < 2e-4 * V
    assert fit.radius / V == pytest.approx(R - SIGMA**2 / R, abs=2e-3)


def test_probing_searches_far(balls, clean):
    _, centres = balls
    points, normals = sphere_pattern(centres[0], (R - 6.0) * V, 300)
    found = probe(clean, points, normals, search_mm=8 * V)
    assert fit_sphere(found.points[found.good]).radius / V == pytest.approx(R - SIGMA**2 / R, abs=3e-3)


@pytest.mark.slow
def test_stated_intervals_hold_the_truth():
    """The height of a plane under noise: 95 % intervals in 120 volumes with known truth."""
    grid = VoxelGrid(shape=(20, 26, 30), spacing=np.full(3, 0.1))
    z = grid.origin[2] + 0.1 * np.arange(20)
    points, normals = plane_pattern([0, 0, 0], [0, 0, 1], [0.6, 0, 0], [0, 0.45, 0], 250)
    held, errors, variances = 0, [], []
    for run in range(120):
        rng = np.random.default_rng(np.random.SeedSequence([17, run]))
        height = rng.uniform(-0.05, 0.05)
        values = ndtr((height - z) / 0.1)[:, None, None] + 0.05 * rng.standard_normal(grid.shape)
        own = EdgeSettings(sigma=0.1, plateau_radius=0.0)
        found = probe(as_volume(values, grid), points, normals, settings=own, contrast=1.0)
        plane = fit_plane(found.points[found.good], outliers=3.0, correlation_range=0.6)
        error, u = plane.point[2] - height, plane.u[2]
        held += abs(error) <= t.ppf(0.975, plane.dof) * u
        errors.append(error)
        variances.append(u**2)
    # 95 % of 120 within three standard deviations of a binomial; the rms error within the same.
    assert 107 <= held <= 120
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(variances)) == pytest.approx(1.0, abs=3 / np.sqrt(240))


class TestBadInput:
    def test_one_grey(self):
        grid = grid_of(20)
        with pytest.raises(InputError, match="one grey"):
            surface(as_volume(np.full(grid.shape, 0.3), grid))

    def test_not_finite(self, clean):
        values = clean.values.copy()
        values[::2] = np.nan
        with pytest.raises(InputError, match="not finite"):
            surface(Volume(values=values, grid=clean.grid))

    def test_inverted_contrast(self, clean):
        with pytest.raises(InputError, match="inverted"):
            surface(Volume(values=1 - clean.values, grid=clean.grid))
        with pytest.raises(InputError, match="inverted"):
            given_levels(1.0, 0.2)

    def test_no_voxel_on_one_side_of_the_level(self, clean):
        with pytest.raises(InputError, match="no surface"):
            surface(clean, levels=given_levels(5.0, 9.0))

    def test_probing_into_nothing(self, clean, balls):
        points, normals = sphere_pattern(balls[1][0], 4 * V, 50)
        with pytest.raises(InputError, match="no edge"):
            probe(clean, points, normals)

    @pytest.mark.parametrize("away", [300.0, -300.0])
    def test_probing_far_from_the_volume(self, clean, balls, away):
        """The splines of no voxels at all were once calculated here, beyond the end of an array."""
        points, normals = sphere_pattern(balls[1][0], R * V, 50)
        with pytest.raises(InputError, match="within the volume or near it"):
            probe(clean, points + [away, 0.0, away], normals)

    def test_probing_with_normals_turned_round(self, clean, balls):
        points, normals = sphere_pattern(balls[1][0], R * V, 50)
        with pytest.raises(InputError, match="no edge"):
            probe(clean, points, -normals)

    def test_shapes(self, clean):
        with pytest.raises(ShapeError):
            probe(clean, np.zeros((3, 2)), np.zeros((3, 2)))

    def test_settings(self):
        for bad in (
            {"search_distance": 0.0},
            {"window": 0.5},
            {"contrast_threshold": 1.0},
            {"sigma": -1.0},
            {"plateau_radius": -1.0},
        ):
            with pytest.raises(InputError):
                EdgeSettings(**bad)

    def test_a_missing_mode(self, clean):
        with pytest.raises(InputError, match="modes"):
            grey_levels(clean, 5)
