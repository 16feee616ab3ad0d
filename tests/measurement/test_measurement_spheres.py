"""A standard of 27 balls on shafts: found, distinguished, measured."""

from __future__ import annotations

import numpy as np
import pytest
from blurred_shapes import as_volume, balls_volume
from scipy.special import ndtr

from tomopose.errors import InputError
from tomopose.geometry.rotations import exp_rotation
from tomopose.measurement.features.sphere_standard import find_spheres, identify_spheres, scale_factor
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from
from tomopose.measurement.surface.surface import surface
from tomopose.volume import VoxelGrid

V, SIGMA, DIAMETER = 0.15, 0.15, 1.8
R = exp_rotation(np.array([0.1, -0.2, 0.7]))
T = np.array([0.3, 0.2, -0.4])


def layout(rng):
    """27 centres, (27, 3) mm, of no symmetry, in a frame of their own."""
    lattice = np.stack(np.meshgrid(*[np.arange(3) - 1.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return lattice * 3.4 + rng.uniform(-0.45, 0.45, lattice.shape)


@pytest.fixture(scope="module")
def standard():
    """The volume and the calibrated centres; every ball is on a shaft of a third of its diameter."""
    rng = np.random.default_rng(3)
    calibrated = layout(rng)
    centres = calibrated @ R.T + T
    grid = VoxelGrid.cube(n=92, spacing=V)
    values = balls_volume(grid, centres, np.full(27, DIAMETER / 2), SIGMA)
    x, y, z = (grid.origin[a] + V * np.arange(92) for a in range(3))
    for c in centres:
        rho = np.hypot(x[None, :] - c[0], y[:, None] - c[1])
        below = ndtr((c[2] - z) / SIGMA) * ndtr((z - c[2] + 1.4) / SIGMA)
        values = np.maximum(values, ndtr((0.3 - rho) / SIGMA)[None] * below[:, None, None])
    values += 0.02 * rng.standard_normal(grid.shape)
    return as_volume(values, grid), calibrated


def test_all_are_found_and_named(standard):
    volume, calibrated = standard
    found = find_spheres(surface(volume), DIAMETER / 2)
    which = identify_spheres(found, calibrated, tolerance=0.2)
    assert (which.index >= 0).all()
    assert np.linalg.norm(found[which.index] - (calibrated @ R.T + T), axis=1).max() < 0.05
    assert which.alignment.t == pytest.approx(T, abs=0.02)


def plan(calibrated, **changes):
    return plan_from(
        {
            "schema": "tomopose/measurement-plan/1",
            "unit": "mm",
            "name": "standard",
            "spheres": {
                "centres": calibrated.tolist(),
                "diameter_mm": DIAMETER,
                "safety_mm": 0.15,
                "tolerance_mm": 0.2,
                "u_distance_mm": 0.0003,
                "mpe_distance": {"A_um": 9.0, "K": 50.0},
                **changes,
            },
        }
    )


@pytest.mark.slow
def test_the_whole_standard(standard):
    volume, calibrated = standard
    found = measure(volume, plan(calibrated))
    assert found.notes["volume"][-1].endswith("not applied")
    kinds = [r.kind for r in found.results]
    assert kinds.count("distance") == 351
    assert kinds.count("diameter") == 27
    assert kinds.count("form_95") == 27
    errors = np.array([r.error for r in found.results if r.kind == "distance"])
    assert np.abs(errors).max() < 0.03 * V
    assert all(r.within for r in found.results if r.kind == "distance")
    assert all(r.direction == "unidirectional" for r in found.results if r.kind == "distance")
    diameters = np.array([r.error for r in found.results if r.kind == "diameter"])
    assert diameters == pytest.approx(np.full(27, -2 * SIGMA**2 / (DIAMETER / 2)), abs=0.05 * V)
    assert found.scale["volume"] == 1.0


@pytest.mark.slow
def test_the_scale_correction_is_switched_on_and_reported(standard):
    volume, calibrated = standard
    found = measure(volume, plan(calibrated * 1.002, scale_correction=True))
    assert found.scale["volume"] == pytest.approx(1.002, abs=5e-5)
    errors = np.array([r.error for r in found.results if r.kind == "distance"])
    assert np.abs(errors).max() < 0.03 * V
    assert any("applied" in n for n in found.notes["volume"])


class TestIdentification:
    @pytest.fixture
    def pair(self):
        rng = np.random.default_rng(8)
        c = layout(rng)
        order = rng.permutation(27)
        return (c @ R.T + T + 0.005 * rng.standard_normal(c.shape))[order], c, order

    def test_any_order(self, pair):
        found, c, order = pair
        which = identify_spheres(found, c, tolerance=0.1)
        assert (order[which.index] == np.arange(27)).all()

    def test_missing_and_false_ones(self, pair):
        found, c, order = pair
        more = np.vstack([found[:20], np.random.default_rng(1).uniform(-5, 5, (6, 3))])
        which = identify_spheres(more, c, tolerance=0.1)
        seen = which.index >= 0
        assert (order[which.index[seen]] == np.flatnonzero(seen)).all()
        assert set(order[:20]) == set(np.flatnonzero(seen))

    def test_metres_for_millimetres(self, pair):
        with pytest.raises(InputError, match="does not match"):
            identify_spheres(pair[0], pair[1] / 1000, tolerance=0.1)

    def test_a_mirror_image_does_not_match(self, pair):
        with pytest.raises(InputError, match="does not match"):
            identify_spheres(pair[0] * [1, 1, -1], pair[1], tolerance=0.05)

    def test_a_symmetric_constellation_is_refused(self):
        cube = np.array([[x, y, z] for x in (0, 4.0) for y in (0, 4.0) for z in (0, 4.0)])
        with pytest.raises(InputError, match="ambiguous"):
            identify_spheres(cube, cube, tolerance=0.1)

    def test_the_scale_factor(self, pair):
        assert scale_factor(pair[1] / 1.001, pair[1]) == pytest.approx(1.001, abs=1e-12)


def test_no_ball_of_that_size(standard):
    with pytest.raises(InputError, match="two voxels"):
        find_spheres(surface(standard[0]), 0.0025)
