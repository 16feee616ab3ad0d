"""The calibration's share in lengths, by covariance and by virtual scans: against each other and against theory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

import tomopose as tp
from tomopose.calibration.uncertainty.propagation import length_sigma
from tomopose.errors import InputError
from tomopose.geometry.projection import project_ball
from tomopose.manipulator.error_models import EmpiricalErrors, PoseRange, RigidErrors
from tomopose.manipulator.pose_map import PoseMap
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.fits import fit_plane, fit_sphere
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from
from tomopose.measurement.probing import plane_pattern, sphere_pattern
from tomopose.measurement.results import MeasurementResults
from tomopose.measurement.uncertainty import displaced
from tomopose.simulation.scene.scene import scene_from
from tomopose.uncertainty.calibration_share import calibration_shares
from tomopose.uncertainty.virtual_scans import drawn_matrices, simulated_errors, virtual_volumes

BALLS, RADIUS = np.array([[-1.4, 0.2, 0.6], [1.3, -0.3, -0.5]]), 0.8
SCANNER = {
    "d_SD_mm": 900.0,
    "d_SR_mm": 200.0,
    "p_u_mm": 0.6,
    "p_v_mm": 0.63,
    "u_0_px": 29.3,
    "v_0_px": 31.1,
    "n_u_px": 60,
    "n_v_px": 63,
}
VOXEL, SIZE = 0.16, 40


def scene(snr):
    shapes = [{"kind": "sphere", "radius_mm": RADIUS, "t_mm": b.tolist()} for b in BALLS]
    return scene_from(
        {
            "schema": "tomopose/scene/1",
            "seed": 4,
            "scanner": SCANNER,
            "source": {"voltage_kV": 120.0, "filters": [{"material": "Cu", "thickness_mm": 2.0}]},
            "detector": {"snr": snr, "blur_sigma_px": 0.5},
            "objects": [{"kind": "solid", "material": "Al", "shapes": shapes}],
            "mount": {"angles_deg": [0, 0, 0]},
            "poses": {"scan": {"n": 48, "tilt": "triangle"}},
        }
    )


def plan():
    features = {
        f"ball {k}": {"kind": "sphere", "point": b.tolist(), "radius_mm": RADIUS, "n_points": 200}
        for k, b in enumerate(BALLS)
    }
    length = float(np.linalg.norm(BALLS[1] - BALLS[0]))
    return plan_from(
        {
            "schema": "tomopose/measurement-plan/1",
            "unit": "mm",
            "features": features,
            "surface": {"search_distance_mm": 0.4},
            "measurands": [
                {"name": "SD", "kind": "distance", "of": ["ball 0", "ball 1"], "nominal_mm": length},
                {"name": "D", "kind": "diameter", "of": ["ball 0"]},
                {"name": "form", "kind": "form_95", "of": ["ball 0"]},
            ],
        }
    )


@pytest.fixture(scope="module")
def run():
    return tp.simulate(scene(float("inf")))


@pytest.fixture(scope="module")
def calibration(run):
    """A calibration of this scanner, whose values are exact, from centres that are known to 0.05 px."""
    scanner, poses = run.scanner.exact(), tp.pose_grid(2, half_range=1.0)
    t = np.array([0.4, -0.3, 0.2])
    x = project_ball(scanner, T_HT=run.T_HT, T_MH=poses.T_MH, t=t)
    seen = tp.BallObservations.from_sigma(x, 0.05, pose_id=poses.pose_id)
    # the draws, and the interpolation of a field of nanometres, know nothing of what no ball shows
    return replace(tp.calibrate(scanner, poses, seen, hypotheses=False, robust=False), unseen=None)


def results(features):
    return MeasurementResults(
        plan_name="", results=(), features={"scan": features}, alignments={"scan": Alignment.none()}
    )


def test_a_distance_of_centres_has_the_share_that_theory_gives(run, calibration):
    features = {f"ball {k}": fit_sphere(sphere_pattern(b, RADIUS, 200)[0]) for k, b in enumerate(BALLS)}
    found = calibration_shares(results(features), plan(), "scan", calibration, run.poses)
    truth = float(length_sigma(calibration, run.poses, BALLS[0], BALLS[1])[0])
    assert found["SD"] == pytest.approx(truth, rel=0.02)
    assert found["D"] > 0
    assert "form" not in found


def test_a_distance_of_planes_has_the_share_of_the_points_between_them(run, calibration):
    """Two small parallel planes: their distance is that of two points one above the other."""
    ends = np.array([[0.3, 0.2, -1.1], [0.3, 0.2, 1.2]])
    document = {
        "schema": "tomopose/measurement-plan/1",
        "unit": "mm",
        "features": {},
        "measurands": [{"name": "L", "kind": "distance", "of": ["foot", "top"]}],
    }
    features = {}
    for name, x, n in (("foot", ends[0], -1.0), ("top", ends[1], 1.0)):
        features[name] = fit_plane(plane_pattern(x, [0, 0, n], [0.2, 0, 0], [0, 0.2, 0], 49)[0])
        document["features"][name] = {
            "kind": "plane",
            "point": x.tolist(),
            "direction": [0, 0, n],
            "u": [0.2, 0, 0],
            "v": [0, 0.2, 0],
        }
    found = calibration_shares(results(features), plan_from(document), "scan", calibration, run.poses)["L"]
    assert found == pytest.approx(float(length_sigma(calibration, run.poses, *ends)[0]), rel=0.05)


@pytest.mark.slow
def test_virtual_scans_with_drawn_calibrations_scatter_as_the_covariance_says(run, calibration):
    """No noise: only the calibration that is believed differs between the scans, here with d_SR uncertain too."""
    wide = replace(
        calibration,
        tangent=(*calibration.tangent, "d_SR"),
        covariance=block_diag(calibration.covariance, 0.2**2),
    )
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    draws = 10
    found = simulated_errors(run, plan(), grid, draws=draws, calibration=wide, seed=3)
    features = {f"ball {k}": fit_sphere(sphere_pattern(b, RADIUS, 200)[0]) for k, b in enumerate(BALLS)}
    stated = calibration_shares(results(features), plan(), "scan", wide, run.poses)["SD"]
    assert stated == pytest.approx(0.2 / 200.0 * np.linalg.norm(BALLS[1] - BALLS[0]), rel=0.05)
    assert found["SD"].u == pytest.approx(stated, rel=3 / np.sqrt(2 * (draws - 1)))
    assert abs(found["SD"].mean) < 3 * stated / np.sqrt(draws) + 0.02 * VOXEL
    assert np.isnan(found["D"].mean)
    assert found["SD"].runs == draws


def map_errors(run, machine, values):
    return EmpiricalErrors(machine=machine, values=values, u=machine.sigma, range=PoseRange.of(run.poses))


@pytest.fixture(scope="module")
def kinematic(run, calibration):
    """The same with errors of a manipulator, a linear map, as well known as before it was calibrated."""
    machine = PoseMap(order=1, t_scale=1.0)
    errors = map_errors(run, machine, np.zeros(len(machine.names)))
    return replace(
        calibration,
        model="kinematic",
        errors=errors,
        tangent=(*calibration.tangent, *machine.names),
        covariance=block_diag(calibration.covariance, np.diag(machine.sigma**2)),
    )


def test_drawn_errors_of_a_manipulator_scatter_as_their_covariance_says(run, kinematic):
    """Centres placed by the drawn matrices: between them only what the covariance's own share says."""
    grid, draws = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL), 60
    features = {f"ball {k}": fit_sphere(sphere_pattern(b, RADIUS, 200)[0]) for k, b in enumerate(BALLS)}
    rigid, stated = (
        calibration_shares(results(features), plan(), "scan", c, run.poses)["SD"]
        for c in (
            replace(
                kinematic, errors=RigidErrors(), tangent=kinematic.tangent[:6], covariance=kinematic.covariance[:6, :6]
            ),
            kinematic,
        )
    )
    assert stated > 5 * rigid
    P = drawn_matrices(run, grid, None, np.random.default_rng(0)).P
    found = np.array(
        [displaced(drawn_matrices(run, grid, kinematic, np.random.default_rng(k)).P, P, BALLS) for k in range(draws)]
    )
    lengths = np.linalg.norm(found[:, 1] - found[:, 0], axis=1)
    assert lengths.std(ddof=1) == pytest.approx(stated, rel=3 / np.sqrt(2 * (draws - 1)))
    # The part as a whole stays where it is.
    assert np.abs(found.mean(axis=1) - BALLS.mean(axis=0)).max() < 0.05 * VOXEL


@pytest.mark.slow
def test_virtual_scans_draw_the_errors_of_a_manipulator(run, kinematic):
    found = simulated_errors(run, plan(), tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL), draws=3, calibration=kinematic)
    assert found["SD"].with_calibration
    assert 0 < found["SD"].u < 0.05 * VOXEL


@pytest.mark.slow
def test_a_scene_whose_manipulator_errs_is_taken_to_be_where_the_calibration_puts_it(run, kinematic):
    """Identified errors are undone; without them the balls come out smeared and elsewhere."""
    machine = PoseMap(order=1, t_scale=1.0)
    errors = 3 * machine.sigma * np.random.default_rng(2).standard_normal(len(machine.names))
    exact = replace(
        kinematic,
        covariance=1e-12 * np.eye(len(kinematic.tangent)),
        errors=map_errors(run, machine, errors),
    )
    real = machine.real_poses(run.poses, errors)
    errs = replace(run, T_MH=replace(run.T_MH, R=real.R, t=real.t))
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    ideal, corrected = (next(virtual_volumes(r, grid, draws=1, calibration=exact)).values for r in (run, errs))
    ignored = next(virtual_volumes(errs, grid, draws=1)).values
    assert np.abs(corrected - ideal).max() < 0.05 * ideal.max()
    assert np.abs(ignored - ideal).max() > 0.3 * ideal.max()


@pytest.mark.slow
def test_draws_lie_elsewhere_and_differ_in_size_by_voxels(run):
    """Relative places of the two ends of a length within their voxels are drawn too; the part in mm stays."""
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    volumes = list(virtual_volumes(run, grid, draws=4))
    sizes = VOXEL / np.array([v.grid.spacing[0] for v in volumes])
    assert (np.abs(sizes - 1) <= 0.02).all()
    assert np.ptp(sizes) > 0.005
    centres = np.array([v.grid.centre for v in volumes]) - grid.centre
    assert np.abs(centres).max() <= VOXEL / 2 / 0.98
    assert np.ptp(centres, axis=0).min() > 0.1 * VOXEL
    for v in volumes:
        found = measure(v, plan()).features["volume"]
        for k, ball in enumerate(BALLS):
            assert found[f"ball {k}"].point == pytest.approx(ball, abs=0.01 * VOXEL)


@pytest.mark.slow
def test_virtual_scans_scatter_by_noise_and_repeat():
    noisy = tp.simulate(scene(120.0))
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    one, two = (simulated_errors(noisy, plan(), grid, draws=3, seed=5) for _ in range(2))
    assert one["SD"] == two["SD"]
    assert 0 < one["SD"].u < 0.2 * VOXEL
    assert one["SD"].low <= one["SD"].mean <= one["SD"].high


@pytest.mark.slow
def test_raw_frames_are_corrected_by_their_own_references():
    content = scene(120.0)
    raw = content.model_copy(
        update={
            "detector": content.detector.model_copy(
                update={"output": "raw", "dark": 500.0, "gain_spread": 0.02, "white": 40000.0}
            )
        }
    )
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    pair = [next(virtual_volumes(tp.simulate(s), grid, draws=1)).values for s in (content, raw)]
    inside = pair[0] > 0.7 * pair[0].max()
    assert np.median(pair[1][inside]) == pytest.approx(np.median(pair[0][inside]), rel=0.02)


class TestRefused:
    def test_too_few_draws(self, run):
        with pytest.raises(InputError, match="at least 3"):
            simulated_errors(run, plan(), tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL), draws=2)

    def test_another_detector(self, run, calibration):
        other = replace(calibration, scanner=replace(calibration.scanner, n_u=80))
        with pytest.raises(InputError, match="n_u"):
            simulated_errors(run, plan(), tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL), draws=3, calibration=other)

    def test_a_volume_that_was_not_measured(self, run, calibration):
        with pytest.raises(InputError, match="no results"):
            calibration_shares(results({}), plan(), "other", calibration, run.poses)
